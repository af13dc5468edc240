"""Whether a landmark exists: the ratio of marginal likelihoods of an object there and of clutter, missed detections counted."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from nolbo_ppl.inference.slam.detection_pairs import DetectionPairs
from nolbo_ppl.inference.slam.exposures import Exposures
from nolbo_ppl.inference.slam.frame_model import PROBABILITY_LIMITS, FrameModel
from nolbo_ppl.inference.slam.measurements import Measurements
from nolbo_ppl.inference.slam.slam_state import SlamState

NO_EVIDENCE = -50.0
"""Log odds of a landmark that no detection speaks for."""
MIN_LANDMARKS = 10
"""Landmarks of three scores or more that a correlation of scores is measured on."""


def score_correlation(measurements: Measurements, pairs: DetectionPairs, weight: Float[np.ndarray, " p"]) -> float:
    """Intraclass correlation of the scores' log odds within landmarks (one-way analysis of variance), from 0 to 0.95."""
    use = weight > 0.5
    score = (measurements.log_object - measurements.log_clutter)[pairs.row[use]]
    group = np.unique(pairs.landmark[use], return_inverse=True)[1]
    count = np.bincount(group)
    keep = count[group] >= 3
    if len(np.unique(group[keep])) < MIN_LANDMARKS:
        return 0.0
    score, group = score[keep], np.unique(group[keep], return_inverse=True)[1]
    count = np.bincount(group).astype(np.float64)
    mean = np.bincount(group, score) / count
    within = np.sum((score - mean[group]) ** 2) / max(len(score) - len(count), 1)
    between = np.sum(count * (mean - score.mean()) ** 2) / max(len(count) - 1, 1)
    typical = (count.sum() - np.sum(count**2) / count.sum()) / max(len(count) - 1, 1)
    return float(np.clip((between - within) / max(between + (typical - 1) * within, 1e-12), 0.0, 0.95))


def mean_score(model: FrameModel, hits: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    """Weight of each view's score evidence: n correlated looks are worth `n / (1 + r (n - 1))` independent ones."""
    return 1.0 / (1.0 + model.score_correlation * np.maximum(hits - 1.0, 0.0))


def existence_log_odds(
    state: SlamState,
    pairs: DetectionPairs,
    weight: Float[np.ndarray, " p"],
    model: FrameModel,
    exposures: Exposures,
    log_density: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " m"]:
    """Log odds of each landmark being an object rather than so many false detections.

    `log rho + log integral of prod N(x_k; l) dl + sum s_k + log P(hits and misses) - sum log lambda_clutter(x_k)`, with the
    density rho of objects, score ratios s_k, and the beta-binomial probability of being detected in just these of all frames
    that had it in view. Features of false detections are independent draws of the population, those of an object alike.
    Soft weights enter as exponents, with their entropy (the variational bound of each frame's sum).
    """
    seen, m = state.measurements, len(state.estimate.T_world_landmark)
    k, j = pairs.row, pairs.landmark
    hits = np.bincount(j, weight, minlength=m).astype(np.float64)
    probability = np.clip(model.probability(pairs.local), *PROBABILITY_LIMITS)
    log_clutter = model.log_clutter(seen, log_density)[k]
    score = model.log_score_ratio(seen)[k] * mean_score(model, hits)[j]
    safe = np.clip(weight, 1e-12, 1 - 1e-12)
    entropy = -safe * np.log(safe) - (1 - safe) * np.log1p(-safe)
    # What placed the landmark lies about it by the sensor's covariance, the place integrated out below. What did not is
    # predicted: the map's own uncertainty is part of its gap, and it says nothing of the place yet.
    inside = np.minimum(weight, pairs.member)
    log_position = inside * pairs.log_residual + (weight - inside) * pairs.log_position
    value = np.bincount(j, log_position + weight * (score - log_clutter) + entropy, minlength=m).astype(np.float64)
    # Each ratio is that of one detection given all others; of n in a row, the first has none before it.
    value += np.bincount(j, weight * pairs.log_feature, minlength=m) * np.maximum(hits - 1, 0) / np.maximum(hits, 1)
    log_object = model.log_objects(seen, log_density)[k] - np.log(probability)
    value += np.bincount(j, weight * log_object, minlength=m) / np.maximum(hits, 1e-9)
    information = np.tile(1e-9 * np.eye(3), (m, 1, 1))
    R = state.estimate.T_world_camera[seen.frame[k], :3, :3]
    # What hardly any detection speaks for is as large as one detection: else its volume, and its odds, would be without bound.
    placed = np.bincount(j, inside, minlength=m)
    whole = np.where(placed[j] > 1e-6, inside / np.clip(placed, 1e-12, 1.0)[j], weight / np.clip(hits, 1e-12, 1.0)[j])
    np.add.at(information, j, whole[:, None, None] * (R @ np.linalg.inv(seen.covariance[k]) @ np.swapaxes(R, 1, 2)))
    value += 1.5 * np.log(2 * np.pi) - 0.5 * np.linalg.slogdet(information)[1]
    number, mean = exposures.totals(model)
    value += model.log_pattern(hits, np.maximum(number, hits), mean)
    return np.where(hits > 1e-6, value, NO_EVIDENCE)


def contribution(
    state: SlamState,
    pairs: DetectionPairs,
    weight: Float[np.ndarray, " p"],
    model: FrameModel,
    exposures: Exposures,
    log_density: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " p"]:
    """What each pair adds to its landmark's log odds of existing: taken off, the landmark is judged without the detection."""
    seen, m = state.measurements, len(state.estimate.T_world_landmark)
    k, j = pairs.row, pairs.landmark
    hits = np.bincount(j, weight, minlength=m).astype(np.float64)
    number, mean = exposures.totals(model)
    number = np.maximum(number, hits)
    without = np.maximum(hits[j] - weight, 0.0)
    pattern = model.log_pattern(hits, number, mean)[j] - model.log_pattern(without, number[j], mean[j])
    score = model.log_score_ratio(seen)[k] * mean_score(model, hits)[j]
    return weight * (pairs.log_position + pairs.log_feature + score - model.log_clutter(seen, log_density)[k]) + pattern


def detected_log_odds(
    state: SlamState,
    pairs: DetectionPairs,
    weight: Float[np.ndarray, " p"],
    model: FrameModel,
    exposures: Exposures,
    log_odds_without: Float[np.ndarray, " p"],
) -> Float[np.ndarray, " p"]:
    """`log r P_D / (1 - r P_D)` of each pair: existence r and detection probability as the other frames show them."""
    m = len(state.estimate.T_world_landmark)
    hits = np.bincount(pairs.landmark, weight, minlength=m).astype(np.float64)
    number, _ = exposures.totals(model)
    here = np.clip(model.probability(pairs.local), *PROBABILITY_LIMITS)
    others = np.maximum(hits[pairs.landmark] - weight, 0.0)
    total = np.maximum(np.maximum(number, hits)[pairs.landmark] - 1.0, others)
    probability = (model.concentration * here + others) / (model.concentration + total)
    probability = np.clip(probability, *PROBABILITY_LIMITS)
    existence = 1.0 / (1.0 + np.exp(-np.clip(log_odds_without, -500, 500)))
    detected = np.maximum(existence * probability, 1e-300)
    return np.log(detected) - np.log1p(-detected)
