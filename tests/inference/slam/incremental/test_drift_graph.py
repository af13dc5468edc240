"""The coarse drift graph of the online system: a random walk with closings, against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest

from nolbo_ppl.geometry.pose import se3_exp, skew
from nolbo_ppl.inference.slam.graph import inflated
from nolbo_ppl.inference.slam.incremental import drift_graph as drift
from nolbo_ppl.inference.slam.incremental.drift_graph import DriftGraph
from nolbo_ppl.inference.slam.noise.residual_calibration import unstated_range_factor

COUNT = 4000


def walk(graph: DriftGraph, steps: int, seed: int = 0) -> list[np.ndarray]:
    """Drive on, and return the covariance of the world-frame error that each step adds."""
    T, out = np.eye(4), []
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        T = T @ se3_exp(np.array([0, 0, 0, 0, 0, 1.0]) + 0.05 * rng.standard_normal(6))
        graph.advance(T, 0.01, 0.02)
        adjoint = np.zeros((6, 6))
        adjoint[:3, :3] = adjoint[3:, 3:] = T[:3, :3]
        adjoint[3:, :3] = skew(T[:3, 3]) @ T[:3, :3]
        out.append((adjoint * np.repeat([0.01**2, 0.02**2], 3)) @ adjoint.T)
    return out


def assert_covariance(samples: np.ndarray, exact: np.ndarray) -> None:
    found = samples @ samples.T / COUNT
    error = np.sqrt((np.outer(np.diag(exact), np.diag(exact)) + exact**2) / COUNT)
    assert (np.abs(found - exact) < 5 * error).all()


def test_errors_add_along_the_drive_and_are_carried_on() -> None:
    graph, rng = DriftGraph(), np.random.default_rng(1)
    added = walk(graph, 40)
    assert graph.place == 4 and graph.rows(np.array([0, 1, 4])).tolist() == [0, 1, 4]
    delta = graph.samples(COUNT, rng)
    assert np.abs(delta[0]).max() < 1e-4
    assert_covariance(delta[4], np.sum(added, axis=0))
    again = DriftGraph()
    walk(again, 20)
    first = again.samples(COUNT, rng)
    T = np.eye(4)
    for _ in range(10):
        again.advance(T, 0.01, 0.02)
    more = again.samples(COUNT, rng)
    np.testing.assert_array_equal(more[:3], first)
    assert_covariance(more[3] - more[2], 10 * np.diag(np.repeat([0.01**2, 0.02**2], 3)))


def conditioned(added: list[np.ndarray], place: np.ndarray, scale: float) -> np.ndarray:
    """Covariance of nodes 1, 2, 3 by dense Gaussian conditioning on `H (e_3 - e_1) ~ N(0, scale^2)`."""
    H = np.concatenate([-skew(place), np.eye(3)], axis=1)
    parts = [np.sum(added[i : i + 10], axis=0) for i in (0, 10, 20)]
    blocks = np.cumsum(parts, axis=0)
    prior = np.block([[blocks[min(i, j)] for j in range(3)] for i in range(3)])
    A = np.concatenate([-H, np.zeros((3, 6)), H], axis=1)
    gain = prior @ A.T @ np.linalg.inv(A @ prior @ A.T + scale**2 * np.eye(3))
    return prior - gain @ A @ prior


def test_closings_tie_what_they_tie() -> None:
    graph, rng = DriftGraph(), np.random.default_rng(2)
    added = walk(graph, 30)
    place, scale = np.array([1.0, 2.0, 20.0]), 0.05
    graph.samples(COUNT, rng)
    graph.close(3, 1, place, scale)
    assert_covariance(graph.samples(COUNT, rng)[1:].reshape(18, COUNT), conditioned(added, place, scale))


def test_on_known_ground_no_node_is_added_and_the_error_is_filtered() -> None:
    """The camera's error relative to the place it is at, against the Kalman filter written out."""
    graph, rng = DriftGraph(), np.random.default_rng(3)
    added = walk(graph, 25)  # 2 nodes, and 5 steps on from the last
    graph.samples(COUNT, rng)
    local, place, scale = np.sum(added[20:], axis=0), np.array([1.0, -1.0, 22.0]), 0.3
    H = np.concatenate([-skew(place), np.eye(3)], axis=1)
    np.testing.assert_allclose(graph.local, local, rtol=1e-9)
    graph.meet(2, place, scale)
    expected = local - local @ H.T @ np.linalg.inv(H @ local @ H.T + scale**2 * np.eye(3)) @ H @ local
    np.testing.assert_allclose(graph.local, expected, atol=1e-9)
    here = graph.samples_here(COUNT, rng) - graph.samples(COUNT, rng)[2]
    assert_covariance(here, expected)
    for _ in range(200):  # round and round the same place
        graph.advance(np.eye(4), 0.01, 0.02)
        graph.meet(2, place, scale)
    assert len(graph.gaps) == 3 and graph.place == 2
    assert np.trace(H @ graph.local @ H.T) < 3 * scale**2


def test_a_landmark_of_an_old_place_met_after_drift_closes_a_loop() -> None:
    graph, rng = DriftGraph(), np.random.default_rng(4)
    added = walk(graph, 30)
    graph.samples(COUNT, rng)
    place = np.array([1.0, 2.0, 20.0])
    graph.meet(1, place, 0.05)
    assert len(graph.loops) == 1
    assert_covariance(graph.samples(COUNT, rng)[1:].reshape(18, COUNT), conditioned(added, place, 0.05))
    graph.meet(1, place, 0.5)  # nothing left that a loop would tell
    assert len(graph.loops) == 1


def test_nodes_stay_few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drift, "MOST_NODES", 7)
    graph = DriftGraph(stride=2)
    added = walk(graph, 100)
    assert len(graph.gaps) <= 7 and graph.stride >= 16
    delta = graph.samples(COUNT, np.random.default_rng(3))
    rest = len(added) - graph.since
    assert_covariance(delta[graph.here], np.sum(added[:rest], axis=0))
    rows = graph.rows(np.arange(len(graph.standing)))
    assert rows[0] == 0 and (np.diff(rows) >= 0).all() and rows[-1] == len(graph.gaps) - 1


def test_covariances_widen_along_and_across_the_ray() -> None:
    position = np.array([[0.0, 0.0, 4.0], [3.0, 0.0, 0.0]])
    wide = inflated(np.tile(np.eye(3), (2, 1, 1)), position, 4.0, 9.0)
    np.testing.assert_allclose(wide, [np.diag([4.0, 4.0, 9.0]), np.diag([9.0, 4.0, 4.0])], atol=1e-12)


def test_depth_of_cameras_is_trusted_less_than_that_of_lidar() -> None:
    scales = {"position_lateral": 0.01, "position_lateral_ratio": 0.001, "position_radial_ratio": 0.001}
    assert unstated_range_factor({**scales, "position_radial": 0.01}, 10.0) == 4.0
    assert unstated_range_factor({**scales, "position_radial": 0.05}, 10.0) == pytest.approx(4.0 * 4.0)
    assert 4.0 < unstated_range_factor({**scales, "position_radial": 0.03}, 10.0) < 16.0
    assert unstated_range_factor({}, 10.0) == 4.0
