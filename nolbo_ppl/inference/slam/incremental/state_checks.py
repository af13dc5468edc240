"""What a saved online system must hold so that nothing breaks later: types and shapes of its columns, and numbers that exist."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nolbo_ppl.inference.slam.detection_features import FeaturePrior
from nolbo_ppl.inference.slam.graph import pose_key
from nolbo_ppl.inference.slam.incremental.incremental_graph import GAUGE, OBSERVATION, PRIOR, STEP
from nolbo_ppl.inference.slam.incremental.incremental_memory import IncrementalMemory
from nolbo_ppl.io.npz import Npz

SHAPES: dict[str, tuple[int | str, ...]] = {
    "latent": ("latent",),
    "latent_variance": ("latent",),
    "votes": ("categories",),
    "size": (3,),
    "information": (3, 3),
    "shared": (3, 3),
    "own": (3, 3),
    "shared_root": (3, 3),
    "mean": (3,),
    "position": (3,),
    "covariance": (3, 3),
}
"""Shape of a row by the name of its column; numbers where none stands."""
TRUTHS = {"oriented"}
"""Columns of true and false."""
REALS = {*SHAPES, "log_odds", "log_object", "log_clutter"}
"""Columns of real numbers; the others are whole."""


def typed_columns(archive: Npz, prefix: str, names: Sequence[str], rows: int, prior: FeaturePrior) -> dict[str, np.ndarray]:
    """Columns of a file with the types and shapes they must have. Raises `InputError` naming file and column."""
    length = {"latent": len(prior.mean), "categories": len(prior.categories)}
    found = {}
    for name in names:
        shape = tuple(length[n] if isinstance(n, str) else n for n in SHAPES.get(name, ()))
        kinds = "b" if name in TRUTHS else "f" if name in REALS else "i"
        found[name] = archive.array(f"{prefix}/{name}", (rows, *shape), kinds=kinds)
    return found


def _within(what: str, numbers: Sequence[int], count: int) -> None:
    values = np.asarray(list(numbers))
    if len(values) and not (np.issubdtype(values.dtype, np.integer) and values.min() >= 0 and values.max() < count):
        raise ValueError(f"{what} out of range")


def check_links(slam: IncrementalMemory) -> None:
    """Numbers of a loaded system name things that it holds, and no chain of them is a circle.

    Raises:
        ValueError: says what does not fit.
    """
    graph, drift, running = slam.graph, slam.loops.drift, slam.loops.map
    if slam.frames != graph.poses:
        raise ValueError(f"{slam.frames} keyframes, {graph.poses} poses")
    hanging = set(graph.hanging.numbers().tolist())
    known = {i for i in range(graph.poses) if graph.isam.valueExists(pose_key(i))}
    if hanging & known or len(hanging) + len(known) != graph.poses:
        raise ValueError("poses that stand nowhere, or twice")
    kinds = {kind: [f for f in graph.factors.values() if f.kind == kind] for kind in (GAUGE, PRIOR, STEP, OBSERVATION)}
    if sum(map(len, kinds.values())) != len(graph.factors):
        raise ValueError("a factor of no kind")
    _within("pose", [f.a for kind in (GAUGE, STEP, OBSERVATION) for f in kinds[kind]], graph.poses)
    _within("pose", [f.b for f in kinds[STEP]], graph.poses)
    _within("landmark", [f.a for f in kinds[PRIOR]] + [f.b for f in kinds[OBSERVATION]], graph.landmarks)
    if (np.diff(running.numbers) <= 0).any() or not set(running.numbers.tolist()) <= set(graph.of_landmark):
        raise ValueError("a landmark that the graph does not know")
    if any(not 0 <= b < a for a, b in running.merged.items()):
        raise ValueError("a landmark merged with a newer one")
    if not {running.standing(t.landmark) for t in slam.tracks.values() if t.landmark >= 0} <= set(running.landmarks):
        raise ValueError("a track of a landmark that is not there")
    nodes = len(drift.parent)
    _within("place", [drift.place, *(j.place for j in running.landmarks.values())], len(drift.standing))
    _within("node", [drift.here, *drift.standing, *(end for a, b, _ in drift.loops for end in (a, b))], nodes)
    if any(not -1 <= parent < max(i, 1) for i, parent in enumerate(drift.parent)):
        raise ValueError("a place reached from a newer one")
    if drift.kept is not None and len(drift.kept[1]) > nodes:
        raise ValueError("samples of places that are not there")
