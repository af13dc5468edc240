"""The space that detections come from, in the camera frame: what rates a cubic metre are rates of."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from nolbo_ppl.structures.detections import Detections

FLAT_WORLD = 0.1
"""Least thickness of the observed space, as a part of its extent: a density per m^3 of a plane is no rate."""
MIN_REACH = 0.25
"""Least standard deviation of where detections come from, as a part of their range: a camera that circles one object sees it at
one and the same place, which says nothing of false detections falling just there."""


def view_volume(table: Detections) -> float:
    """Volume detections come from, m^3: that of the ellipsoid uniform points of this covariance would fill."""
    if len(table) < 5:
        return 1000.0
    extent = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(table.position.T)), 0.0))
    extent = np.maximum(extent, max(FLAT_WORLD * float(extent[-1]), 1e-3))
    return float(4.0 / 3.0 * np.pi * 5.0**1.5 * np.prod(extent)) * widening(table.position) ** 3


def widening(position: Float[np.ndarray, "n 3"]) -> float:
    """Factor, 1 or more, that brings the largest spread of positions in the camera frame to `MIN_REACH` of their range."""
    if len(position) < 2:
        return 1.0
    largest = float(np.sqrt(max(np.linalg.eigvalsh(np.cov(position.T))[-1], 0.0)))
    return max(1.0, MIN_REACH * float(np.linalg.norm(position, axis=1).mean()) / max(largest, 1e-3))
