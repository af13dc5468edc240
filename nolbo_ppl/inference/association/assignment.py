"""The best joint association and its dual potentials, by successive shortest augmenting paths.

The potentials u (detections) and v (landmarks, v >= 0) satisfy `u_i + v_j >= log_likelihood_ij` and
`u_i >= log_null_i` with equality along the best association, so the *reduced* weights
`exp(log_likelihood_ij - u_i - v_j)`, `exp(log_null_i - u_i)` and, for an unused landmark, `exp(-v_j)` are at most 1
and all 1 along it: sums over associations of products of reduced weights neither overflow nor underflow, whatever the
spread of the logs.

scipy's `linear_sum_assignment` gives no potentials (they would need Bellman sweeps) and costs one Python call a frame;
the path search below yields both, for a whole sequence in one compiled call.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numba import njit
from numpy.typing import ArrayLike

from nolbo_ppl.inference.association.problem import Frames, infeasible_error, pack_frames


@dataclass(frozen=True)
class BestAssignments:
    """Best association of every frame, with the potentials that prove it best."""

    match: Int[np.ndarray, " detections"]
    """Landmark (column of its frame) of every detection, -1 for the null hypothesis."""
    row_potential: Float[np.ndarray, " detections"]
    """u, in nats."""
    column_potential: Float[np.ndarray, " landmarks"]
    """v >= 0, in nats; above zero for landmarks that are taken only."""
    log_weight: Float[np.ndarray, " frames"]
    """Log weight of the best association of each frame, in nats."""


@dataclass(frozen=True)
class Association:
    """One joint association of the detections of a frame."""

    landmark: Int[np.ndarray, " n"]
    """Landmark of every detection, -1 for the null hypothesis."""
    log_weight: float
    """Its log weight: the sum of the chosen entries, in nats."""


@njit(cache=True, nogil=True)
def _place(
    row: int,
    values: np.ndarray,
    null: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    match: np.ndarray,
    owner: np.ndarray,
    distance: np.ndarray,
    previous: np.ndarray,
    reached: np.ndarray,
    order: np.ndarray,
) -> bool:
    """Place one more detection along the shortest alternating path (Dijkstra on slacks); False when there is none.

    Each detection ends a path by its own null, each free landmark by itself. Ties go to what was found first.
    """
    columns = v.shape[0]
    distance[:columns] = np.inf
    reached[:columns] = False
    scanned = 0
    current, current_distance = row, 0.0
    shortest, end_row, end_column = np.inf, -1, -1
    while True:
        through_null = current_distance + (u[current] - null[current])
        if through_null < shortest:
            shortest, end_row, end_column = through_null, current, -1
        nearest, nearest_distance = -1, np.inf
        for column in range(columns):
            if reached[column]:
                continue
            step = current_distance + ((u[current] + v[column]) - values[current, column])
            if step < distance[column]:
                distance[column] = step
                previous[column] = current
            if distance[column] < nearest_distance:
                nearest, nearest_distance = column, distance[column]
        if nearest_distance >= shortest:
            break
        if owner[nearest] < 0:
            shortest, end_row, end_column = nearest_distance, previous[nearest], nearest
            break
        reached[nearest] = True
        order[scanned] = nearest
        scanned += 1
        current, current_distance = owner[nearest], nearest_distance
    if end_row < 0:
        return False
    u[row] -= shortest
    for position in range(scanned):
        column = order[position]
        gain = shortest - distance[column]
        u[owner[column]] -= gain
        v[column] += gain
    while True:
        freed = match[end_row]
        match[end_row] = end_column
        if end_column >= 0:
            owner[end_column] = end_row
        if end_row == row:
            return True
        end_column, end_row = freed, previous[freed]


@njit(cache=True, nogil=True)
def _assign(
    log_likelihood: np.ndarray,
    log_null: np.ndarray,
    row_start: np.ndarray,
    column_start: np.ndarray,
    cell_start: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    match: np.ndarray,
    log_weight: np.ndarray,
    failed: np.ndarray,
) -> None:
    """Best association of every frame; `failed[f]` is the detection that could not be placed, or -1."""
    widest = 0
    for frame in range(failed.shape[0]):
        widest = max(widest, column_start[frame + 1] - column_start[frame])
    owner = np.empty(widest, np.int64)
    distance = np.empty(widest)
    previous = np.empty(widest, np.int64)
    reached = np.empty(widest, np.bool_)
    order = np.empty(widest, np.int64)
    for frame in range(failed.shape[0]):
        first, last = row_start[frame], row_start[frame + 1]
        rows, columns = last - first, column_start[frame + 1] - column_start[frame]
        values = log_likelihood[cell_start[frame] : cell_start[frame + 1]].reshape(rows, columns)
        null, potential, partner = log_null[first:last], u[first:last], match[first:last]
        price = v[column_start[frame] : column_start[frame + 1]]
        price[:] = 0.0
        owner[:columns] = -1
        failed[frame] = -1
        total = 0.0
        for row in range(rows):
            best = null[row]
            for column in range(columns):
                best = max(best, values[row, column])
            potential[row] = best
            if best == -np.inf or not _place(
                row, values, null, potential, price, partner, owner, distance, previous, reached, order
            ):
                failed[frame] = row
                break
        if failed[frame] < 0:
            for row in range(rows):
                total += null[row] if partner[row] < 0 else values[row, partner[row]]
        log_weight[frame] = total


def try_assign(frames: Frames) -> tuple[BestAssignments, Int[np.ndarray, " frames"]]:
    """Best association of every frame, and per frame the first detection that cannot be placed (-1: all can)."""
    count = len(frames)
    best = BestAssignments(
        match=np.full(len(frames.log_null), -1, dtype=np.int64),
        row_potential=np.empty(len(frames.log_null)),
        column_potential=np.empty(int(frames.column_start[-1])),
        log_weight=np.empty(count),
    )
    failed = np.empty(count, dtype=np.int64)
    _assign(
        frames.log_likelihood,
        frames.log_null,
        frames.row_start,
        frames.column_start,
        frames.cell_start,
        best.row_potential,
        best.column_potential,
        best.match,
        best.log_weight,
        failed,
    )
    return best, failed


def best_assignments(frames: Frames) -> BestAssignments:
    """Best association of every frame with its potentials.

    Raises:
        InputError: a frame has no association with a weight above zero; names the detection and its rivals.
    """
    best, failed = try_assign(frames)
    if len(failed) and failed.max() >= 0:
        frame = int(np.argmax(failed >= 0))
        raise infeasible_error(frames, frame, int(failed[frame]), best.match)
    return best


def map_association(log_likelihood: ArrayLike, log_null: ArrayLike) -> Association:
    """The most probable joint association of a frame, exact at any size.

    Args:
        log_likelihood: [n, m] log weight of each detection and landmark in nats, -inf for the impossible.
        log_null: [n] log weight of each detection's null hypothesis in nats, -inf when it must be a landmark.

    Raises:
        InputError: wrong shapes, NaN or plus infinity, or no association is possible.
    """
    best = best_assignments(pack_frames([(log_likelihood, log_null)]))
    return Association(best.match, float(best.log_weight[0]))
