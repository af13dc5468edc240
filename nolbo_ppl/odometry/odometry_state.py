"""What the visual odometry is, where it stands, what a step tells and what it leaves to the next."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from jaxtyping import Float, Int, UInt8

from nolbo_ppl.errors import input_error
from nolbo_ppl.odometry.ground_scale import LengthBelief
from nolbo_ppl.odometry.keypoints import Features
from nolbo_ppl.odometry.odometry_config import OdometryConfig, Scale, StepFlag
from nolbo_ppl.odometry.planar_scene import PlanePast

DepthOfFrame = Callable[[int], Float[np.ndarray, "h w"] | None]
"""Depth of a frame along the optical axis, m, 0 or NaN unknown; None where there is no depth image."""


class FrameSource(Protocol):
    """What frames are read from; `nolbo_ppl.data.sequences.FrameSequence` is one."""

    def __len__(self) -> int:
        """Number of frames."""

    def frame(self, k: int, /) -> UInt8[np.ndarray, "h w 3"]:
        """One frame."""


@dataclass(frozen=True)
class VisualOdometry:
    """What does not change along the way."""

    intrinsics: Float[np.ndarray, " 4"]
    """fx, fy, cx, cy, px."""
    scale: Scale
    """Where lengths come from."""
    config: OdometryConfig = field(default_factory=OdometryConfig)
    """Settings."""

    def __post_init__(self) -> None:
        intrinsics = np.asarray(self.intrinsics, dtype=np.float64)
        if intrinsics.shape != (4,) or not np.isfinite(intrinsics).all() or (intrinsics[:2] <= 0).any():
            raise input_error("intrinsics", got=self.intrinsics, expected="[fx, fy, cx, cy] px, focal lengths above 0")
        object.__setattr__(self, "intrinsics", intrinsics)

    @property
    def focal(self) -> float:
        """Focal length, px."""
        return float(np.sqrt(self.intrinsics[0] * self.intrinsics[1]))


@dataclass(frozen=True)
class OdometryState:
    """Where the odometry stands after a frame."""

    frame: int
    """Number of frames seen before this one."""
    T_world_camera: Float[np.ndarray, "4 4"]
    """Pose of this frame; the world is the first camera."""
    image: UInt8[np.ndarray, "h w"]
    """This frame in grey."""
    features: Features
    """Its corners."""
    step: Float[np.ndarray, "4 4"] | None = None
    """The step before, T_earlier_later."""
    direction: Float[np.ndarray, " 3"] | None = None
    """Direction of the last translation that was measured."""
    length: LengthBelief | None = None
    """Length of the step before, where the images give the scale."""
    planes: tuple[PlanePast, ...] = ()
    """Planes that may be all the frames before have seen, in this camera."""
    depth: float | None = None
    """Usual depth of what the camera looks at, m; None where it has turned away from what was measured."""
    turned: float = 0.0
    """Angle since that was measured, rad."""
    feature_depth: Float[np.ndarray, " n"] | None = None
    """Depth of this frame's corners, m, NaN unknown; None without a depth image."""


@dataclass(frozen=True)
class Step:
    """Motion from one frame to the next."""

    T_earlier_later: Float[np.ndarray, "4 4"]
    """Pose of the later camera in the earlier one."""
    covariance: Float[np.ndarray, "6 6"]
    """Of `Log(T_earlier_later^-1 T_true)`, [rotation rad, translation m], about the later camera's axes (GTSAM Pose3)."""
    matches: int
    """Matches between the two frames."""
    inliers: int
    """Those that obey the motion."""
    flags: StepFlag
    """What it lacked."""
    normal: Float[np.ndarray, " 3"] | None = None
    """Normal of the plane in the later camera, where the scene is one."""


@dataclass(frozen=True)
class StepMemory:
    """What a step leaves to the next one."""

    length: LengthBelief | None = None
    """Length of the step, where the images give the scale."""
    planes: tuple[PlanePast, ...] = ()
    """Planes that may be all that was seen, in the later camera."""
    depth: float | None = None
    """Usual depth of the matches, m, where it was measured."""


@dataclass(frozen=True)
class Odometry:
    """A trajectory by visual odometry."""

    T_world_camera: Float[np.ndarray, "n 4 4"]
    """Poses; the world is the first camera."""
    covariance: Float[np.ndarray, "n-1 6 6"]
    """Covariance of each step, [rotation rad, translation m] about the later camera's axes (GTSAM Pose3)."""
    matches: Int[np.ndarray, " n-1"]
    """Matches of each step."""
    inliers: Int[np.ndarray, " n-1"]
    """Inliers of each step."""
    flags: UInt8[np.ndarray, " n-1"]
    """`StepFlag` bits of each step."""

    def __len__(self) -> int:
        return len(self.T_world_camera)
