"""How far and how large objects of photographs are: what the guide says, what the box shows, and what categories measure.

An image shows size over distance. The guide's range and size were learnt from generated scenes; in photographs their ratio is off
by a quarter. Three independent statements of log range u and log diagonal v are multiplied: the guide's two Gaussians, a
Gaussian on u - v from the height at which the category's mean shape, turned as the guide says, fills the box, and the category's
sizes on v. On generated scenes, whose objects have any size, the guide is left alone.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from nolbo_ppl.models.category_sizes import CategorySizes
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.observed_scene import RegionParameters

RATIO_SCALE = 0.15
"""Scale of log (range / diagonal) as a box's height tells it: instances are taller or lower, boxes cut off what is hidden. Of
26 cars of street photographs half are within 0.07."""
GUIDE_LOG_SCALE = 0.25
"""Error of the guide's own log range and log diagonal in photographs, added to the scales it states, which generated scenes
taught: of a motorbike 2.4 m away it was sure, and said 3.8 m."""
FOCAL_LOG_SCALE = 0.35
"""Scale of the log focal length of a camera that nobody states: views of 35 to 85 degrees across are within two of them."""
HULL_POINTS = 96
"""Points that stand for a mean shape."""
BORDER = 2.0
"""A box that comes this near to the border, px, may be cut off and says nothing."""
ROUNDS = 3
"""Steps of the fit of the ratio: perspective changes the height a little."""


@dataclass(frozen=True)
class MetricKnowledge:
    """What is known, beside the posterior, of the objects to answer for."""

    hulls: Float[Tensor, "labels p 3"]
    """Points of each category's mean shape, in diagonals."""
    sizes: CategorySizes
    share: Float[Tensor, " n"]
    """Probability that each object's image is a photograph."""
    guessed_focal: Bool[Tensor, " n"]
    """Nobody stated its camera."""
    extent: Float[Tensor, "n 2"]
    """Width and height of its image, px, without bars."""


def shape_hulls(occupancy: Float[np.ndarray, "labels v v v"]) -> Float[np.ndarray, "labels p 3"]:
    """Points on the convex hull of each shape, scaled to a box of diagonal 1, the box's centre in the middle.

    A shape without a volume is a box of its own extents, a cube where it is empty.
    """
    result = np.empty((len(occupancy), HULL_POINTS, 3))
    for k, grid in enumerate(occupancy > 0.5):
        cell = np.argwhere(grid)
        corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
        points = (cell[:, None] + corners).reshape(-1, 3).astype(np.float64) if len(cell) else corners.astype(np.float64)
        low, high = points.min(0), points.max(0)
        points = (points - (low + high) / 2) / np.linalg.norm(high - low)
        try:
            points = points[ConvexHull(points).vertices]
        except QhullError:  # flat: its points are its hull
            points = np.unique(points, axis=0)
        order = np.argsort(-np.abs(points[:, 2]), kind="stable")  # top and bottom first, where there are too many
        result[k] = (
            points[order[np.arange(HULL_POINTS) % len(points)]]
            if len(points) > HULL_POINTS
            else points[np.arange(HULL_POINTS) % len(points)]
        )
    return result


def ratio_of_height(
    hull: Float[Tensor, "n p 3"],
    R_camera_object: Float[Tensor, "n 3 3"],
    ray: Float[Tensor, "n 3"],
    log_ratio: Float[Tensor, " n"],
    height: Float[Tensor, " n"],
    focal: Float[Tensor, " n"],
) -> Float[Tensor, " n"]:
    """log (range / diagonal) at which a shape fills so many pixels from top to bottom.

    Args:
        hull: points of the shape, in diagonals.
        R_camera_object: its rotation.
        ray: unit direction of its centre.
        log_ratio: where to start.
        height: px.
        focal: fy, px.
    """
    turned = hull @ R_camera_object.transpose(1, 2)
    for _ in range(ROUNDS):
        point = turned + (ray * log_ratio.exp()[:, None])[:, None]
        y = focal[:, None] * point[..., 1] / point[..., 2].clamp_min(0.05)
        log_ratio = (log_ratio + torch.log((y.amax(1) - y.amin(1)) / height)).clamp(-1.0, 8.0)
    return log_ratio


def with_metric_size(
    q: RegionParameters,
    box: Float[Tensor, "n 4"],
    position: Float[Tensor, "n 3"],
    diagonal: Float[Tensor, " n"],
    R_camera_object: Float[Tensor, "n 3 3"],
    camera: Float[Tensor, "n 4"],
    known: MetricKnowledge,
    config: ModelConfig,
) -> RegionParameters:
    """The posterior with range and size as the product of all statements (module's docstring).

    Args:
        q: the guide's posterior, calibrated.
        box: mean boxes, px.
        position: the guide's mean position, m.
        diagonal: its mean diagonal, m.
        R_camera_object: rotation at the likeliest viewpoint.
        camera: [fx, fy, cx, cy], px.
        known: see `MetricKnowledge`.
        config: configuration of the networks.
    """
    if not len(box):
        return q
    spread = q.range_scale.new_tensor([config.range_spread[0], config.range_spread[3]])
    scale = q.range_scale[:, [0, 3]] * spread
    label = q.label_logits.argmax(-1)
    distance = torch.linalg.vector_norm(position, dim=-1)
    log_ratio = torch.log(distance / diagonal)
    height = (box[:, 3] - box[:, 1]).clamp_min(1.0)
    arguments = known.hulls[label], R_camera_object, position / distance[:, None], log_ratio, height, camera[:, 1]
    change = ratio_of_height(*(value.to(box.dtype) for value in arguments)) - log_ratio
    whole = (box[:, 1] > BORDER) & (box[:, 3] < known.extent[:, 1] - BORDER)
    ratio_precision = known.share * whole / RATIO_SCALE**2
    log_mean, size_precision = known.sizes(label)
    size_precision = known.share * size_precision
    # Deviations du, dv from the guide's means: N(du; 0, s0^2) N(dv; 0, s1^2) N(du - dv; change, .) N(dv; log_mean - log d, .)
    own = (scale.square() + known.share[:, None] * GUIDE_LOG_SCALE**2).reciprocal()
    a, b, c = own[:, 0] + ratio_precision, -ratio_precision, own[:, 1] + ratio_precision + size_precision
    first = ratio_precision * change
    second = size_precision * (log_mean - torch.log(diagonal)) - ratio_precision * change
    determinant = a * c - b * b
    moved = torch.stack((c * first - b * second, a * second - b * first), -1) / determinant[:, None]
    variance = torch.stack((c, a), -1) / determinant[:, None]
    focal = known.guessed_focal.to(variance.dtype) * FOCAL_LOG_SCALE**2
    variance = torch.stack((variance[:, 0] + focal, variance[:, 1]), -1)
    loc, wide = q.range_loc.clone(), q.range_scale.clone()
    loc[:, [0, 3]] += moved / spread
    wide[:, [0, 3]] = variance.sqrt() / spread
    return dataclasses.replace(q, range_loc=loc, range_scale=wide)
