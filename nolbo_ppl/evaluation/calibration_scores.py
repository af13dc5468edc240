"""Calibration of an observation model at all levels: coverage and probability integral transforms of its regions, log scores of
everything it states, calibration errors beside those of a perfect forecaster."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from nolbo_ppl.evaluation.records import ObjectRecords
from nolbo_ppl.metrics.calibration import top_label
from nolbo_ppl.metrics.detection import Matches
from nolbo_ppl.metrics.intervals import IntervalEstimate, estimate, widened
from nolbo_ppl.metrics.stated_probabilities import (
    LEVELS,
    LIMIT,
    debiased_calibration_error,
    null_calibration_error,
    probability_record,
    region_record,
)
from nolbo_ppl.metrics.statistics import weighted_mean

MASSES = {
    "orientation": "azimuth_mass",
    "tilt": "tilt_mass",
    "position": "position_mass",
    "position_tails": "position_tails_mass",
    "latent": "latent_mass",
    "latent_gaussian": "latent_gaussian_mass",
}
"""Regions whose coverage is reported, and where their masses stand in the records."""
LOG_DENSITIES = {
    "azimuth": "azimuth_log_density",
    "position": "position_log_density",
    "position_tails": "position_tails_log_density",
    "latent": "latent_log_density",
    "latent_gaussian": "latent_gaussian_log_density",
}
"""Densities whose log scores are reported."""
NULL_DRAWS = 200
"""Draws of a perfect forecaster."""


def calibration_estimates(
    objects: ObjectRecords, found: Matches, weights: Float[np.ndarray, "b scenes"], rng: np.random.Generator
) -> dict[str, IntervalEstimate]:
    """Figures of calibration with their 95 % intervals (those of `ece_..._if_perfect`: of the perfect forecaster's error).

    Args:
        objects: answers at the true boxes.
        found: detections whose objectness is judged.
        weights: how often each scene is in each resample.
        rng: draws the perfect forecaster's outcomes.
    """

    def pooled(value: Float[np.ndarray, " n"], scene: np.ndarray, proportion: bool = False) -> IntervalEstimate:
        rows = np.isfinite(value)
        kept, of = value[rows], scene[rows]
        result = estimate(lambda w: weighted_mean(kept, w[:, of]), weights, len(kept))
        return widened(result) if proportion else result

    out: dict[str, IntervalEstimate] = {}
    for name, field in MASSES.items():
        mass = getattr(objects, field)
        for level in LEVELS:
            inside = np.where(np.isfinite(mass), mass <= level, np.nan)
            out[f"coverage{100 * level:g}_{name}"] = pooled(inside, objects.scene, proportion=True)
    for name, field in LOG_DENSITIES.items():
        out[f"{name}_log_score"] = pooled(-getattr(objects, field), objects.scene)
    labelled = objects.category >= 0
    of_truth = np.take_along_axis(objects.class_posterior[labelled], objects.category[labelled][:, None], 1)[:, 0]
    out["class_log_score"] = pooled(-np.log(np.maximum(of_truth, LIMIT)), objects.scene[labelled])
    stated = np.clip(found.score, LIMIT, 1 - LIMIT)
    out["objectness_log_score"] = pooled(-np.where(found.correct, np.log(stated), np.log1p(-stated)), found.scene)
    out["objectness_brier"] = pooled((found.score - found.correct) ** 2, found.scene)
    top, right = top_label(objects.class_posterior[labelled], objects.category[labelled])
    for name, confidence, outcome in (("objectness", np.minimum(found.score, 1.0), found.correct), ("class", top, right)):
        out[f"ece_{name}_if_perfect"] = perfect_error(confidence, rng)
        debiased = debiased_calibration_error(confidence, outcome)
        out[f"ece_{name}_debiased"] = IntervalEstimate(debiased if np.isfinite(debiased) else None, None, None, len(confidence))
    return out


def perfect_error(confidence: Float[np.ndarray, " n"], rng: np.random.Generator) -> IntervalEstimate:
    """Calibration error that a perfect forecaster of these confidences has by noise: its mean and where 95 % of it lie."""
    if not len(confidence):
        return IntervalEstimate(None, None, None, 0)
    null = null_calibration_error(confidence, rng, NULL_DRAWS)
    low, high = np.quantile(null, [0.025, 0.975])
    return IntervalEstimate(float(null.mean()), float(low), float(high), len(confidence))


def calibration_table(objects: ObjectRecords, judged: Matches) -> dict[str, dict[str, Any]]:
    """Regions and probabilities in full, as metrics.json holds them: transforms, coverage, reliability, scores."""
    labelled = objects.category >= 0
    top, right = top_label(objects.class_posterior[labelled], objects.category[labelled])
    probabilities = {
        "objectness": probability_record(np.minimum(judged.score, 1.0), judged.correct.astype(np.float64)),
        "class": probability_record(top, right.astype(np.float64)),
    }
    return {
        "regions": {name: region_record(getattr(objects, field)) for name, field in MASSES.items()},
        "probabilities": probabilities,
    }
