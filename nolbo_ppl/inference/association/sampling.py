"""Exact joint samples of the association: backward messages over subsets, then one draw a step, forwards."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int
from numba import njit
from numpy.typing import ArrayLike

from nolbo_ppl.errors import input_error
from nolbo_ppl.inference.association.assignment import best_assignments
from nolbo_ppl.inference.association.components import smallest_log, split_components
from nolbo_ppl.inference.association.exact import BUDGET, GATE
from nolbo_ppl.inference.association.problem import pack_frames
from nolbo_ppl.inference.association.subsets import backward_component, gather


@njit(cache=True, nogil=True)
def _draw(
    weights: np.ndarray,
    alone_step: np.ndarray,
    store: np.ndarray,
    offset: np.ndarray,
    width: np.ndarray,
    slots: np.ndarray,
    last: np.ndarray,
    uniform: np.ndarray,
    taken: np.ndarray,
) -> None:
    """Draw the member of every step, -1 for none: taken [count, step], by inversion of uniform [count, step].

    Given the set S taken so far, step t takes s with probability r_ts G_{t+1}[S + s], or none with b_t G_{t+1}[S].
    """
    for draw in range(uniform.shape[0]):
        state = 0
        for step in range(weights.shape[0]):
            ahead = store[offset[step] : offset[step + 1]]
            total = alone_step[step] * ahead[state]
            for bit in range(width[step]):
                if not state >> bit & 1:
                    total += weights[step, slots[step, bit]] * ahead[state | 1 << bit]
            threshold = uniform[draw, step] * total
            reached = alone_step[step] * ahead[state]
            chosen = -1
            # `choice` stays at the last possibility above zero, so that rounding never picks an impossible one
            if reached <= threshold:
                for bit in range(width[step]):
                    if state >> bit & 1:
                        continue
                    weight = weights[step, slots[step, bit]] * ahead[state | 1 << bit]
                    if weight > 0.0:
                        chosen = bit
                        reached += weight
                        if reached > threshold:
                            break
            taken[draw, step] = -1
            if chosen >= 0:
                taken[draw, step] = slots[step, chosen]
                state |= 1 << chosen
            kept, position = 0, 0
            for bit in range(width[step]):
                if last[slots[step, bit]] != step:
                    kept |= (state >> bit & 1) << position
                    position += 1
            state = kept


def sample_associations(
    log_likelihood: ArrayLike,
    log_null: ArrayLike,
    *,
    rng: np.random.Generator,
    count: int = 1,
    budget: int = BUDGET,
    gate: float = GATE,
) -> Int[np.ndarray, "count n"]:
    """Independent samples of the joint association: the landmark of every detection, -1 for its null hypothesis.

    Args:
        log_likelihood: [n, m] log weight of each detection and landmark in nats, -inf for the impossible.
        log_null: [n] log weight of each detection's null hypothesis in nats.
        rng: the source of randomness.
        count: number of samples.
        budget: largest number of subsets kept for one component (8 bytes each).
        gate: reduced weights below this are taken as zero.

    Raises:
        InputError: wrong shapes, NaN or plus infinity, no association is possible, or a component beyond the budget.
    """
    frames = pack_frames([(log_likelihood, log_null)])
    best = best_assignments(frames)
    components = split_components(frames, best, gate)
    n = len(frames.log_null)
    samples = np.full((count, n), -1, dtype=np.int64)
    for c in range(len(components)):
        rows = components.rows[components.row_start[c] : components.row_start[c + 1]]
        columns = components.columns[components.column_start[c] : components.column_start[c + 1]]
        if len(columns) == 0:
            continue
        if components.states[c] > budget:
            raise input_error(
                f"association too entangled to sample exactly: detections {rows.tolist()} share landmarks",
                got=f"{components.states[c]:.3g} subsets",
                expected=f"at most budget = {budget}",
                do="raise the budget, or give detections fewer landmarks with weight",
            )
        over_rows = bool(components.over_rows[c])
        weights, alone_member, alone_step = gather(
            frames.matrix(frames.log_likelihood, 0),
            frames.log_null,
            best.row_potential,
            best.column_potential,
            rows,
            columns,
            over_rows,
            smallest_log(gate),
        )
        taken = np.empty((count, len(weights)), dtype=np.int64)
        store, offset, width, slots, last = backward_component(weights, alone_member, alone_step)
        _draw(weights, alone_step, store, offset, width, slots, last, rng.random(taken.shape), taken)
        draw, step = np.nonzero(taken >= 0)
        member = taken[draw, step]
        if over_rows:
            samples[draw, rows[member]] = columns[step]
        else:
            samples[draw, rows[step]] = columns[member]
    return samples
