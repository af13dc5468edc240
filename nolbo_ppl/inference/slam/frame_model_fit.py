"""The M-step of the model of a frame: rates and detection probabilities given the marginals of the E-step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from scipy.special import expit

from nolbo_ppl.inference.slam.exposures import Exposures
from nolbo_ppl.inference.slam.frame_model import AZIMUTHS, PROBABILITY_LIMITS, RANGES, FrameModel
from nolbo_ppl.inference.slam.measurements import Measurements

PRIOR_COUNT = 4.0
"""Weight of the mean over all cells in each cell, in detections."""
SHARE_CELL_COUNT = 1.0
"""The same for the share of false detections, which is nearly 0 or 1 in most cells: objects stand there, or none do. With 4, a
cell of 30 false detections kept a twentieth for objects, and false ones of a good score became objects seen once."""
CONCENTRATIONS = np.array([2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0])
"""Values tried for how alike objects are in their detection probability (of a beta distribution)."""
SHARE_COUNT = 20.0
"""Weight of the share of false detections that objectness states, in detections: a small drive has no other anchor."""
OFFSET_SCALE = 0.7
"""Standard deviation of the prior on the score's constant: calibrated objectness has none. Without it the share of false
detections and the constant drive each other on: all of a drive of 40 detections became clutter, 19 true ones at 0.9 with it."""
SLOPE_SCALE = 0.5
"""Standard deviation of the prior on the log of the score's slope: calibrated objectness has slope 1."""


def estimate_frame_model(
    model: FrameModel,
    measurements: Measurements,
    background: Float[np.ndarray, " n"],
    new: Float[np.ndarray, " n"],
    expected_new: Float[np.ndarray, " n"],
    exposures: Exposures,
    places: Exposures,
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
        places: exposures of the places of all detections: what the map does not hold was in view as well.
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
    once = new * _with_unseen(model, *places.totals(model))
    seen = seen + places.by_cell(once)
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
    share = (false + SHARE_CELL_COUNT * at_range[:, None]) / (count + SHARE_CELL_COUNT)
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
