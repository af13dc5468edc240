"""Association weights of detections with the landmarks of a map, and whose a detection is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

MAJORITY = 0.5
"""A detection belongs to the landmark that has more than this of its weight: at most one can."""


def majority_landmark(
    row: Int[np.ndarray, " p"], landmark: Int[np.ndarray, " p"], weight: Float[np.ndarray, " p"], count: int
) -> Int[np.ndarray, " k"]:
    """The landmark that has more than half of each detection's weight, -1 for none.

    >>> majority_landmark(np.array([0, 0, 1]), np.array([3, 4, 4]), np.array([0.7, 0.2, 0.4]), 2).tolist()
    [3, -1]
    """
    found = np.full(count, -1, dtype=np.int64)
    strong = weight > MAJORITY
    found[row[strong]] = landmark[strong]
    return found


@dataclass(frozen=True)
class AssociationTable:
    """Weights of every detection, as `associations.jsonl` holds them."""

    id: tuple[str, ...]
    """Identifier of each detection: any text."""
    row: Int[np.ndarray, " p"]
    """Detection of each weight."""
    landmark: Int[np.ndarray, " p"]
    """Landmark of each weight, an index into the landmarks."""
    weight: Float[np.ndarray, " p"]
    """Marginal probability."""
    new: Float[np.ndarray, " k"]
    """Probability of an object that is not in the map."""
    background: Float[np.ndarray, " k"]
    """Probability of no object."""
    frame: Int[np.ndarray, " k"] | None = None
    """Frame of each detection; None when the observations are not at hand."""

    def __len__(self) -> int:
        return len(self.id)

    @property
    def landmark_of(self) -> Int[np.ndarray, " k"]:
        """The landmark that has more than half of each detection's weight, -1 for none."""
        return majority_landmark(self.row, self.landmark, self.weight, len(self))

    def in_time(self) -> AssociationTable:
        """The same in the order of time; as it is where frames are not known."""
        if self.frame is None:
            return self
        order = np.argsort(self.frame, kind="stable")
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        by_row = np.argsort(place[self.row], kind="stable")
        return replace(
            self,
            id=tuple(self.id[k] for k in order),
            row=place[self.row][by_row],
            landmark=self.landmark[by_row],
            weight=self.weight[by_row],
            new=self.new[order],
            background=self.background[order],
            frame=self.frame[order],
        )
