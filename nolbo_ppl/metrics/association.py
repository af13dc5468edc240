"""Quality of an association: pairs of detections put together rightly or wrongly, and consistency of covariances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.errors import input_error


@dataclass(frozen=True)
class PairScore:
    """Counts over pairs of detections, and what follows from them."""

    true_pairs: int
    """Pairs that are one object."""
    found_pairs: int
    """Pairs put on one landmark."""
    correct_pairs: int
    """Pairs that are both."""

    @property
    def precision(self) -> float:
        """Share of the found pairs that is correct; 1 when none was found."""
        return self.correct_pairs / self.found_pairs if self.found_pairs else 1.0

    @property
    def recall(self) -> float:
        """Share of the true pairs that was found; 1 when there are none."""
        return self.correct_pairs / self.true_pairs if self.true_pairs else 1.0

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        total = self.precision + self.recall
        return 2 * self.precision * self.recall / total if total else 0.0


def _pairs_apart(frame: np.ndarray, label: np.ndarray, gap: int) -> int:
    """Number of unordered pairs of equal label whose frames are more than `gap` apart."""
    order = np.lexsort((frame, label))
    frame, label = frame[order].astype(np.int64), label[order].astype(np.int64)
    if not len(frame):
        return 0
    # One sorted axis for all labels: labels are moved so far apart that no pair of two labels comes close.
    span = int(frame.max() - frame.min()) + gap + 2
    key = label * span * 2 + (frame - frame.min())
    later = np.searchsorted(key, key + gap, side="right")
    end = np.searchsorted(label, label, side="right")
    return int(np.sum(np.maximum(end - later, 0)))


def association_pairs(
    frame: Int[np.ndarray, " k"],
    object_of: Int[np.ndarray, " k"],
    landmark_of: Int[np.ndarray, " k"],
    minimum_gap: int = 0,
) -> PairScore:
    """Score of an association over pairs of detections more than `minimum_gap` frames apart.

    With a gap longer than any single view these are the loop pairs: right and wrong loop closures, and missed ones.

    Args:
        frame: frame of each detection.
        object_of: its true object, -1 for clutter.
        landmark_of: its landmark, -1 for none.
        minimum_gap: pairs closer than this in time do not count.

    Raises:
        InputError: lengths differ.
    """
    frame, object_of, landmark_of = np.asarray(frame), np.asarray(object_of), np.asarray(landmark_of)
    if not len(frame) == len(object_of) == len(landmark_of):
        raise input_error("arrays of different lengths", got=(len(frame), len(object_of), len(landmark_of)))
    true, found = object_of >= 0, landmark_of >= 0
    both = true & found
    joint = np.unique(np.stack([object_of[both], landmark_of[both]]), axis=1, return_inverse=True)[1].reshape(-1)
    return PairScore(
        true_pairs=_pairs_apart(frame[true], object_of[true], minimum_gap),
        found_pairs=_pairs_apart(frame[found], landmark_of[found], minimum_gap),
        correct_pairs=_pairs_apart(frame[both], joint, minimum_gap),
    )


def landmark_to_object(
    object_of: Int[np.ndarray, " k"],
    landmark_of: Int[np.ndarray, " k"],
    landmarks: int,
    weight: Float[np.ndarray, " k"] | None = None,
) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """True object of each landmark, the one most of its detections are of, and the share of them that are.

    Args:
        object_of: true object of each detection, or of the detection of each association; a negative number is none.
        landmark_of: its landmark, -1 for none.
        landmarks: number of landmarks. One without a detection has the object -1 and the share 0.
        weight: how much each counts; 1 by default. Of equal votes the smaller number wins.

    Example:
        >>> landmark_to_object(np.array([4, 4, -1, 7]), np.array([0, 0, 0, -1]), 2)
        (array([ 4, -1]), array([0.66666667, 0.        ]))
    """
    owner, purity = np.full(landmarks, -1), np.zeros(landmarks)
    counted = (landmark_of >= 0) & (True if weight is None else weight > 0)
    pair, number = np.unique(np.stack([landmark_of[counted], object_of[counted]]), axis=1, return_inverse=True)
    votes = np.bincount(number.reshape(-1), None if weight is None else weight[counted], minlength=pair.shape[1])
    order = np.lexsort((-votes, pair[0]))  # stable: equal votes stay in the order of the objects' numbers
    best = order[np.flatnonzero(np.diff(pair[0][order], prepend=-1))]
    owner[pair[0][best]] = pair[1][best]
    purity[pair[0][best]] = votes[best] / np.bincount(pair[0], votes, minlength=landmarks)[pair[0][best]]
    return owner, purity


def normalised_error_squared(error: Float[np.ndarray, "n d"], covariance: Float[np.ndarray, "n d d"]) -> Float[np.ndarray, " n"]:
    """NEES per degree of freedom, `e' S^-1 e / d` (Bar-Shalom): 1 on average when covariances are right.

    Raises:
        InputError: a covariance is singular.
    """
    try:
        solved = np.linalg.solve(covariance, error[..., None])[..., 0]
    except np.linalg.LinAlgError:
        raise input_error("a covariance is singular", do="leave out what is known exactly (the first pose)") from None
    nees: np.ndarray = np.sum(error * solved, axis=-1) / error.shape[-1]
    return nees


def brier_score(weight: Float[np.ndarray, " p"], correct: np.ndarray) -> float:
    """Mean square difference between association probabilities and what was true."""
    return float(np.mean((np.asarray(weight) - np.asarray(correct, dtype=np.float64)) ** 2))
