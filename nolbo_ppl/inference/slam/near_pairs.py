"""Pairs of points that are near one another: by a matrix where that is small, by a tree where it is not.

20 000 detections in each of two frames are 400 million pairs, of which a few thousand are near: the matrix of their gaps and
covariances would be 38 GB.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from nolbo_ppl.errors import input_error

DENSE_PAIRS = 1 << 16
"""Pairs up to which the matrix is faster."""
CHUNK_PAIRS = 1 << 21
"""Pairs that are looked at together."""
MAX_PAIRS = 1 << 25
"""Near pairs above which the problem is refused: each takes some hundred bytes further on."""


def near_pairs(
    a: Float[np.ndarray, "n 3"],
    square_a: Float[np.ndarray, " n"],
    b: Float[np.ndarray, "m 3"],
    square_b: Float[np.ndarray, " m"],
) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """All pairs with `|a_i - b_j|^2 <= square_a[i] + square_b[j]`, ascending by i, then j.

    Args:
        a: points, m.
        square_a: their parts of the squared reach, m^2.
        b: the others, m.
        square_b: their parts.

    Raises:
        InputError: more than `MAX_PAIRS` of them.

    Example:
        >>> near_pairs(np.zeros((1, 3)), np.ones(1), np.array([[0, 0, 1.0], [0, 0, 2.0]]), np.zeros(2))
        (array([0]), array([0]))
    """
    if len(a) * len(b) <= DENSE_PAIRS:
        gap = a[:, None] - b[None]
        i, j = np.nonzero(np.sum(gap**2, axis=2) <= square_a[:, None] + square_b[None])
        return i, j
    tree = cKDTree(b)
    reach = np.sqrt(square_a + square_b.max()) * (1 + 1e-9)
    count = tree.query_ball_point(a, reach, return_length=True)
    # Rows in runs of about CHUNK_PAIRS pairs each, one row at least.
    runs = np.split(np.arange(len(a)), np.flatnonzero(np.diff(np.cumsum(count) // CHUNK_PAIRS)) + 1)
    found_i, found_j, total = [], [], 0
    for rows in runs:
        i = np.repeat(rows, count[rows])
        j = np.concatenate(
            [np.asarray(x, dtype=np.int64) for x in tree.query_ball_point(a[rows], reach[rows], return_sorted=True)]
        )
        near = np.sum((a[i] - b[j]) ** 2, axis=1) <= square_a[i] + square_b[j]
        found_i.append(i[near])
        found_j.append(j[near])
        total += int(near.sum())
        if total > MAX_PAIRS:
            raise input_error(
                "too many detections that could be one another's",
                got=f"more than {MAX_PAIRS} pairs of {len(a)} detections and {len(b)} objects",
                do="state smaller position scales, or give fewer detections a frame",
            )
    return np.concatenate(found_i), np.concatenate(found_j)
