"""Rigid motions against matrix exponentials, and round trips up to half turns."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from nolbo_ppl.geometry.pose import (
    adjoint,
    chain,
    inverse,
    is_rotation,
    make_pose,
    matrix_to_quaternion,
    mean_rotation,
    nearest_rotation,
    quaternion_to_matrix,
    relative,
    rotation_angle,
    se3_exp,
    se3_log,
    skew,
    so3_exp,
    so3_log,
    transform,
)


@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e-5, 1e-3, 0.5, 2.0, 3.1])
def test_exponentials_equal_the_matrix_exponential(scale: float) -> None:
    rng = np.random.default_rng(0)
    for _ in range(5):
        omega = rng.standard_normal(3)
        omega *= scale / np.linalg.norm(omega)
        v = rng.standard_normal(3)
        np.testing.assert_allclose(so3_exp(omega), expm(skew(omega)), atol=1e-12)
        twist = np.zeros((4, 4))
        twist[:3, :3], twist[:3, 3] = skew(omega), v
        T = se3_exp(np.concatenate([omega, v]))
        np.testing.assert_allclose(T, expm(twist), atol=1e-11)
        np.testing.assert_allclose(se3_log(T), np.concatenate([omega, v]), atol=1e-8)


def test_half_turns() -> None:
    for axis in np.eye(3):
        R = so3_exp(np.pi * axis)
        assert rotation_angle(R) == pytest.approx(np.pi)
        np.testing.assert_allclose(np.abs(so3_log(R)), np.pi * axis, atol=1e-7)


def test_quaternions_round_trip() -> None:
    q = np.random.default_rng(1).standard_normal((200, 4))
    R = quaternion_to_matrix(q)
    assert is_rotation(R, 1e-12).all()
    np.testing.assert_allclose(quaternion_to_matrix(matrix_to_quaternion(R)), R, atol=1e-12)
    assert (matrix_to_quaternion(R)[:, 3] >= 0).all()


def test_local_rotation_with_a_non_commuting_pair() -> None:
    """R_camera_object = R_world_camera' R_world_object; the other order differs."""
    R_world_camera, R_world_object = so3_exp(np.array([0.4, 0.0, 0.0])), so3_exp(np.array([0.0, 0.9, 0.3]))
    T = relative(make_pose(R_world_camera, np.zeros(3)), make_pose(R_world_object, np.zeros(3)))
    np.testing.assert_allclose(T[:3, :3], R_world_camera.T @ R_world_object, atol=1e-14)
    assert np.abs(T[:3, :3] - R_world_object @ R_world_camera.T).max() > 0.05


def test_composition() -> None:
    rng = np.random.default_rng(2)
    T = se3_exp(rng.standard_normal((250, 6)))
    np.testing.assert_allclose(T @ inverse(T), np.tile(np.eye(4), (250, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(chain(T[0], relative(T[:-1], T[1:])), T, atol=1e-9)
    point = rng.standard_normal((250, 3))
    np.testing.assert_allclose(transform(inverse(T), transform(T, point)), point, atol=1e-12)


def test_means_and_projections_are_rotations() -> None:
    rng = np.random.default_rng(3)
    R = so3_exp(np.array([0.3, -0.4, 1.0])) @ so3_exp(0.05 * rng.standard_normal((500, 3)))
    assert rotation_angle(mean_rotation(R).T @ so3_exp(np.array([0.3, -0.4, 1.0]))) < 5 * 0.05 * np.sqrt(3 / 500)
    assert np.linalg.det(nearest_rotation(-np.eye(3) + 0.1 * rng.standard_normal((3, 3)))) == pytest.approx(1.0)
    assert not is_rotation(np.diag([1.0, 1.0, -1.0]))


def test_the_adjoint_carries_a_twist() -> None:
    rng = np.random.default_rng(0)
    T, xi = se3_exp(rng.standard_normal((5, 6))), 0.3 * rng.standard_normal((5, 6))
    carried = np.einsum("nij,nj->ni", adjoint(T), xi)
    np.testing.assert_allclose(T @ se3_exp(xi) @ inverse(T), se3_exp(carried), atol=1e-12)
    np.testing.assert_array_equal(adjoint(T[0]), adjoint(T)[0])


def test_angles_are_those_of_the_rotation_vectors() -> None:
    rng = np.random.default_rng(4)
    axis = rng.standard_normal((8, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.array([0.0, 1e-9, 1e-4, 0.3, 2.0, 3.1, np.pi - 1e-6, np.pi])
    np.testing.assert_allclose(rotation_angle(so3_exp(angle[:, None] * axis)), angle, rtol=1e-9, atol=1e-12)
