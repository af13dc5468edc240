"""Masks: run lengths against an encoder written the slow way, polygons against pixels counted one by one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.masks import decode_counts, decode_run_lengths, mask_moments, moments_of_pixels, moments_of_polygons


def run_lengths(mask: np.ndarray) -> list[int]:
    """Pixel by pixel, column by column, starting with background."""
    counts, current, value = [], 0, False
    for x in range(mask.shape[1]):
        for y in range(mask.shape[0]):
            if bool(mask[y, x]) != value:
                counts.append(current)
                current, value = 0, not value
            current += 1
    return [*counts, current]


def compressed(counts: list[int]) -> str:
    """Groups of five bits of the differences, low ones first, until what is left is the sign alone."""
    text = ""
    for i, count in enumerate(counts):
        x = count - counts[i - 2] if i > 2 else count
        while True:
            group, x = x & 31, x >> 5
            more = x != (-1 if group & 16 else 0)
            text += chr(48 + group + (32 if more else 0))
            if not more:
                break
    return text


@pytest.mark.parametrize("seed", range(6))
def test_run_lengths_are_decoded(seed: int) -> None:
    rng = np.random.default_rng(seed)
    height, width = int(rng.integers(1, 60)), int(rng.integers(1, 90))
    mask = rng.uniform(size=(height, width)) < rng.choice([0.02, 0.5, 0.98])
    if seed == 5:
        mask[:] = False
        mask[height // 3 : height // 2 + 1, width // 4 : width // 2 + 1] = True  # long runs, large differences
    counts = run_lengths(mask)
    for stated in (counts, compressed(counts)):
        np.testing.assert_array_equal(decode_run_lengths({"size": [height, width], "counts": stated}), mask)


def test_numbers_of_several_groups() -> None:
    counts = [0, 1, 15, 16, 31, 32, 1000, 3, 70000, 1, 5, 1 << 20]
    assert decode_counts(compressed(counts)).tolist() == counts


def test_moments_of_pixels_are_their_means() -> None:
    mask = np.random.default_rng(0).uniform(size=(40, 50)) < 0.1
    y, x = np.nonzero(mask)
    found = moments_of_pixels(mask)
    assert found is not None and found.area == len(x)
    np.testing.assert_allclose(found.centre, [np.mean(x + 0.5), np.mean(y + 0.5)])
    assert found.box.tolist() == [x.min(), y.min(), x.max() + 1, y.max() + 1]
    assert moments_of_pixels(np.zeros((3, 3), bool)) is None


def test_polygons_hold_the_pixels_within_them() -> None:
    """A star that is not convex, either way round: the share and the mean of a fine grid's points inside it."""
    angle = np.linspace(0, 2 * np.pi, 14, endpoint=False)
    radius = np.where(np.arange(14) % 2, 12.0, 30.0)
    points = np.column_stack([50 + radius * np.cos(angle), 40 + 0.7 * radius * np.sin(angle) + 0.3 * radius * np.cos(angle)])
    grid = np.stack(np.meshgrid(np.arange(0, 100, 0.1) + 0.05, np.arange(0, 80, 0.1) + 0.05), axis=-1).reshape(-1, 2)
    inside = np.zeros(len(grid), bool)
    for a, b in zip(points, np.roll(points, -1, axis=0)):  # crossings of a ray to the right
        crosses = (a[1] > grid[:, 1]) != (b[1] > grid[:, 1])
        with np.errstate(divide="ignore", invalid="ignore"):
            x = a[0] + (grid[:, 1] - a[1]) * (b[0] - a[0]) / (b[1] - a[1])
        inside ^= crosses & (grid[:, 0] < x)
    for order in (points, points[::-1]):
        found = moments_of_polygons([order.ravel().tolist()])
        assert found is not None
        assert found.area == pytest.approx(0.01 * inside.sum(), rel=2e-3)
        np.testing.assert_allclose(found.centre, grid[inside].mean(axis=0), atol=0.02)


@pytest.mark.parametrize(
    ("mask", "match"),
    [
        ({"size": [2, 2], "counts": [1, 2]}, "got 3 pixels, expected 2 x 2 = 4 pixels"),
        ({"size": [2, 2], "counts": [5, -1]}, "a negative run"),
        ({"size": [10**6, 10**6], "counts": [10**12]}, "size of a mask"),
        ({"size": [2, 2], "counts": "\u00e9"}, "compressed string"),
        ({"size": [2, 2], "counts": "P"}, "compressed string"),
        ({"size": [2, 2], "counts": "\ud800"}, "compressed string"),
        ({"size": [2, 2], "counts": "o" * 11 + "?" + ("o" * 11 + "?") * 20}, "runs of at most"),
        ({"size": [2, 2], "counts": "P" * 20 + "0"}, "runs of at most"),
        ({"size": [2, 2]}, "counts of a mask: got None"),
        ([[1, 2, 3, 4]], "three points or more"),
        ([[1, 2, 3, 4, 5, "6"]], "three points or more"),
        ("mask", "polygons"),
    ],
)
def test_damage_is_named(mask: object, match: str) -> None:
    with pytest.raises(InputError, match=match):
        mask_moments(mask)


def test_masks_of_coco_agree_with_its_own_areas(data_dir: Path) -> None:
    """Areas that COCO states, and its boxes, of every object of a real file."""
    rows = json.loads((data_dir / "annotations" / "coco" / "instances_val2017.json").read_text())["annotations"]
    for row in rows:
        found, (x, y, w, h) = mask_moments(row["segmentation"]), row["bbox"]
        assert found is not None
        if row["iscrowd"]:  # run lengths; the stated area counts people before one another twice, the box lacks a pixel
            assert found.area <= 1.01 * row["area"]
        else:
            assert found.area == pytest.approx(row["area"], rel=0.01, abs=1)
        np.testing.assert_allclose(found.box, [x, y, x + w, y + h], atol=1.01 if row["iscrowd"] else 0.02)
