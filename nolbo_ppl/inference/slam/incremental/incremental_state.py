"""The online system in a file: one NPZ of numbers and a JSON text, no pickle; what is loaded goes on bit for bit.

iSAM2 itself is not written but rebuilt: saving linearises all factors anew where the estimate stands, in the running system too,
and loading does the same from the file. A run that was saved and one that was loaded are then the same run.
"""

from __future__ import annotations

import json
from collections import deque
from dataclasses import asdict, fields
from itertools import pairwise
from os import PathLike
from typing import Any

import numpy as np

from nolbo_ppl.errors import InputError, input_error, located
from nolbo_ppl.inference.slam.detection_features import FeaturePrior
from nolbo_ppl.inference.slam.graph import GraphError
from nolbo_ppl.inference.slam.incremental.drift_graph import DriftGraph
from nolbo_ppl.inference.slam.incremental.hanging_poses import HangingPoses
from nolbo_ppl.inference.slam.incremental.incremental_calibration import IncrementalCalibration
from nolbo_ppl.inference.slam.incremental.incremental_graph import Factor, IncrementalGraph
from nolbo_ppl.inference.slam.incremental.incremental_loops import LoopCloser, Merge
from nolbo_ppl.inference.slam.incremental.incremental_memory import IncrementalMemory
from nolbo_ppl.inference.slam.incremental.keyframes import KeyframeConfig, KeyframeKeeper
from nolbo_ppl.inference.slam.incremental.live_tracks import LiveTrack
from nolbo_ppl.inference.slam.incremental.running_map import MAX_FRAMES, RunningLandmark, RunningMap
from nolbo_ppl.inference.slam.incremental.state_checks import check_links, typed_columns
from nolbo_ppl.inference.slam.latent_mixture import LatentMixture
from nolbo_ppl.inference.slam.latent_population import LatentPopulation
from nolbo_ppl.inference.slam.measurements import Measurements
from nolbo_ppl.inference.slam.orientation import OrientationModes
from nolbo_ppl.inference.slam.slam_problem import SlamConfig
from nolbo_ppl.io.npz import Npz, save_npz
from nolbo_ppl.renamed_options import current_names, stored_names
from nolbo_ppl.structures.detections import ARRAYS, OPTIONAL, TEXTS, Detections

VERSION = 2
"""Version of the file."""
POPULATION_ARRAYS = ("log_weight", "mean", "variance")
LANDMARK_ARRAYS = ("latent", "latent_variance", "votes", "size", "information", "shared", "own")
LANDMARK_NUMBERS = (
    "number",
    "place",
    "first",
    "last",
    "symmetry",
    "oriented",
    "views",
    "latent_views",
    "sizes",
    "log_odds",
    "passes",
)
TRACKER_ARRAYS = ("index", "mean", "covariance", "last", "oriented", "latent", "latent_variance", "category")
MODES = ("log_weight", "R", "scale")
DRIFT_NUMBERS = ("stride", "here", "place", "since", "moved_at", "steps")
MEASUREMENTS = tuple(f.name for f in fields(Measurements) if f.name not in ("modes", "latent_modes"))
LATENT_MODES = ("log_weight", "mean")


def save_state(slam: IncrementalMemory, path: str | PathLike[str]) -> None:
    """Write a system that has taken at least one keyframe."""
    if slam.beginning is not None:
        raise input_error("a drive was begun that has no keyframe yet", do="call update first")
    slam.graph.rebuild()
    arrays: dict[str, Any] = {}
    meta: dict[str, Any] = {
        "version": VERSION,
        "config": stored_names(SlamConfig, asdict(slam.config) | {"category_symmetry": dict(slam.config.category_symmetry)}),
        "keyframes": asdict(slam.keyframes),
        "frames": slam.frames,
        "last_oriented": slam.last_oriented,
        "stated": slam.stated,
        "drives": slam.drives,
        "factors": [slam.scales.position_factor, slam.scales.range_factor, slam.scales.rotation_factor],
        "categories": list(slam.prior.categories),
        "category_error": slam.prior.category_error,
        "objectness_prior": slam.prior.objectness_prior,
    }
    for name in ("mean", "log_frequency"):
        arrays[f"prior/{name}"] = getattr(slam.prior, name)
    for name in POPULATION_ARRAYS:
        arrays[f"prior/population/{name}"] = getattr(slam.prior.population, name)
    arrays["T_world_camera"], arrays["last_odometry"] = slam.T_world_camera, slam.last_odometry
    _put_graph(slam.graph, arrays, meta)
    _put_loops(slam.loops, arrays, meta)
    _put_tracks(slam, arrays, meta)
    meta["keeper"] = {
        "stretch": slam.keeper.stretch,
        "known": sorted(slam.keeper.known.items()),
        "condensed": slam.keeper.condensed,
        "explored": sorted(set(slam.keeper.explored.values())),
        "waiting": slam.keeper.waiting,
        "start": slam.keeper.start,
    }
    _put_history(slam, arrays, meta)
    arrays["meta"] = np.array(json.dumps(meta))
    save_npz(path, arrays)


def load_state(slam: IncrementalMemory, path: str | PathLike[str]) -> None:
    """Put what a file holds into a new system.

    Raises:
        InputError: no such file, damaged, or not of this kind; names it.
    """
    with Npz(path) as archive:
        try:
            meta = json.loads(str(archive.array("meta", (), kinds="U")))
            if not isinstance(meta, dict) or meta.get("version") != VERSION:
                raise input_error("not a saved online system", expected=f"version {VERSION}", file=path)
            config = current_names(SlamConfig, meta["config"])
            for name in ("objectness_limits", "annealing"):
                config[name] = tuple(config[name])
            slam.config = SlamConfig(**config)
            slam.keyframes = KeyframeConfig(**meta["keyframes"])
            slam.frames, slam.stated, slam.drives = int(meta["frames"]), meta["stated"], int(meta["drives"])
            slam.last_oriented = meta.get("last_oriented", slam.frames - 1)  # files of 0.1.0: landmarks free to turn, as there
            slam.prior = FeaturePrior(
                archive.array("prior/mean", (None,)),
                _get_population(archive),
                tuple(meta["categories"]),
                archive.array("prior/log_frequency", (len(meta["categories"]),)),
                float(meta["category_error"]),
                float(meta["objectness_prior"]),
            )
            slam.scales = IncrementalCalibration(slam.config, slam.prior, *(float(v) for v in meta["factors"]))
            slam.T_world_camera, slam.last_odometry = (
                archive.array("T_world_camera", (4, 4)),
                archive.array("last_odometry", (4, 4)),
            )
            slam.loops = _get_loops(slam, archive, meta)
            _get_tracks(slam, archive, meta)
            _get_history(slam, archive, meta)
            slam.graph = _get_graph(archive, meta)
            slam.keeper = _get_keeper(slam, meta["keeper"])
            check_links(slam)
        except InputError as error:
            raise error if str(path) in str(error) else located(error, path) from None
        except (GraphError, KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError, RecursionError) as error:
            raise input_error("not a saved online system", got=f"{type(error).__name__}: {error}", file=path) from None


def _get_population(archive: Npz) -> LatentPopulation:
    """The population of latents; older files hold one Gaussian."""
    if "prior/population/mean" not in archive.names:
        return LatentPopulation.of_one(archive.array("prior/mean", (None,)), archive.array("prior/variance", (None,)))
    shapes = ((None,), (None, None), (None,))
    log_weight, mean, variance = (archive.array(f"prior/population/{n}", s) for n, s in zip(POPULATION_ARRAYS, shapes))
    d = len(archive.array("prior/mean", (None,)))
    if mean.shape != (len(log_weight), d) or len(variance) != d or not len(log_weight) or (variance <= 0).any():
        raise ValueError(f"a population of shapes {log_weight.shape}, {mean.shape}, {variance.shape}")
    return LatentPopulation(log_weight, mean, variance)


# -- graph --------------------------------------------------------------------------------------------------------------


def _put_graph(graph: IncrementalGraph, arrays: dict[str, Any], meta: dict[str, Any]) -> None:
    numbers = sorted(graph.factors)
    factors = [graph.factors[n] for n in numbers]
    arrays["graph/factor"] = np.array([(n, f.kind, f.a, f.b) for n, f in zip(numbers, factors)], dtype=np.int64).reshape(-1, 4)
    arrays["graph/T"] = np.array([f.T for f in factors]).reshape(-1, 4, 4)
    arrays["graph/covariance"] = np.array([f.covariance for f in factors]).reshape(-1, 6, 6)
    values = graph.isam.calculateEstimate()
    keys = sorted(values.keys())
    # The linearisation point, which `rebuild` has set: the estimate beside it may differ by what one step moves.
    point = graph.isam.getLinearizationPoint()
    arrays["graph/key"] = np.array(keys, dtype=np.uint64)
    arrays["graph/value"] = np.array([point.atPose3(k).matrix() for k in keys]).reshape(-1, 4, 4)
    hanging = graph.hanging.numbers()
    arrays["graph/attached"] = np.stack([hanging, graph.hanging.onto[hanging]], axis=1)
    arrays["graph/attached_T"] = graph.hanging.T[hanging]
    meta["graph"] = {"careful": graph.careful, "serial": graph.serial, "poses": graph.poses, "landmarks": graph.landmarks}


def _get_graph(archive: Npz, meta: dict[str, Any]) -> IncrementalGraph:
    graph = IncrementalGraph()
    rows = archive.array("graph/factor", (None, 4), kinds="i")
    T, covariance = archive.array("graph/T", (len(rows), 4, 4)), archive.array("graph/covariance", (len(rows), 6, 6))
    for (number, kind, a, b), pose, spread in zip(rows.tolist(), T, covariance):
        graph.keep(number, Factor(kind, a, b, pose, spread))
    keys = archive.array("graph/key", (None,), kinds="u")
    values = archive.array("graph/value", (len(keys), 4, 4))
    attached = archive.array("graph/attached", (None, 2), kinds="i")
    places = archive.array("graph/attached_T", (len(attached), 4, 4))
    for name in ("serial", "poses", "landmarks"):
        setattr(graph, name, int(meta["graph"][name]))
    if graph.poses > len(attached) + len(keys):
        raise ValueError(f"{graph.poses} poses, {len(attached) + len(keys)} known")
    graph.hanging = HangingPoses.of_links(attached[:, 0], attached[:, 1], places, graph.poses)
    graph.careful = bool(meta["graph"]["careful"])
    graph.restart(dict(zip(keys.tolist(), values)))
    return graph


def _get_keeper(slam: IncrementalMemory, stored: dict[str, Any]) -> KeyframeKeeper:
    keeper, poses = KeyframeKeeper(slam.keyframes), slam.graph.of_pose
    keeper.stretch, keeper.condensed = list(stored["stretch"]), list(stored["condensed"])
    keeper.known = {int(t): int(n) for t, n in stored["known"]}
    keeper.start = int(stored["start"])
    explored, keeper.waiting = ([int(first) for first in stored.get(name, ())] for name in ("explored", "waiting"))
    for first in (*explored, *keeper.waiting):
        if not all(p in poses for p in range(first, first + slam.keyframes.stretch)):
            raise ValueError(f"a stretch from {first} that is not in the graph")
    for first in explored:
        keeper.explore(first)
    return keeper


# -- map ----------------------------------------------------------------------------------------------------------------


def _put_landmarks(prefix: str, landmarks: list[RunningLandmark], arrays: dict[str, Any]) -> None:
    for name in (*LANDMARK_ARRAYS, *LANDMARK_NUMBERS):
        arrays[f"{prefix}/{name}"] = np.array([getattr(j, name) for j in landmarks])
    frames = np.full((len(landmarks), MAX_FRAMES), -1, dtype=np.int64)
    for row, landmark in enumerate(landmarks):
        frames[row, : len(landmark.frames)] = list(landmark.frames)
    arrays[f"{prefix}/frames"] = frames


def _get_landmarks(prefix: str, archive: Npz, prior: FeaturePrior) -> list[RunningLandmark]:
    frames = archive.array(f"{prefix}/frames", (None, MAX_FRAMES), kinds="i")
    if not len(frames):
        return []
    columns = typed_columns(archive, prefix, (*LANDMARK_ARRAYS, *LANDMARK_NUMBERS), len(frames), prior)
    out = []
    for row in range(len(frames)):
        values = {name: columns[name][row].copy() for name in LANDMARK_ARRAYS}
        values |= {name: columns[name][row].item() for name in LANDMARK_NUMBERS}
        kept = deque(frames[row][frames[row] >= 0].tolist(), maxlen=MAX_FRAMES)
        out.append(RunningLandmark(**values, frames=kept))
    return out


def _put_loops(loops: LoopCloser, arrays: dict[str, Any], meta: dict[str, Any]) -> None:
    running, drift = loops.map, loops.drift
    _put_landmarks("landmark", [running.landmarks[j] for j in running.numbers.tolist()], arrays)
    arrays["landmark/position"] = running.position
    waiting = loops.waiting
    arrays["waiting/T"] = np.array([m.T_a_b for m in waiting]).reshape(-1, 4, 4)
    meta["loops"] = {
        "merged": sorted(running.merged.items()),
        "fresh": loops.fresh,
        "solved_at": loops.solved_at,
        "waiting": [(m.a, m.b, m.agree) for m in waiting],
    }
    meta["drift"] = {name: getattr(drift, name) for name in DRIFT_NUMBERS} | {
        "parent": drift.parent,
        "standing": drift.standing,
        "loops": [(a, b) for a, b, _ in drift.loops],
        "kept": -1 if drift.kept is None else drift.kept[0],
    }
    arrays["drift/gaps"], arrays["drift/local"] = np.array(drift.gaps), drift.local
    arrays["drift/loops"] = np.array([root for _, _, root in drift.loops]).reshape(-1, 3, 6)
    arrays["drift/kept"] = np.zeros((0, 6, 0)) if drift.kept is None else drift.kept[1]


def _get_loops(slam: IncrementalMemory, archive: Npz, meta: dict[str, Any]) -> LoopCloser:
    running = RunningMap(slam.prior)
    landmarks = _get_landmarks("landmark", archive, slam.prior)
    running.landmarks = {j.number: j for j in landmarks}
    running.numbers = np.array([j.number for j in landmarks], dtype=np.int64)
    running.position = archive.array("landmark/position", (len(landmarks), 3))
    running.merged = {int(a): int(b) for a, b in meta["loops"]["merged"]}
    loops = LoopCloser(slam.config, running)
    loops.fresh, loops.solved_at = [int(j) for j in meta["loops"]["fresh"]], int(meta["loops"]["solved_at"])
    turns = archive.array("waiting/T", (len(meta["loops"]["waiting"]), 4, 4))
    loops.waiting = [Merge(int(a), int(b), T, bool(agree)) for (a, b, agree), T in zip(meta["loops"]["waiting"], turns)]
    stored = meta["drift"]
    gaps = archive.array("drift/gaps", (len(stored["parent"]), 6, 6))
    roots = archive.array("drift/loops", (len(stored["loops"]), 3, 6))
    loops.drift = DriftGraph(
        **{name: int(stored[name]) for name in DRIFT_NUMBERS},
        parent=[int(i) for i in stored["parent"]],
        gaps=list(gaps),
        loops=[(int(a), int(b), root) for (a, b), root in zip(stored["loops"], roots)],
        local=archive.array("drift/local", (6, 6)),
        standing=[int(i) for i in stored["standing"]],
        kept=None if stored["kept"] < 0 else (int(stored["kept"]), archive.array("drift/kept", (None, 6, None))),
    )
    return loops


# -- tracks -------------------------------------------------------------------------------------------------------------


def _put_tracks(slam: IncrementalMemory, arrays: dict[str, Any], meta: dict[str, Any]) -> None:
    tracker = slam.tracker
    assert tracker is not None
    for name in TRACKER_ARRAYS:
        arrays[f"tracker/{name}"] = getattr(tracker, name)
    for name in MODES:
        arrays[f"tracker/modes/{name}"] = getattr(tracker.modes, name)
    if tracker.latent_modes is not None:
        for name in LATENT_MODES:
            arrays[f"tracker/latent_modes/{name}"] = getattr(tracker.latent_modes, name)
    numbers = list(slam.tracks)
    tracks = [slam.tracks[n] for n in numbers]
    _put_landmarks("draft", [t.draft for t in tracks], arrays)
    rows = [(n, frame, m) for n, t in zip(numbers, tracks) for frame, m in t.waiting]
    for name in MEASUREMENTS:
        arrays[f"measurement/{name}"] = np.concatenate([getattr(m, name) for _, _, m in rows]) if rows else np.zeros(0)
    width = max((m.modes.log_weight.shape[1] for _, _, m in rows), default=1)
    for name in MODES:
        padded = [getattr(m.modes.padded(width), name) for _, _, m in rows]
        arrays[f"measurement/modes/{name}"] = np.concatenate(padded) if rows else np.zeros(0)
    meta["tracks"] = {
        "total": tracker.total,
        "live": [(n, t.landmark, t.last) for n, t in zip(numbers, tracks)],
        "waiting": [(n, frame) for n, frame, _ in rows],
    }


def _get_tracks(slam: IncrementalMemory, archive: Npz, meta: dict[str, Any]) -> None:
    tracker = slam.new_tracker()
    tracker.index = archive.array("tracker/index", (None,), kinds="i")
    for name, value in typed_columns(archive, "tracker", TRACKER_ARRAYS, len(tracker.index), slam.prior).items():
        setattr(tracker, name, value)
    tracker.modes = _get_modes(archive, "tracker/modes", len(tracker.index))
    if "tracker/latent_modes/mean" in archive.names:
        mean = archive.array("tracker/latent_modes/mean", (*tracker.latent.shape[:1], None, *tracker.latent.shape[1:]), kinds="f")
        log_weight = archive.array("tracker/latent_modes/log_weight", mean.shape[:2], kinds="f", finite=False)
        tracker.latent_modes = LatentMixture(log_weight, mean)
    tracker.total = int(meta["tracks"]["total"])
    slam.tracker = tracker
    drafts = _get_landmarks("draft", archive, slam.prior)
    slam.tracks = {int(n): LiveTrack(int(j), draft, [], int(last)) for (n, j, last), draft in zip(meta["tracks"]["live"], drafts)}
    waiting = meta["tracks"]["waiting"]
    if not waiting:
        return
    columns = typed_columns(archive, "measurement", MEASUREMENTS, len(waiting), slam.prior)
    modes = _get_modes(archive, "measurement/modes", len(waiting))
    for row, (number, frame) in enumerate(waiting):
        part = slice(row, row + 1)
        own = OrientationModes(modes.log_weight[part], modes.R[part], modes.scale[part])
        measurement = Measurements(**{name: columns[name][part] for name in MEASUREMENTS}, modes=own, latent_modes=None)
        slam.tracks[int(number)].waiting.append((int(frame), measurement))


def _get_modes(archive: Npz, prefix: str, rows: int) -> OrientationModes:
    weight = archive.array(f"{prefix}/log_weight", (rows, None), kinds="f", finite=False)
    R = archive.array(f"{prefix}/R", (*weight.shape, 3, 3), kinds="f")
    return OrientationModes(weight, R, archive.array(f"{prefix}/scale", weight.shape, kinds="f"))


# -- history ------------------------------------------------------------------------------------------------------------


def _put_history(slam: IncrementalMemory, arrays: dict[str, Any], meta: dict[str, Any]) -> None:
    if not slam.keyframes.history:
        return
    table = Detections.concatenate(slam.tables)
    for name in ARRAYS:
        arrays[f"history/{name}"] = getattr(table, name)
    meta["history"] = {name: list(getattr(table, name)) for name in (*TEXTS, "class_names")}
    arrays["history/odometry"] = np.array(slam.odometry)
    arrays["history/assigned"], arrays["history/weight"] = np.concatenate(slam.assigned), np.concatenate(slam.weights)
    arrays["history/step_covariance"] = np.array(slam.step_covariances).reshape(-1, 6, 6)


def _get_history(slam: IncrementalMemory, archive: Npz, meta: dict[str, Any]) -> None:
    if not slam.keyframes.history:
        return
    kept = [name for name in ARRAYS if name not in OPTIONAL or f"history/{name}" in archive.names]  # older files have fewer
    columns: dict[str, Any] = {name: archive.array(f"history/{name}", finite=False) for name in kept}
    columns |= {name: tuple(meta["history"][name]) for name in (*TEXTS, "class_names")}
    table = Detections(**columns)
    slam.odometry = list(archive.array("history/odometry", (slam.frames, 4, 4)))
    bounds = np.searchsorted(table.frame, np.arange(slam.frames + 1))
    spans = list(pairwise(bounds.tolist()))
    slam.tables = [table.select(np.arange(a, b)) for a, b in spans]
    assigned, weight = (archive.array(f"history/{name}", (len(table),)) for name in ("assigned", "weight"))
    slam.assigned = [assigned[a:b] for a, b in spans]
    slam.weights = [weight[a:b] for a, b in spans]
    slam.step_covariances = list(archive.array("history/step_covariance", (None, 6, 6)))
