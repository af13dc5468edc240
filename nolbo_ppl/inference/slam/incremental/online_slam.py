"""Online SLAM: a keyframe at a time on iSAM2, loops closed as tracks end, the batch map at the end.

Each keyframe costs one association of its detections with live tracks, one iSAM2 update, and the read-out of one pose. Every
few ended tracks one window of them is matched to all older ones (constellation first, the soft E-step for the rest) under the
covariance of a coarse drift graph. `finish` hands tracks and closings to the batch EM for the final map.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from nolbo_ppl._moved import renamed
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import inverse, is_rotation, make_pose, transform
from nolbo_ppl.inference.slam.detection_features import fit_prior, fuse_latent
from nolbo_ppl.inference.slam.incremental.incremental_graph import OnlineGraph
from nolbo_ppl.inference.slam.incremental.incremental_loops import LoopCloser, Track
from nolbo_ppl.inference.slam.initialise import init, init_from_tracklets
from nolbo_ppl.inference.slam.measurements import Measurements, resolve
from nolbo_ppl.inference.slam.noise.noise_estimation import DEFAULT_ROTATION_STEP, DEFAULT_TRANSLATION_RATIO, estimate_noise
from nolbo_ppl.inference.slam.slam_problem import NoiseModel, SlamConfig, SlamProblem, check_step_covariance
from nolbo_ppl.inference.slam.slam_result import SlamResult
from nolbo_ppl.inference.slam.solve import complete
from nolbo_ppl.inference.slam.tracking import Tracker, summarise_tracks
from nolbo_ppl.io.observations import Detections, concatenate


@dataclass(frozen=True)
class OnlineInfo:
    """What one keyframe did."""

    frame: int
    """Its number."""
    T_world_camera: Float[np.ndarray, "4 4"]
    """Current pose."""
    landmarks: int
    """Landmarks in the graph."""
    closings: int
    """Links closed at this keyframe."""


class IncrementalSlam:
    """Object SLAM fed keyframe by keyframe: `update(odometry, observations)`, then `finish()`.

    Scales that the configuration does not state are taken from a reference problem (the first part of a drive, or an
    earlier one of the same sensors) given as `calibration`; without one they are the defaults.
    """

    def __init__(self, config: SlamConfig | None = None, calibration: SlamProblem | None = None) -> None:
        self.config = config or SlamConfig()
        self.calibration = calibration
        self.reference: NoiseModel | None = None
        self.tracker: Tracker | None = None
        self.odometry: list[np.ndarray] = []
        self.tables: list[Detections] = []
        self.frame_of: list[int] = []
        self.assigned: list[np.ndarray] = []
        self.weights: list[np.ndarray] = []
        self.tracks: dict[int, Track] = {}
        self.loops: LoopCloser | None = None
        self.pending: dict[int, list[tuple[int, Measurements, NoiseModel, int]]] = {}
        self.graph = OnlineGraph()
        self.step_covariances: list[np.ndarray] = []
        self.T_world_camera = np.eye(4)
        self.seen = 0

    # -- one keyframe -------------------------------------------------------------------------------------------------

    def update(
        self,
        odometry: Float[np.ndarray, "4 4"],
        observations: Detections,
        odometry_covariance: Float[np.ndarray, "6 6"] | None = None,
    ) -> OnlineInfo:
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
        frame = len(self.odometry)
        if frame and odometry_covariance is not None:
            check_step_covariance(np.asarray(odometry_covariance)[None], 1)
        if frame > 1 and (odometry_covariance is None) == bool(self.step_covariances):
            raise input_error("odometry_covariance is given for some keyframes only", do="give it for all or for none")
        table = replace(observations, frame=np.zeros(len(observations), dtype=np.int64))
        problem = SlamProblem(odometry[None], table)  # checks the detections
        self._begin(table)
        noise = self._noise(problem)
        rotation, translation = self._add_pose(odometry, frame, odometry_covariance)
        measurements = resolve(table, noise, self.config, self.prior)
        assigned, weight = self._track(measurements, odometry, frame, rotation, translation)
        start = self.seen
        self.odometry.append(odometry)
        self.tables.append(replace(table, frame=np.full(len(table), frame, dtype=np.int64)))
        self.assigned.append(assigned)
        self.weights.append(weight)
        self.seen += len(table)
        self._remember(measurements, assigned, start, frame)
        self._add_factors(problem, measurements, noise, assigned, frame)
        self.graph.commit()
        assert self.loops is not None
        closings = self.loops.close(frame, self.graph, noise)
        self.T_world_camera = self.graph.pose(frame)
        return OnlineInfo(frame, self.T_world_camera, self.graph.landmarks, closings)

    def _begin(self, table: Detections) -> None:
        """At the first keyframe: scales of the reference, and the prior of features."""
        if self.tracker is not None:
            return
        if self.calibration is not None:
            state = init(self.calibration, self.config)
            reference, self.prior = state.noise, state.prior
            report = reference.report
            config = self.config
            ratio = config.odometry_translation_ratio
            constant = config.odometry_translation_scale
            if ratio is None and constant is None:
                length = np.linalg.norm(np.diff(self.calibration.odometry[:, :3, 3], axis=0), axis=1)
                ratio = float(np.median(reference.translation_step) / max(np.median(length), 1e-9))
                constant = 0.2 * float(np.median(reference.translation_step))
            lateral, radial = report.get("position_lateral"), report.get("position_radial")
            position, growth = config.position_scale, config.position_ratio
            if position is None and growth is None and lateral is not None and radial is not None:
                width = max(report.get("position_track_width", 1.0), 1.0) * 1.2
                position = width * max(lateral, radial)
                growth = width * max(report["position_lateral_ratio"], report["position_radial_ratio"])
            self.config = replace(
                config,
                odometry_rotation_scale=float(np.median(reference.rotation_step)),
                odometry_translation_ratio=ratio,
                odometry_translation_scale=constant,
                position_scale=position,
                position_ratio=growth,
                rotation_scale=config.rotation_scale or float(np.median(reference.rotation_scale))
                if len(reference.rotation_scale)
                else config.rotation_scale,
                latent_scale=config.latent_scale or (report.get("latent_scale") if "latent_scale" in report else None),
                new_rate=reference.new_rate,
                clutter_rate=reference.clutter_rate,
            )
            self.factors = (reference.position_factor, reference.range_factor, reference.rotation_factor)
        else:
            self.prior = fit_prior(table, self.config)
            self.factors = (1.0, 1.0, 1.0)
            rate = 1e-3
            self.config = replace(
                self.config, new_rate=self.config.new_rate or rate, clutter_rate=self.config.clutter_rate or 0.5 * rate
            )
        self.loops = LoopCloser(self.config, self.prior)
        self.tracker = Tracker(
            self.config,
            table.latent_dim,
            self.prior,
            float(self.config.new_rate or 1e-3),
            float(self.config.clutter_rate or 1e-3),
        )

    def _noise(self, problem: SlamProblem) -> NoiseModel:
        noise = estimate_noise(problem, self.config)
        return replace(noise, position_factor=self.factors[0], range_factor=self.factors[1], rotation_factor=self.factors[2])

    def _add_pose(self, odometry: np.ndarray, frame: int, covariance: np.ndarray | None) -> tuple[float, float]:
        """Odometry factor and first value of the new pose; scales of the step."""
        if frame == 0:
            self.T_world_camera = odometry
            self.graph.add_first_pose(odometry)
            return 0.0, 0.0
        step = inverse(self.odometry[-1]) @ odometry
        if covariance is None:
            covariance = self._step_covariance(float(np.linalg.norm(step[:3, 3])))
        else:
            self.step_covariances.append(np.asarray(covariance, dtype=np.float64))
        self.T_world_camera = self.T_world_camera @ step
        self.graph.add_pose(step, covariance, self.T_world_camera)
        rotation, translation = (float(np.sqrt(np.trace(covariance[part, part]) / 3)) for part in (slice(3), slice(3, 6)))
        assert self.loops is not None
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

    def _remember(
        self,
        measurements: Measurements,
        assigned: np.ndarray,
        start: int,
        frame: int,
    ) -> None:
        """Fuse features of each detection into its track."""
        latent, variance = measurements.latent, measurements.latent_variance
        for i, number in enumerate(assigned.tolist()):
            if number < 0:
                continue
            if number not in self.tracks:
                self.tracks[number] = Track(
                    [start + i],
                    -1,
                    latent[i],
                    variance[i],
                    int(measurements.category[i]),
                    int(measurements.symmetry[i]),
                    bool(measurements.oriented[i]),
                    frame,
                    frame,
                )
                continue
            track = self.tracks[number]
            track.rows.append(start + i)
            track.last = frame
            track.latent, track.latent_variance = fuse_latent(track.latent, track.latent_variance, latent[i], variance[i])

    def _add_factors(
        self, problem: SlamProblem, measurements: Measurements, noise: NoiseModel, assigned: np.ndarray, frame: int
    ) -> None:
        """Factors of this keyframe's detections; a track enters the graph with its second one, the first is then added."""
        rows, landmarks = [], []
        for i, number in enumerate(assigned.tolist()):
            if number < 0:
                continue
            track = self.tracks[number]
            if track.landmark < 0 and len(track.rows) < self.config.track_minimum:
                self.pending.setdefault(number, []).append((frame, measurements, noise, i))
                continue
            if track.landmark < 0:
                self._found(track, problem.observations, i)
                for earlier, its_measurements, its_noise, k in self.pending.pop(number, []):
                    pose = self.graph.pose(earlier)
                    self.graph.observe(its_measurements, its_noise, self.config, [k], earlier, pose, [track.landmark])
            rows.append(i)
            landmarks.append(track.landmark)
        self.graph.observe(measurements, noise, self.config, rows, frame, self.T_world_camera, landmarks)
        for number in [n for n in self.pending if frame - self.tracks[n].last > self.config.track_gap]:
            del self.pending[number]

    def _found(self, track: Track, table: Detections, i: int) -> None:
        """A new landmark at its latest detection, with its weak prior."""
        R = self.T_world_camera[:3, :3] @ table.rotation[i] if np.isfinite(table.rotation[i, 0, 0]) else np.eye(3)
        T = make_pose(R, transform(self.T_world_camera, table.position[i]))
        track.landmark = self.graph.add_landmark(T, float(np.linalg.norm(table.position[i])))
        assert self.loops is not None
        self.loops.add(track)

    # -- answers ------------------------------------------------------------------------------------------------------

    def trajectory(self) -> Float[np.ndarray, "n 4 4"]:
        """All poses as iSAM2 has them now, every loop found so far closed."""
        if self.loops is not None:
            self.loops.flush(self.graph)
        return self.graph.trajectory()

    def finish(self) -> SlamResult:
        """Batch EM on the tracks gathered: the final trajectory and map.

        Raises:
            InputError: no keyframe was given.
        """
        if not self.odometry:
            raise input_error("no keyframe was given", do="call update first")
        covariance = np.array(self.step_covariances) if self.step_covariances else None
        problem = SlamProblem(np.array(self.odometry), concatenate(self.tables), covariance)
        noise = estimate_noise(problem, self.config)
        prior = fit_prior(problem.observations, self.config, noise)
        tracklets = summarise_tracks(problem, noise, self.config, np.concatenate(self.assigned), np.concatenate(self.weights))
        state = init_from_tracklets(problem, self.config, noise, prior, tracklets)
        return complete(state)


def solve_online(problem: SlamProblem, config: SlamConfig | None = None, calibration_frames: int = 200) -> SlamResult:
    """Feed a whole problem keyframe by keyframe; scales nobody stated come from its first frames."""
    first = problem.observations.select(problem.observations.frame < calibration_frames)
    covariance = problem.odometry_covariance
    part = None if covariance is None else covariance[: calibration_frames - 1]
    slam = IncrementalSlam(config, calibration=SlamProblem(problem.odometry[:calibration_frames], first, part))
    order = np.argsort(problem.observations.frame, kind="stable")
    bounds = np.searchsorted(problem.observations.frame[order], np.arange(len(problem) + 1))
    for t in range(len(problem)):
        step = None if covariance is None or not t else covariance[t - 1]
        slam.update(problem.odometry[t], problem.observations.select(order[bounds[t] : bounds[t + 1]]), step)
    return slam.finish()


__getattr__ = renamed(__name__, {"ObjectSlam": "IncrementalSlam"})
