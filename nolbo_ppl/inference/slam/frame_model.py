"""The generative model of a frame's detections (docs/em.md): clutter, objects of the map, objects the map does not hold.

Its parts are estimated from the drive itself: where detections lie, which share of them is false at which range, how
likely an object is detected where in the view, how much objects differ in that, and what a score says. The E-step's
marginals are the sufficient statistics; `estimate_frame_model` is the M-step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.special import betaln, expit, logsumexp

from nolbo_ppl.geometry.pose import inverse, transform
from nolbo_ppl.inference.slam.measurements import Measurements
from nolbo_ppl.inference.slam.noise.view_volume import widening
from nolbo_ppl.inference.slam.slam_problem import SlamConfig

CENTRES = 500
"""Detections the density of positions is made of."""
RANGES, AZIMUTHS = 5, 8
"""Cells of range (by quantiles) and azimuth (equal) that detection probabilities are learnt in."""
PRIOR_COUNT = 4.0
"""Weight of the mean over all cells in each cell, in detections."""
CHUNK_CELLS = 1 << 21
"""Numbers of a matrix of frames and points that are held at a time."""
PROBABILITY_LIMITS = (0.02, 0.97)
"""Detection probabilities stay within these: a detector is never sure."""
CONCENTRATIONS = np.array([2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0])
"""Values tried for how alike objects are in their detection probability (of a beta distribution)."""
SHARE_COUNT = 20.0
"""Weight of the share of false detections that objectness states, in detections: a small drive has no other anchor."""
OFFSET_SCALE = 0.7
"""Standard deviation of the prior on the score's constant: calibrated objectness has none. Without it the share of false
detections and the constant drive each other on: all of a drive of 40 detections became clutter, 19 true ones at 0.9 with it."""
SLOPE_SCALE = 0.5
"""Standard deviation of the prior on the log of the score's slope: calibrated objectness has slope 1."""


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


@dataclass(frozen=True)
class Exposures:
    """How often points of the world are in view, by cell of the view.

    Counts, and not one entry for each point and frame: those grow with the square of the laps (36 million, 0.9 GB, for 100 000
    detections on twelve laps).
    """

    count: Int[np.ndarray, "m c"]
    """Frames in which each point is in each cell."""

    def totals(self, model: FrameModel) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
        """Number of exposures of each point and its mean detection probability over them."""
        number = self.count.sum(axis=1).astype(np.float64)
        return number, self.count @ model.detection_probability.ravel() / np.maximum(number, 1.0)

    def by_cell(self, weight: Float[np.ndarray, " m"]) -> Float[np.ndarray, " c"]:
        """Exposures in each cell, every point by its weight."""
        return weight @ self.count


def exposures_of(model: FrameModel, T_world_camera: Float[np.ndarray, "n 4 4"], point: Float[np.ndarray, "m 3"]) -> Exposures:
    """How often points of the world are in view, over all frames."""
    reach, cells = float(model.range_edges[-1]), model.detection_probability.size
    count = np.zeros((len(point), cells), dtype=np.int32)
    T_camera_world = inverse(T_world_camera)
    chunk = int(np.clip(CHUNK_CELLS // max(len(point), 1), 1, 128))
    for start in range(0, len(T_world_camera) if len(point) else 0, chunk):
        centre = T_world_camera[start : start + chunk, :3, 3]
        square = np.sum(centre**2, axis=1)[:, None] + np.sum(point**2, axis=1)[None] - 2 * centre @ point.T
        t, j = np.nonzero(square <= reach**2)
        cell = model.cell(transform(T_camera_world[start + t], point[j]))
        inside = cell >= 0
        np.add.at(count, (j[inside], cell[inside]), 1)
    return Exposures(count)


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


def estimate_frame_model(
    model: FrameModel,
    measurements: Measurements,
    background: Float[np.ndarray, " n"],
    new: Float[np.ndarray, " n"],
    expected_new: Float[np.ndarray, " n"],
    exposures: Exposures,
    detection_exposures: Exposures,
    hit_cell: Int[np.ndarray, " p"],
    hit_weight: Float[np.ndarray, " p"],
    existence: Float[np.ndarray, " m"],
    hits: Float[np.ndarray, " m"],
) -> FrameModel:
    """The M-step: every part of the model given the marginals of the E-step.

    Args:
        model: the model the marginals were computed with.
        measurements: in camera frames.
        background: probability of each detection being false.
        new: probability of each being an object the map does not hold.
        expected_new: probability that an object detected there is detected only there.
        exposures: of the map's landmarks.
        detection_exposures: of the places of all detections: what the map does not hold was in view as well.
        hit_cell: cell of the view of each pair of detection and landmark, -1 outside.
        hit_weight: its marginal.
        existence: of each landmark.
        hits: summed marginals of each landmark.
    """
    cells = model.detection_probability.size
    # Objects that were never detected were in view too: for each of the others, P(never) / P(once or more) of them.
    number, chance = exposures.totals(model)
    mapped = existence * _with_unseen(model, number, chance)
    seen = exposures.by_cell(mapped)
    once = new * _with_unseen(model, *detection_exposures.totals(model))
    seen = seen + detection_exposures.by_cell(once)
    hit = np.bincount(hit_cell[hit_cell >= 0], hit_weight[hit_cell >= 0], minlength=cells).astype(np.float64)
    own_cell = model.cell(measurements.position)
    hit += np.bincount(own_cell[own_cell >= 0], new[own_cell >= 0], minlength=cells)
    mean = (hit.sum() + 1.4) / (seen.sum() + 2.0)
    by_range = hit.reshape(RANGES, -1).sum(1) + PRIOR_COUNT * mean, seen.reshape(RANGES, -1).sum(1) + PRIOR_COUNT
    prior = np.repeat(by_range[0] / by_range[1], AZIMUTHS)
    probability = np.clip((hit + PRIOR_COUNT * prior) / (seen + PRIOR_COUNT), *PROBABILITY_LIMITS)
    which = model.nearest_cell(measurements.position)
    count, false = (np.bincount(which, w, minlength=cells).reshape(RANGES, -1) for w in (np.ones(len(which)), background))
    overall = (background.sum() + SHARE_COUNT * model.stated_share) / (len(background) + SHARE_COUNT)
    at_range = (false.sum(1) + PRIOR_COUNT * overall) / (count.sum(1) + PRIOR_COUNT)
    share = (false + PRIOR_COUNT * at_range[:, None]) / (count + PRIOR_COUNT)
    slope, offset = _fit_score(model, measurements, background, overall)
    model = replace(
        model,
        detection_probability=probability.reshape(RANGES, AZIMUTHS),
        clutter_share=np.clip(share, 1e-3, 0.999),
        unmapped=float((new.sum() + PRIOR_COUNT) / (np.sum(expected_new * (1 - background)) + PRIOR_COUNT)),
        score_slope=slope,
        score_offset=offset,
    )
    number, chance = exposures.totals(model)
    return replace(model, concentration=_fit_concentration(model, hits, np.maximum(number, hits), chance, existence))


def _with_unseen(model: FrameModel, number: np.ndarray, chance: np.ndarray) -> np.ndarray:
    """One over the probability of being detected at all, at most 3."""
    never = np.exp(model.log_pattern(np.zeros(len(number)), number, chance))
    return 1.0 / np.maximum(1.0 - never, 1.0 / 3.0)


def _fit_concentration(
    model: FrameModel, hits: np.ndarray, number: np.ndarray, chance: np.ndarray, existence: np.ndarray
) -> float:
    """Likeliest concentration, given that landmarks are what was detected twice or more."""
    use = (number >= 3) & (hits >= 1.5)
    if use.sum() < 5:
        return model.concentration
    value = []
    for concentration in CONCENTRATIONS:
        m = replace(model, concentration=float(concentration))
        none = m.log_pattern(np.zeros(use.sum()), number[use], chance[use])
        once = m.log_pattern(np.ones(use.sum()), number[use], chance[use]) + np.log(number[use])
        twice = np.log(np.maximum(1 - np.exp(none) - np.exp(once), 1e-6))
        value.append(float(existence[use] @ (m.log_pattern(hits[use], number[use], chance[use]) - twice)))
    return float(CONCENTRATIONS[int(np.argmax(value))])


def _fit_score(model: FrameModel, measurements: Measurements, background: np.ndarray, clutter: float) -> tuple[float, float]:
    """Slope and constant of the score's log likelihood ratio: logistic regression on the marginals, by Newton's method.

    The density ratio of scores is an exponential tilt, so that the posterior given the score alone is logistic in its
    log odds. The log of the slope and the constant have normal priors about 0: calibrated objectness has slope 1 and no constant.
    """
    x = measurements.log_object - measurements.log_clutter
    if len(x) < 30 or np.ptp(x) < 1e-6:
        return 1.0, 0.0
    y = 1.0 - background
    base = float(np.log((1 - clutter) / clutter))
    log_slope, constant = np.log(model.score_slope), model.score_offset + base
    for _ in range(20):
        slope = np.exp(log_slope)
        p = expit(slope * x + constant)
        residual, curvature = y - p, p * (1 - p) + 1e-9
        gradient = np.array(
            [slope * (residual @ x) - log_slope / SLOPE_SCALE**2, residual.sum() - (constant - base) / OFFSET_SCALE**2]
        )
        a, b, c = slope**2 * (curvature @ x**2) + 1 / SLOPE_SCALE**2, slope * (curvature @ x), curvature.sum()
        c += 1 / OFFSET_SCALE**2
        step = np.linalg.solve(np.array([[a, b], [b, c]]) + 1e-9 * np.eye(2), gradient)
        step *= min(1.0, 1.0 / max(np.abs(step).max(), 1e-12))
        log_slope, constant = float(np.clip(log_slope + step[0], -3, 3)), float(constant + step[1])
        if np.abs(step).max() < 1e-6:
            break
    return float(np.exp(log_slope)), constant - base
