"""Covariances between keyframes against sampled trajectories; which frames are keyframes."""

from __future__ import annotations

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import chain, inverse, relative, se3_exp, se3_log
from nolbo_ppl.odometry import Odometry, at_keyframes, between, compose_covariance, keyframes


def path(steps: np.ndarray, covariance: np.ndarray) -> Odometry:
    n = len(steps)
    return Odometry(chain(np.eye(4), se3_exp(steps)), covariance, np.full(n, 100), np.arange(n) + 50, np.zeros(n, np.uint8))


def covariances(rng: np.random.Generator, n: int) -> np.ndarray:
    root = rng.standard_normal((n, 6, 6)) * np.repeat([0.004, 0.02], 3)[:, None]
    return root @ np.swapaxes(root, 1, 2)


def test_joined_covariance_is_that_of_samples() -> None:
    rng = np.random.default_rng(1)
    steps = np.array([[0.0, 0.3, 0.05, 0.2, 0.0, 1.0]] * 5)
    odometry = path(steps, covariances(rng, 5))
    draws = 40_000
    total = np.broadcast_to(np.eye(4), (draws, 4, 4))
    for k in range(5):
        noise = rng.multivariate_normal(np.zeros(6), odometry.covariance[k], draws)
        total = total @ se3_exp(steps[k]) @ se3_exp(noise)
    mean = odometry.T_world_camera[5]
    errors = se3_log(inverse(mean) @ total)
    sampled = errors.T @ errors / draws
    joined = between(odometry, np.array([0, 5]))[0]
    # Standard error of an entry of a sampled Gaussian covariance, and 1 % for what first order leaves out.
    tolerance = 5 * np.sqrt((joined**2 + np.outer(np.diag(joined), np.diag(joined))) / draws)
    tolerance += 0.01 * np.sqrt(np.outer(np.diag(joined), np.diag(joined)))
    assert (np.abs(sampled - joined) < tolerance).all()


def test_joining_is_associative_and_a_step_alone_stays() -> None:
    rng = np.random.default_rng(2)
    odometry = path(0.2 * rng.standard_normal((3, 6)), covariances(rng, 3))
    np.testing.assert_array_equal(between(odometry, np.arange(4)), odometry.covariance)
    T = odometry.T_world_camera
    right = compose_covariance(odometry.covariance[1], relative(T[2], T[3]), odometry.covariance[2])
    all_right = compose_covariance(odometry.covariance[0], relative(T[1], T[3]), right)
    np.testing.assert_allclose(between(odometry, np.array([0, 3]))[0], all_right, rtol=1e-10)


def test_keyframes_by_distance_and_angle() -> None:
    steps = np.zeros((20, 6))
    steps[:10, 5], steps[10:, 1] = 0.3, 0.1
    odometry = path(steps, np.tile(np.eye(6), (20, 1, 1)))
    assert keyframes(odometry, 0.9 - 1e-9, 0.25).tolist() == [0, 3, 6, 9, 13, 16, 19]
    assert keyframes(odometry, 0.9 - 1e-9, np.inf).tolist() == [0, 3, 6, 9]
    assert keyframes(odometry, 1e9, 1e9).tolist() == [0]


def test_a_guessed_frame_is_no_keyframe_where_another_follows() -> None:
    steps = np.zeros((8, 6))
    steps[:, 5] = 0.5
    odometry = path(steps, np.tile(np.eye(6), (8, 1, 1)))
    odometry.flags[1] = 1  # the motion into frame 2
    assert keyframes(odometry, 1.0 - 1e-9, 1.0).tolist() == [0, 3, 5, 7]
    odometry.flags[:] = 1
    assert keyframes(odometry, 1.0 - 1e-9, 1.0).tolist() == [0, 4, 8]


def test_odometry_at_keyframes() -> None:
    rng = np.random.default_rng(3)
    odometry = path(0.1 * rng.standard_normal((6, 6)), covariances(rng, 6))
    odometry.flags[2], odometry.flags[3] = 1, 8
    few = at_keyframes(odometry, np.array([0, 2, 5]))
    np.testing.assert_array_equal(few.T_world_camera, odometry.T_world_camera[[0, 2, 5]])
    assert few.inliers.tolist() == [50, 52] and few.flags.tolist() == [0, 9] and few.covariance.shape == (2, 6, 6)


def test_rows_that_are_not_there() -> None:
    odometry = path(np.zeros((3, 6)), np.tile(np.eye(6), (3, 1, 1)))
    for rows in ([0, 4], [-1, 2], [2, 1], [1, 1]):
        with pytest.raises(InputError, match="rows of the odometry"):
            between(odometry, np.array(rows))
    with pytest.raises(InputError, match="spacing of keyframes"):
        keyframes(odometry, 0.0, 1.0)
