"""Independent parts of an association problem, and the order in which each is summed.

Two detections interact when they can reach a common landmark by weights that matter. The test is on *reduced* weights
(see `assignment`): a raw weight may be tiny and yet certain, being a forced second choice. What interacts forms a
connected component; breadth-first order from one end of it keeps the frontier of the sum small, so that a long chain
of neighbours costs little however many detections it has.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from nolbo_ppl.inference.association.assignment import BestAssignments
from nolbo_ppl.inference.association.problem import Frames

SMALLEST_LOG = -690.0
"""Reduced log weights below this are zero in double precision arithmetic."""


@dataclass(frozen=True)
class Components:
    """Connected components of all frames; component c owns the slices `start[c]:start[c + 1]` of rows and columns."""

    frame: Int[np.ndarray, " components"]
    row_start: Int[np.ndarray, " components_and_one"]
    rows: Int[np.ndarray, " detections"]
    """Detections (of their frame) by component, in breadth-first order."""
    column_start: Int[np.ndarray, " components_and_one"]
    columns: Int[np.ndarray, " reachable_landmarks"]
    """Landmarks (of their frame) by component, in breadth-first order; landmarks out of reach are in none."""
    over_rows: Bool[np.ndarray, " components"]
    """True when the subsets summed over are sets of detections, False when they are sets of landmarks."""
    states: Float[np.ndarray, " components"]
    """Number of subsets the exact sum keeps (8 bytes each)."""
    frontier: Int[np.ndarray, " components"]
    """Largest number of detections or landmarks that a subset is drawn from."""

    def __len__(self) -> int:
        return len(self.frame)


@njit(cache=True, nogil=True)
def _explore(
    start: int,
    edges: np.ndarray,
    mark: int,
    row_mark: np.ndarray,
    column_mark: np.ndarray,
    queue: np.ndarray,
    rows: np.ndarray,
    columns: np.ndarray,
) -> tuple[int, int, int]:
    """Breadth-first search from node `start` (a row i, or n + j for column j).

    Fills `rows` and `columns` in the order of discovery; returns their counts and the last node found.
    """
    n, m = edges.shape
    row_count, column_count, head, tail = 0, 0, 0, 1
    queue[0] = start
    if start < n:
        row_mark[start] = mark
    else:
        column_mark[start - n] = mark
    while head < tail:
        node = queue[head]
        head += 1
        if node < n:
            rows[row_count] = node
            row_count += 1
            for column in range(m):
                if edges[node, column] and column_mark[column] != mark:
                    column_mark[column] = mark
                    queue[tail] = n + column
                    tail += 1
        else:
            columns[column_count] = node - n
            column_count += 1
            for row in range(n):
                if edges[row, node - n] and row_mark[row] != mark:
                    row_mark[row] = mark
                    queue[tail] = row
                    tail += 1
    return row_count, column_count, queue[tail - 1]


@njit(cache=True, nogil=True)
def _frontier(edges: np.ndarray, steps: np.ndarray, members: np.ndarray, transposed: bool) -> tuple[float, int]:
    """Subsets kept, and their largest base set, when `steps` are summed in order over subsets of `members`.

    A member is in the base set from its first neighbour among the steps to its last. `edges` is [member, step], or
    [step, member] when transposed.
    """
    change = np.zeros(steps.shape[0] + 1, np.int64)
    for member in members:
        first, last = steps.shape[0], -1
        for position in range(steps.shape[0]):
            step = steps[position]
            if edges[step, member] if transposed else edges[member, step]:
                first = min(first, position)
                last = position
        change[first] += 1
        change[last + 1] -= 1
    states, width, widest = 1.0, 0, 0
    for position in range(steps.shape[0]):
        width += change[position]
        widest = max(widest, width)
        states += 2.0**width
    return states, widest


@njit(cache=True, nogil=True)
def _split(
    log_likelihood: np.ndarray,
    row_start: np.ndarray,
    column_start: np.ndarray,
    cell_start: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    smallest: float,
    frame_of: np.ndarray,
    component_rows: np.ndarray,
    rows: np.ndarray,
    component_columns: np.ndarray,
    columns: np.ndarray,
    over_rows: np.ndarray,
    states: np.ndarray,
    frontier: np.ndarray,
) -> int:
    """Find the components of every frame, fill the arrays of `Components`, return how many there are."""
    count = 0
    component_rows[0] = 0
    component_columns[0] = 0
    for frame in range(row_start.shape[0] - 1):
        n, m = row_start[frame + 1] - row_start[frame], column_start[frame + 1] - column_start[frame]
        values = log_likelihood[cell_start[frame] : cell_start[frame + 1]].reshape(n, m)
        edges = np.empty((n, m), np.bool_)
        for row in range(n):
            potential = u[row_start[frame] + row]
            for column in range(m):
                edges[row, column] = values[row, column] - potential - v[column_start[frame] + column] >= smallest
        row_mark, column_mark = np.full(n, -1), np.full(m, -1)
        queue = np.empty(n + m, np.int64)
        mark = 0
        for row in range(n):
            if row_mark[row] >= 0:
                continue
            row_slice, column_slice = rows[component_rows[count] :], columns[component_columns[count] :]
            found_rows, found_columns, end = _explore(row, edges, mark, row_mark, column_mark, queue, row_slice, column_slice)
            if min(found_rows, found_columns) > 3:  # start again from one end, as the frontier is narrower from there
                _explore(end, edges, mark + 1, row_mark, column_mark, queue, row_slice, column_slice)
            mark += 2
            row_slice, column_slice = row_slice[:found_rows], column_slice[:found_columns]
            by_rows, row_frontier = _frontier(edges, column_slice, row_slice, False)
            by_columns, column_frontier = _frontier(edges, row_slice, column_slice, True)
            frame_of[count] = frame
            choice = found_columns > 0 and by_rows <= by_columns
            over_rows[count] = choice
            states[count] = by_rows if choice else by_columns
            frontier[count] = row_frontier if choice else column_frontier
            count += 1
            component_rows[count] = component_rows[count - 1] + found_rows
            component_columns[count] = component_columns[count - 1] + found_columns
    return count


def split_components(frames: Frames, best: BestAssignments, gate: float) -> Components:
    """Connected components by reduced weights of at least `gate`, each with the cheaper side to take subsets of."""
    detections, landmarks = len(frames.log_null), len(best.column_potential)
    frame = np.empty(detections, dtype=np.int64)
    row_start, column_start = np.zeros(detections + 1, dtype=np.int64), np.zeros(detections + 1, dtype=np.int64)
    rows, columns = np.empty(detections, dtype=np.int64), np.empty(landmarks, dtype=np.int64)
    over_rows, states = np.empty(detections, dtype=np.bool_), np.empty(detections)
    frontier = np.empty(detections, dtype=np.int64)
    count = _split(
        frames.log_likelihood,
        frames.row_start,
        frames.column_start,
        frames.cell_start,
        best.row_potential,
        best.column_potential,
        smallest_log(gate),
        frame,
        row_start,
        rows,
        column_start,
        columns,
        over_rows,
        states,
        frontier,
    )
    return Components(
        frame[:count],
        row_start[: count + 1],
        rows,
        column_start[: count + 1],
        columns[: column_start[count]],
        over_rows[:count],
        states[:count],
        frontier[:count],
    )


def smallest_log(gate: float) -> float:
    """Smallest reduced log weight that is kept, in nats."""
    return max(float(np.log(gate)), SMALLEST_LOG) if gate > 0 else SMALLEST_LOG
