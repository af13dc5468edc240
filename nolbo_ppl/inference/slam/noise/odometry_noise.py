"""Scales of the odometry: by the evidence of the tracked objects first, by the residuals over the posterior later."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nolbo_ppl.geometry.pose import adjoint, inverse, se3_log
from nolbo_ppl.inference.slam.graph import (
    Linearisation,
    SlamEstimate,
    add_landmark_priors,
    add_observation_factors,
    linearise,
    odometry_factors,
    optimise,
    resolve_observations,
)
from nolbo_ppl.inference.slam.noise.noise_estimation import TOO_SMALL
from nolbo_ppl.inference.slam.slam_problem import SlamConfig, SlamProblem
from nolbo_ppl.inference.slam.slam_state import SlamState

WINDOW = 200
"""Frames the evidence is taken from: where most detections are."""
ROBUST_WIDTH = 2.0
"""Width of the Cauchy kernel on detections in the evidence: a few wrong ones in tracks would pass for drift."""
LEAST_GAIN = 3.0
"""Log evidence, in nats, that another scale must gain."""
STEPS = (4.0, 2.0)
"""Factors tried on each scale, coarse first."""
LEAST_FACTOR = 0.5
"""Scales nobody stated are never taken below this part of the defaults: drift that is a bias shows only over loops."""
LARGEST_FACTOR = 64.0
"""And never beyond this multiple."""


def stated_scales(problem: SlamProblem, config: SlamConfig) -> tuple[bool, bool]:
    """Whether the user stated the rotation and the translation scale."""
    if problem.odometry_covariance is not None:
        return True, True
    return config.odometry_rotation_scale is not None, (
        config.odometry_translation_scale is not None or config.odometry_translation_ratio is not None
    )


def densest_window(state: SlamState, length: int = WINDOW) -> SlamState:
    """The problem cut to the frames in a row with most detections, landmarks seen twice there alone."""
    n = len(state.problem)
    frame = state.problem.observations.frame[state.rows]
    if n > length:
        counts = np.concatenate([[0], np.cumsum(np.bincount(frame, minlength=n))])
        first = int(np.argmax(counts[length:] - counts[:-length]))
    else:
        first, length = 0, n
    inside = (frame >= first) & (frame < first + length)
    seen = np.bincount(state.landmark[inside], minlength=len(state.static))
    inside &= seen[state.landmark] >= 2
    names, landmark = np.unique(state.landmark[inside], return_inverse=True)
    table = state.problem.observations.select(state.rows[inside])
    table = replace(table, frame=table.frame - first)
    noise = replace(
        state.noise,
        rotation_step=state.noise.rotation_step[first : first + length - 1],
        translation_step=state.noise.translation_step[first : first + length - 1],
        position_covariance=state.noise.position_covariance[state.rows[inside]],
        rotation_scale=state.noise.rotation_scale[state.rows[inside]],
        latent_scale=state.noise.latent_scale[state.rows[inside]],
    )
    problem = SlamProblem(state.problem.odometry[first : first + length], table)
    estimate = SlamEstimate(state.estimate.T_world_camera[first : first + length], state.estimate.T_world_landmark[names])
    return replace(
        state,
        problem=problem,
        noise=noise,
        rows=np.arange(len(table)),
        landmark=landmark.astype(np.int64),
        weight=state.weight[inside],
        static=names,
        estimate=estimate,
    )


def log_evidence(window: SlamState, rotation: float, translation: float) -> float:
    """Laplace log evidence of the window with odometry scales times the given factors, up to a constant, nats.

    Detections have heavy tails here.
    """
    noise = replace(
        window.noise,
        rotation_step=window.noise.rotation_step * rotation,
        translation_step=window.noise.translation_step * translation,
    )
    graph = odometry_factors(window.problem, noise)
    factors = resolve_observations(
        window.measurements,
        window.problem.odometry,
        noise,
        window.config,
        window.estimate,
        window.rows,
        window.landmark,
        window.weight,
    )
    add_observation_factors(graph, factors, robust_width=ROBUST_WIDTH)
    add_landmark_priors(graph, window.estimate.T_world_landmark, window.typical_range)
    estimate, _, error = optimise(graph, window.estimate, iterations=10)
    determinant = linearise(graph, estimate).log_determinant()
    steps = len(noise.rotation_step)
    return -error - 0.5 * determinant - 3 * steps * (np.log(rotation) + np.log(translation))


def odometry_by_evidence(state: SlamState) -> SlamState:
    """Scale factors of the odometry (where not stated) that the tracked objects make most probable, by coordinate search."""
    stated_rotation, stated_translation = stated_scales(state.problem, state.config)
    free = [not stated_rotation, not stated_translation]
    window = densest_window(state) if any(free) else state
    if not any(free) or len(window.rows) < 20 or len(window.problem) < 10:
        return state
    factors = np.ones(2)
    best = log_evidence(window, *factors)
    for step in STEPS:
        improved = True
        while improved:
            improved = False
            for axis in (0, 1):
                for direction in (step, 1.0 / step):
                    trial = factors.copy()
                    trial[axis] *= direction
                    if not free[axis] or not LEAST_FACTOR <= trial[axis] <= LARGEST_FACTOR:
                        continue
                    value = log_evidence(window, *trial)
                    if value > best + LEAST_GAIN:
                        factors, best, improved = trial, value, True
                        break
    report = dict(state.noise.report)
    noise = replace(
        state.noise,
        rotation_step=state.noise.rotation_step * factors[0],
        translation_step=state.noise.translation_step * factors[1],
        report=report,
    )
    report["odometry_rotation_scale"] = float(np.median(noise.rotation_step))
    report["odometry_translation_scale"] = float(np.median(noise.translation_step))
    return replace(state, noise=noise)


def residual_ratios(state: SlamState, linearisation: Linearisation) -> tuple[float, float]:
    """Root mean square of odometry residuals over the posterior, in units of their scales: rotation, translation.

    The expectation is over samples of the linearised graph: `r = r0 + d_i+1 - Ad d_i`.
    """
    rng = np.random.default_rng(state.config.seed + 7919)
    delta, _ = linearisation.samples(min(state.config.samples, 24), rng)
    T = state.estimate.T_world_camera
    step = inverse(T[:-1]) @ T[1:]
    measured = inverse(state.problem.odometry[:-1]) @ state.problem.odometry[1:]
    mean = se3_log(inverse(measured) @ step)
    square = mean**2 + np.mean((delta[1:] - adjoint(inverse(step)) @ delta[:-1]) ** 2, axis=2)
    rotation = np.sqrt(np.mean(square[:, :3] / state.noise.rotation_step[:, None] ** 2))
    translation = np.sqrt(np.mean(square[:, 3:] / state.noise.translation_step[:, None] ** 2))
    return float(rotation), float(translation)


def refine_odometry(state: SlamState, linearisation: Linearisation) -> SlamState:
    """One EM update of the odometry scales: `sigma^2 <- E[r^2]` over the posterior.

    Stated scales stay unless they are too small by more than a third (reported, and raised with `correct_scales`);
    scales nobody stated only grow: a posterior that knows little of a step would let them creep.
    """
    if len(state.problem) < 3 or not len(state.rows):
        return state
    factors = []
    report, warnings = dict(state.noise.report), list(state.noise.warnings)
    ratios = residual_ratios(state, linearisation)
    for name, stated, ratio in zip(("rotation", "translation"), stated_scales(state.problem, state.config), ratios):
        factor = max(ratio, 1.0)
        if stated:
            factor = 1.0
            if ratio > TOO_SMALL:
                text = f"stated odometry {name} scale is too small: residuals are {ratio:.2f} times as wide"
                warnings = [w for w in warnings if not w.startswith(f"stated odometry {name}")] + [text]
                factor = ratio if state.config.correct_scales else 1.0
        factors.append(factor)
    noise = replace(
        state.noise,
        rotation_step=state.noise.rotation_step * factors[0],
        translation_step=state.noise.translation_step * factors[1],
        report=report,
        warnings=tuple(warnings),
    )
    report["odometry_rotation_scale"] = float(np.median(noise.rotation_step))
    report["odometry_translation_scale"] = float(np.median(noise.translation_step))
    return replace(state, noise=noise)
