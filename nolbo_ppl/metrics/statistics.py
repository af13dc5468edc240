"""Weighted statistics of objects, one row of weights a resample: what the bootstrap over scenes evaluates.

A weight counts how often an object is in the resample; a row of ones gives the statistic of the data itself. A
statistic of nothing (all weights zero) is NaN, which `estimate` turns into an explicit "undefined".
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int, Real

Weights = Float[np.ndarray, "b n"]
"""How often each of n objects is in each of b resamples."""


def weighted_mean(value: Float[np.ndarray, " n"], weight: Weights) -> Float[np.ndarray, " b"]:
    """Mean of the values in each resample."""
    return ratio(weight @ np.asarray(value, dtype=np.float64), weight.sum(1))


def weighted_median(value: Float[np.ndarray, " n"], weight: Weights) -> Float[np.ndarray, " b"]:
    """Median of the values, each repeated `weight` (a whole number) times; the mean of the middle two when even."""
    value = np.asarray(value, dtype=np.float64)
    if not len(value):
        return np.full(len(weight), np.nan)
    order = np.argsort(value, kind="stable")
    cumulative = np.cumsum(weight[:, order], axis=1)
    total = cumulative[:, -1:]
    # The element at position p (from 0) of the repeated list is the first whose cumulative weight exceeds p.
    lower = np.argmax(cumulative > np.floor((total - 1) / 2), axis=1)
    upper = np.argmax(cumulative > np.floor(total / 2), axis=1)
    median = (value[order[lower]] + value[order[upper]]) / 2
    return np.where(total[:, 0] > 0, median, np.nan)


def by_group(
    statistic: Callable[[Float[np.ndarray, " m"], Weights], Float[np.ndarray, " b"]],
    value: Float[np.ndarray, " n"],
    group: Int[np.ndarray, " n"],
    groups: int,
    weight: Weights,
) -> Float[np.ndarray, "b groups"]:
    """The statistic of each group's objects; NaN for a group without any in a resample."""
    return (
        np.stack([statistic(value[group == g], weight[:, group == g]) for g in range(groups)], axis=1)
        if groups
        else np.empty((len(weight), 0))
    )


def mean_of_defined(value: Float[np.ndarray, "b groups"]) -> Float[np.ndarray, " b"]:
    """Mean over the groups that are defined in each resample; NaN when none is."""
    defined = np.isfinite(value)
    return ratio(np.where(defined, value, 0.0).sum(1), defined.sum(1))


def ratio(numerator: Real[np.ndarray, "*n"], denominator: Real[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Quotient, NaN (without a warning) where the denominator is zero."""
    safe = np.where(denominator > 0, denominator, 1.0)
    return np.where(denominator > 0, numerator / safe, np.nan)
