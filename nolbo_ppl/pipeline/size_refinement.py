"""Usual heights of categories refine the guide's positions: an object that fills so many pixels stands so far away.

A network that learnt ranges on generated scenes says of a photograph's car that it is anywhere from half to twice as far; that
cars are 1.5 m high says it to a tenth. The guide's range and the one by the height go together by their precisions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from nolbo_ppl.data.converters.coco_names import HEIGHTS
from nolbo_ppl.data.converters.foreign_detections import is_whole
from nolbo_ppl.pipeline.depth_refinement import fuse_along_ray, half_extent_along_ray
from nolbo_ppl.structures.object_posteriors import ObjectPosteriors

USUAL_HEIGHTS: dict[str, tuple[float, float]] = {
    **{name: HEIGHTS[name] for name in ("bicycle", "bus", "car", "chair", "bottle")},
    "motorbike": HEIGHTS["motorcycle"],
    "sofa": HEIGHTS["couch"],
    "diningtable": HEIGHTS["dining_table"],
    "train": (3.8, 0.4),
    "tvmonitor": (0.45, 0.15),
}
"""Height and its standard deviation of the categories that have a usual one, m; boats and aeroplanes have none."""
NEAR_SHARE = 1.0
"""A box's lower edge is drawn by the near side of an object, the upper one by a side that depends on where the camera is: the box
tells the distance of a place this share of the half extent before the centre. With it the ranges of simulated cars are
4 % too small in the median, those of KITTI's 2 %, with 0.7 6 and 5 %."""
NEAR_SCALE = 0.3
"""How far that place may lie from there, in half extents."""
HIDDEN = 0.1
"""Standard deviation of a box's height in parts of it: what stands before an object hides its lower edge."""
OPEN = 100.0
"""Scale, in its own, of a range that is to have no say."""
GATE = 3.0
"""A range that lies so many scales from the guide's is that of another thing: half an object, a toy."""


def usual_range(
    observed: ObjectPosteriors,
    intrinsics: Float[np.ndarray, " 4"],
    image_size: tuple[int, int],
    heights: Mapping[str, tuple[float, float]],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Distance of each object's centre along its ray and its scale, m, by the height of its category; NaN where none is known.

    Args:
        observed: what the guide says of an image.
        intrinsics: fx, fy, cx, cy, px.
        image_size: width and height of the image, px: boxes at its rim are cut off and say nothing.
        heights: height and standard deviation by category, m.
    """
    box = np.asarray(observed.box, dtype=np.float64)
    names = [observed.categories[k] for k in np.asarray(observed.class_log_posterior).argmax(axis=1)]
    height, spread = np.array([heights.get(name, (np.nan, np.nan)) for name in names]).reshape(-1, 2).T
    tall = box[:, 3] - box[:, 1]
    whole = is_whole(box, image_size) & (tall > 1.0)
    ray = np.asarray(observed.position, dtype=np.float64)
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    size = np.asarray(observed.size, dtype=np.float64)
    size = size * (height / size[:, 2])[:, None]  # the guide's proportions at the usual height
    reach = np.full(len(box), np.nan)
    good = whole & np.isfinite(size).all(axis=1) & (size > 0).all(axis=1)
    reach[good] = half_extent_along_ray(size[good], observed.R_camera_object[good], ray[good])
    near = intrinsics[1] * height / np.where(whole, tall, np.nan) / ray[:, 2]
    scale = np.sqrt((near * np.hypot(spread / height, HIDDEN)) ** 2 + (NEAR_SCALE * reach) ** 2)
    return near + NEAR_SHARE * reach, scale


def refine_by_height(
    observed: ObjectPosteriors,
    intrinsics: Float[np.ndarray, " 4"],
    image_size: tuple[int, int],
    heights: Mapping[str, tuple[float, float]] | None = None,
) -> ObjectPosteriors:
    """Positions, their covariances and sizes with the usual heights of categories taken into account; other answers stay.

    Ranges that hold a height already (`ObjectPosteriors.sized`) are replaced where the new one fits them, others multiplied.

    Args:
        observed: what the guide says of an image.
        intrinsics: fx, fy, cx, cy, px.
        image_size: width and height of the image, px.
        heights: height and standard deviation by category, m; `USUAL_HEIGHTS` by default.
    """
    if not len(observed):
        return observed
    position = np.asarray(observed.position, dtype=np.float64)
    distance = np.linalg.norm(position, axis=1)
    ray = position / distance[:, None]
    measured, scale = usual_range(observed, intrinsics, image_size, USUAL_HEIGHTS if heights is None else heights)
    along = np.sqrt(np.einsum("ni,nij,nj->n", ray, observed.position_covariance, ray))
    fits = np.abs(measured - distance) < GATE * np.hypot(scale, along)
    covariance = np.asarray(observed.position_covariance, dtype=np.float64)
    if observed.sized:  # the same height is in that range already: this one takes its place
        covariance = covariance + (OPEN * along[:, None, None]) ** 2 * fits[:, None, None] * ray[:, :, None] * ray[:, None, :]
    refined, covariance = fuse_along_ray(position, covariance, np.where(fits, measured, np.nan), scale)
    # What fills the same pixels from another distance has another size.
    factor = np.linalg.norm(refined, axis=1) / distance
    return replace(
        observed,
        position=refined,
        position_covariance=covariance,
        size=np.asarray(observed.size, dtype=np.float64) * factor[:, None],
        diagonal=np.asarray(observed.diagonal, dtype=np.float64) * factor,
    )
