"""The baseline every association is measured against: the same graph with true associations, solved by plain LM."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Int

from nolbo_ppl.errors import input_error
from nolbo_ppl.inference.slam.detection_features import fit_prior
from nolbo_ppl.inference.slam.graph import LandmarkEqualities, optimize
from nolbo_ppl.inference.slam.initialise import SlamState, base_graph, first_estimate, tracklet_features
from nolbo_ppl.inference.slam.measurements import resolve
from nolbo_ppl.inference.slam.noise.noise_estimation import estimate_noise
from nolbo_ppl.inference.slam.noise.odometry_scale import metric_problem
from nolbo_ppl.inference.slam.slam_problem import NoiseModel, SlamConfig, SlamProblem
from nolbo_ppl.inference.slam.tracking import Tracklets


def solve_with_associations(
    problem: SlamProblem,
    object_of: Int[np.ndarray, " k"],
    config: SlamConfig | None = None,
    noise: NoiseModel | None = None,
) -> SlamState:
    """Solve the graph with given associations (-1: leave out), all weights one, no kernels.

    Raises:
        InputError: one number a detection is needed.
    """
    config = config or SlamConfig()
    if len(object_of) != len(problem.observations):
        raise input_error("associations do not match", got=len(object_of), expected=len(problem.observations))
    metric = metric_problem(problem, config)
    problem = metric.problem
    noise = noise or replace(estimate_noise(problem, config), scale_walk=metric.walk)
    prior = fit_prior(problem.observations, config, noise)
    measurements = resolve(problem.observations, noise, config, prior)
    rows = np.flatnonzero(object_of >= 0)
    landmark = np.unique(object_of[rows], return_inverse=True)[1].astype(np.int64)
    count = int(landmark.max(initial=-1)) + 1
    weight = np.ones(len(rows))
    features = tracklet_features(measurements, config, prior, rows, landmark, weight, count)
    full = np.full(len(object_of), -1)
    full[rows] = landmark
    tracklets = Tracklets(
        full,
        (full >= 0).astype(float),
        features.first,
        features.last,
        np.bincount(landmark, minlength=count),
        np.zeros(count, bool),
    )
    estimate = first_estimate(measurements, problem.odometry, config, rows, landmark, count)
    state = SlamState(
        problem=problem,
        config=config,
        noise=noise,
        prior=prior,
        tracklets=tracklets,
        static=np.arange(count),
        rows=rows,
        landmark=landmark,
        weight=weight,
        features=features,
        estimate=replace(estimate, scale=None if metric.factor is None else np.ones(len(problem) - 1)),
        odometry_scale=metric.factor,
        links=LandmarkEqualities.none(),
        typical_range=float(np.median(np.linalg.norm(problem.observations.position, axis=1))) if len(full) else 1.0,
    )
    estimate, _, error = optimize(base_graph(state), state.estimate, iterations=100, relative_tolerance=1e-8)
    state = replace(state, estimate=estimate, graph_error=error)
    # Once more: orientation modes were resolved against the first estimate.
    estimate, _, error = optimize(base_graph(state), state.estimate, iterations=100, relative_tolerance=1e-8)
    return replace(state, estimate=estimate, graph_error=error)
