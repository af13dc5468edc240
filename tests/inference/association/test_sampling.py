"""Joint samples against enumeration."""

from __future__ import annotations

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.association import association_marginals, sample_associations


@pytest.mark.parametrize("shape", [(3, 4), (4, 2), (3, 3), (1, 5), (5, 1)])
@pytest.mark.parametrize("sparse", [False, True])
def test_frequencies_of_joint_associations(shape, sparse, enumerate_associations) -> None:
    """Every joint association, not the marginals alone, within 5 standard errors (and a count for the rarest)."""
    rng = np.random.default_rng(sum(shape))
    likelihood, null = rng.normal(size=shape), rng.normal(size=shape[0])
    if sparse:
        likelihood[rng.random(shape) < 0.4] = -np.inf
    truth = enumerate_associations(likelihood, null)
    count = 40_000
    samples = sample_associations(likelihood, null, rng=rng, count=count)
    assert samples.shape == (count, shape[0])
    probability = np.exp(truth.log_weight - truth.log_evidence)
    drawn, tally = np.unique(samples, axis=0, return_counts=True)
    tallies = {tuple(row): int(n) for row, n in zip(drawn.tolist(), tally)}
    frequency = np.array([tallies.pop(tuple(row), 0) for row in truth.landmark.tolist()])
    assert not tallies, "an impossible association was drawn"
    error = np.sqrt(count * probability * (1 - probability))
    assert (np.abs(frequency - count * probability) <= 5 * error + 1).all()


def test_marginals_of_a_larger_problem_over_many_components() -> None:
    rng = np.random.default_rng(9)
    likelihood, null = rng.normal(size=(9, 12)), rng.normal(size=9)
    likelihood[rng.random((9, 12)) < 0.7] = -np.inf
    likelihood[0] -= 1500.0
    null[0] -= 1500.0
    exact = association_marginals(likelihood, null)
    count = 20_000
    samples = sample_associations(likelihood, null, rng=rng, count=count)
    for j in range(12):
        weight = exact.weights[:, j]
        error = np.sqrt(weight * (1 - weight) / count)
        assert (np.abs((samples == j).mean(axis=0) - weight) <= 5 * error).all()
    taken = np.sort(np.where(samples < 0, np.arange(9) - 99, samples), axis=1)
    assert (np.diff(taken, axis=1) != 0).all(), "a landmark was given to two detections"


def test_the_seed_decides() -> None:
    problem = np.zeros((3, 4)), np.zeros(3)
    first, again, other = (sample_associations(*problem, rng=np.random.default_rng(s), count=50) for s in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


@pytest.mark.parametrize("shape", [(0, 0), (0, 4), (4, 0)])
def test_empty_sides(shape) -> None:
    samples = sample_associations(np.zeros(shape), np.zeros(shape[0]), rng=np.random.default_rng(0), count=7)
    assert samples.shape == (7, shape[0]) and (samples == -1).all()


def test_beyond_the_budget_raises() -> None:
    with pytest.raises(InputError, match=r"too entangled to sample exactly: detections \[.*\] share landmarks"):
        sample_associations(np.zeros((9, 9)), np.zeros(9), rng=np.random.default_rng(0), budget=1000)
