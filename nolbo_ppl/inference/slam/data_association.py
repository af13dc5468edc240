"""The E-step of single detections against a map: exact marginals of every frame, with new-landmark and background odds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.geometry.pose import inverse, transform
from nolbo_ppl.inference.association import association_marginals_batch
from nolbo_ppl.inference.slam.detection_features import FeaturePrior, detection_features
from nolbo_ppl.inference.slam.gaussian import squared_distance
from nolbo_ppl.inference.slam.graph import Linearisation, SlamEstimate
from nolbo_ppl.inference.slam.loop_candidates import TrackletFeatures
from nolbo_ppl.inference.slam.orientation import UNIFORM_LOG_DENSITY, mixture_log_density, observed_modes, resolved_symmetry
from nolbo_ppl.inference.slam.slam_problem import NoiseModel, SlamConfig, SlamProblem

GATE = 25.0
"""Squared Mahalanobis distance beyond which a detection is no candidate for a landmark."""


@dataclass(frozen=True)
class Associations:
    """Marginal association of every detection, sparse: rows of the table, landmark numbers, probabilities."""

    row: Int[np.ndarray, " p"]
    """Detection of each entry."""
    landmark: Int[np.ndarray, " p"]
    """Landmark of each entry."""
    weight: Float[np.ndarray, " p"]
    """Its probability."""
    new: Float[np.ndarray, " k"]
    """Probability of each detection being an object the map does not hold."""
    background: Float[np.ndarray, " k"]
    """Probability of each detection being no object."""
    log_evidence: Float[np.ndarray, " f"]
    """Log evidence of each frame with detections, nats."""
    exact: bool
    """Whether every frame was summed exactly."""


def associate_detections(
    problem: SlamProblem,
    noise: NoiseModel,
    config: SlamConfig,
    prior: FeaturePrior,
    estimate: SlamEstimate,
    features: TrackletFeatures,
    linearisation: Linearisation,
    rng: np.random.Generator,
) -> Associations:
    """Marginals of all detections over the landmarks of a map.

    Detection k of frame t is landmark j with odds `q(o) N(x_k; x(T_t, l_j), S + relative covariance) ...`, a new object
    with `q(o) lambda_new`, background with `(1 - q(o)) lambda_clutter`.
    """
    table = problem.observations
    n, m = len(table), len(estimate.T_world_landmark)
    objectness = np.clip(table.objectness, *config.objectness_limits)
    log_new = np.log(objectness) + np.log(noise.new_rate)
    log_background = np.log1p(-objectness) + np.log(noise.clutter_rate)
    log_null = np.logaddexp(log_new, log_background)
    pose_delta, landmark_delta = linearisation.samples(min(config.samples, 48), rng)
    rows, landmarks, square, log_det = _gated(problem, noise, estimate, pose_delta, landmark_delta)
    value = np.log(objectness[rows]) - 0.5 * (square + log_det)
    latent, variance, category = detection_features(table, noise, prior)
    value += prior.pair_log_ratio(
        latent[rows],
        variance[rows],
        category[rows],
        features.latent[landmarks],
        features.latent_variance[landmarks],
        features.category[landmarks],
    )
    both = np.flatnonzero(table.has_rotation[rows] & features.oriented[landmarks])
    if len(both):
        k, j = rows[both], landmarks[both]
        predicted = np.swapaxes(estimate.T_world_camera[table.frame[k], :3, :3], 1, 2) @ estimate.T_world_landmark[j, :3, :3]
        scale = np.sqrt(noise.rotation_scale**2 + 0.02**2)
        modes = observed_modes(table, scale, k)
        value[both] += mixture_log_density(predicted, modes, resolved_symmetry(table, config)[k], config) - UNIFORM_LOG_DENSITY
    return _marginals(table.frame, rows, landmarks, value, log_null, log_new, n, m, config)


def _gated(
    problem: SlamProblem, noise: NoiseModel, estimate: SlamEstimate, pose_delta: np.ndarray, landmark_delta: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Detection-landmark pairs inside the gate: rows, landmarks, squared distances and log determinants of 2 pi S."""
    table = problem.observations
    position = estimate.T_world_landmark[:, :3, 3]
    world = transform(estimate.T_world_camera[table.frame], table.position)
    count = pose_delta.shape[2]
    R_landmark, R_camera = estimate.T_world_landmark[:, :3, :3], estimate.T_world_camera[:, :3, :3]
    moved_landmark = np.einsum("mij,mjs->mis", R_landmark, landmark_delta[:, 3:])
    scale = np.sqrt(np.trace(noise.position_covariance, axis1=1, axis2=2))
    out: list[tuple[np.ndarray, ...]] = []
    for start in range(0, len(table), 2000):
        part = np.arange(start, min(start + 2000, len(table)))
        distance = np.linalg.norm(world[part, None] - position[None], axis=2)
        # A generous first gate on the sensor's scale plus a fifth of the range for the relative pose.
        reach = 5 * scale[part] + 0.2 * np.linalg.norm(table.position[part], axis=1)
        i, j = np.nonzero(distance < reach[:, None])
        k = part[i]
        frame = table.frame[k]
        local = transform(inverse(estimate.T_world_camera[frame]), position[j])
        error = local - table.position[k]
        # Deviation of the landmark in the camera's frame: R'(dp - R v) - omega x local.
        deviation = np.einsum("pji,pjs->pis", R_camera[frame], moved_landmark[j]) - pose_delta[frame, 3:]
        deviation -= np.cross(pose_delta[frame, :3], local[:, :, None], axis=1)
        S = noise.position_covariance[k] + deviation @ np.swapaxes(deviation, 1, 2) / count
        squared, log_determinant = squared_distance(error, S)
        inside = squared < GATE
        out.append((k[inside], j[inside], squared[inside], log_determinant[inside]))
    if not out:
        empty = np.zeros(0, dtype=np.int64)
        return empty, empty, np.zeros(0), np.zeros(0)
    rows, landmarks, square, log_det = (np.concatenate(x) for x in zip(*out))
    return rows, landmarks, square, log_det


def _marginals(
    frame: np.ndarray,
    rows: np.ndarray,
    landmarks: np.ndarray,
    value: np.ndarray,
    log_null: np.ndarray,
    log_new: np.ndarray,
    n: int,
    m: int,
    config: SlamConfig,
) -> Associations:
    order = np.argsort(frame, kind="stable")
    frames, starts = np.unique(frame[order], return_index=True)
    groups = np.split(order, starts[1:]) if len(frames) else []
    by_row = np.argsort(rows, kind="stable")
    sorted_rows = rows[by_row]
    problems, columns_of = [], []
    for group in groups:
        spans = [by_row[np.searchsorted(sorted_rows, k, "left") : np.searchsorted(sorted_rows, k, "right")] for k in group]
        entries = np.concatenate(spans)
        columns, column = np.unique(landmarks[entries], return_inverse=True)
        log_likelihood = np.full((len(group), len(columns)), -np.inf)
        log_likelihood[np.repeat(np.arange(len(group)), [len(s) for s in spans]), column] = value[entries]
        problems.append((log_likelihood, log_null[group]))
        columns_of.append(columns)
    marginals = association_marginals_batch(problems, associator=config.associator) if problems else []
    out_row, out_landmark, out_weight = [], [], []
    null = np.ones(n)
    for group, columns, result in zip(groups, columns_of, marginals):
        null[group] = result.null
        i, j = np.nonzero(np.asarray(result.weights) > 1e-4)
        out_row.append(group[i])
        out_landmark.append(columns[j])
        out_weight.append(np.asarray(result.weights)[i, j])
    new = null * np.exp(log_new - log_null)
    stack = (lambda x, t: np.concatenate(x).astype(t)) if out_row else (lambda x, t: np.zeros(0, t))
    return Associations(
        row=stack(out_row, np.int64),
        landmark=stack(out_landmark, np.int64),
        weight=stack(out_weight, np.float64),
        new=new,
        background=np.maximum(null - new, 0.0),
        log_evidence=np.array([r.log_evidence for r in marginals]),
        exact=all(r.exact for r in marginals),
    )
