"""The oracle of the association tests: every joint association written out, and the problems they are tried on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest


@dataclass(frozen=True)
class Enumeration:
    """All joint associations of a small problem and what they add up to."""

    landmark: np.ndarray
    log_weight: np.ndarray
    weights: np.ndarray
    null: np.ndarray
    log_evidence: float


def _joint_associations(likelihood: np.ndarray, null: np.ndarray, row: int = 0, used: int = 0) -> Iterator[tuple]:
    """Yield (landmarks of the detections from `row` on, log weight) of every possible association."""
    if row == len(null):
        yield (), 0.0
        return
    if null[row] > -np.inf:
        for rest, value in _joint_associations(likelihood, null, row + 1, used):
            yield (-1, *rest), null[row] + value
    for column in range(likelihood.shape[1]):
        if likelihood[row, column] > -np.inf and not used >> column & 1:
            for rest, value in _joint_associations(likelihood, null, row + 1, used | 1 << column):
                yield (column, *rest), likelihood[row, column] + value


@pytest.fixture(scope="session")
def enumerate_associations() -> Callable[[np.ndarray, np.ndarray], Enumeration]:
    """Brute force: recursion over detections, no shortcut shared with the library."""

    def run(likelihood: np.ndarray, null: np.ndarray) -> Enumeration:
        n, m = likelihood.shape
        listed = list(_joint_associations(likelihood, null))
        landmark = np.array([a for a, _ in listed], dtype=int).reshape(len(listed), n)
        log_weight = np.array([w for _, w in listed])
        probability = np.exp(log_weight - log_weight.max())
        log_evidence = float(log_weight.max() + np.log(probability.sum()))
        probability = probability / probability.sum()
        weights = np.stack([probability @ (landmark == j) for j in range(m)], axis=1) if m else np.zeros((n, 0))
        return Enumeration(landmark, log_weight, weights, probability @ (landmark < 0), log_evidence)

    return run


def _dense(rng: np.random.Generator, n: int, m: int, spread: float) -> tuple[np.ndarray, np.ndarray]:
    return spread * rng.normal(size=(n, m)), spread * rng.normal(size=n)


def _sparse(rng: np.random.Generator, n: int, m: int) -> tuple[np.ndarray, np.ndarray]:
    likelihood, null = _dense(rng, n, m, 2.0)
    likelihood[rng.random((n, m)) < 0.6] = -np.inf
    return likelihood, null


def _forced(rng: np.random.Generator, n: int, m: int, spread: float) -> tuple[np.ndarray, np.ndarray]:
    """No null hypothesis for some; feasible when n <= m, as one landmark of each stays possible."""
    likelihood, null = _dense(rng, n, m, spread)
    hidden = rng.random((n, m)) < 0.4
    places = rng.permutation(m)[: min(n, m)]
    hidden[np.arange(len(places)), places] = False
    likelihood[hidden] = -np.inf
    null[: len(places)][rng.random(len(places)) < 0.6] = -np.inf
    return likelihood, null


def _alike(rng: np.random.Generator, n: int, m: int) -> tuple[np.ndarray, np.ndarray]:
    """Landmarks that look the same: few distinct columns, ties in every path."""
    kinds = rng.normal(size=(n, 2)) * 3
    return kinds[:, rng.integers(0, 2, size=m)], np.full(n, -2.0)


def _staircase(rng: np.random.Generator, n: int, m: int) -> tuple[np.ndarray, np.ndarray]:
    """Every detection wants the landmark of the one before more than its own: prices pile up."""
    likelihood = np.full((n, m), -np.inf)
    for i in range(n):
        for j in range(min(i + 1, m)):
            likelihood[i, j] = 300.0 * (i - j) + rng.normal()
    return likelihood, np.full(n, -1500.0)


_KINDS: dict[str, Callable[..., tuple[np.ndarray, np.ndarray]]] = {
    "dense": partial(_dense, spread=2.0),
    "spread over 2 000 nats": partial(_dense, spread=700.0),
    "sparse": _sparse,
    "forced": partial(_forced, spread=2.0),
    "forced over 2 000 nats": partial(_forced, spread=700.0),
    "look-alikes": _alike,
    "staircase": _staircase,
}


@pytest.fixture(params=list(_KINDS))
def problems(request: pytest.FixtureRequest) -> list[tuple[np.ndarray, np.ndarray]]:
    """Forty problems of one kind: empty sides, more detections than landmarks, and the reverse."""
    rng = np.random.default_rng(list(_KINDS).index(request.param))
    shapes = [(0, 0), (0, 3), (3, 0), (1, 1), (1, 6), (6, 1), (5, 5), (6, 3), (3, 6), (4, 7)]
    shapes += [tuple(rng.integers(1, 6, size=2)) for _ in range(30)]
    return [_KINDS[request.param](rng, int(n), int(m)) for n, m in shapes]
