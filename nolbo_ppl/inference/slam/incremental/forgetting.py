"""A bound on the memory of the running graph: the oldest ground is forgotten where a drive covers more than fits.

Laps round known ground need no bound, they are condensed (`keyframes`). A road without end does: its oldest keyframes go, with
the landmarks that no other one sees. What they knew of the first keyframe that stays becomes a prior on it, with its marginal
covariance; that it is correlated with the landmarks there is lost, so the map is told a little too uncertain, never too sure.
Poses of forgotten keyframes stay in the trajectory, fixed relative to the first one that is kept.
"""

from __future__ import annotations

from nolbo_ppl.inference.slam.incremental.incremental_graph import GAUGE, Factor, IncrementalGraph
from nolbo_ppl.inference.slam.incremental.incremental_loops import LoopCloser
from nolbo_ppl.inference.slam.incremental.keyframes import KeyframeKeeper

FACTOR_MEMORY = 0.006
"""MB of a factor with its share of poses, landmarks and iSAM2's cliques: measured, 34 MB at 4 600 factors and 6 400 keyframes."""
POSE_MEMORY = 0.00017
"""MB of the pose of a keyframe that is no longer in the graph (`hanging_poses`, with room for a quarter more)."""
SHARE = 0.8
"""What is left of the bound's factors when ground is forgotten: one marginal covariance serves many keyframes."""


def graph_memory(graph: IncrementalGraph) -> float:
    """Memory of the running graph, MB, by its numbers of factors and keyframes."""
    return FACTOR_MEMORY * len(graph.factors) + POSE_MEMORY * len(graph.hanging)


def forget_oldest(graph: IncrementalGraph, loops: LoopCloser, keeper: KeyframeKeeper, frame: int, live: set[int]) -> int:
    """Forget the oldest keyframes where the graph is over its bound; returns how many went.

    What is taken out goes with the next `commit`; the newest keyframes (`KeyframeConfig.window`) always stay.

    Args:
        graph: the running graph, nothing waiting.
        loops: the running map.
        keeper: which keyframes are condensed, and the bound.
        frame: the newest keyframe.
        live: landmarks of live tracks, which stay.
    """
    bound = keeper.config.max_memory
    if bound is None or graph_memory(graph) <= bound:
        return 0
    left = max(SHARE * (bound - POSE_MEMORY * len(graph.hanging)) / FACTOR_MEMORY, 0.0)
    leaving: list[int] = []
    gone: set[int] = set()
    poses = sorted(graph.of_pose)
    old = [p for p in poses if p <= frame - keeper.config.window - keeper.config.stretch]
    for pose in old:
        if len(graph.factors) - len(gone) <= left:
            break
        leaving.append(pose)
        gone |= graph.of_pose[pose]
    if not leaving:
        return 0
    first = poses[len(leaving)]
    seen = graph.landmarks_of(leaving)
    held = any(graph.factors[n].kind == GAUGE for n in graph.of_pose[first])
    prior = None if held else Factor(GAUGE, first, -1, graph.pose(first), graph.pose_covariance(first))
    graph.forget(leaving, first)
    if prior is not None:
        graph.add(prior)
    alone = {j for j in seen - live if not graph.watchers(j)}
    for j in alone:
        for number in sorted(graph.of_landmark[j]):
            graph.remove(number)
    loops.forget(alone)
    keeper.forget(set(leaving), first)
    return len(leaving)
