"""Marginals of the joint association: exact component by component, belief propagation where that is out of budget."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from nolbo_ppl.inference.association.assignment import BestAssignments, best_assignments
from nolbo_ppl.inference.association.components import Components, smallest_log, split_components
from nolbo_ppl.inference.association.problem import Frames
from nolbo_ppl.inference.association.propagation import ITERATIONS, TOLERANCE, propagate
from nolbo_ppl.inference.association.subsets import gather, sum_frames

BUDGET = 2**24
"""Default limit of the exact sum: subsets kept for one component, 8 bytes each (128 MB, about half a second)."""
GATE = 1e-12
"""Default reduced weight below which a detection and a landmark do not interact."""


@dataclass(frozen=True)
class FrameSums:
    """Marginals of all frames, end to end as in `Frames`."""

    weights: Float[np.ndarray, " cells"]
    null: Float[np.ndarray, " detections"]
    log_evidence: Float[np.ndarray, " frames"]
    residual: Float[np.ndarray, " frames"]
    """Largest residual of belief propagation in the frame, NaN where everything was summed exactly."""

    @property
    def exact(self) -> Bool[np.ndarray, " frames"]:
        """Frames summed exactly."""
        return np.isnan(self.residual)


def sum_associations(frames: Frames, *, budget: int, gate: float) -> FrameSums:
    """Marginals and log evidence of every frame; components of more than `budget` subsets by belief propagation.

    A budget of 0 sends everything through belief propagation.

    Raises:
        InputError: a frame has no association with a weight above zero.
    """
    best = best_assignments(frames)
    components = split_components(frames, best, gate)
    sums = FrameSums(
        weights=np.zeros(len(frames.log_likelihood)),
        null=np.zeros(len(frames.log_null)),
        log_evidence=best.log_weight.copy(),
        residual=np.full(len(frames), np.nan),
    )
    sum_frames(
        frames.log_likelihood,
        frames.log_null,
        frames.row_start,
        frames.column_start,
        frames.cell_start,
        best.row_potential,
        best.column_potential,
        components.frame,
        components.row_start,
        components.rows,
        components.column_start,
        components.columns,
        components.over_rows,
        components.states,
        components.frontier,
        float(budget),
        smallest_log(gate),
        sums.weights,
        sums.null,
        sums.log_evidence,
    )
    for component in np.flatnonzero(components.states > budget):
        _propagate_component(frames, best, components, int(component), smallest_log(gate), sums)
    return sums


def _propagate_component(
    frames: Frames, best: BestAssignments, components: Components, component: int, smallest: float, sums: FrameSums
) -> None:
    """Belief propagation on one component, into the sums of its frame."""
    frame = int(components.frame[component])
    rows = components.rows[components.row_start[component] : components.row_start[component + 1]]
    columns = components.columns[components.column_start[component] : components.column_start[component + 1]]
    reduced, alone_column, alone_row = gather(
        frames.matrix(frames.log_likelihood, frame),
        frames.rows(frames.log_null, frame),
        frames.rows(best.row_potential, frame),
        frames.columns(best.column_potential, frame),
        rows,
        columns,
        False,
        smallest,
    )
    weights, null = np.empty(reduced.shape), np.empty(len(rows))
    log_evidence, residual, _ = propagate(reduced, alone_row, alone_column, ITERATIONS, TOLERANCE, weights, null)
    frames.matrix(sums.weights, frame)[np.ix_(rows, columns)] = weights
    frames.rows(sums.null, frame)[rows] = null
    sums.log_evidence[frame] += log_evidence
    sums.residual[frame] = np.fmax(sums.residual[frame], residual)
