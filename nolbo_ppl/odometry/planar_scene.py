"""Scenes of one plane: the two motions that a homography allows, and which of them the images and the past speak for.

All matches on one plane obey two essential matrices (Longuet-Higgins 1986): the true motion (R, t) before a plane of normal
n, and its twin, in which translation and normal have changed places. A wall passed sideways and bare ground ahead are such
scenes; five-point consensus takes either at random. What tells them apart: points must lie before both cameras, the normal
must stay that of one plane from step to step, and the camera hardly turns more than it has to. One step may not tell; so both
motions are kept, with what was held against each, and the steps that follow decide (the best sum over the sequence, Viterbi).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from nolbo_ppl.geometry.pose import inverse, make_pose, rotation_angle, se3_log
from nolbo_ppl.odometry.epipolar import TwoView, depths, rays, refine
from nolbo_ppl.odometry.odometry_config import OdometryConfig

PLANAR_SHARE = 0.85
"""Part of the inliers of the essential matrix that a homography must explain as well for the scene to count as a plane."""
BEHIND_SHARE = 0.1
"""Part of the inliers that may seem to lie behind a camera (mismatches, points at infinity) in a motion that can be true."""
NORMAL_SCALE, TURN_SCALE, BOUND = 0.1, 0.1, 12.0
"""How far the normal of the plane may change its direction between steps and the camera may turn in one, rad, as standard
deviations, and the most that either is held against a motion, nats."""
DECIDED = 8.0
"""Surprise, nats, by which a twin must exceed the best motion to be forgotten."""
MIN_DOUBT = 0.05
"""Least probability that is left to any other twin: with it, the truth is within Mahalanobis^2 of 20 whichever it is."""


@dataclass(frozen=True)
class PlanePast:
    """What frames up to this one may have seen and how the camera went."""

    normal: Float[np.ndarray, " 3"] | None = None
    """Normal of the plane in this camera; None where no plane was seen."""
    direction: Float[np.ndarray, " 3"] | None = None
    """Direction of the last translation that was measured, in the camera before it."""
    surprise: float = 0.0
    """What is held against it, nats more than against the best."""

    def turned(self, R: Float[np.ndarray, "3 3"]) -> PlanePast:
        """The same in a camera that has turned by `R` = R_earlier_later."""
        return self if self.normal is None else replace(self, normal=R.T @ self.normal)

    def against(self, R: Float[np.ndarray, "3 3"], normal: Float[np.ndarray, " 3"], direction: Float[np.ndarray, " 3"]) -> float:
        """What it holds against a step with rotation `R`, a plane with this normal in the later camera, and this direction."""
        held = self.surprise
        if self.normal is not None:
            held += bounded(angle_between(R @ normal, self.normal), NORMAL_SCALE)
        if self.direction is not None:
            held += bounded(angle_between(direction, self.direction), 1.5 * NORMAL_SCALE)
        return held


@dataclass(frozen=True)
class PlaneMotion:
    """One of the motions before a plane."""

    view: TwoView
    """Rotation and direction, refined on all matches."""
    normal: Float[np.ndarray, " 3"]
    """Normal of the plane in the later camera, towards the points."""
    surprise: float
    """What images and past hold against it, nats."""
    start: tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]] | None = None
    """Rotation and direction as the homography alone has them."""


def bounded(angle: float, scale: float) -> float:
    """Surprise at an angle, nats."""
    return min(0.5 * (angle / scale) ** 2, BOUND)


def angle_between(a: Float[np.ndarray, " 3"], b: Float[np.ndarray, " 3"]) -> float:
    """Angle of two unit vectors, rad."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def plane_inliers(
    first: Float[np.ndarray, "m 2"], second: Float[np.ndarray, "m 2"], config: OdometryConfig, scale: float | None = None
) -> tuple[Float[np.ndarray, "3 3"], Bool[np.ndarray, " m"]] | None:
    """Homography from the later to the earlier image, px, and the matches on it; None without one.

    With `scale`, the standard deviation of a corner in px, a match is on it within three of those of both corners: a
    homography fits a room with a wall ahead to within a few px, but not to within its noise.
    """
    cv2.setRNGSeed(config.seed)
    limit = 3.0 * config.threshold
    if scale is not None:
        limit = float(np.clip(3.0 * np.sqrt(2.0) * scale, 0.3 * config.threshold, limit))
    H, mask = cv2.findHomography(second, first, cv2.RANSAC, limit, maxIters=500)
    if H is None or mask is None or not np.isfinite(H).all():
        return None
    return H, mask[:, 0].astype(bool)


def plane_motions(
    H: Float[np.ndarray, "3 3"],
    first: Float[np.ndarray, "m 2"],
    second: Float[np.ndarray, "m 2"],
    intrinsics: Float[np.ndarray, " 4"],
    config: OdometryConfig,
    also: TwoView | None = None,
    past: Sequence[PlanePast] = (),
) -> list[PlaneMotion]:
    """The motions of a homography with (nearly) all points before both cameras, the least surprising first.

    Args:
        H: homography from the later to the earlier image, px.
        also: a motion found otherwise, which competes.
        first: corners of the earlier image, px.
        second: the same of the later image.
        intrinsics: fx, fy, cx, cy, px.
        config: settings.
        past: what the earlier camera may have seen before.
    """
    fx, fy, cx, cy = intrinsics
    camera = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    count, rotations, translations, normals = cv2.decomposeHomographyMat(H, camera)
    ray_first, ray_second = rays(first, intrinsics), rays(second, intrinsics)
    views: list[tuple[TwoView, tuple[np.ndarray, np.ndarray] | None]] = [] if also is None else [(also, None)]
    for R, t, n in zip(rotations[:count], translations[:count], normals[:count]):
        length = float(np.linalg.norm(t))
        if length < 1e-9 or not np.isfinite(R).all() or np.linalg.det(R) < 0:
            continue
        if np.mean(ray_second @ n[:, 0] > 0) < 1 - BEHIND_SHARE:  # the plane lies behind the later camera
            continue
        direction_of = t[:, 0] / length
        views.append((refine(R, direction_of, ray_first, ray_second, intrinsics, config.threshold), (R, direction_of)))
    found: list[PlaneMotion] = []
    for view, beginning in views:
        if view.inliers.sum() < config.least_inliers:
            continue
        rho = depths(view.R, view.direction, ray_first, ray_second)[view.inliers]
        noise = 2.0 * view.scale / float(np.sqrt(fx * fy))
        if np.mean((rho < -noise).any(axis=1)) > BEHIND_SHARE:
            continue
        n = np.linalg.lstsq(ray_second[view.inliers], rho[:, 1], rcond=None)[0]  # 1 / z = n . ray / distance on the plane
        n /= max(float(np.linalg.norm(n)), 1e-12)
        surprise = 2.0 * len(first) * view.cost + bounded(float(rotation_angle(view.R)), TURN_SCALE)
        surprise += min((before.against(view.R, n, view.direction) for before in past), default=0.0)
        found.append(PlaneMotion(view, n, surprise, beginning))
    return sorted(found, key=lambda motion: motion.surprise)


def pasts_of(motions: Sequence[PlaneMotion]) -> tuple[PlanePast, ...]:
    """What the next step has to know of the motions of this one: all that are not ruled out for good."""
    least = motions[0].surprise
    return tuple(
        PlanePast(motion.normal, motion.view.direction, min(motion.surprise - least, 2.0 * BOUND))
        for motion in motions
        if motion.surprise - least < 3.0 * BOUND
    )


def twin_covariance(motions: Sequence[PlaneMotion], length: float) -> Float[np.ndarray, "6 6"] | None:
    """What the twin adds to the covariance of a step, m and rad: its probability times the square of what lies between.

    Twins that lie close together, where translation and normal nearly agree, are joined by a valley in which refinement
    ends anywhere; the motions of the homography stand at its two ends and are counted as well.

    Returns:
        None where no twin is left: the others are the same motion, or too surprising.
    """
    best = motions[0]
    rivals = [motion for motion in motions if motion.start is not None and motion.surprise - best.surprise < DECIDED]
    if len(rivals) < 2:
        return None
    T = make_pose(best.view.R, length * best.view.direction)
    added = np.zeros((6, 6))
    for motion in rivals:
        weight = max(MIN_DOUBT, 1.0 / (1.0 + float(np.exp(motion.surprise - best.surprise))))
        for R, direction in ((motion.view.R, motion.view.direction), *([motion.start] if motion.start is not None else [])):
            between = se3_log((inverse(T) @ make_pose(R, length * direction))[None])[0]
            added += weight * np.outer(between, between)
    return added
