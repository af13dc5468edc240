"""Drift between parts of a map from a coarse graph of places: cheap posterior samples for the online system.

Nodes stand for places, a few frames of driving each. A node's variable is the world-frame error of the map there (rotation
about the origin, then translation). Where new ground is explored it is a random walk from the node before, with the
odometry's noise carried to the world frame; each closed loop ties two nodes at the place it was closed. On known ground no
node is added: the camera's error relative to the place it is at is kept as one covariance, which grows with the odometry
and shrinks with each landmark met again (a Kalman filter). So the number of nodes follows the ground covered, not the time
driven, and samples are solved for anew only when a loop is closed. What tracked objects add to the odometry is left out: a
little too wide.
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

TELLING = 4.0
"""A landmark met again closes a loop when the drift it removes has this many times the variance it is met with."""


@dataclass
class DriftGraph:
    """Places with their errors, and where the camera is."""

    stride: int = 10
    """Frames of new ground a node stands for."""
    parent: list[int] = field(default_factory=lambda: [-1])
    """Node each node was reached from; -1 for the first."""
    gaps: list[np.ndarray] = field(default_factory=lambda: [np.zeros((6, 6))])
    """Covariance of the error gathered from there, 6 x 6."""
    loops: list[tuple[int, int, np.ndarray]] = field(default_factory=list)
    """Pairs of nodes and a square root of the information of a closing between them."""
    here: int = 0
    """Node the camera's error is told relative to."""
    place: int = 0
    """A name for it that stays valid when nodes are thinned out (see `rows`)."""
    local: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    """Covariance of the camera's error less that of the node."""
    since: int = 0
    """Steps since the node was reached, or known ground was last seen."""
    moved_at: int = 0
    """Steps taken when the camera last changed its node."""
    steps: int = 0
    """Steps taken."""
    standing: list[int] = field(default_factory=lambda: [0])
    """Node that stands for each one ever made (see `rows`)."""
    kept: tuple[int, np.ndarray] | None = None
    """Samples of all nodes, and the number of loops they were made at."""

    def advance(self, T_world_camera: Float[np.ndarray, "4 4"], rotation: float, translation: float) -> None:
        """Add the noise of one odometry step that ends at this pose; on new ground a node every few steps."""
        carry = adjoint(T_world_camera)
        self.local = self.local + (carry * np.repeat([rotation**2, translation**2], 3)) @ carry.T
        self.since += 1
        self.steps += 1
        if self.since >= self.stride:
            self._new_node()

    def restart(self, T_world_camera: Float[np.ndarray, "4 4"], covariance: Float[np.ndarray, "6 6"]) -> None:
        """Another drive begins on this map: a node at a pose known with a covariance in the camera's frame."""
        carry = adjoint(T_world_camera)
        self.here, self.local = 0, carry @ covariance @ carry.T
        self._new_node()

    def _new_node(self) -> None:
        self.parent.append(self.here)
        self.gaps.append(self.local)
        self.standing.append(len(self.gaps) - 1)
        self.here, self.place, self.local = len(self.gaps) - 1, len(self.standing) - 1, np.zeros((6, 6))
        self.since, self.moved_at = 0, self.steps
        if len(self.gaps) > MOST_NODES:
            self._thin_out()

    def rows(self, places: Int[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
        """Node that stands for each place now: the row of its samples."""
        return np.array(self.standing, dtype=np.int64)[np.asarray(places, dtype=np.int64)]

    def meet(self, place: int, position: Float[np.ndarray, " 3"], scale: float) -> None:
        """A landmark of an earlier place is seen again: `H (e_camera - e_place) ~ N(0, scale^2)` at its position."""
        node = self.standing[place]
        H = np.concatenate([-skew(position), np.eye(3)], axis=1)
        apart = self._between(self.here, node)
        drift = H @ apart @ H.T
        if np.trace(drift) > 3 * TELLING * scale**2:
            self.close(self.place, place, position, float(np.sqrt(scale**2 + np.trace(H @ self.local @ H.T) / 3)))
        if self.steps - self.moved_at >= self.stride and node != self.here:
            self.here, self.place, self.local, apart = node, place, self.local + apart, np.zeros((6, 6))
            self.moved_at = self.steps
        drift = H @ apart @ H.T
        S = H @ self.local @ H.T + drift + scale**2 * np.eye(3)
        gain = np.linalg.solve(S, H @ self.local).T
        left = np.eye(6) - gain @ H
        self.local = left @ self.local @ left.T + gain @ (scale**2 * np.eye(3) + drift) @ gain.T
        self.since = 0

    def _between(self, a: int, b: int) -> Float[np.ndarray, "6 6"]:
        """Covariance of the error of one node less that of another."""
        if a == b or self.kept is None or max(a, b) >= len(self.kept[1]):
            return np.zeros((6, 6))
        gap = self.kept[1][a] - self.kept[1][b]
        return gap @ gap.T / gap.shape[1]

    def _thin_out(self) -> None:
        """Every second node goes, its gap added to those of the nodes reached from it; the stride doubles."""
        n = len(self.gaps)
        keep = np.arange(n) % 2 == 0
        keep[self.here] = True
        number = np.cumsum(keep) - 1
        parent, gaps = list(self.parent), list(self.gaps)
        stands = np.arange(n)
        for i in range(1, n):  # parents come before their children
            if parent[i] >= 0 and not keep[parent[i]]:
                gaps[i] = gaps[i] + gaps[parent[i]]
                parent[i] = parent[parent[i]]
            if not keep[i]:
                stands[i] = stands[parent[i]]
        self.parent = [int(number[parent[i]]) if parent[i] >= 0 else -1 for i in range(n) if keep[i]]
        self.gaps = [gaps[i] for i in range(n) if keep[i]]
        node = number[stands]
        self.standing = [int(node[i]) for i in self.standing]
        self.loops = [(int(node[a]), int(node[b]), root) for a, b, root in self.loops]
        self.here = int(node[self.here])
        self.stride *= 2
        if self.kept is not None:
            self.kept = (self.kept[0], self.kept[1][keep[: len(self.kept[1])]])

    def close(self, place_a: int, place_b: int, position: Float[np.ndarray, " 3"], scale: float) -> None:
        """Tie the errors of two places at a landmark both have seen: `H (e_a - e_b) ~ N(0, scale^2)`."""
        root = np.concatenate([-skew(position), np.eye(3)], axis=1) / scale
        self.loops.append((self.standing[place_a], self.standing[place_b], root))

    def samples(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "n 6 s"]:
        """Joint samples of the errors of all nodes, the first one without error; earlier ones are carried on if possible."""
        if self.kept is not None and self.kept[0] == len(self.loops) and self.kept[1].shape[2] == count:
            delta = self.kept[1]
            for i in range(len(delta), len(self.gaps)):
                delta = np.concatenate([delta, delta[[self.parent[i]]] + _root(self.gaps[i]) @ rng.standard_normal((6, count))])
        else:
            delta = self._solve(count, rng)
        self.kept = (len(self.loops), delta)
        return delta

    def samples_here(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "6 s"]:
        """Samples of the camera's error, jointly with those of the nodes."""
        return self.samples(count, rng)[self.here] + _root(self.local) @ rng.standard_normal((6, count))

    def _solve(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "n 6 s"]:
        n = len(self.gaps)
        walk = np.linalg.inv(_root(np.array(self.gaps[1:]))) if n > 1 else np.zeros((0, 6, 6))
        ends = np.array([(a, b) for a, b, _ in self.loops], dtype=np.int64).reshape(-1, 2)
        apart = ends[:, 0] != ends[:, 1]
        ties = np.array([H for _, _, H in self.loops]).reshape(-1, 3, 6)[apart]
        blocks = [(walk, np.array(self.parent[1:], dtype=np.int64), np.arange(1, n)), (ties, ends[apart, 0], ends[apart, 1])]
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
