"""Scales from gaps between frames: gaps of one object told from gaps to strangers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nolbo_ppl.data.simulate import DetectorConfig, WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem
from nolbo_ppl.inference.slam.noise.neighbour_gaps import same_or_stranger
from nolbo_ppl.inference.slam.noise.noise_estimation import estimate_noise, fit_range_model, robust_scale
from nolbo_ppl.structures.detections import Detections


@pytest.mark.parametrize(("width", "same", "strangers"), [(1.0, 300, 0), (1.0, 300, 900), (3.0, 150, 600), (0.2, 150, 600)])
def test_width_among_strangers(width: float, same: int, strangers: int) -> None:
    """The width of normal gaps is found within 5 standard errors, however many strangers fill the space around them."""
    rng = np.random.default_rng(same + strangers)
    near = width * rng.standard_normal((same, 3))
    far = rng.uniform(-15 * width, 15 * width, (strangers, 3))
    squared = np.sum(np.concatenate([near, far]) ** 2, axis=1)
    found, gain, probability = same_or_stranger(squared)
    assert abs(found / width - 1) < 5 / np.sqrt(2 * 3 * same) + 0.02  # a few strangers lie inside
    assert (gain > 8) == (width != 1.0)
    # Probabilities are calibrated as a whole: their sum is the number of true pairs.
    assert abs(probability.sum() - same) < 5 * np.sqrt(same + 0.1 * strangers)


def test_too_few_gaps_tell_nothing() -> None:
    for count in (0, 4):
        found, gain, probability = same_or_stranger(np.ones(count))
        assert np.isnan(found) and gain == 0 and probability.shape == (count,)


def test_exact_detections_have_a_floor() -> None:
    """A simulator's noise-free detections once divided by a scale of 0."""
    rng = np.random.default_rng(0)
    assert fit_range_model(rng.uniform(1, 10, 200), np.zeros(200)) == (0.0, 0.0)
    odometry = np.tile(np.eye(4), (60, 1, 1))
    objects = rng.uniform(2, 8, (5, 3))
    table = Detections.from_arrays(np.repeat(np.arange(60), 5), np.tile(objects, (60, 1)))
    noise = estimate_noise(SlamProblem(odometry, table), SlamConfig())
    scale = np.sqrt(np.linalg.eigvalsh(noise.position_covariance))
    assert np.isfinite(scale).all() and (scale > 1e-5).all() and (scale < 1e-2).all()


@pytest.mark.parametrize(("miss", "clutter"), [(0.6, 0.5), (0.15, 3.0)])
def test_exactly_stated_scales_stay(miss: float, clutter: float) -> None:
    """Mutual nearest neighbours took strangers for pairs here and multiplied exact scales by 1.9."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        truth = simulate_circuit(rng, laps=1, frames_per_lap=90)
        world = simulate_sequence(
            truth,
            rng,
            world=WorldConfig(objects=45, categories=8, latent_dim=6),
            detector=DetectorConfig(miss_rate=miss, clutter_rate=clutter),
            odometry_rotation_scale=0.002,
        )
        problem = SlamProblem(world.odometry, world.observations)
        noise = estimate_noise(problem, SlamConfig())
        assert noise.warnings == ()
        np.testing.assert_array_equal(noise.position_covariance, world.observations.position_covariance)
        small = replace(world.observations, position_covariance=world.observations.position_covariance / 9)
        found = estimate_noise(SlamProblem(world.odometry, small), SlamConfig())
        assert any("position scales are too small" in w for w in found.warnings)
        size = [np.trace(x, axis1=1, axis2=2) for x in (found.position_covariance, world.observations.position_covariance)]
        assert 0.8 < np.sqrt(np.median(size[0] / size[1])) < 1.25


def test_weighted_median_scale() -> None:
    rng = np.random.default_rng(0)
    values, outliers = rng.standard_normal(4000), 50 * rng.standard_normal(4000)
    both = np.concatenate([values, outliers])
    weight = np.repeat([1.0, 0.0], 4000)
    assert robust_scale(both, weight) == pytest.approx(robust_scale(values), rel=1e-2)
    assert abs(robust_scale(values) - 1) < 5 * 1.17 / np.sqrt(4000)  # asymptotic error of the median absolute deviation
