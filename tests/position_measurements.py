"""Measurements of positions alone, for tests of what a score or a position does."""

from __future__ import annotations

import numpy as np

from nolbo_ppl.inference.slam.measurements import Measurements
from nolbo_ppl.inference.slam.orientation import OrientationModes


def position_measurements(
    position: np.ndarray, covariance: np.ndarray, log_odds: np.ndarray | float = 2.0, frame: np.ndarray | None = None
) -> Measurements:
    """Detections without orientation, latent and category, whose scores have these log likelihood ratios."""
    n = len(position)
    return Measurements(
        frame=np.zeros(n, np.int64) if frame is None else frame,
        position=position,
        covariance=covariance,
        shared_root=np.zeros((n, 3, 3)),
        oriented=np.zeros(n, bool),
        modes=OrientationModes(np.zeros((n, 1)), np.tile(np.eye(3), (n, 1, 1, 1)), np.ones((n, 1))),
        symmetry=np.ones(n, np.int64),
        latent=np.zeros((n, 0)),
        latent_variance=np.zeros((n, 0)),
        category=np.full(n, -1),
        log_object=np.broadcast_to(np.asarray(log_odds, dtype=float), (n,)).copy(),
        log_clutter=np.zeros(n),
    )
