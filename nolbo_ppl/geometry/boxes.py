"""Axis-aligned image boxes [x0, y0, x1, y1] in pixels: overlap and non-maximum suppression."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from nolbo_ppl.errors import input_error


def box_area(box: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch"]:
    """Area in square pixels; a reversed box has none."""
    return (box[..., 2] - box[..., 0]).clamp_min(0) * (box[..., 3] - box[..., 1]).clamp_min(0)


def box_iou(a: Float[Tensor, "*#batch 4"], b: Float[Tensor, "*#batch 4"]) -> Float[Tensor, "*batch"]:
    """Intersection over union of paired boxes (broadcast); two boxes without area have 0."""
    corner_min = torch.maximum(a[..., :2], b[..., :2])
    corner_max = torch.minimum(a[..., 2:], b[..., 2:])
    intersection = (corner_max - corner_min).clamp_min(0).prod(-1)
    union = box_area(a) + box_area(b) - intersection
    return torch.where(union > 0, intersection / union.clamp_min(torch.finfo(a.dtype).tiny), torch.zeros_like(union))


def pairwise_iou(a: Float[Tensor, "n 4"], b: Float[Tensor, "m 4"]) -> Float[Tensor, "n m"]:
    """Intersection over union of every box of `a` with every box of `b`."""
    return box_iou(a[:, None], b[None])


def nms(
    boxes: Float[Tensor, "n 4"],
    scores: Float[Tensor, " n"],
    iou_threshold: float = 0.5,
    group: Int[Tensor, " n"] | None = None,
) -> Int[Tensor, " kept"]:
    """Indices that greedy non-maximum suppression keeps, best score first.

    A box goes when it overlaps a kept box of a higher score, and of its own group where groups (images) are given, by
    more than `iou_threshold`.
    """
    return suppress(boxes, scores, iou_threshold, group)[0]


def suppress(
    boxes: Float[Tensor, "n 4"],
    scores: Float[Tensor, " n"],
    iou_threshold: float = 0.5,
    group: Int[Tensor, " n"] | None = None,
) -> tuple[Int[Tensor, " kept"], Int[Tensor, " n"]]:
    """What `nms` keeps, and for each box the kept one that stands for it (itself, or the one that removed it)."""
    order = torch.argsort(scores, descending=True, stable=True)
    iou = pairwise_iou(boxes[order], boxes[order])
    if group is not None:
        iou = torch.where(group[order][:, None] == group[order], iou, -1.0)
    overlaps = ~(iou <= iou_threshold).cpu().numpy()
    removed = np.zeros(len(order), dtype=np.bool_)
    kept: list[int] = []
    owner = np.arange(len(order))
    for i in range(len(order)):
        if not removed[i]:
            kept.append(i)
            owner[overlaps[i] & ~removed] = i
            owner[i] = i
            removed |= overlaps[i]
    stands_for = torch.empty_like(order)
    stands_for[order] = order[torch.from_numpy(owner).to(order.device)]
    return order[torch.tensor(kept, dtype=torch.long, device=order.device)], stands_for


MIN_SIDE = 1.0
"""Shortest side, px, of a box that says where in an image something is."""


def boxes_in_image(boxes: object, size: tuple[int, int], image: int = 0) -> Float[np.ndarray, "n 4"]:
    """Given boxes [x0, y0, x1, y1] in px, cut to the image.

    Args:
        boxes: an array or nested lists, n boxes of 4 numbers.
        size: width and height of the image, px.
        image: its number, for messages.

    Raises:
        InputError: no such array, corners that are not finite or not in order, a box outside of the image or less than a
            pixel wide; names image and box.

    Example:
        >>> boxes_in_image([[-5.0, 20.0, 30.0, 60.0]], (100, 50)).tolist()
        [[0.0, 20.0, 30.0, 50.0]]
    """
    try:
        found = np.asarray(boxes, dtype=np.float64)
    except (TypeError, ValueError):
        found = np.zeros((1, 1))
    found = found.reshape(-1, 4) if found.size == 0 else found
    if found.ndim != 2 or found.shape[1] != 4:
        raise input_error(f"boxes of image {image}", got=f"shape {np.shape(found)}", expected="n rows of x0 y0 x1 y1, px")
    width, height = size
    cut = np.clip(found, 0, [width, height, width, height])
    finite = np.isfinite(found).all(axis=1)
    ordered = finite & (found[:, 0] < found[:, 2]) & (found[:, 1] < found[:, 3])
    inside = ordered & (cut[:, 2] > cut[:, 0]) & (cut[:, 3] > cut[:, 1])
    wide = inside & (np.minimum(cut[:, 2] - cut[:, 0], cut[:, 3] - cut[:, 1]) >= MIN_SIDE)
    for good, expected, do in (
        (finite, "finite x0 y0 x1 y1", None),
        (ordered, "x0 < x1 and y0 < y1", "corners, not a corner with width and height"),
        (inside, f"a box that touches the image of {width} x {height} px", None),
        (wide, "at least a pixel each way", "boxes are in px, not in fractions of the image"),
    ):
        if not good.all():
            k = int(np.argmin(good))
            raise input_error(f"box {k} of image {image}", got=found[k].tolist(), expected=expected, do=do)
    return cut
