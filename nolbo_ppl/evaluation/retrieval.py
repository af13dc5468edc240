"""Finding an instance again among others of its category, by posteriors of its shape latent from two different views.

Three scores of "view a and view b show one instance", the first the figure that is reported, the others beside it:
the log evidence ratio of one latent against two, `log int q_a(z) q_b(z) / p(z) dz`, for the category's prior p (each guide
posterior is proportional to likelihood times prior, so that this is the ratio of the joint to the separate evidence); the
log overlap `log int q_a(z) q_b(z) dz`, which leaves the prior out; and the Euclidean distance of the means.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.errors import input_error
from nolbo_ppl.metrics.intervals import IntervalEstimate, estimate, resample_weights, widened
from nolbo_ppl.metrics.statistics import weighted_mean, weighted_median

SCORES = ("evidence", "overlap", "euclidean")
"""Names of the scores."""


def log_evidence_ratio(
    mean_a: Float[np.ndarray, "n d"],
    scale_a: Float[np.ndarray, "n d"],
    mean_b: Float[np.ndarray, "m d"],
    scale_b: Float[np.ndarray, "m d"],
    prior_mean: Float[np.ndarray, " d"],
) -> Float[np.ndarray, "n m"]:
    """`log int q_a(z) q_b(z) / p(z) dz` of every pair, nats, for diagonal Gaussians and the prior N(prior_mean, I).

    With precisions a and b, and means relative to the prior's, each dimension adds
    `1/2 log(a b / (a + b - 1)) + 1/2 ((a x + b y)^2 / (a + b - 1) - a x^2 - b y^2)`.
    A posterior is no wider than its prior: larger scales count as 1.
    """
    a, b = np.maximum(scale_a, 1e-6) ** -2.0, np.maximum(scale_b, 1e-6) ** -2.0
    a, b = np.maximum(a, 1.0)[:, None], np.maximum(b, 1.0)[None]
    x, y = (mean_a - prior_mean)[:, None], (mean_b - prior_mean)[None]
    both = a + b - 1
    terms = np.log(a) + np.log(b) - np.log(both) + (a * x + b * y) ** 2 / both - a * x**2 - b * y**2
    return 0.5 * terms.sum(-1)


def log_overlap(
    mean_a: Float[np.ndarray, "n d"],
    scale_a: Float[np.ndarray, "n d"],
    mean_b: Float[np.ndarray, "m d"],
    scale_b: Float[np.ndarray, "m d"],
) -> Float[np.ndarray, "n m"]:
    """`log int q_a(z) q_b(z) dz = log N(mean_a; mean_b, scale_a^2 + scale_b^2)` of every pair, nats."""
    variance = scale_a[:, None] ** 2 + scale_b[None] ** 2
    squared = (mean_a[:, None] - mean_b[None]) ** 2
    return -0.5 * (squared / variance + np.log(2 * math.pi * variance)).sum(-1)


def rank_of_own(score: Float[np.ndarray, "n n"]) -> Int[np.ndarray, " n"]:
    """Place, from 1, of each query's own instance (the diagonal) among the scores of its row; it comes last among equals.

    Raises:
        InputError: the scores are not square, or one is not a number.
    """
    score = np.asarray(score)
    if score.ndim != 2 or score.shape[0] != score.shape[1] or np.isnan(score).any():
        raise input_error("scores of pairs", got=score.shape, expected="a square matrix of numbers")
    return (score >= np.diagonal(score)[:, None]).sum(1)


@dataclass(frozen=True)
class RetrievalRecords:
    """Two views of every instance, each sought among the other views of its category."""

    category: Int[np.ndarray, " n"]
    """Category of each instance."""
    gallery: Int[np.ndarray, " n"]
    """Instances it is sought among, itself included."""
    rank: dict[str, Int[np.ndarray, "n 2"]]
    """By score: its place when the first view seeks the second, and the other way round."""

    def __len__(self) -> int:
        return len(self.category)


def retrieve(
    mean: Float[np.ndarray, "n 2 d"],
    scale: Float[np.ndarray, "n 2 d"],
    category: Int[np.ndarray, " n"],
    prior_mean: Float[np.ndarray, "labels d"],
) -> RetrievalRecords:
    """Seek every instance's other view among those of its category.

    Args:
        mean: posterior means of the shape latent in both views of each instance.
        scale: posterior scales.
        category: label of each instance.
        prior_mean: mean latent of each category.

    Raises:
        InputError: shapes do not match, or there is no instance.
    """
    mean, scale, category = np.asarray(mean, np.float64), np.asarray(scale, np.float64), np.asarray(category)
    if mean.ndim != 3 or mean.shape[:2] != (len(category), 2) or scale.shape != mean.shape or not len(category):
        got = (mean.shape, scale.shape, category.shape)
        raise input_error("latents of two views", got=got, expected="(n, 2, d) twice and n labels, n at least 1")
    rank = {name: np.zeros((len(category), 2), dtype=np.int64) for name in SCORES}
    gallery = np.zeros(len(category), dtype=np.int64)
    for label in np.unique(category):
        rows = np.flatnonzero(category == label)
        gallery[rows] = len(rows)
        (a, b), (u, v) = mean[rows].transpose(1, 0, 2), scale[rows].transpose(1, 0, 2)
        scores = {
            "evidence": log_evidence_ratio(a, u, b, v, np.asarray(prior_mean, np.float64)[label]),
            "overlap": log_overlap(a, u, b, v),
            "euclidean": -np.linalg.norm(a[:, None] - b[None], axis=-1),
        }
        for name, score in scores.items():
            rank[name][rows] = np.stack((rank_of_own(score), rank_of_own(score.T)), axis=1)
    return RetrievalRecords(category, gallery, rank)


def retrieval_scores(records: RetrievalRecords, rng: np.random.Generator, resamples: int = 500) -> dict[str, IntervalEstimate]:
    """Recalls and the median place with 95 % intervals: bootstrap over the instances that are sought."""
    weights = resample_weights(len(records), resamples, rng)

    def recall(name: str, places: int) -> IntervalEstimate:
        found = (records.rank[name] <= places).mean(1)
        return widened(estimate(lambda w: weighted_mean(found, w), weights, len(found)))

    middle = records.rank["evidence"].mean(1)
    return {
        "retrieval_recall1": recall("evidence", 1),
        "retrieval_recall5": recall("evidence", 5),
        "retrieval_recall1_overlap": recall("overlap", 1),
        "retrieval_recall1_euclidean": recall("euclidean", 1),
        "retrieval_median_rank": estimate(lambda w: weighted_median(middle, w), weights, len(middle)),
    }


def retrieval_table(records: RetrievalRecords, categories: tuple[str, ...]) -> dict[str, dict[str, float | int]]:
    """Recall at 1 of each category by score, and what chance would give."""
    table: dict[str, dict[str, float | int]] = {}
    for label, name in enumerate(categories):
        rows = records.category == label
        if rows.any():
            recalls = {score: float((records.rank[score][rows] == 1).mean()) for score in SCORES}
            table[name] = {"instances": int(rows.sum()), "chance": float((1 / records.gallery[rows]).mean()), **recalls}
    return table
