"""Parts of the generative model of a frame, each against a general method: optimisation, simulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, log_expit

from nolbo_ppl.inference.slam import SlamConfig
from nolbo_ppl.inference.slam.detection_pairs import DetectionPairs
from nolbo_ppl.inference.slam.existence import score_correlation
from nolbo_ppl.inference.slam.exposures import exposures_of
from nolbo_ppl.inference.slam.frame_model import initial_frame_model
from nolbo_ppl.inference.slam.frame_model_fit import OFFSET_SCALE, SLOPE_SCALE, estimate_frame_model
from nolbo_ppl.inference.slam.measurements import Measurements
from tests.position_measurements import position_measurements


def scored(log_odds: np.ndarray, rng: np.random.Generator) -> Measurements:
    """Detections in view with these log likelihood ratios of their scores."""
    n = len(log_odds)
    position = np.array([0.0, 0.0, 8.0]) + rng.standard_normal((n, 3))
    return position_measurements(position, np.tile(0.01 * np.eye(3), (n, 1, 1)), log_odds, np.arange(n) % 20)


def test_the_score_is_fitted_to_the_maximum_of_its_posterior() -> None:
    rng = np.random.default_rng(0)
    x = 2.0 * rng.standard_normal(400)
    seen = scored(x, rng)
    background = expit(-(0.6 * x + 0.3) + 0.3 * rng.standard_normal(400))
    model = initial_frame_model(seen, SlamConfig(), 20)
    nowhere = exposures_of(model, np.tile(np.eye(4), (20, 1, 1)), np.zeros((0, 3)))
    everywhere = exposures_of(model, np.tile(np.eye(4), (20, 1, 1)), seen.position)
    none = np.zeros(0)
    found = estimate_frame_model(
        model, seen, background, 1 - background, np.ones(400), nowhere, everywhere, none.astype(int), none, none, none
    )
    share = (background.sum() + 20.0 * model.stated_share) / (400 + 20.0)
    base = np.log((1 - share) / share)

    def loss(parameter: np.ndarray) -> float:
        log_slope, offset = parameter
        value = np.exp(log_slope) * x + base + offset
        likelihood = (1 - background) @ log_expit(value) + background @ log_expit(-value)
        return float(-likelihood + 0.5 * (log_slope / SLOPE_SCALE) ** 2 + 0.5 * (offset / OFFSET_SCALE) ** 2)

    best = minimize(loss, np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-8, "fatol": 1e-10}).x
    np.testing.assert_allclose([np.log(found.score_slope), found.score_offset], best, atol=1e-5)


def test_scores_of_one_object_are_as_alike_as_they_were_drawn() -> None:
    rng = np.random.default_rng(1)
    groups, true = 400, 0.4
    count = rng.integers(1, 9, groups)
    landmark = np.repeat(np.arange(groups), count)
    score = np.sqrt(true) * rng.standard_normal(groups)[landmark] + np.sqrt(1 - true) * rng.standard_normal(len(landmark))
    n, empty = len(landmark), np.zeros(len(landmark))
    pairs = DetectionPairs(np.arange(n), landmark, empty, np.zeros((n, 3)), empty, empty, empty)
    stated = score_correlation(scored(score, rng), pairs, np.ones(n))
    # Standard error of an intraclass correlation (Fisher) over the groups of three and more.
    k = count[count >= 3].mean()
    error = np.sqrt(2 * (1 - true) ** 2 * (1 + (k - 1) * true) ** 2 / (k * (k - 1) * (count >= 3).sum()))
    assert abs(stated - true) < 5 * error < 0.25
    alone = replace(pairs, landmark=np.arange(n))
    assert score_correlation(scored(score, rng), alone, np.ones(n)) == 0.0
