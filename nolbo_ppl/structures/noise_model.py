"""The noise that a run has settled on: what odometry and detections state, or what the data show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class NoiseModel:
    """The standard deviations in use, after estimation and correction."""

    rotation_step: Float[np.ndarray, " s"]
    """Standard deviation of each angle of each odometry step, rad."""
    translation_step: Float[np.ndarray, " s"]
    """Standard deviation of each coordinate of each odometry step, m."""
    position_covariance: Float[np.ndarray, "k 3 3"]
    """Covariance of every observed position in its camera frame, m^2."""
    rotation_scale: Float[np.ndarray, " k"]
    """Standard deviation of every observed angle, rad."""
    latent_scale: Float[np.ndarray, "k d"]
    """Standard deviation of every latent coordinate."""
    birth_intensity: float
    """Landmarks not seen before, per m^3."""
    clutter_intensity: float
    """False detections, per m^3 and frame."""
    report: dict[str, float]
    """Estimated values by name."""
    warnings: tuple[str, ...] = ()
    """Stated scales found too small, in words."""
    position_factor: float = 1.0
    """Factor on position covariances in the graph, across the ray, for errors that resemble one another from frame to frame."""
    range_factor: float = 1.0
    """The same along the ray: depth is what detectors are biased in."""
    rotation_factor: float = 1.0
    """The same for orientations."""
    step_correlation: Float[np.ndarray, "s 6 6"] | None = None
    """Covariance of each odometry step in units of its scales, where the problem states covariances."""
    position_dof: float | None = None
    """Degrees of freedom of positions about their covariances, which are then scale matrices; None: Gaussian."""
    scale_walk: float | None = None
    """Standard deviation of the change of the factor on the odometry's steps from one to the next; None: steps are metric."""
