"""Detections of objects as SLAM takes them: one table of arrays, NaN where a field is missing."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from graphlib import CycleError, TopologicalSorter
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from nolbo_ppl._moved import renamed
from nolbo_ppl.errors import input_error

NOT_STATED: Any = None
"""A field that nobody stated: it is filled with missing values when the table is made."""


@dataclass(frozen=True)
class Detections:
    """Detections of objects in camera frames, a row each; what is missing is NaN, -1 or None.

    What `SlamProblem` takes and what a file of observations holds (`nolbo_ppl.read_observations`); made from a model's answer
    by `ObjectPosteriors.detections`, from arrays of your own by `Detections.from_arrays`.

    >>> seen = Detections.from_arrays([0, 0, 1], [[0, 0, 5.0], [2, 0, 9], [0, 0, 4]], category=["car", "bus", "car"])
    >>> len(seen), seen.select(seen.frame == 0).category
    (3, ('car', 'bus'))
    >>> seen.has_rotation.any()
    np.False_
    """

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
    position_shared: Float[np.ndarray, "n 3 3"] = NOT_STATED
    """The part of `position_covariance` that is one error for all views of an object, in the camera's axes, m^2: views added up
    do not make it smaller. NaN: none."""
    mode_weight: Float[np.ndarray, "n K"] = NOT_STATED
    """Weights of the modes of the orientation, 0 where there are fewer; K is 0 when nobody states any."""
    mode_rotation: Float[np.ndarray, "n K 3 3"] = NOT_STATED
    """R_camera_object of every mode, the identity where there are fewer."""
    mode_std: Float[np.ndarray, "n K"] = NOT_STATED
    """Standard deviation of each angle of every mode, rad; 1 where there are fewer."""
    image: tuple[str | None, ...] = ()
    """Name of the image it was seen in, or None."""
    time: Float[np.ndarray, " n"] = NOT_STATED
    """Time of that image, s; NaN where missing."""
    box: Float[np.ndarray, "n 4"] = NOT_STATED
    """Box [x0, y0, x1, y1] in that image, px; NaN where missing."""
    class_names: tuple[str, ...] = ()
    """Categories of the columns of `class_posterior`, in an order that agrees with every row's."""
    class_posterior: Float[np.ndarray, "n c"] = NOT_STATED
    """Probability of each of `class_names`; NaN where a row does not state it."""
    viewpoint: Float[np.ndarray, "n 3"] = NOT_STATED
    """(azimuth, elevation, in-plane rotation), allocentric, rad; NaN where missing."""
    azimuth_weight: Float[np.ndarray, "n M"] = NOT_STATED
    """Weights of the von Mises modes of the azimuth; NaN where there are fewer."""
    azimuth: Float[np.ndarray, "n M"] = NOT_STATED
    """Their mean directions, allocentric, rad."""
    azimuth_concentration: Float[np.ndarray, "n M"] = NOT_STATED
    """Their concentrations."""
    position_tails: Float[np.ndarray, "n 2"] = NOT_STATED
    """Law of the true position about the stated one: degrees of freedom of Student's t, and the factor on the covariance that
    makes it the scale matrix; NaN: nobody states one."""
    latent_mode_weight: Float[np.ndarray, "n L"] = NOT_STATED
    """Weights of the modes of the latent, 0 where there are fewer or none is stated; L is 0 when nobody states any."""
    latent_mode: Float[np.ndarray, "n L d"] = NOT_STATED
    """Their means, all with `latent_scale`; `latent` is the heaviest. 0 where there are fewer."""

    def __post_init__(self) -> None:
        n = len(self.frame)
        if len(self.image) != n and not self.image:
            object.__setattr__(self, "image", (None,) * n)
        for name, columns in OPTIONAL.items():
            if getattr(self, name) is NOT_STATED:
                shape = (n, 0, self.latent_dim) if name == "latent_mode" else (n, *columns)
                object.__setattr__(self, name, padding(name, shape))

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def latent_dim(self) -> int:
        """Dimension of the latents, 0 when there are none."""
        count: int = self.latent.shape[1]
        return count

    @property
    def modes(self) -> int:
        """Most modes an orientation has, 0 when none are stated."""
        count: int = self.mode_weight.shape[1]
        return count

    @property
    def has_rotation(self) -> Bool[np.ndarray, " n"]:
        """Rows with an orientation."""
        known: np.ndarray = np.isfinite(self.rotation[:, 0, 0])
        return known

    @property
    def has_latent(self) -> Bool[np.ndarray, " n"]:
        """Rows with a latent."""
        known: np.ndarray = np.isfinite(self.latent).all(axis=1) & (self.latent_dim > 0)
        return known

    @property
    def has_box(self) -> Bool[np.ndarray, " n"]:
        """Rows with a box in the image."""
        known: np.ndarray = np.isfinite(self.box).all(axis=1)
        return known

    @property
    def has_azimuth(self) -> Bool[np.ndarray, " n"]:
        """Rows that state the modes of their azimuth."""
        known: np.ndarray = np.isfinite(self.azimuth_weight).any(axis=1)
        return known

    def select(self, rows: np.ndarray) -> Detections:
        """The given rows (indices or a mask), in that order."""
        index = np.arange(len(self))[rows]
        chosen: dict[str, Any] = {name: getattr(self, name)[index] for name in ARRAYS}
        chosen |= {name: tuple(getattr(self, name)[i] for i in index) for name in TEXTS}
        return replace(self, **chosen)

    @classmethod
    def from_arrays(
        cls,
        frame: Any,
        position: Any,
        *,
        position_covariance: Any = None,
        position_scale: Any = None,
        position_shared: Any = None,
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
        image: Iterable[str | None] | None = None,
        time: Any = None,
        box: Any = None,
        latent_mode_weight: Any = None,
        latent_mode: Any = None,
    ) -> Detections:
        """Build a table from arrays; everything but frame and position is optional, scalars are broadcast.

        Args:
            frame: [n] rows of the odometry.
            position: [n, 3] m in the camera frame.
            position_covariance: [n, 3, 3] m^2, or `position_scale` [n, 3], [n] or a number in m.
            position_shared: [n, 3, 3] m^2, the part of it that all views of an object have in common.
            rotation: [n, 3, 3] R_camera_object.
            latent: [n, d]; `latent_scale` [n, d], [n] or a number.
            mode_weight: [n, K] weights of the orientation's modes (0: no such mode), with `mode_rotation` [n, K, 3, 3] and
                `mode_std` [n, K] or a number in rad; where `rotation` is not given it is the heaviest mode.
            latent_mode_weight: [n, L] weights of the latent's modes (0: no such mode), with `latent_mode` [n, L, d]; where
                `latent` is not given it is the heaviest mode.
            image: [n] names of images, with `time` [n] s and `box` [n, 4] px.

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

        latents = 0 if latent_mode_weight is None else np.asarray(latent_mode_weight).shape[-1]
        if latents and latent_mode is None:
            raise input_error("modes of the latent are incomplete", expected="latent_mode_weight and latent_mode")
        known = latent_mode if latents and latent is None else latent
        dimension = 0 if known is None else np.asarray(known).shape[-1]
        if position_covariance is None and position_scale is not None:
            scale = full(position_scale, (n, 3), "position_scale")
            position_covariance = scale[:, :, None] ** 2 * np.eye(3)
        modes: dict[str, Any] = {}
        if count:
            modes = {
                "mode_weight": full(mode_weight, (n, count), "mode_weight"),
                "mode_rotation": full(mode_rotation, (n, count, 3, 3), "mode_rotation"),
                "mode_std": full(mode_std, (n, count), "mode_std"),
            }
            if rotation is None:
                rotation, rotation_scale = heaviest_mode(**modes)
        if latents:
            weight = full(latent_mode_weight, (n, latents), "latent_mode_weight")
            mean = full(latent_mode, (n, latents, dimension), "latent_mode")
            modes |= {"latent_mode_weight": weight, "latent_mode": mean}
            if latent is None:
                latent = heaviest_latent(weight, mean)
        texts: dict[str, Any] = {
            "category": tuple(category) if category is not None else (None,) * n,
            "id": tuple(id) if id is not None else tuple(str(i) for i in range(n)),
            "image": tuple(image) if image is not None else (None,) * n,
        }
        for name, values in texts.items():
            if len(values) != n:
                raise input_error(f"{name} has the wrong length", got=len(values), expected=n)
        return cls(
            frame=frame,
            position=full(position, (n, 3), "position").reshape(n, 3),
            position_covariance=full(position_covariance, (n, 3, 3), "position_covariance"),
            position_shared=full(position_shared, (n, 3, 3), "position_shared"),
            rotation=full(rotation, (n, 3, 3), "rotation"),
            rotation_scale=full(rotation_scale, (n,), "rotation_scale"),
            latent=full(latent, (n, dimension), "latent"),
            latent_scale=full(latent_scale, (n, dimension), "latent_scale"),
            objectness=full(objectness, (n,), "objectness", default=1.0),
            size=full(size, (n, 3), "size"),
            symmetry=full(symmetry, (n,), "symmetry", default=-1.0).astype(np.int64),
            time=full(time, (n,), "time"),
            box=full(box, (n, 4), "box"),
            **texts,
            **modes,
        )

    @classmethod
    def concatenate(cls, tables: Sequence[Detections]) -> Detections:
        """Stack tables: those without latents get rows of NaN, those with fewer modes or categories room for more.

        >>> one = Detections.from_arrays([0], [[0, 0, 5.0]], latent=[[1.0, 2.0]], id=["a"])
        >>> two = Detections.from_arrays([1], [[0, 0, 4.0]], id=["b"])
        >>> Detections.concatenate([one, two]).latent
        array([[ 1.,  2.],
               [nan, nan]])

        Raises:
            InputError: no tables, or latents of different lengths.
        """
        if not tables:
            raise input_error("no tables to stack", expected="at least one")
        dimensions = sorted({table.latent_dim for table in tables} - {0})
        if len(dimensions) > 1:
            raise input_error("latents of different lengths", got=dimensions, expected="one length")
        names = merged_order([table.class_names for table in tables])
        tables = [_in_columns(table, names) for table in tables]
        joined: dict[str, Any] = {"class_names": names}
        for name in ARRAYS:
            values = [getattr(table, name) for table in tables]
            width = tuple(max(lengths) for lengths in zip(*(value.shape[1:] for value in values)))
            joined[name] = np.concatenate([_widened(name, value, width) for value in values])
        for name in TEXTS:
            joined[name] = tuple(text for table in tables for text in getattr(table, name))
        return cls(**joined)


TEXTS = ("category", "id", "image")
"""Fields with a text for each row."""
ARRAYS = tuple(one.name for one in fields(Detections) if one.name not in (*TEXTS, "class_names"))
"""Fields with a row of numbers for each row."""
OPTIONAL: dict[str, tuple[int, ...]] = {
    "position_shared": (3, 3),
    "mode_weight": (0,),
    "mode_rotation": (0, 3, 3),
    "mode_std": (0,),
    "time": (),
    "box": (4,),
    "class_posterior": (0,),
    "viewpoint": (3,),
    "azimuth_weight": (0,),
    "azimuth": (0,),
    "azimuth_concentration": (0,),
    "position_tails": (2,),
    "latent_mode_weight": (0,),
    "latent_mode": (0, 0),
}
"""Numbers that a table may be made without, and the shape of a row that nobody stated."""


NOTHING = ("mode_weight", "latent_mode_weight", "latent_mode")
"""Numbers that are 0 where nobody states them."""


def padding(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """What stands for a missing value of a field."""
    if name == "mode_rotation":
        return np.tile(np.eye(3), (*shape[:2], 1, 1))
    return np.full(shape, {"mode_std": 1.0}.get(name, 0.0 if name in NOTHING else np.nan))


def _widened(name: str, value: np.ndarray, width: tuple[int, ...]) -> np.ndarray:
    """A field with rows of the shape that `width` says, what is new missing."""
    for axis, length in enumerate(width, start=1):
        if value.shape[axis] < length:
            more = padding(name, (*value.shape[:axis], length - value.shape[axis], *value.shape[axis + 1 :]))
            value = np.concatenate([value, more], axis=axis)
    return value


def _in_columns(table: Detections, names: tuple[str, ...]) -> Detections:
    """The same table with its class posterior in the given columns."""
    if table.class_names == names:
        return table
    posterior = np.full((len(table), len(names)), np.nan)
    posterior[:, [names.index(name) for name in table.class_names]] = table.class_posterior
    return replace(table, class_names=names, class_posterior=posterior)


def merged_order(orders: Iterable[Sequence[str]]) -> tuple[str, ...]:
    """All names once, in an order that agrees with every given one; that of their first appearance where none does."""
    different = list(dict.fromkeys(tuple(order) for order in orders))
    names = tuple(dict.fromkeys(name for order in different for name in order))
    before: dict[str, dict[str, None]] = {name: {} for name in names}  # no sets: their order would change from run to run
    for order in different:
        for earlier, later in pairwise(order):
            before[later][earlier] = None
    try:
        return tuple(TopologicalSorter(before).static_order())
    except CycleError:
        return names


def heaviest_mode(
    mode_weight: Float[np.ndarray, "n K"], mode_rotation: Float[np.ndarray, "n K 3 3"], mode_std: Float[np.ndarray, "n K"]
) -> tuple[Float[np.ndarray, "n 3 3"], Float[np.ndarray, " n"]]:
    """Rotation and scale of each row's heaviest mode, NaN where a row has none."""
    row, best = np.arange(len(mode_weight)), np.argmax(mode_weight, axis=1)
    none = mode_weight[row, best] <= 0
    return (np.where(none[:, None, None], np.nan, mode_rotation[row, best]), np.where(none, np.nan, mode_std[row, best]))


def heaviest_latent(weight: Float[np.ndarray, "n L"], mode: Float[np.ndarray, "n L d"]) -> Float[np.ndarray, "n d"]:
    """Latent of each row's heaviest mode, NaN where a row has none."""
    row, best = np.arange(len(weight)), np.argmax(weight, axis=1)
    return np.where(weight[row, best][:, None] > 0, mode[row, best], np.nan)


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
