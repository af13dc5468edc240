"""Annotations of many images in columns, with a fixed number of object slots: what caches hold and batches are made of.

The names are those of `nolbo_ppl.models.scene_batch.SceneBatch`. A column of all images is one array, so that a cache maps it
from the disk and a batch is an index into it; `Annotations` of ragged lengths would be put together object by object each time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.rotation import egocentric_to_allocentric, matrix_to_viewpoint
from nolbo_ppl.structures.annotations import Annotations

SLOTS = 8
"""Default number of object slots an image."""

Arrays = dict[str, np.ndarray]
CERTAINTY = ("confidence", "category_confidence")
"""Probabilities that labels of a model are right; loaders draw from them (`nolbo_ppl.training.scene_loader.drawn_labels`)."""

_LAYOUT: dict[str, tuple[tuple[int, ...], type, float]] = {
    "present": ((), np.bool_, 0),
    "box": ((4,), np.float32, 0),
    "category": ((), np.int64, -1),
    "instance": ((), np.int64, -1),
    "rotation": ((3, 3), np.float32, 0),
    "has_viewpoint": ((), np.bool_, 0),
    "symmetry": ((), np.int64, 1),
    "position": ((3,), np.float32, 0),
    "has_position": ((), np.bool_, 0),
    "diagonal": ((), np.float32, 1),
    "has_size": ((), np.bool_, 0),
    "visibility": ((), np.float32, 1),
}
"""Shape of a slot, type and filling of each label; an empty slot holds the filling."""


def empty_labels(scenes: int, slots: int = SLOTS) -> Arrays:
    """Label arrays [scenes, slots, ...] of scenes without objects, and `intrinsics` [scenes, 4]."""
    arrays: Arrays = {
        name: np.full((scenes, slots, *shape), filling, dtype=dtype) for name, (shape, dtype, filling) in _LAYOUT.items()
    }
    arrays["intrinsics"] = np.zeros((scenes, 4), dtype=np.float32)
    return arrays


def fill_annotations(
    arrays: Arrays,
    row: int,
    scene: Annotations,
    categories: Sequence[str] = CATEGORIES,
    instance: Sequence[int] | None = None,
    placing: tuple[float, float, float] = (1.0, 0.0, 0.0),
) -> None:
    """Write the labels of one image into one row.

    Args:
        arrays: from `empty_labels`; changed.
        row: which.
        scene: the labels.
        categories: names that are numbered; others are unlabelled.
        instance: number of each object's shape; -1, unlabelled, by default.
        placing: scale, and shift along x and y in px, that bring the image into that of the batch.

    Raises:
        InputError: more objects than slots.
    """
    slots = arrays["present"].shape[1]
    if len(scene) > slots:
        raise input_error("more objects than slots", got=len(scene), expected=f"at most {slots}")
    scale, shift = placing[0], np.array(placing[1:])
    arrays["intrinsics"][row] = scene.intrinsics * scale
    arrays["intrinsics"][row, 2:] += shift
    at = (row, slice(len(scene)))
    arrays["present"][at] = True
    arrays["box"][at] = scene.box * scale + np.tile(shift, 2)
    arrays["visibility"][at], arrays["symmetry"][at] = scene.visibility, scene.symmetry
    arrays["category"][at] = scene.labels(categories)
    if instance is not None:
        arrays["instance"][at] = instance
    for name, mask, values in (
        ("rotation", "has_viewpoint", scene.R_camera_object),
        ("position", "has_position", scene.position),
        ("diagonal", "has_size", scene.diagonal),
    ):
        known = np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
        arrays[name][row, : len(scene)][known], arrays[mask][at] = values[known], known


def fill_regions(
    arrays: Arrays, scenes: Sequence[Annotations], categories: Sequence[str], placings: Sequence[tuple[float, float, float]]
) -> None:
    """Add `ignore` and `exhaustive`, what is not labelled, and how certain labels are, where any of the images says so."""
    if any(len(scene.ignore) for scene in scenes):
        arrays["ignore"] = np.zeros((len(scenes), max(len(scene.ignore) for scene in scenes), 4), dtype=np.float32)
        for row, (scene, (scale, left, top)) in enumerate(zip(scenes, placings)):
            arrays["ignore"][row, : len(scene.ignore)] = scene.ignore * scale + np.array([left, top, left, top])
    if any(scene.exhaustive is not None for scene in scenes):
        arrays["exhaustive"] = np.array(
            [[scene.exhaustive is None or name in scene.exhaustive for name in categories] for scene in scenes]
        )
    for field in CERTAINTY:
        if any(getattr(scene, field) is not None for scene in scenes):
            arrays[field] = np.ones(arrays["present"].shape, dtype=np.float32)
            for row, scene in enumerate(scenes):
                value = getattr(scene, field)
                if value is not None:
                    arrays[field][row, : len(value)] = value


def allocentric_viewpoints(arrays: Arrays) -> Float[np.ndarray, "scenes slots 3"]:
    """Allocentric viewpoint (azimuth, elevation, in-plane) of every slot in radians; zero without a rotation.

    The viewing ray goes through the box centre of the object where its position is known, else through the middle of
    its image box.
    """
    has = arrays["has_viewpoint"]
    viewpoint = np.zeros((*has.shape, 3), dtype=np.float32)
    row, slot = np.nonzero(has)
    if len(row):
        fx, fy, cx, cy = arrays["intrinsics"][row].astype(np.float64).T
        x0, y0, x1, y1 = arrays["box"][row, slot].astype(np.float64).T
        through_box = np.stack((((x0 + x1) / 2 - cx) / fx, ((y0 + y1) / 2 - cy) / fy, np.ones_like(fx)), axis=-1)
        known = arrays["has_position"][row, slot][:, None]
        ray = np.where(known, arrays["position"][row, slot].astype(np.float64), through_box)
        R = torch.from_numpy(arrays["rotation"][row, slot].astype(np.float64))
        allocentric = egocentric_to_allocentric(R, torch.from_numpy(ray))
        viewpoint[row, slot] = matrix_to_viewpoint(allocentric).numpy()
    return viewpoint


def assemble(
    images: np.ndarray,
    labels: Arrays,
    voxels: np.ndarray,
    has_voxels: Bool[np.ndarray, "scenes slots"],
) -> Arrays:
    """The fields of `nolbo_ppl.models.scene_batch.SceneBatch` as arrays, and `CERTAINTY`; `labels` includes `viewpoint`."""
    batch = {name: labels[name] for name in ("intrinsics", "viewpoint", *_LAYOUT) if name != "rotation"}
    batch |= {name: labels[name] for name in ("ignore", "exhaustive", *CERTAINTY) if name in labels}
    return {"image": images, **batch, "voxels": voxels, "has_voxels": has_voxels}
