"""Axis-aligned image boxes [x0, y0, x1, y1] in pixels: overlap and non-maximum suppression."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor


def box_area(box: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch"]:
    """Area in square pixels; a reversed box has none."""
    return (box[..., 2] - box[..., 0]).clamp_min(0) * (box[..., 3] - box[..., 1]).clamp_min(0)


def box_iou(a: Float[Tensor, "*batch 4"], b: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch"]:
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
    overlaps = ~(iou <= iou_threshold).numpy()
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
    stands_for[order] = order[torch.from_numpy(owner)]
    return order[torch.tensor(kept, dtype=torch.long)], stands_for
