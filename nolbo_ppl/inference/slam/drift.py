"""Drift between parts of a drive from a coarse graph: cheap posterior samples for the online system.

Nodes stand for every few frames. A node's variable is the world-frame error of its pose (rotation about the origin, then
translation); along the drive it is a random walk with the odometry's noise carried to the world frame, and each closed loop
ties two nodes at the place it was closed. What tracked objects add to the odometry is left out: a little too wide.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Float, Int

from nolbo_ppl.geometry.pose import skew


@dataclass
class DriftGraph:
    """Random walk of the world-frame error with loop closures."""

    stride: int = 10
    """Frames a node stands for."""
    information: list[np.ndarray] = field(default_factory=list)
    """Inverse covariance of the error gathered between consecutive nodes, 6 x 6."""
    pending: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    """Covariance gathered since the last node."""
    frames: int = 0
    """Steps taken."""
    loops: list[tuple[int, int, np.ndarray]] = field(default_factory=list)
    """Pairs of nodes and the information of a closing between them."""

    def advance(self, T_world_camera: Float[np.ndarray, "4 4"], rotation: float, translation: float) -> None:
        """Add the noise of one odometry step that ends at this pose."""
        R, p = T_world_camera[:3, :3], T_world_camera[:3, 3]
        adjoint = np.zeros((6, 6))
        adjoint[:3, :3] = adjoint[3:, 3:] = R
        adjoint[3:, :3] = skew(p) @ R
        self.pending = self.pending + (adjoint * np.repeat([rotation**2, translation**2], 3)) @ adjoint.T
        self.frames += 1
        if self.frames % self.stride == 0:
            self.information.append(np.linalg.inv(self.pending + 1e-12 * np.eye(6)))
            self.pending = np.zeros((6, 6))

    def node(self, frame: Int[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
        """Node of each frame."""
        return np.minimum(np.asarray(frame) // self.stride, len(self.information))

    def close(self, frame_a: int, frame_b: int, position: Float[np.ndarray, " 3"], scale: float) -> None:
        """Tie the errors of two frames at a place both have seen: `H (e_a - e_b) ~ N(0, scale^2)`."""
        H = np.concatenate([-skew(position), np.eye(3)], axis=1)
        a, b = int(self.node(np.array(frame_a))), int(self.node(np.array(frame_b)))
        if a != b:
            self.loops.append((a, b, H.T @ H / scale**2))

    def samples(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "n 6 s"]:
        """Joint samples of the errors of all nodes, the first one without error."""
        n = len(self.information) + 1
        square_roots = [np.linalg.cholesky(A + 1e-12 * np.trace(A) / 6 * np.eye(6)).T for A in self.information]
        roots = [(i, i + 1, W) for i, W in enumerate(square_roots)]
        for a, b, A in self.loops:
            values, vectors = np.linalg.eigh(A)
            roots.append((a, b, (np.sqrt(np.maximum(values, 0.0)) * vectors).T))
        rows, columns, entries = [], [], []
        local_row, local_column = (x.ravel() for x in np.mgrid[0:6, 0:6])
        for k, (a, b, W) in enumerate(roots):
            for node, sign in ((a, -1.0), (b, 1.0)):
                rows.append(6 * k + local_row)
                columns.append(6 * node + local_column)
                entries.append(sign * W.ravel())
        rows.append(6 * len(roots) + np.arange(6))
        columns.append(np.arange(6))
        entries.append(np.full(6, 1e6))
        J = scipy.sparse.csc_matrix((np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns))),
                                    shape=(6 * len(roots) + 6, 6 * n))
        factor = scipy.sparse.linalg.splu((J.T @ J).tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
                                          options={"SymmetricMode": True})
        return factor.solve(J.T @ rng.standard_normal((J.shape[0], count))).reshape(n, 6, count)
