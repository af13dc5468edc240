"""The last stage of a model with a detector: how its evidence is read on photographs, fitted on labelled ones kept apart.

Four numbers (`Fusion.photograph`): factor and shift of the detector's log odds, so that objectness is a probability of the
detections that remain after suppression; factor of its log probabilities; and the share of the RoI refinement in the category,
which is kept only where it gains average precision on other photographs: on those that it was fitted on a share gained 0.03, on
two sets of others it lost. Fitted on the regions that training photographs offer instead
(`evidence_fit`), duplicates of one object count as background and the objectness comes out too low.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.optimize import minimize

from nolbo_ppl.data.converters.photographs import Photograph
from nolbo_ppl.data.sequences.image_sequence import read_image
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.metrics.detection import average_precision, match
from nolbo_ppl.models.hybrid_guide import HybridGuide
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.progress import progress_bar

PARTS = 3
"""Of labelled photographs, every third from the first is fitted on, every third from the second measured; the rest decide whether
the RoI refinement has a share in the category, and objectness is fitted on them too."""
MIN_SIDE = 24.0
"""Longer side, px, from which on an object counts (as in `nolbo_ppl.evaluation.photograph_scores`)."""
MIN_ODDS = -4.6
"""Detections of lower log odds, 0.01, are not looked at."""
MIN_DETECTIONS = 30
"""Fewer judged detections, right or wrong, fix no factor."""


@dataclass(frozen=True)
class FoundObjects:
    """Detections of some photographs before anything is fitted."""

    scene: Int[np.ndarray, " n"]
    box: Float[np.ndarray, "n 4"]
    log_odds: Float[np.ndarray, " n"]
    """Of the detector."""
    own: Float[np.ndarray, "n labels"]
    """Its log probabilities of the categories."""
    look: Float[np.ndarray, "n labels"]
    """Those of the RoI refinement."""


@dataclass(frozen=True)
class PhotographFit:
    """What was fitted, and on what."""

    factor: float
    """Of the detector's log odds."""
    shift: float
    """Added to them, nats."""
    label_factor: float
    """Of its log probabilities of the categories."""
    look_share: float
    """Weight of the RoI refinement's log probabilities."""
    photographs: int
    detections: int
    """Behind factor and shift: those of the others too."""
    map50_without_look: float
    """Mean average precision, on photographs that decide."""
    map50_with_look: float


@torch.no_grad()
def find_objects(model: Nolbo, photos: Sequence[Photograph], batch: int = 16) -> FoundObjects:
    """Detections with the detector's evidence as it is; the model's own numbers come back afterwards."""
    guide = model.guide
    assert isinstance(guide, HybridGuide)
    before = guide.fusion.photograph.detach().clone()
    parts: list[list[np.ndarray]] = []
    try:
        for share in (0.0, 1.0):
            guide.fusion.photograph.copy_(torch.tensor([1.0, 0.0, 1.0, share], device="cpu"))
            observer = ObservationModel(model)
            found = []
            for first in progress_bar(range(0, len(photos), batch), "photographs to fit", "batch"):
                images = [read_image(photo.image) for photo in photos[first : first + batch]]
                found += observer.observe(images, threshold=1 / (1 + np.exp(-MIN_ODDS)), decode=False, batch=batch)
            parts.append([one.class_log_posterior for one in found])
    finally:
        guide.fusion.photograph.copy_(before)
    own, both = (np.concatenate(part) for part in parts)
    probability = np.concatenate([one.objectness for one in found])
    return FoundObjects(
        np.repeat(np.arange(len(found)), [len(one) for one in found]),
        np.concatenate([one.box for one in found]),
        np.log(probability) - np.log1p(-probability),
        own,
        both - own,  # up to a constant of each detection, which no softmax sees
    )


def judged(
    found: FoundObjects, photos: Sequence[Photograph], label: Int[np.ndarray, " n"]
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Which detections count, which of them are right, and the true category of the object of each (-1 for none).

    A detection of no object counts only where its category is labelled exhaustively; small and difficult objects do not count.
    """
    rows = [np.flatnonzero(found.scene == k) for k in range(len(photos))]
    ignores = [_not_to_be_found(photo) for photo in photos]
    matches = match([found.box[r] for r in rows], [found.log_odds[r] for r in rows], [p.box for p in photos], ignores)
    counted, right = np.zeros(len(found.scene), dtype=bool), np.zeros(len(found.scene), dtype=bool)
    category = np.full(len(found.scene), -1)
    for scene, detection, truth, ignored in zip(matches.scene, matches.detection, matches.truth, matches.ignored):
        row = rows[scene][detection]
        right[row] = truth >= 0 and not ignored
        counted[row] = not ignored and (truth >= 0 or int(label[row]) in photos[scene].exhaustive)
        if right[row]:
            category[row] = photos[scene].category[truth]
    return counted, right, category


def mean_precision(found: FoundObjects, photos: Sequence[Photograph], log_posterior: Float[np.ndarray, "n labels"]) -> float:
    """Mean over the categories of the average precision, each detection of its likeliest category, scored with both."""
    best = log_posterior.argmax(1)
    score = found.log_odds - np.logaddexp(0, found.log_odds) + log_posterior.max(1)
    values = []
    for label in range(log_posterior.shape[1]):
        rows = [np.flatnonzero((found.scene == k) & (best == label)) for k in range(len(photos))]
        own = [photo.category == label for photo in photos]
        truths = [photo.box[o] for photo, o in zip(photos, own)]
        ignores = [_not_to_be_found(photo)[o] for photo, o in zip(photos, own)]
        matches = match([found.box[r] for r in rows], [score[r] for r in rows], truths, ignores)
        unknown = np.array([label not in photo.exhaustive for photo in photos])[matches.scene] & (matches.truth < 0)
        if matches.truths.sum():
            values.append(float(average_precision(replace(matches, ignored=matches.ignored | unknown))[0]))
    return float(np.mean(values)) if values else float("nan")


def fit_found(
    found: FoundObjects, photos: Sequence[Photograph], others: FoundObjects, other_photos: Sequence[Photograph]
) -> PhotographFit | None:
    """The four numbers by maximum likelihood; None where there are too few detections to tell.

    Args:
        found: detections to fit on.
        photos: their photographs.
        others: detections that decide whether the look has a share; factor and shift are fitted on both.
        other_photos: theirs.
    """
    counted, right, category = judged(found, photos, found.own.argmax(1))
    more, more_right, _ = judged(others, other_photos, others.own.argmax(1))
    if min(int((counted & right).sum()), int((counted & ~right).sum())) < MIN_DETECTIONS:
        return None
    factor, shift = _logistic(
        np.concatenate((found.log_odds[counted], others.log_odds[more])), np.concatenate((right[counted], more_right[more]))
    )
    objects = category >= 0
    own, look, truth = found.own[objects], found.look[objects], category[objects]
    plain = _temperatures(own, np.zeros_like(look), truth)[0]
    label_factor, share = _temperatures(own, look, truth)
    without, with_look = (
        mean_precision(others, other_photos, _normalised(a * others.own + b * others.look))
        for a, b in ((plain, 0.0), (label_factor, share))
    )
    if not with_look > without:
        label_factor, share = plain, 0.0
    return PhotographFit(factor, shift, label_factor, share, len(photos), int(counted.sum() + more.sum()), without, with_look)


@torch.no_grad()
def adopt_fit(model: Nolbo, fit: PhotographFit) -> None:
    """Write what was fitted into the fusion of a model."""
    guide = model.guide
    assert isinstance(guide, HybridGuide)
    numbers = [fit.factor, fit.shift, fit.label_factor, fit.look_share]
    guide.fusion.photograph.copy_(torch.tensor(numbers, device="cpu", dtype=guide.fusion.photograph.dtype))


def _not_to_be_found(photo: Photograph) -> Bool[np.ndarray, " m"]:
    """Small, difficult, crowds."""
    return photo.ignore | (np.max(photo.box[:, 2:] - photo.box[:, :2], axis=1, initial=0.0) < MIN_SIDE)


def _normalised(logits: Float[np.ndarray, "n labels"]) -> Float[np.ndarray, "n labels"]:
    return logits - np.logaddexp.reduce(logits, axis=1, keepdims=True)


def _logistic(odds: Float[np.ndarray, " n"], right: Bool[np.ndarray, " n"]) -> tuple[float, float]:
    """Factor and shift of log odds by maximum likelihood; the factor is positive."""

    def loss(x: np.ndarray) -> float:
        value = np.exp(x[0]) * odds + x[1]
        return float(np.mean(np.logaddexp(0, value) - right * value))

    log_factor, shift = minimize(loss, [0.0, 0.0], method="L-BFGS-B", bounds=[(-3, 3), (-10, 10)]).x
    return float(np.exp(log_factor)), float(shift)


def _temperatures(own: np.ndarray, look: np.ndarray, truth: Int[np.ndarray, " n"]) -> tuple[float, float]:
    """Weights of two log probabilities by maximum likelihood of the true categories; the second one is at least 0."""

    def loss(x: np.ndarray) -> float:
        return -float(np.mean(_normalised(x[0] * own + x[1] * look)[np.arange(len(truth)), truth]))

    first, second = minimize(loss, [1.0, 0.1 if look.any() else 0.0], method="L-BFGS-B", bounds=[(0.05, 20), (0, 5)]).x
    return float(first), float(second)
