"""Measurements resolved once: every detection as the densities that all later steps need.

A table of detections leaves much open: scales to be estimated, symmetry by category, modes or a single orientation, missing
latents. `resolve` settles all of it; tracking, association, the graph and the map read the result and nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from nolbo_ppl.geometry.pose import transform
from nolbo_ppl.inference.slam.detection_features import FeaturePrior, detection_features
from nolbo_ppl.inference.slam.gaussian import upper_root
from nolbo_ppl.inference.slam.latent_mixture import LatentMixture, observed_latent_modes
from nolbo_ppl.inference.slam.orientation import OrientationModes, observed_modes, resolved_symmetry
from nolbo_ppl.inference.slam.slam_problem import NoiseModel, SlamConfig
from nolbo_ppl.structures.detections import Detections


@dataclass(frozen=True)
class Measurements:
    """Detections with everything resolved: no NaN, rows as in the table."""

    frame: Int[np.ndarray, " n"]
    """Row of the odometry."""
    position: Float[np.ndarray, "n 3"]
    """Position in the frame the rest is in (the camera's, or the world's after `in_world`), m."""
    covariance: Float[np.ndarray, "n 3 3"]
    """Its covariance, m^2."""
    shared_root: Float[np.ndarray, "n 3 3"]
    """Root of the part of it that is one error for all views of an object, in the camera's axes, m: one vector of three standard
    normal numbers an object, seen through this."""
    oriented: Bool[np.ndarray, " n"]
    """Whether an orientation is observed."""
    modes: OrientationModes
    """Its modes (the identity where there is none)."""
    symmetry: Int[np.ndarray, " n"]
    """Symmetry order about the object's vertical axis: 0 free, 1 none."""
    latent: Float[np.ndarray, "n d"]
    """Shape latent; the population's mean where missing."""
    latent_variance: Float[np.ndarray, "n d"]
    """Its variance between views of one object (`detection_features`); LARGE_VARIANCE where missing."""
    category: Int[np.ndarray, " n"]
    """Index of the category, -1 for none."""
    log_object: Float[np.ndarray, " n"]
    """Log likelihood of the score for a true object, `log q / pi` (docs/em.md)."""
    log_clutter: Float[np.ndarray, " n"]
    """The same for a false detection, `log (1 - q) / (1 - pi)`."""
    latent_modes: LatentMixture | None = None
    """Modes of the latents; None where no detection states two."""

    def __len__(self) -> int:
        return len(self.frame)

    def select(self, rows: np.ndarray) -> Measurements:
        """Some of the rows."""
        values: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        parted = ("modes", "latent_modes")
        taken: dict[str, Any] = {k: v.select(rows) if k in parted else v[rows] for k, v in values.items() if v is not None}
        return Measurements(**taken)

    def in_world(self, T_world_camera: Float[np.ndarray, "n 4 4"]) -> Measurements:
        """Positions, covariances and orientations carried to the world by one pose a detection."""
        R = T_world_camera[:, :3, :3]
        values: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        values |= {
            "position": transform(T_world_camera, self.position),
            "covariance": R @ self.covariance @ np.swapaxes(R, 1, 2),
            "modes": self.modes.turned(R),
        }
        return Measurements(**values)


def resolve(table: Detections, noise: NoiseModel, config: SlamConfig, prior: FeaturePrior) -> Measurements:
    """Settle everything a table of detections leaves open.

    Args:
        table: detections in camera frames.
        noise: scales of these rows.
        config: symmetry by category, the limits of objectness, and how far views of an object err alike in their latents.
        prior: population of features, with the share of true detections that objectness refers to.
    """
    latent, variance, category = detection_features(table, noise, prior, config.latent_correlation or 0.0)
    objectness = np.clip(table.objectness, *config.objectness_limits)
    share = prior.objectness_prior
    return Measurements(
        frame=table.frame,
        position=table.position,
        covariance=noise.position_covariance,
        shared_root=upper_root(np.nan_to_num(table.position_shared)),
        oriented=table.has_rotation,
        modes=observed_modes(table, noise.rotation_scale),
        symmetry=resolved_symmetry(table, config),
        latent=latent,
        latent_variance=variance,
        category=category,
        log_object=np.log(objectness / share),
        log_clutter=np.log((1 - objectness) / (1 - share)),
        latent_modes=observed_latent_modes(table, latent),
    )
