import math
import time

import numpy as np
import pytest
from scipy.stats import binomtest

from nolbo_ppl.errors import InputError
from nolbo_ppl.metrics.detection import Matches, average_precision
from nolbo_ppl.metrics.intervals import IntervalEstimate, estimate, resample_weights, widened, wilson_interval
from nolbo_ppl.metrics.statistics import by_group, mean_of_defined, weighted_mean, weighted_median


def test_weights_draw_as_many_scenes_each_equally_likely():
    weights = resample_weights(40, 5000, np.random.default_rng(0))
    np.testing.assert_array_equal(weights.sum(1), 40)
    standard_error = math.sqrt((1 - 1 / 40) / 5000)
    np.testing.assert_allclose(weights.mean(0), 1, atol=5 * standard_error)
    # A multinomial count has variance 1 - 1/n; that of its sample variance is about 2.9 / sqrt(resamples).
    np.testing.assert_allclose(weights.var(0), 1 - 1 / 40, atol=5 * 2.9 / math.sqrt(5000))


@pytest.mark.parametrize("seed", range(4))
def test_weighted_statistics_equal_repetition(seed):
    rng = np.random.default_rng(seed)
    value, weight = np.round(rng.normal(size=11), 1), rng.integers(0, 4, (6, 11))
    for row, mean, median in zip(
        weight, weighted_mean(value, weight.astype(float)), weighted_median(value, weight.astype(float))
    ):
        repeated = np.repeat(value, row)
        assert mean == pytest.approx(repeated.mean(), abs=1e-12)
        assert median == pytest.approx(np.median(repeated), abs=1e-12)


def test_statistic_of_nothing_is_undefined():
    zero = np.zeros((2, 3))
    assert np.isnan(weighted_mean(np.ones(3), zero)).all() and np.isnan(weighted_median(np.ones(3), zero)).all()
    assert np.isnan(weighted_median(np.empty(0), np.empty((2, 0)))).all()


def test_groups_without_members_are_left_out_of_the_mean():
    value, group = np.array([1.0, 3.0, 10.0]), np.array([0, 0, 2])
    means = by_group(weighted_mean, value, group, 3, np.array([[1.0, 1, 1], [1, 1, 0], [0, 0, 0]]))
    np.testing.assert_allclose(means, [[2, np.nan, 10], [2, np.nan, np.nan], [np.nan] * 3])
    np.testing.assert_allclose(mean_of_defined(means), [6, 2, np.nan])


def test_bootstrap_of_a_mean_has_the_standard_error_of_the_mean():
    rng = np.random.default_rng(1)
    value = rng.normal(size=400)
    weights = resample_weights(400, 4000, rng)
    result = estimate(lambda w: weighted_mean(value, w), weights, 400)
    half = 1.96 * value.std() / math.sqrt(400)
    assert result.value == pytest.approx(value.mean())
    assert result.low == pytest.approx(value.mean() - half, abs=0.1 * half)
    assert result.high == pytest.approx(value.mean() + half, abs=0.1 * half)


def test_bootstrap_covers_the_truth_as_often_as_it_says():
    rng = np.random.default_rng(2)
    inside, trials = 0, 400
    for _ in range(trials):
        scene = np.repeat(np.arange(60), 3)
        value = rng.normal(size=60)[scene] + rng.normal(size=180)  # objects of a scene share an effect
        weights = resample_weights(60, 300, rng)
        result = estimate(lambda w, v=value, s=scene: weighted_mean(v, w[:, s]), weights, 180)
        inside += result.low <= 0 <= result.high
    # Percentile intervals of 60 scenes cover a little less than 95 %.
    assert inside / trials == pytest.approx(0.94, abs=5 * math.sqrt(0.94 * 0.06 / trials))


def test_pivotal_interval_undoes_the_bias_of_resampling():
    """Mean of 20 absolute group means of pure noise: resampled ones are larger by about sqrt(2)."""
    rng = np.random.default_rng(5)
    value, group = rng.normal(size=400), np.arange(400) % 20
    weights = resample_weights(400, 500, rng)

    def statistic(w):
        return np.abs(by_group(weighted_mean, value, group, 20, w)).mean(1)

    plain, pivotal = (estimate(statistic, weights, 400, pivotal=p) for p in (False, True))
    assert plain.low > plain.value  # what the pivotal form is for
    assert pivotal.low == pytest.approx(2 * plain.value - plain.high) and pivotal.low < pivotal.value
    assert pivotal.high == pytest.approx(2 * plain.value - plain.low)


def test_undefined_figures_are_none():
    weights = resample_weights(3, 10, np.random.default_rng(3))
    assert estimate(lambda w: np.full(len(w), np.nan), weights, 0) == IntervalEstimate(None, None, None, 0)


@pytest.mark.parametrize("successes, trials", [(0, 10), (3, 10), (10, 10), (457, 500), (1, 1)])
def test_wilson_against_scipy(successes, trials):
    expected = binomtest(successes, trials).proportion_ci(0.95, method="wilson")
    got = wilson_interval(successes, trials)
    np.testing.assert_allclose(got, (expected.low, expected.high), atol=1e-9)
    assert got[0] <= successes / trials <= got[1]


def test_widened_interval_has_width_at_one():
    low, _ = wilson_interval(20, 20)
    assert widened(IntervalEstimate(1.0, 1.0, 1.0, 20)) == IntervalEstimate(1.0, low, 1.0, 20)
    wide = IntervalEstimate(0.5, 0.1, 0.9, 100)
    assert widened(wide) == wide
    assert widened(IntervalEstimate(None, None, None, 0)) == IntervalEstimate(None, None, None, 0)


def test_speed_of_a_thousand_scenes():
    rng = np.random.default_rng(4)
    scenes, n = 1000, 30_000
    order = np.sort(rng.random(n))[::-1]
    correct = rng.random(n) < order
    scene = rng.integers(0, scenes, n)
    truths = np.bincount(scene, weights=correct, minlength=scenes).astype(int)
    matches = Matches(scene, np.arange(n), order, np.where(correct, 0, -1), np.zeros(n, dtype=bool), truths)
    start = time.process_time()
    weights = resample_weights(scenes, 500, rng)
    result = estimate(lambda w: average_precision(matches, w), weights, int(truths.sum()))
    assert time.process_time() - start < 20
    assert result.low < result.value < result.high


def test_errors():
    with pytest.raises(InputError, match=r"nothing to resample.*0 scenes"):
        resample_weights(0, 10, np.random.default_rng(0))
    with pytest.raises(InputError, match=r"not a proportion.*11 of 10"):
        wilson_interval(11, 10)
    with pytest.raises(InputError, match=r"level of an interval.*95"):
        wilson_interval(1, 10, level=95)
    with pytest.raises(InputError, match=r"level of an interval.*0"):
        estimate(lambda w: w.sum(1), np.ones((2, 2)), 2, level=0)
