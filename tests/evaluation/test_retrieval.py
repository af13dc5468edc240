"""Retrieval of instances: scores against quadrature and against Gaussian algebra of whole vectors, ranks by hand."""

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from nolbo_ppl.errors import InputError
from nolbo_ppl.evaluation.retrieval import (
    log_evidence_ratio,
    log_overlap,
    rank_of_own,
    retrieval_scores,
    retrieval_table,
    retrieve,
)


def normal(x, mean, scale):
    return np.exp(-0.5 * ((x - mean) / scale) ** 2) / (scale * math.sqrt(2 * math.pi))


def test_evidence_ratio_is_the_integral():
    """One dimension by quadrature; several dimensions add."""
    rng = np.random.default_rng(0)
    x = np.linspace(-30, 30, 120_001)
    mean, scale, prior = rng.normal(size=(2, 3)), rng.uniform(0.2, 1.0, (2, 3)), rng.normal(size=3)
    expected = sum(
        math.log(np.trapezoid(normal(x, *a) * normal(x, *b) / normal(x, p, 1.0), x))
        for a, b, p in zip(zip(mean[0], scale[0]), zip(mean[1], scale[1]), prior)
    )
    found = log_evidence_ratio(mean[:1], scale[:1], mean[1:], scale[1:], prior)
    assert found.shape == (1, 1) and found[0, 0] == pytest.approx(expected, rel=1e-9)


def test_evidence_of_what_says_nothing_is_none():
    """A posterior as wide as the prior at its mean tells nothing about whether two views show one instance."""
    rng = np.random.default_rng(1)
    prior = rng.normal(size=4)
    other, narrow = rng.normal(size=(5, 4)), rng.uniform(0.1, 1, (5, 4))
    found = log_evidence_ratio(prior[None], np.full((1, 4), 1.0), other, narrow, prior)
    np.testing.assert_allclose(found, 0, atol=1e-12)
    np.testing.assert_allclose(log_evidence_ratio(prior[None], np.full((1, 4), 3.0), other, narrow, prior), 0, atol=1e-12)


def test_overlap_is_a_gaussian_of_the_difference():
    rng = np.random.default_rng(2)
    a, b = rng.normal(size=(3, 5)), rng.normal(size=(4, 5))
    u, v = rng.uniform(0.1, 2, (3, 5)), rng.uniform(0.1, 2, (4, 5))
    expected = [[multivariate_normal(b[j], np.diag(u[i] ** 2 + v[j] ** 2)).logpdf(a[i]) for j in range(4)] for i in range(3)]
    np.testing.assert_allclose(log_overlap(a, u, b, v), expected, rtol=1e-10)


def test_ranks_by_hand_and_ties_count_against():
    score = np.array([[3.0, 2.0, 1.0], [5.0, 4.0, 6.0], [0.0, 0.0, 0.0]])
    assert rank_of_own(score).tolist() == [1, 3, 3]
    with pytest.raises(InputError, match="square matrix"):
        rank_of_own(np.zeros((2, 3)))
    with pytest.raises(InputError, match="square matrix"):
        rank_of_own(np.full((2, 2), np.nan))


def instances(noise, per=20, labels=3, d=6, seed=3):
    """Latents drawn from the prior of their category, seen twice with noise that the scales state."""
    rng = np.random.default_rng(seed)
    prior = 4 * rng.normal(size=(labels, d))
    category = np.repeat(np.arange(labels), per)
    z = prior[category] + rng.normal(size=(len(category), d))
    likelihood = noise * rng.uniform(0.5, 2.0, (len(category), 2, d))
    seen = z[:, None] + likelihood * rng.normal(size=likelihood.shape)
    # The posterior under the prior N(prior, I): precisions add.
    variance = 1 / (1 + likelihood**-2)
    mean = variance * (seen / likelihood**2 + prior[category][:, None])
    return mean, np.sqrt(variance), category, prior


def test_sharp_views_find_their_instance_and_noise_does_not():
    found = retrieve(*instances(0.01))
    assert all((rank == 1).all() for rank in found.rank.values()) and (found.gallery == 20).all()
    figures = retrieval_scores(found, np.random.default_rng(0), 100)
    assert figures["retrieval_recall1"].value == 1.0 and figures["retrieval_median_rank"].value == 1.0
    assert 0.9 < figures["retrieval_recall1"].low < 1.0
    lost = retrieve(*instances(100.0, per=50, labels=12))
    recall = retrieval_scores(lost, np.random.default_rng(0), 100)["retrieval_recall1"]
    # The two directions of a pair are far from independent: the bound is that of one draw an instance.
    assert recall.value == pytest.approx(1 / 50, abs=5 * math.sqrt(0.02 * 0.98 / 600)) and recall.low <= 1 / 50 <= recall.high


def test_the_evidence_is_the_best_score_where_scales_differ():
    """Noise of very different sizes: the score that knows them finds more than the distance of the means."""
    rank = retrieve(*instances(0.5, per=60, labels=8)).rank
    recall = {name: (value == 1).mean() for name, value in rank.items()}
    assert recall["evidence"] > recall["euclidean"] + 0.05 and recall["evidence"] >= recall["overlap"] - 0.02


def test_a_category_is_searched_alone():
    mean, scale, category, prior = instances(0.05)
    moved = mean + 1000.0 * category[:, None, None]
    for name, rank in retrieve(mean, scale, category, prior).rank.items():
        np.testing.assert_array_equal(rank, retrieve(moved, scale, category, prior + 1000.0 * np.arange(3)[:, None]).rank[name])
    table = retrieval_table(retrieve(mean, scale, category, prior), ("a", "b", "c", "d"))
    assert set(table) == {"a", "b", "c"} and table["a"]["chance"] == pytest.approx(0.05) and table["a"]["instances"] == 20


def test_shapes_are_checked():
    mean, scale, category, prior = instances(0.1)
    for bad in ((mean[:, :1], scale, category), (mean, scale[:5], category), (mean[:0], scale[:0], category[:0])):
        with pytest.raises(InputError, match="latents of two views"):
            retrieve(*bad, prior)
