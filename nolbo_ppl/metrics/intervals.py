"""95 % intervals: bootstrap over scenes for any statistic, Wilson's for proportions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nolbo_ppl.errors import input_error

Statistic = Callable[[Float[np.ndarray, "b scenes"]], Float[np.ndarray, " b"]]
"""A statistic as a function of how often each scene is in a resample; NaN where it is undefined."""

CHUNK = 64
"""Resamples evaluated at once: bounds the memory of statistics that hold a row of detections for each."""


@dataclass(frozen=True)
class IntervalEstimate:
    """A figure with its interval; None where there is nothing to measure."""

    value: float | None
    low: float | None
    high: float | None
    count: int
    """Objects behind the figure."""


def resample_weights(scenes: int, resamples: int, rng: np.random.Generator) -> Float[np.ndarray, "resamples scenes"]:
    """How often each scene is drawn in each bootstrap resample of as many scenes, with replacement.

    Raises:
        InputError: there is no scene or no resample.
    """
    if scenes < 1 or resamples < 1:
        raise input_error("nothing to resample", got=f"{scenes} scenes, {resamples} resamples", expected="at least 1")
    return rng.multinomial(scenes, np.full(scenes, 1 / scenes), size=resamples).astype(np.float64)


def estimate(
    statistic: Statistic,
    weights: Float[np.ndarray, "resamples scenes"],
    count: int,
    level: float = 0.95,
    pivotal: bool = False,
) -> IntervalEstimate:
    """The statistic of the scenes with its bootstrap interval (Efron & Tibshirani 1993, sections 13.3 and 12.5).

    Scenes are resampled, not objects: objects of one image share its light, camera and occlusion. Resamples in which
    the statistic is undefined (a category is missing) are left out.

    Args:
        statistic: the statistic.
        weights: how often each scene is in each resample.
        count: objects behind the figure.
        level: probability of the interval.
        pivotal: reflect the resampled quantiles about the value, not below zero: for a non-negative statistic that
            resampling biases upwards (a mean of absolute values), whose quantiles would lie above the value itself.

    Raises:
        InputError: `level` is not in (0, 1).
    """
    _check_level(level)
    value = float(statistic(np.ones((1, weights.shape[1])))[0])
    if not np.isfinite(value):
        return IntervalEstimate(None, None, None, count)
    parts = [statistic(weights[start : start + CHUNK]) for start in range(0, len(weights), CHUNK)]
    resampled = np.concatenate(parts)
    resampled = resampled[np.isfinite(resampled)]
    if not len(resampled):
        return IntervalEstimate(value, None, None, count)
    low, high = np.quantile(resampled, [(1 - level) / 2, (1 + level) / 2])
    if pivotal:
        low, high = max(2 * value - high, 0.0), max(2 * value - low, 0.0)
    return IntervalEstimate(value, float(low), float(high), count)


def wilson_interval(successes: int | float, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval of a proportion (Wilson 1927), for independent trials.

    Raises:
        InputError: no trial, more successes than trials, or `level` is not in (0, 1).
    """
    _check_level(level)
    if trials < 1 or not 0 <= successes <= trials:
        got = f"{successes} of {trials}"
        raise input_error("not a proportion", got=got, expected="0 <= successes <= trials, at least one trial")
    from scipy.special import ndtri

    z = float(ndtri((1 + level) / 2))
    share = successes / trials
    centre = (share + z * z / (2 * trials)) / (1 + z * z / trials)
    half = z / (1 + z * z / trials) * np.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    # At 0 and 1 the limits touch the ends; rounding must not carry them past the estimate.
    return float(min(max(centre - half, 0.0), share)), float(max(min(centre + half, 1.0), share))


def widened(estimate: IntervalEstimate, level: float = 0.95) -> IntervalEstimate:
    """A proportion's bootstrap interval, widened to Wilson's: the bootstrap has no width at 0 and 1."""
    if estimate.value is None or estimate.low is None or estimate.high is None:
        return estimate
    low, high = wilson_interval(estimate.value * estimate.count, estimate.count, level)
    return IntervalEstimate(estimate.value, min(low, estimate.low), max(high, estimate.high), estimate.count)


def _check_level(level: float) -> None:
    if not 0 < level < 1:
        raise input_error("level of an interval", got=level, expected="a number in (0, 1)")
