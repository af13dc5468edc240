"""The E-step of frames: sparse log odds of detections and landmarks in, exact one-to-one marginals out.

Tracking, the association with the map, the reference EM and the soft step between tracklets differ in how they compute
a pair's log odds; what happens then is the same and stands here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.inference.association import association_marginals_batch
from nolbo_ppl.inference.association.marginals import Associator


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
    problems, entries_of, place = [], [], []
    for group in groups:
        low, high = np.searchsorted(sorted_rows, group, "left"), np.searchsorted(sorted_rows, group, "right")
        entries = np.concatenate([by_row[a:b] for a, b in zip(low, high)])
        columns, column = np.unique(landmark[entries], return_inverse=True)
        dense = np.full((len(group), len(columns)), -np.inf)
        index = np.repeat(np.arange(len(group)), high - low)
        dense[index, column] = log_likelihood[entries]
        problems.append((dense, log_null[group]))
        entries_of.append(entries)
        place.append((index, column))
    weight, null = np.zeros(len(row)), np.ones(len(frame))
    results = association_marginals_batch(problems, associator=associator) if problems else []
    for group, entries, (index, column), result in zip(groups, entries_of, place, results):
        null[group] = result.null
        weight[entries] = np.asarray(result.weights)[index, column]
    return FrameMarginals(weight, null, np.array([r.log_evidence for r in results]), all(r.exact for r in results))
