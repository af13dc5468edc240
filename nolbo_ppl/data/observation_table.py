"""Observations of objects as SLAM takes them: one table of arrays, NaN where a field is missing, checked before use."""


from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from nolbo_ppl.errors import input_error

MAXIMUM_DISTANCE = 1e5
"""Positions farther than this from the camera, in m, are refused as malformed."""


@dataclass(frozen=True)
class ObservationTable:
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

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def latent_dim(self) -> int:
        """Dimension of the latents, 0 when there are none."""
        return self.latent.shape[1]

    @property
    def has_rotation(self) -> Bool[np.ndarray, " n"]:
        """Rows with an orientation."""
        return np.isfinite(self.rotation[:, 0, 0])

    @property
    def has_latent(self) -> Bool[np.ndarray, " n"]:
        """Rows with a latent."""
        return np.isfinite(self.latent).all(axis=1) & (self.latent_dim > 0)

    def select(self, rows: np.ndarray) -> ObservationTable:
        """The given rows (indices or a mask), in that order."""
        index = np.arange(len(self))[rows]
        return replace(
            self, **{name: getattr(self, name)[index] for name in ARRAYS},
            category=tuple(self.category[i] for i in index), id=tuple(self.id[i] for i in index),
        )


ARRAYS = (
    "frame", "position", "position_covariance", "rotation", "rotation_scale", "latent", "latent_scale", "objectness",
    "size", "symmetry",
)


def make_table(
    frame: Any, position: Any, *, position_covariance: Any = None, position_scale: Any = None, rotation: Any = None,
    rotation_scale: Any = None, latent: Any = None, latent_scale: Any = None, objectness: Any = None,
    category: Iterable[str | None] | None = None, size: Any = None, symmetry: Any = None,
    id: Iterable[str] | None = None,
) -> ObservationTable:
    """Build a table from numpy arrays; everything but frame and position is optional, scalars are broadcast.

    Args:
        frame: [n] rows of the odometry.
        position: [n, 3] m in the camera frame.
        position_covariance: [n, 3, 3] m^2, or `position_scale` [n, 3], [n] or a number in m.
        rotation: [n, 3, 3] R_camera_object.
        latent: [n, d]; `latent_scale` [n, d], [n] or a number.

    Raises:
        InputError: shapes do not match.
    """
    frame = np.asarray(frame, dtype=np.int64).reshape(-1)
    n = len(frame)

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
    categories = tuple(category) if category is not None else (None,) * n
    ids = tuple(id) if id is not None else tuple(str(i) for i in range(n))
    if len(categories) != n or len(ids) != n:
        raise input_error("category or id has the wrong length", got=(len(categories), len(ids)), expected=n)
    return ObservationTable(
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
    )


def concatenate(tables: list[ObservationTable]) -> ObservationTable:
    """Stack tables of one latent dimension."""
    first = tables[0]
    return replace(
        first, **{name: np.concatenate([getattr(t, name) for t in tables]) for name in ARRAYS},
        category=sum((t.category for t in tables), ()), id=sum((t.id for t in tables), ()),
    )


def check_table(table: ObservationTable, frames: int) -> None:
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
    refuse(np.abs(table.position).max(axis=1, initial=0) > MAXIMUM_DISTANCE, "position out of range", table.position,
           f"within {MAXIMUM_DISTANCE:g} m")
    given = ~np.isnan(table.position_covariance).all(axis=(1, 2))
    covariance = np.where(given[:, None, None], table.position_covariance, np.eye(3))
    finite = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    refuse(~finite, "position covariance is not finite", covariance, "finite m^2")
    symmetric = np.abs(covariance - np.swapaxes(covariance, 1, 2)).max(axis=(1, 2), initial=0) <= 1e-6 * np.abs(
        covariance).max(axis=(1, 2), initial=0)
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
    refuse(np.isinf(table.latent).any(axis=1), "latent is not finite", table.latent, "finite numbers")
    refuse(
        ~((table.objectness >= 0) & (table.objectness <= 1)), "objectness is no probability", table.objectness, "0 to 1"
    )
