"""Trajectories on disk (KITTI, TUM, EuRoC, 4 x 4 matrices), poses `T_world_camera`; what belongs to their rows: frames of a
sequence, covariances of the steps."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import matrix_to_quaternion, relative, se3_exp, se3_log
from nolbo_ppl.io.files import atomic_path
from nolbo_ppl.io.images import natural
from nolbo_ppl.io.npz import read_npz
from nolbo_ppl.io.ros_bags import is_bag
from nolbo_ppl.io.text import read_lines
from nolbo_ppl.io.trajectory_documents import is_colmap, parse_colmap, parse_nuscenes
from nolbo_ppl.io.trajectory_tables import TableFormat, parse_table

TrajectoryFormat = Literal["kitti", "tum"]
"""What is written: TUM where there are times, KITTI where there are none."""
Covariances = Float[np.ndarray, "s 6 6"]
COVARIANCE = "odometry_covariance.npz"
"""File of the covariances of an odometry's steps, beside it."""
TIME_TOLERANCE = 0.02
"""How far, in s, the times of a frame and its pose may lie apart."""
LONGEST_GAP = 1.0
"""Longest time, in s, between two poses of a truth that is interpolated."""


@dataclass(frozen=True)
class Trajectory:
    """Poses of a camera, row by row."""

    T_world_camera: Float[np.ndarray, "n 4 4"]
    """Body-to-world poses; camera x right, y down, z forward. NaN where a truth was lost."""
    times: Float[np.ndarray, " n"] | None = None
    """Time stamps in seconds."""
    format: TrajectoryFormat = "kitti"
    """The format it is written in."""
    numbers: Float[np.ndarray, " n"] | None = None
    """Numbers of the frames, where the file gives them."""
    repeated_stamps: int = 0
    """Rows left out because they repeat the time of the row before."""

    def __len__(self) -> int:
        return len(self.T_world_camera)

    @property
    def known(self) -> Bool[np.ndarray, " n"]:
        """Rows that hold a pose."""
        known: np.ndarray = np.isfinite(self.T_world_camera).all(axis=(1, 2))
        return known


def read_trajectory(
    path: str | PathLike[str], form: TableFormat | None = None, *, lost: bool = False, repeated: bool = False
) -> Trajectory:
    """Read a trajectory: KITTI, TUM, EuRoC or TUM-VI, 4 x 4 matrices a row, in blocks, or in a folder of one file a frame.

    COLMAP's `images.txt` is read in natural order of the images' names, its unit of length as it is; `ego_pose.json` of nuScenes
    holds poses of the car's body, not of a camera: their fixed offset remains, as with EuRoC.

    Formats are told apart by the length of the rows, those with quaternions by the names of the header, or by commas and
    times in ns (see `nolbo_ppl.io.trajectory_tables`).

    Args:
        path: the file; the folder of one 4 x 4 matrix a file (ScanNet's `pose/`); or a bag of ROS, `BAG` or `BAG:/topic`
            (Odometry, PoseStamped, TransformStamped; extra `ros`).
        form: the format, where it is not to be told from the file.
        lost: rows of nothing but nan or inf are poses that are not known (NaN), as a truth may have.
        repeated: equal times in a row are harmless: the first is kept, the others are counted.

    Raises:
        InputError: missing, empty, a malformed or truncated row, NaN, no rotation, a non-unit quaternion, times that do
            not increase; names file and line.

    Example:
        >>> import tempfile, pathlib
        >>> file = pathlib.Path(tempfile.mkdtemp()) / "mocap.csv"
        >>> _ = file.write_text("1403636579763555584,1,2,3,0.6,0.8,0,0\\n")  # q_w first: commas and ns
        >>> read_trajectory(file).T_world_camera[0, 2].round(2).tolist()
        [0.0, 0.96, -0.28, 3.0]
        >>> import nolbo_ppl, pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "poses.txt"
        >>> _ = path.write_text("1 0 0 0 0 1 0 0 0 0 1 0\\n1 0 0 0 0 1 0 0 0 0 1 0.5\\n")  # KITTI: rows of 3 x 4 matrices
        >>> nolbo_ppl.read_trajectory(path).T_world_camera[1, :3, 3]
        array([0. , 0. , 0.5])
    """
    path = Path(path)
    if is_bag(path):
        return _poses_of_bag(path, lost)
    if path.is_dir():
        return _folder_of_poses(path, lost)
    if form == "nuscenes" or (form is None and path.suffix.lower() == ".json"):
        document = parse_nuscenes(path)
        return _in_time(path, document.T_world_camera, document.times, None, repeated)
    lines = read_lines(path)
    if form == "colmap" or (form is None and is_colmap(lines)):
        return Trajectory(parse_colmap(path, lines).T_world_camera)
    found = parse_table(path, lines, form, lost=lost)
    if found.times is None:
        return Trajectory(found.T_world_camera, numbers=found.numbers)
    return _in_time(path, found.T_world_camera, found.times, found.lines, repeated)


def _in_time(
    path: Path,
    T_world_camera: Float[np.ndarray, "n 4 4"],
    times: Float[np.ndarray, " n"] | None,
    lines: np.ndarray | None,
    repeated: bool,
) -> Trajectory:
    """A trajectory whose times rise; rows that repeat one are left out where that is allowed."""
    assert times is not None
    step = np.diff(times)
    wrong = step < 0 if repeated else step <= 0
    if wrong.any():
        row = int(np.argmax(wrong)) + 1
        got = f"{times[row]:.9f}".rstrip("0")
        raise input_error("time does not increase", got=got, file=path, line=None if lines is None else int(lines[row]))
    keep = np.concatenate([[True], step > 0])
    return Trajectory(T_world_camera[keep], times[keep], "tum", repeated_stamps=int((~keep).sum()))


def _poses_of_bag(path: Path, lost: bool) -> Trajectory:
    from nolbo_ppl.io.ros_messages import read_bag_poses  # only a bag needs it

    T, times, repeated = read_bag_poses(path)
    known = np.isfinite(T).all(axis=(1, 2))
    if not lost and not known.all():
        raise input_error("a pose is not finite, or no rotation", got=f"message {int(np.argmin(known))}", file=path)
    return Trajectory(T, times, "tum", repeated_stamps=repeated)


def _folder_of_poses(folder: Path, lost: bool) -> Trajectory:
    """One 4 x 4 matrix a file, in natural order of the names."""
    files = [path for path in sorted(folder.glob("*.txt"), key=natural) if not path.name.startswith(".")]
    if not files:
        raise input_error("no pose in the folder", expected="one .txt of 4 rows of 4 numbers a frame", file=folder)
    poses = []
    for path in files:
        found = parse_table(path, read_lines(path), "matrix", lost=lost)
        if len(found.T_world_camera) != 1:
            raise input_error("several poses in one file of a folder", got=len(found.T_world_camera), expected=1, file=path)
        poses.append(found.T_world_camera[0])
    return Trajectory(np.array(poses))


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


def interpolate_poses(
    times: Float[np.ndarray, " n"],
    T: Float[np.ndarray, "n 4 4"],
    at: Float[np.ndarray, " m"],
    longest_gap: float = LONGEST_GAP,
) -> Float[np.ndarray, "m 4 4"]:
    """Poses between poses, along the rigid motion of constant velocity from one to the next; NaN across longer gaps.

    Args:
        times: rising times, s.
        T: poses at these times.
        at: times of the poses wanted; nothing is known before the first and after the last.
        longest_gap: longest time, s, from one pose to the next.
    """
    out = np.full((len(at), 4, 4), np.nan)
    after = np.searchsorted(times, at)
    on = np.minimum(after, len(times) - 1)
    exact = times[on] == at
    out[exact] = T[on[exact]]
    inside = ~exact & (after > 0) & (after < len(times))
    before = after[inside] - 1
    span = times[before + 1] - times[before]
    rows = np.flatnonzero(inside)[span <= longest_gap]
    before, span = before[span <= longest_gap], span[span <= longest_gap]
    share = (at[rows] - times[before]) / span
    out[rows] = T[before] @ se3_exp(share[:, None] * se3_log(relative(T[before], T[before + 1])))
    return out


@dataclass(frozen=True)
class FramePoses:
    """Poses of the frames of a sequence, those that are known, and how they were found."""

    T_world_camera: Float[np.ndarray, "n 4 4"]
    """A row a frame; NaN where the file has no pose for it."""
    matched_by: Literal["row", "number", "time"]
    """What laid rows of the file on frames."""
    repeated_stamps: int = 0
    """Rows of the file left out because they repeat a time."""
    lost: int = 0
    """Rows of the file that hold no pose (nan or inf)."""

    @property
    def known(self) -> Bool[np.ndarray, " n"]:
        """Frames with a pose."""
        known: np.ndarray = np.isfinite(self.T_world_camera).all(axis=(1, 2))
        return known

    def remarks(self, what: str = "truth") -> list[str]:
        """What a reader of the figures has to know: frames without a pose, rows left out."""
        found = []
        if not self.known.all():
            found.append(f"{what}: {int(self.known.sum())} of {len(self.known)} frames have a pose; figures are over these")
        if self.lost:
            found.append(f"{what}: {self.lost} rows hold no pose (nan or inf)")
        if self.repeated_stamps:
            found.append(f"{what}: {self.repeated_stamps} rows repeat a time; the first of each is taken")
        return found


def read_frame_poses(
    path: str | PathLike[str],
    frames: int,
    times: Float[np.ndarray, " f"] | None = None,
    part: slice = slice(None),
    *,
    form: TableFormat | None = None,
    tolerance: float = TIME_TOLERANCE,
    interpolate: bool = False,
    lost: bool = True,
    what: str = "truth",
    of: str = "the frames",
) -> FramePoses:
    """Poses of a sequence's frames, or of a part of them. Where both sides have times, times alone decide.

    Without times on one side, numbers of frames decide, or the rows: one for each frame, or one for each of the part.

    Args:
        path: the trajectory.
        frames: number of frames of the sequence.
        times: their times, s, where all are known.
        part: the frames wanted.
        form: the file's format, where it is not to be told from the file.
        tolerance: how far, s, a frame and its pose may lie apart.
        interpolate: take poses between two rows of the file no more than `LONGEST_GAP` apart, instead of the nearest.
        lost: rows of nothing but nan or inf are poses that are not known.
        what: what the trajectory is, for the messages.
        of: what the frames are, for the messages.

    Raises:
        InputError: the trajectory is malformed, matches neither in number nor by time, or has no pose for any frame;
            names the file.
    """
    found, wanted = read_trajectory(path, form, lost=lost, repeated=True), range(frames)[part]
    count = len(wanted)
    unknown = np.full((frames, 4, 4), np.nan)
    if found.times is not None and times is not None:
        at, known = times[part], found.known
        if interpolate:
            T = interpolate_poses(found.times[known], found.T_world_camera[known], at)
        else:
            T = unknown[:count]
            rows, partner = match_times(at, found.times[known], tolerance)
            T[rows] = found.T_world_camera[known][partner]
        if not np.isfinite(T).any():
            raise input_error(
                f"{what} has no time of {of}",
                got=f"{found.times[0]:.3f} s to {found.times[-1]:.3f} s",
                expected=f"times within {at[0]:.3f} s to {at[-1]:.3f} s",
                do="do both clocks start at the same instant?",
                file=path,
            )
        return FramePoses(T, "time", found.repeated_stamps, int((~known).sum()))
    lost_rows = int((~found.known).sum())
    if found.numbers is not None and len(found) != frames and found.numbers[-1] < frames:
        unknown[found.numbers] = found.T_world_camera
        answer = FramePoses(unknown[part], "number", 0, lost_rows)
    elif len(found) in (frames, count) and not found.repeated_stamps:
        answer = FramePoses(found.T_world_camera[part if len(found) == frames else slice(None)], "row", 0, lost_rows)
    else:
        expected = f"{frames} rows" + ("" if (found.times is None) == (times is None) else ", or times on both sides")
        raise input_error(f"{what} does not match {of} row by row", got=f"{len(found)} rows", expected=expected, file=path)
    if not answer.known.any():
        raise input_error(f"{what} has no pose of {of}", got=f"{len(found)} rows, none with a pose", file=path)
    return answer


def poses_of_frames(
    path: str | PathLike[str],
    frames: int,
    times: Float[np.ndarray, " f"] | None = None,
    part: slice = slice(None),
    *,
    form: TableFormat | None = None,
    tolerance: float = TIME_TOLERANCE,
    interpolate: bool = False,
    what: str = "truth",
    of: str = "the frames",
) -> Float[np.ndarray, "n 4 4"]:
    """`read_frame_poses` where every frame needs a pose.

    Raises:
        InputError: as there, or a frame without a pose; names the file.
    """
    found = read_frame_poses(
        path, frames, times, part, form=form, tolerance=tolerance, interpolate=interpolate, lost=False, what=what, of=of
    )
    if not found.known.all():
        raise input_error(
            f"{what} lacks times of {of}",
            got=f"{int(found.known.sum())} of {len(found.known)} matched within {1000 * tolerance:.0f} ms",
            expected="a pose for each",
            file=path,
        )
    return found.T_world_camera


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
