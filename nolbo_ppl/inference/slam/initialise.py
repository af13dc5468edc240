"""`init`: scales, tracklets, and the graph of odometry and tracklets solved for the first time."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.geometry.pose import inverse, make_pose, transform
from nolbo_ppl.inference.slam.detection_features import (
    LARGE_VARIANCE,
    FeaturePrior,
    correlated_variance,
    fit_prior,
    weighted_latents,
)
from nolbo_ppl.inference.slam.gaussian import position_log_density, squared_distance
from nolbo_ppl.inference.slam.graph import LandmarkEqualities, SlamEstimate, add_landmark_equalities, optimize
from nolbo_ppl.inference.slam.latent_mixture import chosen_modes
from nolbo_ppl.inference.slam.linearisation import Linearisation, linearise
from nolbo_ppl.inference.slam.loop_candidates import TrackletFeatures, log_population
from nolbo_ppl.inference.slam.measurements import Measurements, resolve
from nolbo_ppl.inference.slam.noise.absurd_values import without_absurd_values
from nolbo_ppl.inference.slam.noise.noise_estimation import estimate_noise
from nolbo_ppl.inference.slam.noise.odometry_noise import odometry_by_evidence, stated_sigmas
from nolbo_ppl.inference.slam.noise.odometry_scale import metric_problem
from nolbo_ppl.inference.slam.noise.residual_calibration import calibrate
from nolbo_ppl.inference.slam.orientation import OrientationModes, mixture_log_density
from nolbo_ppl.inference.slam.slam_problem import NoiseModel, SlamConfig, SlamProblem
from nolbo_ppl.inference.slam.slam_state import SlamState, measured_graph
from nolbo_ppl.inference.slam.tracking import Tracklets, build_tracklets

RETRACK = 2.5
"""Growth of an odometry scale beyond which objects are tracked anew."""


def first_estimate(
    measurements: Measurements,
    T_world_camera: Float[np.ndarray, "n 4 4"],
    config: SlamConfig,
    rows: Int[np.ndarray, " k"],
    landmark: Int[np.ndarray, " k"],
    landmarks: int,
) -> SlamEstimate:
    """Landmarks at the weighted mean of their detections under the given poses, oriented as most of them agree."""
    seen = measurements.select(rows)
    seen = seen.in_world(T_world_camera[seen.frame])
    world = seen.position
    w = 1.0 / np.maximum(np.trace(seen.covariance, axis1=1, axis2=2), 1e-12)
    total = np.bincount(landmark, weights=w, minlength=landmarks)
    mean = np.stack([np.bincount(landmark, weights=w * world[:, i], minlength=landmarks) for i in range(3)], axis=1)
    T = make_pose(np.tile(np.eye(3), (landmarks, 1, 1)), mean / np.maximum(total, 1e-300)[:, None])
    symmetry = seen.symmetry
    oriented = np.flatnonzero(seen.oriented)
    modes = seen.modes.select(oriented)
    modes = OrientationModes(modes.log_weight, modes.R, np.maximum(modes.scale, 0.05))
    order = np.argsort(landmark[oriented], kind="stable")
    groups, starts = np.unique(landmark[oriented][order], return_index=True)
    for j, members in zip(groups, np.split(order, starts[1:])):
        # The mode most detections agree with: a mean would fall between flips.
        members = members[np.linspace(0, len(members) - 1, min(len(members), 12)).astype(int)]
        candidates = modes.R[members][np.isfinite(modes.log_weight[members])]
        a, b = np.repeat(np.arange(len(candidates)), len(members)), np.tile(members, len(candidates))
        value = mixture_log_density(candidates[a], modes.select(b), symmetry[oriented[b]], config)
        T[j, :3, :3] = candidates[np.argmax(value.reshape(len(candidates), -1).sum(axis=1))]
    return SlamEstimate(T_world_camera.copy(), T)


def base_graph(state: SlamState) -> gtsam.NonlinearFactorGraph:
    """Odometry, weighted observations and weak priors; the M-step adds its links."""
    return measured_graph(state)[0]


def distances_to_landmarks(state: SlamState) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Squared distance of each detection in the graph from its landmark at the estimate, in the sensor's covariance, and the log
    determinant of that (of 2 pi times it, as `squared_distance`)."""
    seen = state.measurements.select(state.rows)
    T_camera_world = inverse(state.estimate.T_world_camera[seen.frame])
    error = transform(T_camera_world, state.estimate.T_world_landmark[state.landmark, :3, 3]) - seen.position
    return squared_distance(error, seen.covariance)


def inlier_weights(state: SlamState) -> Float[np.ndarray, " k"]:
    """Probability of each detection in the graph being its object rather than background, given the estimate.

    Odds are objectness times the density of the position about the prediction, against the clutter density. This is how
    gross errors leave the graph: by evidence, with weights frozen through the next M-step.
    """
    seen = state.measurements.select(state.rows)
    log_object = seen.log_object + position_log_density(*distances_to_landmarks(state), state.noise.position_dof)
    log_background = seen.log_clutter + np.log(state.noise.clutter_intensity)
    return 1.0 / (1.0 + np.exp(np.clip(log_background - log_object, -500, 500)))


def tracklet_features(
    measurements: Measurements,
    config: SlamConfig,
    prior: FeaturePrior,
    rows: Int[np.ndarray, " k"],
    landmark: Int[np.ndarray, " k"],
    weight: Float[np.ndarray, " k"],
    landmarks: int,
) -> TrackletFeatures:
    """Latent posterior, category, symmetry and life span of each landmark from its detections."""
    seen = measurements.select(rows)
    category = seen.category
    latent = seen.latent
    if seen.latent_modes is not None:
        chosen = chosen_modes(seen.latent_modes, seen.latent_variance, landmark, weight)
        latent = seen.latent_modes.mean[np.arange(len(rows)), chosen]
        category = np.where(chosen == seen.latent_modes.heaviest, category, -1)  # what it names goes with the heaviest mode
    mean, spread = weighted_latents(latent, seen.latent_variance, landmark, weight, landmarks)
    known = (seen.latent_variance < LARGE_VARIANCE).all(axis=1) if mean.shape[1] else np.zeros(len(rows), bool)
    views = np.bincount(landmark, weights=weight * known, minlength=landmarks)
    spread = correlated_variance(spread, views, config.latent_correlation or 0.0)
    votes = np.zeros((landmarks, len(prior.categories) + 1))
    named = category >= 0
    np.add.at(votes, (landmark[named], category[named]), weight[named])
    best = np.where(votes.sum(axis=1) > 0, np.argmax(votes, axis=1), -1)
    symmetry = np.ones(landmarks, dtype=np.int64)
    symmetry[landmark] = seen.symmetry
    oriented = np.zeros(landmarks, dtype=bool)
    oriented[landmark[seen.oriented]] = True
    first, last = np.full(landmarks, measurements.frame.max(initial=-1) + 1), np.full(landmarks, -1)
    np.minimum.at(first, landmark, seen.frame)
    np.maximum.at(last, landmark, seen.frame)
    return TrackletFeatures(mean, spread, log_population(mean, spread), best, symmetry, oriented, first, last)


def linearise_state(state: SlamState) -> Linearisation:
    """Linearise the graph with its links at the estimate, each link by its robust weight there."""

    graph = base_graph(state)
    add_landmark_equalities(graph, state.links, state.config.robust_width)
    return linearise(graph, state.estimate)


def init(problem: SlamProblem, config: SlamConfig) -> SlamState:
    """Scales, tracklets, and the graph of odometry and tracklets solved once; no loop is closed yet.

    Raises:
        InputError: the problem is malformed (see `SlamProblem`).
        GraphError: GTSAM could not solve the graph.
    """
    problem, set_aside = without_absurd_values(problem)
    metric = metric_problem(problem, config)
    problem = metric.problem
    noise = estimate_noise(problem, config)
    noise = replace(noise, warnings=(*set_aside, *metric.warnings, *noise.warnings), scale_walk=metric.walk)
    prior = fit_prior(problem.observations, config, noise)
    tracklets = build_tracklets(problem, noise, config, prior)
    state = init_from_tracklets(problem, config, noise, prior, tracklets, metric.factor)
    if all(stated_sigmas(problem, config)) or not len(tracklets):
        return state
    # Tracks were broken where the default scales were much too small: track once more with the better ones.
    growth = (
        np.median(state.noise.rotation_step / noise.rotation_step),
        np.median(state.noise.translation_step / noise.translation_step),
    )
    if max(growth) < RETRACK:
        return state
    noise = replace(noise, rotation_step=state.noise.rotation_step, translation_step=state.noise.translation_step)
    tracklets = build_tracklets(problem, noise, config, prior)
    return init_from_tracklets(problem, config, noise, prior, tracklets, metric.factor)


def init_from_tracklets(
    problem: SlamProblem,
    config: SlamConfig,
    noise: NoiseModel,
    prior: FeaturePrior,
    tracklets: Tracklets,
    odometry_scale: Float[np.ndarray, " n-1"] | None = None,
) -> SlamState:
    """The second half of `init`, for tracklets that came from elsewhere (the online tracker)."""
    static = np.flatnonzero(~tracklets.moving)
    number = np.full(len(tracklets) + 1, -1)
    number[static] = np.arange(len(static))
    landmark = number[tracklets.of_observation]
    rows = np.flatnonzero(landmark >= 0)
    landmark, weight = landmark[rows], tracklets.weight[rows]
    distance = np.linalg.norm(problem.observations.position, axis=1)
    measurements = resolve(problem.observations, noise, config, prior)
    estimate = first_estimate(measurements, problem.odometry, config, rows, landmark, len(static))
    state = SlamState(
        problem=problem,
        config=config,
        noise=noise,
        prior=prior,
        tracklets=tracklets,
        static=static,
        rows=rows,
        landmark=landmark,
        weight=weight,
        features=tracklet_features(measurements, config, prior, rows, landmark, weight, len(static)),
        estimate=replace(estimate, scale=None if odometry_scale is None else np.ones(len(problem) - 1)),
        odometry_scale=odometry_scale,
        links=LandmarkEqualities.none(),
        typical_range=float(np.median(distance)) if len(distance) else 1.0,
    )
    for repeat in range(3):
        estimate, _, error = optimize(base_graph(state), state.estimate, iterations=10 if repeat == 0 else 4)
        state = replace(state, estimate=estimate, graph_error=error)
        state = calibrate(state) if repeat < 2 else state
        state = replace(state, weight=inlier_weights(state))
        if repeat == 0:
            state = odometry_by_evidence(state)
    return state
