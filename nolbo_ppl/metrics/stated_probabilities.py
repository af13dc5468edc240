"""Stated probabilities beside what happened: reliability in joined bins, proper scores, calibration error less its own noise,
and probability integral transforms of regions at several levels.

A calibration error is a mean of absolute gaps: it is above zero for a perfect forecaster too, by noise alone, and the more bins
and the fewer cases the more. It is never reported here without its value under perfect calibration.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import kstest

from nolbo_ppl.errors import input_error
from nolbo_ppl.metrics.calibration import BINS, expected_calibration_error

LEVELS = (0.5, 0.68, 0.9, 0.95, 0.99)
"""Levels of regions whose coverage is reported."""
Outcomes = Bool[np.ndarray, " n"] | Float[np.ndarray, " n"]
"""Whether each thing happened, or 1 and 0."""
MIN_IN_BIN = 50
"""Bins of a reliability table with fewer cases are joined to the next."""
LIMIT = 1e-6
"""Probabilities are kept this far from zero and one in a log score: one mistake at certainty costs 13.8 nats."""


@dataclass(frozen=True)
class ReliabilityBin:
    """Cases of nearly one stated probability."""

    stated: float
    """Their mean stated probability."""
    happened: float
    """The share that happened."""
    count: int
    """How many they are."""


def _checked(stated: np.ndarray, happened: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    stated, happened = np.asarray(stated, dtype=np.float64), np.asarray(happened, dtype=np.float64)
    if stated.ndim != 1 or stated.shape != happened.shape:
        raise input_error("stated probabilities", got=(stated.shape, happened.shape), expected="one outcome for each")
    if not ((stated >= 0) & (stated <= 1)).all():
        raise input_error("stated probability", got=stated[~((stated >= 0) & (stated <= 1))][0], expected="in [0, 1]")
    return stated, happened


def log_score(stated: Float[np.ndarray, " n"], happened: Outcomes) -> float:
    """Mean negative log probability of what happened, nats; less is better.

    Raises:
        InputError: shapes do not match, or a probability is outside [0, 1].

    Example:
        >>> round(log_score(np.array([0.5, 0.5]), np.array([True, False])), 4)
        0.6931
    """
    p, y = _checked(stated, happened)
    p = np.clip(p, LIMIT, 1 - LIMIT)
    return float(-np.mean(np.where(y > 0.5, np.log(p), np.log1p(-p)))) if len(p) else float("nan")


def reliability_bins(
    stated: Float[np.ndarray, " n"], happened: Outcomes, bins: int = 10, least: int = MIN_IN_BIN
) -> tuple[ReliabilityBin, ...]:
    """Bins of equal width, those of fewer than `least` cases joined to the next.

    What is left at the end with fewer than `least` cases is left out, unless it is all there is.

    Raises:
        InputError: as `log_score`.
    """
    p, y = _checked(stated, happened)
    which = np.minimum((p * bins).astype(np.int64), bins - 1)
    out: list[ReliabilityBin] = []
    rest = np.zeros(len(p), dtype=bool)
    for b in range(bins):
        rest |= which == b
        if rest.sum() >= least:
            out.append(ReliabilityBin(float(p[rest].mean()), float(y[rest].mean()), int(rest.sum())))
            rest[:] = False
    if rest.any() and not out:
        out.append(ReliabilityBin(float(p[rest].mean()), float(y[rest].mean()), int(rest.sum())))
    return tuple(out)


def reliability_gap(bins: tuple[ReliabilityBin, ...]) -> float:
    """Largest distance of what was stated from what happened over some bins; NaN without any."""
    return max((abs(b.stated - b.happened) for b in bins), default=float("nan"))


def null_calibration_error(
    confidence: Float[np.ndarray, " n"], rng: np.random.Generator, draws: int = 200, bins: int = BINS
) -> Float[np.ndarray, " draws"]:
    """Expected calibration errors of a perfect forecaster who states these confidences: outcomes drawn from them.

    What a calibration error of these cases has to be compared with: its mean is the error's bias, its quantiles say
    what noise explains. Outcomes are independent; where cases of one scene go together the true noise is larger.

    Raises:
        InputError: a confidence outside [0, 1].
    """
    p, _ = _checked(confidence, np.zeros(len(confidence)))
    return np.array([expected_calibration_error(p, rng.random(len(p)) < p, bins=bins)[0] for _ in range(draws)])


def debiased_calibration_error(confidence: Float[np.ndarray, " n"], outcome: Outcomes, bins: int = BINS) -> float:
    """Root of the squared calibration error less the part that noise makes (Bröcker 2012; Kumar et al. 2019, section 4).

    In each bin the squared gap of means is above its true value by the variance of the frequency, estimated without bias by
    `f (1 - f) / (n - 1)`. Zero where noise explains all; bins of one case tell nothing and are left out.

    Raises:
        InputError: as `log_score`.
    """
    p, y = _checked(confidence, outcome)
    which = np.minimum((p * bins).astype(np.int64), bins - 1)
    count = np.bincount(which, minlength=bins)
    use = count >= 2
    n = np.maximum(count, 1)
    frequency, stated = np.bincount(which, y, minlength=bins) / n, np.bincount(which, p, minlength=bins) / n
    square = (frequency - stated) ** 2 - frequency * (1 - frequency) / np.maximum(count - 1, 1)
    total = count[use].sum()
    return float(np.sqrt(max(np.sum((count * square)[use]) / total, 0.0))) if total else float("nan")


def _or_none(value: float) -> float | None:
    """A number as JSON holds it: None where there is none."""
    return value if np.isfinite(value) else None


def probability_record(stated: Float[np.ndarray, " n"], happened: Outcomes) -> dict[str, Any]:
    """All of this for one kind of probability, as JSON holds it; what so few cases do not tell is None.

    Example:
        >>> p = np.repeat([0.2, 0.8], 100)
        >>> record = probability_record(p, np.arange(200) % 100 < np.repeat([20, 80], 100))
        >>> record["gap"] < 1e-9, record["count"], record["debiased_error"]
        (True, 200, 0.0)
    """
    p, y = _checked(stated, happened)
    if not len(p):
        return {"count": 0}
    bins = reliability_bins(p, y)
    null = null_calibration_error(p, np.random.default_rng(0))
    return {
        "count": len(p),
        "stated": float(p.mean()),
        "happened": float(y.mean()),
        "log_score": log_score(p, y),
        "brier": float(np.mean((p - y) ** 2)),
        "gap": _or_none(reliability_gap(bins)),
        "calibration_error": float(expected_calibration_error(p, y > 0.5)[0]),
        "calibration_error_if_perfect": float(null.mean()),
        "debiased_error": _or_none(debiased_calibration_error(p, y > 0.5)),
        "bins": [[b.stated, b.happened, b.count] for b in bins],
    }


def coverages(mass: Float[np.ndarray, " n"], levels: tuple[float, ...] = LEVELS) -> dict[str, float]:
    """Share of truths inside the region of each level, by its percentage.

    Args:
        mass: mass of the posterior region that reaches to each truth (`metrics.calibration`).
        levels: levels in (0, 1).
    """
    mass = np.asarray(mass, dtype=np.float64)
    return {f"{100 * level:g}": float((mass <= level).mean()) for level in levels} if len(mass) else {}


def region_record(
    mass: Float[np.ndarray, " n"], squared: Float[np.ndarray, " n"] | None = None, degrees: int = 1
) -> dict[str, Any]:
    """Probability integral transforms of regions: coverage at all levels, a histogram, the distance from uniform, NEES.

    Args:
        mass: mass of the region that reaches to each truth, uniform where the posterior holds; NaN is left out.
        squared: normalised squared errors, where they are at hand.
        degrees: their degrees of freedom.

    Example:
        >>> region_record(np.linspace(0.005, 0.995, 100))["coverage"]["90"]
        0.9
    """
    known = np.isfinite(mass)
    mass = np.asarray(mass, dtype=np.float64)[known]
    if not len(mass):
        return {"count": 0}
    out: dict[str, Any] = {"count": len(mass)}
    if squared is not None:
        out["nees"] = _or_none(float(np.mean(np.asarray(squared)[known]) / degrees))
    out["coverage"] = coverages(mass)
    out["pit"] = (np.histogram(mass, bins=10, range=(0.0, 1.0))[0] / len(mass)).tolist()
    out["distance_from_uniform"] = float(kstest(mass, "uniform").statistic)
    return out
