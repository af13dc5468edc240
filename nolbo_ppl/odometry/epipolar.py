"""The essential matrix between two views: residuals, their Jacobian, robust refinement, covariance.

Points x1 of the earlier and x2 of the later camera obey `x1' E x2 = 0` with `E = [t]x R` and `T_earlier_later = (R, t)`.
The length of t is not observable; it is 1 here.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from nolbo_ppl.geometry.pose import skew, so3_exp
from nolbo_ppl.odometry.odometry_config import OdometryConfig

FREEDOM = 5.0
"""Degrees of freedom of the Student t that weights residuals: mismatches have long tails."""
GATE = 4.0
"""Residuals beyond this many standard deviations are no inliers."""
MIN_SCALE = 0.02
"""Least standard deviation of a corner, px: synthetic images can fit to rounding."""
LEVERAGE = 3.0
"""A match pulls at the direction of translation at most so many times as much as the usual one."""
GENERATORS = skew(np.eye(3))
"""`w x a` for the three axes w."""
DIRECTION_SCALE, DIRECTION_BOUND = 0.15, 12.0
"""How far the direction of translation turns from step to step, rad, and the most that is held against another, nats."""
HALVINGS = 4
"""How often a step that raises the loss is cut to a quarter before it is given up."""
MAD = 1.4826
"""Standard deviation of a normal variable over its median absolute deviation."""


@dataclass(frozen=True)
class TwoView:
    """Motion between two views up to its length."""

    R: Float[np.ndarray, "3 3"]
    """Rotation of T_earlier_later."""
    direction: Float[np.ndarray, " 3"]
    """Direction of its translation, unit length."""
    covariance: Float[np.ndarray, "5 5"]
    """Of [rotation about the later camera's axes, direction along `tangent(direction)`], rad^2."""
    inliers: Bool[np.ndarray, " m"]
    """Which matches obey it."""
    scale: float
    """Standard deviation of a corner, px."""
    cost: float
    """Mean of the robust loss over all matches; less is better."""


def rays(pixels: Float[np.ndarray, "m 2"], intrinsics: Float[np.ndarray, " 4"]) -> Float[np.ndarray, "m 3"]:
    """Rays [x / z, y / z, 1] of pixels."""
    return np.column_stack([(pixels - intrinsics[2:]) / intrinsics[:2], np.ones(len(pixels))])


def cross(a: Float[np.ndarray, "... 3"], b: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
    """Cross products of rows; `np.cross` spends five times as long on its bookkeeping."""
    result = np.empty(np.broadcast_shapes(a.shape, b.shape))
    result[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    result[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    result[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return result


def tangent(direction: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 2"]:
    """Two orthonormal vectors across a unit vector."""
    axis = np.eye(3)[int(np.argmin(np.abs(direction)))]
    first = cross(direction, axis)
    first /= np.linalg.norm(first)
    return np.column_stack([first, cross(direction, first)])


def rowwise(
    points: Float[np.ndarray, "m 3"], maps: Float[np.ndarray, "p 2 3"], pull: Float[np.ndarray, "m 2"]
) -> Float[np.ndarray, "m p"]:
    """`pull . (map x)` for each point x and each map, in one product of matrices."""
    moved = points @ maps.reshape(-1, 3).T
    return moved[:, 0::2] * pull[:, :1] + moved[:, 1::2] * pull[:, 1:]


def sampson(
    R: Float[np.ndarray, "3 3"],
    direction: Float[np.ndarray, " 3"],
    first: Float[np.ndarray, "m 3"],
    second: Float[np.ndarray, "m 3"],
    intrinsics: Float[np.ndarray, " 4"],
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 5"]]:
    """Signed Sampson residuals in px and their Jacobian by [rotation, direction] (Hartley and Zisserman 2004, eq. 11.9).

    A residual has the standard deviation of one coordinate of a corner. The derivative of the denominator belongs to the
    Jacobian: without it the translation wanders into the image, where epipolar lines are short.
    """
    E = skew(direction) @ R
    basis = tangent(direction)
    turned = second @ R.T
    line_first, line_second = second @ E.T, first @ E  # E x2, E' x1
    error = np.sum(first * line_first, axis=1)
    gradient = np.concatenate([line_first[:, :2], line_second[:, :2]], axis=1) / np.tile(intrinsics[:2], 2)
    norm = np.maximum(np.linalg.norm(gradient, axis=1), 1e-12)
    # With R Exp(w) and t + B b: x1' [t]x R (w x x2) = w . (x2 x E'x1) and x1' (B b x R x2) = b . B' (R x2 x x1).
    by_parameter = np.concatenate([cross(second, line_second), cross(turned, first) @ basis], axis=1)
    # The lines are linear in each parameter: E (w x x2), E'x1 x w, B b x R x2 and R' (x1 x B b), the first two rows of each.
    pull = gradient / np.tile(intrinsics[:2], 2) / norm[:, None]
    across = skew(basis.T)
    by_norm = np.empty_like(by_parameter)
    by_norm[:, :3] = rowwise(second, E[:2] @ GENERATORS, pull[:, :2]) - rowwise(line_second, GENERATORS[:, :2], pull[:, 2:])
    by_norm[:, 3:] = rowwise(turned, across[:, :2], pull[:, :2]) - rowwise(first, R.T[:2] @ across, pull[:, 2:])
    residual = error / norm
    return residual, (by_parameter - residual[:, None] * by_norm) / norm[:, None]


def depths(
    R: Float[np.ndarray, "3 3"],
    translation: Float[np.ndarray, " 3"],
    first: Float[np.ndarray, "m 3"],
    second: Float[np.ndarray, "m 3"],
) -> Float[np.ndarray, "m 2"]:
    """Inverse depths in the earlier and the later view of points `x1 / rho1 = R x2 / rho2 + t`, in the unit of 1 / |t|.

    The equation crossed with R x2 (and with x1), in least squares; negative behind the camera, zero at infinity.
    """
    turned = second @ R.T
    normal = cross(turned, first)
    by_first = cross(turned, translation)  # rho1 (R x2 x t) = R x2 x x1
    by_second = cross(first, translation)  # rho2 (x1 x t) = R x2 x x1
    rho_first = np.sum(normal * by_first, axis=1) / np.maximum(np.sum(by_first**2, axis=1), 1e-18)
    rho_second = np.sum(normal * by_second, axis=1) / np.maximum(np.sum(by_second**2, axis=1), 1e-18)
    return np.column_stack([rho_first, rho_second])


def student_weights(residual: Float[np.ndarray, " m"], scale: float) -> Float[np.ndarray, " m"]:
    """Weights of Student's t for residuals in units of `scale`."""
    return (FREEDOM + 1.0) / (FREEDOM + (residual / scale) ** 2)


def student_loss(residual: Float[np.ndarray, " m"], scale: float) -> Float[np.ndarray, " m"]:
    """The loss those weights belong to, up to a constant, nats."""
    return 0.5 * (FREEDOM + 1.0) * np.log1p((residual / scale) ** 2 / FREEDOM)


def leverage_weights(jacobian: Float[np.ndarray, "m 5"], inside: Bool[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    """Weights that bound the pull of single matches (Mallows 1975).

    A wrong match seems to lie right before the camera; with twenty times the parallax of the others it turns the
    translation until its residual is small, and no loss on residuals alone gets rid of it.
    """
    pull = np.linalg.norm(jacobian[:, 3:], axis=1)
    largest = LEVERAGE * float(np.median(pull[inside])) if inside.any() else np.inf
    return np.minimum(1.0, largest / np.maximum(pull, 1e-12)) ** 2


def robust_cost(residual: Float[np.ndarray, " m"], threshold: float) -> float:
    """Mean of Geman and McClure's bounded loss, for comparing two motions on the same matches."""
    square = (residual / threshold) ** 2
    return float(np.mean(square / (1.0 + square)))


def refine(
    R: Float[np.ndarray, "3 3"],
    direction: Float[np.ndarray, " 3"],
    first: Float[np.ndarray, "m 3"],
    second: Float[np.ndarray, "m 3"],
    intrinsics: Float[np.ndarray, " 4"],
    threshold: float,
    iterations: int = 10,
) -> TwoView:
    """Iteratively reweighted Gauss-Newton on the Sampson residuals from a first guess.

    Inliers follow the scale of the residuals, `GATE` times its robust estimate, and end within twice `threshold` px.
    """
    residual, jacobian = sampson(R, direction, first, second, intrinsics)
    limit = max(threshold, GATE * MAD * float(np.median(np.abs(residual))))  # a first guess may be pixels off
    for _ in range(iterations):
        inside = np.abs(residual) < limit
        if inside.sum() < 8:
            break
        scale = max(MAD * float(np.median(np.abs(residual[inside]))), MIN_SCALE)
        leverage = leverage_weights(jacobian, inside) * inside
        weight = student_weights(residual, scale) * leverage
        normal = (jacobian * weight[:, None]).T @ jacobian
        # Along a direction nobody measures the step must stay small, not blow up.
        step = -np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(5), jacobian.T @ (weight * residual))
        step *= min(1.0, 0.2 / max(float(np.abs(step).max()), 1e-12))
        before = student_loss(residual, scale) @ leverage
        for _ in range(HALVINGS):
            trial_R = R @ so3_exp(step[:3])
            trial = direction + tangent(direction) @ step[3:]
            trial /= np.linalg.norm(trial)
            residual, jacobian = sampson(trial_R, trial, first, second, intrinsics)
            if student_loss(residual, scale) @ leverage <= before:
                break
            step = 0.25 * step
        else:
            residual, jacobian = sampson(R, direction, first, second, intrinsics)
            break
        R, direction = trial_R, trial
        limit = min(2.0 * threshold, max(GATE * scale, 0.1 * threshold))
        if np.abs(step).max() < 3e-5:
            break
    inside = np.abs(residual) < limit
    scale = max(MAD * float(np.median(np.abs(residual[inside]))), MIN_SCALE) if inside.any() else threshold
    weight = leverage_weights(jacobian, inside)[inside]
    covariance = sampson_covariance(residual[inside], jacobian[inside], weight, scale)
    return TwoView(R, direction, covariance, inside, scale, robust_cost(residual, threshold))


def sampson_covariance(
    residual: Float[np.ndarray, " m"], jacobian: Float[np.ndarray, "m 5"], weight: Float[np.ndarray, " m"], scale: float
) -> Float[np.ndarray, "5 5"]:
    """Covariance of the robust estimate, `s (J'WJ)^-1 J'W^2J (J'WJ)^-1` with `s = sum psi^2 / (m - 5) / mean(psi')^2`
    (Huber 1981, eq. 7.6.5, with weights W of the leverage). Fewer than six residuals say nothing: a unit matrix.
    """
    if len(residual) < 6:
        return np.eye(5)
    square = (residual / scale) ** 2
    psi = student_weights(residual, scale) * residual
    slope = np.mean((FREEDOM + 1.0) * (FREEDOM - square) / (FREEDOM + square) ** 2)
    variance = np.sum(psi**2) / (len(residual) - 5) / slope**2
    weighted = jacobian * weight[:, None]
    # Along a direction nobody measures the standard deviation is about a radian.
    bread = np.linalg.inv(weighted.T @ jacobian + variance * np.eye(5))
    return variance * bread @ (weighted.T @ weighted + variance * np.eye(5)) @ bread


def essential_by_consensus(
    first: Float[np.ndarray, "m 2"],
    second: Float[np.ndarray, "m 2"],
    intrinsics: Float[np.ndarray, " 4"],
    config: OdometryConfig,
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]] | None:
    """Rotation and unit translation of T_earlier_later by MAGSAC++ (Barath et al. 2020) on five points (Nister 2004).

    None where no sample gave a motion with the points before both cameras. Deterministic by the seed.
    """
    fx, fy, cx, cy = intrinsics
    camera = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    options = cv2.UsacParams()
    options.confidence, options.maxIterations, options.threshold = config.confidence, config.iterations, config.threshold
    options.score, options.loMethod = cv2.SCORE_METHOD_MAGSAC, cv2.LOCAL_OPTIM_SIGMA
    options.randomGeneratorState, options.isParallel = config.seed, False
    try:
        E, mask = cv2.findEssentialMat(second, first, camera, camera, None, None, options)
    except cv2.error:  # a minimal solver that failed on every sample
        return None
    if E is None or mask is None or E.shape[0] < 3 or not np.isfinite(E).all():
        return None
    # recoverPose takes points of the later camera to the earlier one: T_earlier_later.
    count, R, translation, _ = cv2.recoverPose(E[:3], second, first, camera, mask=mask.copy())
    if count < 5 or not (np.isfinite(R).all() and np.isfinite(translation).all()):
        return None
    return R, translation[:, 0] / np.linalg.norm(translation)


def two_view(
    first: Float[np.ndarray, "m 2"],
    second: Float[np.ndarray, "m 2"],
    intrinsics: Float[np.ndarray, " 4"],
    config: OdometryConfig,
    guess: tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]] | None = None,
) -> TwoView | None:
    """Motion between two views by RANSAC and refinement.

    Few or poor matches often fit two motions that lie far apart. A `guess` of rotation and direction competes as a second
    start, and motions are compared by their loss with a bounded prior about its direction.

    Returns:
        The better motion; None where there are too few matches or inliers.
    """
    if len(first) < config.least_inliers:
        return None
    found = essential_by_consensus(first, second, intrinsics, config)
    starts = [start for start in (found, guess) if start is not None]
    ray_first, ray_second = rays(first, intrinsics), rays(second, intrinsics)
    candidates = []
    for R, direction in starts:
        view = refine(R, direction, ray_first, ray_second, intrinsics, config.threshold)
        rho = depths(view.R, view.direction, ray_first, ray_second)
        behind = (rho.min(axis=1) < 0) & view.inliers
        if behind.sum() > 0.5 * view.inliers.sum():  # the mirrored translation: all points change sides
            direction = -view.direction
            view = TwoView(view.R, direction, mirrored(view.covariance, direction), view.inliers, view.scale, view.cost)
        candidates.append(view)
    good = [view for view in candidates if view.inliers.sum() >= config.least_inliers]
    if not good:
        return None
    return min(good, key=lambda view: 2.0 * len(first) * view.cost + direction_penalty(view, guess))


def direction_penalty(view: TwoView, guess: tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]] | None) -> float:
    """Surprise at the direction of a motion after that of the step before, nats; bounded, so that clear images decide."""
    if guess is None:
        return 0.0
    angle = float(np.arccos(np.clip(view.direction @ guess[1], -1.0, 1.0)))
    return min(0.5 * (angle / DIRECTION_SCALE) ** 2, DIRECTION_BOUND)


def mirrored(covariance: Float[np.ndarray, "5 5"], direction: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "5 5"]:
    """Covariance of the opposite direction, in the tangent of the new one."""
    turn = np.eye(5)
    turn[3:, 3:] = -tangent(direction).T @ tangent(-direction)
    return turn @ covariance @ turn.T
