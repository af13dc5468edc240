"""Settings of the visual odometry, the sources of its scale, and the flags of steps that had to be guessed."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag
from typing import Literal

import numpy as np
from jaxtyping import Float

from nolbo_ppl.errors import input_error


class StepFlag(IntFlag):
    """What a step lacked; zero is a plain step. Bits are joined."""

    OK = 0
    """The motion and its length were both measured."""
    FEW_MATCHES = 1
    """Too few matches or inliers: the step before is repeated, with a large covariance."""
    STILL = 2
    """The images do not differ: no motion, but for a length somebody else measured."""
    ROTATION = 4
    """The matches turn about the camera without parallax: rotation measured, direction of translation as before."""
    NO_SCALE = 8
    """No ground was found: the length before is repeated."""
    TWIN = 16
    """All matches lie on one plane, which allows two motions: the likelier one, with a covariance that holds both."""
    WEAK = 32
    """Matches so few or so close together that the motion is hardly better known than by a guess; its covariance says so."""


@dataclass(frozen=True)
class OdometryConfig:
    """Settings of the visual odometry. The defaults are tuned on images of 384 x 192 px and hold for larger ones."""

    detector: Literal["orb", "sift"] = "orb"
    """Features: ORB is faster, SIFT more accurate and three times slower."""
    features: int = 500
    """Features an image, at most."""
    fast_threshold: int = 5
    """Least contrast of an ORB corner in grey values; small, since small images of plain surfaces have few corners."""
    levels: int = 4
    """Levels of the ORB pyramid; a fifth of 384 x 192 px would hold next to nothing."""
    level_factor: float = 1.2
    """Scale between levels."""
    cell: int = 32
    """Side of the cells the corners are spread over, px."""
    ratio: float = 0.85
    """Ratio test: a match is this much nearer than the second best (Lowe 2004)."""
    largest_shift: float = 0.25
    """Matches further apart than this part of the image's diagonal are dropped."""
    patch: int = 0
    """Side of the patches that are registered to place matches below a pixel; 0 takes the corners as they are.

    The paper's odometry is weak on purpose, and so is this default. With 11 px the drift is three times smaller.
    """
    threshold: float = 1.0
    """Inlier threshold of the essential matrix, px."""
    confidence: float = 0.999
    """Probability that RANSAC has drawn one sample without outliers."""
    iterations: int = 2000
    """Samples of RANSAC, at most."""
    seed: int = 0
    """Seed of RANSAC: the same images give the same odometry."""
    least_inliers: int = 20
    """Fewer inliers than this measure nothing."""
    still_shift: float = 0.25
    """Median shift of the matches, px, below which the camera stands still."""
    parallax_share: float = 0.1
    """Least part of the inliers that must show parallax for the direction of translation to be measured."""
    lost_rotation_scale: float = 0.1
    """Standard deviation of each angle of a repeated step, rad."""
    lost_translation_ratio: float = 0.5
    """The same for its translation, in parts of its length."""
    inflation: float = 2.0
    """Factor on the standard deviations that follow from the residuals alone.

    Exact on simulated points with 1. On images errors of neighbouring corners go together: normalised squared errors
    of steps have medians of 14 to 28 there, where six degrees of freedom would give 5.3.
    """

    def __post_init__(self) -> None:
        positive = (
            "features",
            "fast_threshold",
            "levels",
            "cell",
            "threshold",
            "iterations",
            "inflation",
            "lost_rotation_scale",
            "lost_translation_ratio",
            "largest_shift",
        )
        for name in positive:
            if not getattr(self, name) > 0:
                raise input_error(f"odometry setting {name}", got=getattr(self, name), expected="a positive number")
        if self.level_factor <= 1:
            raise input_error("odometry setting level_factor", got=self.level_factor, expected="more than 1")
        for name in ("ratio", "confidence"):
            if not 0 < getattr(self, name) <= 1:
                raise input_error(f"odometry setting {name}", got=getattr(self, name), expected="a number in (0, 1]")
        if self.least_inliers < 8:
            raise input_error("odometry setting least_inliers", got=self.least_inliers, expected="at least 8")


@dataclass(frozen=True)
class KnownLengths:
    """Scale from outside: the length of every step, of a wheel or of the truth."""

    lengths: Float[np.ndarray, " n-1"]
    """Way between one frame and the next, m."""
    ratio: float = 0.01
    """Standard deviation of a length in parts of it."""
    floor: float = 1e-3
    """Least standard deviation, m."""

    def __post_init__(self) -> None:
        lengths = np.asarray(self.lengths, dtype=np.float64)
        if lengths.ndim != 1 or not np.isfinite(lengths).all() or (lengths < 0).any():
            raise input_error("lengths of steps", got=lengths[:8], expected="a row of finite lengths, none negative, m")
        if not (self.ratio >= 0 and self.floor > 0):
            raise input_error("noise of lengths", got=f"ratio {self.ratio}, floor {self.floor}", expected="floor above 0")
        object.__setattr__(self, "lengths", lengths)

    def scale(self, length: float) -> float:
        """Standard deviation of a length, m."""
        return float(np.hypot(self.ratio * length, self.floor))


@dataclass(frozen=True)
class GroundHeight:
    """Scale from the ground: how high the camera sits over the plane it drives on."""

    height: float
    """Height of the camera over the ground, m."""
    pitch: float = 0.0
    """How far the camera looks down from the horizontal, rad."""
    ratio: float = 0.03
    """Standard deviation in parts of a length that remains with the best of grounds: bumps, nodding."""
    acceleration: float = 0.1
    """Standard deviation of the change of the logarithm of the length from one step to the next."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.height) and self.height > 0):
            raise input_error("height of the camera", got=self.height, expected="metres over the ground, more than 0")
        if not abs(self.pitch) < np.pi / 4:
            raise input_error("pitch of the camera", got=self.pitch, expected="rad, less than pi / 4 either way")
        if not (self.ratio > 0 and self.acceleration > 0):
            raise input_error("noise of the ground", got=f"{self.ratio}, {self.acceleration}", expected="more than 0")


@dataclass(frozen=True)
class MeasuredDepth:
    """Scale from depth images (RGB-D, stereo): each step is measured in metres. Errors are those of one pixel."""

    ratio: float = 0.0015
    """Standard deviation of a depth that grows with its square, 1/m (structured light: Khoshelham and Elberink 2012)."""
    floor: float = 0.005
    """Least standard deviation of a depth, m."""

    def __post_init__(self) -> None:
        if not (np.isfinite([self.ratio, self.floor]).all() and self.ratio >= 0 and self.floor > 0):
            raise input_error("noise of depths", got=f"ratio {self.ratio}, floor {self.floor}", expected="floor above 0")

    def scale(self, depth: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Standard deviation of depths, m.

        >>> MeasuredDepth(ratio=0.001, floor=0.003).scale(np.array([0.0, 2.0])).round(4).tolist()
        [0.003, 0.005]
        """
        return np.hypot(self.ratio * np.asarray(depth) ** 2, self.floor)


Scale = KnownLengths | GroundHeight | MeasuredDepth


def lengths_of(T_world_camera: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, " n-1"]:
    """Lengths of the steps of a trajectory, m."""
    return np.linalg.norm(np.diff(np.asarray(T_world_camera, dtype=np.float64)[:, :3, 3], axis=0), axis=1)
