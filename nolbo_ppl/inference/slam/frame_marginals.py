"""The E-step of frames: sparse log odds of detections and landmarks in, exact one-to-one marginals out.

Tracking, the association with the map, the reference EM and the soft step between tracklets differ in how they compute
a pair's log odds; what happens then is the same and stands here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from nolbo_ppl.errors import input_error
from nolbo_ppl.inference.association import association_marginals_batch
from nolbo_ppl.inference.association.marginals import Associator

SMALL_MATRIX = 1 << 14
"""Pairs of a frame's detections and landmarks up to which they are one matrix."""
LARGEST_MATRIX = 1 << 25
"""Pairs of a part of a frame above which it is refused (0.3 GB)."""


@dataclass(frozen=True)
class FrameMarginals:
    """Marginals of every pair that was given, and of no pair."""

    weight: Float[np.ndarray, " p"]
    """Probability of each pair, in the order given."""
    null: Float[np.ndarray, " n"]
    """Probability of each detection being none of the landmarks it was paired with."""
    log_evidence: Float[np.ndarray, " f"]
    """Log evidence of each frame with detections, nats, frames ascending."""
    exact: bool
    """Whether every frame was summed exactly."""


def frame_marginals(
    frame: Int[np.ndarray, " n"],
    row: Int[np.ndarray, " p"],
    landmark: Int[np.ndarray, " p"],
    log_likelihood: Float[np.ndarray, " p"],
    log_null: Float[np.ndarray, " n"],
    *,
    associator: Associator = "exact",
) -> FrameMarginals:
    """Marginals of the one-to-one association of each frame's detections with landmarks.

    Args:
        frame: frame (or group) of each detection; within one a landmark takes at most one detection.
        row: detection of each candidate pair; pairs that are not listed are impossible.
        landmark: landmark of each pair.
        log_likelihood: log odds of the pair, in the units of `log_null`.
        log_null: log odds of each detection being none of the landmarks.
        associator: see `nolbo_ppl.inference.association`.

    Example:
        >>> import numpy as np
        >>> found = frame_marginals(np.zeros(2, int), np.array([0, 1]), np.array([7, 7]), np.zeros(2), np.zeros(2))
        >>> found.weight.round(3)  # one landmark, two detections alike: three associations of equal weight
        array([0.333, 0.333])
    """
    order = np.argsort(frame, kind="stable")
    frames, starts = np.unique(frame[order], return_index=True)
    groups = np.split(order, starts[1:]) if len(frames) else []
    by_row = np.argsort(row, kind="stable")
    sorted_rows = row[by_row]
    problems, entries_of, place, rows_of, frame_of = [], [], [], [], []
    for f, group in enumerate(groups):
        low, high = np.searchsorted(sorted_rows, group, "left"), np.searchsorted(sorted_rows, group, "right")
        entries = np.concatenate([by_row[a:b] for a, b in zip(low, high)])
        columns, column = np.unique(landmark[entries], return_inverse=True)
        index = np.repeat(np.arange(len(group)), high - low)
        for rows, own in _parts(index, column, len(group), len(columns)):
            local_row, local_column = np.searchsorted(rows, index[own]), column[own]
            if len(rows) < len(group):
                local_column = np.unique(local_column, return_inverse=True)[1]
            dense = np.full((len(rows), int(local_column.max(initial=-1)) + 1), -np.inf)
            dense[local_row, local_column] = log_likelihood[entries[own]]
            problems.append((dense, log_null[group[rows]]))
            entries_of.append(entries[own])
            place.append((local_row, local_column))
            rows_of.append(group[rows])
            frame_of.append(f)
    weight, null = np.zeros(len(row)), np.ones(len(frame))
    results = association_marginals_batch(problems, associator=associator) if problems else []
    for rows, entries, (index, column), result in zip(rows_of, entries_of, place, results):
        null[rows] = result.null
        weight[entries] = np.asarray(result.weights)[index, column]
    evidence = np.bincount(np.array(frame_of, int), [r.log_evidence for r in results], minlength=len(frames)).astype(np.float64)
    return FrameMarginals(weight, null, evidence, all(r.exact for r in results))


def _parts(
    row: Int[np.ndarray, " e"], column: Int[np.ndarray, " e"], rows: int, columns: int
) -> list[tuple[Int[np.ndarray, " r"], Int[np.ndarray, " e"]]]:
    """Rows and entries of the parts of a frame that have no landmark in common; one part where its matrix is small.

    Raises:
        InputError: a part is larger than `LARGEST_MATRIX`.
    """
    if rows * columns <= SMALL_MATRIX:
        return [(np.arange(rows), np.arange(len(row)))]
    links = scipy.sparse.coo_matrix((np.ones(len(row)), (row, rows + column)), shape=(rows + columns, rows + columns))
    label = scipy.sparse.csgraph.connected_components(links, directed=False)[1]
    by_row, by_entry = np.argsort(label[:rows], kind="stable"), np.argsort(label[row], kind="stable")
    entry_label, out = label[row][by_entry], []
    for part in np.split(by_row, np.flatnonzero(np.diff(label[by_row])) + 1):
        low, high = np.searchsorted(entry_label, label[part[0]], "left"), np.searchsorted(entry_label, label[part[0]], "right")
        own = by_entry[low:high]
        size = (len(part), len(np.unique(column[own])))
        if size[0] * size[1] > LARGEST_MATRIX:
            raise input_error(
                "too many detections of one frame that could be one another's",
                got=f"{size[0]} detections and {size[1]} objects that hang together",
                expected=f"at most {LARGEST_MATRIX} pairs",
                do="state smaller position scales, or give fewer detections a frame",
            )
        out.append((part, own))
    return out
