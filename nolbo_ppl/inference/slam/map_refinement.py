"""From soft links to a map: tracklets merged by evidence, a clean solve without kernels, and EM of
every detection with the map: exact marginals under the model of a frame, then a solve with these as weights."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.inference.slam.clusters import frames_of_landmarks, join
from nolbo_ppl.inference.slam.data_association import Associations, associate_detections, moving_detections, rates_report
from nolbo_ppl.inference.slam.em import make_landmark_equalities
from nolbo_ppl.inference.slam.exposures import exposures_of
from nolbo_ppl.inference.slam.frame_model import initial_frame_model
from nolbo_ppl.inference.slam.graph import LandmarkEqualities, optimize
from nolbo_ppl.inference.slam.initialise import (
    SlamState,
    base_graph,
    distances_to_landmarks,
    first_estimate,
    inlier_weights,
    linearise_state,
    tracklet_features,
)
from nolbo_ppl.inference.slam.linearisation import linearise
from nolbo_ppl.inference.slam.loop_candidates import Pairs, candidate_pairs, posterior_samples
from nolbo_ppl.inference.slam.noise.odometry_noise import leaves_odometry, refine_odometry, settle_odometry, warn_of_contradiction
from nolbo_ppl.inference.slam.noise.residual_calibration import calibrate
from nolbo_ppl.inference.slam.slam_state import object_log_density

LARGEST_MISSED = 6.0
"""Most that missed detections may speak for one landmark instead of two, nats: occlusions make misses alike."""
MERGE_LOG_ODDS = 3.0
"""Two landmarks are merged in the end when one explains them better by this many nats."""
BROKEN_LINK = 6.0
"""A link stretched to this many of its scales by the others is cut."""
BROKEN_FACTOR = 6.0
"""Detections that are left so many of their scales from a landmark do not move it, whatever their marginals say."""
CONSISTENT_ROUNDS = 2
"""Times that such detections are sought, and the map solved again without them."""
SMALLEST_MARGINAL = 0.01
"""Associations of lower probability are left out of the map's M-step."""


def surviving_landmark_equalities(state: SlamState) -> LandmarkEqualities:
    """Equalities that the robust solution keeps: those it stretches far are contradicted by the rest."""
    links = state.links
    position = state.estimate.T_world_landmark[:, :3, 3]
    stretch = np.linalg.norm(position[links.a] - position[links.b], axis=1) / np.maximum(links.scale[:, 1], 1e-12)
    keep = stretch < BROKEN_LINK
    return LandmarkEqualities(links.a[keep], links.b[keep], links.weight[keep], links.T_a_b[keep], links.scale[keep])


def relabel(state: SlamState, cluster: Int[np.ndarray, " m"]) -> SlamState:
    """The same problem with landmarks joined: numbering, features, first positions from the current poses."""
    count = int(cluster.max(initial=-1)) + 1
    landmark = cluster[state.landmark]
    T_world_camera = state.estimate.T_world_camera
    estimate = first_estimate(state.measurements, T_world_camera, state.config, state.rows, landmark, count)
    features = tracklet_features(state.measurements, state.config, state.prior, state.rows, landmark, state.weight, count)
    return replace(
        state,
        landmark=landmark,
        static=np.arange(count),
        features=features,
        links=LandmarkEqualities.none(),
        closed={},
        estimate=replace(estimate, scale=state.estimate.scale),
    )


def solve_clean(state: SlamState, repeats: int = 3, tolerance: float = 1e-8) -> SlamState:
    """Solve without kernels; between solves only the frozen weights of detections change."""
    for _ in range(repeats):
        estimate, _, error = optimize(base_graph(state), state.estimate, iterations=30, relative_tolerance=tolerance)
        state = replace(state, estimate=estimate, graph_error=error)
        weight = inlier_weights(state)
        settled = np.abs(weight - state.weight).max(initial=0.0) < 0.02
        state = replace(state, weight=weight)
        if settled:
            break
    return state


def missed_log_ratio(state: SlamState, pairs: Pairs) -> Float[np.ndarray, " p"]:
    """Log probability of the frames with and without a detection if both landmarks are one, less that if they are two."""
    seen, m = state.measurements, len(state.estimate.T_world_landmark)
    T_world_camera, place = state.estimate.T_world_camera, state.estimate.T_world_landmark[:, :3, 3]
    model = initial_frame_model(seen, state.config, len(state.problem))
    exposures = exposures_of(model, T_world_camera, place)
    hits = np.bincount(state.landmark, state.weight, minlength=m).astype(np.float64)
    number, _ = exposures.totals(model)
    # One probability for all: that of the map as it is, which duplicates make too low, not too high.
    chance = np.full(len(pairs), (hits.sum() + 1.0) / (np.maximum(number, hits).sum() + 2.0))
    a, b, count = hits[pairs.a], hits[pairs.b], np.maximum(number, hits)
    one = model.log_pattern(a + b, np.maximum(np.maximum(count[pairs.a], count[pairs.b]), a + b), chance)
    two = model.log_pattern(a, count[pairs.a], chance) + model.log_pattern(b, count[pairs.b], chance)
    return np.minimum(one - two, LARGEST_MISSED)


def merge_duplicates(state: SlamState, rng: np.random.Generator) -> SlamState:
    """Join landmarks that one explains better: never seen together, close under the final covariance, alike.

    Two objects in view would each have been missed wherever the other was detected; one was not.
    """
    linearisation = linearise_state(state)
    samples = posterior_samples(linearisation, state.estimate, linearisation.affordable(state.config.samples), rng)
    frames = frames_of_landmarks(state)
    spans = replace(state.features, first=np.arange(len(frames)), last=np.arange(len(frames)))  # every pair once
    pairs = candidate_pairs(state.estimate, samples, spans, state.prior, state.config, inflation=1.0, floor=state.link_scale)
    value = pairs.log_position + pairs.log_feature - object_log_density(state.noise) + missed_log_ratio(state, pairs)
    apart = np.array([frames[i].isdisjoint(frames[j]) for i, j in zip(pairs.a, pairs.b)], dtype=bool)
    good = np.flatnonzero((value > MERGE_LOG_ODDS) & apart)
    if not len(good):
        return state
    weight = 1.0 / (1.0 + np.exp(-np.minimum(value[good], 30.0)))
    links = make_landmark_equalities(state, pairs.a[good], pairs.b[good], weight)
    return relabel(state, join(links, frames, 0.5))


def reassociate(state: SlamState, rng: np.random.Generator) -> tuple[SlamState, Associations]:
    """E-step of every detection against the map: each enters the graph with its marginals, one factor a landmark.

    Detections of moving tracks stay out.
    """
    found = associate_detections(state, linearise(base_graph(state), state.estimate), rng)
    use = (found.weight > SMALLEST_MARGINAL) & ~moving_detections(state)[found.row]
    rows, landmark, weight = found.row[use], found.landmark[use], found.weight[use]
    features = tracklet_features(
        state.measurements, state.config, state.prior, rows, landmark, weight, len(state.estimate.T_world_landmark)
    )
    return replace(state, rows=rows, landmark=landmark, weight=weight, features=features, frame_model=found.model), found


def solve_soft(state: SlamState, tolerance: float = 1e-8) -> SlamState:
    """The M-step of the map: solve with the marginals as frozen weights."""
    estimate, _, error = optimize(base_graph(state), state.estimate, iterations=30, relative_tolerance=tolerance)
    return replace(state, estimate=estimate, graph_error=error)


def drop_empty(state: SlamState, minimum: float) -> SlamState:
    """Remove landmarks whose weights sum to less than `minimum`."""
    total = np.bincount(state.landmark, weights=state.weight, minlength=len(state.static))
    keep = total >= minimum
    number = np.where(keep, np.cumsum(keep) - 1, -1)
    rows = number[state.landmark] >= 0
    landmark = number[state.landmark[rows]]
    count = int(keep.sum())
    state = replace(
        state,
        rows=state.rows[rows],
        landmark=landmark,
        weight=state.weight[rows],
        static=np.arange(count),
        estimate=replace(state.estimate, T_world_landmark=state.estimate.T_world_landmark[keep]),
    )
    features = tracklet_features(state.measurements, state.config, state.prior, state.rows, landmark, state.weight, count)
    return replace(state, features=features)


def solve_consistent(state: SlamState, factors: tuple[float, float] = (1.0, 1.0)) -> SlamState:
    """`solve_settled` without what stays far from its landmark, begun again: while the odometry is believed.

    A place known to metres may well be that of a near detection six metres off, known to centimetres; but if it is not, no other
    factor holds the landmark, and with it the trajectory, against it (2 m of error became 16 in one solve).
    """
    solved = solve_settled(state, factors)
    for _ in range(CONSISTENT_ROUNDS if not leaves_odometry(state) else 0):
        far = (distances_to_landmarks(solved)[0] > BROKEN_FACTOR**2) & (state.weight > 0)
        if not far.any():
            break
        state = replace(state, weight=np.where(far, 0.0, state.weight))
        solved = solve_settled(state, factors)
    return solved


def solve_settled(state: SlamState, factors: tuple[float, float]) -> SlamState:
    """`solve_soft` with the odometry's scales times the factors of `settle_odometry`; the state keeps its own scales."""
    noise = state.noise
    stiff = replace(noise, rotation_step=noise.rotation_step * factors[0], translation_step=noise.translation_step * factors[1])
    return replace(solve_soft(replace(state, noise=stiff)), noise=noise)


def fit_odometry(state: SlamState, rounds: int = 4, tolerance: float = 0.05) -> SlamState:
    """Scales of the odometry to the fixed point of the evidence on the closed map, solved anew after each change."""
    if len(state.problem) < 3:
        return state
    for _ in range(rounds):
        before = np.array([np.median(state.noise.rotation_step), np.median(state.noise.translation_step)])
        state = refine_odometry(state, linearise_state(state))
        after = np.array([np.median(state.noise.rotation_step), np.median(state.noise.translation_step)])
        if (np.abs(np.log(after / before)) < tolerance).all():
            break
        # The marginals stay: weights by each pair's residual alone count a detection up to four times.
        state = solve_soft(state)
    return state


def finish(state: SlamState) -> tuple[SlamState, Associations]:
    """Merge, solve clean, associate every detection with the map, solve again: the final state and its associations."""
    rng = np.random.default_rng([state.config.seed, 104729])
    links = surviving_landmark_equalities(state)
    cluster = join(links, frames_of_landmarks(state), state.config.merge_weight)
    state = solve_clean(relabel(state, cluster), repeats=2, tolerance=1e-5)
    # Several passes of one object show what one track cannot: how far the detector errs from view to view.
    state = calibrate(state)
    state = merge_duplicates(solve_clean(state, repeats=2, tolerance=1e-5), rng)
    # Again: passes that differed by more than the first scales allowed are joined only now.
    state = solve_clean(calibrate(solve_clean(state, repeats=1)))
    state, _ = reassociate(state, rng)
    state = solve_consistent(drop_empty(state, 0.5))
    factors = (1.0, 1.0)
    if len(state.rows):
        state = fit_odometry(state)
        state, factors = settle_odometry(state)
        state = warn_of_contradiction(solve_settled(state, factors))
    final, found = reassociate(state, rng)
    for _ in range(3):  # landmarks that lost what placed them are no part of the answer
        if not len(found.existence) or np.bincount(found.landmark, found.weight, minlength=len(found.existence)).min() >= 0.5:
            break
        state = solve_consistent(drop_empty(final, 0.5), factors)
        final, found = reassociate(state, rng)
    noise = replace(final.noise, report=final.noise.report | rates_report(found, len(state.problem)))
    final = replace(final, rows=state.rows, landmark=state.landmark, weight=state.weight, features=state.features, noise=noise)
    return final, found


def final_graph(state: SlamState) -> gtsam.NonlinearFactorGraph:
    """The graph of the final state."""
    return base_graph(state)
