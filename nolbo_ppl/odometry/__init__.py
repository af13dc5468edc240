"""Visual odometry, deliberately simple: features, essential matrix, a scale from outside, a covariance for every step."""

from __future__ import annotations

from nolbo_ppl.odometry.odometry_config import (
    GroundHeight,
    KnownLengths,
    MeasuredDepth,
    OdometryConfig,
    Scale,
    StepFlag,
    lengths_of,
)
from nolbo_ppl.odometry.odometry_state import (
    DepthOfFrame,
    FrameSource,
    Odometry,
    OdometryState,
    Step,
    StepMemory,
    VisualOdometry,
)
from nolbo_ppl.odometry.step_composition import at_keyframes, between, compose_covariance, keyframes
from nolbo_ppl.odometry.step_estimation import motion
from nolbo_ppl.odometry.visual_odometry import estimate_odometry, init, step

__all__ = [
    "DepthOfFrame",
    "FrameSource",
    "GroundHeight",
    "KnownLengths",
    "MeasuredDepth",
    "Odometry",
    "OdometryConfig",
    "OdometryState",
    "Scale",
    "Step",
    "StepFlag",
    "StepMemory",
    "VisualOdometry",
    "at_keyframes",
    "between",
    "compose_covariance",
    "estimate_odometry",
    "init",
    "keyframes",
    "lengths_of",
    "motion",
    "step",
]
