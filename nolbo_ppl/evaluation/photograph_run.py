"""Run a model, and peers beside it, over labelled photographs."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8

from nolbo_ppl.data.converters.photographs import Photograph, read_photographs
from nolbo_ppl.data.sequences.image_sequence import read_image
from nolbo_ppl.errors import input_error
from nolbo_ppl.evaluation.peers import OnnxPeer
from nolbo_ppl.evaluation.photograph_scores import (
    PhotographDetections,
    PhotographScores,
    Viewpoints,
    counts,
    match_photographs,
    photograph_scores,
)
from nolbo_ppl.evaluation.scores import MIN_OBJECTNESS
from nolbo_ppl.inference.posterior.multiscale import MultiScalePredictor
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.inference.posterior.preprocess import guessed_intrinsics
from nolbo_ppl.models.distributions import VonMisesMixture
from nolbo_ppl.progress import progress_bar
from nolbo_ppl.structures.annotations import Annotations
from nolbo_ppl.structures.object_posteriors import ObjectPosteriors

Model = ObservationModel | MultiScalePredictor


@dataclass(frozen=True)
class PhotographEvaluation:
    """Everything measured on photographs."""

    photos: list[Photograph]
    answers: list[PhotographDetections]
    scores: PhotographScores
    peers: dict[str, PhotographScores]
    images_per_second: float
    """Of `observe` without decoding shapes, at the evaluation's threshold, on the threads torch has."""


@dataclass(frozen=True)
class PhotographScenes:
    """Photographs as labelled scenes without poses, for the pictures."""

    photos: Sequence[Photograph]
    categories: Sequence[str]
    """Names that their labels stand for."""

    def __len__(self) -> int:
        return len(self.photos)

    def __getitem__(self, index: int) -> Annotations:
        photo = self.photos[index]
        image = read_image(photo.image)
        labelled = photo.box[~photo.ignore]
        return Annotations.from_arrays(
            guessed_intrinsics(image),
            labelled,
            category=[self.categories[label] if label >= 0 else None for label in photo.category[~photo.ignore]],
            ignore=photo.box[photo.ignore],
            voxels=np.zeros((len(labelled), 1), dtype=np.uint8),
            file=photo.image,
            pixels=image,
        )


def evaluate_photographs(
    path: Path,
    model: Model,
    peers: Sequence[OnnxPeer] = (),
    *,
    threshold: float = 0.01,
    batch: int = 16,
    count: int | None = None,
    part: tuple[int, int] = (0, 1),
    seed: int = 0,
    resamples: int = 500,
) -> PhotographEvaluation:
    """Figures of a model and of peers on the photographs of a COCO-style file.

    Args:
        path: the file, or a folder with `val.json`.
        model: the model.
        peers: detectors to measure in the same way.
        threshold: least objectness of a detection.
        batch: photographs that go through the network at once.
        count: at most this many photographs, evenly spread over the file.
        part: number of the first photograph, and step to the next; the rest may have served to fit something.
        seed: of the bootstrap.
        resamples: of the bootstrap.

    Raises:
        InputError: the file or an image cannot be used, or no such part.
    """  # fmt: skip
    categories = model.config.categories
    photos = read_photographs(path, categories=categories)
    if not (part[1] >= 1 and 0 <= part[0] < len(photos)):
        raise input_error("part of the photographs", got=part, expected=f"a number below {len(photos)} and a step of at least 1")
    photos = photos[part[0] :: part[1]]
    if count is not None and count < len(photos):
        photos = [photos[k] for k in np.linspace(0, len(photos) - 1, count).round().astype(int)]
    answers: list[PhotographDetections] = []
    views: list[Viewpoints] = []
    seconds = 0.0
    for first, chunk, images in _chunks(photos, batch):
        started = time.perf_counter()
        found = model.observe(images, threshold=threshold, decode=False, batch=batch)
        seconds += time.perf_counter() - started
        said = [
            PhotographDetections(one.box, one.objectness, one.class_posterior, np.asarray(one.viewpoint[:, 0], dtype=np.float64))
            for one in found
        ]
        answers += said
        views.append(_viewpoints(model, first, chunk, images, said, batch))
    joined = Viewpoints(*(np.concatenate([getattr(v, name) for v in views]) for name in ("scene", "error", "mass", "found")))
    scores = photograph_scores(photos, answers, categories, np.random.default_rng(seed), resamples, joined)
    beside = {}
    for peer in peers:
        theirs = [_as_answer(peer, image, len(categories)) for _, _, images in _chunks(photos, batch) for image in images]
        beside[peer.name] = photograph_scores(photos, theirs, categories, np.random.default_rng(seed), resamples)
    return PhotographEvaluation(photos, answers, scores, beside, len(photos) / max(seconds, 1e-9))


def _chunks(
    photos: Sequence[Photograph], batch: int
) -> Iterator[tuple[int, Sequence[Photograph], list[UInt8[np.ndarray, "h w 3"]]]]:
    step = 4 * batch
    for first in progress_bar(range(0, len(photos), step), "photographs", "batch"):
        chunk = photos[first : first + step]
        yield first, chunk, [read_image(photo.image) for photo in chunk]


def _viewpoints(
    model: Model,
    first: int,
    photos: Sequence[Photograph],
    images: Sequence[np.ndarray],
    answers: Sequence[PhotographDetections],
    batch: int,
) -> Viewpoints:
    """Azimuths of the objects with a true viewpoint: of the detection where one matches, else at the true box."""
    rows = [k for k, photo in enumerate(photos) if (np.isfinite(photo.viewpoint[:, 0]) & counts(photo)).any()]
    scene: list[int] = []
    error: list[float] = []
    mass: list[float] = []
    found: list[bool] = []
    if rows:
        slots = [np.flatnonzero(np.isfinite(photos[k].viewpoint[:, 0]) & counts(photos[k])) for k in rows]
        looked = [_matched_boxes(photos[k], answers[k], chosen) for k, chosen in zip(rows, slots)]
        posteriors = model.observe_boxes([images[k] for k in rows], None, [box for box, _ in looked], decode=False, batch=batch)
        for k, chosen, (_, seen), posterior in zip(rows, slots, looked, posteriors):
            truth = photos[k].viewpoint[chosen, 0]
            difference = np.remainder(posterior.viewpoint[:, 0] - truth + np.pi, 2 * np.pi) - np.pi
            scene += [first + k] * len(chosen)
            error += difference.tolist()
            mass += _region_mass(posterior, truth).tolist()
            found += seen.tolist()
    return Viewpoints(
        np.array(scene, dtype=np.int64), np.array(error, dtype=np.float64), np.array(mass, dtype=np.float64),
        np.array(found, dtype=bool),
    )  # fmt: skip


def _matched_boxes(photo: Photograph, answer: PhotographDetections, slots: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where to look at each object: the box of the detection that matches it, else its true one; and whether one does."""
    matched = match_photographs([photo], [answer])
    boxes, seen = photo.box[slots].copy(), np.zeros(len(slots), dtype=bool)
    for k, slot in enumerate(slots):
        hits = np.flatnonzero((matched.truth == slot) & (matched.score >= MIN_OBJECTNESS))
        if len(hits):
            boxes[k], seen[k] = answer.box[matched.detection[hits[0]]], True
    return boxes, seen


def _region_mass(posterior: ObjectPosteriors, azimuth: np.ndarray) -> np.ndarray:
    modes = posterior.viewpoint_modes
    weights, mean, concentration = (
        torch.as_tensor(np.asarray(value, dtype=np.float64)) for value in (modes.weights, modes.azimuth, modes.concentration)
    )
    mixture = VonMisesMixture.from_mean_concentration(
        weights.clamp_min(1e-300).log(), mean, concentration, max_concentration=float(concentration.max()) + 1
    )
    return mixture.hpd_mass(torch.as_tensor(azimuth), torch.ones(len(azimuth), dtype=torch.long)).numpy()


def _as_answer(peer: OnnxPeer, image: np.ndarray, labels: int) -> PhotographDetections:
    """A peer's detections as answers: its score is the objectness, its category certain."""
    found = peer.detect(image)
    posterior = np.zeros((len(found.box), labels))
    posterior[np.arange(len(found.box)), found.label.astype(int)] = 1.0
    return PhotographDetections(found.box, found.score, posterior, np.full(len(found.box), np.nan))
