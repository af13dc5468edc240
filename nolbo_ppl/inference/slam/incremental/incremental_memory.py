"""Everything the online system holds between two keyframes."""

from __future__ import annotations

import numpy as np

from nolbo_ppl.inference.slam.detection_features import FeaturePrior
from nolbo_ppl.inference.slam.incremental.incremental_calibration import IncrementalCalibration
from nolbo_ppl.inference.slam.incremental.incremental_graph import IncrementalGraph
from nolbo_ppl.inference.slam.incremental.incremental_loops import LoopCloser
from nolbo_ppl.inference.slam.incremental.keyframes import KeyframeConfig, KeyframeKeeper
from nolbo_ppl.inference.slam.incremental.live_tracks import LiveTrack
from nolbo_ppl.inference.slam.slam_problem import SlamConfig
from nolbo_ppl.inference.slam.tracking import Tracker
from nolbo_ppl.structures.detections import Detections


class IncrementalMemory:
    """What a keyframe reads and leaves behind; what `incremental_state` writes to a file."""

    config: SlamConfig
    keyframes: KeyframeConfig
    scales: IncrementalCalibration
    prior: FeaturePrior
    loops: LoopCloser

    def __init__(self, config: SlamConfig, keyframes: KeyframeConfig) -> None:
        self.config, self.keyframes = config, keyframes
        self.tracker: Tracker | None = None
        self.frames = 0
        self.last_oriented: int | None = None
        self.last_odometry = np.eye(4)
        self.odometry: list[np.ndarray] = []
        self.tables: list[Detections] = []
        self.assigned: list[np.ndarray] = []
        self.weights: list[np.ndarray] = []
        self.step_covariances: list[np.ndarray] = []
        self.stated: bool | None = None
        self.tracks: dict[int, LiveTrack] = {}
        self.graph = IncrementalGraph()
        self.keeper = KeyframeKeeper(keyframes)
        self.T_world_camera = np.eye(4)
        self.drives = 1
        self.beginning: tuple[np.ndarray, np.ndarray] | None = None

    def new_tracker(self) -> Tracker:
        """A tracker without tracks, under the scales in use."""
        birth_intensity, clutter_intensity = self.config.birth_intensity, self.config.clutter_intensity
        assert birth_intensity is not None and clutter_intensity is not None  # the calibration states both
        return Tracker(self.config, len(self.prior.mean), self.prior, birth_intensity, clutter_intensity)

    def live_landmarks(self) -> set[int]:
        """Landmarks that belong to tracks the tracker still follows."""
        return {self.loops.map.standing(track.landmark) for track in self.tracks.values() if track.landmark >= 0}
