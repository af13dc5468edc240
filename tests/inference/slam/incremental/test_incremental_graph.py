"""The running graph against the same factors solved at once by Levenberg-Marquardt, and against GTSAM's marginals."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from nolbo_ppl.geometry.pose import inverse, make_pose, se3_exp, so3_exp
from nolbo_ppl.inference.slam.graph import GraphError, landmark_key, pose_key
from nolbo_ppl.inference.slam.incremental.incremental_graph import OBSERVATION, PRIOR, STEP, Factor, IncrementalGraph, compose

ODOMETRY = np.diag(np.repeat([0.01**2, 0.03**2], 3))
DETECTION = np.diag(np.repeat([0.1**2, 0.2**2], 3))


def world(poses: int, landmarks: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A straight drive past two rows of landmarks."""
    T = make_pose(np.tile(np.eye(3), (poses, 1, 1)), np.arange(poses)[:, None] * np.array([0.0, 0.0, 1.0]))
    rng = np.random.default_rng(seed)
    place = np.stack([6 * np.sign(rng.random(landmarks) - 0.5), np.zeros(landmarks), np.linspace(0, poses, landmarks)], axis=1)
    return T, make_pose(so3_exp(rng.normal(size=(landmarks, 3))), place)


def drive(poses: int = 30, landmarks: int = 10, seed: int = 0, turn: np.ndarray | None = None) -> IncrementalGraph:
    """Noisy steps and observations within 8 m, committed pose by pose.

    With `turn` the first landmark is, from the middle of the drive on, observed as another one whose axes are turned.
    """
    rng = np.random.default_rng(seed)
    T, L = world(poses, landmarks, seed)
    graph, number = IncrementalGraph(), {}
    guess = T[0]
    for i in range(poses):
        if i:
            step = inverse(T[i - 1]) @ T[i] @ se3_exp(rng.normal(size=6) * np.sqrt(np.diag(ODOMETRY)))
            guess = graph.pose(i - 1) @ step
            graph.add_pose(step, ODOMETRY, guess)
        else:
            graph.add_first_pose(guess)
        for j in np.flatnonzero(np.linalg.norm(L[:, :3, 3] - T[i, :3, 3], axis=1) < 12):
            noise = se3_exp(rng.normal(size=6) * np.sqrt(np.diag(DETECTION)))
            other = turn is not None and j == 4 and i >= poses // 2
            Z = inverse(T[i]) @ L[j] @ noise @ (turn if turn is not None and other else np.eye(4))
            key = (int(j), bool(other))
            if key not in number:
                number[key] = graph.add_landmark(guess @ Z, 10.0)
            graph.add(Factor(OBSERVATION, i, number[key], Z, DETECTION))
        graph.commit()
    graph.settle()
    return graph


def at_once(graph: IncrementalGraph) -> tuple[gtsam.Values, gtsam.Marginals]:
    """All factors by Levenberg-Marquardt."""
    whole = gtsam.NonlinearFactorGraph()
    for number in sorted(graph.factors):
        whole.add(graph.factors[number].build())
    values = gtsam.LevenbergMarquardtOptimizer(whole, graph.isam.calculateEstimate()).optimize()
    return values, gtsam.Marginals(whole, values)


def test_estimates_and_covariances_are_those_of_the_batch() -> None:
    graph = drive()
    values, marginals = at_once(graph)
    for i in (5, 29):
        np.testing.assert_allclose(graph.pose(i), values.atPose3(pose_key(i)).matrix(), atol=8e-3)
        exact = marginals.marginalCovariance(pose_key(i))
        np.testing.assert_allclose(graph.pose_covariance(i), exact, atol=0.05 * np.abs(exact).max())
    for j in (0, 7):
        np.testing.assert_allclose(graph.landmark(j), values.atPose3(landmark_key(j)).matrix(), atol=8e-3)
        exact = marginals.marginalCovariance(landmark_key(j))
        np.testing.assert_allclose(graph.landmark_covariance(j), exact, atol=0.05 * np.abs(exact).max())
    assert graph.trajectory().shape == (30, 4, 4)


def test_merged_landmarks_are_as_if_they_had_been_one() -> None:
    """Two halves of one object's observations, the later ones turned by 90 degrees, against the drive without that."""
    turn = make_pose(so3_exp(np.array([0.0, 0.0, np.pi / 2])), np.zeros(3))
    one, two = drive(seed=3), drive(seed=3, turn=turn)
    assert two.landmarks == one.landmarks + 1
    place = one.landmark(4)[:3, 3]
    newer = next(j for j in range(two.landmarks) if j != 4 and np.linalg.norm(two.landmark(j)[:3, 3] - place) < 1.0)
    two.merge(newer, 4, inverse(turn))
    two.settle()
    assert newer not in two.of_landmark and not two.isam.valueExists(landmark_key(newer))
    assert len(two.factors) == len(one.factors)
    np.testing.assert_allclose(two.landmark(4), one.landmark(4), atol=1e-2)
    np.testing.assert_allclose(two.landmark_covariance(4), one.landmark_covariance(4), atol=1e-3)
    np.testing.assert_allclose(two.trajectory(), one.trajectory(), atol=1e-2)


def test_orientations_that_disagree_leave_the_position_alone() -> None:
    graph = drive(seed=4, turn=make_pose(so3_exp(np.array([0.7, 0.9, 0.0])), np.zeros(3)))
    before = graph.landmark(4)
    newer = next(j for j in range(graph.landmarks) if j != 4 and np.linalg.norm(graph.landmark(j)[:3, 3] - before[:3, 3]) < 1.0)
    graph.merge(newer, 4, np.eye(4), agree=False)
    graph.settle()
    turned = np.arccos(np.clip((np.trace(before[:3, :3].T @ graph.landmark(4)[:3, :3]) - 1) / 2, -1, 1))
    assert turned < 0.02 and np.linalg.norm(graph.landmark(4)[:3, 3] - before[:3, 3]) < 0.2


def test_condensing_keeps_what_is_known() -> None:
    """Twenty poses become two: estimates within a third of a standard deviation, covariances within a seventh."""
    full, small = drive(seed=5), drive(seed=5)
    small.condense(list(range(5, 15)))
    small.condense(list(range(15, 25)))
    small.settle()
    assert sorted(small.of_pose) == [*range(5), 10, 20, *range(25, 30)]
    assert not small.isam.valueExists(pose_key(12))
    values, _ = at_once(small)
    np.testing.assert_allclose(small.pose(29), values.atPose3(pose_key(29)).matrix(), atol=8e-3)
    for j in range(10):
        exact, told = full.landmark_covariance(j), small.landmark_covariance(j)
        np.testing.assert_allclose(np.diag(told), np.diag(exact), rtol=0.15)
        error = (full.landmark(j)[:3, :3].T @ (small.landmark(j)[:3, 3] - full.landmark(j)[:3, 3])) / np.sqrt(np.diag(exact)[3:])
        assert np.abs(error).max() < 0.35
    scale = np.sqrt(np.diag(full.pose_covariance(12))[3:].max())
    assert np.linalg.norm(full.trajectory()[:, :3, 3] - small.trajectory()[:, :3, 3], axis=1).max() < 0.5 * scale
    np.testing.assert_allclose(np.diag(small.pose_covariance(12)), np.diag(full.pose_covariance(12)), rtol=0.25)
    # The last pose of a stretch forgotten hangs on its neighbour.
    small.drop(10, 20)
    small.settle()
    assert sorted(small.of_pose) == [*range(5), 20, *range(25, 30)]
    assert small.hanging.root(12)[0] == 20 and np.isfinite(small.trajectory()).all()


def test_steps_compose_as_sampled_motions_do() -> None:
    rng, count = np.random.default_rng(6), 40000
    first = Factor(STEP, 0, 1, se3_exp(np.array([0.3, -0.2, 0.1, 1.0, 2.0, 0.5])), 1e-4 * np.diag([1.0, 2, 3, 4, 5, 6]))
    second = Factor(STEP, 1, 2, se3_exp(np.array([-0.1, 0.4, 0.2, 2.0, 0.0, 1.0])), 1e-4 * np.diag([6.0, 5, 4, 3, 2, 1]))
    both = compose(first, second)
    a, b = (rng.normal(size=(count, 6)) * np.sqrt(np.diag(f.covariance)) for f in (first, second))
    error = inverse(both.T) @ (first.T @ se3_exp(a) @ second.T @ se3_exp(b))
    # To first order the rotation vector and position of the error are its tangent.
    skewed = error[:, :3, :3] - np.swapaxes(error[:, :3, :3], 1, 2)
    tangent = np.concatenate([np.stack([skewed[:, 2, 1], skewed[:, 0, 2], skewed[:, 1, 0]], axis=1) / 2, error[:, :3, 3]], axis=1)
    sampled = tangent.T @ tangent / count
    scale = np.sqrt((np.outer(np.diag(sampled), np.diag(sampled)) + sampled**2) / count)
    assert (np.abs(sampled - both.covariance) < 5 * scale + 2e-5).all()
    assert (both.a, both.b) == (0, 2)


def test_a_chain_without_detections_is_bridged_exactly() -> None:
    graph = IncrementalGraph()
    graph.add_first_pose(np.eye(4))
    for i in range(1, 12):
        step = se3_exp(np.array([0, 0.1, 0, 0, 0, 1.0]))
        graph.add_pose(step, ODOMETRY, graph.pose(i - 1) @ step)
    graph.commit()
    before = graph.pose_covariance(11)
    graph.condense(list(range(2, 9)))
    graph.settle()
    assert sorted(graph.of_pose) == [0, 1, 5, 9, 10, 11]
    np.testing.assert_allclose(graph.pose_covariance(11), before, rtol=1e-6, atol=1e-12)


def test_rebuilding_changes_nothing_that_is_told() -> None:
    graph = drive(seed=7)
    before, spread = graph.trajectory(), graph.landmark_covariance(3)
    graph.rebuild()
    np.testing.assert_allclose(graph.trajectory(), before, atol=1e-2)
    np.testing.assert_allclose(graph.landmark_covariance(3), spread, atol=0.05 * np.abs(spread).max())


def test_factors_that_wait_can_be_taken_back() -> None:
    graph = IncrementalGraph()
    graph.add_first_pose(np.eye(4))
    j = graph.add_landmark(make_pose(np.eye(3), np.array([0, 0, 5.0])), 5.0)
    other = graph.add_landmark(make_pose(np.eye(3), np.array([0, 0, 5.1])), 5.0)
    for k in (j, other):
        graph.add(Factor(OBSERVATION, 0, k, make_pose(np.eye(3), np.array([0, 0, 5.0 + 0.2 * k])), DETECTION))
    graph.merge(other, j, np.eye(4))
    graph.commit()
    assert not graph.isam.valueExists(landmark_key(other))
    assert sum(f.kind == PRIOR for f in graph.factors.values()) == 1
    assert graph.landmark(j)[2, 3] == pytest.approx(5.1, abs=1e-3)


def test_a_graph_without_solution_names_the_variable() -> None:
    graph = IncrementalGraph()
    graph.add_first_pose(np.eye(4))
    graph.add(Factor(OBSERVATION, 0, 7, np.eye(4), DETECTION))
    with pytest.raises(GraphError, match="l7"):
        graph.commit()


def test_scales_too_far_apart_for_cholesky_are_solved_with_care() -> None:
    """A landmark seen once, its detection 1e9 times wider than the step: an iSAM2 by QR takes over with the same answer."""
    graph = IncrementalGraph()
    graph.add_first_pose(np.eye(4))
    graph.commit()
    step = make_pose(np.eye(3), np.array([0, 0, 1.0]))
    graph.add_pose(step, 1e-16 * np.eye(6), step)
    j = graph.add_landmark(make_pose(np.eye(3), np.array([0, 0, 6.0])), 1e7)
    graph.add(Factor(OBSERVATION, 1, j, make_pose(np.eye(3), np.array([0, 0, 5.0])), 1e10 * np.eye(6)))
    graph.commit()
    np.testing.assert_allclose(graph.landmark(j)[:3, 3], [0, 0, 6.0], atol=1e-6)
    np.testing.assert_allclose(graph.pose(1), step, atol=1e-6)
