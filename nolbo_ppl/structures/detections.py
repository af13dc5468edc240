"""Observations of objects as SLAM takes them: one table of arrays, NaN where a field is missing, checked before use."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from nolbo_ppl._moved import renamed
from nolbo_ppl.errors import input_error

MAXIMUM_DISTANCE = 1e5
"""Positions farther than this from the camera, in m, are refused as malformed."""


@dataclass(frozen=True)
class Detections:
    """Detections of objects in camera frames; NaN where a field is missing. Rows keep the order of the file."""

    frame: Int[np.ndarray, " n"]
    """Row of the odometry, from 0."""
    position: Float[np.ndarray, "n 3"]
    """Position of the object in the camera frame, m."""
    position_covariance: Float[np.ndarray, "n 3 3"]
    """Covariance of the position in the camera frame, m^2; NaN: to be estimated."""
    rotation: Float[np.ndarray, "n 3 3"]
    """R_camera_object; NaN: the detector gives none."""
    rotation_scale: Float[np.ndarray, " n"]
    """Standard deviation of each angle of the rotation, rad; NaN: to be estimated."""
    latent: Float[np.ndarray, "n d"]
    """Shape latent; d may be 0; a row of NaN where missing."""
    latent_scale: Float[np.ndarray, "n d"]
    """Its standard deviation; NaN: to be estimated."""
    objectness: Float[np.ndarray, " n"]
    """Probability that this is an object at all, q(o)."""
    category: tuple[str | None, ...]
    """Category name or None."""
    size: Float[np.ndarray, "n 3"]
    """Extent in m, NaN where missing."""
    symmetry: Int[np.ndarray, " n"]
    """Order of the symmetry about the object's vertical axis (0 free); -1: that of the category."""
    id: tuple[str, ...]
    """Identifiers; the row number where the file had none."""
    mode_weight: Float[np.ndarray, "n K"] = field(default_factory=lambda: np.zeros((0, 0)))
    """Weights of the modes of the orientation, 0 where there are fewer; K is 0 when nobody states any."""
    mode_rotation: Float[np.ndarray, "n K 3 3"] = field(default_factory=lambda: np.zeros((0, 0, 3, 3)))
    """R_camera_object of every mode, the identity where there are fewer."""
    mode_std: Float[np.ndarray, "n K"] = field(default_factory=lambda: np.ones((0, 0)))
    """Standard deviation of each angle of every mode, rad; 1 where there are fewer."""

    def __post_init__(self) -> None:
        if len(self.mode_weight) != len(self.frame) and not self.mode_weight.shape[1]:  # a table without modes
            object.__setattr__(self, "mode_weight", np.zeros((len(self.frame), 0)))
            object.__setattr__(self, "mode_rotation", np.zeros((len(self.frame), 0, 3, 3)))
            object.__setattr__(self, "mode_std", np.ones((len(self.frame), 0)))

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def latent_dim(self) -> int:
        """Dimension of the latents, 0 when there are none."""
        return self.latent.shape[1]

    @property
    def modes(self) -> int:
        """Most modes an orientation has, 0 when none are stated."""
        return self.mode_weight.shape[1]

    @property
    def has_rotation(self) -> Bool[np.ndarray, " n"]:
        """Rows with an orientation."""
        return np.isfinite(self.rotation[:, 0, 0])

    @property
    def has_latent(self) -> Bool[np.ndarray, " n"]:
        """Rows with a latent."""
        return np.isfinite(self.latent).all(axis=1) & (self.latent_dim > 0)

    def select(self, rows: np.ndarray) -> Detections:
        """The given rows (indices or a mask), in that order."""
        index = np.arange(len(self))[rows]
        return replace(
            self,
            **{name: getattr(self, name)[index] for name in ARRAYS},
            category=tuple(self.category[i] for i in index),
            id=tuple(self.id[i] for i in index),
        )


ARRAYS = (
    "frame",
    "position",
    "position_covariance",
    "rotation",
    "rotation_scale",
    "latent",
    "latent_scale",
    "objectness",
    "size",
    "symmetry",
    "mode_weight",
    "mode_rotation",
    "mode_std",
)


def make_table(
    frame: Any,
    position: Any,
    *,
    position_covariance: Any = None,
    position_scale: Any = None,
    rotation: Any = None,
    rotation_scale: Any = None,
    latent: Any = None,
    latent_scale: Any = None,
    objectness: Any = None,
    category: Iterable[str | None] | None = None,
    size: Any = None,
    symmetry: Any = None,
    id: Iterable[str] | None = None,
    mode_weight: Any = None,
    mode_rotation: Any = None,
    mode_std: Any = None,
) -> Detections:
    """Build a table from numpy arrays; everything but frame and position is optional, scalars are broadcast.

    Args:
        frame: [n] rows of the odometry.
        position: [n, 3] m in the camera frame.
        position_covariance: [n, 3, 3] m^2, or `position_scale` [n, 3], [n] or a number in m.
        rotation: [n, 3, 3] R_camera_object.
        latent: [n, d]; `latent_scale` [n, d], [n] or a number.
        mode_weight: [n, K] weights of the orientation's modes (0: no such mode), with `mode_rotation` [n, K, 3, 3] and
            `mode_std` [n, K] or a number in rad; where `rotation` is not given it is the heaviest mode.

    Raises:
        InputError: shapes do not match.
    """
    frame = np.asarray(frame, dtype=np.int64).reshape(-1)
    n = len(frame)
    count = 0 if mode_weight is None else np.asarray(mode_weight).shape[-1]
    if count and (mode_rotation is None or mode_std is None):
        raise input_error("modes of the orientation are incomplete", expected="mode_weight, mode_rotation and mode_std")

    def full(value: Any, shape: tuple[int, ...], name: str, default: float = np.nan) -> np.ndarray:
        if value is None:
            return np.full(shape, default)
        array = np.asarray(value, dtype=np.float64)
        if array.ndim == 1 and len(shape) == 2 and len(array) == n:
            array = array[:, None]
        try:
            return np.array(np.broadcast_to(array, shape))
        except ValueError:
            raise input_error(f"{name} has the wrong shape", got=array.shape, expected=shape) from None

    dimension = 0 if latent is None else np.asarray(latent).shape[-1]
    if position_covariance is None and position_scale is not None:
        scale = full(position_scale, (n, 3), "position_scale")
        position_covariance = scale[:, :, None] ** 2 * np.eye(3)
    modes: dict[str, np.ndarray] = {}
    if count:
        modes = {
            "mode_weight": full(mode_weight, (n, count), "mode_weight"),
            "mode_rotation": full(mode_rotation, (n, count, 3, 3), "mode_rotation"),
            "mode_std": full(mode_std, (n, count), "mode_std"),
        }
        if rotation is None:
            rotation, rotation_scale = heaviest_mode(**modes)
    categories = tuple(category) if category is not None else (None,) * n
    ids = tuple(id) if id is not None else tuple(str(i) for i in range(n))
    if len(categories) != n or len(ids) != n:
        raise input_error("category or id has the wrong length", got=(len(categories), len(ids)), expected=n)
    return Detections(
        frame=frame,
        position=full(position, (n, 3), "position").reshape(n, 3),
        position_covariance=full(position_covariance, (n, 3, 3), "position_covariance"),
        rotation=full(rotation, (n, 3, 3), "rotation"),
        rotation_scale=full(rotation_scale, (n,), "rotation_scale"),
        latent=full(latent, (n, dimension), "latent"),
        latent_scale=full(latent_scale, (n, dimension), "latent_scale"),
        objectness=full(objectness, (n,), "objectness", default=1.0),
        category=categories,
        size=full(size, (n, 3), "size"),
        symmetry=full(symmetry, (n,), "symmetry", default=-1.0).astype(np.int64),
        id=ids,
        **modes,
    )


def heaviest_mode(
    mode_weight: Float[np.ndarray, "n K"], mode_rotation: Float[np.ndarray, "n K 3 3"], mode_std: Float[np.ndarray, "n K"]
) -> tuple[Float[np.ndarray, "n 3 3"], Float[np.ndarray, " n"]]:
    """Rotation and scale of each row's heaviest mode, NaN where a row has none."""
    row, best = np.arange(len(mode_weight)), np.argmax(mode_weight, axis=1)
    none = mode_weight[row, best] <= 0
    return (np.where(none[:, None, None], np.nan, mode_rotation[row, best]), np.where(none, np.nan, mode_std[row, best]))


def with_modes(table: Detections, count: int) -> Detections:
    """The same table with room for `count` modes an orientation."""
    more = count - table.modes
    if more <= 0:
        return table
    n = len(table)
    return replace(
        table,
        mode_weight=np.concatenate([table.mode_weight, np.zeros((n, more))], axis=1),
        mode_rotation=np.concatenate([table.mode_rotation, np.tile(np.eye(3), (n, more, 1, 1))], axis=1),
        mode_std=np.concatenate([table.mode_std, np.ones((n, more))], axis=1),
    )


def concatenate(tables: list[Detections]) -> Detections:
    """Stack tables of one latent dimension."""
    count = max(table.modes for table in tables)
    tables = [with_modes(table, count) for table in tables]
    first = tables[0]
    return replace(
        first,
        **{name: np.concatenate([getattr(t, name) for t in tables]) for name in ARRAYS},
        category=sum((t.category for t in tables), ()),
        id=sum((t.id for t in tables), ()),
    )


def check_table(table: Detections, frames: int) -> None:
    """Refuse what no inference can use: the first bad row is named by its id.

    Raises:
        InputError: frames out of range, values not finite, covariances not positive definite, no rotations, scales not
            positive, objectness outside [0, 1].
    """

    def refuse(bad: np.ndarray, what: str, values: np.ndarray, expected: str) -> None:
        if bad.any():
            row = int(np.argmax(bad))
            raise input_error(f"observation {table.id[row]!r} (row {row}): {what}", got=values[row], expected=expected)

    refuse((table.frame < 0) | (table.frame >= frames), "frame out of range", table.frame, f"0 to {frames - 1}")
    refuse(~np.isfinite(table.position).all(axis=1), "position is not finite", table.position, "3 finite numbers in m")
    refuse(
        np.abs(table.position).max(axis=1, initial=0) > MAXIMUM_DISTANCE,
        "position out of range",
        table.position,
        f"within {MAXIMUM_DISTANCE:g} m",
    )
    given = ~np.isnan(table.position_covariance).all(axis=(1, 2))
    covariance = np.where(given[:, None, None], table.position_covariance, np.eye(3))
    finite = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    refuse(~finite, "position covariance is not finite", covariance, "finite m^2")
    symmetric = np.abs(covariance - np.swapaxes(covariance, 1, 2)).max(axis=(1, 2), initial=0) <= 1e-6 * np.abs(covariance).max(
        axis=(1, 2), initial=0
    )
    refuse(~symmetric, "position covariance is not symmetric", covariance, "a symmetric matrix")
    eigenvalues = np.linalg.eigvalsh(covariance) if len(covariance) else np.ones((0, 3))
    refuse(
        eigenvalues[:, 0] <= 1e-12 * np.maximum(eigenvalues[:, 2], 1e-300),
        "position covariance is not positive definite",
        covariance,
        "positive eigenvalues",
    )
    rotation = np.where(table.has_rotation[:, None, None], table.rotation, np.eye(3))
    residual = np.abs(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(3)).max(axis=(1, 2), initial=0)
    refuse(~(residual < 1e-3) | (np.linalg.det(rotation) < 0), "rotation is no rotation", rotation, "orthonormal")
    for name in ("rotation_scale", "latent_scale"):
        scale = getattr(table, name).reshape(len(table), -1 if len(table) else 0)
        bad = ((scale <= 0) | np.isinf(scale)).any(axis=1)
        refuse(bad, f"{name} is not a positive number", scale, "greater than 0")
    weight = table.mode_weight
    refuse(~(np.isfinite(weight) & (weight >= 0)).all(axis=1), "mode_weight is no weight", weight, "0 or more")
    stated = weight.sum(axis=1) > 0
    refuse(stated & ~table.has_rotation, "modes without a rotation", weight, "`rotation`, the best mode, as well")
    turned = table.mode_rotation
    residual = np.abs(np.swapaxes(turned, 2, 3) @ turned - np.eye(3)).max(axis=(1, 2, 3), initial=0)
    mirrored = (np.linalg.det(turned) < 0).any(axis=1)
    refuse(~(residual < 1e-3) | mirrored, "mode_rotation is no rotation", turned, "orthonormal")
    bad = (~(table.mode_std > 0) | np.isinf(table.mode_std)).any(axis=1)
    refuse(bad, "mode_std is not a positive number", table.mode_std, "greater than 0")
    refuse(np.isinf(table.latent).any(axis=1), "latent is not finite", table.latent, "finite numbers")
    refuse(~((table.objectness >= 0) & (table.objectness <= 1)), "objectness is no probability", table.objectness, "0 to 1")


__getattr__ = renamed(__name__, {"ObservationTable": "Detections"})
