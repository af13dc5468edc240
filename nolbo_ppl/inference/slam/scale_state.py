"""Scale drift as a state: odometry of one camera, whose unit of length is unknown and wanders, as factors of the graph.

Each step of such odometry is a rotation and `t / scale`; the scale of step i is a variable beside the poses,

    T_i^-1 T_i+1 = [R_i, scale_i t_i] exp(noise),    scale_i+1 = scale_i + N(0, walk^2),

a factor on the step as it was handed in. Ranges of detections and places met again tell it. The variable is the factor itself
and not its logarithm: the factor enters the residual linearly, and Levenberg-Marquardt on 200 keyframes with 20 loops takes
5 iterations (0.14 s); with the logarithm it takes 14 and rejects every second one (0.87 s). Steps are put to the right scale
but for the last part before the graph sees them (`noise.odometry_scale`), so that factors stay near one.
"""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
from jaxtyping import Float

FIRST_SCALE = 0.5
"""Prior standard deviation of the first factor about one."""

_IDENTITY = np.eye(6)


def scale_key(i: int) -> int:
    """GTSAM key of the scale of step i; sorts behind landmarks and poses."""
    return gtsam.symbol("z", int(i))


def step_error(step: Float[np.ndarray, "4 4"]) -> Callable[..., np.ndarray]:
    """Error of one step for `gtsam.CustomFactor` on (earlier pose, later pose, scale), with Jacobians as GTSAM's own factor."""
    R, t = gtsam.Rot3(step[:3, :3]), step[:3, 3].copy()
    by_scale = np.zeros((6, 1))
    by_scale[3:, 0] = -step[:3, :3].T @ t

    def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        earlier, later, scale = this.keys()
        moved = values.atPose3(earlier).between(values.atPose3(later))
        if jacobians is not None:
            jacobians[0] = -moved.inverse().AdjointMap()
            jacobians[1] = _IDENTITY
            jacobians[2] = by_scale
        return np.asarray(gtsam.Pose3(R, values.atVector(scale)[0] * t).localCoordinates(moved))

    return error


def scaled_step_factor(
    earlier: int, later: int, i: int, step: Float[np.ndarray, "4 4"], model: gtsam.noiseModel.Base
) -> gtsam.CustomFactor:
    """Factor of odometry step i between two pose keys, its length times the scale of the step."""
    return gtsam.CustomFactor(model, [earlier, later, scale_key(i)], step_error(step))


def add_scale_walk(graph: gtsam.NonlinearFactorGraph, steps: int, walk: float) -> None:
    """Prior of the first scale and the random walk of the others, one row each.

    Args:
        graph: added to.
        steps: steps of the odometry.
        walk: standard deviation of the change from one step to the next.
    """
    if not steps:
        return
    graph.add(gtsam.PriorFactorVector(scale_key(0), np.ones(1), gtsam.noiseModel.Isotropic.Sigma(1, FIRST_SCALE)))
    model = gtsam.noiseModel.Isotropic.Sigma(1, walk)
    for i in range(steps - 1):
        graph.add(gtsam.BetweenFactorVector(scale_key(i), scale_key(i + 1), np.zeros(1), model))
