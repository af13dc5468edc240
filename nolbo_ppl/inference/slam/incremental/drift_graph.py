"""Drift between parts of a drive from a coarse graph: cheap posterior samples for the online system.

Nodes stand for every few frames. A node's variable is the world-frame error of its pose (rotation about the origin, then
translation); along the drive it is a random walk with the odometry's noise carried to the world frame, and each closed loop
ties two nodes at the place it was closed. What tracked objects add to the odometry is left out: a little too wide. Nodes
become sparser as the drive grows, so that their number, and the cost of a solve, stay bounded; between closings samples are
only carried on.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Float, Int

from nolbo_ppl.geometry.pose import adjoint, skew

MOST_NODES = 256
"""Nodes beyond which every second one goes."""


@dataclass
class DriftGraph:
    """Random walk of the world-frame error with loop closures."""

    stride: int = 10
    """Frames a node stands for."""
    gaps: list[np.ndarray] = field(default_factory=list)
    """Covariance of the error gathered between consecutive nodes, 6 x 6."""
    pending: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    """Covariance gathered since the last node."""
    since: int = 0
    """Steps taken since the last node."""
    loops: list[tuple[int, int, np.ndarray]] = field(default_factory=list)
    """Pairs of frames and a square root of the information of a closing between them."""
    kept: tuple[int, int, np.ndarray] | None = None
    """Samples of all nodes, with the stride and the number of loops they were made at."""

    def advance(self, T_world_camera: Float[np.ndarray, "4 4"], rotation: float, translation: float) -> None:
        """Add the noise of one odometry step that ends at this pose."""
        carry = adjoint(T_world_camera)
        self.pending = self.pending + (carry * np.repeat([rotation**2, translation**2], 3)) @ carry.T
        self.since += 1
        if self.since < self.stride:
            return
        self.gaps.append(self.pending)
        self.pending, self.since = np.zeros((6, 6)), 0
        if len(self.gaps) >= MOST_NODES:
            self._thin_out()

    def _thin_out(self) -> None:
        """Every second node goes: gaps are added in pairs, an odd one waits for its partner."""
        if len(self.gaps) % 2:
            self.pending, self.since = self.gaps.pop() + self.pending, self.since + self.stride
        self.gaps = [a + b for a, b in zip(self.gaps[::2], self.gaps[1::2])]
        self.stride *= 2

    def node(self, frame: Int[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
        """Node of each frame."""
        return np.minimum(np.asarray(frame) // self.stride, len(self.gaps))

    def close(self, frame_a: int, frame_b: int, position: Float[np.ndarray, " 3"], scale: float) -> None:
        """Tie the errors of two frames at a place both have seen: `H (e_a - e_b) ~ N(0, scale^2)`."""
        self.loops.append((frame_a, frame_b, np.concatenate([-skew(position), np.eye(3)], axis=1) / scale))

    def samples(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "n 6 s"]:
        """Joint samples of the errors of all nodes, the first one without error; earlier ones are carried on if possible."""
        if self.kept is not None and self.kept[:2] == (self.stride, len(self.loops)) and self.kept[2].shape[2] == count:
            delta = self.kept[2]
            for gap in self.gaps[len(delta) - 1 :]:
                delta = np.concatenate([delta, delta[-1:] + _root(gap) @ rng.standard_normal((6, count))])
        else:
            delta = self._solve(count, rng)
        self.kept = (self.stride, len(self.loops), delta)
        return delta

    def _solve(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "n 6 s"]:
        n = len(self.gaps) + 1
        walk = np.linalg.inv(_root(np.array(self.gaps))) if self.gaps else np.zeros((0, 6, 6))
        ends = self.node(np.array([(a, b) for a, b, _ in self.loops], dtype=np.int64).reshape(-1, 2))
        apart = ends[:, 0] != ends[:, 1]
        ties = np.array([H for _, _, H in self.loops]).reshape(-1, 3, 6)[apart]
        steps = np.arange(n - 1)
        blocks = [(walk, steps, steps + 1), (ties, ends[apart, 0], ends[apart, 1])]
        rows, columns, entries, start = [], [], [], 0
        for H, a, b in blocks:
            height = H.shape[1]
            row = start + height * np.arange(len(H))[:, None, None] + np.arange(height)[None, :, None] + np.zeros(6, int)
            for node, sign in ((a, -1.0), (b, 1.0)):
                rows.append(row.ravel())
                columns.append((6 * node[:, None, None] + np.zeros((1, height, 1), int) + np.arange(6)).ravel())
                entries.append(sign * H.ravel())
            start += height * len(H)
        rows.append(start + np.arange(6))
        columns.append(np.arange(6))
        entries.append(np.full(6, 1e6))
        J = scipy.sparse.csc_matrix(
            (np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns))), shape=(start + 6, 6 * n)
        )
        factor = scipy.sparse.linalg.splu(
            (J.T @ J).tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        return factor.solve(J.T @ rng.standard_normal((J.shape[0], count))).reshape(n, 6, count)


def _root(covariance: Float[np.ndarray, "... 6 6"]) -> Float[np.ndarray, "... 6 6"]:
    """Lower triangular square root, with a floor far below any real noise."""
    return np.linalg.cholesky(covariance + 1e-14 * np.eye(6))
