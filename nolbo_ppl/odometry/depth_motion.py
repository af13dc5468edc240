"""Motion between two views with depth: points of the earlier view seen again in the later one, all six degrees in metres.

Corners with a depth are points. The motion is the robust maximum of the likelihood of where they are seen again and, where the
later view has a depth as well, how far away: errors of both corners and both depths are carried into the residual of a match,
so that neither a reprojection that trusts depths blindly nor an alignment of points that trusts far ones is made.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from nolbo_ppl.geometry.pose import inverse, make_pose, se3_exp, skew, transform
from nolbo_ppl.odometry.epipolar import FREEDOM, GATE, MAD, MIN_SCALE, rays
from nolbo_ppl.odometry.odometry_config import MeasuredDepth, OdometryConfig

CORNER_SCALE = 0.5
"""Standard deviation of a corner at first, px; the residuals tell it then."""
EDGE_STEP = 0.1
"""A corner whose neighbours' inverse depths differ from a plane's by this share lies on an edge: nobody knows on which side."""
MIN_DEPTHS = 5
"""Of the nine pixels about a corner, so many must have a depth."""
MIN_DEPTH = 0.05
"""Points nearer than this to a camera are none, m."""
CLEAR = 0.6
"""A motion that more of the matches obey needs no other start."""
CLOSE = 3e-6
"""A step of Gauss and Newton this small, rad and m, is the last."""


@dataclass(frozen=True)
class DepthView:
    """Motion between two views with depth."""

    T_earlier_later: Float[np.ndarray, "4 4"]
    """Pose of the later camera in the earlier one, m."""
    covariance: Float[np.ndarray, "6 6"]
    """Of `Log(T_earlier_later^-1 T_true)`, [rotation rad, translation m]."""
    inliers: Bool[np.ndarray, " m"]
    """Which matches obey it; those without a depth in the earlier view do not count."""


def depth_at(depth: Float[np.ndarray, "h w"], pixels: Float[np.ndarray, "n 2"], zoom: float = 1.0) -> Float[np.ndarray, " n"]:
    """Depth at corners, m, NaN where nothing or an edge is: the inverse depth of a plane through the nine pixels about each.

    Inverse depth is linear in the image of a plane, so its slope costs nothing, and the noise of nine pixels is averaged.

    Args:
        depth: along the optical axis, m; 0 or NaN unknown.
        pixels: corners in continuous coordinates of the image, whose first pixel has its centre at (0.5, 0.5).
        zoom: pixels of the depth to one of the image.

    Example:
        >>> depth_at(np.full((4, 4), 2.0), np.array([[2.0, 2.0]])).round(6).tolist()
        [2.0]
    """
    height, width = depth.shape
    place = np.asarray(pixels, dtype=np.float64) * zoom - 0.5
    nearest = np.floor(place + 0.5).astype(np.int64)
    inside = np.asarray(((nearest >= 0) & (nearest < [width, height])).all(axis=1))
    across, up = np.meshgrid([-1, 0, 1], [-1, 0, 1])
    u, v = nearest[:, :1] + across.ravel(), nearest[:, 1:] + up.ravel()
    known = inside[:, None] & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    values = depth[v.clip(0, height - 1), u.clip(0, width - 1)]
    known &= np.isfinite(values) & (values > MIN_DEPTH)
    rho = np.where(known, 1.0 / np.where(known, values, 1.0), np.nan)
    count = known.sum(axis=1)
    use = (count >= MIN_DEPTHS) & known[:, 4]
    found = np.full(len(place), np.nan)
    if not use.any():
        return found
    rho, weight, offset = rho[use], known[use].astype(np.float64), place[use] - nearest[use]
    if np.isnan(rho).any():
        rho = np.where(np.isnan(rho), rho[:, 4:5], rho)
    steps = rho.max(axis=1) - rho.min(axis=1)
    # A plane that is seen at a slant has steps too, but even ones: what is judged is what a plane leaves.
    design = np.column_stack([np.ones(9), across.ravel(), up.ravel()]).astype(np.float64)
    normal = np.einsum("ni,ij,ik->njk", weight, design, design) + 1e-9 * np.eye(3)
    plane = np.linalg.solve(normal, np.einsum("ni,ni,ij->nj", weight, rho, design)[..., None])[..., 0]
    left = np.abs((rho - plane @ design.T) * weight).max(axis=1)
    value = plane[:, 0] + np.sum(plane[:, 1:] * offset, axis=1)
    good = (left < EDGE_STEP * rho[:, 4]) & (steps < 3 * EDGE_STEP * rho[:, 4]) & (value > 0)
    found[np.flatnonzero(use)[good]] = 1.0 / value[good]
    return found


@dataclass(frozen=True)
class DepthMatches:
    """Matches of which the earlier corner has a depth."""

    first: Float[np.ndarray, "m 2"]
    """Corners of the earlier view, px."""
    second: Float[np.ndarray, "m 2"]
    """The same of the later view, px."""
    depth_first: Float[np.ndarray, " m"]
    """Depth of the earlier corner, m."""
    depth_second: Float[np.ndarray, " m"]
    """Depth of the later corner, m; NaN where it is not known."""

    def __len__(self) -> int:
        return len(self.first)


def residuals(
    T_earlier_later: Float[np.ndarray, "4 4"], matches: DepthMatches, intrinsics: Float[np.ndarray, " 4"], noise: MeasuredDepth
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3 6"], Bool[np.ndarray, " m"]]:
    """Whitened residuals [u, v, inverse depth] of the later view and their Jacobian by `T Exp(x)`; the last is 0 without depth.

    The third is what is left of the inverse depth given the other two (Cholesky). Also which points lie before the camera.
    """
    fx, fy = intrinsics[:2]
    ray = rays(matches.first, intrinsics)
    later = transform(inverse(T_earlier_later), ray * matches.depth_first[:, None])
    before = later[:, 2] > MIN_DEPTH
    X, Y, Z = np.where(before[:, None], later, [0.0, 0.0, 1.0]).T
    seen = np.isfinite(matches.depth_second)
    rho = 1.0 / np.where(seen, matches.depth_second, 1.0)
    residual = np.column_stack([fx * X / Z + intrinsics[2], fy * Y / Z + intrinsics[3], 1.0 / Z])
    residual -= np.column_stack([matches.second, rho])
    zero = np.zeros_like(Z)
    by_point = np.stack(
        [
            np.column_stack([fx / Z, zero, -fx * X / Z**2]),
            np.column_stack([zero, fy / Z, -fy * Y / Z**2]),
            np.column_stack([zero, zero, -1.0 / Z**2]),
        ],
        axis=1,
    )
    point = np.column_stack([X, Y, Z])
    # Of T Exp(x) the point in the later camera is Exp(-x) Y = Y + [Y]x w - v.
    jacobian = np.concatenate([by_point @ skew(point), -by_point], axis=2)
    lift = np.zeros((len(ray), 3, 3))  # the earlier point by its corner and its depth
    lift[:, 0, 0], lift[:, 1, 1] = matches.depth_first / fx, matches.depth_first / fy
    lift[:, :, 2] = ray
    by_source = by_point @ T_earlier_later[:3, :3].T @ lift
    source = np.stack([np.full(len(ray), CORNER_SCALE**2)] * 2 + [noise.scale(matches.depth_first) ** 2], axis=1)
    later_depth = noise.scale(np.where(seen, matches.depth_second, 1.0)) * rho**2
    covariance = (by_source * source[:, None, :]) @ np.swapaxes(by_source, 1, 2)
    covariance[:, [0, 1], [0, 1]] += CORNER_SCALE**2
    covariance[:, 2, 2] += later_depth**2
    factor = np.linalg.cholesky(covariance)
    both = np.linalg.solve(factor, np.concatenate([residual[:, :, None], jacobian], axis=2))
    both[~seen, 2] = 0.0
    return both[:, :, 0], both[:, :, 1:], before


def scales_of(residual: Float[np.ndarray, "k 3"], seen: Bool[np.ndarray, " k"]) -> Float[np.ndarray, " 3"]:
    """Robust scales of the whitened residuals: one of both corners, one of the depth."""
    corner = MAD * float(np.median(np.abs(residual[:, :2])))
    least = MIN_SCALE / CORNER_SCALE
    depth = MAD * float(np.median(np.abs(residual[seen, 2]))) if seen.sum() > 2 else 1.0
    return np.maximum(np.array([corner, corner, depth]), least)


def refine_depth_motion(
    T_earlier_later: Float[np.ndarray, "4 4"],
    matches: DepthMatches,
    intrinsics: Float[np.ndarray, " 4"],
    noise: MeasuredDepth,
    iterations: int = 15,
) -> DepthView | None:
    """Iteratively reweighted Gauss-Newton with the weights of Student's t from a first guess.

    Returns:
        The motion, its inliers and the covariance of the robust estimate (sandwich of the weights' slopes and the residuals'
        own variances, Huber 1981, section 7.6); None where the matches leave a direction open.
    """
    seen, T = np.isfinite(matches.depth_second), T_earlier_later
    freedom = 2.0 + seen
    scale: Float[np.ndarray, " 3"] | None = None
    for count in range(iterations + 1):
        residual, jacobian, before = residuals(T, matches, intrinsics, noise)
        if before.sum() < 4:
            return None
        if scale is None:
            scale = scales_of(residual[before], seen[before])
            inside = before
        square = np.sum((residual / scale) ** 2, axis=1)
        inside = before & (square < GATE**2 * freedom / 2.0)
        if inside.sum() < 4:
            return None
        scale = scales_of(residual[inside], seen[inside])
        square = np.sum((residual / scale) ** 2, axis=1)
        weight = np.where(inside, (FREEDOM + freedom) / (FREEDOM + square), 0.0)
        r, J = residual / scale, jacobian / scale[:, None]
        rows = J.reshape(-1, 6)
        pulled = rows * np.repeat(weight, 3)[:, None]
        normal = pulled.T @ rows
        if count == iterations:
            break
        if np.linalg.cond(normal) > 1e14:
            return None
        step = -np.linalg.solve(normal, pulled.T @ r.ravel())
        if np.abs(step).max() < CLOSE:
            break
        T = T @ se3_exp(step * min(1.0, 0.5 / max(float(np.abs(step).max()), 1e-12)))
    r, J, w, square, freedom, seen = r[inside], J[inside], weight[inside], square[inside], freedom[inside], seen[inside]
    outer = (J * r[:, :, None]).sum(axis=1)
    slope = 2.0 * (FREEDOM + freedom) / (FREEDOM + square) ** 2
    flat = J.reshape(-1, 6)
    bread = (flat * np.repeat(w, 3)[:, None]).T @ flat - (outer * slope[:, None]).T @ outer
    psi = w[:, None] * r
    rows = 2 * len(r) + int(seen.sum())
    if rows <= 6:
        return None
    corner, depth = np.mean(psi[:, :2] ** 2), np.mean(psi[seen, 2] ** 2) if seen.any() else 1.0
    variance = np.array([corner, corner, depth]) * rows / (rows - 6)
    meat = (flat * np.tile(variance, len(r))[:, None]).T @ flat
    values, vectors = np.linalg.eigh(bread)
    if values[0] <= 1e-12 * values[-1]:
        return None
    inverse_bread = (vectors / values) @ vectors.T
    return DepthView(T, inverse_bread @ meat @ inverse_bread, inside)


def first_guesses(
    matches: DepthMatches, intrinsics: Float[np.ndarray, " 4"], config: OdometryConfig
) -> list[Float[np.ndarray, "4 4"]]:
    """Starts: the perspective from points by consensus (deterministic), and no motion at all."""
    fx, fy, cx, cy = intrinsics
    camera = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    points = rays(matches.first, intrinsics) * matches.depth_first[:, None]
    found = [np.eye(4)]
    try:
        good, turn, shift, _ = cv2.solvePnPRansac(
            points,
            matches.second,
            camera,
            None,
            iterationsCount=min(config.iterations, 300),
            reprojectionError=3.0 * config.threshold,
            confidence=config.confidence,
            flags=cv2.SOLVEPNP_EPNP,
        )
    except cv2.error:  # a minimal solver that failed on every sample
        return found
    if good and np.isfinite(turn).all() and np.isfinite(shift).all():
        found.insert(0, inverse(make_pose(cv2.Rodrigues(turn)[0], shift[:, 0])))
    return found


def depth_motion(
    first: Float[np.ndarray, "m 2"],
    second: Float[np.ndarray, "m 2"],
    depth_first: Float[np.ndarray, " m"],
    depth_second: Float[np.ndarray, " m"],
    intrinsics: Float[np.ndarray, " 4"],
    noise: MeasuredDepth,
    config: OdometryConfig,
) -> DepthView | None:
    """Motion between two views of which corners have depths.

    Args:
        first: corners of the earlier view, px.
        second: the same of the later view, px.
        depth_first: depths of the earlier corners, m; NaN where they are not known.
        depth_second: depths of the later corners, m; NaN where they are not known.
        intrinsics: fx, fy, cx, cy, px.
        noise: of the depths.
        config: settings.

    Returns:
        The motion with most matches; None where fewer than `least_inliers` have a depth or obey it.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> camera, pixels = np.array([500.0, 500.0, 320.0, 240.0]), rng.uniform([50, 50], [590, 430], (80, 2))
        >>> depth = rng.uniform(1, 4, 80)
        >>> points = rays(pixels, camera) * depth[:, None] - [0.1, 0.0, 0.0]
        >>> later = points[:, :2] / points[:, 2:] * camera[:2] + camera[2:]
        >>> found = depth_motion(pixels, later, depth, points[:, 2], camera, MeasuredDepth(), OdometryConfig())
        >>> bool(np.allclose(found.T_earlier_later[:3, 3], [0.1, 0.0, 0.0], atol=1e-4))
        True
    """
    known = np.isfinite(depth_first)
    if known.sum() < config.least_inliers:
        return None
    matches = DepthMatches(first[known], second[known], depth_first[known], depth_second[known])
    best: DepthView | None = None
    for start in first_guesses(matches, intrinsics, config):
        found = refine_depth_motion(start, matches, intrinsics, noise)
        if found is None or found.inliers.sum() < config.least_inliers:
            continue
        if best is None or found.inliers.sum() > 1.1 * best.inliers.sum():
            best = found
        if best.inliers.sum() > CLEAR * len(matches):
            break
    if best is None:
        return None
    inliers = np.zeros(len(first), dtype=bool)
    inliers[np.flatnonzero(known)] = best.inliers
    return DepthView(best.T_earlier_later, best.covariance, inliers)
