"""The online system's factor graph on iSAM2: poses, landmarks, observations and links, added and solved in small steps."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
from jaxtyping import Float

from nolbo_ppl.inference.slam.graph import (
    GAUGE_SCALE,
    Links,
    SlamEstimate,
    add_landmark_priors,
    add_links,
    add_observation_factors,
    landmark_key,
    named_error,
    pose_key,
    resolve_observations,
)
from nolbo_ppl.inference.slam.measurements import Measurements
from nolbo_ppl.inference.slam.slam_problem import NoiseModel, SlamConfig

RELINEARISE_ROTATION, RELINEARISE_POSITION = 0.05, 10.0
"""Changes in rad and m beyond which a variable is linearised anew."""


class OnlineGraph:
    """Factors and first values wait until `commit`; `pose` and `landmark` answer with what is known now."""

    def __init__(self) -> None:
        parameters = gtsam.ISAM2Params()
        # Between-factors are linear in positions: only rotations that have moved need a new linearisation point.
        thresholds = gtsam.ISAM2ThresholdMap()
        for symbol in "xl":
            thresholds.insert((symbol, np.repeat([RELINEARISE_ROTATION, RELINEARISE_POSITION], 3)))
        parameters.setRelinearizeThreshold(thresholds)
        parameters.relinearizeSkip = 10
        # Landmarks hang on weak priors beside a nearly fixed first pose: QR takes that spread, Cholesky does not.
        parameters.setFactorization("QR")
        self.isam = gtsam.ISAM2(parameters)
        self.graph = gtsam.NonlinearFactorGraph()
        self.values = gtsam.Values()
        self.poses = 0
        self.landmarks = 0

    def add_first_pose(self, T_world_camera: Float[np.ndarray, "4 4"]) -> None:
        """The pose everything hangs on."""
        model = gtsam.noiseModel.Isotropic.Sigma(6, GAUGE_SCALE)
        self.graph.add(gtsam.PriorFactorPose3(pose_key(0), gtsam.Pose3(T_world_camera), model))
        self.values.insert(pose_key(0), gtsam.Pose3(T_world_camera))
        self.poses = 1

    def add_pose(
        self, step: Float[np.ndarray, "4 4"], covariance: Float[np.ndarray, "6 6"], T_world_camera: Float[np.ndarray, "4 4"]
    ) -> None:
        """The next pose, at its first value, and the odometry step that leads to it."""
        model = gtsam.noiseModel.Gaussian.Covariance(covariance)
        self.graph.add(gtsam.BetweenFactorPose3(pose_key(self.poses - 1), pose_key(self.poses), gtsam.Pose3(step), model))
        self.values.insert(pose_key(self.poses), gtsam.Pose3(T_world_camera))
        self.poses += 1

    def add_landmark(self, T_world_landmark: Float[np.ndarray, "4 4"], distance: float) -> int:
        """A new landmark with its weak prior; returns its number."""
        self.values.insert(landmark_key(self.landmarks), gtsam.Pose3(T_world_landmark))
        add_landmark_priors(self.graph, T_world_landmark[None], distance, first=self.landmarks)
        self.landmarks += 1
        return self.landmarks - 1

    def observe(
        self,
        measurements: Measurements,
        noise: NoiseModel,
        config: SlamConfig,
        rows: list[int],
        frame: int,
        T_world_camera: Float[np.ndarray, "4 4"],
        landmarks: list[int],
    ) -> None:
        """Factors of detections of one keyframe (`measurements` hold that keyframe alone)."""
        if not rows:
            return
        estimate = SlamEstimate(T_world_camera[None], np.array([self.landmark(j) for j in landmarks]))
        count = len(rows)
        factors = resolve_observations(
            measurements, T_world_camera[None], noise, config, estimate, np.array(rows), np.arange(count), np.ones(count)
        )
        factors = replace(factors, frame=np.full_like(factors.frame, frame), landmark=np.array(landmarks)[factors.landmark])
        add_observation_factors(self.graph, factors)

    def add_links(self, links: Links) -> None:
        """Tie landmarks together; the linearisation points follow with the next keyframes."""
        add_links(self.graph, links, None)

    def commit(self) -> None:
        """Hand what waits to iSAM2.

        Raises:
            GraphError: GTSAM could not solve it; names the variable.
        """
        try:
            self.isam.update(self.graph, self.values)
        except RuntimeError as error:
            raise named_error(error) from None
        self.graph = gtsam.NonlinearFactorGraph()
        self.values = gtsam.Values()

    def pose(self, frame: int) -> Float[np.ndarray, "4 4"]:
        """Pose of a keyframe."""
        return self.isam.calculateEstimatePose3(pose_key(frame)).matrix()

    def landmark(self, number: int) -> Float[np.ndarray, "4 4"]:
        """Pose of a landmark; its first value while it waits."""
        key = landmark_key(number)
        if self.values.exists(key):
            return self.values.atPose3(key).matrix()
        return self.isam.calculateEstimatePose3(key).matrix()

    def trajectory(self) -> Float[np.ndarray, "n 4 4"]:
        """All poses."""
        values = self.isam.calculateEstimate()
        return np.array([values.atPose3(pose_key(i)).matrix() for i in range(self.poses)])
