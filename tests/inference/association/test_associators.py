"""The associators beside the exact one: each where it is exact, and its error where it is not."""

from __future__ import annotations

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.association import association_marginals, association_marginals_batch, k_best_associations


def test_belief_propagation_is_exact_on_trees(enumerate_associations) -> None:
    rng = np.random.default_rng(0)
    star = 2 * rng.normal(size=(6, 1)), rng.normal(size=6)
    fan = 2 * rng.normal(size=(1, 6)), rng.normal(size=1)
    path = np.full((5, 5), -np.inf)
    steps = np.arange(5)
    path[steps, steps], path[steps[1:], steps[:-1]] = rng.normal(size=5), rng.normal(size=4)
    for likelihood, null in [star, fan, (path, rng.normal(size=5)), (700 * star[0], 700 * star[1])]:
        truth = enumerate_associations(likelihood, null)
        ours = association_marginals(likelihood, null, associator="belief_propagation")
        assert not ours.exact and ours.residual is not None and ours.residual < 1e-11
        np.testing.assert_allclose(ours.weights, truth.weights, rtol=0, atol=1e-10)
        np.testing.assert_allclose(ours.null, truth.null, rtol=0, atol=1e-10)
        assert ours.log_evidence == pytest.approx(truth.log_evidence, abs=1e-9)


def test_belief_propagation_is_close_on_dense_problems() -> None:
    rng = np.random.default_rng(1)
    likelihood, null = rng.normal(size=(8, 50)), np.zeros(8)
    exact = association_marginals(likelihood, null)
    ours = association_marginals(likelihood, null, associator="belief_propagation")
    assert ours.residual is not None and ours.residual < 1e-11
    assert 1e-9 < np.abs(ours.weights - exact.weights).max() < 5e-3
    assert ours.log_evidence == pytest.approx(exact.log_evidence, abs=0.05)
    np.testing.assert_allclose(ours.weights.sum(axis=1) + ours.null, 1, atol=1e-12)


def test_beyond_the_budget_belief_propagation_takes_over_and_says_so() -> None:
    rng = np.random.default_rng(2)
    likelihood = np.full((12, 14), -np.inf)
    likelihood[:8, :10] = rng.normal(size=(8, 10))  # beyond a budget of 2 000 subsets
    likelihood[8:, 10:] = rng.normal(size=(4, 4))  # within it
    null = rng.normal(size=12)
    exact = association_marginals(likelihood, null)
    ours = association_marginals(likelihood, null, budget=2000)
    assert exact.exact and not ours.exact and ours.residual is not None and ours.residual < 1e-11
    np.testing.assert_allclose(ours.weights[8:], exact.weights[8:], rtol=0, atol=1e-15)
    assert 1e-9 < np.abs(ours.weights - exact.weights).max() < 0.05
    assert exact.log_evidence - 0.3 < ours.log_evidence < exact.log_evidence  # Bethe bounds permanents from below


def test_forty_by_forty_dense_is_answered() -> None:
    rng = np.random.default_rng(3)
    ours = association_marginals(rng.normal(size=(40, 40)), np.zeros(40))
    assert not ours.exact and ours.residual is not None and ours.residual < 1e-9
    np.testing.assert_allclose(ours.weights.sum(axis=1) + ours.null, 1, atol=1e-12)
    assert (ours.weights.sum(axis=0) <= 1 + 1e-9).all()


def test_belief_propagation_without_null_is_finite() -> None:
    likelihood = np.array([[0.0, -1500.0], [0.0, -700.0]])
    ours = association_marginals(likelihood, np.full(2, -np.inf), associator="belief_propagation")
    np.testing.assert_allclose(ours.weights, np.eye(2), atol=1e-9)
    assert ours.log_evidence == pytest.approx(-700.0, abs=1e-6)


def test_softmax_is_each_detection_by_itself(problems) -> None:
    for (likelihood, null), ours in zip(problems, association_marginals_batch(problems, associator="softmax")):
        alone = [association_marginals(likelihood[i : i + 1], null[i : i + 1]) for i in range(len(null))]
        np.testing.assert_allclose(ours.null, [float(a.null[0]) for a in alone], rtol=0, atol=1e-12)
        for i, one in enumerate(alone):
            np.testing.assert_allclose(ours.weights[i], one.weights[0], rtol=0, atol=1e-12)
        assert ours.log_evidence == pytest.approx(sum(a.log_evidence for a in alone), rel=1e-14, abs=1e-9)
        assert not ours.exact and ours.residual is None


def test_hungarian_is_the_best_association(problems, enumerate_associations) -> None:
    for (likelihood, null), ours in zip(problems, association_marginals_batch(problems, associator="hungarian")):
        truth = enumerate_associations(likelihood, null)
        assert set(np.unique(ours.weights)) | set(np.unique(ours.null)) <= {0.0, 1.0}
        np.testing.assert_array_equal(ours.weights.sum(axis=1) + ours.null, np.ones(len(null)))
        assert ours.log_evidence == pytest.approx(truth.log_weight.max(), rel=1e-14, abs=1e-11)
        chosen = ours.weights > 0
        value = likelihood[chosen].sum() + null[ours.null > 0].sum()
        assert value == pytest.approx(ours.log_evidence, rel=1e-14, abs=1e-11)


def test_all_associations_listed_are_the_exact_sum(problems, enumerate_associations) -> None:
    for likelihood, null in problems[::4]:
        truth = enumerate_associations(likelihood, null)
        if len(truth.log_weight) > 1500:
            continue
        ours = association_marginals(likelihood, null, associator="k_best", k=len(truth.log_weight))
        assert ours.exact
        np.testing.assert_allclose(ours.weights, truth.weights, rtol=0, atol=1e-11)
        np.testing.assert_allclose(ours.null, truth.null, rtol=0, atol=1e-11)
        assert ours.log_evidence == pytest.approx(truth.log_evidence, rel=1e-14, abs=1e-10)


def test_the_k_best_are_the_first_of_all_sorted(problems, enumerate_associations) -> None:
    for likelihood, null in problems[3::6]:
        truth = enumerate_associations(likelihood, null)
        listed = k_best_associations(likelihood, null, 25)
        order = np.sort(truth.log_weight)[::-1][:25]
        np.testing.assert_allclose([a.log_weight for a in listed], order, rtol=1e-14, atol=1e-10)
        assert len({tuple(a.landmark) for a in listed}) == len(listed) == min(25, len(truth.log_weight))


def test_fewer_than_all_is_not_exact_and_bounds_the_evidence_from_below() -> None:
    rng = np.random.default_rng(4)
    likelihood, null = rng.normal(size=(4, 5)), np.zeros(4)
    exact = association_marginals(likelihood, null)
    last = -np.inf
    for k in (1, 5, 50, 200):
        ours = association_marginals(likelihood, null, associator="k_best", k=k)
        assert not ours.exact and last < ours.log_evidence < exact.log_evidence
        last = ours.log_evidence


def test_errors() -> None:
    likelihood, null = np.zeros((2, 2)), np.zeros(2)
    with pytest.raises(InputError, match=r"unknown associator: got 'nearest', expected exact or"):
        association_marginals(likelihood, null, associator="nearest")  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"number of associations to list: got 0"):
        association_marginals(likelihood, null, associator="k_best", k=0)
    with pytest.raises(InputError, match=r"gate of reduced weights: got 1.5"):
        association_marginals(likelihood, null, gate=1.5)
