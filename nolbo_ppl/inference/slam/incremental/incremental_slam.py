"""Online SLAM: a keyframe at a time on iSAM2, landmarks used again where they are met again, the batch map at the end.

Each keyframe costs one association of its detections with live tracks, one of new tracks with landmarks that may be there, one
iSAM2 update, and the read-out of one pose. On known ground nothing is added to the map, and keyframes behind the window are
condensed (`KeyframeConfig`), so that the running graph follows the ground covered and not the time driven. Every few ended
tracks that found no landmark one window of them is matched to all older ones, and what is one object becomes one landmark.
`landmarks()` and `trajectory()` answer at any keyframe; `finish` hands all tracks to the batch EM for the final map.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from os import PathLike
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from nolbo_ppl._moved import renamed
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import inverse, is_rotation
from nolbo_ppl.inference.slam.detection_features import fit_prior
from nolbo_ppl.inference.slam.incremental.forgetting import forget_oldest
from nolbo_ppl.inference.slam.incremental.incremental_calibration import calibrate_incremental, default_calibration
from nolbo_ppl.inference.slam.incremental.incremental_loops import LoopCloser
from nolbo_ppl.inference.slam.incremental.incremental_memory import IncrementalMemory
from nolbo_ppl.inference.slam.incremental.incremental_state import load_state, save_state
from nolbo_ppl.inference.slam.incremental.keyframes import KeyframeConfig
from nolbo_ppl.inference.slam.incremental.landmark_assignment import assign_landmarks
from nolbo_ppl.inference.slam.incremental.map_answers import map_landmarks
from nolbo_ppl.inference.slam.incremental.running_map import RunningMap
from nolbo_ppl.inference.slam.initialise import init_from_tracklets
from nolbo_ppl.inference.slam.measurements import Measurements, resolve
from nolbo_ppl.inference.slam.noise.noise_estimation import DEFAULT_ROTATION_STEP, DEFAULT_TRANSLATION_RATIO, estimate_noise
from nolbo_ppl.inference.slam.slam_problem import (
    NoiseModel,
    SlamConfig,
    SlamProblem,
    check_step_covariance,
    metric_odometry,
)
from nolbo_ppl.inference.slam.slam_result import SlamResult
from nolbo_ppl.inference.slam.solve import complete
from nolbo_ppl.inference.slam.tracking import summarise_tracks
from nolbo_ppl.progress import progress_bar
from nolbo_ppl.structures.detections import Detections
from nolbo_ppl.structures.landmark import Landmark


@dataclass(frozen=True)
class IncrementalInfo:
    """What one keyframe did."""

    frame: int
    """Its number."""
    T_world_camera: Float[np.ndarray, "4 4"]
    """Current pose."""
    landmarks: int
    """Landmarks in the running graph."""
    closings: int
    """Pairs of landmarks found to be one at this keyframe."""
    met: int = 0
    """Tracks put to landmarks met again at this keyframe."""
    keyframes: int = 0
    """Poses in the running graph."""


class IncrementalSlam(IncrementalMemory):
    """Object SLAM fed keyframe by keyframe: `update(odometry, observations)`, then `finish()`.

    Scales that the configuration does not state are taken from a reference problem (the first part of a drive, or an
    earlier one of the same sensors) given as `calibration`; without one they are the defaults.

    Example:
        >>> import nolbo_ppl
        >>> from nolbo_ppl.data.simulate import WorldConfig, simulate_circuit, simulate_sequence
        >>> rng = np.random.default_rng(0)
        >>> drive = simulate_sequence(simulate_circuit(rng, frames_per_lap=30), rng, world=WorldConfig(objects=15))

        >>> slam = nolbo_ppl.IncrementalSlam()
        >>> for frame, pose in enumerate(drive.odometry[:10]):
        ...     info = slam.update(pose, drive.observations.select(drive.observations.frame == frame))
        >>> info.frame, info.T_world_camera.shape
        (9, (4, 4))
    """

    def __init__(
        self,
        config: SlamConfig | None = None,
        calibration: SlamProblem | None = None,
        keyframes: KeyframeConfig | None = None,
    ) -> None:
        super().__init__(metric_odometry(config or SlamConfig(), "the online system"), keyframes or KeyframeConfig())
        self.calibration = calibration

    # -- one keyframe -------------------------------------------------------------------------------------------------

    def update(
        self,
        odometry: Float[np.ndarray, "4 4"],
        observations: Detections,
        odometry_covariance: Float[np.ndarray, "6 6"] | None = None,
    ) -> IncrementalInfo:
        """Take the next keyframe.

        Args:
            odometry: its T_world_camera as odometry has it.
            observations: its detections; their frame numbers are ignored.
            odometry_covariance: of the step that led here (see `SlamProblem`), for all keyframes after the first or for none.

        Raises:
            InputError: odometry or observations are malformed.
        """
        odometry = np.asarray(odometry, dtype=np.float64)
        if odometry.shape != (4, 4) or not np.isfinite(odometry).all() or not is_rotation(odometry[:3, :3]):
            raise input_error("odometry is no pose", got=odometry, expected="a finite 4 x 4 rigid motion")
        frame = self.frames
        steps = frame and self.beginning is None
        if steps and odometry_covariance is not None:
            check_step_covariance(np.asarray(odometry_covariance)[None], 1)
        if steps and self.stated is not None and (odometry_covariance is not None) != self.stated:
            raise input_error("odometry_covariance is given for some keyframes only", do="give it for all or for none")
        table = replace(observations, frame=np.zeros(len(observations), dtype=np.int64))
        problem = SlamProblem(odometry[None], table)  # checks the detections
        self._begin(problem)
        noise = self._noise(problem)
        rotation, translation = self._add_pose(odometry, frame, odometry_covariance)
        measurements = resolve(table, noise, self.config, self.prior)
        assigned, weight = self._track(measurements, odometry, frame, rotation, translation)
        self.frames += 1
        self.last_odometry = odometry
        if self.keyframes.history:
            self.odometry.append(odometry)
            self.tables.append(replace(table, frame=np.full(len(table), frame, dtype=np.int64)))
            self.assigned.append(assigned)
            self.weights.append(weight)
        if table.has_rotation.any():
            self.last_oriented = frame
        met = assign_landmarks(self, table, measurements, noise, assigned, frame)
        self.keeper.advance(frame, self.graph)
        self.graph.commit()
        closings = self.loops.close(frame, self.graph, noise, self.live_landmarks())
        self.T_world_camera = self.graph.pose(frame)
        forget_oldest(self.graph, self.loops, self.keeper, frame, self.live_landmarks())
        return IncrementalInfo(frame, self.T_world_camera, len(self.loops.map), closings, met, len(self.graph.of_pose))

    def _begin(self, first: SlamProblem) -> None:
        """At the first keyframe: scales of the reference, and the prior of features."""
        if self.tracker is not None:
            return
        if self.calibration is not None:
            self.scales = calibrate_incremental(self.calibration, self.config)
        else:
            self.scales = default_calibration(first, self.config)
        self.config, self.prior = self.scales.config, self.scales.prior
        self.loops = LoopCloser(self.config, RunningMap(self.prior))
        self.tracker = self.new_tracker()

    def _noise(self, problem: SlamProblem) -> NoiseModel:
        scales = self.scales
        return replace(
            estimate_noise(problem, self.config),
            position_factor=scales.position_factor,
            range_factor=scales.range_factor,
            rotation_factor=scales.rotation_factor,
        )

    def _add_pose(self, odometry: np.ndarray, frame: int, covariance: np.ndarray | None) -> tuple[float, float]:
        """Odometry factor and first value of the new pose; scales of the step."""
        if frame == 0:
            self.T_world_camera = odometry
            self.graph.add_first_pose(odometry)
            return 0.0, 0.0
        if self.beginning is not None:
            self.T_world_camera, spread = self.beginning
            self.beginning = None
            self.graph.add_first_pose(self.T_world_camera, spread)
            self.loops.drift.restart(self.T_world_camera, spread)
            return 0.0, 0.0
        step = inverse(self.last_odometry) @ odometry
        self.stated = covariance is not None
        if covariance is None:
            covariance = self._step_covariance(float(np.linalg.norm(step[:3, 3])))
        elif self.keyframes.history:
            self.step_covariances.append(np.asarray(covariance, dtype=np.float64))
        self.T_world_camera = self.T_world_camera @ step
        self.graph.add_pose(step, covariance, self.T_world_camera)
        rotation, translation = (float(np.sqrt(np.trace(covariance[part, part]) / 3)) for part in (slice(3), slice(3, 6)))
        self.loops.drift.advance(self.T_world_camera, rotation, translation)
        return rotation, translation

    def _step_covariance(self, length: float) -> np.ndarray:
        """Covariance of an odometry step of this length where none is stated."""
        config = self.config
        rotation = config.odometry_rotation_scale or DEFAULT_ROTATION_STEP
        constant, ratio = config.odometry_translation_scale, config.odometry_translation_ratio
        if constant is None and ratio is None:
            ratio = DEFAULT_TRANSLATION_RATIO
        translation = max(float(np.hypot(constant or 0.0, (ratio or 0.0) * length)), 1e-4)
        return np.diag(np.repeat([rotation**2, translation**2], 3))

    def _track(
        self,
        measurements: Measurements,
        odometry: np.ndarray,
        frame: int,
        rotation: float,
        translation: float,
    ) -> tuple[np.ndarray, np.ndarray]:
        tracker = self.tracker
        assert tracker is not None
        if frame:
            tracker.predict(odometry, frame, rotation, translation)
        if not len(measurements):
            return np.zeros(0, dtype=np.int64), np.zeros(0)
        return tracker.associate(measurements.in_world(np.tile(odometry, (len(measurements), 1, 1))), frame)

    # -- answers ------------------------------------------------------------------------------------------------------

    def trajectory(self) -> Float[np.ndarray, "n 4 4"]:
        """All poses as iSAM2 has them now, every loop found so far closed.

        Raises:
            InputError: no keyframe was given.
        """
        self._started()
        self.loops.flush(self.frames - 1, self.graph)
        return self.graph.trajectory()

    def landmarks(self) -> tuple[Landmark, ...]:
        """The map as it is now: pose with covariance, existence, class, latent and size of every landmark.

        Raises:
            InputError: no keyframe was given.
        """
        self._started()
        self.loops.flush(self.frames - 1, self.graph)
        return map_landmarks(self.loops.map, self.graph, self.config)

    def begin(self, T_world_camera: Float[np.ndarray, "4 4"], covariance: Float[np.ndarray, "6 6"]) -> None:
        """Begin another drive on this map, yesterday's as the prior of today's: the next keyframe is its first one.

        Its odometry may start anywhere. Landmarks are met again as far as the covariance allows: by single tracks within five
        scales of a detection, by constellations beyond. `finish` is for one drive alone.

        Args:
            T_world_camera: where the drive begins, in the frame of the map.
            covariance: of that pose, [rotation rad, position m] in the camera's frame.

        Raises:
            InputError: no map yet, no pose, or no covariance.
        """
        self._started()
        T = np.asarray(T_world_camera, dtype=np.float64)
        if T.shape != (4, 4) or not np.isfinite(T).all() or not is_rotation(T[:3, :3]):
            raise input_error("the beginning is no pose", got=T, expected="a finite 4 x 4 rigid motion")
        spread = np.asarray(covariance, dtype=np.float64)
        check_step_covariance(spread[None], 1)
        self.beginning, self.drives = (T, spread), self.drives + 1
        total = self.tracker.total if self.tracker is not None else 0
        self.tracker, self.tracks, self.stated = self.new_tracker(), {}, None
        self.tracker.total = total
        self.keeper.restart(self.frames)

    def save(self, path: str | PathLike[str]) -> None:
        """Write everything to one NPZ file; `load` goes on from it bit for bit as this system does from here.

        Raises:
            InputError: no keyframe was given.

        Example:
            >>> import pathlib, tempfile
            >>> from nolbo_ppl.structures.detections import Detections
            >>> slam = IncrementalSlam()
            >>> _ = slam.update(np.eye(4), Detections.from_arrays([0], np.array([[0.0, 0.0, 5.0]])))
            >>> file = pathlib.Path(tempfile.mkdtemp()) / "online.npz"
            >>> slam.save(file)
            >>> IncrementalSlam.load(file).frames
            1
        """
        self._started()
        save_state(self, path)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> IncrementalSlam:
        """The system that `save` wrote.

        Raises:
            InputError: no such file, damaged, or not of this kind; names it.
        """
        slam = cls()
        load_state(slam, path)
        return slam

    def _started(self) -> None:
        if not self.frames:
            raise input_error("no keyframe was given", do="call update first")

    def finish(self) -> SlamResult:
        """Batch EM on the tracks gathered: the final trajectory and map.

        Raises:
            InputError: no keyframe was given, the history was not kept, or there were several drives.
        """
        self._started()
        if self.drives > 1:
            raise input_error("the map holds several drives", got=self.drives, do="use trajectory() and landmarks()")
        if not self.keyframes.history:
            raise input_error("the history was not kept", do="use trajectory() and landmarks(), or KeyframeConfig(history=True)")
        covariance = np.array(self.step_covariances) if self.step_covariances else None
        problem = SlamProblem(np.array(self.odometry), Detections.concatenate(self.tables), covariance)
        noise = estimate_noise(problem, self.config)
        prior = fit_prior(problem.observations, self.config, noise)
        tracklets = summarise_tracks(problem, noise, self.config, np.concatenate(self.assigned), np.concatenate(self.weights))
        state = init_from_tracklets(problem, self.config, noise, prior, tracklets)
        return complete(state)


def solve_incremental(problem: SlamProblem, config: SlamConfig | None = None, calibration_frames: int = 200) -> SlamResult:
    """Feed a whole problem keyframe by keyframe; scales nobody stated come from its first frames."""
    first = problem.observations.select(problem.observations.frame < calibration_frames)
    covariance = problem.odometry_covariance
    part = None if covariance is None else covariance[: calibration_frames - 1]
    slam = IncrementalSlam(config, calibration=SlamProblem(problem.odometry[:calibration_frames], first, part))
    order = np.argsort(problem.observations.frame, kind="stable")
    bounds = np.searchsorted(problem.observations.frame[order], np.arange(len(problem) + 1))
    for t in progress_bar(range(len(problem)), "following", "keyframe", leave=False):
        step = None if covariance is None or not t else covariance[t - 1]
        slam.update(problem.odometry[t], problem.observations.select(order[bounds[t] : bounds[t + 1]]), step)
    return slam.finish()


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
