"""Constellation closing: a fresh group of tracklets matched to old ones by a largest set of mutually consistent pairs.

One pair after drift is ambiguous; several that imply the same motion are not. Two pairs are consistent when their gaps
differ by no more than the graph's own covariance of that difference allows: distance, direction and relative rotation
in one test. A maximum clique of consistent pairs is accepted on its joint log evidence, and only when no other clique
that implies another motion comes close.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice

import networkx
import numpy as np
from jaxtyping import Bool, Float, Int

from nolbo_ppl.inference.slam.gaussian import squared_distance
from nolbo_ppl.inference.slam.graph import SlamEstimate
from nolbo_ppl.inference.slam.loop_candidates import Pairs, PosteriorSamples
from nolbo_ppl.inference.slam.slam_problem import SlamConfig

CONSISTENT = 14.0
"""Largest squared Mahalanobis distance between the gaps of two pairs (3 degrees of freedom: p = 0.003)."""
CLIQUE_BUDGET = 5000
"""Cliques looked at in one window before the search is cut."""
NODE_BUDGET = 400
"""Candidate pairs of one window, the best by evidence."""
NODES_SEARCHED = 80
"""Nodes the exact search for cliques runs on."""
FEATURE_MINIMUM = -6.0
"""Pairs whose features speak against them by more than this many nats join no constellation."""


@dataclass(frozen=True)
class LoopClosure:
    """A group of pairs accepted together."""

    a: Int[np.ndarray, " c"]
    """Newer tracklets."""
    b: Int[np.ndarray, " c"]
    """Older tracklets."""
    log_odds: float
    """Joint log evidence above new landmarks, nats."""
    margin: float
    """How far it is above the best clique that implies another motion, nats."""


def consistency(
    gap: Float[np.ndarray, "p 3"], deviation: Float[np.ndarray, "p 3 s"], pairs: Pairs, inflation: float, floor: float
) -> Bool[np.ndarray, "p p"]:
    """Which pairs can hold together: gaps equal within their joint covariance, no tracklet used twice."""
    p, _, count = deviation.shape
    flat = deviation.reshape(3 * p, count)
    cross = (flat @ flat.T).reshape(p, 3, p, 3).transpose(0, 2, 1, 3) / count
    own = cross[np.arange(p), np.arange(p)]
    covariance = own[:, None] + own[None] - cross - np.swapaxes(cross, 2, 3)
    covariance = inflation * covariance + 2 * floor**2 * np.eye(3)
    difference = gap[:, None] - gap[None]
    square, _ = squared_distance(difference, covariance)
    together = square < CONSISTENT
    together &= (pairs.a[:, None] != pairs.a[None]) & (pairs.b[:, None] != pairs.b[None])
    return together & together.T


def joint_log_density(
    gap: Float[np.ndarray, "c 3"], deviation: Float[np.ndarray, "c 3 s"], inflation: float, floor: float, rank: int = 6
) -> float:
    """Log density of all gaps at once: drift common to the group (its leading directions) plus a part of each pair's own.

    A covariance of samples alone underestimates its small eigenvalues as the group grows; hence the factor form.
    """
    size, count = gap.size, deviation.shape[2]
    flat = deviation.reshape(size, count) * np.sqrt(inflation / count)
    U, singular, _ = np.linalg.svd(flat, full_matrices=False)
    r = min(rank, len(singular))
    common = U[:, :r] * singular[:r]
    rest = np.maximum(np.sum(flat**2, axis=1) - np.sum(common**2, axis=1), 0.0) + floor**2
    covariance = common @ common.T + np.diag(rest)
    solved = np.linalg.solve(covariance, gap.ravel())
    return float(-0.5 * (gap.ravel() @ solved + np.linalg.slogdet(2 * np.pi * covariance)[1]))


def greedy_clique(together: Bool[np.ndarray, "p p"], seed: int) -> list[int]:
    """A large clique that holds one node: always add the node that leaves most others possible."""
    members = [seed]
    alive = np.flatnonzero(together[seed])
    while len(alive):
        left = together[np.ix_(alive, alive)]
        best = int(np.argmax(left.sum(axis=1)))
        members.append(int(alive[best]))
        alive = alive[left[best]]
    return members


def promising_nodes(together: Bool[np.ndarray, "p p"], minimum: int) -> Int[np.ndarray, " n"]:
    """Nodes of the largest greedy cliques, at most NODES_SEARCHED: the full search on all of them takes a hundred
    times as long.

    Without features (poles) a window has hundreds of candidate pairs and ten thousands of maximal cliques, most of them tiny.
    """
    cliques = [greedy_clique(together, i) for i in np.flatnonzero(together.sum(axis=1) >= minimum - 1).tolist()]
    cliques = sorted((c for c in cliques if len(c) >= minimum), key=len, reverse=True)
    chosen: set[int] = set()
    for clique in cliques:
        if len(chosen) >= NODES_SEARCHED:
            break
        chosen.update(clique)
    return np.array(sorted(chosen), dtype=np.int64)


def find_loop_closure(
    pairs: Pairs,
    estimate: SlamEstimate,
    samples: PosteriorSamples,
    config: SlamConfig,
    *,
    inflation: float,
    floor: float,
    log_new: float,
) -> LoopClosure | None:
    """The best clique of one window's pairs, or None when it is too small, too weak or not unique."""
    if len(pairs) < config.clique_minimum:
        return None
    pairs = pairs.select(np.flatnonzero(pairs.log_feature > FEATURE_MINIMUM))
    if len(pairs) > NODE_BUDGET:
        pairs = pairs.select(np.argsort(-(pairs.log_position + pairs.log_feature), kind="stable")[:NODE_BUDGET])
    position = estimate.T_world_landmark[:, :3, 3]
    gap = position[pairs.a] - position[pairs.b]
    deviation = samples.position[pairs.a] - samples.position[pairs.b]
    # Annealing widens what all pairs share (drift); what tells them apart is local and well known.
    together = consistency(gap, deviation, pairs, min(inflation, 2.0), floor)
    nodes = promising_nodes(together, config.clique_minimum)
    if len(nodes) < config.clique_minimum:
        return None
    graph = networkx.Graph()
    graph.add_edges_from(np.argwhere(np.triu(together[np.ix_(nodes, nodes)], 1)).tolist())
    cliques = []
    for clique in islice(networkx.find_cliques(graph), CLIQUE_BUDGET):
        if len(clique) >= config.clique_minimum:
            members = nodes[np.array(clique)]
            cliques.append((float(len(members) * 3.0 + pairs.log_feature[members].sum()), members))
    if not cliques:
        return None
    # Score the most promising in full; the rest cannot overtake them by much.
    cliques.sort(key=lambda item: -item[0])
    scored = []
    for _, members in cliques[:40]:
        value = joint_log_density(gap[members], deviation[members], inflation, floor)
        scored.append((value + float(pairs.log_feature[members].sum()) - len(members) * log_new, members))
    scored.sort(key=lambda item: -item[0])
    best, members = scored[0]
    motion = gap[members].mean(axis=0)
    chosen = set(members.tolist())
    rival = 0.0
    for value, other in scored[1:]:
        shared = len(chosen.intersection(other.tolist()))
        same_motion = np.linalg.norm(gap[other].mean(axis=0) - motion) < 3 * floor
        if shared < 0.5 * min(len(other), len(members)) and not same_motion:
            rival = max(rival, value)
            break
    return LoopClosure(pairs.a[members], pairs.b[members], best, best - rival)


def windows(first: Int[np.ndarray, " m"], size: int) -> list[Int[np.ndarray, " w"]]:
    """Groups of tracklets that follow each other in time, each half overlapping the next."""
    order = np.argsort(first, kind="stable")
    if len(order) <= size:
        return [order] if len(order) else []
    half = max(size // 2, 1)
    return [order[start : start + size] for start in range(0, len(order) - half, half)]


def close_constellations(
    pairs: Pairs,
    first: Int[np.ndarray, " m"],
    estimate: SlamEstimate,
    samples: PosteriorSamples,
    config: SlamConfig,
    *,
    inflation: float,
    floor: float,
    log_new: float,
) -> list[LoopClosure]:
    """Closings of every window that pass, best first, no tracklet closed twice in different ways."""
    found = []
    order = np.argsort(pairs.a, kind="stable")
    sorted_a = pairs.a[order]
    for window in windows(first, config.clique_window):
        member = np.sort(window)
        low, high = np.searchsorted(sorted_a, member, "left"), np.searchsorted(sorted_a, member, "right")
        rows = np.concatenate([order[s:e] for s, e in zip(low, high)]) if len(member) else np.zeros(0, int)
        # Pairs within the window itself are short-term matters, left to the soft E-step.
        rows = rows[~np.isin(pairs.b[rows], member)]
        closing = find_loop_closure(
            pairs.select(rows), estimate, samples, config, inflation=inflation, floor=floor, log_new=log_new
        )
        if closing and closing.log_odds > config.clique_log_odds and closing.margin > config.clique_log_odds / 2:
            found.append(closing)
    found.sort(key=lambda closing: -closing.log_odds)
    partner: dict[int, int] = {}
    accepted = []
    for closing in found:
        if any(partner.get(int(x), int(y)) != int(y) for x, y in zip(closing.a, closing.b)):
            continue
        partner.update({int(x): int(y) for x, y in zip(closing.a, closing.b)})
        accepted.append(closing)
    return accepted
