"""Tails and certainty from whole answers on held-out scenes."""

from __future__ import annotations

import numpy as np
import pytest

from nolbo_ppl.models.posterior_calibration import CERTAIN, Calibration
from nolbo_ppl.training.calibrate_answers import calibrate_answers


def test_tails_and_limit_are_those_of_the_answers() -> None:
    rng = np.random.default_rng(0)
    squared = 3 * 0.5 * rng.f(3, 3.0, 4000)
    score, right = np.full(500, 0.99999), np.arange(500) >= 5
    found = calibrate_answers(Calibration(shape_scale=1.3), squared, score, right)
    assert found.position_dof == pytest.approx(3.0, rel=0.2) and found.position_spread == pytest.approx(0.5, rel=0.1)
    assert found.objectness_limit == pytest.approx(496 / 502) and found.shape_scale == 1.3
    # What is then stated at most came true as often as it says.
    assert abs(right.mean() - found.objectness_limit) < 0.005


def test_little_data_changes_nothing() -> None:
    few = calibrate_answers(Calibration(), np.ones(10), np.ones(10), np.ones(10, dtype=bool))
    assert few == Calibration() and few.objectness_limit == CERTAIN
