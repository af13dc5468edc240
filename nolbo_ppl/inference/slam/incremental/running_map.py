"""What the online system knows of each object besides its place in the graph: sums over its detections, of constant size.

A landmark gathers the detections of every pass. Latents are fused by their precisions; views of one object err alike, so the
variance told is `1 + r (n - 1)` times that of independent views (`latent_correlation`), over all passes together.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.inference.slam.detection_features import (
    LARGE_VARIANCE,
    FeaturePrior,
    correlated_variance,
    fuse_latent,
)
from nolbo_ppl.inference.slam.gaussian import log_normal
from nolbo_ppl.inference.slam.latent_mixture import likeliest_mode
from nolbo_ppl.inference.slam.loop_candidates import TrackletFeatures, log_population
from nolbo_ppl.inference.slam.measurements import Measurements
from nolbo_ppl.inference.slam.slam_problem import NoiseModel
from nolbo_ppl.inference.slam.slam_state import link_scale

MAX_FRAMES = 64
"""Newest frames of a landmark that are kept, to tell which landmarks were seen together."""
RIGHT_TRACK = 0.95
"""Probability that a detection was put to the right landmark; a stray one cannot sink it."""
POPULATION = 300
"""Landmarks the population of latents is taken from."""


@dataclass
class RunningLandmark:
    """One object of the running map."""

    number: int
    """Its number in the graph."""
    place: int
    """Place of the drift graph it was found at."""
    first: int
    """First frame it was detected in."""
    last: int
    """Last one."""
    latent: Float[np.ndarray, " d"]
    """Fused latent."""
    latent_variance: Float[np.ndarray, " d"]
    """Its variance, as if views were independent."""
    symmetry: int
    """Symmetry order."""
    votes: Float[np.ndarray, " c"]
    """Detections by category."""
    oriented: bool = False
    """Whether an orientation was observed."""
    views: int = 0
    """Detections."""
    latent_views: int = 0
    """Those with a latent."""
    size: Float[np.ndarray, " 3"] = field(default_factory=lambda: np.zeros(3))
    """Sum of observed extents, m."""
    sizes: int = 0
    """Number of them."""
    log_odds: float = 0.0
    """Log ratio of its detections as those of an object to those of background, its position aside."""
    information: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.zeros((3, 3)))
    """Sum of the information of its detections in the world frame, m^-2."""
    shared: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.zeros((3, 3)))
    """Sum of what the error that all its views share adds to them, by their information in the world frame, m^-2 m."""
    own: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.zeros((3, 3)))
    """Sum of the squares of the same, view by view: what `information` counts already."""
    frames: deque[int] = field(default_factory=lambda: deque(maxlen=MAX_FRAMES))
    """Newest frames it was detected in."""
    passes: int = 1
    """Tracks it was made of."""

    def add(self, frame: int, measurements: Measurements, row: int, size: Float[np.ndarray, " 3"]) -> None:
        """One more detection: a row of measurements, and its extent (NaN: none)."""
        self.views += 1
        self.first, self.last = min(self.first, frame), max(self.last, frame)
        self.frames.append(frame)
        self.oriented |= bool(measurements.oriented[row])
        category = int(measurements.category[row])
        if category >= 0:
            self.votes[category] += 1.0
        latent, variance = measurements.latent[row], measurements.latent_variance[row]
        if len(variance) and variance[0] < LARGE_VARIANCE:
            if measurements.latent_modes is not None and self.latent_views:
                latent = likeliest_mode(measurements.latent_modes, row, self.latent, self.latent_variance + variance)
            self.latent, self.latent_variance = fuse_latent(self.latent, self.latent_variance, latent, variance)
            self.latent_views += 1
        if np.isfinite(size).all():
            self.size = self.size + size
            self.sizes += 1

    def absorb(self, other: RunningLandmark) -> None:
        """Take over the detections of another landmark that is the same object."""
        self.latent, self.latent_variance = fuse_latent(self.latent, self.latent_variance, other.latent, other.latent_variance)
        self.first, self.last = min(self.first, other.first), max(self.last, other.last)
        self.votes = self.votes + other.votes
        self.oriented |= other.oriented
        self.views += other.views
        self.latent_views += other.latent_views
        self.size, self.sizes = self.size + other.size, self.sizes + other.sizes
        self.log_odds += other.log_odds
        self.information = self.information + other.information
        self.shared, self.own = self.shared + other.shared, self.own + other.own
        self.frames = deque(sorted({*self.frames, *other.frames})[-MAX_FRAMES:], maxlen=MAX_FRAMES)
        self.passes += other.passes

    def shared_covariance(self) -> Float[np.ndarray, "3 3"]:
        """What the error that all views share adds to the covariance of the position in the world frame, m^2.

        As `shared_errors` has it, but for the poses, which are taken as known.
        """
        if not self.shared.any():
            return np.zeros((3, 3))
        inverted = np.linalg.inv(self.information)
        return np.asarray(inverted @ (self.shared @ self.shared.T - self.own) @ inverted)

    def together_with(self, other: RunningLandmark) -> bool:
        """Whether both were detected in one frame of late: then they are two objects."""
        return not set(self.frames).isdisjoint(other.frames)

    @property
    def category(self) -> int:
        """Most frequent category, -1 for none."""
        return int(np.argmax(self.votes)) if self.votes.sum() > 0 else -1


def new_landmark(number: int, place: int, frame: int, prior: FeaturePrior, symmetry: int) -> RunningLandmark:
    """A landmark without detections."""
    d = len(prior.mean)
    return RunningLandmark(
        number=number,
        place=place,
        first=frame,
        last=frame,
        latent=prior.mean.copy(),
        latent_variance=np.full(d, LARGE_VARIANCE),
        symmetry=symmetry,
        votes=np.zeros(len(prior.categories)),
    )


def count_detections(
    landmarks: list[RunningLandmark],
    error: Float[np.ndarray, "k 3"],
    R_world_camera: Float[np.ndarray, "3 3"],
    covariance: Float[np.ndarray, "k 3 3"],
    score: Float[np.ndarray, " k"],
    noise: NoiseModel,
    shared_root: Float[np.ndarray, "k 3 3"] | None = None,
) -> None:
    """Evidence of detections of one keyframe that their landmarks are objects rather than background (see `map_answers`).

    Args:
        landmarks: the landmark of each detection.
        error: position predicted less observed, in the camera frame, m.
        covariance: of the observed positions in the camera frame, m^2.
        score: log likelihood ratio of each detection's score, object over clutter.
        noise: the rates.
        shared_root: root of what all views of an object err by alike, in the camera frame, m; nothing by default.
    """
    ratio = score - np.log(noise.clutter_intensity)
    information = np.array([j.information for j in landmarks])
    known = np.asarray(information.any(axis=(1, 2)))
    spread = np.linalg.inv(np.where(known.reshape(-1, 1, 1), information, np.eye(3))) + link_scale(noise) ** 2 * np.eye(3)
    value = ratio + log_normal(error, covariance + R_world_camera.T @ spread @ R_world_camera)
    value = np.logaddexp(np.log1p(-RIGHT_TRACK), np.log(RIGHT_TRACK) + value)
    value = np.where(known, value, ratio + np.log(noise.birth_intensity))
    inverted = np.linalg.inv(covariance)
    more = R_world_camera @ inverted @ R_world_camera.T
    alike = R_world_camera @ inverted @ (np.zeros_like(covariance) if shared_root is None else shared_root)
    for k, landmark in enumerate(landmarks):
        landmark.log_odds += float(value[k])
        landmark.information = landmark.information + more[k]
        landmark.shared, landmark.own = landmark.shared + alike[k], landmark.own + alike[k] @ alike[k].T


def variance_between_views(landmarks: list[RunningLandmark], correlation: float) -> Float[np.ndarray, "m d"]:
    """Variances of their latents between views, views of one track alike; LARGE_VARIANCE where none was observed."""
    variance = np.array([j.latent_variance for j in landmarks])
    variance = np.where(variance < 0.5 * LARGE_VARIANCE, variance, LARGE_VARIANCE)
    return correlated_variance(variance, np.array([float(j.latent_views) for j in landmarks]), correlation)


def landmark_features(
    landmarks: list[RunningLandmark], fresh: Int[np.ndarray, " f"], others: list[RunningLandmark], correlation: float
) -> TrackletFeatures:
    """Features of landmarks for loop candidates.

    Args:
        landmarks: those compared.
        fresh: which of them may be the newer one of a pair; how rare a latent is, is needed of these alone.
        others: landmarks of the whole map, which rarity is measured against.
        correlation: of the latents of two views.
    """
    numbers = {j.number for j in landmarks}
    everyone = landmarks + [j for j in others if j.number not in numbers]
    variance = variance_between_views(everyone, correlation)
    rarity = log_population(np.array([j.latent for j in everyone]), variance, fresh)
    count = len(landmarks)
    return TrackletFeatures(
        latent=np.array([j.latent for j in landmarks]),
        latent_variance=variance[:count],
        log_population=rarity[:count],
        category=np.array([j.category for j in landmarks], dtype=np.int64),
        symmetry=np.array([j.symmetry for j in landmarks], dtype=np.int64),
        oriented=np.array([j.oriented for j in landmarks], dtype=bool),
        first=np.array([j.first for j in landmarks], dtype=np.int64),
        last=np.array([j.last for j in landmarks], dtype=np.int64),
    )


class RunningMap:
    """All landmarks of the running graph; merged ones are gone, their numbers point to what took them over."""

    def __init__(self, prior: FeaturePrior) -> None:
        self.prior = prior
        self.landmarks: dict[int, RunningLandmark] = {}
        self.merged: dict[int, int] = {}
        self.numbers = np.zeros(0, dtype=np.int64)
        self.position = np.zeros((0, 3))

    def __len__(self) -> int:
        return len(self.landmarks)

    def add(self, landmark: RunningLandmark, position: Float[np.ndarray, " 3"]) -> None:
        """A new landmark."""
        self.landmarks[landmark.number] = landmark
        self.numbers = np.append(self.numbers, landmark.number)
        self.position = np.concatenate([self.position, position[None]])

    def standing(self, number: int) -> int:
        """The landmark that a number stands for now."""
        while number in self.merged:
            number = self.merged[number]
        return number

    def merge(self, a: int, b: int) -> None:
        """Landmark a is landmark b."""
        self.landmarks[b].absorb(self.landmarks.pop(a))
        self.merged[a] = b
        keep = self.numbers != a
        self.numbers, self.position = self.numbers[keep], self.position[keep]

    def forget(self, numbers: set[int]) -> None:
        """Landmarks that are gone for good."""
        for number in numbers:
            self.landmarks.pop(number, None)
        keep = ~np.isin(self.numbers, list(numbers))
        self.numbers, self.position = self.numbers[keep], self.position[keep]

    def population(self) -> list[RunningLandmark]:
        """A few hundred landmarks of the whole map."""
        chosen = self.numbers[:: max(1, len(self.numbers) // POPULATION)]
        return [self.landmarks[j] for j in chosen.tolist()]

    def near(self, position: Float[np.ndarray, " 3"], radius: Float[np.ndarray, " m"] | float) -> list[int]:
        """Numbers of landmarks within a radius (one, or one each)."""
        return self.numbers[np.linalg.norm(self.position - position, axis=1) < radius].tolist()
