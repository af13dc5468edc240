"""A stretch of keyframes as one: what its detections say of each landmark, seen from the keyframe in its middle."""

from __future__ import annotations

import gtsam
import numpy as np
from jaxtyping import Float

from nolbo_ppl.geometry.pose import inverse
from nolbo_ppl.inference.slam.graph import (
    GAUGE_SCALE,
    PRIOR_ROTATION,
    UNINFORMATIVE_ROTATION_SIGMA,
    landmark_key,
    named_error,
    pose_key,
)

LANDMARK_PRIOR = 1e3
"""Scale of the weak prior that keeps the local system determinate, m."""


def condensed_observations(
    factors: list[gtsam.NonlinearFactor],
    T_world_camera: dict[int, Float[np.ndarray, "4 4"]],
    T_world_landmark: dict[int, Float[np.ndarray, "4 4"]],
    anchor: int,
) -> list[tuple[int, Float[np.ndarray, "4 4"], Float[np.ndarray, "6 6"]]]:
    """Solve a stretch alone, its anchor held fixed.

    Args:
        factors: odometry within the stretch and observations from its poses.
        T_world_camera: its poses by number; they must hang together by the factors.
        T_world_landmark: the landmarks its factors observe.
        anchor: the pose everything is told relative to.

    Returns:
        Landmark, pose relative to the anchor, and marginal covariance [rotation, position] in the landmark's frame.

    Raises:
        GraphError: GTSAM could not solve it.
    """
    if not T_world_landmark:
        return []
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for factor in factors:
        graph.add(factor)
    fixed = gtsam.noiseModel.Isotropic.Sigma(6, GAUGE_SCALE)
    graph.add(gtsam.PriorFactorPose3(pose_key(anchor), gtsam.Pose3(T_world_camera[anchor]), fixed))
    for i, T in T_world_camera.items():
        values.insert(pose_key(i), gtsam.Pose3(T))
    weak = gtsam.noiseModel.Diagonal.Sigmas(np.array([PRIOR_ROTATION * UNINFORMATIVE_ROTATION_SIGMA] * 3 + [LANDMARK_PRIOR] * 3))
    for j, T in T_world_landmark.items():
        values.insert(landmark_key(j), gtsam.Pose3(T))
        graph.add(gtsam.PriorFactorPose3(landmark_key(j), gtsam.Pose3(T), weak))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(5)
    parameters.setVerbosityLM("SILENT")
    try:
        values = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
        marginals = gtsam.Marginals(graph, values)
        back = inverse(values.atPose3(pose_key(anchor)).matrix())
        return [
            (j, back @ values.atPose3(landmark_key(j)).matrix(), np.asarray(marginals.marginalCovariance(landmark_key(j))))
            for j in T_world_landmark
        ]
    except RuntimeError as error:
        raise named_error(error) from None
