"""Positions alone, long ellipsoids along their rays: the graph's answer is the closed form, whatever a landmark's axes are."""

from __future__ import annotations

import numpy as np
import pytest

from nolbo_ppl.geometry.pose import inverse, make_pose, so3_exp, transform
from nolbo_ppl.inference.slam import IncrementalSlam, SlamConfig, SlamProblem
from nolbo_ppl.inference.slam.initialise import init
from nolbo_ppl.structures.detections import Detections

STILL = 1e-6
"""Standard deviations of an odometry that is known."""


def views() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Poses, a point's noisy places in them, their covariances (5 cm across, 3 m along), and the weighted mean of all."""
    rng = np.random.default_rng(0)
    turn, way = np.zeros((12, 3)), np.zeros((12, 3))
    turn[:, 1], way[:, 0] = 0.02 * np.arange(12), 0.5 * np.arange(12)
    T = make_pose(so3_exp(turn), way)
    point = np.array([3.0, 0.5, 9.0])
    local = transform(inverse(T), point)
    ray = local / np.linalg.norm(local, axis=1, keepdims=True)
    C = 0.05**2 * np.eye(3) + 3.0**2 * ray[:, :, None] * ray[:, None, :]
    seen = local + 0.08 * rng.standard_normal(local.shape) + ray * rng.standard_normal((12, 1))  # wider than stated
    R = T[:, :3, :3]
    information = np.linalg.inv(R @ C @ np.swapaxes(R, 1, 2))
    mean = np.linalg.solve(information.sum(axis=0), np.einsum("nij,nj->i", information, transform(T, seen)))
    return T, seen, C, mean


def test_batch_is_the_weighted_mean() -> None:
    T, seen, C, mean = views()
    table = Detections.from_arrays(np.arange(12), seen, position_covariance=C)
    covariance = np.tile(STILL**2 * np.eye(6), (11, 1, 1))
    config = SlamConfig(correct_scales=False, birth_intensity=1e-12, clutter_intensity=1e-20)
    state = init(SlamProblem(T, table, covariance), config)
    assert len(state.static) == 1 and state.weight.min() > 0.999
    np.testing.assert_allclose(state.estimate.T_world_landmark[0, :3, 3], mean, atol=0.01)
    error = transform(inverse(T), mean) - seen
    square = np.einsum("ni,nij,nj->n", error, np.linalg.inv(C), error)
    assert state.graph_error == pytest.approx(0.5 * square.sum(), rel=1e-2)


def test_online_is_the_weighted_mean() -> None:
    T, seen, C, mean = views()
    covariance = STILL**2 * np.eye(6)
    slam = IncrementalSlam(SlamConfig(correct_scales=False, birth_intensity=1e-12, clutter_intensity=1e-20))
    for k in range(12):
        one = Detections.from_arrays([0], seen[[k]], position_covariance=C[[k]], id=[f"d{k}"])
        slam.update(T[k], one, odometry_covariance=None if k == 0 else covariance)
    landmarks = slam.landmarks()
    assert len(landmarks) == 1
    np.testing.assert_allclose(landmarks[0].position, mean, atol=0.02)
