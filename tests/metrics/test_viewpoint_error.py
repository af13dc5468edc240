import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nolbo_ppl.errors import InputError
from nolbo_ppl.metrics.viewpoint_error import rotation_error


def random_rotations(n, seed):
    return Rotation.random(n, rng=np.random.default_rng(seed)).as_matrix()


def turned(R, angle):
    return R @ Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()


def test_without_symmetry_it_is_the_norm_of_the_matrix_logarithm():
    from scipy.linalg import logm

    a, b = random_rotations(20, 0), random_rotations(20, 1)
    expected = [np.linalg.norm(logm(x.T @ y)) / math.sqrt(2) for x, y in zip(a, b)]
    np.testing.assert_allclose(rotation_error(a, b, np.ones(20, dtype=int)), expected, atol=1e-10)


@pytest.mark.parametrize("order", [2, 3, 4])
def test_turns_of_the_group_cost_nothing(order):
    a = random_rotations(30, 2)
    b = turned(a, 2 * math.pi * 1 / order)
    np.testing.assert_allclose(rotation_error(a, b, np.full(30, order)), 0, atol=1e-7)
    half = turned(a, math.pi / order)
    np.testing.assert_allclose(rotation_error(a, half, np.full(30, order)), math.pi / order, atol=1e-10)


def test_free_axis_against_a_search_over_turns():
    a, b = random_rotations(10, 3), random_rotations(10, 4)
    grid = np.linspace(0, 2 * math.pi, 20_000, endpoint=False)
    turns = Rotation.from_rotvec(np.outer(grid, [0, 0, 1]))
    relative = Rotation.from_matrix(a.transpose(0, 2, 1) @ b)
    expected = [(relative[i] * turns).magnitude().min() for i in range(10)]
    np.testing.assert_allclose(rotation_error(a, b, np.zeros(10, dtype=int)), expected, atol=1e-6)


def test_small_and_half_turn_errors_are_accurate():
    a = random_rotations(1, 5)
    for angle in (1e-9, 1e-6, math.pi - 1e-9, math.pi):
        b = a @ Rotation.from_rotvec([angle, 0.0, 0.0]).as_matrix()
        np.testing.assert_allclose(rotation_error(a, b, np.array([1])), angle, rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(rotation_error(a, b, np.array([0])), angle, rtol=1e-6, atol=1e-12)


def test_mixed_orders_keep_their_rows():
    a, b = random_rotations(3, 6), random_rotations(3, 7)
    mixed = rotation_error(a, b, np.array([1, 0, 4]))
    for i, order in enumerate((1, 0, 4)):
        assert mixed[i] == rotation_error(a[i : i + 1], b[i : i + 1], np.array([order]))[0]


def test_errors():
    with pytest.raises(InputError, match=r"rotations.*twice"):
        rotation_error(np.eye(3)[None], np.eye(3)[None].repeat(2, 0), np.array([1]))
    with pytest.raises(InputError, match=r"order of a symmetry.*-1"):
        rotation_error(np.eye(3)[None], np.eye(3)[None], np.array([-1]))
