"""One object of a map: pose, existence, class, shape latent, each with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Landmark:
    """One object of the map."""

    index: int
    """Its number; `L<index>` in files."""
    T_world_object: Float[np.ndarray, "4 4"]
    """Pose; the rotation is meaningful where `oriented`."""
    covariance: Float[np.ndarray, "6 6"]
    """Covariance of [rotation rad, position m] in the object's own frame, the first camera pose held fixed."""
    position_covariance: Float[np.ndarray, "3 3"]
    """Covariance of the position in the world frame, m^2."""
    oriented: bool
    """Whether an orientation was observed."""
    existence: float
    """Probability that it is an object at all."""
    class_posterior: dict[str, float]
    """Probability of each category; empty where none was reported."""
    latent: Float[np.ndarray, " d"] | None
    """Posterior mean of the shape latent from all views."""
    latent_variance: Float[np.ndarray, " d"] | None
    """Its variance."""
    size: Float[np.ndarray, " 3"] | None
    """Weighted mean extent, m."""
    detections: float
    """Sum of its association weights."""
    first_frame: int
    """First frame it was detected in."""
    last_frame: int
    """Last frame it was detected in."""

    @property
    def name(self) -> str:
        """Its name in files."""
        return f"L{self.index}"
