"""Pair scores against brute force, NEES against its distribution."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.metrics.association import association_pairs, brier_score, landmark_to_object, normalised_error_squared


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("gap", [0, 1, 7])
def test_pairs_equal_brute_force(seed: int, gap: int) -> None:
    rng = np.random.default_rng(seed)
    frame, truth, found = rng.integers(0, 30, 80), rng.integers(-1, 6, 80), rng.integers(-1, 7, 80)
    counts = np.zeros(3, dtype=int)
    for i, j in combinations(range(80), 2):
        if abs(frame[i] - frame[j]) > gap:
            one = truth[i] == truth[j] >= 0
            put = found[i] == found[j] >= 0
            counts += [one, put, one and put]
    score = association_pairs(frame, truth, found, gap)
    assert (score.true_pairs, score.found_pairs, score.correct_pairs) == tuple(counts)
    assert score.precision == pytest.approx(counts[2] / counts[1])
    assert score.recall == pytest.approx(counts[2] / counts[0])
    assert score.f1 == pytest.approx(2 * counts[2] / (counts[0] + counts[1]))


def test_nothing_found_is_precise_and_incomplete() -> None:
    score = association_pairs(np.array([0, 9]), np.array([1, 1]), np.array([-1, -1]))
    assert (score.precision, score.recall, score.f1) == (1.0, 0.0, 0.0)


@pytest.mark.parametrize("weighted", [False, True])
def test_object_of_a_landmark_equals_brute_force(weighted: bool) -> None:
    rng = np.random.default_rng(5)
    for count in (0, 1, 60):
        truth, found = rng.integers(-2, 4, count), rng.integers(-1, 7, count)
        weight = rng.integers(0, 3, count) / 4 if weighted else np.ones(count)  # ties, and associations of weight zero
        owner, share = landmark_to_object(truth, found, 8, weight if weighted else None)
        for j in range(8):
            votes = {o: weight[(found == j) & (truth == o)].sum() for o in sorted(set(truth[found == j].tolist()))}
            total = sum(votes.values())
            best = max(votes, key=votes.__getitem__) if total else -1  # the first of equal ones: the smaller number
            assert owner[j] == best and share[j] == pytest.approx(votes[best] / total if total else 0.0)


def test_lengths_must_match() -> None:
    with pytest.raises(InputError, match="different lengths"):
        association_pairs(np.zeros(2), np.zeros(3), np.zeros(2))


def test_normalised_errors_average_to_one() -> None:
    rng = np.random.default_rng(0)
    root = rng.standard_normal((4, 4))
    covariance = root @ root.T + np.eye(4)
    n = 4000
    error = rng.multivariate_normal(np.zeros(4), covariance, n)
    nees = normalised_error_squared(error, np.tile(covariance, (n, 1, 1)))
    assert nees.mean() == pytest.approx(1.0, abs=5 * np.sqrt(2 / 4 / n))


def test_singular_covariances_raise() -> None:
    with pytest.raises(InputError, match="singular"):
        normalised_error_squared(np.ones((1, 2)), np.zeros((1, 2, 2)))


def test_brier_score_of_certainty() -> None:
    assert brier_score(np.array([1.0, 0.0, 0.5]), np.array([True, False, True])) == pytest.approx(0.25 / 3)
