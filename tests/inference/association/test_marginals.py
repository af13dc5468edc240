"""Exact marginals against enumeration, and the identities they must keep."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from nolbo_ppl.inference.association import association_marginals, association_marginals_batch

TOLERANCE = 1e-11


def test_equals_enumeration(problems, enumerate_associations) -> None:
    for likelihood, null in problems:
        truth = enumerate_associations(likelihood, null)
        ours = association_marginals(likelihood, null)
        assert ours.exact and ours.residual is None
        assert ours.weights.shape == likelihood.shape and ours.null.shape == null.shape
        np.testing.assert_allclose(ours.weights, truth.weights, rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(ours.null, truth.null, rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(ours.log_evidence, truth.log_evidence, rtol=1e-14, atol=TOLERANCE)


def test_small_probabilities_are_relatively_exact_without_a_gate(enumerate_associations) -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        likelihood, null = 25 * rng.normal(size=(4, 5)), 25 * rng.normal(size=4)
        truth = enumerate_associations(likelihood, null)
        ours = association_marginals(likelihood, null, gate=0.0)
        assert truth.weights.min() < 1e-14
        np.testing.assert_allclose(ours.weights, truth.weights, rtol=1e-9, atol=1e-200)
        np.testing.assert_allclose(ours.null, truth.null, rtol=1e-9, atol=1e-200)


def test_rows_sum_to_one_and_columns_to_at_most_one(problems) -> None:
    for likelihood, null in problems:
        ours = association_marginals(likelihood, null)
        assert (ours.weights >= 0).all() and (ours.null >= 0).all()
        np.testing.assert_allclose(ours.weights.sum(axis=1) + ours.null, 1, atol=1e-12)
        assert (ours.weights.sum(axis=0) <= 1 + 1e-12).all()
        assert (ours.weights[likelihood == -np.inf] == 0).all() and (ours.null[null == -np.inf] == 0).all()


def test_a_batch_gives_what_its_frames_give(problems) -> None:
    for (likelihood, null), ours in zip(problems, association_marginals_batch(problems), strict=True):
        alone = association_marginals(likelihood, null)
        np.testing.assert_array_equal(ours.weights, alone.weights)
        np.testing.assert_array_equal(ours.null, alone.null)
        assert ours.log_evidence == alone.log_evidence and ours.exact


def test_an_empty_batch() -> None:
    assert association_marginals_batch([]) == []


@pytest.mark.parametrize("spread", [1.0, 8.0])
def test_evidence_has_the_weights_as_its_gradient(spread: float) -> None:
    rng = np.random.default_rng(11)
    step = 1e-5
    for n, m in [(4, 6), (6, 3), (5, 5)]:
        likelihood, null = spread * rng.normal(size=(n, m)), spread * rng.normal(size=n)
        ours = association_marginals(likelihood, null)
        for i in range(n):
            for j in range(m):
                up, down = likelihood.copy(), likelihood.copy()
                up[i, j] += step
                down[i, j] -= step
                slope = association_marginals(up, null).log_evidence - association_marginals(down, null).log_evidence
                assert slope / (2 * step) == pytest.approx(ours.weights[i, j], abs=2e-8)
            up, down = null.copy(), null.copy()
            up[i] += step
            down[i] -= step
            slope = association_marginals(likelihood, up).log_evidence
            slope -= association_marginals(likelihood, down).log_evidence
            assert slope / (2 * step) == pytest.approx(ours.null[i], abs=2e-8)


_log = st.one_of(st.just(-np.inf), st.floats(-2000, 2000), st.sampled_from([0.0, -1.0, -1000.0]))


@st.composite
def _problem(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    n, m = draw(st.integers(0, 6)), draw(st.integers(0, 6))
    null = arrays(float, n, elements=st.floats(-2000, 2000))
    return draw(arrays(float, (n, m), elements=_log)), draw(null)


@settings(max_examples=150, deadline=None)
@given(_problem(), st.randoms(use_true_random=False))
def test_permutation_moves_the_weights_along(problem, random) -> None:
    likelihood, null = problem
    rows, columns = list(range(likelihood.shape[0])), list(range(likelihood.shape[1]))
    random.shuffle(rows)
    random.shuffle(columns)
    ours = association_marginals(likelihood, null)
    moved = association_marginals(likelihood[np.ix_(rows, columns)], null[rows])
    np.testing.assert_allclose(moved.weights, ours.weights[np.ix_(rows, columns)], rtol=0, atol=1e-9)
    assert moved.log_evidence == pytest.approx(ours.log_evidence, abs=1e-9)


@settings(max_examples=150, deadline=None)
@given(_problem(), st.floats(-1000, 1000))
def test_a_constant_on_a_row_only_shifts_the_evidence(problem, constant) -> None:
    likelihood, null = problem
    shift = constant * np.arange(1, len(null) + 1) / 3
    ours = association_marginals(likelihood, null)
    shifted = association_marginals(likelihood + shift[:, None], null + shift)
    np.testing.assert_allclose(shifted.weights, ours.weights, rtol=0, atol=1e-9)
    np.testing.assert_allclose(shifted.null, ours.null, rtol=0, atol=1e-9)
    assert shifted.log_evidence == pytest.approx(ours.log_evidence + shift.sum(), abs=1e-9)


@settings(max_examples=150, deadline=None)
@given(_problem())
def test_any_problem_equals_enumeration(enumerate_associations, problem) -> None:
    truth, ours = enumerate_associations(*problem), association_marginals(*problem)
    np.testing.assert_allclose(ours.weights, truth.weights, rtol=0, atol=1e-9)
    assert ours.log_evidence == pytest.approx(truth.log_evidence, abs=1e-9)


def test_a_vanishing_null_gives_the_answer_without_null(enumerate_associations) -> None:
    rng = np.random.default_rng(3)
    for n, m in [(3, 3), (4, 6), (1, 2)]:
        likelihood = 2 * rng.normal(size=(n, m))
        forced = association_marginals(likelihood, np.full(n, -np.inf))
        truth = enumerate_associations(likelihood, np.full(n, -np.inf))
        np.testing.assert_allclose(forced.weights, truth.weights, rtol=0, atol=TOLERANCE)
        assert (forced.null == 0).all()
        differences = []
        for null in (-10.0, -20.0, -40.0, -2000.0):
            nearly = association_marginals(likelihood, np.full(n, null))
            differences.append(np.abs(nearly.weights - forced.weights).max())
        assert differences[0] > differences[1] > 1e-13
        assert differences[2] < 1e-12 and differences[3] < 1e-12


def test_a_forced_second_choice_is_certain_however_small(enumerate_associations) -> None:
    """Raw weights of exp(-1990) that must be taken: a gate on raw weights would call this infeasible."""
    likelihood = np.array([[0.0, -1990.0], [0.0, -1000.0]])
    ours = association_marginals(likelihood, np.full(2, -np.inf))
    np.testing.assert_allclose(ours.weights, [[1, 0], [0, 1]], atol=1e-15)
    assert ours.log_evidence == pytest.approx(-1000.0, abs=1e-12)


def test_look_alikes_share_evenly() -> None:
    """By symmetry alone: n detections over m equal landmarks, null weight 1; Z = sum_k C(n, k) m! / (m - k)!."""
    from math import comb, log, perm

    for n, m in [(8, 50), (50, 8), (6, 6)]:
        ours = association_marginals(np.zeros((n, m)), np.zeros(n))
        total = sum(comb(n, k) * perm(m, k) for k in range(min(n, m) + 1))
        placed = sum(k * comb(n, k) * perm(m, k) for k in range(min(n, m) + 1)) / total
        np.testing.assert_allclose(ours.weights, placed / (n * m), rtol=1e-12)
        assert ours.log_evidence == pytest.approx(log(total), abs=1e-11)


def test_the_objectness_of_a_detection_without_null_cancels() -> None:
    """The correction of the paper's weight: without a background hypothesis a factor per detection divides out."""
    rng = np.random.default_rng(8)
    likelihood, objectness = rng.normal(size=(4, 5)), np.log(rng.random(4))
    plain = association_marginals(likelihood, np.full(4, -np.inf))
    scaled = association_marginals(likelihood + objectness[:, None], np.full(4, -np.inf))
    np.testing.assert_allclose(scaled.weights, plain.weights, atol=1e-13)
    with_null = (
        association_marginals(likelihood, np.zeros(4)),
        association_marginals(likelihood + objectness[:, None], np.log1p(-np.exp(objectness))),
    )
    assert np.abs(with_null[0].weights - with_null[1].weights).max() > 0.01


def test_the_gate_costs_what_its_documentation_says(enumerate_associations) -> None:
    """About the gate on random problems; 2^(n - 2) times the gated weight where exact ties pile up."""
    rng = np.random.default_rng(13)
    for _ in range(100):
        n, m = rng.integers(1, 9, size=2)
        likelihood, null = 20 * rng.normal(size=(n, m)), 20 * rng.normal(size=n)
        gated, full = association_marginals(likelihood, null), association_marginals(likelihood, null, gate=0.0)
        np.testing.assert_allclose(gated.weights, full.weights, rtol=0, atol=5e-12)
    ties = np.where(np.triu(np.ones((6, 6))) > 0, 0.0, -np.inf)
    ties[5, 0] = np.log(0.9e-12)
    forced = np.full(6, -np.inf)
    truth = enumerate_associations(ties, forced)
    np.testing.assert_allclose(association_marginals(ties, forced, gate=0.0).weights, truth.weights, atol=1e-15)
    error = np.abs(association_marginals(ties, forced).weights - truth.weights).max()
    assert error == pytest.approx(2**4 * 0.9e-12, rel=1e-3)


def _log_sum(likelihood: np.ndarray, null: np.ndarray) -> float:
    """Log evidence by a dictionary of the sets of landmarks taken, detection after detection, in plain Python."""
    sums = {frozenset[int](): 1.0}
    for row, alone in zip(np.exp(likelihood), np.exp(null)):
        following: dict[frozenset[int], float] = {}
        for taken, value in sums.items():
            following[taken] = following.get(taken, 0.0) + value * alone
            for column in np.flatnonzero(row > 0).tolist():
                if column not in taken:
                    grown = taken | {column}
                    following[grown] = following.get(grown, 0.0) + value * row[column]
        sums = following
    return float(np.log(sum(sums.values())))


@pytest.mark.parametrize("kind", ["band", "random", "two hubs"])
def test_larger_sparse_components(kind: str) -> None:
    """Components in which members open and close on the way: every marginal is a ratio of two evidences."""
    rng = np.random.default_rng(17)
    for n, m in [(9, 10), (11, 7), (7, 11), (10, 10), (12, 5)]:
        kept = rng.random((n, m)) < 0.25
        if kind == "band":
            kept = np.abs(np.arange(n)[:, None] / n - np.arange(m) / m) < 0.2
        elif kind == "two hubs":
            kept[:, 0] = kept[0] = kept[-1] = True
        likelihood, null = np.where(kept, rng.normal(size=(n, m)), -np.inf), rng.normal(size=n)
        rows, columns = rng.permutation(n), rng.permutation(m)
        likelihood = likelihood[np.ix_(rows, columns)]
        ours, total = association_marginals(likelihood, null), _log_sum(likelihood, null)
        assert ours.exact and ours.log_evidence == pytest.approx(total, abs=1e-11)
        for i in range(n):
            rest = np.delete(likelihood, i, axis=0), np.delete(null, i)
            assert ours.null[i] == pytest.approx(np.exp(null[i] + _log_sum(*rest) - total), abs=1e-12)
        for i, j in np.argwhere(np.isfinite(likelihood))[:: 1 + n * m // 40]:
            rest = np.delete(np.delete(likelihood, i, axis=0), j, axis=1), np.delete(null, i)
            expected = np.exp(likelihood[i, j] + _log_sum(*rest) - total)
            assert ours.weights[i, j] == pytest.approx(expected, abs=1e-12)


def _chain(rng: np.random.Generator, length: int) -> tuple[np.ndarray, np.ndarray]:
    """Detection i sees landmarks i and i + 1 alone: one component of any length, a frontier of one or two."""
    likelihood = np.full((length, length + 1), -np.inf)
    steps = np.arange(length)
    likelihood[steps, steps], likelihood[steps, steps + 1] = rng.normal(size=(2, length))
    return likelihood, rng.normal(size=length)


def test_a_long_chain_is_exact() -> None:
    """A component of 200 detections and 201 landmarks: its Z by a three-term recursion along the chain."""
    rng = np.random.default_rng(21)
    likelihood, null = _chain(rng, 200)
    free, taken = 0.0, -np.inf  # log sums with landmark i free or taken by detection i - 1
    for i in range(200):
        either = np.logaddexp(free, taken)
        free, taken = np.logaddexp(either + null[i], free + likelihood[i, i]), either + likelihood[i, i + 1]
    order, columns = rng.permutation(200), rng.permutation(201)
    ours = association_marginals(likelihood[np.ix_(order, columns)], null[order])
    assert ours.exact
    assert ours.log_evidence == pytest.approx(np.logaddexp(free, taken), abs=1e-10)
    np.testing.assert_allclose(ours.weights.sum(axis=1) + ours.null, 1, atol=1e-12)


def test_components_are_independent() -> None:
    rng = np.random.default_rng(31)
    blocks = [(rng.normal(size=(n, m)), rng.normal(size=n)) for n, m in [(3, 4), (5, 2), (1, 1), (4, 4)]]
    rows, columns = sum(len(b[1]) for b in blocks), sum(b[0].shape[1] for b in blocks)
    likelihood, i, j = np.full((rows, columns), -np.inf), 0, 0
    for block, _ in blocks:
        likelihood[i : i + block.shape[0], j : j + block.shape[1]] = block
        i, j = i + block.shape[0], j + block.shape[1]
    joint = association_marginals(likelihood, np.concatenate([b[1] for b in blocks]))
    parts = [association_marginals(*block) for block in blocks]
    assert joint.log_evidence == pytest.approx(sum(part.log_evidence for part in parts), abs=1e-12)
    np.testing.assert_allclose(joint.null, np.concatenate([part.null for part in parts]), atol=1e-13)


def test_extreme_problems_stay_finite_and_agree_with_their_reduction() -> None:
    """400 larger problems over 2 000 nats: rows sum to one, and a landmark out of every path changes nothing."""
    rng = np.random.default_rng(41)
    for trial in range(400):
        n, m = rng.integers(1, 10, size=2)
        likelihood, null = rng.uniform(-2000, 0, size=(n, m)), rng.uniform(-2000, 0, size=n)
        if trial % 2:
            likelihood = np.round(likelihood / 250) * 250  # ties at every scale
        ours = association_marginals(likelihood, null)
        assert np.isfinite(ours.log_evidence)
        np.testing.assert_allclose(ours.weights.sum(axis=1) + ours.null, 1, atol=1e-12)
        assert (ours.weights.sum(axis=0) <= 1 + 1e-12).all()
        shifted = association_marginals(likelihood - null[:, None], np.zeros(n))
        np.testing.assert_allclose(shifted.weights, ours.weights, atol=1e-10)
