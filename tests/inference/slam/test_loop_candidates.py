"""Evidence of pairs of tracklets, of groups of them, and what is joined to what, each against an independent computation."""

from __future__ import annotations

from dataclasses import replace

import networkx
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal, norm

from nolbo_ppl.inference.slam import SlamConfig
from nolbo_ppl.inference.slam.clusters import join
from nolbo_ppl.inference.slam.consistent_cliques import (
    LoopClosure,
    close_constellations,
    find_loop_closure,
    joint_log_density,
    windows,
)
from nolbo_ppl.inference.slam.detection_features import FeaturePrior
from nolbo_ppl.inference.slam.graph import LandmarkEqualities, SlamEstimate
from nolbo_ppl.inference.slam.latent_population import LatentPopulation
from nolbo_ppl.inference.slam.loop_candidates import (
    POSITION_GATE,
    PosteriorSamples,
    TrackletFeatures,
    candidate_pairs,
    feature_log_ratio,
    log_population,
)

PRIOR = FeaturePrior(np.zeros(2), LatentPopulation.of_one(np.zeros(2), np.ones(2)), (), np.zeros(0), 0.05)


def features(
    m: int, latent: np.ndarray | None = None, variance: float = 0.1, first: np.ndarray | None = None
) -> TrackletFeatures:
    z = np.zeros((m, 0)) if latent is None else latent
    spread = np.full(z.shape, variance)
    first = 10 * np.arange(m) if first is None else first
    return TrackletFeatures(
        z, spread, log_population(z, spread), np.full(m, -1), np.ones(m, int), np.zeros(m, bool), first, first + 1
    )


def poses(position: np.ndarray) -> SlamEstimate:
    T = np.tile(np.eye(4), (len(position), 1, 1))
    T[:, :3, 3] = position
    return SlamEstimate(np.eye(4)[None], T)


def still(m: int, count: int = 64) -> PosteriorSamples:
    return PosteriorSamples(np.zeros((m, 3, count)), np.zeros((m, 3, count)))


def test_population_density_by_brute_force() -> None:
    rng = np.random.default_rng(0)
    z, v = rng.standard_normal((6, 2)), rng.uniform(0.1, 1.0, (6, 2))
    for i, value in enumerate(log_population(z, v)):
        others = [norm.pdf(z[i], z[c], np.sqrt(v[i] + v[c])).prod() for c in range(6) if c != i]
        assert value == pytest.approx(np.log(np.mean(others)), abs=1e-10)


def test_pair_evidence_is_the_density_of_the_gap() -> None:
    """Position: the normal density of the gap under the samples' covariance; latent: the match against the population."""
    rng = np.random.default_rng(1)
    m, count = 5, 40
    position = rng.uniform(-1, 1, (m, 3))
    deviation = 0.4 * rng.standard_normal((m, 3, count))
    z = rng.standard_normal((m, 2))
    data = features(m, z, 0.3)
    found = candidate_pairs(
        poses(position), PosteriorSamples(deviation, 0 * deviation), data, PRIOR, SlamConfig(), inflation=2.0, floor=0.1
    )
    expected = {}
    for a in range(m):
        for b in range(a):
            d = deviation[a] - deviation[b]
            covariance = 2.0 * d @ d.T / count + 0.01 * np.eye(3)
            gap = position[a] - position[b]
            if gap @ np.linalg.solve(covariance, gap) < POSITION_GATE:
                latent = norm.logpdf(z[a], z[b], np.sqrt(0.6)).sum() - data.log_population[a]
                expected[a, b] = (multivariate_normal.logpdf(gap, np.zeros(3), covariance), latent)
    assert {(int(a), int(b)) for a, b in zip(found.a, found.b)} == set(expected) and len(expected) > 3
    for k, pair in enumerate(zip(found.a.tolist(), found.b.tolist())):
        assert (found.log_position[k], found.log_feature[k]) == pytest.approx(expected[pair], abs=1e-9)


def test_tracklets_seen_together_are_no_pair() -> None:
    data = features(3, first=np.array([0, 0, 5]))
    found = candidate_pairs(poses(np.zeros((3, 3))), still(3), data, PRIOR, SlamConfig(), inflation=1.0, floor=0.1)
    assert {(int(a), int(b)) for a, b in zip(found.a, found.b)} == {(2, 0), (2, 1)}


def test_parallel_neighbours_are_no_evidence() -> None:
    """What stands along a road has one heading there: agreeing in it is worth at most the log of two, elsewhere more."""
    rng = np.random.default_rng(5)
    road, apart = 40, 60
    position = np.zeros((road + apart, 3))
    position[:road, 0], position[road:, 0] = 3.0 * np.arange(road), 1000 + 3.0 * np.arange(apart)
    turn = np.concatenate([0.02 * rng.standard_normal(road), rng.uniform(-np.pi, np.pi, apart)])
    turn[road] = turn[road + 20]  # one pair of objects that happen to agree
    T = poses(position)
    T.T_world_landmark[:, :3, :3] = Rotation.from_rotvec(turn[:, None] * [0, 0, 1]).as_matrix()
    found = replace(features(road + apart), oriented=np.ones(road + apart, bool))
    a, b = np.array([20, road + 20]), np.array([2, road])
    ratio = feature_log_ratio(T, still(road + apart), found, PRIOR, SlamConfig(), a, b)
    assert 0.0 < ratio[0] < np.log(2.0) + 0.05
    assert ratio[1] > 1.5


def test_joint_density_of_a_group_equals_the_dense_normal() -> None:
    """Drift of six directions common to all gaps plus a part of each one's own."""
    rng = np.random.default_rng(2)
    size, count = 4, 60_000
    common, own = 0.5 * rng.standard_normal((3 * size, 6)), 0.2
    flat = common @ rng.standard_normal((6, count))
    gap = rng.standard_normal((size, 3))
    exact = common @ common.T + own**2 * np.eye(3 * size)
    value = joint_log_density(gap, flat.reshape(size, 3, count), 1.0, own)
    # The covariance is sampled: its relative error is sqrt(2 / count) an element.
    tolerance = 5 * np.sqrt(2 / count) * (gap.ravel() @ np.linalg.solve(exact, gap.ravel()) + 3 * size)
    assert value == pytest.approx(multivariate_normal.logpdf(gap.ravel(), np.zeros(3 * size), exact), abs=tolerance)


def second_pass(shift: np.ndarray, wrong: np.ndarray | None = None) -> tuple[np.ndarray, PosteriorSamples, np.random.Generator]:
    """Six objects, seen again after a drift common to all; optionally a copy of the constellation elsewhere."""
    rng = np.random.default_rng(3)
    old = rng.uniform(0, 30, (6, 3)) * np.array([1, 0.1, 1])
    parts = [old] if wrong is None else [old, old + wrong]
    parts.append(old + shift + 0.02 * rng.standard_normal((6, 3)))
    drift = 4.0 * rng.standard_normal((1, 3, 64))
    olds = 6 * (len(parts) - 1)
    deviation = np.concatenate([0.02 * rng.standard_normal((olds, 3, 64)), np.repeat(drift, 6, axis=0)])
    return np.concatenate(parts), PosteriorSamples(deviation, 0 * deviation), rng


def closing(position: np.ndarray, samples: PosteriorSamples) -> tuple[LoopClosure | None, int]:
    m = len(position)
    first = np.concatenate([np.arange(m - 6), np.full(6, 1000)])
    config = SlamConfig()
    pairs = candidate_pairs(poses(position), samples, features(m, first=first), PRIOR, config, inflation=1.0, floor=0.05)
    fresh = pairs.select(pairs.a >= m - 6)
    return find_loop_closure(fresh, poses(position), samples, config, inflation=1.0, floor=0.05, log_new=float(np.log(1e-3))), m


def test_constellation_is_found_and_twins_are_refused() -> None:
    position, samples, _ = second_pass(np.array([3.0, 0.1, -2.0]))
    found, m = closing(position, samples)
    assert found is not None and sorted(zip(found.a.tolist(), found.b.tolist())) == [(m - 6 + i, i) for i in range(6)]
    config = SlamConfig()
    assert found.margin > config.clique_log_odds
    twins, _ = closing(*second_pass(np.array([3.0, 0.1, -2.0]), wrong=np.array([5.0, 0.2, -3.5]))[:2])
    assert twins is not None and twins.margin < config.clique_log_odds / 2


def test_closings_use_no_tracklet_twice() -> None:
    position, samples, _ = second_pass(np.array([3.0, 0.1, -2.0]))
    first = np.concatenate([np.arange(6), 1000 + np.arange(6)])
    data = features(12, first=first)
    config = replace(SlamConfig(), clique_window=4)
    pairs = candidate_pairs(poses(position), samples, data, PRIOR, config, inflation=1.0, floor=0.05)
    accepted = close_constellations(
        pairs, first, poses(position), samples, config, inflation=1.0, floor=0.05, log_new=float(np.log(1e-3))
    )
    partner: dict[int, int] = {}
    for a, b in ((int(a), int(b)) for c in accepted for a, b in zip(c.a, c.b)):
        assert partner.setdefault(a, b) == b
    assert partner == {6 + i: i for i in range(6)}


def test_windows_hold_every_tracklet() -> None:
    first = np.random.default_rng(0).permutation(50)
    found = windows(first, 14)
    assert set(np.concatenate(found).tolist()) == set(range(50)) and all(len(w) <= 14 for w in found)
    for window in found:
        assert (np.diff(first[window]) == 1).all()  # neighbours in time


def links(a: list[int], b: list[int], weight: list[float], scale: float = 1.0) -> LandmarkEqualities:
    return LandmarkEqualities(
        np.array(a, int), np.array(b, int), np.array(weight), np.tile(np.eye(4), (len(a), 1, 1)), np.full((len(a), 2), scale)
    )


def test_clusters_are_components_of_strong_links() -> None:
    rng = np.random.default_rng(4)
    for _ in range(20):
        m = 12
        a, b, w = rng.integers(m, size=15), rng.integers(m, size=15), rng.uniform(size=15)
        apart = [frozenset({i}) for i in range(m)]  # never seen together: plain components
        found = join(links(a.tolist(), b.tolist(), w.tolist()), apart, 0.5)
        graph = networkx.Graph()
        graph.add_nodes_from(range(m))
        graph.add_edges_from([(int(x), int(y)) for x, y, z in zip(a, b, w) if z > 0.5])
        groups = {frozenset(c) for c in networkx.connected_components(graph)}
        assert {frozenset(np.flatnonzero(found == k).tolist()) for k in np.unique(found)} == groups
        # With frames of their own in common no cluster may hold two of one frame, and the strongest link is kept.
        frames = [frozenset(rng.integers(6, size=2).tolist()) for _ in range(m)]
        found = join(links(a.tolist(), b.tolist(), w.tolist()), frames, 0.5)
        for k in np.unique(found):
            members = [frames[i] for i in np.flatnonzero(found == k)]
            assert sum(map(len, members)) == len(frozenset().union(*members))
        best = int(np.argmax(w))
        if a[best] != b[best] and w[best] > 0.5 and frames[a[best]].isdisjoint(frames[b[best]]):
            assert found[a[best]] == found[b[best]]


def test_a_link_does_not_speak_for_itself() -> None:
    """Two tracklets with drift between them, linked: judged without the link they are as before it."""
    from nolbo_ppl.inference.slam.loop_candidates import link_information, without_own_landmark_equalities

    rng = np.random.default_rng(5)
    A = rng.standard_normal((3, 3))
    before, gap = A @ A.T + 0.5 * np.eye(3), np.array([1.0, -0.5, 0.7])
    information = 1.5
    after = np.linalg.inv(np.linalg.inv(before) + information * np.eye(3))
    pulled = after @ np.linalg.inv(before) @ gap
    found_gap, found = without_own_landmark_equalities(
        np.tile(pulled, (2, 1)), np.tile(after, (2, 1, 1)), np.array([information, 0.0])
    )
    share = np.max(np.linalg.eigvalsh(after)) * information
    assert share < 0.9  # nothing is cut here
    np.testing.assert_allclose(found_gap, [gap, pulled], atol=1e-10)
    np.testing.assert_allclose(found, [before, after], atol=1e-10)
    # The information is that of the weighted link under its Cauchy kernel at the gap.
    joined = links([3, 4], [1, 0], [0.8, 0.5])
    position = np.zeros((5, 3))
    position[3, 0] = 2.0
    found_information = link_information(joined, poses(position), 1.5, np.array([3, 4, 4]), np.array([1, 0, 2]))
    np.testing.assert_allclose(found_information, [0.8 / (1 + 0.8 * 4 / 1.5**2), 0.5, 0.0])


def test_tracklets_seen_together_are_judged_by_their_joint_density() -> None:
    """Three gaps that share their drift: each judged in the graph that holds the links of the others.

    Link after link, the densities multiply to the joint one (the chain rule); with all links in the graph each is the density
    given all others. Both by dense algebra of the joint Gaussian.
    """
    rng = np.random.default_rng(7)
    count, floor, shared = 20000, 0.3, 2.0
    own = np.kron(np.diag([0.2, 0.3, 0.1]), np.eye(3))
    K = shared * np.kron(np.ones((3, 3)), np.eye(3)) + own
    gap = (np.array([1.6, -0.8, 0.4]) + 0.3 * rng.standard_normal((3, 3))).ravel()
    config = SlamConfig(robust_width=1e6)

    def judged(linked: list[int]) -> np.ndarray:
        """Log densities of the three gaps in the graph with these links."""
        information = np.repeat(np.isin(np.arange(3), linked) / floor**2, 3)
        after = np.linalg.inv(np.linalg.inv(K) + np.diag(information))
        mean = after @ np.linalg.solve(K, gap)
        position = np.zeros((6, 3))
        position[:3, 0] = 30.0 * np.arange(3)
        position[3:] = position[:3] + mean.reshape(3, 3)
        deviation = np.zeros((6, 3, count))
        deviation[3:] = (np.linalg.cholesky(after) @ rng.standard_normal((9, count))).reshape(3, 3, count)
        found = candidate_pairs(
            poses(position),
            PosteriorSamples(deviation, np.zeros_like(deviation)),
            features(6, first=np.array([0, 0, 0, 50, 50, 50])),
            PRIOR,
            config,
            inflation=1.0,
            floor=floor,
            links=links([3 + i for i in linked], linked, [1.0] * len(linked), floor),
        )
        assert found.a.tolist() == [3, 4, 5] and found.b.tolist() == [0, 1, 2]
        return np.asarray(found.log_position)

    total = K + floor**2 * np.eye(9)
    joint = multivariate_normal(np.zeros(9), total).logpdf(gap)
    chain = sum(judged(list(range(i)))[i] for i in range(3))
    assert chain == pytest.approx(joint, abs=0.1)
    assert abs(judged([]).sum() - joint) > 1.0  # the marginals, multiplied, say something else
    given_others = judged([0, 1, 2])
    for i in range(3):
        others = np.delete(np.arange(9), slice(3 * i, 3 * i + 3))
        rest = multivariate_normal(np.zeros(6), total[np.ix_(others, others)]).logpdf(gap[others])
        assert given_others[i] == pytest.approx(joint - rest, abs=0.1)
