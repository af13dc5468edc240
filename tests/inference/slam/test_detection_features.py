"""Latents fused over views whose errors are alike, against simulated means."""

from __future__ import annotations

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem
from nolbo_ppl.inference.slam.detection_features import (
    LARGE_VARIANCE,
    FeaturePrior,
    correlated_variance,
    weighted_latents,
)
from nolbo_ppl.inference.slam.incremental.running_map import new_landmark, variance_between_views
from nolbo_ppl.inference.slam.latent_population import LatentPopulation
from nolbo_ppl.inference.slam.measurements import resolve
from nolbo_ppl.inference.slam.noise.noise_estimation import estimate_noise
from nolbo_ppl.structures.detections import Detections


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
    """A landmark's latent has the variance that the batch computes from the same views, over two passes together."""
    latent, scale, views, correlation = np.array([[0.2, -1.0]]), np.array([[0.3, 0.5]]), 4, 0.6
    prior = FeaturePrior(np.zeros(2), LatentPopulation.of_one(np.zeros(2), np.ones(2)), (), np.zeros(0), 0.9)
    table = Detections.from_arrays(np.zeros(1, int), np.ones((1, 3)), latent=latent, latent_scale=scale)
    problem = SlamProblem(np.eye(4)[None], table)
    config = SlamConfig()
    seen = resolve(table, estimate_noise(problem, config), config, prior)
    first, second, single = (new_landmark(j, 0, 0, prior, 1) for j in range(3))
    for frame in range(views):
        (first if frame < 3 else second).add(frame, seen, 0, table.size[0])
    single.add(0, seen, 0, table.size[0])
    first.absorb(second)
    rows = np.zeros(views, int)
    batch_mean, batch = weighted_latents(np.repeat(latent, views, 0), np.repeat(scale**2, views, 0), rows, np.ones(views), 1)
    expected = correlated_variance(batch, np.array([float(views)]), correlation)[0]
    np.testing.assert_allclose(variance_between_views([first, single], correlation), [expected, scale[0] ** 2], rtol=1e-9)
    np.testing.assert_allclose(first.latent, batch_mean[0], rtol=1e-9)


def test_one_view_and_missing_latents_stay() -> None:
    variance = np.array([[0.5], [LARGE_VARIANCE], [0.2]])
    same = correlated_variance(variance, np.array([1.0, 0.0, 0.4]), 0.8)
    np.testing.assert_array_equal(same, variance)
    with pytest.raises(InputError, match="latent_correlation"):
        SlamConfig(latent_correlation=1.0)
