"""Which landmark a track of the online system belongs to: one met again, a new one, or none yet.

A track asks for its landmark with its second detection (`SlamConfig.track_minimum`). Until it has one its detections wait; then
all that still lie in the window become factors of the running graph.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.geometry.pose import inverse, make_pose, transform
from nolbo_ppl.inference.slam.incremental.incremental_loops import SURE_WEIGHT
from nolbo_ppl.inference.slam.incremental.incremental_memory import IncrementalMemory
from nolbo_ppl.inference.slam.incremental.live_tracks import LiveTrack
from nolbo_ppl.inference.slam.incremental.running_map import count_detections, new_landmark
from nolbo_ppl.inference.slam.measurements import Measurements
from nolbo_ppl.structures.detections import Detections
from nolbo_ppl.structures.noise_model import NoiseModel

MAX_WAITING = 5
"""Detections a track gathers at most before it founds a landmark, where a known one may be there but is not sure."""
ORIENTED_FRAMES = 50
"""A detector that gave no orientation in so many frames gives none."""


def assign_landmarks(
    memory: IncrementalMemory,
    detections: Detections,
    measurements: Measurements,
    noise: NoiseModel,
    track: Int[np.ndarray, " n"],
    frame: int,
) -> int:
    """Put the detections of a keyframe to landmarks; returns how many tracks met an old one.

    Args:
        memory: of the online system; its tracks, map and graph are changed.
        detections: of the keyframe.
        measurements: the same, resolved.
        noise: of this keyframe.
        track: of each detection, -1 for none.
        frame: number of the keyframe, whose pose is in the graph.
    """
    asking = _gather(memory, detections, measurements, track, frame)
    met = _choose_landmarks(memory, asking, detections, noise, frame)
    rows, landmarks = [], []
    for i, number in enumerate(track.tolist()):
        if number < 0 or memory.tracks[number].landmark < 0:
            continue
        live = memory.tracks[number]
        live.landmark = memory.loops.map.standing(live.landmark)
        for earlier, measurement in live.waiting[:-1]:
            if earlier in memory.graph.of_pose:  # else it has left the window
                _add_factors(memory, measurement, noise, [0], earlier, memory.graph.pose(earlier), [live.landmark])
        if not live.waiting:
            memory.loops.map.landmarks[live.landmark].add(frame, measurements, i, detections.size[i])
        live.waiting = []
        rows.append(i)
        landmarks.append(live.landmark)
    _add_factors(memory, measurements, noise, rows, frame, memory.T_world_camera, landmarks)
    memory.keeper.saw(frame, [memory.loops.map.landmarks[j].passes > 1 for j in landmarks])
    for number in [n for n, live in memory.tracks.items() if frame - live.last > memory.config.track_gap]:
        del memory.tracks[number]
    return met


def _gather(
    memory: IncrementalMemory, detections: Detections, measurements: Measurements, track: Int[np.ndarray, " n"], frame: int
) -> list[tuple[int, int]]:
    """Give each detection to its track; returns the tracks that ask for a landmark, each with its detection here."""
    asking: list[tuple[int, int]] = []
    for i, number in enumerate(track.tolist()):
        if number < 0:
            continue
        if number not in memory.tracks:
            draft = new_landmark(-1, memory.loops.drift.place, frame, memory.prior, int(measurements.symmetry[i]))
            memory.tracks[number] = LiveTrack(-1, draft)
        live = memory.tracks[number]
        live.last = frame
        if live.landmark < 0:
            live.draft.add(frame, measurements, i, detections.size[i])
            live.waiting.append((frame, measurements.select(np.array([i]))))
            if len(live.waiting) >= memory.config.track_minimum:
                asking.append((number, i))
    return asking


def _choose_landmarks(
    memory: IncrementalMemory, asking: list[tuple[int, int]], detections: Detections, noise: NoiseModel, frame: int
) -> int:
    """Give tracks their landmarks: one met again where that is sure, else a new one; the unsure may wait."""
    if not asking:
        return 0
    tracks = [memory.tracks[number] for number, _ in asking]
    poses = [_first_pose(memory, detections, i) for _, i in asking]
    drafts = [live.draft for live in tracks]
    found, new = memory.loops.meet(drafts, poses, frame, memory.live_landmarks(), memory.graph, noise)
    met, oriented = 0, memory.last_oriented is not None and frame - memory.last_oriented < ORIENTED_FRAMES
    for live, T, (landmark, weight), alone, (_, i) in zip(tracks, poses, found, new, asking):
        if weight > SURE_WEIGHT:
            old = memory.loops.map.landmarks[landmark]
            live.landmark = landmark
            old.absorb(live.draft)
            memory.loops.met(landmark, T[:3, 3], noise)
            met += 1
        elif alone > SURE_WEIGHT or len(live.waiting) >= MAX_WAITING:
            number = memory.graph.add_landmark(T, float(np.linalg.norm(detections.position[i])), oriented)
            live.landmark = live.draft.number = number
            live.draft.place = memory.loops.drift.place
            memory.loops.add(live.draft, T[:3, 3])
    return met


def _add_factors(
    memory: IncrementalMemory,
    measurements: Measurements,
    noise: NoiseModel,
    rows: list[int],
    frame: int,
    T_world_camera: Float[np.ndarray, "4 4"],
    landmarks: list[int],
) -> None:
    """Factors of detections of one keyframe, and their evidence that there are objects (see `map_answers`)."""
    if not rows:
        return
    T = memory.graph.observe(measurements, noise, memory.config, rows, frame, T_world_camera, landmarks)
    error = transform(inverse(T_world_camera), T[:, :3, 3]) - measurements.position[rows]
    count_detections(
        [memory.loops.map.landmarks[j] for j in landmarks],
        error,
        T_world_camera[:3, :3],
        measurements.covariance[rows],
        (measurements.log_object - measurements.log_clutter)[rows],
        noise,
        measurements.shared_root[rows],
    )


def _first_pose(memory: IncrementalMemory, detections: Detections, i: int) -> Float[np.ndarray, "4 4"]:
    """First value of a landmark: its latest detection."""
    T = memory.T_world_camera
    R = T[:3, :3] @ detections.rotation[i] if detections.has_rotation[i] else np.eye(3)
    return make_pose(R, transform(T, detections.position[i]))
