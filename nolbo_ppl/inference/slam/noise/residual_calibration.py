"""Scales against whole tracks: how wide residuals are, and how much one resembles the next.

Differences of consecutive detections (`noise`) understate errors that change slowly, as those of real detectors do: one
view of an object gives one error, not thirty. Residuals about the solved tracks show them. Their width corrects the
scale; their correlation from one detection to the next says how many independent ones there are, and the graph divides
the information by that number.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.geometry.pose import inverse, relative, so3_log, transform
from nolbo_ppl.inference.slam.noise.noise_estimation import TOO_SMALL, robust_scale
from nolbo_ppl.inference.slam.orientation import nearest_of_modes
from nolbo_ppl.inference.slam.slam_state import SlamState

CLIP = 3.0
"""Whitened residuals are clipped here before they are correlated."""
LARGEST_FACTOR = 20.0
"""Most that correlation may widen covariances."""
UNSTATED_FACTOR, UNSTATED_ROTATION_FACTOR = 4.0, 16.0
"""Least factors where nobody stated a scale: detectors are biased by view, most of all in orientation, which residuals about
one track do not show."""
POOR_DEPTH = 1.5
"""Depth this many times as noisy as directions is that of a camera: then it is biased as well, and its factor grows."""
LEAST_DETECTIONS = 30
"""Fewer residuals than this calibrate nothing."""


def correlation_factor(whitened: Float[np.ndarray, "k c"], track: Int[np.ndarray, " k"], frame: Int[np.ndarray, " k"]) -> float:
    """Factor on covariances that makes up for correlated errors: `(1 + r) / (1 - r)` of a first-order process, at least 1."""
    order = np.lexsort((frame, track))
    z = np.clip(whitened[order], -CLIP, CLIP)
    follows = (np.diff(track[order]) == 0) & (np.diff(frame[order]) <= 2)
    if follows.sum() < LEAST_DETECTIONS:
        return 1.0
    product, square = z[:-1][follows] * z[1:][follows], 0.5 * (z[:-1][follows] ** 2 + z[1:][follows] ** 2)
    r = float(product.mean() / max(square.mean(), 1e-12))
    if r < 0.2:  # short tracks alone give a little
        return 1.0
    length = len(z) / max(len(np.unique(track)), 1)
    return float(min((1 + r) / (1 - min(r, 0.99)), LARGEST_FACTOR, max(length, 1.0)))


def _width(whitened: np.ndarray, count: np.ndarray) -> float:
    """Robust scale of whitened residuals, the part a track's own mean takes away given back; NaN without enough."""
    use = count >= 3
    if use.sum() < LEAST_DETECTIONS:
        return float("nan")
    return robust_scale((whitened[use] / np.sqrt(1 - 1 / count[use])[:, None]).ravel())


def unstated_range_factor(report: dict[str, float], distance: float) -> float:
    """Least factor along the ray: as across it where depth is as good as directions, up to four times that where it is not."""
    if "position_radial" not in report:
        return UNSTATED_FACTOR
    lateral, radial = (report[f"position_{k}"] + report[f"position_{k}_ratio"] * distance for k in ("lateral", "radial"))
    return UNSTATED_FACTOR * float(np.clip((radial / max(lateral, 1e-12) / POOR_DEPTH) ** 2, 1.0, 4.0))


def calibrate(state: SlamState) -> SlamState:
    """Widen position and rotation scales to the residuals about the solved tracks, and account for their correlation.

    Scales the user stated are widened only when they are too small by more than a third (reported) and `correct_scales`.
    """
    table, rows = state.problem.observations, state.rows
    noise, config = state.noise, state.config
    if len(rows) < LEAST_DETECTIONS:
        if not np.isfinite(table.position_covariance[rows]).any():
            along = unstated_range_factor(noise.report, state.typical_range)
            noise = replace(noise, position_factor=UNSTATED_FACTOR, range_factor=along, rotation_factor=UNSTATED_ROTATION_FACTOR)
        return replace(state, noise=noise)
    frame = table.frame[rows]
    count = np.bincount(state.landmark, minlength=len(state.static))[state.landmark].astype(np.float64)
    report, warnings = dict(noise.report), list(noise.warnings)
    predicted = transform(inverse(state.estimate.T_world_camera[frame]), state.estimate.T_world_landmark[state.landmark, :3, 3])
    whitening = np.linalg.inv(np.linalg.cholesky(noise.position_covariance[rows]))
    z = np.einsum("kij,kj->ki", whitening, table.position[rows] - predicted)
    ratio = _width(z, count)
    stated = np.isfinite(table.position_covariance).all(axis=(1, 2))
    factor = np.where(
        stated,
        _stated_factor(ratio, "position", stated[rows], config.correct_scales, warnings),
        np.nan_to_num(max(ratio, 1.0), nan=1.0),
    )
    report["position_track_width"] = ratio
    across, along = (
        (1.0, 1.0) if stated[rows].any() else (UNSTATED_FACTOR, unstated_range_factor(noise.report, state.typical_range))
    )
    report["position_correlation_factor"] = position_factor = correlation_factor(z, state.landmark, frame)
    noise = replace(
        noise,
        position_covariance=noise.position_covariance * (factor**2)[:, None, None],
        position_factor=max(position_factor, across),
        range_factor=max(position_factor, along),
    )
    oriented = np.flatnonzero(table.has_rotation[rows])
    if len(oriented) >= LEAST_DETECTIONS:
        k, j = rows[oriented], state.landmark[oriented]
        R = relative(state.estimate.T_world_camera[table.frame[k]], state.estimate.T_world_landmark[j])[:, :3, :3]
        seen = state.measurements.select(k)
        symmetry = seen.symmetry
        observed = nearest_of_modes(R, seen.modes, symmetry)
        w = so3_log(np.swapaxes(R, 1, 2) @ observed) / noise.rotation_scale[k][:, None]
        usable = symmetry != 0
        if usable.sum() >= LEAST_DETECTIONS:
            w, k, j = w[usable], k[usable], j[usable]
            ratio = max((_width(w[:, [c]], count[oriented][usable]) for c in range(3)), default=float("nan"))
            stated = np.isfinite(table.rotation_scale)
            factor = np.where(
                stated,
                _stated_factor(ratio, "rotation", stated[k], config.correct_scales, warnings),
                np.nan_to_num(max(ratio, 1.0), nan=1.0),
            )
            report["rotation_track_width"] = ratio
            least = 1.0 if stated[k].any() else UNSTATED_ROTATION_FACTOR
            report["rotation_correlation_factor"] = rotation_factor = max(correlation_factor(w, j, table.frame[k]), least)
            noise = replace(noise, rotation_scale=noise.rotation_scale * factor, rotation_factor=rotation_factor)
    clean = {name: value for name, value in report.items() if np.isfinite(value)}
    return replace(state, noise=replace(noise, report=clean, warnings=tuple(dict.fromkeys(warnings))))


def _stated_factor(ratio: float, name: str, stated: np.ndarray, correct: bool, warnings: list[str]) -> float:
    if not stated.any() or not np.isfinite(ratio) or ratio < TOO_SMALL:
        return 1.0
    if not any(w.startswith(f"stated {name} scales") for w in warnings):
        warnings.append(f"stated {name} scales are too small: residuals about whole tracks are {ratio:.2f} times as wide")
    return ratio if correct else 1.0
