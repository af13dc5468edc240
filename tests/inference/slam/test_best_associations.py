"""The search for whole associations against every partition of a few tracklets, and on a drive whose annealed run goes wrong."""

from itertools import islice, pairwise, product
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from nolbo_ppl.data.simulate import DetectorConfig, WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, hypotheses, solve, solve_with_associations
from nolbo_ppl.inference.slam import best_associations as module
from nolbo_ppl.inference.slam.best_associations import WholeAssociation, best_associations, search, with_association
from nolbo_ppl.inference.slam.initialise import init
from nolbo_ppl.inference.slam.map_evidence import trajectory_distance
from nolbo_ppl.structures.detections import Detections

FLOOR, LOG_NEW = 0.2, -3.0


def drifting(seed, tracklets=6, probes=2):
    """Positions with a drift that grows, four of them two passes of two objects; one later feature that speaks for itself."""
    rng = np.random.default_rng(seed)
    n = tracklets + probes
    steps = rng.normal(size=(n, 3, 4)) * 0.4
    walk = np.cumsum(steps, axis=0).reshape(3 * n, 4)
    covariance = walk @ walk.T + 0.02 * np.eye(3 * n)
    position = rng.normal(size=(n, 3)) * 1.5
    position[3] = position[0] + 0.6
    position[4] = position[1] + 0.6
    log_ratio = rng.normal(size=(tracklets, tracklets))
    first = np.arange(tracklets) * 10
    last = first + np.array([5, 12, 3, 4, 11, 2])  # the second overlaps the third, the fifth the sixth
    return position, covariance.reshape(n, 3, n, 3), first, last, log_ratio


def enumerated(position, covariance, first, last, log_ratio):
    """Joint log density of every partition without overlaps in time, by one multivariate normal over all its gaps."""
    m, out = len(first), {}
    full = covariance.reshape(3 * len(position), -1)
    for root in product(*[range(a + 1) for a in range(m)]):
        if any(root[r] != r for r in root):
            continue
        members = [[b for b in range(m) if root[b] == r] for r in set(root)]
        if any(last[i] >= first[j] for group in members for i, j in pairwise(group)):
            continue
        pairs = [(a, r) for a, r in enumerate(root) if a != r]
        H = np.zeros((3 * len(pairs), len(full)))
        for k, (a, r) in enumerate(pairs):
            H[3 * k : 3 * k + 3, 3 * a : 3 * a + 3] = np.eye(3)
            H[3 * k : 3 * k + 3, 3 * r : 3 * r + 3] = -np.eye(3)
        value = sum(log_ratio[a, r] for a, r in pairs) - len(pairs) * LOG_NEW
        if pairs:
            value += multivariate_normal.logpdf(H @ position.ravel(), cov=H @ full @ H.T + FLOOR**2 * np.eye(len(H)))
        out[root] = value
    return out


@pytest.mark.parametrize("seed", range(6))
def test_search_finds_the_best_partition_with_its_joint_density(seed, monkeypatch):
    monkeypatch.setattr(module, "GATE", np.inf)
    monkeypatch.setattr(module, "WORST", np.inf)
    monkeypatch.setattr(module, "BRANCHES", 10)
    monkeypatch.setattr(module, "BEAM", 1000)
    monkeypatch.setattr(module, "ALIKE", 1000)
    problem = drifting(seed)
    every = enumerated(*problem)
    found = search(*problem, floor=FLOOR, log_new=LOG_NEW, count=3)
    best = max(every, key=every.get)
    assert tuple(found[0].root) == best
    for one in found:
        assert one.log_odds == pytest.approx(every[tuple(one.root)], abs=1e-8)


@pytest.mark.parametrize("seed", range(6))
def test_narrow_beam_loses_little(seed):
    problem = drifting(seed)
    every = enumerated(*problem)
    found = search(*problem, floor=FLOOR, log_new=LOG_NEW, count=1)
    assert found[0].log_odds > max(every.values()) - 2.0
    assert found[0].log_odds == pytest.approx(every[tuple(found[0].root)], abs=1e-8)


@pytest.fixture(scope="module")
def lookalikes():
    """Two laps round identical objects with loose odometry, where annealing from the odometry closes the wrong loops."""
    rng = np.random.default_rng(4)
    drive = simulate_sequence(
        simulate_circuit(rng, laps=2, radius=12.0, frames_per_lap=36),
        rng,
        world=WorldConfig(objects=24, categories=1, latent_dim=0, instance_scale=0.0),
        detector=DetectorConfig(maximum_range=12.0, rotation_scale=None, clutter_rate=0.3),
        odometry_rotation_scale=0.02,
        odometry_translation_ratio=0.05,
    )
    stated = {"odometry_rotation_scale": 0.02, "odometry_translation_ratio": 0.05}
    problem = SlamProblem(drive.odometry, drive.observations)
    oracle = solve_with_associations(problem, drive.object_of, SlamConfig(**stated)).estimate.T_world_camera
    return problem, oracle, stated


def test_map_of_the_true_associations_is_found_where_annealing_alone_misses_it(lookalikes):
    problem, oracle, stated = lookalikes
    alone = solve(problem, SlamConfig(hypotheses=1, **stated))
    several = solve(problem, SlamConfig(**stated))
    assert trajectory_distance(alone.T_world_camera, oracle) > 2.0
    assert trajectory_distance(several.T_world_camera, oracle) < 1.3


def test_start_with_an_association_holds_its_objects_together(lookalikes):
    problem, _, stated = lookalikes
    state = init(problem, SlamConfig(**stated))
    best = best_associations(state)[0]
    start = with_association(state, best)
    position = start.estimate.T_world_landmark[:, :3, 3]
    joined = best.root != np.arange(len(best.root))
    before = state.estimate.T_world_landmark[:, :3, 3]
    gap = np.linalg.norm(position - position[best.root], axis=1)[joined]
    assert np.median(gap) < 0.3 < np.median(np.linalg.norm(before - before[best.root], axis=1)[joined])


def test_nothing_associated_leaves_the_trajectory(lookalikes):
    problem, _, stated = lookalikes
    state = init(problem, SlamConfig(**stated))
    alone = with_association(state, WholeAssociation(np.arange(len(state.static)), 0.0))
    assert trajectory_distance(alone.estimate.T_world_camera, state.estimate.T_world_camera) < 0.01


def test_long_drives_are_not_searched(lookalikes, monkeypatch):
    problem, _, stated = lookalikes
    monkeypatch.setattr(module, "MOST_TRACKLETS", 5)
    assert best_associations(init(problem, SlamConfig(**stated))) == []


def test_starts_of_further_runs(monkeypatch):
    """Scales stated: the best association first. Guessed: a wider drift first. Agreed: what comes near the best alone."""
    monkeypatch.setattr(hypotheses, "with_association", lambda state, one: f"association {one.log_odds:g}")
    monkeypatch.setattr(hypotheses, "start_of_run", lambda state, k: f"anneal {k}")
    found = [WholeAssociation(np.zeros(1, int), odds) for odds in (10.0, 7.0, 4.0)]
    problem = SlamProblem(np.tile(np.eye(4), (2, 1, 1)), Detections.from_arrays([0], [[0, 0, 4.0]]))
    guessed = SimpleNamespace(problem=problem, config=SlamConfig())
    stated = SimpleNamespace(problem=problem, config=SlamConfig(odometry_rotation_scale=0.01, odometry_translation_scale=0.1))
    after = hypotheses.starts_after_first
    first = ["association 10", "anneal 1", "association 7", "anneal 2", "association 4", "anneal 3", "anneal 4"]
    assert list(islice(after(stated, found), 7)) == first
    assert list(islice(after(guessed, found), 4)) == ["anneal 1", "association 10", "anneal 2", "association 7"]
    assert list(islice(after(stated, []), 2)) == ["anneal 1", "anneal 2"]
    assert list(hypotheses.near_rivals(stated, found)) == ["association 7"]
    assert list(hypotheses.near_rivals(stated, [])) == list(hypotheses.near_rivals(guessed, found)) == []
