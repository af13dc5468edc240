"""The association problem: checked, and packed frame after frame so that one compiled call serves a whole sequence.

Detection i (a row) goes to one landmark j (a column) with log weight `log_likelihood[i, j]`, or to its own null
hypothesis with `log_null[i]`; a landmark takes at most one detection of the frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from nolbo_ppl.errors import InputError, input_error

LARGEST = 1e15
"""Largest magnitude of a log weight, in nats: beyond it a double no longer resolves 0.1 nats."""


@dataclass(frozen=True)
class Frames:
    """Association problems of several frames, end to end; frame f owns the slices `start[f]:start[f + 1]`."""

    log_likelihood: Float[np.ndarray, " cells"]
    """Log weights of detection and landmark in nats, each frame row by row."""
    log_null: Float[np.ndarray, " detections"]
    """Log weight of the null hypothesis of every detection, in nats."""
    row_start: Int[np.ndarray, " frames_and_one"]
    """First detection of each frame."""
    column_start: Int[np.ndarray, " frames_and_one"]
    """First landmark column of each frame."""
    cell_start: Int[np.ndarray, " frames_and_one"]
    """First cell of each frame."""

    def __len__(self) -> int:
        return len(self.row_start) - 1

    def shape(self, frame: int) -> tuple[int, int]:
        """Numbers of detections and landmarks of one frame."""
        return (
            int(self.row_start[frame + 1] - self.row_start[frame]),
            int(self.column_start[frame + 1] - self.column_start[frame]),
        )

    def matrix(self, values: np.ndarray, frame: int) -> np.ndarray:
        """View of one frame in values held per cell: [n, m]."""
        return values[self.cell_start[frame] : self.cell_start[frame + 1]].reshape(self.shape(frame))

    def rows(self, values: np.ndarray, frame: int) -> np.ndarray:
        """View of one frame in values held per detection: [n]."""
        return values[self.row_start[frame] : self.row_start[frame + 1]]

    def columns(self, values: np.ndarray, frame: int) -> np.ndarray:
        """View of one frame in values held per landmark: [m]."""
        return values[self.column_start[frame] : self.column_start[frame + 1]]

    def name(self, frame: int) -> str:
        """How errors call a frame: nothing when there is one alone."""
        return "" if len(self) == 1 else f"frame {frame}, "


def pack_frames(problems: Sequence[tuple[ArrayLike, ArrayLike]]) -> Frames:
    """Check (log_likelihood [n, m], log_null [n]) of every frame and lay them end to end.

    Raises:
        InputError: wrong shapes, a NaN, a plus infinity, or a finite value beyond `LARGEST`; names frame, detection
            and landmark.
    """
    likelihoods, nulls = [], []
    rows, columns, cells = [0], [0], [0]
    for frame, (likelihood, null) in enumerate(problems):
        likelihood, null = np.asarray(likelihood, dtype=np.float64), np.asarray(null, dtype=np.float64)
        if likelihood.ndim != 2 or null.shape != likelihood.shape[:1]:
            raise input_error(
                "association problem with wrong shapes" + (f" in frame {frame}" if len(problems) > 1 else ""),
                got=f"log_likelihood {list(likelihood.shape)} and log_null {list(null.shape)}",
                expected="[n, m] and [n] for n detections and m landmarks",
            )
        likelihoods.append(likelihood.reshape(-1))
        nulls.append(null)
        n, m = likelihood.shape
        rows.append(rows[-1] + n)
        columns.append(columns[-1] + m)
        cells.append(cells[-1] + n * m)
    frames = Frames(_join(likelihoods), _join(nulls), np.array(rows), np.array(columns), np.array(cells))
    _check_values(frames)
    return frames


def _join(parts: list[np.ndarray]) -> np.ndarray:
    """Concatenate; one part alone is copied only when it is not contiguous."""
    if not parts:
        return np.zeros(0)
    return np.ascontiguousarray(parts[0]) if len(parts) == 1 else np.concatenate(parts)


def _first_unusable(values: np.ndarray) -> int:
    """Index of the first value that is neither a log weight within range nor minus infinity, or -1."""
    magnitude = np.abs(values)
    if magnitude.max(initial=0.0) <= LARGEST:  # false for NaN too
        return -1
    bad = ~(magnitude <= LARGEST) & (values != -np.inf)
    return int(np.argmax(bad)) if bad.any() else -1


def _check_values(frames: Frames) -> None:
    """Raise for the first unusable value, by detection and landmark."""
    cell = _first_unusable(frames.log_likelihood)
    if cell >= 0:
        frame = int(np.searchsorted(frames.cell_start, cell, side="right")) - 1
        row, column = divmod(cell - int(frames.cell_start[frame]), frames.shape(frame)[1])
        where = f"{frames.name(frame)}detection {row} and landmark {column}"
        raise _value_error(f"unusable log likelihood of {where}", float(frames.log_likelihood[cell]))
    index = _first_unusable(frames.log_null)
    if index >= 0:
        frame = int(np.searchsorted(frames.row_start, index, side="right")) - 1
        where = f"{frames.name(frame)}detection {index - int(frames.row_start[frame])}"
        raise _value_error(f"unusable log weight of the null hypothesis of {where}", float(frames.log_null[index]))


def _value_error(what: str, value: float) -> InputError:
    return input_error(what, got=value, expected=f"nats of magnitude up to {LARGEST:g}, or -inf for the impossible")


def infeasible_error(frames: Frames, frame: int, row: int, match: Int[np.ndarray, " detections"]) -> InputError:
    """The error for detection `row`, which no assignment can place beside the detections already in `match`.

    The detections that alternate with it form a Hall violator: together they have too few landmarks.
    """
    possible = frames.matrix(frames.log_likelihood, frame) > -np.inf
    partner = frames.rows(match, frame)[:row]
    rivals, landmarks, queue = {row}, set[int](), [row]
    while queue:
        for column in np.flatnonzero(possible[queue.pop()]).tolist():
            if column not in landmarks:
                landmarks.add(column)
                owner = int(np.flatnonzero(partner == column)[0])
                rivals.add(owner)
                queue.append(owner)
    where = f"{frames.name(frame)}detection {row}"
    if not landmarks:
        got = "log likelihood -inf for every landmark and log null -inf"
    else:
        got = f"detections {sorted(rivals)}, none with a null hypothesis, for landmarks {sorted(landmarks)} alone"
    return input_error(
        f"infeasible association: {where} cannot go anywhere",
        got=got,
        expected="an assignment of every detection with a weight above zero",
        do="give the detection a finite log null, or another landmark a finite log likelihood",
    )
