"""Scales and populations the online system starts with: of a reference problem, or defaults."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from nolbo_ppl.inference.slam.detection_features import FeaturePrior, fit_prior
from nolbo_ppl.inference.slam.initialise import init
from nolbo_ppl.inference.slam.noise.noise_estimation import DEFAULT_TRANSLATION_RATIO, estimate_noise
from nolbo_ppl.inference.slam.slam_problem import SlamConfig, SlamProblem

DEFAULT_INTENSITY = 1e-3
"""Density of new landmarks where nothing is known, per m^3; that of false detections is half of it."""


@dataclass(frozen=True)
class IncrementalCalibration:
    """What stays fixed while driving."""

    config: SlamConfig
    """Settings with every scale the reference gave."""
    prior: FeaturePrior
    """Population of features."""
    position_factor: float = 1.0
    """Factor on position covariances in the graph, across the ray."""
    range_factor: float = 1.0
    """The same along the ray."""
    rotation_factor: float = 1.0
    """The same for orientations."""


def default_calibration(first: SlamProblem, config: SlamConfig) -> IncrementalCalibration:
    """Without a reference: stated scales and defaults, and the population of the first keyframe."""
    birth_intensity, clutter_intensity = (
        config.birth_intensity or DEFAULT_INTENSITY,
        config.clutter_intensity or 0.5 * DEFAULT_INTENSITY,
    )
    config = replace(config, birth_intensity=birth_intensity, clutter_intensity=clutter_intensity)
    return IncrementalCalibration(config, fit_prior(first.observations, config, estimate_noise(first, config)))


def calibrate_incremental(reference: SlamProblem, config: SlamConfig) -> IncrementalCalibration:
    """Scales of a reference problem, for everything the configuration does not state.

    A reference of one frame has no steps and gives no scale of the odometry; the defaults stay.
    """
    state = init(reference, config)
    noise, report = state.noise, state.noise.report
    rotation, ratio = config.odometry_rotation_scale, config.odometry_translation_ratio
    constant = config.odometry_translation_scale
    if len(noise.rotation_step):
        rotation = float(np.median(noise.rotation_step))
        if ratio is None and constant is None:
            step = float(np.median(noise.translation_step))
            length = float(np.median(np.linalg.norm(np.diff(reference.odometry[:, :3, 3], axis=0), axis=1)))
            # A reference that stands still says nothing of how the error grows with the step.
            moving = length > step
            ratio = step / length if moving else DEFAULT_TRANSLATION_RATIO
            constant = 0.2 * step if moving else step
    lateral, radial = report.get("position_lateral"), report.get("position_radial")
    position, growth = config.position_scale, config.position_ratio
    if position is None and growth is None and lateral is not None and radial is not None:
        width = max(report.get("position_track_width", 1.0), 1.0) * 1.2
        position = width * max(lateral, radial)
        growth = width * max(report["position_lateral_ratio"], report["position_radial_ratio"])
    angle = config.rotation_scale
    if angle is None and len(noise.rotation_scale):
        angle = float(np.median(noise.rotation_scale))
    config = replace(
        config,
        odometry_rotation_scale=rotation,
        odometry_translation_ratio=ratio,
        odometry_translation_scale=constant,
        position_scale=position,
        position_ratio=growth,
        rotation_scale=angle,
        latent_scale=config.latent_scale or report.get("latent_scale"),
        birth_intensity=noise.birth_intensity,
        clutter_intensity=noise.clutter_intensity,
    )
    return IncrementalCalibration(config, state.prior, noise.position_factor, noise.range_factor, noise.rotation_factor)
