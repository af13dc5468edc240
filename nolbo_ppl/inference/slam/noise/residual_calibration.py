"""Scales of detections against whole tracks: how wide residuals are, and how much one resembles the next.

Gaps between frames (`noise_estimation`) understate errors that change slowly, as those of real detectors do: one view of an
object gives one error, not thirty. Residuals about the solved tracks show them, compared with what the graph itself expects
after the fit. The width of single ones corrects the scale; the width of their sums over halves of tracks says how many
detections are worth one independent one, and the graph divides the information by that number.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from nolbo_ppl.inference.slam.graph import inflated
from nolbo_ppl.inference.slam.latent_mixture import resolved_latents
from nolbo_ppl.inference.slam.noise.fitted_residuals import (
    block_ratio,
    fitted_residuals,
    halves_of_tracks,
    robust_width,
    widths_by_ray,
)
from nolbo_ppl.inference.slam.noise.noise_estimation import MIN_RANGE_PART, TOO_SMALL, robust_scale
from nolbo_ppl.inference.slam.slam_state import SlamState

LARGEST_FACTOR = 20.0
"""Most that correlation may widen covariances."""
MIN_FACTOR = 0.05
"""Least factor on a scale nobody stated."""
UNSTATED_FACTOR, UNSTATED_ROTATION_FACTOR = 4.0, 16.0
"""What correlated errors are expected to cost where nobody stated a scale: detectors are biased by view, most of all in
orientation. A prior: it counts as `PRIOR_BLOCKS` halves of tracks do."""
PRIOR_BLOCKS = 8.0
"""Weight of this prior, in halves of tracks of objects seen in one pass: the bias of a pass does not show in it."""
BETWEEN_PRECISION = 1.2
"""Precision of what one pass tells of the log of a factor, where several passes of one object show it: a scale of 0.9."""
POOR_DEPTH = 1.5
"""Depth this many times as noisy as directions is that of a camera: then it is biased as well, and its factor grows."""
MIN_PASSES = 6
"""Fewer passes of objects that have several say nothing of what one pass hides."""
MIN_DETECTIONS = 30
"""Fewer residuals than this calibrate nothing."""


def shrunk_factor(measured: float, blocks: int, expected: float) -> float:
    """Factor on covariances: measured from halves of tracks, drawn in the log towards what is expected where they are few."""
    if expected == 1.0:  # stated scales are believed unless the data speak: two standard errors of a ratio of 3 x blocks squares
        measured *= max(1 - 2 * np.sqrt(2 / 3 / max(blocks, 1)), 0.0)
    log_factor = (blocks * np.log(max(measured, 1.0)) + PRIOR_BLOCKS * np.log(expected)) / (blocks + PRIOR_BLOCKS)
    return float(np.clip(np.exp(log_factor), 1.0, LARGEST_FACTOR))


def between_passes(factor: float, measured: float, blocks: int) -> float:
    """Factor of unstated scales drawn to what passes of one object show beside each other: the random effect of a view.

    A sum over three components of so many passes is a scaled chi-square; its log has a precision of 1.5 a pass.

    Args:
        factor: from single passes (`shrunk_factor`).
        measured: squared ratio of sums over whole passes of objects that have several.
        blocks: passes it was measured on.
    """
    precision = 1.5 * blocks if blocks >= MIN_PASSES else 0.0
    log_factor = (precision * np.log(max(measured, 1.0)) + BETWEEN_PRECISION * np.log(factor)) / (precision + BETWEEN_PRECISION)
    return float(np.clip(np.exp(log_factor), 1.0, LARGEST_FACTOR))


def rows_of_several_passes(state: SlamState, row: Int[np.ndarray, " k"]) -> Bool[np.ndarray, " k"]:
    """Which rows of the graph are of landmarks that two tracks or more placed."""
    track, landmark = state.tracklets.of_observation[state.rows], state.landmark
    placed = np.unique(np.stack([landmark, track], axis=1)[(state.weight > 0.5) & (track >= 0)], axis=0)
    passes = np.bincount(placed[:, 0], minlength=int(landmark.max(initial=-1)) + 1)
    return passes[landmark[row]] >= 2


def unstated_range_factor(report: dict[str, float], distance: float) -> float:
    """Expected factor along the ray: as across it where depth is as good as directions, up to four times that where it is not."""
    if "position_radial" not in report:
        return UNSTATED_FACTOR
    lateral, radial = (report[f"position_{k}"] + report[f"position_{k}_ratio"] * distance for k in ("lateral", "radial"))
    return UNSTATED_FACTOR * float(np.clip((radial / max(lateral, 1e-12) / POOR_DEPTH) ** 2, 1.0, 4.0))


def position_stated(state: SlamState) -> np.ndarray:
    """Whether each detection's position has a scale that somebody stated, by itself or in the configuration."""
    stated = np.isfinite(state.problem.observations.position_covariance).all(axis=(1, 2))
    return stated | (state.config.position_scale is not None) | (state.config.position_ratio is not None)


def calibrate(state: SlamState) -> SlamState:
    """Fit position and rotation scales to the residuals about the solved tracks, and account for their correlation.

    Scales nobody stated go up and down. Stated ones are raised only when they are too small by more than a third (reported)
    and `correct_scales`; too wide ones are reported.
    """
    noise, config = state.noise, state.config
    stated, rotation_stated = position_stated(state), np.isfinite(state.problem.observations.rotation_scale)
    rotation_stated |= config.rotation_scale is not None
    along = unstated_range_factor(noise.report, state.typical_range)
    if len(state.rows) < MIN_DETECTIONS:
        if not stated[state.rows].any():
            noise = replace(noise, position_factor=UNSTATED_FACTOR, range_factor=along, rotation_factor=UNSTATED_ROTATION_FACTOR)
        return replace(state, noise=noise)
    report, warnings = dict(noise.report), list(noise.warnings)
    found = fitted_residuals(state, np.random.default_rng([config.seed, 15485863]))
    rows = state.rows[found.row]
    track = state.tracklets.of_observation[rows]
    block, several = halves_of_tracks(track, state.problem.observations.frame[rows]), rows_of_several_passes(state, found.row)
    position, expected = found.observation[:, 3:], found.observation_expected[:, 3:]
    if len(rows) >= MIN_DETECTIONS:
        # The graph's covariances hold the factors in use; what is measured is relative to them.
        used = (noise.position_factor**2 * noise.range_factor) ** (1 / 3)
        ratio = _width(position, expected) * np.sqrt(used)
        report["position_track_width"] = ratio
        change = _change(ratio, "position", stated[rows], config.correct_scales, warnings)
        # Where nobody stated them, directions and depth are told apart: gaps between frames hold the odometry's steps as well.
        in_use = zip(widths_by_ray(found), (noise.position_factor, noise.range_factor))
        across, along_ray = (width**2 * own if np.isfinite(width) else change[1] ** 2 for width, own in in_use)
        least = MIN_FACTOR**2
        free = inflated(noise.position_covariance, state.problem.observations.position, max(across, least), max(along_ray, least))
        covariance = np.where(stated[:, None, None], noise.position_covariance * change[0] ** 2, free)
        floor = (MIN_RANGE_PART * state.typical_range) ** 2 * np.eye(3)
        covariance = np.where(stated[:, None, None], covariance, covariance + floor)
        measured, blocks = block_ratio(position, expected, block)
        # Widths of single residuals are given to the scale; what is left of the sums is correlation.
        report["position_correlation_factor"] = measured
        if stated[rows].mean() > 0.5:
            factor = along_factor = shrunk_factor(measured, blocks, 1.0)
        else:
            between = block_ratio(position[several], expected[several], track[several])
            factor, along_factor = (
                between_passes(shrunk_factor(measured, blocks, prior), between[0], between[1])
                for prior in (UNSTATED_FACTOR, along)
            )
        noise = replace(noise, position_covariance=covariance, position_factor=factor, range_factor=along_factor)
    whole = found.oriented.any(axis=1)
    if whole.sum() >= MIN_DETECTIONS:
        turn, turn_expected = found.observation[whole, :3], found.observation_expected[whole, :3]
        axes = found.oriented[whole]
        used = noise.rotation_factor
        widths = [
            _width(turn[axes[:, c], c], turn_expected[axes[:, c], c]) for c in range(3) if axes[:, c].sum() >= MIN_DETECTIONS
        ]
        ratio = max(widths, default=float("nan")) * np.sqrt(used)
        if np.isfinite(ratio):
            change = _change(ratio, "rotation", rotation_stated[rows[whole]], config.correct_scales, warnings)
            report["rotation_track_width"] = ratio
            scale = np.maximum(noise.rotation_scale * np.where(rotation_stated, change[0], change[1]), 1e-4)
            measured, blocks = block_ratio(turn * axes, turn_expected * axes[:, :, None], block[whole])
            report["rotation_correlation_factor"] = measured
            if rotation_stated[rows[whole]].mean() > 0.5:
                factor = shrunk_factor(measured, blocks, 1.0)
            else:
                several = several[whole]
                shown, passes = block_ratio(
                    (turn * axes)[several], (turn_expected * axes[:, :, None])[several], track[whole][several]
                )
                factor = between_passes(shrunk_factor(measured, blocks, UNSTATED_ROTATION_FACTOR), shown, passes)
            noise = replace(noise, rotation_scale=scale, rotation_factor=factor)
    ratio = latent_width(state)
    if np.isfinite(ratio):
        latent_stated = np.isfinite(state.problem.observations.latent_scale).all(axis=1) | (config.latent_scale is not None)
        change = _change(ratio, "latent", latent_stated[state.rows], config.correct_scales, warnings)
        report["latent_track_width"] = ratio
        noise = replace(noise, latent_scale=noise.latent_scale * np.where(latent_stated, change[0], change[1])[:, None])
    clean = {name: value for name, value in report.items() if np.isfinite(value)}
    return replace(state, noise=replace(noise, report=clean, warnings=tuple(dict.fromkeys(warnings))))


def latent_width(state: SlamState) -> float:
    """Scale of latents about their tracks' means, in units of their scales between views; NaN without enough of them."""
    rows = state.rows[(state.weight > 0.5) & state.problem.observations.has_latent[state.rows]]
    track = state.tracklets.of_observation[rows]
    count = np.bincount(track[track >= 0], minlength=len(state.tracklets)) if len(rows) else np.zeros(0, int)
    rows = rows[(track >= 0) & (count[track] >= 2)]
    if len(rows) < MIN_DETECTIONS:
        return float("nan")
    track = np.unique(state.tracklets.of_observation[rows], return_inverse=True)[1]
    seen, scale = state.measurements.select(rows), state.noise.latent_scale[rows]
    latent = resolved_latents(seen.latent, seen.latent_variance, seen.latent_modes, track, np.ones(len(rows)))
    precision, total = (np.zeros((track.max() + 1, latent.shape[1])) for _ in range(2))
    np.add.at(precision, track, scale**-2.0)
    np.add.at(total, track, latent / scale**2)
    left = (1 - scale**-2.0 / precision[track]) * (1.0 - (state.config.latent_correlation or 0.0))
    return robust_scale(((latent - (total / precision)[track]) / scale / np.sqrt(np.maximum(left, 1e-9))).ravel())


def _width(residual: Float[np.ndarray, " ..."], expected: Float[np.ndarray, " ..."]) -> float:
    return robust_width(residual.ravel(), expected.reshape(residual.size, -1))


def _change(ratio: float, name: str, stated: Int[np.ndarray, " k"], correct: bool, warnings: list[str]) -> tuple[float, float]:
    """Factors on stated and on unstated scales for residuals this wide, with a word where stated ones are wrong."""
    if not np.isfinite(ratio):
        return 1.0, 1.0
    free = max(ratio, MIN_FACTOR)
    if not stated.any():
        return 1.0, free
    raised = [w for w in warnings if w.startswith(f"stated {name} scales are too small: gaps between frames")]
    if raised and correct and ratio < 1:
        # Gaps between frames spoke for it, whole tracks know better: not below what was stated.
        factor = float(raised[0].split()[-4])
        if ratio * factor < TOO_SMALL:
            warnings.remove(raised[0])
        return max(ratio, 1 / factor), free
    if ratio > TOO_SMALL:
        if not any(w.startswith(f"stated {name} scales are too small") for w in warnings):
            warnings.append(f"stated {name} scales are too small: residuals about whole tracks are {ratio:.2f} times as wide")
        return (ratio if correct else 1.0), free
    if ratio < 1 / TOO_SMALL:
        text = f"stated {name} scales are too wide: residuals about whole tracks are {ratio:.2f} times as wide"
        warnings[:] = [w for w in warnings if not w.startswith(f"stated {name} scales are too wide")] + [text]
    return 1.0, free
