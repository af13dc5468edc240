"""Several drives, one map: joined where they share a place, apart where they do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nolbo_ppl.data.simulate import (
    DetectorConfig,
    WorldConfig,
    simulate_circuit,
    simulate_detections,
    simulate_odometry,
    simulate_world,
)
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import inverse, relative, se3_exp, se3_log
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, solve_sessions
from nolbo_ppl.inference.slam.common_place import CommonPlace
from nolbo_ppl.inference.slam.sessions import connected, joined_problem
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error

CONFIG = SlamConfig(odometry_rotation_scale=0.003, odometry_translation_ratio=0.01, hypotheses=1)


def drives(seed: int, worlds: tuple[int, int] = (0, 0)) -> tuple[list[SlamProblem], list[np.ndarray]]:
    """Two stretches of a circle that share 20 frames, each in the world of its number."""
    rng = np.random.default_rng(seed)
    circle = simulate_circuit(rng, laps=1, radius=18.0, frames_per_lap=50)
    places = [simulate_world(circle, WorldConfig(objects=22, categories=5, latent_dim=4), rng) for _ in range(2)]
    problems, truths = [], []
    for rows, number in zip((slice(0, 32), slice(12, 44)), worlds):
        truth = circle[rows]
        local = inverse(truth[0]) @ truth
        odometry = simulate_odometry(local, rng, rotation_scale=0.003, translation_ratio=0.01)
        table, _ = simulate_detections(truth, places[number], DetectorConfig(), rng)
        problems.append(SlamProblem(odometry, table))
        truths.append(truth)
    return problems, truths


def test_two_drives_of_one_place_become_one_map() -> None:
    problems, truth = drives(0)
    found = solve_sessions(problems, CONFIG)
    assert len(found.maps) == 1 and found.maps[0].sessions == (0, 1)
    joint = found.map_of(1)
    true = relative(truth[0][0], truth[1][0])
    error = se3_log(relative(joint.T_world_session[1], true))
    assert np.linalg.norm(error[3:]) < 0.6 and np.linalg.norm(error[:3]) < np.radians(2)
    assert 0.1 < error @ np.linalg.solve(joint.covariance[1], error) < 22.5  # chi-square, 6: 0.999
    assert (joint.covariance[0] == 0).all() and np.allclose(joint.T_world_session[0], np.eye(4))
    # Objects of the stretch that both saw are one landmark each: fewer than the two maps have.
    alone = [len(x.landmarks) for x in found.alone]
    assert max(alone) < len(joint.result.landmarks) < sum(alone) - 3
    both = absolute_trajectory_error(np.concatenate([joint.trajectory(0), joint.trajectory(1)]), np.concatenate(truth)).rmse
    assert both < 0.6
    with pytest.raises(InputError, match="no such session"):
        joint.trajectory(2)


def test_drives_of_different_places_stay_apart() -> None:
    problems, _ = drives(1, worlds=(0, 1))
    found = solve_sessions(problems, CONFIG)
    assert [joint.sessions for joint in found.maps] == [(0,), (1,)] and found.places == {}
    assert found.maps[1].result is found.alone[1]


def test_sessions_chain_through_the_surest_places() -> None:
    T = [np.eye(4), se3_exp(np.array([0.1, 0.4, 0.0, 5.0, 0.0, 1.0])), se3_exp(np.array([0.0, -1.0, 0.2, 1.0, 2.0, -4.0]))]
    empty = np.zeros(0, dtype=np.int64)

    def place(a: int, b: int, odds: float, wrong: bool = False) -> CommonPlace:
        pose = se3_exp(np.ones(6)) if wrong else inverse(T[a]) @ T[b]
        return CommonPlace(pose, np.eye(6), empty, empty, odds, odds)

    places = {(0, 2): place(0, 2, 30.0), (1, 2): place(1, 2, 20.0), (0, 1): place(0, 1, 9.0, wrong=True)}
    ((members, poses, used),) = connected(3, places)
    assert members == (0, 1, 2) and used == [(0, 2), (1, 2)]
    np.testing.assert_allclose(poses, T, atol=1e-12)
    assert [group[0] for group in connected(4, {(1, 3): place(1, 2, 9.0)})] == [(0,), (1, 3), (2,)]


def test_joined_problem_keeps_every_detection_and_step() -> None:
    problems, _ = drives(2)
    T = se3_exp(np.array([0.0, 0.5, 0.0, 3.0, 0.0, 1.0]))
    covariances = [np.tile(1e-4 * np.eye(6), (len(p) - 1, 1, 1)) for p in problems]
    stated = [replace(p, odometry_covariance=c) for p, c in zip(problems, covariances)]
    whole = joined_problem(stated, [np.eye(4), T])
    assert len(whole) == 64 and len(whole.observations) == sum(len(p.observations) for p in problems)
    late = whole.observations.frame >= 32
    np.testing.assert_array_equal(whole.observations.position[late], problems[1].observations.position)
    np.testing.assert_array_equal(whole.observations.frame[late] - 32, problems[1].observations.frame)
    np.testing.assert_allclose(whole.odometry[32:], T @ problems[1].odometry)
    assert whole.odometry_covariance is not None
    assert whole.odometry_covariance[31, 5, 5] == 1e6 and whole.odometry_covariance[32, 5, 5] == 1e-4
    assert joined_problem([stated[0], problems[1]], [np.eye(4), T]).odometry_covariance is None


def test_what_cannot_be_joined_is_named() -> None:
    problems, _ = drives(3)
    with pytest.raises(InputError, match="no sessions"):
        solve_sessions([])
    with pytest.raises(InputError, match="several sessions"):
        solve_sessions(problems, replace(CONFIG, scale_drift=True))
    other = replace(
        problems[1],
        observations=replace(
            problems[1].observations,
            latent=problems[1].observations.latent[:, :2],
            latent_scale=problems[1].observations.latent_scale[:, :2],
        ),
    )
    with pytest.raises(InputError, match="different lengths"):
        solve_sessions([problems[0], other])
