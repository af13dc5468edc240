"""Trajectory files: round trips and every kind of damage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import matrix_to_quaternion, se3_exp
from nolbo_ppl.io.trajectories import (
    Trajectory,
    covariance_beside,
    interpolate_poses,
    match_times,
    poses_of_frames,
    read_covariance,
    read_frame_poses,
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


def euroc(T: np.ndarray, times: np.ndarray, header: bool, separator: str = ",") -> str:
    """Rows as EuRoC and TUM-VI ship them: ns, position, q_w first."""
    q = matrix_to_quaternion(T[:, :3, :3])[:, [3, 0, 1, 2]]
    first = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []\n" if header else ""
    rows = [[f"{t * 1e9:.0f}", *(f"{v:.9f}" for v in (*p, *r))] for t, p, r in zip(times, T[:, :3, 3], q)]
    return first + "".join(separator.join(row) + "\n" for row in rows)


@pytest.mark.parametrize("header", [True, False])
def test_euroc_has_w_first_and_nanoseconds(tmp_path: Path, header: bool) -> None:
    times = 1.4e9 + np.arange(7) * 0.05
    (tmp_path / "mocap.csv").write_text(euroc(poses(7), times, header))
    found = read_trajectory(tmp_path / "mocap.csv")
    np.testing.assert_allclose(found.T_world_camera, poses(7), atol=1e-7)
    np.testing.assert_allclose(found.times, times, atol=1e-6)  # type: ignore[arg-type]


def test_orb_slam_writes_nanoseconds_with_blanks_and_w_last(tmp_path: Path) -> None:
    times = 1.4e9 + np.arange(7) * 0.05
    table = np.concatenate([poses(7)[:, :3, 3], matrix_to_quaternion(poses(7)[:, :3, :3])], axis=1)
    rows = [f"{t * 1e9:.6f} " + " ".join(f"{v:.9f}" for v in row) for t, row in zip(times, table)]
    (tmp_path / "t.txt").write_text("\n".join(rows))
    np.testing.assert_allclose(read_trajectory(tmp_path / "t.txt").T_world_camera, poses(7), atol=1e-7)
    np.testing.assert_allclose(
        read_trajectory(tmp_path / "t.txt", "euroc").T_world_camera[:, :3, 3], poses(7)[:, :3, 3], atol=1e-7
    )
    assert np.abs(read_trajectory(tmp_path / "t.txt", "euroc").T_world_camera - poses(7)).max() > 0.1  # forced, and wrong


@pytest.mark.parametrize(
    "header",
    [
        "time,x,y,z,qw,qx,qy,qz",
        "# timestamp(s) tx ty tz q_w q_x q_y q_z",
        "stamp; position.x; position.y; position.z; orientation.w; orientation.x; orientation.y; orientation.z",
    ],
)
def test_the_header_tells_the_order_of_the_quaternion(tmp_path: Path, header: str) -> None:
    separator = ";" if ";" in header else "," if "," in header else " "
    text = euroc(poses(5), np.arange(5) * 1e-9, False, separator)
    (tmp_path / "t.csv").write_text(header + "\n" + text)
    np.testing.assert_allclose(read_trajectory(tmp_path / "t.csv").T_world_camera, poses(5), atol=1e-7)


def test_more_columns_than_a_pose(tmp_path: Path) -> None:
    """EuRoC's state estimate goes on with velocity and biases, which end in x, y, z as well."""
    header = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    header += ", ".join(f"{n}_{a} [u]" for n in ("v_RS_R", "b_w_RS_S", "b_a_RS_S") for a in "xyz") + "\n"
    rows = [line + ",7" * 9 for line in euroc(poses(3), 1.4e9 + np.arange(3), False).splitlines()]
    for first in (header, ""):
        (tmp_path / "data.csv").write_text(first + "\n".join(rows))
        np.testing.assert_allclose(read_trajectory(tmp_path / "data.csv").T_world_camera, poses(3), atol=1e-7)


def four(T: np.ndarray, separator: str = " ") -> str:
    return separator.join(f"{v:.12g}" for v in T.ravel())


def test_matrices_of_four_rows(tmp_path: Path) -> None:
    """A row, four rows, a folder of files, and rows that begin with the number of the frame."""
    T = poses(4)
    np.savetxt(tmp_path / "rows.txt", T.reshape(4, 16))
    np.savetxt(tmp_path / "blocks.txt", T.reshape(16, 4))
    (tmp_path / "pose").mkdir()
    for k, pose in enumerate(poses(12)):
        np.savetxt(tmp_path / "pose" / f"{k}.txt", pose)
    for name in ("rows.txt", "blocks.txt"):
        np.testing.assert_allclose(read_trajectory(tmp_path / name).T_world_camera, T, atol=1e-9)
    np.testing.assert_allclose(read_trajectory(tmp_path / "pose").T_world_camera, poses(12), atol=1e-9)
    (tmp_path / "numbered.txt").write_text("".join(f"{k} {four(T[i, :3])}\n" for i, k in enumerate((1, 2, 5, 6))))
    found = read_frame_poses(tmp_path / "numbered.txt", 8)
    assert found.matched_by == "number" and found.known.tolist() == [False, True, True, False, False, True, True, False]
    np.testing.assert_allclose(found.T_world_camera[5], T[2], atol=1e-9)
    (tmp_path / "bad.txt").write_text(four(np.diag([1.0, 1, 1, 2])))
    with pytest.raises(InputError, match="unknown trajectory format: got 16 numbers a row"):
        read_trajectory(tmp_path / "bad.txt")


@pytest.mark.parametrize("width", [12, 16])
def test_lost_poses_are_unknown_in_a_truth_alone(tmp_path: Path, width: int) -> None:
    rows = poses(6).reshape(6, 16)[:, :width].copy()
    rows[2], rows[4] = -np.inf, np.nan
    np.savetxt(tmp_path / "t.txt", rows)
    found = read_frame_poses(tmp_path / "t.txt", 6)
    assert found.lost == 2 and found.known.tolist() == [True, True, False, True, False, True]
    assert found.remarks()[0] == "truth: 4 of 6 frames have a pose; figures are over these"
    for reader in (lambda p: read_trajectory(p), lambda p: poses_of_frames(p, 6)):
        with pytest.raises(InputError, match=r"t\.txt:3: a value is not finite"):
            reader(tmp_path / "t.txt")
    rows[4, 0] = 1.0
    np.savetxt(tmp_path / "t.txt", rows)
    with pytest.raises(InputError, match=r"t\.txt:5: a value is not finite: .* expected numbers, or nothing but nan"):
        read_frame_poses(tmp_path / "t.txt", 6)


def test_repeated_stamps_of_a_truth_are_counted(tmp_path: Path) -> None:
    times = np.array([0.0, 0.1, 0.1, 0.2, 0.3])
    write_trajectory(tmp_path / "t.txt", Trajectory(poses(5), times, "tum"))
    found = read_frame_poses(tmp_path / "t.txt", 3, np.array([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(found.T_world_camera, poses(5)[[1, 3, 4]], atol=1e-9)  # the first of the two
    assert found.repeated_stamps == 1 and "1 rows repeat a time" in found.remarks()[0]
    with pytest.raises(InputError, match=r"t\.txt:3: time does not increase: got 0\.1$"):
        read_trajectory(tmp_path / "t.txt")
    write_trajectory(tmp_path / "t.txt", Trajectory(poses(5), times[::-1], "tum"))
    with pytest.raises(InputError, match=r"t\.txt:2: time does not increase: got 0\.2$"):
        read_frame_poses(tmp_path / "t.txt", 5, times)


def test_times_decide_where_both_sides_have_them(tmp_path: Path) -> None:
    """As many rows as frames, recorded 0.3 s earlier: no row belongs to the frame of its number."""
    T, times = poses(10), 100.0 + 0.1 * np.arange(10)
    write_trajectory(tmp_path / "t.txt", Trajectory(T, times - 0.3, "tum"))
    found = read_frame_poses(tmp_path / "t.txt", 10, times)
    assert found.matched_by == "time" and found.known.sum() == 7
    np.testing.assert_allclose(found.T_world_camera[:7], T[3:], atol=1e-9)
    with pytest.raises(InputError, match=r"truth has no time of the frames: got 99\.700 s to 100\.600 s, expected times within"):
        read_frame_poses(tmp_path / "t.txt", 10, times + 50)


def test_interpolation_follows_the_motion(tmp_path: Path) -> None:
    """A constant twist is met exactly between its samples, and nothing is made up across a gap or beyond the ends."""
    twist = np.array([0.2, -0.1, 0.3, 1.0, 0.5, -0.2])
    times = np.array([0.0, 0.4, 0.8, 3.0, 3.4])
    T = se3_exp(times[:, None] * twist)
    at = np.array([-0.1, 0.0, 0.3, 0.79, 1.5, 3.2, 3.4, 3.5])
    found = interpolate_poses(times, T, at)
    known = np.array([False, True, True, True, False, True, True, False])
    np.testing.assert_array_equal(np.isfinite(found).all(axis=(1, 2)), known)
    np.testing.assert_allclose(found[known], se3_exp(at[known, None] * twist), atol=1e-12)
    write_trajectory(tmp_path / "t.txt", Trajectory(T, times, "tum"))
    assert read_frame_poses(tmp_path / "t.txt", 8, at, interpolate=True).known.tolist() == known.tolist()


def test_a_byte_order_mark_is_nothing(tmp_path: Path) -> None:
    for text in (f"{IDENTITY}\r\n", "# timestamp tx ty tz qx qy qz qw\n1 0 0 0 0 0 0 1\n"):
        (tmp_path / "t.txt").write_bytes(b"\xef\xbb\xbf" + text.encode())
        np.testing.assert_array_equal(read_trajectory(tmp_path / "t.txt").T_world_camera[0], np.eye(4))


def test_utf_16_is_named(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text(f"{IDENTITY}\n", encoding="utf-16")
    with pytest.raises(InputError, match=r"t\.txt:1: not a text file: got UTF-16, expected UTF-8; save it as UTF-8"):
        read_trajectory(tmp_path / "t.txt")


def test_decimal_commas_are_named(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text("0,5 0 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match=r"t\.txt:1: decimal commas: got .*, expected decimal points"):
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
    with pytest.raises(InputError, match="not a readable NPZ file"):
        read_covariance(path)
    with pytest.raises(InputError, match=r"none\.npz: no such file"):
        read_covariance(tmp_path / "none.npz")
