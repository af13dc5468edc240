"""The figures of merit of an observation model, with intervals, from per-object and per-detection records.

Everything here takes arrays: what a model answered beside what was true (`nolbo_ppl.evaluation.model_evaluation` fills it).
Means "over categories" give every category the same weight, as the paper's Table 1 does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from nolbo_ppl._moved import renamed
from nolbo_ppl.evaluation.calibration_scores import calibration_estimates
from nolbo_ppl.evaluation.records import DetectionRecords, ObjectRecords
from nolbo_ppl.metrics.calibration import expected_calibration_error, top_label
from nolbo_ppl.metrics.detection import Matches, average_precision
from nolbo_ppl.metrics.intervals import IntervalEstimate, estimate, resample_weights, widened
from nolbo_ppl.metrics.statistics import Weights, by_group, mean_of_defined, weighted_mean, weighted_median
from nolbo_ppl.metrics.viewpoint_error import ACCURATE

REQUIRED = (
    "ap50",
    "map50",
    "category_accuracy",
    "acc_pi6",
    "med_err_deg",
    "acc_pi6_all",
    "voxel_iou",
    "voxel_iou_gain",
    "voxel_ap",
    "ece_objectness",
    "ece_class",
    "coverage90_orientation",
    "coverage90_position",
    "coverage90_latent",
)
"""The figures every evaluation reports."""
LEVEL = 0.9
"""Probability of the posterior regions whose coverage is reported."""
MIN_OBJECTNESS = 0.1
"""Least objectness of the detections whose calibration is judged: a host of near-zero ones would flatter the error."""


def score_intervals(
    objects: ObjectRecords,
    detections: DetectionRecords,
    scenes: int,
    symmetry: Sequence[int],
    rng: np.random.Generator,
    resamples: int = 500,
) -> dict[str, IntervalEstimate]:
    """Every figure with its 95 % interval: percentile bootstrap over scenes, proportions widened to Wilson's interval.

    Args:
        objects: answers at the true boxes; only objects that count.
        detections: matched detections.
        scenes: number of scenes.
        symmetry: declared symmetry of each category; `acc_pi6` and `med_err_deg` are means over those that have none.
        rng: draws the resamples.
        resamples: number of resamples.
    """
    weights = resample_weights(scenes, resamples, rng)
    plain = np.flatnonzero(np.asarray(symmetry) == 1)
    groups = len(symmetry)

    def pooled(value: Float[np.ndarray, " n"], *, proportion: bool = False, median: bool = False) -> IntervalEstimate:
        rows = np.isfinite(value)
        scene, kept = objects.scene[rows], value[rows]
        average = weighted_median if median else weighted_mean
        result = estimate(lambda w: average(kept, w[:, scene]), weights, len(kept))
        return widened(result) if proportion else result

    def over_categories(
        value: Float[np.ndarray, " n"], which: Int[np.ndarray, " k"], average: Callable[..., np.ndarray] = weighted_mean
    ) -> IntervalEstimate:
        rows = np.isfinite(value) & np.isin(objects.category, which)
        scene, kept, group = objects.scene[rows], value[rows], objects.category[rows]

        def statistic(w: Weights) -> Float[np.ndarray, " b"]:
            return mean_of_defined(by_group(average, kept, group, groups, w[:, scene]))

        return estimate(statistic, weights, len(kept))

    accurate, degrees = accurate_viewpoint(objects), np.degrees(objects.rotation_error)
    everything = np.arange(groups)
    found = detections.all
    result = {
        "ap50": estimate(lambda w: average_precision(found, w), weights, int(found.truths.sum())),
        "map50": estimate(lambda w: _mean_ap(detections.by_category, w), weights, _count(detections.by_category)),
        "category_accuracy": pooled(right_category(objects), proportion=True),
        "acc_pi6": over_categories(accurate, plain),
        "med_err_deg": over_categories(degrees, plain, weighted_median),
        "acc_pi6_all": over_categories(accurate, everything),
        "azimuth_acc_pi6": pooled(accurate_azimuth(objects), proportion=True),
        "voxel_iou": pooled(objects.voxel_iou),
        "voxel_iou_gain": pooled(objects.voxel_iou - objects.category_iou),
        "voxel_iou_ceiling": pooled(objects.teacher_iou),
        "voxel_ap": pooled(objects.voxel_ap),
        "ece_objectness": _objectness_error(found, weights),
        "ece_class": _class_error(objects, weights),
        **calibration_estimates(objects, found.select(judged(found)), weights, rng),
        "azimuth_crps_deg": pooled(np.degrees(objects.azimuth_crps)),
        "median_range_error": pooled(objects.range_error, median=True),
        "median_depth_error": pooled(objects.depth_error, median=True),
        "median_depth_error_known_size": pooled(objects.sized_depth_error, median=True),
    }
    assert set(REQUIRED) <= set(result)
    return result


def accurate_viewpoint(objects: ObjectRecords) -> Float[np.ndarray, " n"]:
    """1 where the viewpoint is within pi/6, 0 where it is not, NaN without a true one."""
    return np.where(np.isfinite(objects.rotation_error), objects.rotation_error < ACCURATE, np.nan)


def accurate_azimuth(objects: ObjectRecords) -> Float[np.ndarray, " n"]:
    """1 where the azimuth alone is within pi/6, 0 where it is not, NaN for symmetric objects and without a true one."""
    error = np.abs(objects.azimuth_error)
    return np.where(np.isfinite(error), error < ACCURATE, np.nan)


def right_category(objects: ObjectRecords) -> Float[np.ndarray, " n"]:
    """1 where the maximum-likelihood category is the true one, 0 where it is not, NaN without a true one."""
    return np.where(objects.category >= 0, objects.likeliest == objects.category, np.nan)


def inside(mass: Float[np.ndarray, " n"], level: float = LEVEL) -> Float[np.ndarray, " n"]:
    """1 where the truth is inside the region of that probability, 0 where it is outside, NaN without a truth."""
    return np.where(np.isfinite(mass), mass <= level, np.nan)


def _mean_ap(matches: Sequence[Matches], weights: Float[np.ndarray, "b scenes"]) -> Float[np.ndarray, " b"]:
    """Mean average precision over the categories that have a truth."""
    return mean_of_defined(np.stack([average_precision(one, weights) for one in matches], axis=1))


def _count(matches: Sequence[Matches]) -> int:
    return int(sum(one.truths.sum() for one in matches))


def _objectness_error(found: Matches, weights: Float[np.ndarray, "b scenes"]) -> IntervalEstimate:
    """Calibration error of objectness over the detections, right where they match a truth."""
    kept = judged(found)
    score, correct, scene = found.score[kept], found.correct[kept], found.scene[kept]
    return estimate(lambda w: expected_calibration_error(score, correct, w[:, scene]), weights, len(score), pivotal=True)


def judged(found: Matches) -> Bool[np.ndarray, " n"]:
    """Detections whose objectness is judged: certain enough to be seen, and not on an object that does not count."""
    return ~found.ignored & (found.score >= MIN_OBJECTNESS)


def _class_error(objects: ObjectRecords, weights: Float[np.ndarray, "b scenes"]) -> IntervalEstimate:
    """Top-label calibration error of the class posterior."""
    rows = objects.category >= 0
    confidence, right = top_label(objects.class_posterior[rows], objects.category[rows])
    scene = objects.scene[rows]
    return estimate(lambda w: expected_calibration_error(confidence, right, w[:, scene]), weights, len(scene), pivotal=True)


def category_table(objects: ObjectRecords, detections: DetectionRecords, categories: Sequence[str]) -> dict[str, dict[str, Any]]:
    """The figures of each category, and how many objects are behind them; None where nothing is to be measured."""
    table = {}
    for label, name in enumerate(categories):
        matches = detections.by_category[label]
        table[name] = {
            "objects": int(matches.truths.sum()),
            "ap50": _defined(average_precision(matches)[0]),
            **point_scores(objects.select(objects.category == label)),
        }
    return table


def difficulty_table(objects: ObjectRecords) -> dict[str, dict[str, Any]]:
    """The figures by visible share and by size of the box."""
    bands = {
        "visible 50-70 %": objects.visibility < 0.7,
        "visible 70-95 %": (objects.visibility >= 0.7) & (objects.visibility < 0.95),
        "visible 95-100 %": objects.visibility >= 0.95,
        "under 24 px": objects.side < 24,
        "24-48 px": (objects.side >= 24) & (objects.side < 48),
        "48 px and more": objects.side >= 48,
    }
    return {name: {"objects": int(rows.sum()), **point_scores(objects.select(rows))} for name, rows in bands.items()}


def point_scores(objects: ObjectRecords) -> dict[str, float | None]:
    """Point estimates over some objects, all together."""
    return {
        "category_accuracy": _mean(right_category(objects)),
        "acc_pi6": _mean(accurate_viewpoint(objects)),
        "med_err_deg": _median(np.degrees(objects.rotation_error)),
        "flips": _mean(flipped(objects)),
        "voxel_iou": _mean(objects.voxel_iou),
        "voxel_iou_gain": _mean(objects.voxel_iou - objects.category_iou),
        "voxel_ap": _mean(objects.voxel_ap),
        "coverage90_orientation": _mean(inside(objects.azimuth_mass)),
        "coverage90_position": _mean(inside(objects.position_mass)),
        "coverage90_latent": _mean(inside(objects.latent_mass)),
        "median_range_error": _median(objects.range_error),
        "median_depth_error_known_size": _median(objects.sized_depth_error),
    }


def flipped(objects: ObjectRecords) -> Float[np.ndarray, " n"]:
    """1 where the azimuth is within pi/6 of the opposite one (front taken for back), NaN for symmetric objects."""
    error = np.abs(objects.azimuth_error)
    return np.where(np.isfinite(error), error > math.pi - ACCURATE, np.nan)


def confusion(objects: ObjectRecords, categories: int) -> Int[np.ndarray, "labels labels"]:
    """Objects of each true category (row) by their maximum-likelihood category (column)."""
    rows = objects.category >= 0
    index = objects.category[rows] * categories + objects.likeliest[rows]
    return np.bincount(index, minlength=categories**2).reshape(categories, categories)


def _mean(value: Float[np.ndarray, " n"]) -> float | None:
    value = value[np.isfinite(value)]
    return float(value.mean()) if len(value) else None


def _median(value: Float[np.ndarray, " n"]) -> float | None:
    value = value[np.isfinite(value)]
    return float(np.median(value)) if len(value) else None


def _defined(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
