"""The k best joint associations of a frame, by Murty's partition of what remains.

Murty, "An algorithm for ranking all the assignments in order of increasing cost" (Operations Research 16, 1968): the
associations other than the best are split by the first detection that differs from it, and each part has a best one
of its own, found by the same shortest paths.
"""

from __future__ import annotations

import heapq
from itertools import count as counter

import numpy as np
from numpy.typing import ArrayLike

from nolbo_ppl.errors import input_error
from nolbo_ppl.inference.association.assignment import Association, best_assignments, try_assign
from nolbo_ppl.inference.association.problem import Frames, pack_frames


def k_best_associations(log_likelihood: ArrayLike, log_null: ArrayLike, k: int) -> list[Association]:
    """The `k` most probable joint associations of a frame, best first; all of them when there are fewer.

    Args:
        log_likelihood: [n, m] log weight of each detection and landmark in nats, -inf for the impossible.
        log_null: [n] log weight of each detection's null hypothesis in nats.
        k: how many to list.

    Raises:
        InputError: k below 1, wrong shapes, NaN or plus infinity, or no association is possible.
    """
    if k < 1:
        raise input_error("number of associations to list", got=k, expected="k of at least 1")
    frames = pack_frames([(log_likelihood, log_null)])
    best = best_assignments(frames)
    order = counter()  # breaks ties in the heap by age
    heap = [(-float(best.log_weight[0]), next(order), best.match, frames, 0)]
    found: list[Association] = []
    while heap and len(found) < k:
        negative, _, match, region, fixed = heapq.heappop(heap)
        found.append(Association(match, -negative))
        if len(found) < k:
            for part, agreeing in _partition(region, match, fixed):
                other, failed = try_assign(part)
                if failed[0] < 0:
                    heapq.heappush(heap, (-float(other.log_weight[0]), next(order), other.match, part, agreeing))
    return found


def _partition(region: Frames, match: np.ndarray, fixed: int) -> list[tuple[Frames, int]]:
    """Parts of a region without its best association: agreeing up to a detection, and differing there.

    The detections before `fixed` already have one choice each in `region`.
    """
    parts = []
    likelihood, null = region.matrix(region.log_likelihood, 0).copy(), region.log_null.copy()
    for row in range(fixed, len(match)):
        column = int(match[row])
        without_likelihood, without_null = likelihood.copy(), null.copy()
        if column < 0:
            without_null[row] = -np.inf
        else:
            without_likelihood[row, column] = -np.inf
        if without_null[row] > -np.inf or (without_likelihood[row] > -np.inf).any():
            parts.append((_replaced(region, without_likelihood, without_null), row))
        if column < 0:
            likelihood[row] = -np.inf
        else:
            kept = likelihood[row, column]
            likelihood[row], null[row] = -np.inf, -np.inf
            likelihood[row, column] = kept
    return parts


def _replaced(region: Frames, likelihood: np.ndarray, null: np.ndarray) -> Frames:
    return Frames(likelihood.reshape(-1), null, region.row_start, region.column_start, region.cell_start)
