"""Which keyframes the running graph keeps: all of new ground, one of every few on known ground, and not without end.

Keyframes behind the window in which mapped landmarks were met again are condensed, ten to one (`IncrementalGraph.condense`), and
with them those that first explored the place. A place driven past many times keeps its first pass and its newest ones; what those
between said of the landmarks is forgotten, which leaves the map a little less certain than it could be, never more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from nolbo_ppl.errors import input_error
from nolbo_ppl.inference.slam.incremental.incremental_graph import IncrementalGraph


@dataclass(frozen=True)
class KeyframeConfig:
    """How many keyframes the online system keeps in its graph."""

    window: int = 20
    """Newest keyframes, always kept."""
    stretch: int = 10
    """Keyframes of known ground that become one."""
    least_met: int = 3
    """Landmarks met again in a stretch that make it known ground."""
    passes: int = 8
    """Condensed keyframes from which one landmark is seen; beyond that the oldest go."""
    history: bool = True
    """Keep all detections for `finish`. Without, memory grows with the ground covered alone."""
    max_memory: float | None = None
    """Most MB of the running graph (an estimate, about 6 kB a factor); beyond it the oldest ground is forgotten, landmarks and
    all (`forgetting`). Needs `history=False`. None: no bound."""

    def __post_init__(self) -> None:
        bound = self.max_memory
        if bound is not None and (isinstance(bound, bool) or not isinstance(bound, int | float) or not 1.0 <= bound < math.inf):
            raise input_error("max_memory", got=bound, expected="a finite number of MB, at least 1")
        if bound is not None and self.history:
            raise input_error("max_memory with the history of all detections", do="set history=False (and do without `finish`)")
        for name, least in (("window", 10), ("stretch", 1), ("least_met", 1), ("passes", 1)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise input_error(name, got=value, expected=f"a whole number from {least}")


class KeyframeKeeper:
    """Condenses known ground behind the window, and forgets the oldest passes of a place."""

    def __init__(self, config: KeyframeConfig) -> None:
        self.config = config
        self.stretch: list[int] = []
        self.known: dict[int, int] = {}
        self.condensed: list[int] = []
        self.explored: dict[int, int] = {}  # keyframes of new ground: the first one of their stretch
        self.waiting: list[int] = []  # such stretches that were driven past again
        self.start = 0

    def explore(self, first: int) -> None:
        """Note a stretch of new ground by its first keyframe."""
        self.explored |= dict.fromkeys(range(first, first + self.config.stretch), first)

    def forget(self, poses: set[int], first: int) -> None:
        """Keyframes that have left the graph; the first one that stays holds a prior and is not condensed."""
        self.condensed = [p for p in self.condensed if p not in poses]
        self.known = {t: n for t, n in self.known.items() if t not in poses}
        self.explored = {p: start for p, start in self.explored.items() if start > first}
        self.waiting = [start for start in self.waiting if start > first]

    def restart(self, frame: int) -> None:
        """Another drive begins at this keyframe: the window of the last one stays as it is."""
        self.start, self.stretch, self.known = frame, [], {}

    def saw(self, frame: int, met: list[bool]) -> None:
        """Note how many landmarks met again a keyframe sees."""
        self.known[frame] = sum(met)

    def advance(self, frame: int, graph: IncrementalGraph) -> None:
        """One more keyframe: what leaves the window may be condensed."""
        leaving = frame - self.config.window
        if leaving <= self.start:
            return
        self.stretch.append(leaving)
        if len(self.stretch) < self.config.stretch:
            if self.waiting:  # one a keyframe: each is a small solve of its own
                graph.condense(list(range(start := self.waiting.pop(0), start + self.config.stretch)))
            return
        stretch, self.stretch = self.stretch, []
        seen = [self.known.pop(t, 0) for t in stretch]
        if sum(1 for s in seen if s) < self.config.least_met or sum(seen) < self.config.least_met * 2:
            self.explore(stretch[0])
            return
        graph.condense(stretch)
        anchor = stretch[len(stretch) // 2]
        self.condensed.append(anchor)
        self._pass_again(anchor, graph)
        self._forget(anchor, graph)

    def _pass_again(self, newest: int, graph: IncrementalGraph) -> None:
        """Stretches of new ground that saw enough of the landmarks seen from the newest anchor are to be condensed."""
        shared: dict[int, int] = {}
        for j in graph.landmarks_of([newest]):
            for start in {self.explored[p] for p in graph.watchers(j) if p in self.explored}:
                shared[start] = shared.get(start, 0) + 1
        for start in sorted(start for start, count in shared.items() if count >= self.config.least_met):
            self.waiting.append(start)
            for pose in range(start, start + self.config.stretch):
                del self.explored[pose]

    def _forget(self, newest: int, graph: IncrementalGraph) -> None:
        """While the landmarks seen from the newest anchor have too many of them, the oldest goes."""
        own = set(self.condensed)
        for j in sorted(graph.landmarks_of([newest])):
            watchers = [i for i in graph.watchers(j) if i in own]
            if len(watchers) <= self.config.passes:
                continue
            oldest = watchers[0]
            graph.drop(oldest, self._support(oldest, newest, graph))
            self.condensed.remove(oldest)
            own.discard(oldest)

    def _support(self, leaving: int, newest: int, graph: IncrementalGraph) -> int:
        """What a keyframe that goes hangs on: the nearest of the first pass that shares a landmark with it.

        That one stays, so that no error adds up. On the newest one of the place instead, forgotten itself later, frames slip
        along the road and hang on what is ever farther off: error of all poses 0.24 -> 1.5 m in 12 laps of 350 m with
        `passes=3`. On its neighbour in time: 0.41 -> 1.16 m in 6 laps of 942 m.
        """
        seen = {i for j in graph.landmarks_of([leaving]) for i in graph.watchers(j)} - {leaving}
        own = set(self.condensed)
        first = [i for i in seen if i not in own and i < newest - self.config.stretch]
        near = sorted(first or (seen & own)) or [newest]
        place = graph.pose(leaving)[:3, 3]
        return min(near, key=lambda i: float(np.linalg.norm(graph.pose(i)[:3, 3] - place)))
