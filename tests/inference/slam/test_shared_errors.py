"""Errors that all views of an object share: roots, covariances by hand and by Monte Carlo, reading and writing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import inverse, make_pose, so3_exp, transform
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, solve_with_associations
from nolbo_ppl.inference.slam.gaussian import upper_root
from nolbo_ppl.inference.slam.shared_errors import error_root, linearise_answer
from nolbo_ppl.inference.slam.slam_state import SlamState, measured_graph
from nolbo_ppl.io.observations import read_observations, write_observations
from nolbo_ppl.structures.detection_checks import check_table
from nolbo_ppl.structures.detections import Detections

VIEWS = 8
OBJECTS = np.array([[1.0, 0.2, 6.0], [-2.0, 0.0, 8.0], [0.5, -0.3, 9.0]])
OWN, SHARED = np.array([0.02, 0.02, 0.05]), np.array([0.05, 0.03, 0.1])


def path() -> np.ndarray:
    """A camera that turns by a quarter while it passes three objects."""
    turn, way = np.zeros((VIEWS, 3)), np.zeros((VIEWS, 3))
    turn[:, 1] = np.linspace(0.8, -0.8, VIEWS)
    way[:, 0] = np.linspace(-5, 5, VIEWS)
    return make_pose(so3_exp(turn), way)


def solved(rng: np.random.Generator, shared: bool = True) -> SlamState:
    """All objects seen from everywhere, each off by its own vector in all views, in the camera's axes."""
    truth = path()
    frame, of = np.repeat(np.arange(VIEWS), 3), np.tile(np.arange(3), VIEWS)
    off = SHARED * rng.standard_normal((3, 3))
    place = transform(inverse(truth[frame]), OBJECTS[of]) + off[of] + OWN * rng.standard_normal((3 * VIEWS, 3))
    covariance = np.diag(OWN**2 + SHARED**2)
    table = Detections.from_arrays(
        frame, place, position_covariance=covariance, position_shared=np.diag(SHARED**2) if shared else None
    )
    problem = SlamProblem(truth, table, np.tile(np.diag(np.repeat([1e-4, 2e-3], 3) ** 2), (VIEWS - 1, 1, 1)))
    return solve_with_associations(problem, of, SlamConfig(correct_scales=False))


def test_roots_are_upper_triangular() -> None:
    rng = np.random.default_rng(0)
    full = rng.standard_normal((20, 3, 3))
    flat = np.diag([0.3, 0.2, 0.0])[None] ** 2
    matrices = np.concatenate([full @ np.swapaxes(full, 1, 2), flat, np.zeros((1, 3, 3))])
    root = upper_root(matrices)
    np.testing.assert_allclose(root @ np.swapaxes(root, 1, 2), matrices, atol=1e-10)
    assert np.abs(np.tril(root, -1)).max() == 0 and (np.diagonal(root, axis1=1, axis2=2) >= 0).all()


def test_covariance_is_the_sandwich() -> None:
    """All blocks against dense algebra: A^-1 J' E J A^-1 with E filled in view by view."""
    state = solved(np.random.default_rng(1))
    found = linearise_answer(state)
    _, factors = measured_graph(state)
    rows = found.jacobian.shape[0]
    E, begin = np.eye(rows), 6 * VIEWS
    white = [np.linalg.inv(np.linalg.cholesky(C)) for C in factors.covariance]
    turned = [T[:3, :3].T @ np.diag(SHARED) for T in factors.T_camera_landmark]
    for a in range(len(white)):
        for b in range(len(white)):
            if a != b and factors.landmark[a] == factors.landmark[b]:
                block = white[a][:, 3:] @ turned[a] @ turned[b].T @ white[b][:, 3:].T
                E[begin + 6 * a : begin + 6 * a + 6, begin + 6 * b : begin + 6 * b + 6] = block
    J = found.jacobian.toarray()
    A = np.linalg.inv(J.T @ J)
    expected = A @ J.T @ E @ J @ A
    blocks = np.array([0, 2, 3 + 4])  # two landmarks and a pose
    at = (6 * blocks[:, None] + np.arange(6)).ravel()
    joint = found.joint_covariance(blocks).reshape(18, 18)
    np.testing.assert_allclose(joint, expected[np.ix_(at, at)], atol=1e-9)
    own = found.covariance(blocks)
    for k in range(3):
        np.testing.assert_allclose(own[k], joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6], atol=1e-12)
    draws = found.samples(4000, np.random.default_rng(2))[1][0, 3:]
    expected_own = own[0][3:, 3:]
    spread = np.sqrt((np.outer(np.diag(expected_own), np.diag(expected_own)) + expected_own**2) / 4000)
    assert (np.abs(draws @ draws.T / 4000 - expected_own) < 5 * spread).all()


def test_stated_regions_hold_the_objects() -> None:
    """40 worlds: the normalised squared error is that of three degrees of freedom; without the shared part it is far above."""
    rng = np.random.default_rng(4)
    honest, naive = [], []
    for _ in range(40):
        state = solved(rng)
        gap = state.estimate.T_world_landmark[:, :3, 3] - OBJECTS
        R = state.estimate.T_world_landmark[:, :3, :3]
        answer = linearise_answer(state)
        for found, out in ((answer, honest), (answer.with_errors(None), naive)):
            C = R @ found.covariance(np.arange(3))[:, 3:, 3:] @ np.swapaxes(R, 1, 2)
            out.append(np.einsum("mi,mij,mj->m", gap, np.linalg.inv(C), gap))
    error = 5 * np.sqrt(2 / 3 / 120) * 1.5  # objects of a world share its poses
    assert abs(np.mean(honest) / 3 - 1) < error
    assert np.mean(naive) / 3 > 2


def test_without_shared_errors_nothing_changes() -> None:
    state = solved(np.random.default_rng(5), shared=False)
    _, factors = measured_graph(state)
    assert error_root(state, factors, 10) is None and linearise_answer(state).error_root is None


def test_shared_part_is_read_and_written(tmp_path: Path) -> None:
    table = Detections.from_arrays(
        [0, 0], [[0, 0, 5.0], [1, 0, 6]], position_covariance=0.04 * np.eye(3), position_shared=np.diag([0.01, 0.02, 0.0])
    )
    table.position_shared[1] = np.nan
    write_observations(tmp_path / "seen.jsonl", table)
    again = read_observations(tmp_path / "seen.jsonl")
    np.testing.assert_array_equal(again.position_shared, table.position_shared)
    check_table(again, 1)
    for shared in (np.diag([0.05, 0.0, 0.0]), np.diag([-0.01, 0.0, 0.0]), np.eye(3, k=1) * 0.01):
        bad = np.array(table.position_shared)
        bad[0] = shared
        with pytest.raises(InputError, match="shared position covariance"):
            check_table(replace(table, position_shared=bad), 1)
        text = (tmp_path / "seen.jsonl").read_text().splitlines()
        text[0] = text[0].replace(str(table.position_shared[0].tolist()), str(shared.tolist()))
        (tmp_path / "bad.jsonl").write_text("\n".join(text))
        with pytest.raises(InputError, match=r"bad.jsonl:1: `position_cov_shared`"):
            read_observations(tmp_path / "bad.jsonl")
