"""Exact sums over joint associations of one component: forward-backward over subsets of a frontier.

The two sides of a component are its *steps*, taken one at a time, and its *members*, of which a subset S is taken so
far. With reduced weights r (step, member), and the weights a and b of a member or a step that stays alone,

    forward   F_{t+1}[S] = b_t F_t[S] + sum_{s in S} r_ts F_t[S - s]
    backward  G_t[S] = b_t G_{t+1}[S] + sum_{s not in S} r_ts G_{t+1}[S + s]
    weight    w_ts = r_ts sum_{S without s} F_t[S] G_{t+1}[S + s] / Z.

A member *opens* (S may hold it) before its first neighbour among the steps and *closes* (it is taken, or pays a) after
its last, so that arrays have 2^(open members) entries: O(n m 2^min(n, m)) at most, for which all are open at once.
Bit p of a state is the member `slots[t, p]`. All weights are at most 1 and the best association has weight 1
(see `assignment`): no sum overflows, and what underflows is below 1e-200 of the answer.
Everything here is in one file because numba's cache follows the file of the caller alone.
"""

from __future__ import annotations

import numpy as np
from numba import njit

_FAST = {"reassoc", "contract", "nsz"}
"""Sums may be reordered, to use vector registers; infinities and NaN keep their meaning."""


@njit(cache=True, nogil=True)
def gather(
    values: np.ndarray,
    null: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    rows: np.ndarray,
    columns: np.ndarray,
    over_rows: bool,
    smallest: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reduced weights of a component: weights [step, member], alone_member, alone_step."""
    n, m = rows.shape[0], columns.shape[0]
    weights = np.zeros((m, n)) if over_rows else np.zeros((n, m))
    alone_row, alone_column = np.empty(n), np.empty(m)
    for j in range(m):
        alone_column[j] = np.exp(-v[columns[j]])
    for i in range(n):
        row = rows[i]
        alone_row[i] = np.exp(null[row] - u[row])
        for j in range(m):
            reduced = values[row, columns[j]] - u[row] - v[columns[j]]
            if reduced >= smallest:
                if over_rows:
                    weights[j, i] = np.exp(reduced)
                else:
                    weights[i, j] = np.exp(reduced)
    if over_rows:
        return weights, alone_row, alone_column
    return weights, alone_column, alone_row


@njit(cache=True, nogil=True)
def _schedule(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Plan of the sum: last[member], width[step], opened[step], slots[step, bit], offset[step] into the store."""
    steps, members = weights.shape
    first, last = np.full(members, steps), np.full(members, -1)
    for step in range(steps):
        for member in range(members):
            if weights[step, member] > 0:
                first[member] = min(first[member], step)
                last[member] = step
    width, opened = np.zeros(steps, np.int64), np.zeros(steps, np.int64)
    slots = np.zeros((steps, members), np.int64)
    offset = np.zeros(steps + 1, np.int64)
    count = 0
    for step in range(steps):
        if step > 0:
            count = 0
            for bit in range(width[step - 1]):
                member = slots[step - 1, bit]
                if last[member] >= step:
                    slots[step, count] = member
                    count += 1
        for member in range(members):
            if first[member] == step:
                slots[step, count] = member
                count += 1
                opened[step] += 1
        width[step] = count
        offset[step + 1] = offset[step] + (1 << count)
    return last, width, opened, slots, offset


@njit(cache=True, nogil=True, fastmath=_FAST)
def _take_step(before: np.ndarray, after: np.ndarray, width: int, slots: np.ndarray, r: np.ndarray, b: float) -> None:
    """Forward recursion of one step: `after` from `before`, both over subsets of the open members.

    The lowest three bits go together, eight states in registers; the others by contiguous slices, which vectorise
    (one plain loop over bits and states takes 4 to 7 times longer).
    """
    size = 1 << width
    if width < 3:
        for state in range(size):
            after[state] = b * before[state]
    else:
        r0, r1, r2 = r[slots[0]], r[slots[1]], r[slots[2]]
        for block in range(size >> 3):
            s = 8 * block
            f0, f1, f2, f3, f4, f5, f6 = (
                before[s],
                before[s + 1],
                before[s + 2],
                before[s + 3],
                before[s + 4],
                before[s + 5],
                before[s + 6],
            )
            after[s] = b * f0
            after[s + 1] = b * f1 + r0 * f0
            after[s + 2] = b * f2 + r1 * f0
            after[s + 3] = b * f3 + r1 * f1 + r0 * f2
            after[s + 4] = b * f4 + r2 * f0
            after[s + 5] = b * f5 + r2 * f1 + r0 * f4
            after[s + 6] = b * f6 + r2 * f2 + r1 * f4
            after[s + 7] = b * before[s + 7] + r2 * f3 + r1 * f5 + r0 * f6
    for bit in range(0 if width < 3 else 3, width):
        weight = r[slots[bit]]
        if weight == 0.0:
            continue
        stride = 1 << bit
        for high in range(0, size, 2 * stride):
            source, target = before[high : high + stride], after[high + stride : high + 2 * stride]
            for low in range(stride):
                target[low] += weight * source[low]


@njit(cache=True, nogil=True, fastmath=_FAST)
def _undo_step(
    before: np.ndarray,
    ahead: np.ndarray,
    behind: np.ndarray,
    width: int,
    slots: np.ndarray,
    r: np.ndarray,
    b: float,
    evidence: float,
    marginal: np.ndarray,
) -> float:
    """Backward recursion of one step: `behind` (G_t) from `ahead` (G_{t+1}), with the marginals of the step.

    Fills marginal[member]; returns sum_S F_t[S] G_{t+1}[S] / Z, which times b is the probability of staying alone.
    """
    size = 1 << width
    without = 0.0
    if width < 3:
        for state in range(size):
            behind[state] = b * ahead[state]
            without += before[state] * ahead[state]
    else:
        r0, r1, r2 = r[slots[0]], r[slots[1]], r[slots[2]]
        m0, m1, m2 = 0.0, 0.0, 0.0
        for block in range(size >> 3):
            s = 8 * block
            f0, f1, f2, f3, f4, f5, f6 = (
                before[s],
                before[s + 1],
                before[s + 2],
                before[s + 3],
                before[s + 4],
                before[s + 5],
                before[s + 6],
            )
            g0, g1, g2, g3, g4, g5, g6, g7 = (
                ahead[s],
                ahead[s + 1],
                ahead[s + 2],
                ahead[s + 3],
                ahead[s + 4],
                ahead[s + 5],
                ahead[s + 6],
                ahead[s + 7],
            )
            behind[s] = b * g0 + r0 * g1 + r1 * g2 + r2 * g4
            behind[s + 1] = b * g1 + r1 * g3 + r2 * g5
            behind[s + 2] = b * g2 + r0 * g3 + r2 * g6
            behind[s + 3] = b * g3 + r2 * g7
            behind[s + 4] = b * g4 + r0 * g5 + r1 * g6
            behind[s + 5] = b * g5 + r1 * g7
            behind[s + 6] = b * g6 + r0 * g7
            behind[s + 7] = b * g7
            m0 += f0 * g1 + f2 * g3 + f4 * g5 + f6 * g7
            m1 += f0 * g2 + f1 * g3 + f4 * g6 + f5 * g7
            m2 += f0 * g4 + f1 * g5 + f2 * g6 + f3 * g7
            without += f0 * g0 + f1 * g1 + f2 * g2 + f3 * g3 + f4 * g4 + f5 * g5 + f6 * g6 + before[s + 7] * g7
        marginal[slots[0]] = r0 * m0 / evidence
        marginal[slots[1]] = r1 * m1 / evidence
        marginal[slots[2]] = r2 * m2 / evidence
    for bit in range(0 if width < 3 else 3, width):
        weight = r[slots[bit]]
        if weight == 0.0:
            continue
        stride = 1 << bit
        total = 0.0
        for high in range(0, size, 2 * stride):
            source, target = before[high : high + stride], behind[high : high + stride]
            taken = ahead[high + stride : high + 2 * stride]
            for low in range(stride):
                target[low] += weight * taken[low]
                total += source[low] * taken[low]
        marginal[slots[bit]] = weight * total / evidence
    return without / evidence


@njit(cache=True, nogil=True)
def _close(states: np.ndarray, at: int, to: int, width: int, bit: int, alone: float) -> None:
    """Sum a member out of the array at `at` of 2^width entries, into the one at `to`: taken, or alone."""
    stride = 1 << bit
    for high in range(1 << (width - 1 - bit)):
        for low in range(stride):
            source = at + high * 2 * stride + low
            states[to + high * stride + low] = states[source + stride] + alone * states[source]


@njit(cache=True, nogil=True)
def _reopen(ahead: np.ndarray, width: int, bit: int, alone: float) -> None:
    """Backward of `_close`, in place and from the top: ahead has 2^(width - 1) entries and gets 2^width."""
    stride = 1 << bit
    for high in range((1 << (width - 1 - bit)) - 1, -1, -1):
        for low in range(stride - 1, -1, -1):
            value = ahead[high * stride + low]
            ahead[high * 2 * stride + stride + low] = value
            ahead[high * 2 * stride + low] = alone * value


@njit(cache=True, nogil=True)
def _close_all(
    chain: np.ndarray, step: int, width: int, slots: np.ndarray, last: np.ndarray, alone: np.ndarray
) -> tuple[int, int]:
    """Close what ends at this step, from the highest bit down; `chain` keeps every stage, one after the other.

    Returns where the last stage begins and how many members stay open.
    """
    at = 0
    for bit in range(width - 1, -1, -1):
        if last[slots[bit]] == step:
            size = 1 << width
            # highest bit first: the bits below keep their place, and the bits above that stay open move down
            _close(chain, at, at + size, width, bit, alone[slots[bit]])
            at += size
            width -= 1
    return at, width


@njit(cache=True, nogil=True)
def _forward(
    weights: np.ndarray,
    alone_member: np.ndarray,
    alone_step: np.ndarray,
    last: np.ndarray,
    width: np.ndarray,
    slots: np.ndarray,
    offset: np.ndarray,
    store: np.ndarray,
    chain: np.ndarray,
) -> float:
    """Forward pass: F before every step into `store`; returns Z, in [1, number of associations]."""
    steps = weights.shape[0]
    kept, at = 1, 0
    chain[0] = 1.0
    for step in range(steps):
        before = store[offset[step] : offset[step + 1]]
        stage = chain[at : at + kept]
        for state in range(kept):
            before[state] = stage[state]
        for state in range(kept, before.shape[0]):  # members that open are in no state yet
            before[state] = 0.0
        _take_step(before, chain, width[step], slots[step], weights[step], alone_step[step])
        at, open_count = _close_all(chain, step, width[step], slots[step], last, alone_member)
        kept = 1 << open_count
    return chain[at]


@njit(cache=True, nogil=True)
def sum_component(
    weights: np.ndarray,
    alone_member: np.ndarray,
    alone_step: np.ndarray,
    store: np.ndarray,
    chain: np.ndarray,
    ahead: np.ndarray,
    behind: np.ndarray,
    marginal: np.ndarray,
    idle_member: np.ndarray,
    idle_step: np.ndarray,
) -> float:
    """Z of a component, its marginals [step, member], and the probabilities of every member and step to stay alone.

    `store` holds offset[-1] entries, `chain` and `ahead` 2^(frontier + 1), `behind` 2^frontier.
    """
    last, width, opened, slots, offset = _schedule(weights)
    evidence = _forward(weights, alone_member, alone_step, last, width, slots, offset, store, chain)
    marginal[:] = 0.0
    ahead[0] = 1.0
    for step in range(weights.shape[0] - 1, -1, -1):
        before = store[offset[step] : offset[step + 1]]
        ends = False
        for bit in range(width[step]):
            ends |= last[slots[step, bit]] == step
        if ends:
            _take_step(before, chain, width[step], slots[step], weights[step], alone_step[step])
            at, open_count = _close_all(chain, step, width[step], slots[step], last, alone_member)
            for bit in range(width[step]):  # undo the closings in reverse: from the lowest bit up
                member = slots[step, bit]
                if last[member] != step:
                    continue
                open_count += 1
                at -= 1 << open_count
                alone = alone_member[member]
                total = 0.0
                stride = 1 << bit
                for high in range(1 << (open_count - 1 - bit)):
                    for low in range(stride):
                        total += chain[at + high * 2 * stride + low] * ahead[high * stride + low]
                idle_member[member] = alone * total / evidence
                _reopen(ahead, open_count, bit, alone)
        idle = _undo_step(
            before, ahead, behind, width[step], slots[step], weights[step], alone_step[step], evidence, marginal[step]
        )
        idle_step[step] = alone_step[step] * idle
        kept = 1 << (width[step] - opened[step])
        for state in range(kept):
            ahead[state] = behind[state]
    return evidence


@njit(cache=True, nogil=True)
def sum_frames(
    log_likelihood: np.ndarray,
    log_null: np.ndarray,
    row_start: np.ndarray,
    column_start: np.ndarray,
    cell_start: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    frame_of: np.ndarray,
    component_rows: np.ndarray,
    rows: np.ndarray,
    component_columns: np.ndarray,
    columns: np.ndarray,
    over_rows: np.ndarray,
    states: np.ndarray,
    frontier: np.ndarray,
    budget: float,
    smallest: float,
    weights: np.ndarray,
    null: np.ndarray,
    log_evidence: np.ndarray,
) -> None:
    """Sum every component within the budget (in states): scatter its marginals, add log Z to its frame's evidence."""
    most, widest = 1, 0
    for c in range(frame_of.shape[0]):
        if states[c] <= budget:
            most, widest = max(most, int(states[c])), max(widest, frontier[c])
    store, chain, ahead = np.empty(most), np.empty(2 << widest), np.empty(2 << widest)
    behind = np.empty(1 << widest)
    for c in range(frame_of.shape[0]):
        if states[c] > budget:
            continue
        frame = frame_of[c]
        n, m = row_start[frame + 1] - row_start[frame], column_start[frame + 1] - column_start[frame]
        values = log_likelihood[cell_start[frame] : cell_start[frame + 1]].reshape(n, m)
        out = weights[cell_start[frame] : cell_start[frame + 1]].reshape(n, m)
        null_in = log_null[row_start[frame] : row_start[frame + 1]]
        null_out = null[row_start[frame] : row_start[frame + 1]]
        ours = rows[component_rows[c] : component_rows[c + 1]]
        theirs = columns[component_columns[c] : component_columns[c + 1]]
        reduced, alone_member, alone_step = gather(
            values,
            null_in,
            u[row_start[frame] : row_start[frame + 1]],
            v[column_start[frame] : column_start[frame + 1]],
            ours,
            theirs,
            over_rows[c],
            smallest,
        )
        marginal = np.empty_like(reduced)
        idle_member, idle_step = np.empty(reduced.shape[1]), np.empty(reduced.shape[0])
        evidence = sum_component(reduced, alone_member, alone_step, store, chain, ahead, behind, marginal, idle_member, idle_step)
        log_evidence[frame] += np.log(evidence)
        for i in range(ours.shape[0]):
            null_out[ours[i]] = idle_member[i] if over_rows[c] else idle_step[i]
            for j in range(theirs.shape[0]):
                out[ours[i], theirs[j]] = marginal[j, i] if over_rows[c] else marginal[i, j]


@njit(cache=True, nogil=True)
def backward_component(
    weights: np.ndarray, alone_member: np.ndarray, alone_step: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Backward pass alone: store (G after every step), offset, width, slots [step, bit], last[member]."""
    last, width, opened, slots, offset = _schedule(weights)
    widest = width.max()
    store, ahead, behind = np.empty(offset[-1]), np.empty(2 << widest), np.empty(1 << widest)
    unused, marginal = np.zeros(1 << widest), np.empty(weights.shape[1])
    ahead[0] = 1.0
    for step in range(weights.shape[0] - 1, -1, -1):
        open_count = width[step]
        for bit in range(width[step]):
            open_count -= last[slots[step, bit]] == step
        for bit in range(width[step]):
            member = slots[step, bit]
            if last[member] == step:
                open_count += 1
                _reopen(ahead, open_count, bit, alone_member[member])
        for state in range(1 << width[step]):
            store[offset[step] + state] = ahead[state]
        _undo_step(
            unused, ahead, behind, width[step], slots[step], weights[step], alone_step[step], 1.0, marginal
        )  # the marginals are of no use here
        kept = 1 << (width[step] - opened[step])
        for state in range(kept):
            ahead[state] = behind[state]
    return store, offset, width, slots, last
