"""The generative model of a frame's detections (docs/em.md): clutter, objects of the map, objects the map does not hold.

Its parts are estimated from the drive itself (`frame_model_fit`): where detections lie, which share of them is false at which
range, how likely an object is detected where in the view, how much objects differ in that, and what a score says.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.special import betaln, expit, logsumexp

from nolbo_ppl.inference.slam.measurements import Measurements
from nolbo_ppl.inference.slam.noise.view_volume import widening
from nolbo_ppl.inference.slam.slam_problem import SlamConfig

CENTRES = 500
"""Detections the density of positions is made of."""
RANGES, AZIMUTHS = 5, 8
"""Cells of range (by quantiles) and azimuth (equal) that detection probabilities are learnt in."""
PROBABILITY_LIMITS = (0.02, 0.97)
"""Detection probabilities stay within these: a detector is never sure."""


@dataclass(frozen=True)
class FrameModel:
    """What is known of a frame before its detections are seen."""

    centre: Float[np.ndarray, "c 3"]
    """Positions that detections were seen at, m in the camera frame, divided by `spread`."""
    spread: Float[np.ndarray, "3 3"]
    """Root of the covariance of positions, m."""
    per_frame: float
    """Detections a frame."""
    range_edges: Float[np.ndarray, " r+1"]
    """Cells of range, m."""
    azimuth_edges: Float[np.ndarray, " a+1"]
    """Cells of azimuth, rad."""
    elevation_limits: tuple[float, float]
    """Elevations objects are seen at, rad."""
    clutter_share: Float[np.ndarray, "r a"]
    """Share of false detections by range and azimuth: false ones are everywhere, objects stand beside the road."""
    detection_probability: Float[np.ndarray, "r a"]
    """Probability that an object in a cell is detected."""
    stated_share: float = 0.1
    """Share of false detections by the stated objectness."""
    concentration: float = 16.0
    """How alike objects are: detection probabilities of objects are beta with this total count."""
    unmapped: float = 1.0
    """Objects seen once over their expected number."""
    score_slope: float = 1.0
    """Log likelihood ratio of a score (object over clutter) by its log odds."""
    score_offset: float = 0.0
    """Its constant part."""
    score_correlation: float = 0.0
    """Correlation of the scores of one object: looks of one network are alike."""
    clutter_intensity: float | None = None
    """Stated clutter intensity, per m^3 and frame."""
    birth_intensity: float | None = None
    """Stated intensity of objects not in the map, per m^3."""

    def log_detection_density(self, position: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Log of the expected number of detections per m^3 and frame at positions in the camera frame."""
        white = np.linalg.solve(self.spread, position.T).T
        count = len(self.centre)
        bandwidth = count ** (-1.0 / 7.0)  # Silverman's rate in three dimensions
        out = np.empty(len(position))
        for start in range(0, len(position), 2000):
            part = slice(start, start + 2000)
            square = np.sum((white[part, None] - self.centre[None]) ** 2, axis=2)
            out[part] = logsumexp(-0.5 * square / bandwidth**2, axis=1)
        out -= np.log(count) + 1.5 * np.log(2 * np.pi * bandwidth**2) + np.linalg.slogdet(self.spread)[1]
        return out + np.log(self.per_frame)

    def range_cell(self, position: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
        """Cell of range of each position, the nearest one where it is outside."""
        distance = np.linalg.norm(position, axis=1)
        return np.clip(np.searchsorted(self.range_edges, distance, side="right") - 1, 0, len(self.range_edges) - 2)

    def nearest_cell(self, position: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
        """Cell of range and azimuth of each position, the nearest one where it is outside of the view."""
        columns = len(self.azimuth_edges) - 1
        azimuth = np.arctan2(position[:, 0], position[:, 2])
        column = np.clip(np.searchsorted(self.azimuth_edges, azimuth, side="right") - 1, 0, columns - 1)
        return self.range_cell(position) * columns + column

    def cell(self, position: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
        """Cell of the view of each position in the camera frame, -1 outside of it."""
        x, y, z = position.T
        azimuth, elevation = np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))
        distance = np.linalg.norm(position, axis=1)
        column = np.searchsorted(self.azimuth_edges, azimuth, side="right") - 1
        columns = len(self.azimuth_edges) - 1
        inside = (column >= 0) & (column < columns) & (distance >= self.range_edges[0]) & (distance <= self.range_edges[-1])
        inside &= (elevation >= self.elevation_limits[0]) & (elevation <= self.elevation_limits[1])
        return np.where(inside, self.range_cell(position) * columns + column, -1)

    def probability(self, position: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Detection probability of objects at positions in the camera frame; 0 out of view."""
        cell = self.cell(position)
        return np.where(cell >= 0, self.detection_probability.ravel()[np.maximum(cell, 0)], 0.0)

    def log_score_ratio(self, measurements: Measurements) -> Float[np.ndarray, " n"]:
        """Log likelihood ratio of each score, object over clutter."""
        return self.score_slope * (measurements.log_object - measurements.log_clutter) + self.score_offset

    def log_clutter(self, measurements: Measurements, log_density: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Log density of clutter at each detection, per m^3 and frame.

        Args:
            measurements: in camera frames.
            log_density: `log_detection_density` of their positions. It is the costly part, and no M-step changes it.
        """
        if self.clutter_intensity is not None:
            return np.full(len(measurements), np.log(self.clutter_intensity))
        return np.log(self.clutter_share.ravel()[self.nearest_cell(measurements.position)]) + log_density

    def log_objects(self, measurements: Measurements, log_density: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Log density of detections of objects at each detection, per m^3 and frame; arguments as of `log_clutter`."""
        return np.log1p(-self.clutter_share.ravel()[self.nearest_cell(measurements.position)]) + log_density

    def log_pattern(
        self, hits: Float[np.ndarray, " m"], exposures: Float[np.ndarray, " m"], mean: Float[np.ndarray, " m"]
    ) -> Float[np.ndarray, " m"]:
        """Log probability that an object in view in so many frames is detected in just these `hits` of them (beta-binomial)."""
        p = np.clip(mean, *PROBABILITY_LIMITS)
        a, b = self.concentration * p, self.concentration * (1 - p)
        return betaln(a + hits, b + np.maximum(exposures - hits, 0.0)) - betaln(a, b)


def initial_frame_model(measurements: Measurements, config: SlamConfig, frames: int) -> FrameModel:
    """The model before any association: where detections lie; objectness says which share is false.

    Args:
        measurements: in camera frames.
        config: stated rates and the field of view.
        frames: number of frames of the drive, empty ones too.
    """
    seen, n = measurements, len(measurements)
    centre = seen.position[:: max(n // CENTRES, 1)] if n else np.zeros((1, 3))
    # An axis along which nothing varies (a flat world) is as wide as its measurement.
    covariance = np.cov(seen.position.T) if n > 3 else np.eye(3) * 100.0
    floor = seen.covariance.mean(axis=0) if n else np.eye(3)
    value, axes = np.linalg.eigh(covariance)
    value = np.maximum(value, np.einsum("ia,ij,ja->a", axes, floor, axes))
    spread = axes * np.sqrt(value) * widening(seen.position)
    distance = np.linalg.norm(seen.position, axis=1) if n else np.array([1.0])
    edges = np.quantile(distance, np.linspace(0, 1, RANGES + 1))
    edges = np.maximum.accumulate(edges + 1e-9 * np.arange(RANGES + 1) * max(edges[-1], 1.0))
    x, y, z = seen.position.T if n else np.ones((3, 1))
    azimuth, elevation = np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))
    low, high = azimuth.min() - 1e-6, azimuth.max() + 1e-6
    bottom, top = elevation.min() - 1e-6, elevation.max() + 1e-6
    if config.field_of_view is not None:
        low, high = -0.5 * config.field_of_view[0], 0.5 * config.field_of_view[0]
        bottom, top = -0.5 * config.field_of_view[1], 0.5 * config.field_of_view[1]
    # On average objectness is right: its prior share of false ones.
    false = float(np.mean(expit(-(seen.log_object - seen.log_clutter)))) if n else 0.1
    return FrameModel(
        centre=np.linalg.solve(spread, centre.T).T,
        spread=spread,
        per_frame=max(n, 1) / max(frames, 1),
        range_edges=edges,
        azimuth_edges=np.linspace(low, high, AZIMUTHS + 1),
        elevation_limits=(float(bottom), float(top)),
        clutter_share=np.full((RANGES, AZIMUTHS), np.clip(false, 0.01, 0.9)),
        detection_probability=np.full((RANGES, AZIMUTHS), 0.7),
        stated_share=float(np.clip(false, 0.01, 0.9)),
        clutter_intensity=config.clutter_intensity,
        birth_intensity=config.birth_intensity,
    )
