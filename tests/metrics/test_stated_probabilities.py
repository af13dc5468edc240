"""Proper scores, joined bins, calibration error beside its noise, regions at all levels."""

from __future__ import annotations

import json

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.metrics.calibration import expected_calibration_error
from nolbo_ppl.metrics.stated_probabilities import (
    LEVELS,
    coverages,
    debiased_calibration_error,
    log_score,
    null_calibration_error,
    probability_record,
    region_record,
    reliability_bins,
    reliability_gap,
)


def test_log_score_is_least_for_the_true_probability() -> None:
    y = np.arange(1000) < 300
    scores = {p: log_score(np.full(1000, p), y) for p in (0.2, 0.3, 0.4)}
    assert min(scores, key=scores.__getitem__) == 0.3
    assert scores[0.3] == pytest.approx(-(0.3 * np.log(0.3) + 0.7 * np.log(0.7)))
    assert log_score(np.array([0.0]), np.array([True])) == pytest.approx(6 * np.log(10))  # certain and wrong: limited


def test_bins_are_joined_until_they_hold_enough() -> None:
    p = np.concatenate([np.full(30, 0.05), np.full(30, 0.15), np.full(200, 0.95), np.full(10, 0.5)])
    y = np.concatenate([np.zeros(45), np.ones(15), np.ones(200), np.ones(10)])
    first, last = reliability_bins(p, y > 0.5)
    assert (first.count, last.count) == (60, 210)
    assert first.stated == pytest.approx(0.1) and first.happened == pytest.approx(0.25)
    assert reliability_gap((first, last)) == pytest.approx(0.15)
    assert [b.count for b in reliability_bins(p[:10], y[:10] > 0.5)] == [10]
    assert reliability_bins(p[:0], y[:0] > 0.5) == () and np.isnan(reliability_gap(()))


def test_error_of_a_perfect_forecaster_is_what_the_null_says() -> None:
    rng = np.random.default_rng(0)
    p = rng.beta(2, 1, 500)
    null = null_calibration_error(p, rng)
    errors = [expected_calibration_error(p, rng.random(500) < p)[0] for _ in range(200)]
    assert null.mean() > 0.02  # the noise alone
    assert abs(np.mean(errors) - null.mean()) < 5 * np.hypot(np.std(errors), null.std()) / np.sqrt(200)


@pytest.mark.parametrize("off", [0.0, 0.1])
def test_squared_debiased_error_has_the_true_mean(off: float) -> None:
    """One probability a bin, so that the true error is `off`; its square is estimated without bias (before it is cut at 0)."""
    rng = np.random.default_rng(1)
    stated = np.repeat([0.25, 0.45, 0.65], 40)
    found = np.array([debiased_calibration_error(stated, rng.random(120) < stated + off) for _ in range(2000)])
    if off:
        assert abs(np.mean(found**2) - off**2) < 5 * np.std(found**2) / np.sqrt(2000)
    else:
        plain = expected_calibration_error(stated, rng.random(120) < stated)[0]
        assert (found == 0).mean() > 0.4 and plain > 0
    assert np.isnan(debiased_calibration_error(np.array([0.3]), np.array([True])))


def test_regions_of_true_covariances_cover_what_they_say() -> None:
    mass = np.random.default_rng(2).random(20000)
    record = region_record(mass, squared=np.full(20000, 3.0), degrees=3)
    for level in LEVELS:
        assert abs(record["coverage"][f"{100 * level:g}"] - level) < 5 * np.sqrt(level * (1 - level) / 20000)
    assert record["nees"] == 1.0 and sum(record["pit"]) == pytest.approx(1.0) and record["distance_from_uniform"] < 0.02
    narrow = region_record(mass**0.2)  # scales too small: truths lie far out
    assert narrow["coverage"]["50"] < 0.1 and narrow["distance_from_uniform"] > 0.4
    assert region_record(np.array([np.nan])) == {"count": 0} and coverages(np.zeros(0)) == {}


def test_record_of_probabilities_and_what_is_none() -> None:
    rng = np.random.default_rng(3)
    p = rng.random(4000)
    record = probability_record(p, rng.random(4000) < p)
    assert record["gap"] < 0.1 and record["calibration_error"] < 2 * record["calibration_error_if_perfect"]
    assert record["brier"] == pytest.approx(1 / 6, abs=0.02) and sum(b[2] for b in record["bins"]) == 4000
    assert probability_record(p[:0], np.zeros(0, dtype=bool)) == {"count": 0}
    single = probability_record(np.array([0.7]), np.array([True]))  # one detection in a whole folder
    assert single["debiased_error"] is None and single["count"] == 1
    json.dumps([single, region_record(np.array([0.5]), np.array([np.inf]))], allow_nan=False)
    with pytest.raises(InputError, match=r"\[0, 1\]"):
        log_score(np.array([1.1]), np.array([True]))
    with pytest.raises(InputError, match="one outcome for each"):
        log_score(np.array([0.5]), np.array([True, False]))
