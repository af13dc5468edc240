"""`nolbo odometry`: images in, a drifting trajectory with covariances out."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from nolbo_ppl._version import __version__
from nolbo_ppl.data.sequences import (
    FrameSequence,
    frames_with_camera,
    open_frames,
    read_lengths,
)
from nolbo_ppl.errors import input_error
from nolbo_ppl.io.files import atomic_path, read_json_object, write_json
from nolbo_ppl.io.npz import save_npz
from nolbo_ppl.io.output_folder import output_folder
from nolbo_ppl.io.ros_bags import is_bag
from nolbo_ppl.io.trajectories import COVARIANCE, Trajectory, read_frame_poses, write_trajectory
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error, path_length
from nolbo_ppl.odometry import (
    GroundHeight,
    KnownLengths,
    Odometry,
    OdometryConfig,
    Scale,
    StepFlag,
    estimate_odometry,
    lengths_of,
)
from nolbo_ppl.pipeline.perception import DepthSource, depth_noise, open_depth


@dataclass(frozen=True)
class OdometryRunConfig:
    """Simple visual odometry: motion from matched features, its length from elsewhere, a covariance for every step."""

    images: Path
    """Folder of images (KITTI, TUM RGB-D, any names), a video or a bag of ROS (`BAG:/topic`)."""
    out: Path
    """Folder for odometry.txt, odometry_covariance.npz and odometry.json."""
    intrinsics: Path | None = None
    """The camera: YAML of OpenCV, ROS, Kalibr or ORB-SLAM, intrinsics.json, a KITTI calib.txt, or a text file with fx fy cx cy
    and the distortion, which is taken out of the images. Without a file the camera is guessed."""
    scale: Literal["truth", "ground", "file", "depth"] = "ground"
    """Length of the steps: of the true trajectory, from the ground under the camera, of a file (a wheel), or measured by depth
    images (of `--depth`, which implies it, or of a TUM RGB-D folder)."""
    truth: Path | None = None
    """True trajectory, a row a frame (or TUM rows matched by time): for `--scale truth`, and for errors."""
    lengths: Path | None = None
    """Lengths of the steps in metres, one a line, for `--scale file`."""
    camera_height: float | None = None
    """Height of the camera over the ground in metres, for `--scale ground`."""
    camera_pitch: float = 0.0
    """How far the camera looks down, rad, for `--scale ground`."""
    depth: Path | None = None
    """Folder of depth pictures (16 bit PNG, same names or same order as the images), registered to them, or `BAG:/topic`."""
    depth_unit: float = 1 / 5000
    """Metres of one step of them: TUM 1/5000, YCB-Video 1/10000, millimetres 1/1000."""
    first: int = 0
    """First frame."""
    count: int | None = None
    """Number of frames; all when left out."""
    config: OdometryConfig = field(default_factory=OdometryConfig)
    """Settings."""
    topic: str | None = None
    """Topic of the images of a bag; by default its only one."""


@dataclass(frozen=True)
class Part:
    """Some frames of a sequence in a row."""

    frames: FrameSequence
    first: int
    count: int

    def __len__(self) -> int:
        return self.count

    def frame(self, k: int, /) -> np.ndarray:
        """Frame k of the part."""
        return self.frames.frame(self.first + k)


def part_of(frames: FrameSequence, first: int, count: int | None) -> Part:
    """The frames asked for. Raises `InputError` when they are not there."""
    rest = len(frames) - first
    if first < 0 or rest < 1 or (count is not None and not 1 <= count <= rest):
        raise input_error(
            "frames asked for",
            got=f"{count if count is not None else 'all'} from {first}",
            expected=f"frames within 0 to {len(frames) - 1}",
        )
    return Part(frames, first, rest if count is None else count)


def frame_times(part: Part) -> np.ndarray | None:
    """Times of the frames in s; None unless all are known."""
    times = part.frames.times
    return None if times is None else times[part.first : part.first + len(part)]


def true_poses(path: Path, part: Part) -> np.ndarray:
    """True poses of the frames, NaN where they are not known.

    Raises:
        InputError: rows that match the sequence neither in number nor by time.
    """
    rows = slice(part.first, part.first + len(part))
    return read_frame_poses(path, len(part.frames), part.frames.times, rows).T_world_camera


def known_lengths(path: Path, part: Part) -> np.ndarray:
    """Lengths of the part's steps from a file of all steps, or of the part's alone. Raises `InputError` otherwise."""
    lengths = read_lengths(path)
    if len(lengths) == len(part) - 1:
        return lengths
    if len(lengths) == len(part.frames) - 1:
        return lengths[part.first : part.first + len(part) - 1]
    raise input_error(
        "lengths do not match the frames",
        got=f"{len(lengths)} lengths",
        expected=f"{len(part.frames) - 1}, one fewer than frames",
        file=path,
    )


def depth_source(arguments: OdometryRunConfig, part: Part) -> DepthSource | None:
    """Depth of the part's frames where it gives the lengths. Raises `InputError` where there is none or it does not fit."""
    implied = arguments.depth is not None and arguments.camera_height is None and arguments.scale == "ground"
    if arguments.scale != "depth" and not implied:
        return None
    if not (np.isfinite(arguments.depth_unit) and arguments.depth_unit > 0):
        raise input_error("--depth-unit", got=arguments.depth_unit, expected="metres of one step, above 0")
    if arguments.depth is None and not part.frames.has_depth:
        raise input_error("--scale depth without depth images", do="give --depth FOLDER, or a TUM folder with depth.txt")
    index = list(range(part.first, part.first + len(part)))
    return open_depth(part.frames, index, arguments.depth, arguments.depth_unit)


def scale_of(arguments: OdometryRunConfig, part: Part, truth: np.ndarray | None, source: DepthSource | None = None) -> Scale:
    """Where lengths come from. Raises `InputError` when the option that gives them is missing."""
    if arguments.scale == "truth":
        if truth is None:
            raise input_error("--scale truth without a trajectory", do="give --truth FILE")
        if not np.isfinite(truth).all():
            raise input_error("--scale truth with gaps in the truth", expected="a pose for every frame", do="take --scale file")
        return KnownLengths(lengths_of(truth))
    if arguments.scale == "file":
        if arguments.lengths is None:
            raise input_error("--scale file without lengths", do="give --lengths FILE, one length a line")
        return KnownLengths(known_lengths(arguments.lengths, part))
    if source is not None:
        return depth_noise(source)
    if arguments.camera_height is None:
        raise input_error("--scale ground without the height of the camera", do="give --camera-height METRES")
    return GroundHeight(arguments.camera_height, arguments.camera_pitch)


def _depth(source: DepthSource, part: Part, k: int) -> np.ndarray | None:
    return source.depth(k, part.frame(k))


def summary(odometry: Odometry, truth: np.ndarray | None, seconds: float) -> dict[str, Any]:
    """Figures of a run: counts, speed, and errors where the truth is known."""
    names = {flag.name: int(np.sum((odometry.flags & flag) > 0)) for flag in StepFlag if flag}
    figures: dict[str, Any] = {
        "frames": len(odometry),
        "path_length": path_length(odometry.T_world_camera),
        "median_inliers": float(np.median(odometry.inliers)) if len(odometry) > 1 else 0.0,
        "flags": names,
        "seconds": round(seconds, 3),
        "frames_per_second": round(len(odometry) / max(seconds, 1e-9), 2),
    }
    if truth is not None and len(odometry) > 1:
        error = absolute_trajectory_error(odometry.T_world_camera, truth, "se3").rmse
        way = path_length(truth)
        figures |= {"true_path_length": way, "ate": error, "ate_percent": 100.0 * error / way if way > 0 else None}
    return figures


RESULT = ("odometry.txt", COVARIANCE, "times.txt", "odometry.json")
"""Files of an odometry."""


def is_result(folder: Path) -> bool:
    """Whether a folder holds an odometry that another may replace."""
    file = folder / "odometry.json"
    return file.is_file() and {"options", "config", "version"} <= set(read_json_object(file))


def write_odometry(out: Path, odometry: Odometry, times: np.ndarray | None, report: dict[str, Any]) -> None:
    """Write odometry.txt (KITTI rows), odometry_covariance.npz, times.txt where known, and odometry.json, each atomically."""
    write_trajectory(out / "odometry.txt", Trajectory(odometry.T_world_camera))
    names = ("covariance", "matches", "inliers", "flags")
    save_npz(out / COVARIANCE, {name: getattr(odometry, name) for name in names}, compressed=False)
    if times is not None:
        with atomic_path(out / "times.txt") as temporary:
            temporary.write_text("".join(f"{stamp!r}\n" for stamp in times.tolist()), encoding="utf-8")
    write_json(out / "odometry.json", report)


def run(arguments: OdometryRunConfig) -> tuple[Odometry, dict[str, Any]]:
    """Read, estimate, write; returns the odometry and the report.

    Raises:
        InputError: unusable input, or an output folder that holds something else; an older result stays as it was.
    """
    inputs = (arguments.intrinsics, arguments.truth, arguments.lengths, arguments.depth)
    with output_folder(arguments.out, RESULT, is_own=is_result, inputs=inputs) as folder:
        return _estimate(arguments, folder)


def _estimate(arguments: OdometryRunConfig, folder: Path) -> tuple[Odometry, dict[str, Any]]:
    bag = arguments.depth if arguments.depth is not None and is_bag(arguments.depth) else None
    frames, camera, remark = frames_with_camera(open_frames(arguments.images, arguments.topic, bag), arguments.intrinsics)
    remarks = [remark] if remark else []
    part, intrinsics = part_of(frames, arguments.first, arguments.count), camera.vector
    truth = None if arguments.truth is None else true_poses(arguments.truth, part)
    source = depth_source(arguments, part)
    scale = scale_of(arguments, part, truth, source)
    depth = None if source is None else partial(_depth, source, part)
    begin = time.perf_counter()
    odometry = estimate_odometry(part, intrinsics, scale, arguments.config, progress=True, depth=depth)
    figures = summary(odometry, truth, time.perf_counter() - begin)
    options = {
        name: str(value) if isinstance(value, Path) else value for name, value in asdict(arguments).items() if name != "config"
    }
    report = {"version": __version__, "options": options, "config": asdict(arguments.config), **figures, "remarks": remarks}
    write_odometry(folder, odometry, frame_times(part), report)
    return odometry, report


def describe(report: dict[str, Any]) -> str:
    """A few lines for the terminal."""
    flags = {name: count for name, count in report["flags"].items() if count}
    lines = [
        f"{report['frames']} frames, {report['path_length']:.1f} m, {report['frames_per_second']:.1f} frames/s, "
        f"{report['median_inliers']:.0f} inliers"
    ]
    if flags:
        lines.append("guessed steps: " + json.dumps(flags))
    if "ate" in report:
        percent = "" if report["ate_percent"] is None else f" ({report['ate_percent']:.2f} % of the way)"
        lines.append(f"ATE {report['ate']:.3f} m{percent}")
    lines += report.get("remarks", [])
    return "\n".join(lines)


def main(args: Sequence[str] | None = None) -> None:
    """Command line of `nolbo odometry`."""
    import sys

    import tyro

    arguments = tyro.cli(OdometryRunConfig, prog="nolbo odometry", args=args)
    _, report = run(arguments)
    sys.stdout.write(describe(report) + f"\nwritten to {arguments.out}\n")


if __name__ == "__main__":
    main()
