"""Loopy belief propagation for associations beyond the exact budget.

Messages are ratios (taken over not taken) on the edges of the bipartite graph, after Williams and Lau, "Approximate
evaluation of marginal association probabilities with belief propagation" (IEEE TAES 50, 2014), on reduced weights
(see `assignment`). Exact when the graph is a tree; elsewhere the evidence is Bethe's approximation.
"""

from __future__ import annotations

import numpy as np
from numba import njit

ITERATIONS = 5000
TOLERANCE = 1e-12
"""Largest difference between the beliefs of detections and of landmarks at which the messages have converged."""
FLOOR = 1e-150
"""Smallest weight of staying alone: keeps ratios of messages finite where a null hypothesis is impossible."""


@njit(cache=True, nogil=True)
def propagate(
    reduced: np.ndarray,
    alone_row: np.ndarray,
    alone_column: np.ndarray,
    iterations: int,
    tolerance: float,
    weights: np.ndarray,
    null: np.ndarray,
) -> tuple[float, float, int]:
    """Belief propagation on reduced weights [n, m]; fills the marginals `weights` [n, m] and `null` [n].

    Returns Bethe's log evidence (relative to the potentials), the residual (the largest difference between what
    detections and landmarks believe of one edge) and the number of iterations.
    """
    n, m = reduced.shape
    to_column, to_row = np.zeros((n, m)), np.empty((n, m))
    before = np.empty(max(n, m) + 1)
    for j in range(m):
        alone_column[j] = max(alone_column[j], FLOOR)
        for i in range(n):
            to_row[i, j] = 1.0 / alone_column[j]
    for i in range(n):
        alone_row[i] = max(alone_row[i], FLOOR)
    residual, rounds = np.inf, 0
    while rounds < iterations and residual > tolerance:
        rounds += 1
        # exclusive sums by prefix and suffix: subtracting an edge from the full sum would cancel
        for i in range(n):
            before[0] = alone_row[i]
            for j in range(m):
                before[j + 1] = before[j] + reduced[i, j] * to_row[i, j]
            after, total = 0.0, before[m]
            null[i] = alone_row[i] / total
            for j in range(m - 1, -1, -1):
                to_column[i, j] = reduced[i, j] / (before[j] + after)
                weights[i, j] = reduced[i, j] * to_row[i, j] / total
                after += reduced[i, j] * to_row[i, j]
        residual = 0.0
        for j in range(m):
            before[0] = alone_column[j]
            for i in range(n):
                before[i + 1] = before[i] + to_column[i, j]
            after = 0.0
            for i in range(n - 1, -1, -1):
                to_row[i, j] = 1.0 / (before[i] + after)
                after += to_column[i, j]
                residual = max(residual, abs(to_column[i, j] / before[n] - weights[i, j]))
    return _bethe(reduced, alone_row, alone_column, to_column, to_row), residual, rounds


@njit(cache=True, nogil=True)
def _bethe(
    reduced: np.ndarray, alone_row: np.ndarray, alone_column: np.ndarray, to_column: np.ndarray, to_row: np.ndarray
) -> float:
    """Bethe's log evidence: log normalisers of detections and landmarks, less those of the edges between them."""
    n, m = reduced.shape
    value = 0.0
    for i in range(n):
        total = alone_row[i]
        for j in range(m):
            total += reduced[i, j] * to_row[i, j]
            value -= np.log1p(to_column[i, j] * to_row[i, j])
        value += np.log(total)
    for j in range(m):
        total = alone_column[j]
        for i in range(n):
            total += to_column[i, j]
        value += np.log(total)
    return value
