"""Trajectory files: round trips and every kind of damage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.data.trajectories import Trajectory, match_times, read_trajectory, write_trajectory
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import se3_exp


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
    with pytest.raises(InputError, match="no such trajectory"):
        read_trajectory(tmp_path / "none.txt")
    (tmp_path / "b.txt").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(InputError, match="not a text file"):
        read_trajectory(tmp_path / "b.txt")


def test_times_match_one_to_one() -> None:
    rows, partner = match_times(np.array([0.0, 1.0, 2.0, 3.0]), np.array([0.01, 0.99, 1.005, 2.5]))
    assert rows.tolist() == [0, 1] and partner.tolist() == [0, 2]
