"""The EM between tracklets: `step` is one round of E-step (which tracklets are one object) and M-step (GTSAM).

This is the working form that closes loops: relative covariances from the graph itself, inflated in the first rounds,
links under a Cauchy kernel. It is not exact coordinate ascent on the bound of the plain EM
(`nolbo_ppl.inference.slam.reference_em`), which never falls but closes no loop after drift; its log evidence is reported for
each iteration with what changed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.geometry.pose import make_pose
from nolbo_ppl.inference.slam.clusters import clusters_of
from nolbo_ppl.inference.slam.consistent_cliques import close_constellations
from nolbo_ppl.inference.slam.frame_marginals import frame_marginals
from nolbo_ppl.inference.slam.graph import UNINFORMATIVE_ROTATION_SIGMA, LandmarkEqualities, add_landmark_equalities, optimize
from nolbo_ppl.inference.slam.initialise import base_graph, inlier_weights
from nolbo_ppl.inference.slam.linearisation import linearise
from nolbo_ppl.inference.slam.loop_candidates import Pairs, TrackletFeatures, candidate_pairs, posterior_samples
from nolbo_ppl.inference.slam.noise.odometry_noise import refine_odometry
from nolbo_ppl.inference.slam.orientation import nearest_mode_rotation
from nolbo_ppl.inference.slam.slam_problem import SlamConfig
from nolbo_ppl.inference.slam.slam_state import SlamState, object_log_density

LINK_ROTATION = 0.05
"""Scale of the rotation between two linked landmarks that are oriented, rad."""
CONTRADICTION = 0.7
"""Linked orientations farther apart than this, in every mode, say nothing, rad."""


@dataclass(frozen=True)
class EmStepInfo:
    """What one iteration did."""

    iteration: int
    """Number of the iteration, from 1."""
    phase: str
    """constellation or em."""
    log_evidence: float
    """Log evidence of the associations of this E-step less the graph's error, nats."""
    closings: int
    """Constellations accepted."""
    links: int
    """Equalities of landmarks in the M-step."""
    strong_links: int
    """Equalities that merge tracklets."""
    change: float
    """Root mean square change of the camera positions, m."""
    graph_error: float
    """Half the sum of squared whitened residuals after the M-step."""


def link_arrays(
    R: Float[np.ndarray, "m 3 3"],
    features: TrackletFeatures,
    a: Int[np.ndarray, " l"],
    b: Int[np.ndarray, " l"],
    weight: Float[np.ndarray, " l"],
    position_scale: float,
) -> LandmarkEqualities:
    """Equalities between tracklets; where both are oriented, by the mode (flip, symmetry) nearest to the estimate."""
    T = np.tile(np.eye(4), (len(a), 1, 1))
    scale = np.tile([UNINFORMATIVE_ROTATION_SIGMA, position_scale], (len(a), 1))
    both = np.flatnonzero(features.oriented[a] & features.oriented[b] & (features.symmetry[a] != 0) & (features.symmetry[b] != 0))
    if len(both):
        i, j = a[both], b[both]
        turned = nearest_mode_rotation(R[i], R[j], features.symmetry[j])
        # L_b = L_a * T_a_b: when L_b turned by M looks like L_a, then R_a = R_b M and T_a_b = M'.
        T[both] = make_pose(np.swapaxes(turned, 1, 2) @ R[j], np.zeros(3))
        scale[both, 0] = LINK_ROTATION
        error = np.arccos(np.clip((np.einsum("lij,lij->l", R[i], turned) - 1) / 2, -1, 1))
        scale[both[error > CONTRADICTION], 0] = UNINFORMATIVE_ROTATION_SIGMA
    return LandmarkEqualities(a, b, weight, T, scale)


def make_landmark_equalities(
    state: SlamState, a: Int[np.ndarray, " l"], b: Int[np.ndarray, " l"], weight: np.ndarray
) -> LandmarkEqualities:
    """`link_arrays` of a state."""
    return link_arrays(state.estimate.T_world_landmark[:, :3, :3], state.features, a, b, weight, state.link_scale)


def groups_seen_together(first: Int[np.ndarray, " m"], last: Int[np.ndarray, " m"], limit: int = 16) -> list[np.ndarray]:
    """Tracklets in the order of their first frames, cut into groups that overlap in time one with all."""
    order = np.argsort(first, kind="stable")
    out, start = [], 0
    while start < len(order):
        end, least_last = start + 1, last[order[start]]
        while end < len(order) and first[order[end]] <= least_last and end - start < limit:
            least_last = min(least_last, last[order[end]])
            end += 1
        out.append(order[start:end])
        start = end
    return out


def soft_assignment(
    pairs: Pairs, features: TrackletFeatures, cluster: Int[np.ndarray, " m"], log_new: float, config: SlamConfig
) -> tuple[Int[np.ndarray, " l"], Int[np.ndarray, " l"], Float[np.ndarray, " l"], float]:
    """E-step: marginals of every group of tracklets seen together over the older clusters or a new landmark.

    Tracklets seen in one frame are different objects, so within a group the association is one-to-one; a cluster (what
    earlier iterations hold to be one object) stands as one candidate, by its best member. Returns newer tracklets,
    older ones, weights, and the log evidence above all tracklets being new.
    """
    groups = groups_seen_together(features.first, features.last)
    group = np.empty(len(features.first), dtype=np.int64)
    group[np.concatenate([*groups, np.zeros(0, np.int64)])] = np.repeat(np.arange(len(groups)), [len(one) for one in groups])
    value, candidate = pairs.log_position + pairs.log_feature, cluster[pairs.b]
    order = np.lexsort((-value, candidate, pairs.a))
    same = (np.diff(pairs.a[order]) == 0) & (np.diff(candidate[order]) == 0)
    best = order[np.concatenate([np.ones(min(len(order), 1), dtype=bool), ~same])]
    a, b = pairs.a[best], pairs.b[best]
    log_null = np.full(len(group), log_new)
    found = frame_marginals(group, a, candidate[best], value[best], log_null, associator=config.associator)
    strong = found.weight > config.equality_minimum
    evidence = float(found.log_evidence.sum() - log_null.sum())
    return a[strong], b[strong], np.minimum(found.weight[strong], 1.0), evidence


def soft_landmark_equalities(state: SlamState, pairs: Pairs) -> tuple[LandmarkEqualities, float]:
    """The E-step of a state as links, and its log evidence."""
    a, b, weight, evidence = soft_assignment(
        pairs, state.features, clusters_of(state), object_log_density(state.noise), state.config
    )
    return make_landmark_equalities(state, a, b, weight), evidence


def step(state: SlamState) -> tuple[SlamState, EmStepInfo]:
    """One iteration: samples of the graph, E-step, M-step.

    While constellations are found their pairs are linked with weight one; then the soft E-step decides every link anew.

    Raises:
        GraphError: GTSAM could not solve the graph.
    """
    config = state.config
    rng = np.random.default_rng([config.seed, state.iteration])
    graph = base_graph(state)
    linked = gtsam.NonlinearFactorGraph()
    linked.push_back(graph)  # shares the factors; those written in Python cannot be cloned
    add_landmark_equalities(linked, state.links, config.robust_width)
    linearisation = linearise(linked, state.estimate)
    if state.iteration and state.iteration % 2 == 0:
        state = refine_odometry(state, linearisation)
    samples = posterior_samples(linearisation, state.estimate, linearisation.affordable(config.samples), rng)
    inflation = config.annealing[min(state.iteration, len(config.annealing) - 1)]
    pairs = candidate_pairs(
        state.estimate,
        samples,
        state.features,
        state.prior,
        config,
        inflation=inflation,
        floor=state.link_scale,
        links=None if state.closing else state.links,
    )
    closings = 0
    evidence = 0.0
    phase = "em"
    if state.closing:
        phase = "constellation"
        log_new = object_log_density(state.noise)
        # Closed tracklets rest until the soft E-step decides every link anew.
        fresh = pairs.select(~np.isin(pairs.a, list(state.closed)))
        accepted = close_constellations(
            fresh,
            state.features.first,
            state.estimate,
            samples,
            config,
            inflation=inflation,
            floor=state.link_scale,
            log_new=log_new,
        )
        closed = dict(state.closed)
        closed.update({int(a): int(b) for c in accepted for a, b in zip(c.a, c.b)})
        closings = len(accepted)
        evidence = sum(c.log_odds for c in accepted)
        a = np.array(list(closed.keys()), dtype=np.int64)
        b = np.array(list(closed.values()), dtype=np.int64)
        links = make_landmark_equalities(state, a, b, np.ones(len(a)))
        news = len(closed) - len(state.closed)
        # A few more can wait for the soft E-step; the first rounds must anneal.
        few = news <= 0.02 * len(closed) and state.iteration + 1 >= len(config.annealing)
        last_round = not closed or few or state.iteration + 1 >= config.clique_rounds
        state = replace(state, closed=closed, closing=not last_round)
    else:
        links, evidence = soft_landmark_equalities(state, pairs)
    add_landmark_equalities(graph, links, config.robust_width)
    estimate, _, error = optimize(graph, state.estimate, iterations=25)
    moved = estimate.T_world_camera[:, :3, 3] - state.estimate.T_world_camera[:, :3, 3]
    state = replace(state, estimate=estimate, links=links, iteration=state.iteration + 1, graph_error=error)
    state = replace(state, weight=inlier_weights(state))
    info = EmStepInfo(
        iteration=state.iteration,
        phase=phase,
        log_evidence=float(evidence - error),
        closings=closings,
        links=len(links),
        strong_links=int((links.weight > config.merge_weight).sum()),
        change=float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))),
        graph_error=error,
    )
    return state, info
