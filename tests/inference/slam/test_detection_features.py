"""Latents fused over views whose errors are alike, against simulated means."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.slam import SlamConfig
from nolbo_ppl.inference.slam.detection_features import (
    LARGE_VARIANCE,
    FeaturePrior,
    correlated_variance,
    fuse_latent,
    weighted_latents,
)
from nolbo_ppl.inference.slam.incremental.incremental_loops import LoopCloser, Track


@pytest.mark.parametrize("correlation", [0.0, 0.3, 0.9])
def test_variance_of_correlated_views_is_that_of_their_mean(correlation: float) -> None:
    """Monte Carlo: the spread of fused latents about the truth, where every view shares a part of its error."""
    rng = np.random.default_rng(0)
    draws, views, scale = 20000, 7, 0.6
    common, own = rng.normal(size=(draws, 1, 2)), rng.normal(size=(draws, views, 2))
    latent = scale * (np.sqrt(correlation) * common + np.sqrt(1 - correlation) * own)
    group = np.repeat(np.arange(draws), views)
    mean, variance = weighted_latents(
        latent.reshape(-1, 2), np.full((draws * views, 2), scale**2), group, np.ones(draws * views), draws
    )
    said = correlated_variance(variance, np.full(draws, float(views)), correlation)
    measured = mean.var(axis=0)
    error = measured * np.sqrt(2 / draws)
    assert (np.abs(measured - said[0]) < 5 * error).all()


def test_the_online_system_widens_latents_of_views_that_are_alike() -> None:
    """What it compares tracks by has the variance that the batch computes from the same views."""
    table_latent, scale, views = np.array([[0.2, -1.0]]), np.array([[0.3, 0.5]]), 4
    fused, variance = table_latent[0], scale[0] ** 2
    for _ in range(views - 1):
        fused, variance = fuse_latent(fused, variance, table_latent[0], scale[0] ** 2)
    config = SlamConfig(latent_correlation=0.6)
    closer = LoopCloser(config, FeaturePrior(np.zeros(2), np.ones(2), (), np.zeros(0), 0.9))
    track = Track(list(range(views)), 0, fused, variance, -1, 1, False, 0, views)
    closer.add(track)
    closer.add(replace(track, rows=[0], latent_variance=scale[0] ** 2))
    features = closer._features(np.arange(2), np.array([True, False]))
    batch = weighted_latents(
        np.repeat(table_latent, views, 0), np.repeat(scale**2, views, 0), np.zeros(views, int), np.ones(views), 1
    )[1]
    expected = correlated_variance(batch, np.array([float(views)]), 0.6)[0]
    np.testing.assert_allclose(features.latent_variance, [expected, scale[0] ** 2])


def test_one_view_and_missing_latents_stay() -> None:
    variance = np.array([[0.5], [LARGE_VARIANCE], [0.2]])
    same = correlated_variance(variance, np.array([1.0, 0.0, 0.4]), 0.8)
    np.testing.assert_array_equal(same, variance)
    with pytest.raises(InputError, match="latent_correlation"):
        SlamConfig(latent_correlation=1.0)
