"""Calibration: expected calibration error, reliability, coverage of posterior regions, proper scores on the circle.

Coverage takes region masses: the posterior probability of all points with a density above that at the truth. For a
calibrated posterior the mass is uniform on [0, 1], so that it is at most 0.9 for 90 % of the truths.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import gammainc

from nolbo_ppl.errors import input_error
from nolbo_ppl.metrics.statistics import ratio

BINS = 15
"""Bins of equal width of the expected calibration error (Guo et al. 2017)."""


@dataclass(frozen=True)
class Reliability:
    """What a reliability diagram shows."""

    edges: Float[np.ndarray, " bins_and_one"]
    confidence: Float[np.ndarray, " bins"]
    """Mean stated probability in each bin; NaN in an empty one."""
    frequency: Float[np.ndarray, " bins"]
    """Share that was right; NaN in an empty bin."""
    count: Int[np.ndarray, " bins"]


def _bins(confidence: Float[np.ndarray, " n"], outcome: Bool[np.ndarray, " n"], bins: int) -> Int[np.ndarray, " n"]:
    confidence = np.asarray(confidence, dtype=np.float64)
    if confidence.shape != np.shape(outcome) or confidence.ndim != 1:
        raise input_error("confidences", got=(confidence.shape, np.shape(outcome)), expected="one outcome for each")
    outside = ~((confidence >= 0) & (confidence <= 1))
    if outside.any():
        raise input_error("confidence", got=confidence[outside][0], expected="in [0, 1]")
    if bins < 1:
        raise input_error("bins of a calibration error", got=bins, expected="at least 1")
    return np.minimum((confidence * bins).astype(np.int64), bins - 1)


def expected_calibration_error(
    confidence: Float[np.ndarray, " n"],
    outcome: Bool[np.ndarray, " n"],
    weight: Float[np.ndarray, "b n"] | None = None,
    bins: int = BINS,
) -> Float[np.ndarray, " b"]:
    """`sum_bins (n_bin / n) |frequency - confidence|` over bins of equal width (Guo et al. 2017, eq. 3).

    For a binary event (objectness) the confidence is its probability and the outcome whether it happened; for several
    classes the top probability and whether that class was right (`top_label`).

    Args:
        confidence: stated probabilities.
        outcome: whether they came true.
        weight: how often each counts, one value of the result a row; once, when not given.
        bins: number of bins.

    Raises:
        InputError: a confidence outside [0, 1], shapes that do not match, no bin.
    """
    index = _bins(confidence, outcome, bins)
    weight = np.ones((1, len(index))) if weight is None else weight
    # |sum over a bin of (outcome - confidence)| is the bin's count times the gap of its means.
    gap = np.stack(
        [np.abs(weight[:, index == k] @ (np.asarray(outcome, dtype=np.float64) - confidence)[index == k]) for k in range(bins)]
    )
    return ratio(gap.sum(0), weight.sum(1))


def reliability(confidence: Float[np.ndarray, " n"], outcome: Bool[np.ndarray, " n"], bins: int = BINS) -> Reliability:
    """Mean confidence and frequency of each bin. Raises as `expected_calibration_error`."""
    index = _bins(confidence, outcome, bins)
    count = np.bincount(index, minlength=bins)
    return Reliability(
        edges=np.linspace(0, 1, bins + 1),
        confidence=ratio(np.bincount(index, weights=confidence, minlength=bins), count),
        frequency=ratio(np.bincount(index, weights=outcome, minlength=bins), count),
        count=count,
    )


def top_label(
    posterior: Float[np.ndarray, "n labels"], truth: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Probability of the most probable label, and whether it is the true one."""
    best = posterior.argmax(1)
    # Rounding may carry a normalised probability a few units past one.
    return np.minimum(np.take_along_axis(posterior, best[:, None], 1)[:, 0], 1.0), best == truth


def coverage(region_mass: Float[np.ndarray, " n"], level: float = 0.9) -> float:
    """Share of truths inside the posterior region of probability `level`.

    Raises:
        InputError: no truth, a mass outside [0, 1], or a level outside (0, 1).
    """
    mass = np.asarray(region_mass, dtype=np.float64)
    if not len(mass) or not ((mass >= 0) & (mass <= 1)).all():
        got = f"{len(mass)} beginning with {mass[:4].tolist()}"
        raise input_error("masses of posterior regions", got=got, expected="at least one, in [0, 1]")
    if not 0 < level < 1:
        raise input_error("level of a region", got=level, expected="a number in (0, 1)")
    return float((mass <= level).mean())


def chi_square_mass(
    difference: Float[np.ndarray, "n d"], covariance: Float[np.ndarray, "n d d"] | Float[np.ndarray, "n d"]
) -> Float[np.ndarray, " n"]:
    """Mass of a Gaussian's region that reaches out to the truth: chi-square distribution of the Mahalanobis distance.

    Args:
        difference: truth minus posterior mean.
        covariance: covariance matrices, or the variances where they are diagonal.

    Raises:
        InputError: shapes do not match, or a covariance is not positive definite.
    """
    difference, covariance = np.asarray(difference, dtype=np.float64), np.asarray(covariance, dtype=np.float64)
    n, d = difference.shape
    if covariance.shape == (n, d):
        if not (covariance > 0).all():
            raise input_error("variance", got=covariance.min(), expected="a positive number")
        distance = (difference**2 / covariance).sum(1)
    elif covariance.shape == (n, d, d):
        try:
            half = np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError:
            raise input_error("covariance", got="a matrix that is not positive definite") from None
        distance = (np.linalg.solve(half, difference[..., None])[..., 0] ** 2).sum(1)
    else:
        raise input_error("covariance", got=covariance.shape, expected=f"({n}, {d}, {d}) or ({n}, {d})")
    mass: np.ndarray = gammainc(d / 2, distance / 2)
    return mass


def circular_crps(log_density: Float[np.ndarray, "n nodes"], truth: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Continuous ranked probability score on the circle in rad (Grimit et al. 2006, eq. 7); less is better.

    `E a(V, v) - E a(V, V') / 2` with the angular distance a, V and V' independent draws of the posterior, v the truth.

    Args:
        log_density: posterior log density at the angles `-pi + 2 pi k / nodes`.
        truth: true angles, rad.

    Raises:
        InputError: fewer than 8 nodes, or shapes that do not match.
    """
    log_density, truth = np.asarray(log_density, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    if log_density.ndim != 2 or log_density.shape[0] != len(truth) or log_density.shape[1] < 8:
        raise input_error("densities on the circle", got=log_density.shape, expected=f"({len(truth)}, at least 8)")
    nodes = log_density.shape[1]
    mass = np.exp(log_density - log_density.max(1, keepdims=True))
    mass /= mass.sum(1, keepdims=True)
    angle = -np.pi + 2 * np.pi * np.arange(nodes) / nodes
    to_truth = (mass * angular_distance(angle, truth[:, None])).sum(1)
    # The distribution of V - V' on the nodes is the circular autocorrelation of the masses.
    lag = np.fft.irfft(np.abs(np.fft.rfft(mass, axis=1)) ** 2, nodes, axis=1)
    spread = lag @ angular_distance(2 * np.pi * np.arange(nodes) / nodes, np.zeros(1))
    score: np.ndarray = to_truth - spread / 2
    return score


def angular_distance(a: Float[np.ndarray, "*#n"], b: Float[np.ndarray, "*#n"]) -> Float[np.ndarray, "*n"]:
    """Length of the shorter arc between two angles, rad."""
    distance: np.ndarray = np.abs(np.remainder(np.asarray(a) - b + np.pi, 2 * np.pi) - np.pi)
    return distance
