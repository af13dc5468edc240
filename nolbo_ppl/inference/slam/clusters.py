"""Which tracklets are one landmark: strong links joined, never two tracklets seen in one frame."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

from nolbo_ppl.inference.slam.graph import LandmarkEqualities
from nolbo_ppl.inference.slam.slam_state import SlamState


def frames_of_landmarks(state: SlamState) -> list[frozenset[int]]:
    """Frames every landmark of the graph was detected in."""
    frames: list[set[int]] = [set() for _ in range(len(state.static))]
    for j, t in zip(state.landmark.tolist(), state.problem.observations.frame[state.rows].tolist()):
        frames[j].add(t)
    return [frozenset(f) for f in frames]


def join(links: LandmarkEqualities, frames: list[frozenset[int]], minimum: float) -> Int[np.ndarray, " m"]:
    """Cluster of every landmark, numbered by its earliest member: links above `minimum`, strongest first.

    A link that would put two tracklets of one frame together is passed over.
    """
    m = len(frames)
    parent = np.arange(m)
    members: list[set[int]] = [set(f) for f in frames]

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = int(parent[i])
        return i

    for k in np.argsort(-links.weight, kind="stable"):
        if links.weight[k] <= minimum:
            break
        i, j = root(int(links.a[k])), root(int(links.b[k]))
        if i == j or not members[i].isdisjoint(members[j]):
            continue
        low, high = min(i, j), max(i, j)
        parent[high] = low
        members[low] |= members[high]
    roots = np.array([root(i) for i in range(m)], dtype=np.int64)
    return np.unique(roots, return_inverse=True)[1].astype(np.int64) if m else roots


def clusters_of(state: SlamState) -> Int[np.ndarray, " m"]:
    """Cluster of every landmark under the links in use."""
    return join(state.links, frames_of_landmarks(state), state.config.merge_weight)
