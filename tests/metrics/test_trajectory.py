"""Trajectory errors against brute force, known alignments, published figures and evo as a separate tool."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import chain, make_pose, rotation_angle, se3_exp, so3_exp
from nolbo_ppl.io.trajectories import Trajectory, read_trajectory, write_trajectory
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error, align, path_length, relative_pose_error, umeyama


def walk(n: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return chain(np.eye(4), se3_exp(0.3 * rng.standard_normal((n - 1, 6)) + np.array([0, 0, 0, 0, 0, 1.0])))


def test_unknown_rows_of_the_truth_are_left_out() -> None:
    """The figures are those of the other rows alone."""
    rng = np.random.default_rng(3)
    truth = se3_exp(rng.standard_normal((9, 6)))
    estimate = truth @ se3_exp(0.05 * rng.standard_normal((9, 6)))
    gaps, known = truth.copy(), np.array([0, 1, 4, 5, 6, 8])
    gaps[[2, 3, 7]] = np.nan
    found, alone = absolute_trajectory_error(estimate, gaps), absolute_trajectory_error(estimate[known], truth[known])
    np.testing.assert_allclose(found.errors, alone.errors, atol=1e-12)
    steps = relative_pose_error(estimate, gaps)
    pairs = [relative_pose_error(estimate[k : k + 2], truth[k : k + 2]).rmse for k in (0, 4, 5)]
    np.testing.assert_allclose(steps.errors, pairs, atol=1e-12)
    assert path_length(gaps) == pytest.approx(path_length(truth[known]))
    half = truth.copy()
    half[2, 0, 3] = np.nan
    with pytest.raises(InputError, match="truth holds values that are not finite"):
        absolute_trajectory_error(estimate, half)
    with pytest.raises(InputError, match="no row with both"):
        absolute_trajectory_error(estimate, np.full_like(truth, np.nan))


def test_a_straight_road_is_aligned_by_what_the_cameras_see() -> None:
    """Positions on a line leave the turn about it open: `pose` finds it, and leaves positions as well aligned as `se3`."""
    rng = np.random.default_rng(0)
    truth = np.tile(np.eye(4), (40, 1, 1))
    truth[:, 2, 3] = np.arange(40) * 2.0
    moved = se3_exp(np.array([0.3, -0.2, 1.4, 5.0, 1.0, -2.0])) @ truth
    moved[:, :3, 3] += 0.01 * rng.standard_normal((40, 3))
    aligned = align(moved, truth, "pose")
    assert np.degrees(rotation_angle(np.swapaxes(truth, 1, 2)[:, :3, :3] @ aligned[:, :3, :3])).max() < 0.1
    errors = [np.linalg.norm((align(moved, truth, kind) - truth)[:, :3, 3], axis=1) for kind in ("pose", "se3")]
    assert np.sqrt(np.mean(errors[0] ** 2)) < 1.05 * np.sqrt(np.mean(errors[1] ** 2))


def test_umeyama_recovers_a_similarity() -> None:
    rng = np.random.default_rng(0)
    source = rng.standard_normal((50, 3))
    R, t, scale = so3_exp(np.array([0.3, -1.2, 2.0])), np.array([1.0, -2.0, 3.0]), 1.7
    R_found, t_found, scale_found = umeyama(source, scale * source @ R.T + t, with_scale=True)
    np.testing.assert_allclose(R_found, R, atol=1e-12)
    np.testing.assert_allclose(t_found, t, atol=1e-12)
    assert scale_found == pytest.approx(scale)


def test_umeyama_never_reflects() -> None:
    rng = np.random.default_rng(1)
    source = rng.standard_normal((20, 3))
    R, _, _ = umeyama(source, source * np.array([1.0, 1.0, -1.0]))
    assert np.linalg.det(R) == pytest.approx(1.0)


def test_alignment_is_the_minimum_over_rigid_motions() -> None:
    estimate, truth = walk(30, 2), walk(30, 3)
    found = absolute_trajectory_error(estimate, truth).rmse

    def rmse(xi: np.ndarray) -> float:
        return absolute_trajectory_error(se3_exp(xi) @ estimate, truth, "none").rmse

    best = min(minimize(rmse, start, method="BFGS").fun for start in 3 * np.random.default_rng(4).standard_normal((8, 6)))
    assert found == pytest.approx(best, abs=1e-6)


def test_origin_alignment_starts_at_the_truth() -> None:
    estimate, truth = walk(10, 5), walk(10, 6)
    np.testing.assert_allclose(align(estimate, truth, "origin")[0], truth[0], atol=1e-12)


def test_errors_are_invariant_to_a_rigid_motion() -> None:
    estimate, truth = walk(40, 7), walk(40, 8)
    moved = se3_exp(np.array([0.5, 0.2, -2.0, 10.0, -3.0, 4.0])) @ estimate
    assert absolute_trajectory_error(moved, truth).rmse == pytest.approx(absolute_trajectory_error(estimate, truth).rmse)
    assert relative_pose_error(moved, truth).rmse == pytest.approx(relative_pose_error(estimate, truth).rmse)


def test_relative_error_of_a_known_fault() -> None:
    truth = make_pose(np.tile(np.eye(3), (5, 1, 1)), np.arange(5)[:, None] * np.array([1.0, 0.0, 0.0]))
    estimate = truth.copy()
    estimate[3:, 0, 3] += 0.5
    error = relative_pose_error(estimate, truth)
    np.testing.assert_allclose(error.errors, [0.0, 0.0, 0.5, 0.0], atol=1e-12)
    assert error.rmse == pytest.approx(0.25)
    assert path_length(truth) == pytest.approx(4.0)


@pytest.mark.parametrize(("rows", "match"), [(3, "row by row"), (0, "row by row")])
def test_mismatched_lengths_raise(rows: int, match: str) -> None:
    with pytest.raises(InputError, match=match):
        absolute_trajectory_error(walk(4, 0)[:rows], walk(4, 1)[: 4 if rows else 0])


def test_bad_values_raise() -> None:
    bad = walk(4, 0)
    bad[1, 0, 3] = np.nan
    with pytest.raises(InputError, match="not finite"):
        absolute_trajectory_error(bad, walk(4, 1))
    with pytest.raises(InputError, match="unknown alignment"):
        absolute_trajectory_error(walk(4, 0), walk(4, 1), "affine")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="no pair"):
        relative_pose_error(walk(4, 0), walk(4, 1), delta=4)


@pytest.mark.parametrize(("name", "unaligned", "aligned"), [("ORB", 7.790289, 1.303450), ("SPTAM", 9.224542, 3.738488)])
def test_published_figures(data_dir: Path, name: str, unaligned: float, aligned: float) -> None:
    folder = data_dir / "kitti_odometry" / "estimates"
    truth = read_trajectory(folder / "KITTI_00_gt.txt").T_world_camera
    estimate = read_trajectory(folder / f"KITTI_00_{name}.txt").T_world_camera
    assert absolute_trajectory_error(estimate, truth, "none").rmse == pytest.approx(unaligned, abs=1e-6)
    assert absolute_trajectory_error(estimate, truth).rmse == pytest.approx(aligned, abs=1e-6)


def test_equal_to_evo(tmp_path: Path) -> None:
    tool = shutil.which("evo_ape")
    if tool is None:
        pytest.skip("evo_ape is not on the path: install evo in an environment of its own to compare with it")
    estimate, truth = walk(60, 0), walk(60, 10)
    write_trajectory(tmp_path / "estimate.txt", Trajectory(estimate))
    write_trajectory(tmp_path / "truth.txt", Trajectory(truth))

    def evo(program: str, *options: str) -> float:
        run = subprocess.run(
            [str(Path(tool).with_name(program)), "kitti", "truth.txt", "estimate.txt", *options],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=True,
            env={"HOME": str(tmp_path), "PATH": "/usr/bin:/bin"},
        )
        found = re.search(r"rmse\s+([0-9.]+)", run.stdout)
        assert found is not None, run.stdout
        return float(found[1])

    assert absolute_trajectory_error(estimate, truth, "none").rmse == pytest.approx(evo("evo_ape"), abs=1e-6)
    assert absolute_trajectory_error(estimate, truth).rmse == pytest.approx(evo("evo_ape", "-a"), abs=1e-6)
    assert absolute_trajectory_error(estimate, truth, "sim3").rmse == pytest.approx(evo("evo_ape", "-as"), abs=1e-6)
    assert relative_pose_error(estimate, truth).rmse == pytest.approx(evo("evo_rpe"), abs=1e-6)
    assert relative_pose_error(estimate, truth, delta=3).rmse == pytest.approx(evo("evo_rpe", "-d", "3"), abs=1e-6)
    rotation = relative_pose_error(estimate, truth, part="rotation").rmse
    assert rotation == pytest.approx(evo("evo_rpe", "-r", "angle_rad"), abs=1e-6)
