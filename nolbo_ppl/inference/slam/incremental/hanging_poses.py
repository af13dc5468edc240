"""Keyframes that have left the running graph: each stands fixed relative to another one.

What one hangs on may leave the graph later and hang on a third. Only the one link is kept, 136 bytes a keyframe, and chains are
followed when a place is asked for: moving all that hangs on a keyframe whenever it leaves costs more with every lap.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int


class HangingPoses:
    """Keyframe numbers, what each hangs on, and its pose relative to that.

    Example:
        >>> poses, step = HangingPoses(), np.eye(4)
        >>> step[2, 3] = 1.0
        >>> poses.hang(3, 4, step)
        >>> poses.hang(4, 6, step)
        >>> poses.root(3)[0], float(poses.root(3)[1][2, 3])
        (6, 2.0)
    """

    def __init__(self) -> None:
        self.onto: Int[np.ndarray, " n"] = np.full(0, -1, dtype=np.int64)
        self.T: Float[np.ndarray, "n 4 4"] = np.zeros((0, 4, 4))
        self.count = 0

    @classmethod
    def of_links(
        cls, frames: Int[np.ndarray, " k"], onto: Int[np.ndarray, " k"], T: Float[np.ndarray, "k 4 4"], total: int
    ) -> HangingPoses:
        """Those of a file, among `total` keyframes.

        Raises:
            ValueError: a number out of range, or links that go round in a circle.
        """
        numbers = np.concatenate([frames, onto])
        if ((numbers < 0) | (numbers >= total)).any():
            raise ValueError(f"a pose hangs on one that is none of {total}")
        poses, end = cls(), np.arange(total)
        for frame, other, pose in zip(frames.tolist(), onto.tolist(), T):
            poses.hang(frame, other, pose)
        end[frames] = onto
        for _ in range(total.bit_length()):  # twice as far a turn
            end = end[end]
        if np.isin(end, frames).any():
            raise ValueError("poses hang on one another in a circle")
        return poses

    def __len__(self) -> int:
        return self.count

    def __contains__(self, frame: int) -> bool:
        return 0 <= frame < len(self.onto) and bool(self.onto[frame] >= 0)

    def hang(self, frame: int, onto: int, T_onto_frame: Float[np.ndarray, "4 4"]) -> None:
        """A keyframe stands relative to another one from now on."""
        if frame >= len(self.onto):
            more = max(frame + 1 - len(self.onto), len(self.onto) // 4, 256)  # by a quarter: a copy now and then
            self.onto = np.concatenate([self.onto, np.full(more, -1, dtype=np.int64)])
            self.T = np.concatenate([self.T, np.zeros((more, 4, 4))])
        self.count += int(self.onto[frame] < 0)
        self.onto[frame], self.T[frame] = onto, T_onto_frame

    def numbers(self) -> Int[np.ndarray, " k"]:
        """Keyframes that hang, in order."""
        return np.flatnonzero(self.onto >= 0)

    def root(self, frame: int) -> tuple[int, Float[np.ndarray, "4 4"]]:
        """The keyframe of the graph that one hangs on in the end (itself, where it is there), and its pose relative to that."""
        T = np.eye(4)
        while frame in self:
            T = self.T[frame] @ T
            frame = int(self.onto[frame])
        return frame, T

    def places(self, frames: int, pose_of: Callable[[int], Float[np.ndarray, "4 4"]]) -> Float[np.ndarray, "n 4 4"]:
        """World poses of the first `frames` keyframes, from those of the graph."""
        root, T = np.arange(frames), np.tile(np.eye(4), (frames, 1, 1))
        known = np.zeros(frames, dtype=bool)
        known[: len(self.onto)] = self.onto[:frames] >= 0
        hanging = np.flatnonzero(known)
        while len(hanging):  # a link of every chain a turn
            at = root[hanging]
            T[hanging] = self.T[at] @ T[hanging]
            root[hanging] = self.onto[at]
            hanging = hanging[known[root[hanging]]]
        ends, which = np.unique(root, return_inverse=True)
        return np.array([pose_of(i) for i in ends.tolist()]).reshape(-1, 4, 4)[which] @ T
