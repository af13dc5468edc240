"""Evidence of latents: densities over a population of categories, against quadrature and against its own frequencies."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.special import expit
from scipy.stats import norm

from nolbo_ppl.inference.slam.detection_features import detection_features, fit_prior, variance_of_shape
from nolbo_ppl.inference.slam.latent_mixture import LatentMixture
from nolbo_ppl.inference.slam.latent_population import LatentPopulation, fit_population
from nolbo_ppl.inference.slam.noise.noise_estimation import estimate_noise
from nolbo_ppl.inference.slam.slam_problem import SlamConfig, SlamProblem
from nolbo_ppl.structures.detections import Detections


def test_evidence_of_a_pair_against_quadrature() -> None:
    population = LatentPopulation(np.log([0.3, 0.7]), np.array([[-1.0], [2.0]]), np.array([0.4]))
    rng = np.random.default_rng(0)
    a, b = rng.normal(0, 2, (20, 1)), rng.normal(0, 2, (20, 1))
    one, other = rng.uniform(0.1, 2.0, (20, 1)), rng.uniform(0.1, 2.0, (20, 1))
    u = np.linspace(-30, 30, 60001)
    prior = 0.3 * norm.pdf(u, -1.0, np.sqrt(0.4)) + 0.7 * norm.pdf(u, 2.0, np.sqrt(0.4))
    seen_a, seen_b = (norm.pdf(x, u, np.sqrt(v)) for x, v in ((a, one), (b, other)))
    alone_a, alone_b, both = ((prior * x).sum(1) * (u[1] - u[0]) for x in (seen_a, seen_b, seen_a * seen_b))
    np.testing.assert_allclose(population.log_density(a, one), np.log(alone_a), rtol=1e-8)
    np.testing.assert_allclose(population.log_ratio(a, one, b, other), np.log(both / (alone_a * alone_b)), rtol=1e-6, atol=1e-8)


def test_evidence_of_modes_against_enumeration() -> None:
    """Latents of two and three modes; exact where one pair of modes is far likelier than all others."""
    rng = np.random.default_rng(1)
    population = LatentPopulation(np.log([0.5, 0.5]), np.array([[-4.0, 0.0], [4.0, 1.0]]), np.array([0.3, 0.5]))
    a = LatentMixture(np.log(rng.dirichlet(np.ones(2), 8)), np.stack([rng.normal(0, 0.4, (8, 2)) + c for c in (-4, 4)], 1))
    b = LatentMixture(np.log(rng.dirichlet(np.ones(3), 8)), np.stack([rng.normal(0, 0.4, (8, 2)) + c for c in (4, 30, -30)], 1))
    variance, other = np.full((8, 2), 0.2), np.full((8, 2), 0.1)
    joint = np.zeros(8)
    alone = [np.zeros(8), np.zeros(8)]
    for k in range(2):
        alone[0] += np.exp(a.log_weight[:, k] + population.log_density(a.mean[:, k], variance))
        for m in range(3):
            pair = population.log_ratio(a.mean[:, k], variance, b.mean[:, m], other)
            pair += population.log_density(a.mean[:, k], variance) + population.log_density(b.mean[:, m], other)
            joint += np.exp(a.log_weight[:, k] + b.log_weight[:, m] + pair)
    for m in range(3):
        alone[1] += np.exp(b.log_weight[:, m] + population.log_density(b.mean[:, m], other))
    np.testing.assert_allclose(population.log_density_of_modes(a, variance), np.log(alone[0]), rtol=1e-12)
    found = population.log_ratio_of_modes(a, variance, b, other)
    np.testing.assert_allclose(found, np.log(joint / (alone[0] * alone[1])), rtol=1e-9)


def test_wrong_names_are_outvoted() -> None:
    rng = np.random.default_rng(2)
    n, means, own = 3000, 4.0 * rng.standard_normal((3, 6)), 0.3
    label = rng.choice(3, n, p=[0.5, 0.3, 0.2])
    latent = means[label] + rng.standard_normal((n, 6)) + np.sqrt(own) * rng.standard_normal((n, 6))
    named = np.where(rng.random(n) < 0.15, rng.integers(3, size=n), label)
    named[rng.random(n) < 0.05] = -1
    found = fit_population(latent, np.full((n, 6), own), named)
    order = np.argsort(-found.log_weight)[:3]
    share = np.bincount(label) / n
    np.testing.assert_allclose(np.exp(found.log_weight[order]), np.sort(share)[::-1], atol=0.02)
    np.testing.assert_allclose(found.mean[order], means[np.argsort(-share)], atol=5 * np.sqrt(1.3 / 500))
    np.testing.assert_allclose(found.variance, 1.0, atol=5 * 1.3 * np.sqrt(2 / n))


def test_clusters_stand_in_for_names() -> None:
    rng = np.random.default_rng(5)
    n, means, own = 2000, 5.0 * rng.standard_normal((4, 5)), 0.3
    latent = means[rng.integers(4, size=n)] + np.sqrt(1 + own) * rng.standard_normal((n, 5))
    found = fit_population(latent, np.full((n, 5), own), np.full(n, -1))
    assert len(found.mean) == 4
    np.testing.assert_allclose(found.variance, 1.0, atol=5 * 1.3 * np.sqrt(2 / n))
    one = fit_population(latent - latent.mean(0), np.full((n, 5), own), np.zeros(n, int))
    assert len(one.mean) == 1
    np.testing.assert_allclose(one.variance, latent.var(axis=0) - own, rtol=1e-9)
    alone = fit_population(rng.standard_normal((n, 5)), np.zeros((n, 5)), np.full(n, -1))
    assert len(alone.mean) == 1  # one Gaussian is one cluster
    same = fit_population(np.ones((100, 2)), np.zeros((100, 2)), np.full(100, -1))
    assert np.isfinite(same.log_density(np.ones((1, 2)), np.ones((1, 2)))).all()


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.9])
@pytest.mark.parametrize("categories", [1, 5])
def test_evidence_of_two_views_is_calibrated(correlation: float, categories: int) -> None:
    """Pairs of which half are one object: the stated probability that they are is right, within five standard errors.

    Objects have a category's latent and one of their own; a part of the error is the same in all views of an object.
    """
    rng = np.random.default_rng(3)
    objects, d, scale = 4000, 3, 0.8
    label = rng.integers(categories, size=objects)
    latent = (3.0 * rng.standard_normal((categories, d)))[label] + rng.standard_normal((objects, d))
    signature = latent + scale * np.sqrt(correlation) * rng.standard_normal((objects, d))
    views = np.repeat(signature, 2, axis=0) + scale * np.sqrt(1 - correlation) * rng.standard_normal((2 * objects, d))
    names = [f"c{k}" for k in np.repeat(label, 2)]
    frame = np.arange(2 * objects)
    table = Detections.from_arrays(
        frame, np.tile([0, 0, 5.0], (2 * objects, 1)), latent=views, latent_scale=scale, category=names, position_scale=0.1
    )
    config = SlamConfig(latent_correlation=correlation)
    prior = fit_prior(table, config)
    problem = SlamProblem(np.tile(np.eye(4), (2, 1, 1)), table.select(frame < 2))
    noise = estimate_noise(problem, config)
    _, variance, _ = detection_features(table.select(frame < 2), noise, prior, correlation)
    np.testing.assert_allclose(variance, (1 - correlation) * scale**2)
    variance, none = np.tile(variance[:1], (objects, 1)), np.full(objects, -1)
    first, second = views[::2], views[1::2]
    same = prior.log_likelihood_ratio(first, variance, none, second, variance, none)
    other = prior.log_likelihood_ratio(first, variance, none, np.roll(second, 1, axis=0), variance, none)
    stated, truth = expit(np.concatenate([same, other])), np.repeat([1.0, 0.0], objects)
    edges = np.array([0.0, 0.02, 0.2, 0.5, 0.8, 0.98, 1.0])
    for low, high in pairwise(edges):
        some = (stated > low) & (stated <= high)
        expected = np.sqrt((stated[some] * (1 - stated[some])).sum()) + 1.0
        assert abs(truth[some].sum() - stated[some].sum()) < 5 * expected


def test_a_shared_category_is_worth_its_share() -> None:
    """Two objects of one category, whatever the number of dimensions: not tens of nats, but the log of how rare it is."""
    rng = np.random.default_rng(4)
    for d in (4, 64):
        label = rng.integers(4, size=2000)
        latent = (5.0 * rng.standard_normal((4, d)))[label] + 0.2 * rng.standard_normal((2000, d))
        seen = latent + 0.5 * rng.standard_normal((2000, d))
        found = fit_population(seen, np.full((2000, d), 0.25), label)
        kind = [np.flatnonzero(label == k)[:200] for k in range(4)]
        variance = np.full((200, d), 0.25)
        ratio = np.concatenate([found.log_ratio(seen[rows], variance, seen[np.roll(rows, 1)], variance) for rows in kind])
        assert ratio.mean() < np.log(4) + 0.1  # one Gaussian of all categories: 7 and 98 nats
        wide = fit_population(seen, np.full((2000, d), 0.25), np.zeros(2000, int))
        assert wide.log_ratio(seen[kind[0]], variance, seen[np.roll(kind[0], 1)], variance).mean() > d


def test_variance_of_the_shape_holds_what_views_share() -> None:
    between = np.array([[0.3, 0.6], [1e12, 1e12]])
    np.testing.assert_allclose(variance_of_shape(between, 0.4), [[0.5, 1.0], [1e12, 1e12]])
