"""Overlap of boxes against counted pixels, suppression against a naive implementation."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.boxes import box_area, box_iou, boxes_in_image, nms, pairwise_iou


def random_boxes(count: int, seed: int, side: int = 24) -> torch.Tensor:
    """Boxes with integer corners inside a side x side image."""
    generator = torch.Generator().manual_seed(seed)
    a = torch.randint(0, side, (count, 2), generator=generator)
    b = torch.randint(0, side, (count, 2), generator=generator)
    return torch.cat((torch.minimum(a, b), torch.maximum(a, b)), -1).double()


def painted(box: torch.Tensor, side: int = 24) -> torch.Tensor:
    """The pixels of a box with integer corners."""
    image = torch.zeros(side, side, dtype=torch.bool)
    x0, y0, x1, y1 = (int(v) for v in box)
    image[y0:y1, x0:x1] = True
    return image


def test_iou_against_counted_pixels() -> None:
    a, b = random_boxes(40, 0), random_boxes(30, 1)
    expected = torch.zeros(40, 30)
    for i, one in enumerate(a):
        for j, other in enumerate(b):
            p, q = painted(one), painted(other)
            union = int((p | q).sum())
            expected[i, j] = int((p & q).sum()) / union if union else 0.0
    torch.testing.assert_close(pairwise_iou(a, b), expected)
    torch.testing.assert_close(box_iou(a[:30], b), expected[:30].diagonal())
    torch.testing.assert_close(box_area(a), torch.stack([painted(x).sum() for x in a]).double())
    assert bool((expected > 0.3).any()), "some boxes overlap"


def test_boxes_without_area() -> None:
    point = torch.tensor([3.0, 3.0, 3.0, 3.0])
    reversed_ = torch.tensor([9.0, 9.0, 1.0, 1.0])
    real = torch.tensor([0.0, 0.0, 10.0, 10.0])
    assert float(box_iou(point, point)) == 0
    assert float(box_iou(reversed_, reversed_)) == 0
    assert float(box_iou(reversed_, real)) == 0
    assert float(box_iou(real, real)) == 1


def naive_nms(boxes: torch.Tensor, scores: torch.Tensor, threshold: float) -> list[int]:
    """Take the best, throw out what overlaps it, repeat."""
    left = sorted(range(len(boxes)), key=lambda i: -float(scores[i]))
    kept = []
    while left:
        best, *left = left
        kept.append(best)
        left = [i for i in left if float(box_iou(boxes[best], boxes[i])) <= threshold]
    return kept


@pytest.mark.parametrize("threshold", [0.0, 0.2, 0.5, 0.9])
def test_nms_against_naive(threshold: float) -> None:
    generator = torch.Generator().manual_seed(2)
    for seed in range(5):
        boxes, scores = random_boxes(40, seed + 10, 16), torch.rand(40, generator=generator)
        kept = nms(boxes, scores, threshold).tolist()
        assert kept == naive_nms(boxes, scores, threshold)
        assert threshold == 0.9 or len(kept) < 40


def test_nms_keeps_groups_apart() -> None:
    """Boxes of different images never suppress each other, however large they are."""
    generator = torch.Generator().manual_seed(3)
    boxes, scores = random_boxes(60, 4) * 1e4, torch.rand(60, generator=generator)
    group = torch.randint(0, 3, (60,), generator=generator)
    kept = nms(boxes, scores, 0.3, group)
    assert bool((scores[kept].diff() <= 0).all())
    for one in range(3):
        index = (group == one).nonzero().squeeze(-1)
        alone = index[nms(boxes[index], scores[index], 0.3)]
        assert kept[group[kept] == one].tolist() == alone.tolist()


def test_nms_of_nothing() -> None:
    assert nms(torch.zeros(0, 4), torch.zeros(0)).tolist() == []


@pytest.mark.parametrize(
    ("box", "expected"),
    [
        ([np.nan, 0, 10, 10], "finite x0 y0 x1 y1"),
        ([0, 0, np.inf, 10], "finite x0 y0 x1 y1"),
        ([89, 131, 0, 55], "x0 < x1 and y0 < y1; corners"),
        ([191, 69, 68, 25], "x0 < x1 and y0 < y1; corners"),
        ([50, 50, 50, 80], "x0 < x1 and y0 < y1"),
        ([500, 50, 600, 90], "touches the image of 384 x 192 px"),
        ([0, 0.3, 0.25, 0.7], "at least a pixel each way; boxes are in px"),
    ],
)
def test_given_boxes_are_checked(box: list[float], expected: str) -> None:
    with pytest.raises(InputError, match=f"box 1 of image 3: got .*expected .*{expected}"):
        boxes_in_image([[0, 0, 10, 10], box], (384, 192), 3)


def test_given_boxes_are_cut_to_the_image() -> None:
    np.testing.assert_array_equal(boxes_in_image([[-9, 10, 400, 60.5]], (384, 192)), [[0, 10, 384, 60.5]])
    assert boxes_in_image([], (384, 192)).shape == (0, 4)
    for wrong in ([1, 2, 3], [[1, 2, 3]], "box", [[1, 2], [3]]):
        with pytest.raises(InputError, match="boxes of image 0"):
            boxes_in_image(wrong, (384, 192))
