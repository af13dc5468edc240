"""Trajectories on disk: KITTI (12 numbers a row) and TUM (`time x y z qx qy qz qw`), poses `T_world_camera`; what belongs to
their rows: frames of a sequence, covariances of the steps."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import is_rotation, make_pose, matrix_to_quaternion, nearest_rotation, quaternion_to_matrix
from nolbo_ppl.io.files import atomic_path, read_text
from nolbo_ppl.io.npz import read_npz

TrajectoryFormat = Literal["kitti", "tum"]
Covariances = Float[np.ndarray, "n-1 6 6"]
COVARIANCE = "odometry_covariance.npz"
"""File of the covariances of an odometry's steps, beside it."""
TIME_TOLERANCE = 0.02
"""How far, in s, the times of a frame and its pose may lie apart."""


@dataclass(frozen=True)
class Trajectory:
    """Poses of a camera, row by row."""

    T_world_camera: Float[np.ndarray, "n 4 4"]
    """Body-to-world poses; camera x right, y down, z forward."""
    times: Float[np.ndarray, " n"] | None = None
    """Time stamps in seconds (TUM only)."""
    format: TrajectoryFormat = "kitti"
    """The format it was read in, used again to write."""

    def __len__(self) -> int:
        return len(self.T_world_camera)


def _numbers(path: Path) -> list[tuple[int, list[float]]]:
    """Line numbers and values of a table of numbers; comments and blank lines are skipped."""
    rows = []
    lines = read_text(path).splitlines()
    for number, text in enumerate(lines, start=1):
        text = text.split("#", 1)[0].replace(",", " ").strip()
        if not text:
            continue
        try:
            values = [float(word) for word in text.split()]
        except ValueError:
            raise input_error("not a row of numbers", got=repr(text[:80]), file=path, line=number) from None
        if not np.isfinite(values).all():
            raise input_error("a value is not finite", got=repr(text[:80]), file=path, line=number)
        rows.append((number, values))
    if not rows:
        raise input_error("the trajectory is empty", file=path)
    return rows


def read_trajectory(path: str | PathLike[str]) -> Trajectory:
    """Read a KITTI or TUM trajectory, told apart by the length of its rows.

    Rotations that are orthonormal to three digits are made exactly so; quaternions may be off unit length by 1 %.

    Raises:
        InputError: missing, empty, a malformed or truncated row, NaN, no rotation, a non-unit quaternion, times that do
            not increase; names file and line.
    """
    path = Path(path)
    rows = _numbers(path)
    width = len(rows[0][1])
    if width not in (8, 12):
        raise input_error(
            "unknown trajectory format",
            got=f"{width} numbers a row",
            expected="12 (KITTI) or 8 (TUM)",
            file=path,
            line=rows[0][0],
        )
    for number, values in rows:
        if len(values) != width:
            raise input_error(
                "row of another length",
                got=f"{len(values)} numbers",
                expected=width,
                do="is the file truncated?",
                file=path,
                line=number,
            )
    table = np.array([values for _, values in rows])
    lines = [number for number, _ in rows]
    if width == 12:
        matrices = table.reshape(-1, 3, 4)
        good = is_rotation(matrices[:, :, :3], tolerance=1e-2)
        if not good.all():
            raise input_error(
                "the left 3x3 block is no rotation",
                expected="orthonormal, determinant +1",
                file=path,
                line=lines[int(np.argmin(good))],
            )
        return Trajectory(make_pose(nearest_rotation(matrices[:, :, :3]), matrices[:, :, 3]))
    norms = np.linalg.norm(table[:, 4:], axis=1)
    if (np.abs(norms - 1) > 1e-2).any():
        row = int(np.argmax(np.abs(norms - 1)))
        raise input_error("quaternion of another length than 1", got=f"{norms[row]:.4g}", file=path, line=lines[row])
    backwards = np.diff(table[:, 0]) <= 0
    if backwards.any():
        row = int(np.argmax(backwards)) + 1
        raise input_error("time does not increase", got=f"{table[row, 0]!r}", file=path, line=lines[row])
    return Trajectory(make_pose(quaternion_to_matrix(table[:, 4:]), table[:, 1:4]), times=table[:, 0], format="tum")


def write_trajectory(path: str | PathLike[str], trajectory: Trajectory) -> None:
    """Write a trajectory in its format, atomically; 12 significant digits."""
    T = trajectory.T_world_camera
    if trajectory.format == "kitti":
        table = T[:, :3, :].reshape(-1, 12)
        text = "\n".join(" ".join(f"{v:.12g}" for v in row) for row in table)
    else:
        times = np.arange(len(T), dtype=float) if trajectory.times is None else trajectory.times
        table = np.concatenate([T[:, :3, 3], matrix_to_quaternion(T[:, :3, :3])], axis=1)
        text = "\n".join(f"{t!r} " + " ".join(f"{v:.12g}" for v in row) for t, row in zip(times.tolist(), table))
    with atomic_path(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def match_times(
    reference: Float[np.ndarray, " n"], other: Float[np.ndarray, " m"], tolerance: float = TIME_TOLERANCE
) -> tuple[np.ndarray, np.ndarray]:
    """Indices of rows of both whose times agree within `tolerance` seconds, each row used once at most."""
    nearest = np.clip(np.searchsorted(other, reference), 1, max(len(other) - 1, 1))
    nearest -= (reference - other[nearest - 1]) <= np.abs(other[np.minimum(nearest, len(other) - 1)] - reference)
    nearest = np.clip(nearest, 0, len(other) - 1)
    gap = np.abs(other[nearest] - reference)
    order = np.argsort(gap, kind="stable")
    used: set[int] = set()
    keep = []
    for i in order:
        if gap[i] <= tolerance and int(nearest[i]) not in used:
            used.add(int(nearest[i]))
            keep.append(int(i))
    rows = np.array(sorted(keep), dtype=int)
    return rows, nearest[rows]


def poses_of_frames(
    path: str | PathLike[str],
    frames: int,
    times: Float[np.ndarray, " f"] | None = None,
    part: slice = slice(None),
    *,
    what: str = "truth",
    of: str = "the frames",
) -> Float[np.ndarray, "n 4 4"]:
    """Poses of a sequence's frames, or of a part of them: rows in the order of the frames, or TUM rows matched by time.

    Args:
        path: the trajectory: a row for each frame of the sequence, one for each of the part, or rows with times.
        frames: number of frames of the sequence.
        times: their times, s, where all are known.
        part: the frames wanted.
        what: what the trajectory is, for the messages.
        of: what the frames are, for the messages.

    Raises:
        InputError: the trajectory is malformed, or matches neither in number nor by time; names the file.
    """
    found, count = read_trajectory(path), len(range(frames)[part])
    if len(found) == frames:
        return found.T_world_camera[part]
    if len(found) == count:
        return found.T_world_camera
    if found.times is None or times is None:
        raise input_error(
            f"{what} does not match {of} row by row", got=f"{len(found)} rows", expected=f"{frames} rows", file=path
        )
    rows, partner = match_times(times[part], found.times)
    if len(rows) < count:
        raise input_error(
            f"{what} lacks times of {of}",
            got=f"{len(rows)} of {count} matched within {1000 * TIME_TOLERANCE:.0f} ms",
            expected="a pose for each",
            file=path,
        )
    return found.T_world_camera[partner]


def read_covariance(path: str | PathLike[str]) -> Covariances:
    """Covariances of an odometry's steps, [rotation rad, translation m] at the later camera: `covariance` of an NPZ file.

    Raises:
        InputError: no such file, or it holds no such array; names the file.
    """
    covariance = read_npz(path, {"covariance": (None, 6, 6)})["covariance"]
    return covariance.astype(np.float64)


def covariance_beside(trajectory: str | PathLike[str]) -> Covariances | None:
    """Covariances of the steps of an odometry from `odometry_covariance.npz` beside it; None where there is none.

    Raises:
        InputError: a file that cannot be read; names it.
    """
    path = Path(trajectory).parent / COVARIANCE
    return read_covariance(path) if path.is_file() else None
