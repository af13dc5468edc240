"""KITTI raw drives: poses of the left colour camera from OXTS (GPS and inertial), calibrated to the rectified camera.

Files as they are distributed (Geiger et al. 2013, section III): `oxts/data/*.txt` or all its rows in one file, and
`calib_imu_to_velo.txt`, `calib_velo_to_cam.txt`, `calib_cam_to_cam.txt`.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import inverse, make_pose, so3_exp
from nolbo_ppl.io.files import read_text
from nolbo_ppl.io.images import natural

EARTH_RADIUS = 6378137.0
"""Radius of the Mercator projection, m."""
FIELDS = 30
"""Numbers of a row of OXTS."""
OXTS_ROTATION, OXTS_TRANSLATION = 5e-4, 0.01
"""Standard deviations of a step between two frames, rad and m: what the errors of successive rows share does not count."""


def read_calibration_rows(path: str | PathLike[str], wanted: dict[str, int]) -> dict[str, Float[np.ndarray, " k"]]:
    """Named rows of a calibration file, each with so many numbers. Raises `InputError` naming file and line."""
    found: dict[str, np.ndarray] = {}
    for number, text in enumerate(read_text(path).splitlines(), start=1):
        name, _, rest = text.partition(":")
        if name.strip() not in wanted:
            continue
        count = wanted[name.strip()]
        try:
            values = np.array([float(word) for word in rest.split()])
        except ValueError:
            values = np.empty(0)
        if len(values) != count or not np.isfinite(values).all():
            got = repr(rest.strip()[:60])
            raise input_error(f"row {name.strip()}", got=got, expected=f"{count} numbers", file=path, line=number)
        found[name.strip()] = values
    missing = sorted(set(wanted) - set(found))
    if missing:
        raise input_error("calibration without a row", got=", ".join(found) or "none", expected=missing[0], file=path)
    return found


def read_oxts(path: str | PathLike[str]) -> Float[np.ndarray, "n 30"]:
    """Rows of OXTS from one file, or from a folder with a file a frame. Raises `InputError` naming file and line."""
    source = Path(path)
    files = sorted(source.glob("*.txt"), key=natural) if source.is_dir() else [source]
    rows = []
    for file in files:
        for number, text in enumerate(read_text(file).splitlines(), start=1):
            if not text.strip():
                continue
            try:
                values = [float(word) for word in text.split()]
            except ValueError:
                values = []
            if len(values) != FIELDS or not np.isfinite(values).all():
                raise input_error("not a row of OXTS", got=repr(text[:60]), expected=f"{FIELDS} numbers", file=file, line=number)
            rows.append(values)
    if not rows:
        raise input_error("no row of OXTS", file=source)
    return np.array(rows)


def poses_of_oxts(rows: Float[np.ndarray, "n 30"]) -> Float[np.ndarray, "n 4 4"]:
    """T_world_imu (x forward, y left, z up); the world is east, north, up by the Mercator projection at the first latitude.

    Example:
        >>> rows = np.zeros((2, 30))
        >>> rows[1, 1] = 1e-5  # degrees east at the equator: 1.11 m
        >>> poses_of_oxts(rows)[1, :3, 3].round(2).tolist()
        [1.11, 0.0, 0.0]
    """
    rows = np.asarray(rows, dtype=np.float64)
    latitude, longitude = np.radians(rows[:, 0]), np.radians(rows[:, 1])
    scale = np.cos(latitude[0])
    east = scale * EARTH_RADIUS * longitude
    north = scale * EARTH_RADIUS * np.log(np.tan(np.pi / 4 + latitude / 2))
    turns = [so3_exp(rows[:, 3 + k : 4 + k] * np.eye(3)[k]) for k in range(3)]
    position = np.column_stack([east, north, rows[:, 2]])
    return make_pose(turns[2] @ turns[1] @ turns[0], position - position[0])


def imu_to_camera(folder: str | PathLike[str]) -> Float[np.ndarray, "4 4"]:
    """T_camera_imu of the rectified left colour camera from the calibration files of a day. Raises `InputError` naming them."""
    folder, rigid = Path(folder), {"R": 9, "T": 3}
    links = [read_calibration_rows(folder / name, rigid) for name in ("calib_velo_to_cam.txt", "calib_imu_to_velo.txt")]
    T_cam0_velo, T_velo_imu = (make_pose(link["R"].reshape(3, 3), link["T"]) for link in links)
    rectified = read_calibration_rows(folder / "calib_cam_to_cam.txt", {"R_rect_00": 9, "P_rect_02": 12})
    P = rectified["P_rect_02"].reshape(3, 4)
    shift = np.eye(4)
    shift[:3, 3] = np.linalg.solve(P[:, :3], P[:, 3])
    return shift @ make_pose(rectified["R_rect_00"].reshape(3, 3), np.zeros(3)) @ T_cam0_velo @ T_velo_imu


def camera_poses(oxts: str | PathLike[str], calibration: str | PathLike[str]) -> Float[np.ndarray, "n 4 4"]:
    """T_world_camera of the rectified left colour camera (x right, y down, z forward); the world is the first camera.

    Args:
        oxts: file of rows, or folder of files.
        calibration: folder with the three calibration files.

    Raises:
        InputError: a file is missing or malformed.
    """
    T_world_camera = poses_of_oxts(read_oxts(oxts)) @ inverse(imu_to_camera(calibration))
    return inverse(T_world_camera[0]) @ T_world_camera


def step_covariance(count: int) -> Float[np.ndarray, "n 6 6"]:
    """Covariance that is stated for each of so many steps of OXTS, [rotation rad, translation m]."""
    return np.tile(np.diag(np.repeat([OXTS_ROTATION**2, OXTS_TRANSLATION**2], 3)), (count, 1, 1))
