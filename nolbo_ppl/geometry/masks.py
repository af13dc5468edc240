"""Masks of objects in images: polygons and COCO's run lengths, their boxes and centres of mass."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from nolbo_ppl.errors import input_error

MAXIMUM_PIXELS = 1 << 26
"""Pixels of a mask above which it is refused: a few numbers may stand for gigabytes."""
MOST_VERTICES = 1_000_000
"""Vertices of a polygon above which it is refused."""


@dataclass(frozen=True)
class MaskMoments:
    """What a mask says of where its object is; the centre of the first pixel is at (0.5, 0.5)."""

    area: float
    """Pixels."""
    centre: Float[np.ndarray, " 2"]
    """Centre of mass, px."""
    box: Float[np.ndarray, " 4"]
    """x0 y0 x1 y1, px."""


def decode_counts(text: str) -> Int[np.ndarray, " r"]:
    """Lengths of the runs of COCO's compressed string.

    Each number stands in characters of six bits from `0` on, five of them the number's, low ones first, the sixth says that
    more follow; from the fourth run on, the difference from the run two before it is written.

    Raises:
        InputError: characters of another kind, a string that ends within a number, or a run longer than a mask may be.

    Example:
        >>> decode_counts("04").tolist(), decode_counts("T14").tolist()
        ([0, 4], [36, 4])
    """
    codes = np.frombuffer(text.encode(errors="surrogatepass"), dtype=np.uint8).astype(np.int64) - 48
    if len(codes) and (codes.min() < 0 or codes.max() > 63 or codes[-1] & 32):
        raise input_error("run lengths of a mask", got=repr(text[:40]), expected="COCO's compressed string")
    beyond = input_error("run lengths of a mask", got=repr(text[:40]), expected=f"runs of at most {MAXIMUM_PIXELS} pixels")
    counts: list[int] = []
    value, shift = 0, 0
    for code in codes.tolist():
        value |= (code & 31) << shift
        shift += 5
        if code & 32:
            if shift > 60:
                raise beyond
            continue
        if code & 16:
            value -= 1 << shift  # two's complement
        if len(counts) > 2:
            value += counts[-2]
        if abs(value) > MAXIMUM_PIXELS:  # sums of longer runs leave 64 bits
            raise beyond
        counts.append(value)
        value, shift = 0, 0
    return np.array(counts, dtype=np.int64)


def decode_run_lengths(mask: Mapping[str, Any]) -> Bool[np.ndarray, "h w"]:
    """Pixels of COCO's `{"size": [h, w], "counts": ...}`, a list of run lengths or a compressed string; columns come first.

    Raises:
        InputError: counts that do not fill the size, negative ones, a size out of range.

    Example:
        >>> decode_run_lengths({"size": [2, 3], "counts": [1, 2, 3]}).astype(int).tolist()
        [[0, 1, 0], [1, 0, 0]]
    """
    size, counts = mask.get("size"), mask.get("counts")
    whole = isinstance(size, list | tuple) and len(size) == 2 and all(type(v) is int and v > 0 for v in size)
    if not whole or size[0] * size[1] > MAXIMUM_PIXELS:  # type: ignore[index]
        raise input_error("size of a mask", got=size, expected=f"[height, width], at most {MAXIMUM_PIXELS} pixels")
    height, width = size  # type: ignore[misc]
    if isinstance(counts, str):
        runs = decode_counts(counts)
    elif isinstance(counts, list) and all(type(v) is int for v in counts):
        runs = np.array(counts, dtype=np.int64) if all(0 <= v <= MAXIMUM_PIXELS for v in counts) else np.array([-1])
    else:
        raise input_error("counts of a mask", got=repr(counts)[:60], expected="whole numbers, or a compressed string")
    if (len(runs) and runs.min() < 0) or runs.sum() != height * width:
        got = f"{int(runs.sum())} pixels" if not len(runs) or runs.min() >= 0 else "a negative run"
        raise input_error("run lengths of a mask", got=got, expected=f"{height} x {width} = {height * width} pixels")
    return np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(width, height).T


def moments_of_pixels(mask: Bool[np.ndarray, "h w"]) -> MaskMoments | None:
    """Area, centre and box of a mask of pixels; None of an empty one."""
    rows, columns = mask.sum(axis=1), mask.sum(axis=0)
    area = int(rows.sum())
    if not area:
        return None
    y, x = np.flatnonzero(rows), np.flatnonzero(columns)
    centre = np.array([columns @ (np.arange(mask.shape[1]) + 0.5), rows @ (np.arange(mask.shape[0]) + 0.5)]) / area
    return MaskMoments(float(area), centre, np.array([x[0], y[0], x[-1] + 1, y[-1] + 1], dtype=np.float64))


def _polygon(values: Any) -> Float[np.ndarray, "v 2"]:
    flat = isinstance(values, list | tuple) and 6 <= len(values) <= 2 * MOST_VERTICES and len(values) % 2 == 0
    if not flat or not all(isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < 1e6 for v in values):
        raise input_error(
            "polygon of a mask", got=repr(values)[:60], expected="[x, y, x, y, x, y, ...] in px, three points or more"
        )
    return np.array(values, dtype=np.float64).reshape(-1, 2)


def moments_of_polygons(polygons: Sequence[Sequence[float]]) -> MaskMoments | None:
    """Area, centre and box of an object of one or more polygons that do not overlap, as COCO has them; None without an area.

    Green's theorem: the area is half the sum of cross products of successive vertices, the centre that of their triangles with
    the origin.

    Raises:
        InputError: a polygon of fewer than three points, or of anything but numbers.

    Example:
        >>> found = moments_of_polygons([[0, 0, 4, 0, 4, 2, 0, 2], [10, 0, 12, 0, 12, 2, 10, 2]])
        >>> found.area, found.centre.tolist(), found.box.tolist()
        (12.0, [5.0, 1.0], [0.0, 0.0, 12.0, 2.0])
    """
    shapes = [_polygon(values) for values in polygons]
    area, moment = 0.0, np.zeros(2)
    for points in shapes:
        middle = points.mean(axis=0)  # near the origin cross products keep their digits
        a, b = points - middle, np.roll(points, -1, axis=0) - middle
        cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        signed = 0.5 * cross.sum()
        turn = np.sign(signed)
        area += turn * signed
        moment += turn * ((a + b).T @ cross / 6 + signed * middle)
    if not shapes or not area > 0:
        return None
    points = np.concatenate(shapes)
    return MaskMoments(float(area), moment / area, np.concatenate([points.min(axis=0), points.max(axis=0)]))


def mask_moments(mask: Any) -> MaskMoments | None:
    """Area, centre and box of a mask as COCO writes it: a list of polygons, or run lengths; None of an empty one.

    Raises:
        InputError: neither, or malformed.
    """
    if isinstance(mask, Mapping):
        return moments_of_pixels(decode_run_lengths(mask))
    if isinstance(mask, list):
        return moments_of_polygons([mask] if mask and not isinstance(mask[0], list) else mask)
    raise input_error("mask", got=repr(mask)[:60], expected='polygons [[x, y, ...], ...], or {"size": [h, w], "counts": ...}')
