"""Poses of KITTI raw drives from rows made by hand; damaged files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.data.converters.kitti_raw import camera_poses, imu_to_camera, poses_of_oxts, read_oxts
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import inverse, relative


def row(east: float, north: float, up: float, yaw: float) -> list[float]:
    """A row at metres from 49 degrees north, 8 east, on a sphere; yaw 0 faces east."""
    radius, latitude = 6378137.0, np.radians(49.0)
    values = np.zeros(30)
    values[:3] = 49.0 + np.degrees(north / radius), 8.0 + np.degrees(east / (radius * np.cos(latitude))), up
    values[5] = yaw
    return values.tolist()


def calibration(folder: Path) -> None:
    """Axes of KITTI's car: camera 0.3 m before and 0.7 m under the inertial unit, colour camera 6 cm aside."""
    axes = "0 -1 0 0 0 -1 1 0 0"
    (folder / "calib_imu_to_velo.txt").write_text("R: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.8\n")
    (folder / "calib_velo_to_cam.txt").write_text(f"calib_time: today\nR: {axes}\nT: 0 -0.1 -0.3\n")
    (folder / "calib_cam_to_cam.txt").write_text("R_rect_00: 1 0 0 0 1 0 0 0 1\nP_rect_02: 700 0 600 42 0 700 180 0 0 0 1 0\n")


def test_a_drive_to_the_east_and_a_turn(tmp_path: Path) -> None:
    calibration(tmp_path)
    rows = [row(0, 0, 100, 0.0), row(2, 0, 100, 0.0), row(2, 3, 100, np.pi / 2)]
    (tmp_path / "oxts.txt").write_text("".join(" ".join(map(repr, values)) + "\n" for values in rows))
    imu = poses_of_oxts(np.array(rows))
    np.testing.assert_allclose(imu[:, :3, 3], [[0, 0, 0], [2, 0, 0], [2, 3, 0]], atol=1e-5)
    poses = camera_poses(tmp_path / "oxts.txt", tmp_path)
    np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(poses[1][:3, 3], [0, 0, 2], atol=1e-4)  # forward
    np.testing.assert_allclose(poses[1][:3, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(poses[2][:3, 2], [-1, 0, 0], atol=1e-12)  # turned to the left
    T = imu_to_camera(tmp_path)
    np.testing.assert_allclose(T @ relative(imu[1], imu[2]) @ inverse(T), relative(poses[1], poses[2]), atol=1e-9)
    # The inertial unit's origin lies where the calibration's links put it: 0.06 m aside by 42 / 700.
    np.testing.assert_allclose(T[:3, 3], [-0.3 + 0.06, 0.8 - 0.1, -0.8 - 0.3], atol=1e-12)


def test_a_folder_of_rows_is_a_file_of_rows(tmp_path: Path) -> None:
    rows = np.array([row(k, 0, 0, 0) for k in range(3)])
    for k in range(3):
        (tmp_path / f"{k}.txt").write_text(" ".join(map(repr, rows[k].tolist())))
    np.testing.assert_array_equal(read_oxts(tmp_path), rows)


def test_damaged_files_are_named(tmp_path: Path) -> None:
    calibration(tmp_path)
    (tmp_path / "oxts.txt").write_text("1 2 3\n")
    with pytest.raises(InputError, match=r"oxts\.txt:1: not a row of OXTS"):
        read_oxts(tmp_path / "oxts.txt")
    (tmp_path / "calib_velo_to_cam.txt").write_text("R: 1 0 0\nT: 0 0 0\n")
    with pytest.raises(InputError, match=r"calib_velo_to_cam\.txt:1: row R"):
        imu_to_camera(tmp_path)
    (tmp_path / "calib_velo_to_cam.txt").write_text("T: 0 0 0\n")
    with pytest.raises(InputError, match="calibration without a row"):
        imu_to_camera(tmp_path)
