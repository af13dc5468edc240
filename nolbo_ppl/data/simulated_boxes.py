"""Simulated detections of a detector that gives 2D boxes alone, with everything that real ones get wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.data.converters.foreign_detections import ForeignDetections
from nolbo_ppl.data.simulate import SimulatedWorld
from nolbo_ppl.geometry.pose import inverse, transform


@dataclass(frozen=True)
class BoxDetectorConfig:
    """What a detector of boxes sees of a world."""

    intrinsics: tuple[float, float, float, float] = (320.0, 320.0, 320.0, 240.0)
    """fx fy cx cy, px."""
    size: tuple[int, int] = (640, 480)
    """Width and height of the images, px."""
    maximum_range: float = 30.0
    """m."""
    heights: tuple[float, float] = (0.6, 2.0)
    """Least and largest height of a category, m."""
    height_spread: float = 0.1
    """Relative standard deviation of an object's height about its category's."""
    jitter: float = 0.04
    """Standard deviation of a box's centre, in parts of the box, from frame to frame."""
    bias: float = 0.03
    """The same of one object's, all along: the box's centre is not the object's."""
    edges: float = 0.04
    """Standard deviation of the log of a box's width and height."""
    miss_rate: float = 0.15
    """Probability that a visible object is not detected."""
    clutter_rate: float = 0.3
    """Mean number of boxes of nothing in a frame."""
    gross_rate: float = 0.03
    """Share of boxes that lie anywhere within their own size of the object."""
    wrong_category: float = 0.03
    """Share of categories that are wrong."""


@dataclass(frozen=True)
class SimulatedBoxes:
    """Boxes and their truth."""

    detections: ForeignDetections
    """What the detector gives."""
    object_of: Int[np.ndarray, " k"]
    """True object of each, -1 for clutter."""
    heights: dict[str, tuple[float, float]]
    """Height and standard deviation by category, m."""


def simulate_boxes(
    truth: Float[np.ndarray, "n 4 4"], world: SimulatedWorld, config: BoxDetectorConfig, rng: np.random.Generator
) -> SimulatedBoxes:
    """Boxes of every frame in order.

    Args:
        truth: true poses.
        world: objects, and their categories.
        config: the detector.
        rng: draws everything.
    """
    categories = int(world.category.max(initial=0)) + 1
    mean = rng.uniform(*config.heights, categories)
    tall = mean[world.category] * np.exp(config.height_spread * rng.standard_normal(len(world.category)))
    wide = tall * rng.uniform(0.5, 1.5, categories)[world.category]
    bias = config.bias * rng.standard_normal((len(tall), 2))
    focal, middle = np.array(config.intrinsics[:2]), np.array(config.intrinsics[2:])
    limit = np.array(config.size, dtype=np.float64)
    frames, boxes, kinds, sources, scores = [], [], [], [], []
    for t, pose in enumerate(truth):
        local = transform(inverse(pose), world.position)
        z = np.where(local[:, 2] > 0.5, local[:, 2], np.nan)
        extent = np.column_stack([wide, tall]) / z[:, None] * focal
        centre = local[:, :2] / z[:, None] * focal + middle
        seen = (centre - extent / 2 > 0).all(axis=1) & (centre + extent / 2 < limit).all(axis=1)
        seen &= (z < config.maximum_range) & (extent.min(axis=1) > 6) & (rng.uniform(size=len(z)) >= config.miss_rate)
        rows = np.flatnonzero(seen)
        gross = rng.uniform(size=(len(rows), 1)) < config.gross_rate
        offset = bias[rows] + config.jitter * rng.standard_normal((len(rows), 2))
        offset = np.where(gross, rng.uniform(-1, 1, (len(rows), 2)), offset)
        size = extent[rows] * np.exp(config.edges * rng.standard_normal((len(rows), 2)))
        at = centre[rows] + offset * extent[rows]
        wrong = rng.uniform(size=len(rows)) < config.wrong_category
        kind = np.where(wrong, rng.integers(0, categories, len(rows)), world.category[rows])
        count = rng.poisson(config.clutter_rate)
        false_size = rng.uniform(10, 80, (count, 2))
        false_at = rng.uniform(false_size / 2, limit - false_size / 2)
        at, size = np.concatenate([at, false_at]), np.concatenate([size, false_size])
        frames += [t] * len(at)
        boxes.append(np.concatenate([at - size / 2, at + size / 2], axis=1))
        kinds += [*kind.tolist(), *rng.integers(0, categories, count).tolist()]
        sources += [*rows.tolist(), *[-1] * count]
        scores += [*rng.beta(9, 1.5, len(rows)).tolist(), *rng.beta(3, 4, count).tolist()]
    n = len(frames)
    detections = ForeignDetections(
        np.array(frames, dtype=np.int64),
        np.concatenate(boxes) if boxes else np.zeros((0, 4)),
        np.array(scores, dtype=np.float64),
        tuple(f"kind{k}" for k in kinds),
        np.full((n, 3), np.nan),
        np.full((n, 3, 3), np.nan),
        np.full((n, 3), np.nan),
    )
    heights = {f"kind{k}": (float(h), float(config.height_spread * h)) for k, h in enumerate(mean)}
    return SimulatedBoxes(detections, np.array(sources, dtype=np.int64), heights)
