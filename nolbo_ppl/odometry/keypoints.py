"""Features of an image and their matches between two: ORB or SIFT, ratio test, mutual best."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt8

from nolbo_ppl.errors import input_error
from nolbo_ppl.odometry.odometry_config import OdometryConfig

EDGE = 16
"""ORB looks at no corner nearer to the border, px: half of its patch."""
PATCH = 31
"""Side of ORB's patch, px."""


@dataclass(frozen=True)
class Features:
    """Corners of one image."""

    pixels: Float[np.ndarray, "n 2"]
    """Continuous image coordinates; the centre of the first pixel is at (0.5, 0.5)."""
    descriptors: Shaped[np.ndarray, "n d"]
    """Bits in bytes (ORB) or gradients (SIFT)."""

    def __len__(self) -> int:
        return len(self.pixels)


def grey(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w"]:
    """Grey values of an RGB image. Raises `InputError` for anything else."""
    image = np.asarray(image)
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise input_error("not an image", got=f"{image.dtype} {image.shape}", expected="uint8 [h, w, 3], RGB")
    return cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)


def spread(pixels: Float[np.ndarray, "n 2"], strength: Float[np.ndarray, " n"], cell: int, limit: int) -> Int[np.ndarray, " k"]:
    """Rows of the strongest corners of every cell, `limit` in all: rank in the cell first, then strength.

    Corners crowd where contrast is high; a pose wants them all over the image, the ground above all.
    """
    key = (pixels[:, 1] // cell).astype(np.int64) * 100_000 + (pixels[:, 0] // cell).astype(np.int64)
    order = np.lexsort((np.arange(len(pixels)), -strength, key))
    _, start, count = np.unique(key[order], return_index=True, return_counts=True)
    rank = np.empty(len(pixels), dtype=np.int64)
    rank[order] = np.arange(len(pixels)) - np.repeat(start, count)
    return np.sort(np.lexsort((-strength, rank))[:limit])


def detect(picture: UInt8[np.ndarray, "h w"], config: OdometryConfig) -> Features:
    """Features of a grey image, spread over it."""
    if config.detector == "sift":
        extractor: cv2.Feature2D = cv2.SIFT.create(nfeatures=0, contrastThreshold=0.01, edgeThreshold=12.0, sigma=1.2)
    else:
        extractor = cv2.ORB.create(
            4 * config.features,
            config.level_factor,
            config.levels,
            EDGE,
            0,
            2,
            cv2.ORB_HARRIS_SCORE,
            PATCH,
            config.fast_threshold,
        )
    points = extractor.detect(picture, None)
    if not points:
        return Features(np.zeros((0, 2)), np.zeros((0, 32), dtype=np.uint8))
    pixels = np.array([point.pt for point in points]) + 0.5  # OpenCV has the first pixel's centre at (0, 0)
    keep = spread(pixels, np.array([point.response for point in points]), config.cell, config.features)
    points, descriptors = extractor.compute(picture, [points[row] for row in keep])
    if descriptors is None:
        return Features(np.zeros((0, 2)), np.zeros((0, 32), dtype=np.uint8))
    return Features(np.array([point.pt for point in points], dtype=np.float64) + 0.5, descriptors)


def match(first: Features, second: Features, ratio: float, largest: float) -> Int[np.ndarray, "m 2"]:
    """Rows of matching features: mutually best, and much nearer than the second best (Lowe 2004, section 7.1).

    Args:
        first: features of one image.
        second: features of the other.
        ratio: a match is at most this part of the distance of the second best.
        largest: longest shift of a match, px.
    """
    if len(first) < 2 or len(second) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING if first.descriptors.dtype == np.uint8 else cv2.NORM_L2)
    forward = matcher.knnMatch(first.descriptors, second.descriptors, k=2)
    back = np.full(len(second), -1, dtype=np.int64)
    for found in matcher.match(second.descriptors, first.descriptors):
        back[found.queryIdx] = found.trainIdx
    rows = np.array(
        [(best.queryIdx, best.trainIdx) for best, other in forward if best.distance <= ratio * other.distance],
        dtype=np.int64,
    ).reshape(-1, 2)
    rows = rows[back[rows[:, 1]] == rows[:, 0]]
    shift = np.linalg.norm(first.pixels[rows[:, 0]] - second.pixels[rows[:, 1]], axis=1)
    return rows[shift <= largest]


def track(
    before: UInt8[np.ndarray, "h w"],
    after: UInt8[np.ndarray, "h w"],
    first: Float[np.ndarray, "m 2"],
    second: Float[np.ndarray, "m 2"],
    window: int,
    largest: float,
) -> tuple[Float[np.ndarray, "m 2"], Bool[np.ndarray, " m"]]:
    """Where the surroundings of each earlier corner are found in the later image, starting at its match.

    A corner of FAST is a whole pixel of a level of the pyramid, found anew in every image; registering the patches
    (Lucas and Kanade 1981) makes the error of a step several times smaller.

    Args:
        before: earlier image, grey.
        after: later one.
        first: corners in the earlier image, px.
        second: their matches in the later one, px.
        window: side of a patch, px.
        largest: a match that moves further than this is none, px.

    Returns:
        The matches, moved, and which of them stayed near where they were.
    """
    if not len(first):
        return second, np.zeros(0, dtype=bool)
    start = np.ascontiguousarray(first - 0.5, dtype=np.float32)[:, None]
    end = np.ascontiguousarray(second - 0.5, dtype=np.float32)[:, None]
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 15, 0.01)
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        before,
        after,
        start,
        end.copy(),
        winSize=(window, window),
        maxLevel=0,
        criteria=criteria,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    moved = moved[:, 0].astype(np.float64) + 0.5
    return moved, (status[:, 0] > 0) & (np.linalg.norm(moved - second, axis=1) < largest)
