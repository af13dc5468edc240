"""Figures on labelled photographs, of which not everything is labelled.

Objects of 24 px and more count, crowds and difficult ones do not. A detection that matches nothing counts against a model
only where its category is labelled exhaustively in that image: elsewhere an unlabelled object is unknown. Average precision
is of objects of any category (pooled) and of each category with its own score; calibration is judged on the same detections,
from `MIN_OBJECTNESS` on.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from nolbo_ppl.data.converters.photographs import Photograph
from nolbo_ppl.errors import input_error
from nolbo_ppl.evaluation.calibration_scores import perfect_error
from nolbo_ppl.evaluation.scores import MIN_OBJECTNESS
from nolbo_ppl.metrics.calibration import expected_calibration_error
from nolbo_ppl.metrics.detection import Matches, average_precision, match
from nolbo_ppl.metrics.intervals import IntervalEstimate, estimate, resample_weights, widened
from nolbo_ppl.metrics.statistics import mean_of_defined, weighted_mean, weighted_median
from nolbo_ppl.metrics.viewpoint_error import ACCURATE

MIN_SIDE = 24.0
"""Longer side, px, from which on an object counts."""
CONFIDENT = 0.5
"""Objectness from which on a detection in an image without objects is a false one."""
SIZES = {"small (24-64 px)": (24.0, 64.0), "medium (64-160 px)": (64.0, 160.0), "large (160 px and more)": (160.0, np.inf)}
"""Bands of the longer side of objects."""


@dataclass(frozen=True)
class PhotographDetections:
    """What a model finds in one photograph."""

    box: Float[np.ndarray, "n 4"]
    objectness: Float[np.ndarray, " n"]
    class_posterior: Float[np.ndarray, "n labels"]
    azimuth: Float[np.ndarray, " n"]
    """Most probable azimuth, rad; NaN for a model that has none."""


@dataclass(frozen=True)
class Viewpoints:
    """Azimuths at the true boxes, of the objects that have a true one."""

    scene: Int[np.ndarray, " n"]
    error: Float[np.ndarray, " n"]
    """Wrapped, rad."""
    mass: Float[np.ndarray, " n"]
    """Posterior mass of the region that reaches out to the truth."""
    found: Bool[np.ndarray, " n"]
    """A detection from `MIN_OBJECTNESS` on matches the object."""


@dataclass(frozen=True)
class PhotographScores:
    """Figures by name, and tables by source, size and category."""

    figures: dict[str, IntervalEstimate]
    by_source: dict[str, dict[str, float | int | None]]
    by_size: dict[str, dict[str, float | int | None]]
    by_category: dict[str, dict[str, float | int | None]]
    pooled: Matches
    """Matches of objects of any category."""


def counts(photo: Photograph) -> Bool[np.ndarray, " m"]:
    """Objects that are to be found."""
    side = (photo.box[:, 2:] - photo.box[:, :2]).max(1) if len(photo.box) else np.zeros(0)
    return (side >= MIN_SIDE) & ~photo.ignore


def match_photographs(
    photos: Sequence[Photograph],
    answers: Sequence[PhotographDetections],
    label: int | None = None,
    sides: tuple[float, float] | None = None,
) -> Matches:
    """Match the detections of every photograph with its objects.

    Args:
        photos: the photographs.
        answers: what a model finds in each.
        label: of this category alone, detections scored with its probability; of any category when None.
        sides: objects of these longer sides alone, px; others and detections of such a size do not count.
    """
    boxes, scores, truths, ignores, judged = [], [], [], [], []
    for photo, answer in zip(photos, answers, strict=True):
        best = answer.class_posterior.argmax(1) if len(answer.box) else np.zeros(0, dtype=int)
        chosen = np.ones(len(best), dtype=bool) if label is None else best == label
        score = answer.objectness.astype(np.float64)
        if label is not None and len(best):
            score = score * answer.class_posterior.max(1)
        concerned = np.ones(len(photo.box), dtype=bool) if label is None else photo.category == label
        ignore = ~counts(photo)
        against = np.isin(best, list(photo.exhaustive))
        if sides is not None:
            side = (photo.box[:, 2:] - photo.box[:, :2]).max(1) if len(photo.box) else np.zeros(0)
            ignore |= (side < sides[0]) | (side >= sides[1])
            own = (answer.box[:, 2:] - answer.box[:, :2]).max(1) if len(best) else np.zeros(0)
            against &= (own >= sides[0]) & (own < sides[1])
        boxes.append(answer.box[chosen])
        scores.append(score[chosen])
        truths.append(photo.box[concerned])
        ignores.append(ignore[concerned])
        judged.append(against[chosen])
    found = match(boxes, scores, truths, ignores)
    first = np.cumsum([0, *(len(part) for part in judged)])[:-1]
    flat = np.concatenate(judged) if judged else np.zeros(0, dtype=bool)
    unknown = ~flat[first[found.scene] + found.detection] if len(found.scene) else np.zeros(0, dtype=bool)
    return dataclasses.replace(found, ignored=found.ignored | ((found.truth < 0) & unknown))


def photograph_scores(
    photos: Sequence[Photograph],
    answers: Sequence[PhotographDetections],
    categories: Sequence[str],
    rng: np.random.Generator,
    resamples: int = 500,
    viewpoints: Viewpoints | None = None,
) -> PhotographScores:
    """Every figure with its 95 % interval: bootstrap over photographs, proportions widened to Wilson's interval.

    Args:
        photos: the photographs.
        answers: what a model finds in each.
        categories: names of the labels.
        rng: draws the resamples.
        resamples: number of resamples.
        viewpoints: azimuths at the true boxes, for a model that has them.

    Raises:
        InputError: no photograph holds an object that counts.
    """
    pooled = match_photographs(photos, answers)
    if not pooled.truths.sum():
        raise input_error("no object to evaluate on", got=f"{len(photos)} photographs", expected=f"one of {MIN_SIDE} px")
    by_label = [match_photographs(photos, answers, label) for label in range(len(categories))]
    weights = resample_weights(len(photos), resamples, rng)
    right, confidence, scene = _categories(photos, answers, pooled)
    judged = ~pooled.ignored & (pooled.score >= MIN_OBJECTNESS)
    score, correct, at = pooled.score[judged], pooled.correct[judged], pooled.scene[judged]
    empty = np.array([not len(photo.box) and len(photo.exhaustive) == len(categories) for photo in photos])
    false = np.array([int((answer.objectness > CONFIDENT).sum()) for answer in answers], dtype=np.float64)
    rows = np.flatnonzero(empty)
    figures = {
        "map50": estimate(
            lambda w: mean_of_defined(np.stack([average_precision(one, w) for one in by_label], axis=1)),
            weights,
            int(sum(one.truths.sum() for one in by_label)),
        ),
        "ap50": estimate(lambda w: average_precision(pooled, w), weights, int(pooled.truths.sum())),
        "category_found": widened(estimate(lambda w: weighted_mean(right, w[:, scene]), weights, len(right))),
        "ece_objectness": estimate(
            lambda w: expected_calibration_error(score, correct, w[:, at]), weights, len(score), pivotal=True
        ),
        "ece_class": estimate(
            lambda w: expected_calibration_error(confidence, right > 0, w[:, scene]), weights, len(right), pivotal=True
        ),
        "ece_objectness_if_perfect": perfect_error(score, rng),
        "ece_class_if_perfect": perfect_error(confidence, rng),
        "false_without_objects": estimate(lambda w: weighted_mean(false[rows], w[:, rows]), weights, len(rows)),
    }
    if viewpoints is not None and len(viewpoints.error):
        figures |= _viewpoint_scores(viewpoints, weights)
    return PhotographScores(
        figures,
        {name: _row(*_of_source(photos, answers, name)) for name in sorted({photo.source for photo in photos})},
        {name: _size_row(match_photographs(photos, answers, None, band)) for name, band in SIZES.items()},
        {
            name: {"objects": int(one.truths.sum()), "ap50": _defined(average_precision(one)[0])}
            for name, one in zip(categories, by_label)
        },
        pooled,
    )


def _viewpoint_scores(views: Viewpoints, weights: np.ndarray) -> dict[str, IntervalEstimate]:
    scene, error = views.scene, np.abs(views.error)

    def share(value: np.ndarray, rows: np.ndarray) -> IntervalEstimate:
        chosen, of = value[rows].astype(np.float64), scene[rows]
        return widened(estimate(lambda w: weighted_mean(chosen, w[:, of]), weights, len(chosen)))

    every, found = np.ones(len(error), dtype=bool), views.found
    degrees = np.degrees(error)
    return {
        "viewpoint_found": share(found, every),
        "azimuth_acc_pi6": share(error < ACCURATE, found),
        "azimuth_median_deg": estimate(lambda w: weighted_median(degrees[found], w[:, scene[found]]), weights, int(found.sum())),
        "azimuth_flips": share(error > np.pi - ACCURATE, found),
        "azimuth_coverage90": share(views.mass <= 0.9, found),
        "azimuth_acc_pi6_all": share(error < ACCURATE, every),
    }


def _categories(
    photos: Sequence[Photograph], answers: Sequence[PhotographDetections], pooled: Matches
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Of the objects found: whether the category is right, how sure the model is of it, and the photograph."""
    rows = np.flatnonzero(pooled.correct & (pooled.score >= MIN_OBJECTNESS))
    right, confidence = np.zeros(len(rows)), np.zeros(len(rows))
    for k, row in enumerate(rows):
        scene = pooled.scene[row]
        posterior = answers[scene].class_posterior[pooled.detection[row]]
        right[k] = posterior.argmax() == photos[scene].category[pooled.truth[row]]
        confidence[k] = min(float(posterior.max()), 1.0)
    return right, confidence, pooled.scene[rows]


def _of_source(
    photos: Sequence[Photograph], answers: Sequence[PhotographDetections], name: str
) -> tuple[list[Photograph], list[PhotographDetections]]:
    rows = [k for k, photo in enumerate(photos) if photo.source == name]
    return [photos[k] for k in rows], [answers[k] for k in rows]


def _row(photos: Sequence[Photograph], answers: Sequence[PhotographDetections]) -> dict[str, float | int | None]:
    found = match_photographs(photos, answers)
    right, _, _ = _categories(photos, answers, found)
    return {
        "photographs": len(photos),
        "objects": int(found.truths.sum()),
        "ap50": _defined(average_precision(found)[0]),
        "category_found": float(right.mean()) if len(right) else None,
    }


def _size_row(found: Matches) -> dict[str, float | int | None]:
    return {"objects": int(found.truths.sum()), "ap50": _defined(average_precision(found)[0])}


def _defined(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
