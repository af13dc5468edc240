"""One labelled image: its objects as arrays, NaN, -1 or None where a label is missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from nolbo_ppl.errors import input_error

MIN_SIDE = 12.0
"""Objects whose box has no side of so many px need not be found."""
MIN_VISIBILITY = 0.5
"""Objects of which less is seen need not be found."""


@dataclass(frozen=True)
class Annotations:
    """The labelled objects of one image, a row each; what is missing is unlabelled, never guessed.

    A line of `scenes.jsonl`, a rendered scene, a frame of a generated sequence: whoever trains or evaluates takes this
    (`nolbo_ppl.SceneBatch.from_annotations` makes the network's batch of several).

    Example:
        >>> import nolbo_ppl
        >>> seen = nolbo_ppl.Annotations.from_arrays(
        ...     intrinsics=[100, 100, 48, 48], box=[[10, 10, 60, 50], [70, 20, 76, 26]], category=["car", None])
        >>> len(seen), seen.labels(("bus", "car")), seen.counts()
        (2, array([ 1, -1]), array([ True, False]))
        >>> bool(np.isnan(seen.position).all())  # nobody knows where they are
        True
    """

    intrinsics: Float[np.ndarray, " 4"]
    """[fx, fy, cx, cy], px of the image."""
    box: Float[np.ndarray, "m 4"]
    """[x0, y0, x1, y1], px of the image, of the whole object, hidden parts included."""
    category: tuple[str | None, ...]
    """Name of each one's category, or None."""
    instance: tuple[str | None, ...]
    """Name of each one's shape, or None."""
    id: tuple[str | None, ...]
    """Name of the object itself, the same in every image of a sequence, or None."""
    R_camera_object: Float[np.ndarray, "m 3 3"]
    """Egocentric rotation."""
    position: Float[np.ndarray, "m 3"]
    """Centre of the object's box in the camera frame, m."""
    diagonal: Float[np.ndarray, " m"]
    """Diagonal of that box, m."""
    dimensions: Float[np.ndarray, "m 3"]
    """Side lengths of that box along the object's axes, m."""
    visibility: Float[np.ndarray, " m"]
    """Visible share, 1 where nobody says otherwise."""
    symmetry: Int[np.ndarray, " m"]
    """1 none, n n-fold, 0 free about the vertical axis."""
    ignore: Float[np.ndarray, "k 4"]
    """Boxes of parts of the image whose objects are not labelled: nothing is learnt of them, and what is found there is not
    judged."""
    exhaustive: tuple[str, ...] | None = None
    """Categories of which every instance is labelled; None for all of them."""
    confidence: Float[np.ndarray, " m"] | None = None
    """Probability that each object is there, of labels that a model gave; None: they are certain."""
    category_confidence: Float[np.ndarray, " m"] | None = None
    """Probability that each one's category is right; None: they are certain."""
    voxels: UInt8[np.ndarray, "m bytes"] | None = None
    """Canonical grids, packed bits in C order, all zero where one is unknown; None where nobody looked them up."""
    file: Path | None = None
    """The image's file."""
    pixels: UInt8[np.ndarray, "h w 3"] | None = None
    """The image itself, where it is at hand."""

    def __len__(self) -> int:
        return len(self.box)

    @property
    def image(self) -> UInt8[np.ndarray, "h w 3"]:
        """The image. Raises `InputError` when only its labels are at hand."""
        if self.pixels is None:
            raise input_error("labels without their image", got=self.file, do="read the image and give it as `pixels`")
        return self.pixels

    @property
    def side(self) -> Float[np.ndarray, " m"]:
        """Longer side of each box, px."""
        side: np.ndarray = np.max(self.box[:, 2:] - self.box[:, :2], axis=1, initial=0.0)
        return side

    def counts(self, min_side: float = MIN_SIDE, min_visibility: float = MIN_VISIBILITY) -> Bool[np.ndarray, " m"]:
        """Objects that are to be found: boxes with a side of at least so many px, and at least so much of the object seen."""
        return (self.side >= min_side) & (self.visibility >= min_visibility)

    def labels(self, categories: Sequence[str]) -> Int[np.ndarray, " m"]:
        """Number of each one's category among these names, -1 where it is missing or another."""
        number = {name: k for k, name in enumerate(categories)}
        return np.array([number.get(name, -1) if name is not None else -1 for name in self.category], dtype=np.int64)

    def select(self, rows: np.ndarray) -> Annotations:
        """The given objects (indices or a mask), in that order."""
        index = np.arange(len(self))[rows]
        chosen: dict[str, Any] = {name: getattr(self, name)[index] for name in ARRAYS}
        chosen |= {name: tuple(getattr(self, name)[i] for i in index) for name in ("category", "instance", "id")}
        for name in ("confidence", "category_confidence", "voxels"):
            value = getattr(self, name)
            chosen[name] = None if value is None else value[index]
        return replace(self, **chosen)

    @classmethod
    def from_arrays(
        cls,
        intrinsics: Any,
        box: Any,
        *,
        category: Sequence[str | None] | None = None,
        instance: Sequence[str | None] | None = None,
        id: Sequence[str | None] | None = None,
        R_camera_object: Any = None,
        position: Any = None,
        diagonal: Any = None,
        dimensions: Any = None,
        visibility: Any = None,
        symmetry: Any = None,
        ignore: Any = None,
        exhaustive: Sequence[str] | None = None,
        confidence: Any = None,
        category_confidence: Any = None,
        voxels: UInt8[np.ndarray, "m bytes"] | None = None,
        file: Path | None = None,
        pixels: UInt8[np.ndarray, "h w 3"] | None = None,
    ) -> Annotations:
        """Build it from whatever is known; lists may hold None for single objects of which something is not.

        Args:
            intrinsics: [fx, fy, cx, cy], px.
            box: [m, 4] px.
            category: [m] names.
            R_camera_object: [m, 3, 3].
            position: [m, 3] m.
            diagonal: [m] m; that of `dimensions` where these are given alone.
            dimensions: [m, 3] m.
            visibility: [m], 1 by default.
            symmetry: [m], 1 by default.
            ignore: [k, 4] px.
            confidence: [m] probabilities; where all are None or missing, labels are certain.
            category_confidence: the same of the categories.

        Raises:
            InputError: lengths do not match.
        """
        boxes = np.asarray(box, dtype=np.float64).reshape(-1, 4)
        m = len(boxes)

        def full(values: Any, shape: tuple[int, ...], name: str, default: float) -> np.ndarray:
            if values is None:
                return np.full((m, *shape), default)
            found = [np.full(shape, default) if value is None else np.asarray(value, dtype=np.float64) for value in values]
            if len(found) != m or any(value.shape != shape for value in found):
                raise input_error(f"{name} of labelled objects", got=[value.shape for value in found], expected=f"{m} of {shape}")
            return np.array(found).reshape(m, *shape)

        def names(values: Sequence[str | None] | None, name: str) -> tuple[str | None, ...]:
            found = (None,) * m if values is None else tuple(values)
            if len(found) != m:
                raise input_error(f"{name} of labelled objects", got=len(found), expected=m)
            return found

        def unsure(values: Any, name: str) -> np.ndarray | None:
            some = values is not None and any(value is not None for value in values)
            return full(values, (), name, 1.0) if some else None

        sides = full(dimensions, (3,), "dimensions", np.nan)
        diagonals = full(diagonal, (), "diagonal", np.nan)
        if voxels is not None and len(voxels) != m:
            raise input_error("voxels of labelled objects", got=len(voxels), expected=m)
        return cls(
            intrinsics=np.asarray(intrinsics, dtype=np.float64).reshape(4),
            box=boxes,
            category=names(category, "category"),
            instance=names(instance, "instance"),
            id=names(id, "id"),
            R_camera_object=full(R_camera_object, (3, 3), "R_camera_object", np.nan),
            position=full(position, (3,), "position", np.nan),
            diagonal=np.where(np.isnan(diagonals), np.linalg.norm(sides, axis=1), diagonals),
            dimensions=sides,
            visibility=full(visibility, (), "visibility", 1.0),
            symmetry=full(symmetry, (), "symmetry", 1.0).astype(np.int64),
            ignore=np.zeros((0, 4)) if ignore is None else np.asarray(ignore, dtype=np.float64).reshape(-1, 4),
            exhaustive=None if exhaustive is None else tuple(exhaustive),
            confidence=unsure(confidence, "confidence"),
            category_confidence=unsure(category_confidence, "category_confidence"),
            voxels=voxels,
            file=file,
            pixels=pixels,
        )


ARRAYS = ("box", "R_camera_object", "position", "diagonal", "dimensions", "visibility", "symmetry")
"""Fields with a row of numbers for each object."""
