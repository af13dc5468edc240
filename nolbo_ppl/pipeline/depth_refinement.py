"""Depth at hand (a depth map, a stereo pair) refines the guide's positions: measured range and guide's range by precision.

A depth map sees the front of an object, the position is that of the centre of its box. The shape between the two is taken
for the ellipsoid of the object's extents, with a scale that says how far that may be wrong.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from nolbo_ppl.errors import input_error
from nolbo_ppl.io.images import open_depth_image
from nolbo_ppl.structures.object_posteriors import ObjectPosteriors

CENTRAL = 0.5
"""Share of the box's width and height that is looked at: its border shows the background."""
FRONT = 0.9
"""Mean depth of an ellipsoid's front over that central part, in half extents along the ray (1 at its very middle)."""
FRONT_SCALE = 0.35
"""How far a real object's front may lie from there, in half extents (hollow, off-centre, or only partly seen)."""
MIN_PIXELS = 12
"""Fewer valid pixels than this say nothing."""
MIN_SHARE = 0.25
"""Less than this share of the valid pixels near the guide's range: what is seen there is something else."""
GATE = 4.0
"""Depths farther than this many scales from where the guide expects the front belong to something else."""


@dataclass(frozen=True)
class DepthScale:
    """How the numbers of a depth picture become metres, and how well they are known."""

    unit: float = 1 / 5000
    """Metres of one step of a 16 bit picture (TUM 1/5000, YCB-Video 1/10000, millimetres 1/1000)."""
    ratio: float = 0.0
    """Scale of a depth's error that grows with the square of the depth, 1/m (structured light about 0.0015)."""
    floor: float = 0.01
    """Scale of a depth's error at no depth, m."""


def read_depth(path: Path, scale: DepthScale) -> Float[np.ndarray, "h w"]:
    """A 16 bit depth picture in metres along the optical axis, NaN where it knows nothing.

    Raises:
        InputError: no readable picture of one 16 bit channel.
    """
    raw = open_depth_image(path)
    return np.where(raw > 0, raw * scale.unit, np.nan)


def stereo_depth(
    left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"], focal: float, baseline: float
) -> Float[np.ndarray, "h w"]:
    """Depth of the left image of a rectified pair by semi-global matching, m along the optical axis; NaN where unmatched.

    Args:
        left: the image objects are observed in.
        right: the other one, to its right.
        focal: focal length, px.
        baseline: distance of the two cameras, m.
    """
    import cv2  # delayed: only stereo needs it

    if left.shape != right.shape:
        raise input_error("stereo pair", got=f"{left.shape} and {right.shape}", expected="two images of one size")
    block = 5
    levels = int(np.ceil(left.shape[1] / 4 / 16)) * 16
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=levels,
        blockSize=block,
        P1=24 * block**2,
        P2=96 * block**2,
        disp12MaxDiff=1,
        uniquenessRatio=8,
        speckleWindowSize=60,
        speckleRange=2,
    )
    # The leftmost columns have no partner inside the right image: matched on a widened pair they stay unknown, not wrong.
    pad = ((0, 0), (levels, 0), (0, 0))
    disparity = matcher.compute(np.pad(left, pad, mode="edge"), np.pad(right, pad, mode="edge"))[:, levels:] / 16.0
    return np.where(disparity > 0.5, focal * baseline / np.maximum(disparity, 0.5), np.nan)


def stereo_scale(focal: float, baseline: float, disparity_scale: float = 0.5) -> DepthScale:
    """Error of stereo depth: `z^2 / (f b)` times the scale of the disparity in px."""
    return DepthScale(ratio=disparity_scale / (focal * baseline))


def half_extent_along_ray(
    size: Float[np.ndarray, "n 3"], R_camera_object: Float[np.ndarray, "n 3 3"], ray: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, " n"]:
    """Distance from the centre of the ellipsoid with full axes `size` to its surface along the ray."""
    direction = np.einsum("nji,nj->ni", R_camera_object, ray)
    return 0.5 / np.sqrt(np.sum((direction / size) ** 2, axis=1))


def fuse_along_ray(
    position: Float[np.ndarray, "n 3"],
    covariance: Float[np.ndarray, "n 3 3"],
    measured: Float[np.ndarray, " n"],
    scale: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
    """Product of the guide's Gaussian with one along the ray: `N(x; p, C) N(r' x; d, s^2)` normalised.

    Args:
        position: p, camera frame, m; r is its direction.
        covariance: C, m^2.
        measured: d, distance of the centre along r, m; NaN leaves that object as it is.
        scale: s, m.
    """
    distance = np.linalg.norm(position, axis=1)
    ray = position / distance[:, None]
    used = np.isfinite(measured)
    innovation = np.where(used, np.nan_to_num(measured) - distance, 0.0)
    variance = np.where(used, np.nan_to_num(scale, nan=1.0) ** 2, 1.0)
    Cr = np.einsum("nij,nj->ni", covariance, ray)
    total = np.einsum("ni,ni->n", ray, Cr) + variance
    gain = Cr / total[:, None]
    moved = position + gain * innovation[:, None]
    reduced = covariance - gain[:, :, None] * Cr[:, None, :]
    reduced = 0.5 * (reduced + np.swapaxes(reduced, 1, 2))
    keep = used[:, None]
    return np.where(keep, moved, position), np.where(keep[..., None], reduced, covariance)


def front_depth(
    depth: Float[np.ndarray, " p"], expected: float, scale: float, reach: float
) -> tuple[float, Bool[np.ndarray, " p"]]:
    """Depth of the object's front among the pixels of its box: median of those the guide's range allows; NaN if too few.

    Args:
        depth: valid depths in the central part of the box, m.
        expected: where the guide expects the front, m.
        scale: scale of that expectation, m.
        reach: half extent of the object along the ray, m: its surface spreads that far.
    """
    near = np.abs(depth - expected) <= GATE * scale + reach
    if near.sum() < max(MIN_PIXELS, MIN_SHARE * len(depth)):
        return float("nan"), near
    return float(np.median(depth[near])), near


def refine_positions(
    observed: ObjectPosteriors, depth: Float[np.ndarray, "h w"], image_size: tuple[int, int], scale: DepthScale
) -> ObjectPosteriors:
    """Positions and their covariances with the depth inside each box taken into account; other answers stay.

    Args:
        observed: what the guide says of the image.
        depth: depth along the optical axis, m; NaN unknown; of any size that shows the same view.
        image_size: width and height of the image the boxes refer to, px.
        scale: errors of the depth.
    """
    if not len(observed):
        return observed
    position = np.asarray(observed.position, dtype=np.float64)
    distance = np.linalg.norm(position, axis=1)
    ray = position / distance[:, None]
    reach = half_extent_along_ray(np.asarray(observed.size, dtype=np.float64), observed.R_camera_object, ray)
    along = np.sqrt(np.einsum("ni,nij,nj->n", ray, observed.position_covariance, ray))
    zoom = np.array([depth.shape[1] / image_size[0], depth.shape[0] / image_size[1]])
    measured, spread = np.full(len(observed), np.nan), np.full(len(observed), np.nan)
    for i, box in enumerate(np.asarray(observed.box, dtype=np.float64)):
        centre, half = (box[:2] + box[2:]) / 2, CENTRAL * (box[2:] - box[:2]) / 2
        low = np.floor((centre - half) * zoom).astype(int).clip(0)
        high = np.ceil((centre + half) * zoom).astype(int)
        window = depth[low[1] : high[1], low[0] : high[0]]
        window = window[np.isfinite(window)] / ray[i, 2]  # depth along the axis -> distance along the object's ray
        front, _ = front_depth(window, distance[i] - FRONT * reach[i], along[i], reach[i])
        measured[i] = front + FRONT * reach[i]
        error = scale.floor + scale.ratio * front**2
        spread[i] = np.hypot(error, FRONT_SCALE * reach[i])
    refined, covariance = fuse_along_ray(position, observed.position_covariance, measured, spread)
    return replace(observed, position=refined, position_covariance=covariance)
