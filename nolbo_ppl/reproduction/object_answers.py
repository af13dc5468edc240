"""What a network answers at the true boxes of held-out scenes: viewpoint, latent, and occupancy beside the true shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.distance import cdist

from nolbo_ppl.evaluation.labelled_scenes import Scenes
from nolbo_ppl.geometry.voxels import unpack_voxels
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.metrics.detection import PrecisionRecall
from nolbo_ppl.metrics.viewpoint_error import rotation_error
from nolbo_ppl.metrics.voxel import voxel_iou
from nolbo_ppl.progress import progress_bar

BINS = 200
"""Thresholds of a curve of precision and recall, evenly spaced in probability."""


@dataclass(frozen=True)
class ObjectAnswers:
    """Answers at true boxes, a row an object that counts."""

    scene: Int[np.ndarray, " n"]
    """Its scene."""
    category: Int[np.ndarray, " n"]
    """True category, -1 where it is missing."""
    likeliest: Int[np.ndarray, " n"]
    """Category of maximum likelihood over the prior means."""
    rotation_error: Float[np.ndarray, " n"]
    """Geodesic angle up to symmetry, rad; NaN without a true one, or where the network states none."""
    latent: Float[np.ndarray, "n d"]
    """Mean of the shape latent."""
    iou: Float[np.ndarray, " n"]
    """IoU of the decoded latent at one half; NaN without a true shape."""
    occupied: Int[np.ndarray, "n bins"]
    """Occupied voxels by the probability the decoder gives them, in `BINS` equal bins."""
    empty: Int[np.ndarray, "n bins"]
    """Empty ones."""

    def select(self, rows: Bool[np.ndarray, " n"]) -> ObjectAnswers:
        """Some of the objects."""
        return ObjectAnswers(**{name: value[rows] for name, value in vars(self).items()})


def answers_at_boxes(model: ObservationModel, scenes: Scenes, batch: int = 16) -> ObjectAnswers:
    """Ask a network for the objects of scenes, with ground truth boxes (NOLBO Table 1); objects hardly seen do not count."""
    parts: dict[str, list[np.ndarray]] = {}
    for start in progress_bar(range(0, len(scenes), batch), "answers", "batch"):
        rows = range(start, min(start + batch, len(scenes)))
        truth = [(i, scenes[i]) for i in rows]
        truth = [(i, one.select(np.flatnonzero(one.counts()))) for i, one in truth]
        truth = [(i, one) for i, one in truth if len(one)]
        if not truth:
            continue
        cameras = np.array([one.intrinsics for _, one in truth])
        seen = model.observe_boxes(
            [one.image for _, one in truth], cameras, [one.box for _, one in truth], decode=False, batch=batch
        )
        for (i, one), answer in zip(truth, seen):
            error = np.full(len(one), np.nan)
            known = np.isfinite(one.R_camera_object).all((1, 2)) & answer.describes
            error[known] = rotation_error(
                np.asarray(answer.R_camera_object, dtype=np.float64)[known], one.R_camera_object[known], one.symmetry[known]
            )
            found = {
                "scene": np.full(len(one), i),
                "category": one.labels(model.config.categories),
                "likeliest": answer.class_log_likelihood.argmax(1),
                "rotation_error": error,
                "latent": np.asarray(answer.latent, dtype=np.float64),
                **_shapes(model, one.voxels, answer.latent),
            }
            for name, value in found.items():
                parts.setdefault(name, []).append(value)
    return ObjectAnswers(**{name: np.concatenate(values) for name, values in parts.items()})


def _shapes(model: ObservationModel, packed: np.ndarray | None, latent: np.ndarray) -> dict[str, np.ndarray]:
    """IoU and counts of voxels of objects whose shape is known; zero counts for the others."""
    n = len(latent)
    found = {"iou": np.full(n, np.nan), "occupied": np.zeros((n, BINS), np.int64), "empty": np.zeros((n, BINS), np.int64)}
    rows = np.flatnonzero(packed.any(1)) if packed is not None and packed.size else np.zeros(0, int)
    if packed is None or not len(rows):
        return found
    truth = unpack_voxels(packed[rows], round((8 * packed.shape[1]) ** (1 / 3)))
    decoded = model.decode(latent[rows])
    factor = decoded.shape[1] // truth.shape[1]
    for axis in (1, 2, 3) if factor > 1 else ():
        truth = truth.repeat(factor, axis=axis)
    found["iou"][rows] = voxel_iou(decoded, truth)
    index = np.minimum((decoded * BINS).astype(np.int64), BINS - 1)
    for i, row in enumerate(rows):
        found["occupied"][row] = np.bincount(index[i][truth[i]], minlength=BINS)
        found["empty"][row] = np.bincount(index[i][~truth[i]], minlength=BINS)
    return found


def occupancy_curve(occupied: Int[np.ndarray, "n bins"], empty: Int[np.ndarray, "n bins"]) -> PrecisionRecall:
    """Precision and recall of occupancy (NOLBO, figure of 3D reconstruction) from counts of voxels by probability.

    All voxels of all objects together; thresholds are the lower edges of the bins.
    """
    hits = np.cumsum(occupied.sum(0)[::-1])
    found = hits + np.cumsum(empty.sum(0)[::-1])
    some = found > 0
    threshold = np.arange(len(found) - 1, -1, -1) / len(found)
    return PrecisionRecall(threshold[some], hits[some] / found[some], hits[some] / max(hits[-1], 1))


def nearest_category_accuracy(latent: Float[np.ndarray, "n d"], category: Int[np.ndarray, " n"], neighbours: int = 5) -> float:
    """Share of objects whose nearest neighbours in the latent space are most often of their own category."""
    n = len(latent)
    if n <= neighbours:
        return float("nan")
    distance = cdist(latent, latent)  # all differences at once would take 17 GB of 4 000 latents of 128 dimensions
    np.fill_diagonal(distance, np.inf)
    nearest = category[np.argsort(distance, axis=1)[:, :neighbours]]
    votes = np.stack([(nearest == label).sum(1) for label in range(category.max() + 1)], axis=1)
    return float((votes.argmax(1) == category).mean())


def categories_shown(category: Int[np.ndarray, " n"], count: int, rng: np.random.Generator) -> Sequence[int]:
    """So many of the categories that occur, drawn at random, in the order of their labels."""
    there = np.unique(category[category >= 0])
    return sorted(int(label) for label in rng.permutation(there)[:count])
