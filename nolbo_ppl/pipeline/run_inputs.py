"""What a run is made from: images, camera, odometry and truth of every image; which images are keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from nolbo_ppl._moved import renamed
from nolbo_ppl.data.sequences import (
    BagFrames,
    CameraIntrinsics,
    FrameSequence,
    ImageFolder,
    UndistortedFrames,
    frames_with_camera,
    open_frames,
    read_lengths,
)
from nolbo_ppl.errors import input_error
from nolbo_ppl.io.ros_bags import is_bag
from nolbo_ppl.io.trajectories import covariance_beside, poses_of_frames, read_frame_poses
from nolbo_ppl.odometry import (
    GroundHeight,
    KnownLengths,
    MeasuredDepth,
    Odometry,
    Scale,
    at_keyframes,
    estimate_odometry,
    keyframes,
    lengths_of,
)
from nolbo_ppl.pipeline.perception import DepthSource, depth_noise, open_depth
from nolbo_ppl.pipeline.run_config import RunConfig
from nolbo_ppl.pipeline.stage_keys import folder_digest

Poses = Float[np.ndarray, "n 4 4"]


@dataclass(frozen=True)
class RunInputs:
    """The input of a run."""

    frames: FrameSequence
    """All images."""
    camera: CameraIntrinsics
    """The camera that took them."""
    used: Int[np.ndarray, " u"]
    """Images that are looked at: every so many-th."""
    truth: Poses | None
    """True pose of every image; NaN where it is not known."""
    remarks: tuple[str, ...] = ()
    """What a reader of the figures has to know of the input."""

    @property
    def intrinsics(self) -> Float[np.ndarray, " 4"]:
        """[fx, fy, cx, cy], px."""
        return self.camera.vector

    def file(self, k: int) -> Path:
        """The file of an image; of a video, its name inside the video."""
        source = self._source
        return source.files[k] if isinstance(source, ImageFolder) else source.path / source.name(k)

    @property
    def _source(self) -> FrameSequence:
        """The images as they are in files."""
        return self.frames.source if isinstance(self.frames, UndistortedFrames) else self.frames

    def fingerprint(self) -> Any:
        """What tells one sequence of images from another: names and sizes of its files."""
        source = self._source
        if isinstance(source, ImageFolder):
            return [[file.name, file.stat().st_size] for file in source.files]
        if isinstance(source, BagFrames):
            return [len(source), source.topic, folder_digest(source.path)[1]]
        return [len(source), source.path.stat().st_size]


@dataclass(frozen=True)
class FrameSubset:
    """Some frames of a sequence."""

    frames: FrameSequence
    """All."""
    used: Int[np.ndarray, " u"]
    """Which."""

    def __len__(self) -> int:
        return len(self.used)

    def frame(self, k: int, /) -> UInt8[np.ndarray, "h w 3"]:
        """One of them."""
        return self.frames.frame(int(self.used[k]))


@dataclass(frozen=True)
class FoundOdometry:
    """Odometry of the images that are looked at."""

    odometry: Odometry
    """Poses and, where they are known, covariances."""
    stated: bool
    """Whether covariances are known."""
    estimated: bool = False
    """Whether it is visual odometry, whose steps have flags."""

    def at(
        self, rows: Int[np.ndarray, " k"]
    ) -> tuple[Poses, Float[np.ndarray, "k-1 6 6"] | None, UInt8[np.ndarray, " k-1"] | None]:
        """Poses at these rows, the covariances of the motions between them, and what those lacked."""
        chosen = at_keyframes(self.odometry, rows)
        return chosen.T_world_camera, chosen.covariance if self.stated else None, chosen.flags if self.estimated else None


def open_run_inputs(config: RunConfig) -> RunInputs:
    """Open images, camera and truth.

    Raises:
        InputError: one of them is missing or malformed, or they do not fit each other.
    """
    depth = config.depth if config.depth is not None and is_bag(config.depth) else None
    frames = open_frames(config.images, config.topic, depth)
    frames, camera, remark = frames_with_camera(frames, config.intrinsics)
    remarks = [remark] if remark else []
    if isinstance(frames, UndistortedFrames) and config.right is not None:
        raise input_error("--right with a distorted camera", expected="images that were rectified together")
    truth = None
    if config.truth is not None:
        found = read_frame_poses(config.truth, len(frames), frames.times, interpolate=is_bag(config.truth), of="the images")
        truth = found.T_world_camera
        remarks += found.remarks()
    return RunInputs(frames, camera, np.arange(0, len(frames), config.frame_stride), truth, tuple(remarks))


def depth_of_drive(drive: RunInputs, config: RunConfig, index: Sequence[int]) -> DepthSource:
    """Depth of some images, where there is any. Raises `InputError` for pictures that belong to no image."""
    focal = float(drive.intrinsics[0])
    return open_depth(drive.frames, index, config.depth, config.depth_unit, config.right, config.baseline, focal)


def scale_of(drive: RunInputs, config: RunConfig) -> Scale:
    """Where visual odometry has its lengths from: a wheel, the height over the ground, depth images, or the truth.

    Raises:
        InputError: nowhere, or a wheel file that does not fit.
    """
    if config.camera_height is not None:
        return GroundHeight(config.camera_height, pitch=config.camera_pitch)
    if config.step_lengths is not None:
        return KnownLengths(lengths_between(read_step_lengths(config.step_lengths, len(drive.frames) - 1), drive.used))
    if config.depth is not None or config.right is not None or drive.frames.has_depth:
        return depth_noise(depth_of_drive(drive, config, drive.used.tolist()))
    if drive.truth is not None:
        if not np.isfinite(drive.truth[drive.used]).all():
            raise input_error(
                "lengths from a truth with gaps", expected="a pose for every image, --step-lengths or --camera-height"
            )
        return KnownLengths(lengths_of(drive.truth[drive.used]))
    raise input_error(
        "visual odometry without a scale",
        expected="--camera-height, --step-lengths, --depth, --right or --truth",
        do="or give an odometry of your own with --odometry",
    )


def read_step_lengths(path: Path, count: int) -> Float[np.ndarray, " n"]:
    """Lengths of the steps between successive images, m. Raises `InputError` when there are more or fewer of them."""
    lengths = read_lengths(path)
    if len(lengths) != count:
        raise input_error("lengths of steps", got=f"{len(lengths)} numbers", expected=f"{count}, one between images", file=path)
    return lengths


def lengths_between(lengths: Float[np.ndarray, " n"], used: Int[np.ndarray, " u"]) -> Float[np.ndarray, " u-1"]:
    """Way between the images that are looked at."""
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    return np.diff(along[used])


def _depth(source: DepthSource, frames: FrameSubset, k: int) -> Float[np.ndarray, "h w"] | None:
    return source.depth(k, frames.frame(k))


def estimate_or_read(drive: RunInputs, config: RunConfig) -> FoundOdometry:
    """The given odometry, with the covariances beside it where there are any, or visual odometry.

    Raises:
        InputError: an odometry that does not match the images, or none and no scale to make one.
    """
    if config.odometry is None:
        scale, frames = scale_of(drive, config), FrameSubset(drive.frames, drive.used)
        depth = None
        if isinstance(scale, MeasuredDepth):
            source = depth_of_drive(drive, config, drive.used.tolist())
            depth = partial(_depth, source, frames)
        found = estimate_odometry(frames, drive.intrinsics, scale, config.visual, progress=True, depth=depth)
        return FoundOdometry(found, stated=True, estimated=True)
    images = drive.frames
    poses = poses_of_frames(
        config.odometry, len(images), images.times, interpolate=is_bag(config.odometry), what="odometry", of="the images"
    )
    covariance = covariance_beside(config.odometry)
    stated = covariance is not None and len(covariance) == len(poses) - 1
    n = len(poses) - 1
    every = Odometry(
        T_world_camera=poses,
        covariance=covariance if covariance is not None and stated else np.zeros((n, 6, 6)),
        matches=np.zeros(n, dtype=np.int64),
        inliers=np.zeros(n, dtype=np.int64),
        flags=np.zeros(n, dtype=np.uint8),
    )
    return FoundOdometry(at_keyframes(every, drive.used), stated)


def keyframe_rows(found: FoundOdometry, config: RunConfig) -> Int[np.ndarray, " k"]:
    """Rows of the odometry that are keyframes: all, or those far enough from the last."""
    if config.keyframe_distance == 0 and config.keyframe_angle == 0:
        return np.arange(len(found.odometry))
    distance, angle = (value or np.inf for value in (config.keyframe_distance, config.keyframe_angle))
    return keyframes(found.odometry, distance, angle)


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
