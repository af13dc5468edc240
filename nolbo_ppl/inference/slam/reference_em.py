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
from typing import TYPE_CHECKING

import gtsam
import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl._moved import renamed
from nolbo_ppl.geometry.pose import inverse, make_pose, relative, skew, so3_log, transform
from nolbo_ppl.inference.slam.detection_features import LARGE_VARIANCE, FeaturePrior, fit_prior, latent_log_density
from nolbo_ppl.inference.slam.frame_marginals import frame_marginals
from nolbo_ppl.inference.slam.gaussian import log_normal
from nolbo_ppl.inference.slam.graph import (
    ObservationFactors,
    SlamEstimate,
    add_landmark_priors,
    add_observation_factors,
    landmark_key,
    odometry_factors,
    optimize,
    pose_key,
    to_values,
)
from nolbo_ppl.inference.slam.latent_mixture import LatentMixture
from nolbo_ppl.inference.slam.measurements import Measurements, resolve
from nolbo_ppl.inference.slam.noise.noise_estimation import estimate_noise
from nolbo_ppl.inference.slam.orientation import (
    UNIFORM_LOG_DENSITY,
    angle_log_normaliser,
    nearest_mode_rotation,
    turn_shares,
    vertical_turns,
)
from nolbo_ppl.inference.slam.slam_problem import NoiseModel, SlamConfig, SlamProblem, metric_odometry

SMALLEST_WEIGHT = 1e-10
"""Weights below this are left out of the M-step."""
NO_INFORMATION = 1e5
"""Standard deviation, rad or m, of the part of a factor that says nothing."""


@dataclass(frozen=True)
class Modes:
    """Every detection split into the modes of its orientation: a weighted list of measured rotations."""

    row: Int[np.ndarray, " g"]
    """Detection of each mode."""
    log_weight: Float[np.ndarray, " g"]
    """Log prior weight of the mode over its normaliser, relative to the uniform density on SO(3)."""
    R_camera_landmark: Float[np.ndarray, "g 3 3"]
    """Measured rotation."""
    angle: Float[np.ndarray, "g 3"]
    """Standard deviation of each angle, rad; infinite where it is free."""


@dataclass(frozen=True)
class ReferenceEmState:
    """State of the plain EM."""

    problem: SlamProblem
    """Odometry and observations."""
    config: SlamConfig
    """Settings."""
    noise: NoiseModel
    """Scales in use."""
    prior: FeaturePrior
    """Population of latents."""
    measurements: Measurements
    """Detections, resolved."""
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
class ReferenceEmInfo:
    """What one iteration of the plain EM saw."""

    iteration: int
    """Number of the iteration, from 1."""
    bound: float
    """Log posterior before this iteration's M-step, nats, up to constants that never change."""
    log_evidence: float
    """Its part from the frames."""
    expected_landmarks: Float[np.ndarray, " m"]
    """Sum of the weights of each landmark."""


def split_modes(problem: SlamProblem, measurements: Measurements, config: SlamConfig) -> Modes:
    """All orientation modes of all detections: those stated, symmetry, half turn, and one that says nothing.

    Every mode is a density over position and SO(3), in m^-3 and relative to the uniform density: a detection without an
    orientation, and the part of one that says nothing, are a density of the position alone times one.
    """
    seen = measurements
    R_plain = np.swapaxes(problem.odometry[seen.frame, :3, :3], 1, 2)
    row, log_weight, rotation, scale = [], [], [], []
    oriented = np.flatnonzero(seen.oriented)
    for order in np.unique(seen.symmetry[oriented]):
        k = oriented[seen.symmetry[oriented] == order]
        turns = vertical_turns(int(order)) if order else np.eye(3)[None]
        with np.errstate(divide="ignore"):
            shares = np.log(turn_shares(int(order), len(turns), config) if order else np.ones(1))
        stated = seen.modes.select(k)
        angle = np.broadcast_to(stated.scale[:, :, None], (*stated.scale.shape, len(turns)))
        normaliser = angle_log_normaliser(angle, 3) if order else angle_log_normaliser(angle, 2) + np.log(2 * np.pi)
        value = np.log1p(-config.orientation_outlier) + stated.log_weight[:, :, None] + shares - normaliser
        turned = stated.R[:, :, None] @ turns
        third = angle if order else np.full(angle.shape, np.inf)
        i = np.broadcast_to(k[:, None, None], value.shape)
        use = np.isfinite(value)
        row.append(i[use])
        log_weight.append(value[use] - UNIFORM_LOG_DENSITY)
        rotation.append(turned[use])
        scale.append(np.stack([angle, angle, third], axis=-1)[use])
    for k, weight in ((oriented, config.orientation_outlier), (np.flatnonzero(~seen.oriented), 1.0)):
        if weight > 0:
            row.append(k)
            log_weight.append(np.full(len(k), np.log(weight)))
            rotation.append(R_plain[k])
            scale.append(np.full((len(k), 3), np.inf))
    index, R, angles = np.concatenate(row).astype(np.int64), np.concatenate(rotation), np.concatenate(scale)
    return Modes(index, np.concatenate(log_weight), R, angles)


def em_init(
    problem: SlamProblem,
    config: SlamConfig,
    T_world_landmark: Float[np.ndarray, "m 4 4"],
    latent: Float[np.ndarray, "m d"] | None = None,
    noise: NoiseModel | None = None,
) -> ReferenceEmState:
    """Start from odometry and a given set of landmarks.

    Raises:
        InputError: the problem is malformed.
    """
    noise = noise or estimate_noise(problem, metric_odometry(config, "the reference EM"))
    table = problem.observations
    m = len(T_world_landmark)
    prior = fit_prior(table, config, noise)
    measurements = resolve(table, noise, config, prior)
    distance = np.linalg.norm(table.position, axis=1)
    return ReferenceEmState(
        problem=problem,
        config=config,
        noise=noise,
        prior=prior,
        measurements=measurements,
        modes=split_modes(problem, measurements, config),
        estimate=SlamEstimate(problem.odometry.copy(), np.asarray(T_world_landmark, dtype=np.float64)),
        prior_pose=np.asarray(T_world_landmark, dtype=np.float64),
        latent=np.tile(prior.mean, (m, 1)) if latent is None else np.asarray(latent, dtype=np.float64),
        typical_range=float(np.median(distance)) if len(distance) else 1.0,
    )


def position_log_density(state: ReferenceEmState) -> Float[np.ndarray, "k m"]:
    """Log density of every observed position under every landmark, m^-3."""
    seen = state.measurements
    landmarks = state.estimate.T_world_landmark[:, :3, 3]
    local = transform(inverse(state.estimate.T_world_camera[seen.frame])[:, None], landmarks[None])
    return log_normal(local - seen.position[:, None], seen.covariance[:, None])


def mode_log_density(state: ReferenceEmState) -> Float[np.ndarray, "g m"]:
    """Log density of every mode of every orientation under every landmark over the uniform density, weight included."""
    modes, estimate = state.modes, state.estimate
    frame = state.measurements.frame[modes.row]
    out = np.tile(modes.log_weight[:, None], (1, len(estimate.T_world_landmark)))
    informed, free = np.isfinite(modes.angle[:, 0]), np.isinf(modes.angle[:, 2])
    for rows in (np.flatnonzero(informed & ~free), np.flatnonzero(informed & free)):
        R_world_camera = estimate.T_world_camera[frame[rows], :3, :3]
        predicted = np.swapaxes(R_world_camera, 1, 2)[:, None] @ estimate.T_world_landmark[None, :, :3, :3]
        measured = modes.R_camera_landmark[rows, None]
        if len(rows) and free[rows[0]]:
            # A free axis leaves the tilt: the angle between the two vertical axes.
            up = measured[..., 2] - predicted[..., 2]
            angle = 2 * np.arcsin(np.clip(0.5 * np.linalg.norm(up, axis=-1), 0, 1))
        else:
            angle = np.linalg.norm(so3_log(np.swapaxes(measured, -1, -2) @ predicted), axis=-1)
        out[rows] -= 0.5 * (angle / modes.angle[rows, :1]) ** 2
    return out


def e_step(state: ReferenceEmState) -> tuple[Float[np.ndarray, "g m"], Float[np.ndarray, "k m"], float]:
    """Weights of every mode and of every detection for every landmark, and the log evidence of all frames.

    Orientation and latent enter as ratios to the uniform density on SO(3) and to the population, so that every hypothesis is
    a density over position alone; what is common to all of them is left out of the evidence.
    """
    seen, config, noise = state.measurements, state.config, state.noise
    n, m = len(seen), len(state.estimate.T_world_landmark)
    by_mode = mode_log_density(state)
    log_likelihood = np.full((n, m), -np.inf)
    np.logaddexp.at(log_likelihood, state.modes.row, by_mode)
    share = np.exp(by_mode - log_likelihood[state.modes.row])
    log_likelihood += position_log_density(state) + seen.log_object[:, None]
    if seen.latent.shape[1]:
        known = seen.latent_variance[:, 0] < LARGE_VARIANCE
        latent, variance = seen.latent[known], seen.latent_variance[known]
        population = state.prior.population.log_density(latent, variance)
        if seen.latent_modes is None:
            density = latent_log_density(latent[:, None], state.latent[None], variance[:, None])
        else:
            by_latent, population = _latents_by_mode(state, seen.latent_modes)
            density, population = np.logaddexp.reduce(by_latent[known], axis=1), population[known]
        log_likelihood[known] += density - population[:, None]
    log_null = np.logaddexp(seen.log_object + np.log(noise.birth_intensity), seen.log_clutter + np.log(noise.clutter_intensity))
    k, j = np.nonzero(np.isfinite(log_likelihood))
    found = frame_marginals(seen.frame, k, j, log_likelihood[k, j], log_null, associator=config.associator)
    weights = np.zeros((n, m))
    weights[k, j] = found.weight
    return weights[state.modes.row] * share, weights, float(found.log_evidence.sum())


def _latents_by_mode(state: ReferenceEmState, modes: LatentMixture) -> tuple[Float[np.ndarray, "k L m"], Float[np.ndarray, " k"]]:
    """Log density of every mode of every latent given every landmark's, weight included, and of all in the population."""
    variance = state.measurements.latent_variance[:, None]
    by_mode = [latent_log_density(modes.mean, landmark, variance) for landmark in state.latent]
    population = state.prior.population.log_density_of_modes(modes, variance[:, 0])
    return modes.log_weight[..., None] + np.stack(by_mode, axis=-1), population


def position_factor(
    pose: int, landmark: int, position: Float[np.ndarray, " 3"], covariance: Float[np.ndarray, "3 3"]
) -> gtsam.CustomFactor:
    """An observed position alone: `R'(l - t) - x`. A between-factor's translation is turned by its rotation's error."""

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        keys = factor.keys()
        T_world_camera, T_world_landmark = (values.atPose3(key).matrix() for key in (keys[0], keys[1]))
        R = T_world_camera[:3, :3].T
        local = R @ (T_world_landmark[:3, 3] - T_world_camera[:3, 3])
        if jacobians is not None:
            jacobians[0] = np.concatenate([skew(local), -np.eye(3)], axis=1)
            jacobians[1] = np.concatenate([np.zeros((3, 3)), R @ T_world_landmark[:3, :3]], axis=1)
        return local - position

    model = gtsam.noiseModel.Gaussian.Covariance(covariance)
    return gtsam.CustomFactor(model, [pose_key(pose), landmark_key(landmark)], error)


def frozen_graph(
    state: ReferenceEmState, weights: Float[np.ndarray, "k m"] | None, mode_weights: Float[np.ndarray, "g m"] | None
) -> gtsam.NonlinearFactorGraph:
    """Odometry and priors, and observations at frozen weights when given: a position a pair, a rotation a mode."""
    graph = odometry_factors(state.problem, state.noise)
    add_landmark_priors(graph, state.prior_pose, state.typical_range)
    if weights is None or mode_weights is None:
        return graph
    seen, modes, estimate = state.measurements, state.modes, state.estimate
    for k, j in zip(*np.nonzero(weights > SMALLEST_WEIGHT)):
        graph.add(position_factor(seen.frame[k], j, seen.position[k], seen.covariance[k] / weights[k, j]))
    g, j = np.nonzero((mode_weights > SMALLEST_WEIGHT) & np.isfinite(modes.angle[:, :1]))
    frame, measured = seen.frame[modes.row[g]], modes.R_camera_landmark[g]
    predicted = relative(estimate.T_world_camera[frame], estimate.T_world_landmark[j])[:, :3, :3]
    free = np.isinf(modes.angle[g, 2])
    # Turned about its free axis to the prediction, the two other angles bound the tilt from above and touch it here.
    no_symmetry = np.zeros(int(free.sum()), dtype=np.int64)
    measured[free] = nearest_mode_rotation(predicted[free], measured[free], no_symmetry)
    covariance = np.zeros((len(g), 6, 6))
    covariance[:, [0, 1, 2], [0, 1, 2]] = np.minimum(modes.angle[g], NO_INFORMATION) ** 2
    covariance[:, [3, 4, 5], [3, 4, 5]] = NO_INFORMATION**2
    factors = ObservationFactors(frame, j, make_pose(measured, np.zeros(3)), covariance, mode_weights[g, j], g)
    add_observation_factors(graph, factors, minimum=SMALLEST_WEIGHT)
    return graph


def em_step(state: ReferenceEmState) -> tuple[ReferenceEmState, ReferenceEmInfo]:
    """One E-step and one M-step; the bound is that of the state it was given."""
    mode_weights, weights, evidence = e_step(state)
    prior_error = frozen_graph(state, None, None).error(to_values(state.estimate))
    info = ReferenceEmInfo(state.iteration + 1, evidence - prior_error, evidence, weights.sum(axis=0))
    estimate, _, _ = optimize(frozen_graph(state, weights, mode_weights), state.estimate, iterations=30, relative_tolerance=1e-10)
    latent = state.latent
    value, variance = state.measurements.latent, state.measurements.latent_variance
    if value.shape[1]:
        known = variance[:, 0] < LARGE_VARIANCE
        precision = np.einsum("km,kd->md", weights[known], 1.0 / variance[known])
        total = np.einsum("km,kd->md", weights[known], value[known] / variance[known])
        if state.measurements.latent_modes is not None:  # each mode by its share, as those of orientations
            modes = state.measurements.latent_modes
            by_latent, _ = _latents_by_mode(state, modes)
            share = np.exp(by_latent - np.logaddexp.reduce(by_latent, axis=1, keepdims=True)) * weights[:, None]
            total = np.einsum("klm,kld->md", share[known], modes.mean[known] / variance[known, None])
        latent = np.where(precision > 1e-9, total / np.maximum(precision, 1e-9), state.latent)
    return replace(state, estimate=estimate, latent=latent, iteration=state.iteration + 1), info


def em_solve(
    state: ReferenceEmState, iterations: int = 20, tolerance: float = 1e-4
) -> tuple[ReferenceEmState, tuple[ReferenceEmInfo, ...]]:
    """Iterate until the bound rises by less than `tolerance` nats."""
    infos: list[ReferenceEmInfo] = []
    for _ in range(iterations):
        state, info = em_step(state)
        infos.append(info)
        if len(infos) > 1 and infos[-1].bound - infos[-2].bound < tolerance:
            break
    return state, tuple(infos)


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
