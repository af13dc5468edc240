"""Scale from the ground: the plane under the camera in inverse depths, where it is linear and its noise is even.

A point of the plane `n . X = h` seen along the ray x has the inverse depth `rho = n . x / h`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nolbo_ppl.odometry.epipolar import TwoView, cross, depths, student_weights
from nolbo_ppl.odometry.odometry_config import GroundHeight

BELOW_HORIZON = 0.1
"""Points on the ground lie at least this slope below the horizon."""
ASIDE = 2.0
"""And no further to the side than so many camera heights: walls and hedges stand there."""
TILT = 0.01
"""Standard deviation of the ground's slope against the horizontal of the camera, rad."""
MIN_POINTS = 12
"""Fewer points make no ground."""
MIN_PART = 0.25
"""Nor do points that are fewer than this part of those below the horizon."""
COARSE = 0.05
"""Relative width of the vote for the height."""


@dataclass(frozen=True)
class Ground:
    """The plane below the camera, in the unit of the step's length."""

    inverse_height: float
    """Step length over camera height."""
    scale: float
    """Standard deviation of the inverse height from the points alone."""
    points: int
    """How many points it rests on."""


def ground_axes(pitch: float) -> Float[np.ndarray, "3 3"]:
    """Columns down, right and forward along the ground, in the frame of a camera that looks down by `pitch` rad."""
    down = np.array([0.0, np.cos(pitch), np.sin(pitch)])
    right = np.array([1.0, 0.0, 0.0])
    return np.column_stack([down, right, np.cross(right, down)])


def vote(candidates: Float[np.ndarray, " n"], scale: Float[np.ndarray, " n"]) -> float:
    """The inverse height that most points agree on. Every point is a candidate: exhaustive, so nothing is drawn."""
    tolerance = 2.0 * scale[None, :] + COARSE * np.abs(candidates)[:, None]
    support = np.abs(candidates[:, None] - candidates[None, :]) < tolerance
    # A vague point agrees with everything; its voice counts less.
    return float(candidates[int(np.argmax(support @ (1.0 / (COARSE + scale / np.abs(candidates)))))])


def fit_ground(
    view: TwoView,
    first: Float[np.ndarray, "m 3"],
    second: Float[np.ndarray, "m 3"],
    intrinsics: Float[np.ndarray, " 4"],
    pitch: float,
    iterations: int = 8,
) -> Ground | None:
    """The ground under the earlier camera from the inliers of a step of unit length.

    Args:
        view: the motion.
        first: rays of the matches in the earlier camera.
        second: and in the later.
        intrinsics: fx, fy, cx, cy, px.
        pitch: how far the camera looks down, rad.
        iterations: reweighted fits.

    Returns:
        The plane, or None where too few points agree on one.
    """
    first, second = first[view.inliers], second[view.inliers]
    slopes = first @ ground_axes(pitch)
    rho = depths(view.R, view.direction, first, second)[:, 0]
    below = (slopes[:, 0] > BELOW_HORIZON) & (np.abs(slopes[:, 1]) < ASIDE * slopes[:, 0]) & (rho > 0)
    if below.sum() < MIN_POINTS:
        return None
    slopes, rho = slopes[below], rho[below]
    # An error of one corner across the focal length shifts rho by its inverse lever |R x2 x t|.
    lever = np.linalg.norm(cross(second[below] @ view.R.T, view.direction), axis=1)
    noise = np.sqrt(2.0) * view.scale / np.sqrt(intrinsics[0] * intrinsics[1]) / np.maximum(lever, 1e-6)
    plane = np.array([vote(rho / slopes[:, 0], noise / slopes[:, 0]), 0.0, 0.0])
    width = noise + COARSE * rho
    for _ in range(iterations):
        error = (rho - slopes @ plane) / width
        weight = np.where(np.abs(error) < 4.0, student_weights(error, 1.0), 0.0) / width**2
        prior = np.array([0.0, 1.0, 1.0]) / (TILT * plane[0]) ** 2
        information = (slopes * weight[:, None]).T @ slopes + np.diag(prior)
        plane = np.linalg.solve(information, slopes.T @ (weight * rho))
        if not plane[0] > 0:
            return None
        width = np.maximum(noise, 0.02 * rho)
    used = np.abs(rho - slopes @ plane) < 3.0 * width
    if used.sum() < max(MIN_POINTS, MIN_PART * len(rho)):
        return None
    return Ground(float(plane[0]), float(np.sqrt(np.linalg.inv(information)[0, 0])), int(used.sum()))


@dataclass(frozen=True)
class LengthBelief:
    """What is known of the length of a step: a log-normal."""

    length: float
    """Median, m."""
    log_scale: float
    """Standard deviation of its logarithm."""

    @property
    def scale(self) -> float:
        """Standard deviation, m."""
        return self.length * self.log_scale


def next_length(before: LengthBelief | None, ground: Ground | None, setting: GroundHeight) -> tuple[LengthBelief | None, bool]:
    """The length of this step from that of the step before and the ground under this one.

    Returns:
        The belief (None where nothing was ever measured), and whether the ground was used: one that contradicts the
        step before by more than 4 standard deviations is not.
    """
    predicted = None
    if before is not None:
        predicted = LengthBelief(before.length, float(np.hypot(before.log_scale, setting.acceleration)))
    if ground is None:
        return predicted, False
    measured = LengthBelief(
        setting.height * ground.inverse_height, float(np.hypot(ground.scale / ground.inverse_height, setting.ratio))
    )
    if predicted is None:
        return measured, True
    gap = np.log(measured.length / predicted.length)
    if abs(gap) > 4.0 * np.hypot(measured.log_scale, predicted.log_scale):
        return predicted, False
    gain = predicted.log_scale**2 / (predicted.log_scale**2 + measured.log_scale**2)
    return LengthBelief(float(predicted.length * np.exp(gain * gap)), float(predicted.log_scale * np.sqrt(1.0 - gain))), True
