"""Loop closures of a result: where a landmark is seen again after a long time, and whether that was right."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from nolbo_ppl.io.run_folder import RunFolder
from nolbo_ppl.metrics.association import association_pairs
from nolbo_ppl.structures.association_table import AssociationTable

LOOP_GAP = 50
"""Frames between two views that make a loop (as in `summary.json`)."""


@dataclass(frozen=True)
class FoundLoop:
    """A landmark seen again."""

    landmark: int
    """Index of the landmark."""
    before: int
    """Frame in which it was last seen before."""
    after: int
    """Frame in which it was seen again."""


def loop_gap(run: RunFolder) -> int:
    """The gap that makes a loop: the run's own, else 50 keyframes, or a quarter of a drive of less than 200."""
    configuration = run.record.get("configuration")
    stated = configuration.get("loop_gap") if isinstance(configuration, dict) else None
    if isinstance(stated, int) and not isinstance(stated, bool) and stated > 0:
        return stated
    return min(LOOP_GAP, max(len(run) // 4, 2))


def find_loops(found: AssociationTable, gap: int) -> list[FoundLoop]:
    """Every return to a landmark after more than `gap` frames, by its detections of weight above one half.

    Needs the frames of the detections; without them there are none.
    """
    if found.frame is None:
        return []
    label, loops = found.landmark_of, []
    for j in np.unique(label[label >= 0]):
        frames: Int[np.ndarray, " v"] = np.unique(found.frame[label == j])
        for k in np.flatnonzero(np.diff(frames) > gap):
            loops.append(FoundLoop(int(j), int(frames[k]), int(frames[k + 1])))
    return sorted(loops, key=lambda loop: loop.after)


def object_labels(run: RunFolder) -> Int[np.ndarray, " k"] | None:
    """Number of the true object of each detection, -1 for none, -2 where it is not known; None when nobody said anything."""
    if run.objects is None or run.associations_in_time is None:
        return None
    number: dict[str | None, int] = {None: -1}
    for name in run.objects.values():
        number.setdefault(name, len(number) - 1)
    return np.array([number[run.objects[i]] if i in run.objects else -2 for i in run.associations_in_time.id], dtype=np.int64)


def is_right(run: RunFolder, loop: FoundLoop) -> bool | None:
    """Whether both ends of a loop are one true object; None when truth does not say."""
    label = object_labels(run)
    found = run.associations_in_time
    if label is None or found is None or found.frame is None:
        return None
    mine = found.landmark_of == loop.landmark
    before, after = set(label[mine & (found.frame == loop.before)]), set(label[mine & (found.frame == loop.after)])
    if before == {-2} or after == {-2}:
        return None
    return bool((before & after) - {-1, -2})


def loop_scores(run: RunFolder) -> dict[str, float | None] | None:
    """Precision and recall of the loop pairs: computed where the true objects are known, else as the run's summary has them."""
    stated = run.summary.get("loops")
    if isinstance(stated, dict) and "precision" in stated:
        return {
            key: stated.get(name)
            for key, name in (("precision", "precision"), ("recall", "recall"), ("found", "found_pairs"), ("true", "true_pairs"))
        }
    label, found = object_labels(run), run.associations_in_time
    if label is None or found is None or found.frame is None:
        return None
    known = label > -2
    score = association_pairs(found.frame[known], label[known], found.landmark_of[known], loop_gap(run))
    return {"precision": score.precision, "recall": score.recall, "found": score.found_pairs, "true": score.true_pairs}
