"""Are the probabilities that a map states true? Every one of them beside what happened, where truth is at hand.

Poses, landmark positions, orientations and latents as regions (NEES, coverage at five levels, probability integral transform);
existence, background, category and association as probabilities (reliability, log score, calibration error beside that of a
perfect forecaster). The same numbers stand in `summary.json`, in the report and in `benchmarks/calibration.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.special import gammainc

from nolbo_ppl.geometry.pose import inverse, relative, se3_log, so3_exp, so3_log
from nolbo_ppl.inference.slam import SlamResult
from nolbo_ppl.io.true_objects import CLUTTER, UNKNOWN, TrueObjects
from nolbo_ppl.metrics.association import landmark_to_object, normalised_error_squared
from nolbo_ppl.metrics.stated_probabilities import probability_record, region_record
from nolbo_ppl.metrics.trajectory import known_rows

MOST_POSES = 60
"""Poses whose errors are looked at, evenly spread: neighbours say the same."""
HALF_TURN = so3_exp(np.array([0.0, 0.0, np.pi]))
"""About the object's vertical axis: an orientation may be flipped as a whole."""

Cases = tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]
"""Stated probabilities and whether it happened (0 or 1)."""


@dataclass(frozen=True)
class Regions:
    """Normalised squared errors of some quantity."""

    squared: Float[np.ndarray, " n"]
    """Squared Mahalanobis distance of each truth."""
    degrees: int
    """Degrees of freedom."""

    @property
    def mass(self) -> Float[np.ndarray, " n"]:
        """Mass of the region that reaches to each truth: the probability integral transform."""
        return np.asarray(gammainc(self.degrees / 2, self.squared / 2))


def landmark_objects(
    result: SlamResult, object_of: Int[np.ndarray, " k"]
) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """True object of each landmark (`CLUTTER`: none), the one most of its associations are of; and the real share of these.

    Detections of which nobody knows what they are of are left out; landmarks of nothing else are `UNKNOWN`.
    """
    found, m = result.associations, len(result.state.static)
    known = object_of[found.row] != UNKNOWN
    of, landmark, weight = object_of[found.row[known]], found.landmark[known], found.weight[known]
    owner, share = landmark_to_object(of, landmark, m, weight)
    total, clutter = np.bincount(landmark, weight, m), np.bincount(landmark, weight * (of == CLUTTER), m)
    return np.where(share > 0, owner, UNKNOWN), 1 - clutter / np.maximum(total, 1e-9)


def background_cases(result: SlamResult, object_of: Int[np.ndarray, " k"]) -> Cases:
    """Probability of each detection being no object."""
    known = object_of != UNKNOWN
    return result.associations.background[known], (object_of[known] == CLUTTER).astype(np.float64)


def existence_cases(result: SlamResult, object_of: Int[np.ndarray, " k"]) -> Cases:
    """Probability of each landmark being an object; it is one where most of its detections are of one."""
    owner, real = landmark_objects(result, object_of)
    known = owner != UNKNOWN
    return result.existence()[known], (real[known] > 0.5).astype(np.float64)


def class_cases(result: SlamResult, object_of: Int[np.ndarray, " k"], category: tuple[str | None, ...]) -> Cases:
    """Probability of the likeliest category of each landmark that is an object of a known one, and whether it is right."""
    owner, _ = landmark_objects(result, object_of)
    stated, right = [], []
    for landmark, o in zip(result.landmarks, owner):
        if o >= 0 and landmark.class_posterior and category[o] is not None:
            best = max(landmark.class_posterior, key=landmark.class_posterior.__getitem__)
            stated.append(min(landmark.class_posterior[best], 1.0))
            right.append(float(best == category[o]))
    return np.array(stated), np.array(right)


def association_cases(result: SlamResult, object_of: Int[np.ndarray, " k"], few: bool = False) -> Cases:
    """Probability of every listed pair of a detection and a landmark, and whether its object is that of the landmark's others.

    Detections of which nobody knows what they are of neither count nor say what the landmark is.

    Args:
        result: the answer.
        object_of: true object of each detection.
        few: only likely pairs (above one half) of landmarks of two or three detections.
    """
    found = result.associations
    hits = np.bincount(found.landmark, found.weight, minlength=len(result.state.static))
    stated, right = [], []
    order = np.argsort(found.landmark, kind="stable")
    names, start = np.unique(found.landmark[order], return_index=True)
    for j, mine in zip(names, np.split(order, start[1:])):
        of, weight = object_of[found.row[mine]], found.weight[mine]
        for k in range(len(mine)):
            others = (np.arange(len(mine)) != k) & (of != UNKNOWN)
            if of[k] == UNKNOWN or not others.any():
                continue
            objects, inverse_index = np.unique(of[others], return_inverse=True)
            most = objects[np.argmax(np.bincount(inverse_index, weight[others]))]
            if few and not (1.5 < hits[j] < 3.5 and weight[k] > 0.5):
                continue
            stated.append(min(float(weight[k]), 1.0))
            right.append(float(most >= 0 and of[k] == most))
    return np.array(stated), np.array(right)


def pose_regions(result: SlamResult, truth: Float[np.ndarray, "n 4 4"], every: int | None = None) -> Regions:
    """Errors of poses, the first one held fixed as in the covariances.

    Args:
        result: the answer.
        truth: true poses of the same rows in any world; NaN where they are not known.
        every: distance of the poses looked at; `MOST_POSES` of them when it is not given.
    """
    known = known_rows(truth)
    if len(truth) < 2 or not known[0]:
        return Regions(np.zeros(0), 6)
    every = every or max(1, len(truth) // MOST_POSES)
    rows = np.arange(every, len(truth), every)
    rows = rows[known[rows]]
    moved = world_of_truth(result, truth) @ truth[rows]
    error = se3_log(relative(result.T_world_camera[rows], moved))
    return Regions(6 * normalised_error_squared(error, result.pose_covariances(rows)), 6)


def world_of_truth(result: SlamResult, truth: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "4 4"]:
    """The truth's world in the answer's, by the first pose, which the covariances hold fixed."""
    return np.asarray(result.T_world_camera[0] @ inverse(truth[0]))


def landmark_regions(result: SlamResult, objects: TrueObjects, T_world_truth: Float[np.ndarray, "4 4"]) -> dict[str, Regions]:
    """Errors of positions, orientations (up to a half turn) and latents of the landmarks that are objects.

    Args:
        result: the answer.
        objects: the truth.
        T_world_truth: the truth's world in the answer's.
    """
    owner, _ = landmark_objects(result, objects.object_of)
    position, orientation, latent = [], [], []
    dimensions = 1
    for landmark, o in zip(result.landmarks, owner):
        if o < 0:
            continue
        T = T_world_truth @ objects.T_world_object[o]
        if np.isfinite(T).all():
            error = landmark.T_world_object[:3, 3] - T[:3, 3]
            position.append(error @ np.linalg.solve(landmark.position_covariance, error))
            if landmark.oriented:
                R = landmark.T_world_object[:3, :3].T @ T[:3, :3]
                error = min((so3_log(R), so3_log(R @ HALF_TURN)), key=lambda v: float(v @ v))
                orientation.append(error @ np.linalg.solve(landmark.covariance[:3, :3], error))
        if objects.latent is not None and landmark.latent is not None and landmark.latent_variance is not None:
            dimensions = len(landmark.latent)
            if objects.latent.shape[1] == dimensions and np.isfinite(objects.latent[o]).all():
                latent.append(np.sum((landmark.latent - objects.latent[o]) ** 2 / landmark.latent_variance))
    return {
        "landmark_position": Regions(np.array(position), 3),
        "landmark_orientation": Regions(np.array(orientation), 3),
        "landmark_latent": Regions(np.array(latent), dimensions),
    }


def map_calibration(
    result: SlamResult, truth: Float[np.ndarray, "n 4 4"] | None = None, objects: TrueObjects | None = None
) -> dict[str, Any]:
    """Everything the map states beside the truth, as `summary.json` holds it; what no truth is known of is left out.

    One drive holds few independent cases: poses of one drive share their drift. Read coverages over many drives
    (`benchmarks/calibration.py`).

    Args:
        result: the answer.
        truth: true poses of the same rows.
        objects: true object of each detection, and where they stand.

    Example:
        >>> import nolbo_ppl
        >>> from nolbo_ppl.data.simulate import WorldConfig, simulate_circuit, simulate_sequence
        >>> rng = np.random.default_rng(0)
        >>> drive = simulate_sequence(simulate_circuit(rng, frames_per_lap=30), rng, world=WorldConfig(objects=15))
        >>> result = nolbo_ppl.solve(nolbo_ppl.SlamProblem(drive.odometry, drive.observations))
        >>> sorted(map_calibration(result, drive.truth)["regions"])
        ['pose']
    """
    regions: dict[str, Regions] = {}
    if truth is not None:
        regions["pose"] = pose_regions(result, truth)
    probabilities: dict[str, Cases] = {}
    if objects is not None:
        of = objects.object_of
        probabilities = {
            "background": background_cases(result, of),
            "existence": existence_cases(result, of),
            "category": class_cases(result, of, objects.category),
            "association": association_cases(result, of),
        }
        if truth is not None and known_rows(truth)[0]:
            regions |= landmark_regions(result, objects, world_of_truth(result, truth))
    return {
        "regions": {
            name: region_record(found.mass, found.squared, found.degrees) for name, found in regions.items() if len(found.squared)
        },
        "probabilities": {name: probability_record(*cases) for name, cases in probabilities.items() if len(cases[0])},
    }
