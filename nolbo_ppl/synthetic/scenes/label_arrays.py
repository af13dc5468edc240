"""Labels of scenes as arrays with a fixed number of object slots: what caches hold and what batches are made of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.rotation import egocentric_to_allocentric, matrix_to_viewpoint
from nolbo_ppl.synthetic.scenes.render_scene import Rendered

SLOTS = 8
"""Default number of object slots an image."""

Arrays = dict[str, np.ndarray]

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


def fill_rendered(arrays: Arrays, row: int, rendered: Rendered, categories: Sequence[str] = CATEGORIES) -> None:
    """Write the labels of a rendered scene into one row."""
    slots = arrays["present"].shape[1]
    if len(rendered.labels) > slots:
        raise input_error("more objects than slots", got=len(rendered.labels), expected=f"at most {slots}")
    arrays["intrinsics"][row] = rendered.intrinsics
    for slot, label in enumerate(rendered.labels):
        at = (row, slot)
        arrays["present"][at] = arrays["has_viewpoint"][at] = True
        arrays["has_position"][at] = arrays["has_size"][at] = True
        arrays["box"][at] = label.box
        arrays["category"][at] = categories.index(label.category)
        arrays["instance"][at] = label.item.number
        arrays["rotation"][at] = label.R_camera_object
        arrays["symmetry"][at] = label.symmetry
        arrays["position"][at] = label.position
        arrays["diagonal"][at] = label.size
        arrays["visibility"][at] = label.visibility


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
    """The fields of `nolbo_ppl.inference.batch.SceneBatch` as arrays; `labels` includes `viewpoint`."""
    batch = {name: labels[name] for name in ("intrinsics", "viewpoint", *_LAYOUT) if name != "rotation"}
    batch |= {name: labels[name] for name in ("ignore", "exhaustive") if name in labels}
    return {"image": images, **batch, "voxels": voxels, "has_voxels": has_voxels}
