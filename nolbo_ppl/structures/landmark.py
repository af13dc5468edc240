"""One object of a map: pose, existence, class, shape latent, each with its uncertainty; NaN or -1 where a file says nothing."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

SURE_EXISTENCE = 0.5
"""A landmark of less existence is more likely background."""
MIN_DETECTIONS = 0.5
"""A landmark with less weight of detections is one that in the end nothing is associated with."""


def _unknown(*shape: int) -> np.ndarray:
    return np.full(shape, np.nan)


@dataclass(frozen=True)
class Landmark:
    """One object of the map, as SLAM finds it and as `landmarks.json` holds it.

    >>> mug = Landmark("L0", np.eye(4), class_posterior={"bottle": 0.2, "mug": 0.8}, existence=0.9)
    >>> mug.category, mug.in_map, mug.size is None
    ('mug', True, True)
    """

    name: str
    """Its name in files: any text, `L0`, `L1`, ... by SLAM."""
    T_world_object: Float[np.ndarray, "4 4"]
    """Pose; the rotation is meaningful where `oriented`, upright otherwise when it was read from a file."""
    covariance: Float[np.ndarray, "6 6"] = field(default_factory=lambda: _unknown(6, 6))
    """Covariance of [rotation rad, position m] in the object's own frame, the first camera pose held fixed."""
    position_covariance: Float[np.ndarray, "3 3"] = field(default_factory=lambda: _unknown(3, 3))
    """Covariance of the position in the world frame, m^2."""
    oriented: bool = False
    """Whether an orientation was observed."""
    existence: float = np.nan
    """Probability that it is an object at all."""
    class_posterior: dict[str, float] = field(default_factory=dict)
    """Probability of each category; empty where none was reported."""
    latent: Float[np.ndarray, " d"] | None = None
    """Posterior mean of the shape latent from all views."""
    latent_variance: Float[np.ndarray, " d"] | None = None
    """Its variance."""
    size: Float[np.ndarray, " 3"] | None = None
    """Weighted mean extent, m."""
    detections: float = np.nan
    """Sum of its association weights."""
    first_frame: int = -1
    """First frame it was detected in."""
    last_frame: int = -1
    """Last frame it was detected in."""
    category: str | None = None
    """Most probable category; that of `class_posterior` where it is not given."""
    index: int = -1
    """Its number in the graph of SLAM; -1 when it was read from a file."""

    def __post_init__(self) -> None:
        if self.category is None and self.class_posterior:
            object.__setattr__(self, "category", max(self.class_posterior, key=lambda name: self.class_posterior[name]))

    @property
    def position(self) -> Float[np.ndarray, " 3"]:
        """Position in the world, m."""
        return self.T_world_object[:3, 3]

    @property
    def frames(self) -> tuple[int, int] | None:
        """First and last frame it was seen in, where they are known."""
        return None if min(self.first_frame, self.last_frame) < 0 else (self.first_frame, self.last_frame)

    @property
    def diagonal(self) -> float | None:
        """Diagonal of its box, m: the unit of the canonical frame."""
        return None if self.size is None else float(np.linalg.norm(self.size))

    @property
    def spread(self) -> float:
        """Root of the largest eigenvalue of the position's covariance, m; NaN where it is not known."""
        if not np.isfinite(self.position_covariance).all():
            return np.nan
        return float(np.sqrt(max(np.linalg.eigvalsh(self.position_covariance)[-1], 0.0)))

    @property
    def likely(self) -> bool:
        """More likely an object than not, as far as is known."""
        return not self.existence < SURE_EXISTENCE

    @property
    def in_map(self) -> bool:
        """Part of the map: likely, and not without detections."""
        return self.likely and not self.detections < MIN_DETECTIONS
