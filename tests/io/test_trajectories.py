"""Trajectory files: round trips and every kind of damage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import se3_exp
from nolbo_ppl.io.trajectories import (
    Trajectory,
    covariance_beside,
    match_times,
    poses_of_frames,
    read_covariance,
    read_trajectory,
    write_trajectory,
)


def poses(n: int) -> np.ndarray:
    return se3_exp(np.random.default_rng(0).standard_normal((n, 6)))


def test_kitti_round_trip(tmp_path: Path) -> None:
    write_trajectory(tmp_path / "t.txt", Trajectory(poses(7)))
    back = read_trajectory(tmp_path / "t.txt")
    assert back.format == "kitti" and back.times is None and len(back) == 7
    np.testing.assert_allclose(back.T_world_camera, poses(7), atol=1e-10)


def test_tum_round_trip(tmp_path: Path) -> None:
    times = 1.3e9 + np.arange(7) * 0.1
    write_trajectory(tmp_path / "t.txt", Trajectory(poses(7), times, "tum"))
    back = read_trajectory(tmp_path / "t.txt")
    assert back.format == "tum" and back.times is not None
    np.testing.assert_array_equal(back.times, times)
    np.testing.assert_allclose(back.T_world_camera, poses(7), atol=1e-10)


def test_comments_and_blank_lines_are_skipped(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text("# time x y z qx qy qz qw\n\n1 0 0 0 0 0 0 1\n2 0 0 1 0 0 0 1 # end\n")
    assert len(read_trajectory(tmp_path / "t.txt")) == 2


IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0"


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "empty"),
        (f"{IDENTITY}\n1 0 0 0 0 1\n", r":2: row of another length.*truncated"),
        (f"{IDENTITY}\n1 0 0 0 0 1 0 0 0 0 1 x\n", r":2: not a row of numbers"),
        (f"{IDENTITY}\n1 0 0 nan 0 1 0 0 0 0 1 0\n", r":2: a value is not finite"),
        ("2 0 0 0 0 1 0 0 0 0 1 0\n", r":1: the left 3x3 block is no rotation"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n", "no rotation"),
        ("1 2 3\n", "unknown trajectory format"),
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 2\n", r":2: quaternion of another length"),
        ("2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", r":2: time does not increase"),
    ],
)
def test_damage_is_named(tmp_path: Path, text: str, match: str) -> None:
    (tmp_path / "t.txt").write_text(text)
    with pytest.raises(InputError, match=match):
        read_trajectory(tmp_path / "t.txt")


def test_missing_and_binary_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_trajectory(tmp_path / "none.txt")
    (tmp_path / "b.txt").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(InputError, match="not a text file"):
        read_trajectory(tmp_path / "b.txt")


def test_times_match_one_to_one() -> None:
    rows, partner = match_times(np.array([0.0, 1.0, 2.0, 3.0]), np.array([0.01, 0.99, 1.005, 2.5]))
    assert rows.tolist() == [0, 1] and partner.tolist() == [0, 2]


def test_poses_by_row_or_by_time(tmp_path: Path) -> None:
    T, times = poses(12), 50.0 + 0.05 * np.arange(12)
    write_trajectory(tmp_path / "rows.txt", Trajectory(T[:6]))
    np.testing.assert_allclose(poses_of_frames(tmp_path / "rows.txt", 6), T[:6], atol=1e-9)
    write_trajectory(tmp_path / "timed.txt", Trajectory(T, times, "tum"))
    found = poses_of_frames(tmp_path / "timed.txt", 4, times[[1, 4, 5, 9]] + 0.003)
    np.testing.assert_allclose(found, T[[1, 4, 5, 9]], atol=1e-9)


def test_poses_of_a_part_of_the_frames(tmp_path: Path) -> None:
    """From rows of all frames, rows of the part, or by time, where only times of the part need a pose."""
    T, times, part = poses(12), 50.0 + 0.05 * np.arange(12), slice(3, 8)
    for name, trajectory in {
        "all": Trajectory(T),
        "part": Trajectory(T[part]),
        "timed": Trajectory(T[2:], times[2:], "tum"),
    }.items():
        write_trajectory(tmp_path / name, trajectory)
        np.testing.assert_allclose(poses_of_frames(tmp_path / name, 12, times, part), T[part], atol=1e-9)
    with pytest.raises(InputError, match="got 10 of 12 matched"):
        poses_of_frames(tmp_path / "timed", 12, times)


def test_poses_that_fit_neither_way_name_the_file(tmp_path: Path) -> None:
    times = np.array([0.0, 1.0, 2.0])
    write_trajectory(tmp_path / "t.txt", Trajectory(poses(3), times, "tum"))
    write_trajectory(tmp_path / "rows.txt", Trajectory(poses(3)))
    lacks = r"t\.txt: odometry lacks times of the images: got 1 of 2 matched within 20 ms, expected a pose for each"
    with pytest.raises(InputError, match=lacks):
        poses_of_frames(tmp_path / "t.txt", 2, np.array([1.01, 1.5]), what="odometry", of="the images")
    neither = r"truth does not match the frames row by row: got 3 rows, expected 2 rows"
    for name, known in (("t.txt", None), ("rows.txt", times[:2])):
        with pytest.raises(InputError, match=neither):
            poses_of_frames(tmp_path / name, 2, known)


def test_covariances_and_every_kind_of_damage(tmp_path: Path) -> None:
    good = np.tile(np.eye(6), (3, 1, 1))
    assert covariance_beside(tmp_path / "odometry.txt") is None
    path = tmp_path / "odometry_covariance.npz"
    np.savez(path, covariance=good)
    np.testing.assert_array_equal(read_covariance(path), good)
    np.testing.assert_array_equal(covariance_beside(tmp_path / "odometry.txt"), good)
    for content, match in (
        ({"sigma": good}, r"no array `covariance`: got \['sigma'\]"),
        ({"covariance": good[0]}, r"`covariance`: got shape \[6, 6\], expected \[any, 6, 6\]"),
    ):
        np.savez(path, **content)
        with pytest.raises(InputError, match=r"odometry_covariance\.npz: .*" + match):
            covariance_beside(tmp_path / "odometry.txt")
    path.write_text("no archive")
    with pytest.raises(InputError, match="cannot be read"):
        read_covariance(path)
    with pytest.raises(InputError, match=r"none\.npz: no such file"):
        read_covariance(tmp_path / "none.npz")
