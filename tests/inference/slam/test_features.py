"""Latents fused over views whose errors are alike, against simulated means."""

from __future__ import annotations

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.slam import SlamConfig
from nolbo_ppl.inference.slam.features import LARGE_VARIANCE, correlated_variance, weighted_latents


@pytest.mark.parametrize("correlation", [0.0, 0.3, 0.9])
def test_variance_of_correlated_views_is_that_of_their_mean(correlation: float) -> None:
    """Monte Carlo: the spread of fused latents about the truth, where every view shares a part of its error."""
    rng = np.random.default_rng(0)
    draws, views, scale = 20000, 7, 0.6
    common, own = rng.normal(size=(draws, 1, 2)), rng.normal(size=(draws, views, 2))
    latent = scale * (np.sqrt(correlation) * common + np.sqrt(1 - correlation) * own)
    group = np.repeat(np.arange(draws), views)
    mean, variance = weighted_latents(latent.reshape(-1, 2), np.full((draws * views, 2), scale**2), group,
                                      np.ones(draws * views), draws)  # fmt: skip
    said = correlated_variance(variance, np.full(draws, float(views)), correlation)
    measured = mean.var(axis=0)
    error = measured * np.sqrt(2 / draws)
    assert (np.abs(measured - said[0]) < 5 * error).all()


def test_one_view_and_missing_latents_stay() -> None:
    variance = np.array([[0.5], [LARGE_VARIANCE], [0.2]])
    same = correlated_variance(variance, np.array([1.0, 0.0, 0.4]), 0.8)
    np.testing.assert_array_equal(same, variance)
    with pytest.raises(InputError, match="latent_correlation"):
        SlamConfig(latent_correlation=1.0)
