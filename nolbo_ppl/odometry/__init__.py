"""Visual odometry, deliberately simple: features, essential matrix, a scale from outside, a covariance for every step."""

from __future__ import annotations

from nolbo_ppl.odometry.odometry_config import (
    GroundHeight,
    KnownLengths,
    OdometryConfig,
    Scale,
    StepFlag,
    lengths_of,
)
from nolbo_ppl.odometry.step_composition import at_keyframes, between, compose_covariance, keyframes
from nolbo_ppl.odometry.visual_odometry import (
    FrameSource,
    Odometry,
    OdometryState,
    Step,
    VisualOdometry,
    estimate_odometry,
    init,
    motion,
    step,
)

__all__ = [
    "FrameSource",
    "GroundHeight",
    "KnownLengths",
    "Odometry",
    "OdometryConfig",
    "OdometryState",
    "Scale",
    "Step",
    "StepFlag",
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
