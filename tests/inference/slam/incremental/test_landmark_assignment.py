"""Which landmark a track gets: none at its first detection, one met again where it is sure, else a new one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nolbo_ppl.inference.slam import IncrementalSlam, SlamConfig
from nolbo_ppl.structures.detections import Detections

CONFIG = SlamConfig(
    odometry_rotation_scale=1e-3, odometry_translation_scale=1e-3, position_scale=0.05, position_ratio=0.0, track_gap=2
)
CHAIR, TABLE = [1.0, 0.2, 5.0], [-2.0, 0.1, 6.0]


def follow(slam: IncrementalSlam, *seen: list[list[float]]) -> list[tuple[int, int]]:
    """Landmarks and tracks met after each keyframe of a camera that stands still."""
    told = []
    for places in seen:
        table = Detections.from_arrays(np.zeros(len(places), int), np.array(places).reshape(-1, 3), objectness=0.95)
        info = slam.update(np.eye(4), table)
        told.append((info.landmarks, info.met))
    return told


def detection_factors(slam: IncrementalSlam, landmark: int) -> int:
    """Factors of the running graph that hold a landmark and a pose."""
    return sum(1 for number in slam.graph.of_landmark[landmark] if len(slam.graph.factors[number].variables()) == 2)


def test_the_second_detection_founds_a_landmark_and_the_first_is_not_lost() -> None:
    slam = IncrementalSlam(CONFIG)
    assert follow(slam, [CHAIR], [CHAIR], [CHAIR, TABLE]) == [(0, 0), (1, 0), (1, 0)]
    assert detection_factors(slam, 0) == 3  # that of the keyframe in which it waited, too
    assert slam.loops.map.landmarks[0].views == 3
    live = {track.landmark for track in slam.tracks.values()}
    assert live == {0, -1} and slam.live_landmarks() == {0}


def test_an_object_met_again_is_its_landmark_and_another_one_is_new() -> None:
    slam = IncrementalSlam(CONFIG)
    follow(slam, [CHAIR], [CHAIR], [CHAIR])
    assert follow(slam, [], [], []) == [(1, 0)] * 3 and not slam.tracks  # the track has ended
    told = follow(slam, [CHAIR, TABLE], [CHAIR, TABLE])
    assert told[-1] == (2, 1)
    assert slam.loops.map.landmarks[0].passes == 2 and slam.loops.map.landmarks[0].views == 5
    position = slam.graph.landmark(1)[:3, 3]
    np.testing.assert_allclose(position, TABLE, atol=0.02)


def test_background_founds_nothing() -> None:
    slam = IncrementalSlam(replace(CONFIG, objectness_prior=0.5, birth_intensity=1e-4, clutter_intensity=1e-2))
    table = Detections.from_arrays(np.zeros(1, int), np.array([CHAIR]), objectness=0.02)
    for _ in range(4):
        assert slam.update(np.eye(4), table).landmarks == 0
