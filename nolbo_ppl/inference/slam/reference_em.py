"""The plain EM of the paper, corrected: a fixed set of landmarks, sensor covariances, and a bound that never falls.

Maximises the log posterior `sum_t log evidence_t(X, L, mu) + log p(odometry | X) + log p(L)` over poses X, landmark
poses L and latents mu, where a frame's evidence sums over all one-to-one associations of its detections with landmarks,
a new object or background, and over the modes of every orientation. E-step: exact marginals. M-step: GTSAM with frozen
weights `w_kj * (share of the mode)` inside the noise models (NOLBO eq. EM_maximization without its second sum over
associations, which counts every detection several times), then the normalised latent update. Either step alone can only
raise the posterior. It closes no loop after drift, since its covariances hold the sensor alone: use `solve` for that.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.geometry.pose import make_pose, relative, se3_log
from nolbo_ppl.inference.association import association_marginals_batch
from nolbo_ppl.inference.slam.detection_features import LARGE_VARIANCE, detection_features, fit_prior, latent_log_density
from nolbo_ppl.inference.slam.graph import (
    LOOSE_ROTATION,
    ObservationFactors,
    SlamEstimate,
    add_landmark_priors,
    add_observation_factors,
    odometry_factors,
    optimise,
    to_values,
)
from nolbo_ppl.inference.slam.noise.noise_estimation import estimate_noise
from nolbo_ppl.inference.slam.orientation import observed_modes, resolved_symmetry, turn_shares, vertical_turns
from nolbo_ppl.inference.slam.slam_problem import NoiseModel, SlamConfig, SlamProblem

SMALLEST_WEIGHT = 1e-12
"""Weights below this are left out of the M-step."""


@dataclass(frozen=True)
class Modes:
    """Every detection split into the modes of its orientation: a weighted list of measured poses."""

    row: Int[np.ndarray, " g"]
    """Detection of each mode."""
    log_weight: Float[np.ndarray, " g"]
    """Log prior weight of the mode."""
    T_camera_landmark: Float[np.ndarray, "g 4 4"]
    """Measured pose."""
    covariance: Float[np.ndarray, "g 6 6"]
    """[rotation, position] in the measured landmark's frame."""


@dataclass(frozen=True)
class PlainState:
    """State of the plain EM."""

    problem: SlamProblem
    """Odometry and observations."""
    config: SlamConfig
    """Settings."""
    noise: NoiseModel
    """Scales in use."""
    modes: Modes
    """Detections by mode."""
    estimate: SlamEstimate
    """Poses and landmarks."""
    prior_pose: Float[np.ndarray, "m 4 4"]
    """Centres of the weak priors on landmarks."""
    latent: Float[np.ndarray, "m d"]
    """Latents of the landmarks."""
    typical_range: float
    """Median range of detections, m."""
    iteration: int = 0
    """Iterations done."""


@dataclass(frozen=True)
class PlainInfo:
    """What one iteration of the plain EM saw."""

    iteration: int
    """Number of the iteration, from 1."""
    bound: float
    """Log posterior before this iteration's M-step, nats, up to constants that never change."""
    log_evidence: float
    """Its part from the frames."""
    expected_landmarks: Float[np.ndarray, " m"]
    """Sum of the weights of each landmark."""


def split_modes(problem: SlamProblem, noise: NoiseModel, config: SlamConfig) -> Modes:
    """All orientation modes of all detections: those stated, symmetry, half turn, and one that says nothing."""
    table = problem.observations
    symmetry = resolved_symmetry(table, config)
    stated = observed_modes(table, noise.rotation_scale)
    rows, weights, rotations, scales = [], [], [], []
    for k in range(len(table)):
        if not table.has_rotation[k]:
            rows.append(k)
            weights.append(0.0)
            rotations.append(problem.odometry[table.frame[k], :3, :3].T)
            scales.append(np.full(3, LOOSE_ROTATION))
            continue
        order = int(symmetry[k])
        turns = vertical_turns(order) if order else np.eye(3)[None]
        shares = turn_shares(order, len(turns), config) if order else np.ones(1)
        for log_weight, R_mode, angle in zip(stated.log_weight[k], stated.R[k], stated.scale[k]):
            if not np.isfinite(log_weight):
                continue
            for share, turn in zip(shares, turns):
                scale = np.full(3, angle)
                if order == 0:
                    scale[2] = LOOSE_ROTATION
                rows.append(k)
                weights.append(np.log1p(-config.orientation_outlier) + log_weight + np.log(max(share, 1e-300)))
                rotations.append(R_mode @ turn)
                scales.append(scale)
        rows.append(k)
        weights.append(np.log(config.orientation_outlier))
        rotations.append(table.rotation[k])
        scales.append(np.full(3, LOOSE_ROTATION))
    row = np.array(rows, dtype=np.int64)
    R = np.array(rotations).reshape(-1, 3, 3)
    covariance = np.zeros((len(row), 6, 6))
    covariance[:, [0, 1, 2], [0, 1, 2]] = np.array(scales).reshape(-1, 3) ** 2
    covariance[:, 3:, 3:] = np.swapaxes(R, 1, 2) @ noise.position_covariance[row] @ R
    return Modes(row, np.array(weights), make_pose(R, table.position[row].reshape(-1, 3)), covariance)


def plain_init(
    problem: SlamProblem,
    config: SlamConfig,
    T_world_landmark: Float[np.ndarray, "m 4 4"],
    latent: Float[np.ndarray, "m d"] | None = None,
    noise: NoiseModel | None = None,
) -> PlainState:
    """Start from odometry and a given set of landmarks.

    Raises:
        InputError: the problem is malformed.
    """
    noise = noise or estimate_noise(problem, config)
    table = problem.observations
    m = len(T_world_landmark)
    mean = fit_prior(table, config).mean
    distance = np.linalg.norm(table.position, axis=1)
    return PlainState(
        problem=problem,
        config=config,
        noise=noise,
        modes=split_modes(problem, noise, config),
        estimate=SlamEstimate(problem.odometry.copy(), np.asarray(T_world_landmark, dtype=np.float64)),
        prior_pose=np.asarray(T_world_landmark, dtype=np.float64),
        latent=np.tile(mean, (m, 1)) if latent is None else np.asarray(latent, dtype=np.float64),
        typical_range=float(np.median(distance)) if len(distance) else 1.0,
    )


def mode_log_likelihood(state: PlainState) -> Float[np.ndarray, "g m"]:
    """Log density of every mode of every detection under every landmark, weight of the mode included."""
    modes, m = state.modes, len(state.estimate.T_world_landmark)
    frame = state.problem.observations.frame[modes.row]
    whitening = np.linalg.inv(np.linalg.cholesky(modes.covariance))
    log_normaliser = np.sum(np.log(np.diagonal(whitening, axis1=1, axis2=2)), axis=1) - 3 * np.log(2 * np.pi)
    out = np.empty((len(modes.row), m))
    for j, T_world_landmark in enumerate(state.estimate.T_world_landmark):
        predicted = relative(state.estimate.T_world_camera[frame], T_world_landmark[None])
        error = se3_log(relative(modes.T_camera_landmark, predicted))  # as GTSAM's BetweenFactorPose3
        white = np.einsum("gij,gj->gi", whitening, error)
        out[:, j] = modes.log_weight - 0.5 * np.sum(white**2, axis=1) + log_normaliser
    return out


def e_step(state: PlainState) -> tuple[Float[np.ndarray, "g m"], Float[np.ndarray, "k m"], float]:
    """Weights of every mode and of every detection for every landmark, and the log evidence of all frames."""
    table, config, noise = state.problem.observations, state.config, state.noise
    n, m = len(table), len(state.estimate.T_world_landmark)
    by_mode = mode_log_likelihood(state)
    log_likelihood = np.full((n, m), -np.inf)
    np.logaddexp.at(log_likelihood, state.modes.row, by_mode)
    share = np.exp(by_mode - log_likelihood[state.modes.row])
    latent, variance, _ = detection_features(table, noise, fit_prior(table, config))
    if table.latent_dim:
        known = variance[:, 0] < LARGE_VARIANCE
        log_likelihood[known] += latent_log_density(latent[known][:, None], state.latent[None], variance[known][:, None])
    objectness = np.clip(table.objectness, *config.objectness_limits)
    log_new = np.log(objectness) + np.log(noise.new_rate)
    if table.latent_dim:
        # A new object's latent comes from the population; background shows the same, so that the terms compare.
        population = np.zeros(n)
        if known.any():
            mean, spread = latent[known].mean(axis=0), latent[known].var(axis=0)
            population[known] = latent_log_density(latent[known], mean, variance[known] + spread)
    else:
        population = np.zeros(n)
    log_null = np.logaddexp(log_new, np.log1p(-objectness) + np.log(noise.clutter_rate)) + population
    log_likelihood += np.log(objectness)[:, None]
    order = np.argsort(table.frame, kind="stable")
    frames, starts = np.unique(table.frame[order], return_index=True)
    groups = np.split(order, starts[1:]) if len(frames) else []
    results = (
        association_marginals_batch([(log_likelihood[g], log_null[g]) for g in groups], associator=config.associator)
        if groups
        else []
    )
    weights = np.zeros((n, m))
    for group, result in zip(groups, results):
        weights[group] = result.weights
    return weights[state.modes.row] * share, weights, float(sum(r.log_evidence for r in results))


def frozen_graph(state: PlainState, mode_weights: Float[np.ndarray, "g m"] | None) -> gtsam.NonlinearFactorGraph:
    """Odometry and priors, and observations at frozen weights when given."""
    graph = odometry_factors(state.problem, state.noise)
    add_landmark_priors(graph, state.prior_pose, state.typical_range)
    if mode_weights is not None:
        g, j = np.nonzero(mode_weights > SMALLEST_WEIGHT)
        factors = ObservationFactors(
            state.problem.observations.frame[state.modes.row[g]],
            j,
            state.modes.T_camera_landmark[g],
            state.modes.covariance[g],
            mode_weights[g, j],
        )
        add_observation_factors(graph, factors, minimum=SMALLEST_WEIGHT)
    return graph


def plain_step(state: PlainState) -> tuple[PlainState, PlainInfo]:
    """One E-step and one M-step; the bound is that of the state it was given."""
    mode_weights, weights, evidence = e_step(state)
    prior_error = frozen_graph(state, None).error(to_values(state.estimate))
    info = PlainInfo(state.iteration + 1, evidence - prior_error, evidence, weights.sum(axis=0))
    estimate, _, _ = optimise(frozen_graph(state, mode_weights), state.estimate, iterations=30, relative_tolerance=1e-10)
    latent = state.latent
    table = state.problem.observations
    if table.latent_dim:
        value, variance, _ = detection_features(table, state.noise, fit_prior(table, state.config))
        known = variance[:, 0] < LARGE_VARIANCE
        precision = np.einsum("km,kd->md", weights[known], 1.0 / variance[known])
        total = np.einsum("km,kd->md", weights[known], value[known] / variance[known])
        latent = np.where(precision > 1e-9, total / np.maximum(precision, 1e-9), state.latent)
    return replace(state, estimate=estimate, latent=latent, iteration=state.iteration + 1), info


def plain_solve(state: PlainState, iterations: int = 20, tolerance: float = 1e-4) -> tuple[PlainState, tuple[PlainInfo, ...]]:
    """Iterate until the bound rises by less than `tolerance` nats."""
    infos: list[PlainInfo] = []
    for _ in range(iterations):
        state, info = plain_step(state)
        infos.append(info)
        if len(infos) > 1 and infos[-1].bound - infos[-2].bound < tolerance:
            break
    return state, tuple(infos)
