"""The factor graph in GTSAM: poses, landmarks, odometry, observations with their weights, links between landmarks.

Every landmark is a Pose3, also where no orientation is observed: a `BetweenFactorPose3` then carries a rotation part so
loose (10 rad) that it says nothing. It converges in 5 iterations where points with bearing and range take 16. Weights
sit in the noise models (scale / sqrt(w)) and are frozen while the graph is solved.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import gtsam
import numpy as np
from jaxtyping import Bool, Float, Int

from nolbo_ppl._moved import renamed
from nolbo_ppl.errors import NolboError
from nolbo_ppl.geometry.pose import inverse, make_pose, relative, transform
from nolbo_ppl.inference.slam.gaussian import squared_distance
from nolbo_ppl.inference.slam.measurements import Measurements
from nolbo_ppl.inference.slam.orientation import resolve_modes
from nolbo_ppl.inference.slam.scale_state import add_scale_walk, scale_key, scaled_step_factor
from nolbo_ppl.inference.slam.slam_problem import NoiseModel, SlamConfig, SlamProblem
from nolbo_ppl.metrics.heavy_tails import student_weight

UNINFORMATIVE_ROTATION_SIGMA = 10.0
"""Scale of a rotation nobody observed, rad."""
PRIOR_ROTATION, PRIOR_POSITION_RATIO = 1.0, 1e3
"""Weak prior of each landmark about its first estimate: rad, and the multiple of the typical range in m."""
FIRM_ROTATION_SIGMA = 1e-2
"""Scale of the prior on the rotation of a landmark without an orientation, rad."""
MINIMUM_WEIGHT = 1e-3
"""Observations of no more weight are left out of the graph."""
GAUGE_SCALE = 1e-5
"""Scale of the prior that fixes the first pose, rad and m."""


class GraphError(NolboError, RuntimeError):
    """GTSAM could not solve the graph; the message names the pose or landmark."""


@dataclass(frozen=True)
class SlamEstimate:
    """Values of all variables."""

    T_world_camera: Float[np.ndarray, "n 4 4"]
    """Camera poses."""
    T_world_landmark: Float[np.ndarray, "m 4 4"]
    """Landmark poses; the rotation means nothing where none is observed."""
    scale: Float[np.ndarray, " n-1"] | None = None
    """Factor on the length of each odometry step, where that is a state (`scale_state`)."""


@dataclass(frozen=True)
class ObservationFactors:
    """Relative pose measurements of landmarks, ready for the graph."""

    frame: Int[np.ndarray, " k"]
    """Pose each hangs on."""
    landmark: Int[np.ndarray, " k"]
    """Landmark each hangs on."""
    T_camera_landmark: Float[np.ndarray, "k 4 4"]
    """Measured pose, symmetry and flips resolved."""
    covariance: Float[np.ndarray, "k 6 6"]
    """Covariance [rotation, position] in the measured landmark's frame, rad^2 and m^2."""
    weight: Float[np.ndarray, " k"]
    """Frozen weight."""
    index: Int[np.ndarray, " k"]
    """Detection each is of (a place in the rows they were made from)."""


@dataclass(frozen=True)
class LandmarkEqualities:
    """Soft equality of two landmarks."""

    a: Int[np.ndarray, " l"]
    """Newer landmark."""
    b: Int[np.ndarray, " l"]
    """Older landmark."""
    weight: Float[np.ndarray, " l"]
    """Probability that both are one object."""
    T_a_b: Float[np.ndarray, "l 4 4"]
    """Identity, or the half turn or symmetry between the two landmarks' frames."""
    scale: Float[np.ndarray, "l 2"]
    """Scales of rotation in rad and of position in m."""

    @staticmethod
    def none() -> LandmarkEqualities:
        """No links."""
        return LandmarkEqualities(np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros((0, 4, 4)), np.zeros((0, 2)))

    def __len__(self) -> int:
        return len(self.a)


def pose_key(i: int) -> int:
    """GTSAM key of pose i."""
    return gtsam.symbol("x", int(i))


def landmark_key(j: int) -> int:
    """GTSAM key of landmark j."""
    return gtsam.symbol("l", int(j))


def inflated(
    covariance: Float[np.ndarray, "k 3 3"], position: Float[np.ndarray, "k 3"], across: float, along: float
) -> Float[np.ndarray, "k 3 3"]:
    """Covariances of observed positions multiplied by one factor across the ray and another along it."""
    ray = position / np.maximum(np.linalg.norm(position, axis=1, keepdims=True), 1e-9)
    root = np.sqrt(across) * np.eye(3) + (np.sqrt(along) - np.sqrt(across)) * ray[:, :, None] * ray[:, None, :]
    return root @ covariance @ root


def resolve_observations(
    measurements: Measurements,
    noise: NoiseModel,
    config: SlamConfig,
    estimate: SlamEstimate,
    rows: Int[np.ndarray, " k"],
    landmark: Int[np.ndarray, " k"],
    weight: Float[np.ndarray, " k"],
) -> ObservationFactors:
    """Measured relative poses of the given detections; a factor of several orientation modes is split by their responsibilities.

    A mode with `SURE_MODE` stands alone. The share of the uninformative part keeps the position alone, as do detections
    without an orientation.
    """
    seen = measurements.select(rows)
    frame, symmetry = seen.frame, seen.symmetry
    predicted = relative(estimate.T_world_camera[frame], estimate.T_world_landmark[landmark])[:, :3, :3]
    plain, o = np.flatnonzero(~seen.oriented), np.flatnonzero(seen.oriented)
    modes = resolve_modes(predicted[o], seen.modes.select(o), symmetry[o], config)
    k = np.concatenate([plain, o[modes.row]])
    # Without an orientation the landmark's axes are those it has: then the factor's error is that of the position, exactly.
    R = np.concatenate([predicted[plain], modes.R])
    angular = np.concatenate([np.full(len(plain), np.inf), modes.scale]) * np.sqrt(noise.rotation_factor)
    informative = np.isfinite(angular)
    covariance = np.zeros((len(k), 6, 6))
    covariance[:, [0, 1, 2], [0, 1, 2]] = (np.where(informative, angular, UNINFORMATIVE_ROTATION_SIGMA) ** 2)[:, None]
    covariance[informative & (symmetry[k] == 0), 2, 2] = UNINFORMATIVE_ROTATION_SIGMA**2
    S = inflated(seen.covariance[k], seen.position[k], noise.position_factor, noise.range_factor)
    covariance[:, 3:, 3:] = np.swapaxes(R, 1, 2) @ S @ R
    share = np.concatenate([np.ones(len(plain)), modes.responsibility])
    if noise.position_dof is not None:
        # Student's t as a mixture of Gaussians over scales: its mean precision given the error, frozen like every weight.
        place = transform(inverse(estimate.T_world_camera[frame[k]]), estimate.T_world_landmark[landmark[k], :3, 3])
        square, _ = squared_distance(place - seen.position[k], S)
        share = share * student_weight(square, noise.position_dof)
    return ObservationFactors(frame[k], landmark[k], make_pose(R, seen.position[k]), covariance, weight[k] * share, k)


def odometry_factors(problem: SlamProblem, noise: NoiseModel) -> gtsam.NonlinearFactorGraph:
    """Gauge prior on the first pose, one factor a step, and the random walk of their scales where scale drifts."""
    graph = gtsam.NonlinearFactorGraph()
    graph.add(
        gtsam.PriorFactorPose3(pose_key(0), gtsam.Pose3(problem.odometry[0]), gtsam.noiseModel.Isotropic.Sigma(6, GAUGE_SCALE))
    )
    steps = relative(problem.odometry[:-1], problem.odometry[1:])
    for i, step in enumerate(steps):
        sigmas = np.repeat([noise.rotation_step[i], noise.translation_step[i]], 3)
        model: gtsam.noiseModel.Base
        if noise.step_correlation is None:
            model = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        else:
            model = gtsam.noiseModel.Gaussian.Covariance(sigmas[:, None] * noise.step_correlation[i] * sigmas)
        if noise.scale_walk is None:
            graph.add(gtsam.BetweenFactorPose3(pose_key(i), pose_key(i + 1), gtsam.Pose3(step), model))
        else:
            graph.add(scaled_step_factor(pose_key(i), pose_key(i + 1), i, step, model))
    if noise.scale_walk is not None:
        add_scale_walk(graph, len(steps), noise.scale_walk)
    return graph


def odometry_rows(steps: int, noise: NoiseModel) -> int:
    """Rows that `odometry_factors` of so many steps take in the linearised graph; observations come behind them."""
    return 6 * (steps + 1) + (0 if noise.scale_walk is None else steps)


def add_observation_factors(
    graph: gtsam.NonlinearFactorGraph,
    factors: ObservationFactors,
    minimum: float = MINIMUM_WEIGHT,
    robust_width: float | None = None,
) -> None:
    """One factor a detection, its covariance divided by its weight; weights below `minimum` are left out.

    Under a Cauchy kernel when a width is given.
    """
    covariance = factors.covariance / np.maximum(factors.weight, 1e-12)[:, None, None]
    # One batched factorisation here, so that GTSAM checks nothing and prints nothing.
    information = np.linalg.inv(np.linalg.cholesky(covariance))
    kernel = None if robust_width is None else gtsam.noiseModel.mEstimator.Cauchy.Create(robust_width)
    for k in np.flatnonzero(factors.weight > minimum):
        model: gtsam.noiseModel.Base = gtsam.noiseModel.Gaussian.SqrtInformation(information[k], False)
        if kernel is not None:
            model = gtsam.noiseModel.Robust.Create(kernel, model)
        graph.add(
            gtsam.BetweenFactorPose3(
                pose_key(factors.frame[k]), landmark_key(factors.landmark[k]), gtsam.Pose3(factors.T_camera_landmark[k]), model
            )
        )


def add_landmark_priors(
    graph: gtsam.NonlinearFactorGraph,
    T_world_landmark: Float[np.ndarray, "m 4 4"],
    typical_range: float,
    oriented: Bool[np.ndarray, " m"] | None = None,
) -> None:
    """Weak prior on each landmark, so that no system is ever indeterminate; firm on rotations that nobody observes.

    Free to turn, a landmark of elongated covariances would: the error of a `BetweenFactorPose3` is in the frame of the turned
    landmark, where what is off across the ray comes to lie along it and costs nothing (lateral errors of boxes were 3 of their
    standard deviations in the median of a drive, at a tenth of the error they cost).
    """
    position = PRIOR_POSITION_RATIO * max(typical_range, 1e-3)
    weak, firm = (
        gtsam.noiseModel.Diagonal.Sigmas(np.array([rotation] * 3 + [position] * 3))
        for rotation in (PRIOR_ROTATION * UNINFORMATIVE_ROTATION_SIGMA, FIRM_ROTATION_SIGMA)
    )
    for j, T in enumerate(T_world_landmark):
        free = oriented is None or oriented[j]
        graph.add(gtsam.PriorFactorPose3(landmark_key(j), gtsam.Pose3(T), weak if free else firm))


def add_landmark_equalities(graph: gtsam.NonlinearFactorGraph, links: LandmarkEqualities, robust_width: float | None) -> None:
    """Between-factors of linked landmarks, weighted; under a Cauchy kernel when a width is given."""
    for k in range(len(links)):
        sigmas = np.repeat(links.scale[k], 3) / np.sqrt(max(links.weight[k], 1e-12))
        model: gtsam.noiseModel.Base = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        if robust_width is not None:
            model = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(robust_width), model)
        graph.add(
            gtsam.BetweenFactorPose3(landmark_key(links.a[k]), landmark_key(links.b[k]), gtsam.Pose3(links.T_a_b[k]), model)
        )


def to_values(estimate: SlamEstimate) -> gtsam.Values:
    """GTSAM values of an estimate."""
    values = gtsam.Values()
    for i, T in enumerate(estimate.T_world_camera):
        values.insert(pose_key(i), gtsam.Pose3(T))
    for j, T in enumerate(estimate.T_world_landmark):
        values.insert(landmark_key(j), gtsam.Pose3(T))
    for i, scale in enumerate(() if estimate.scale is None else estimate.scale):
        values.insert(scale_key(i), np.array([scale]))
    return values


def from_values(values: gtsam.Values, poses: int, landmarks: int, scales: int | None = None) -> SlamEstimate:
    """An estimate of GTSAM values."""
    camera = np.array([values.atPose3(pose_key(i)).matrix() for i in range(poses)]).reshape(poses, 4, 4)
    landmark = np.array([values.atPose3(landmark_key(j)).matrix() for j in range(landmarks)]).reshape(landmarks, 4, 4)
    scale = None if scales is None else np.array([values.atVector(scale_key(i))[0] for i in range(scales)])
    return SlamEstimate(camera, landmark, scale)


def named_error(error: RuntimeError) -> GraphError:
    """Turn GTSAM's complaint into one that names the variable."""
    text = " ".join(str(error).split())
    return GraphError(f"the factor graph cannot be solved: {text[:300]} (x: pose of that row, l: landmark of that number)")


def optimize(
    graph: gtsam.NonlinearFactorGraph, estimate: SlamEstimate, *, iterations: int = 20, relative_tolerance: float = 1e-5
) -> tuple[SlamEstimate, float, float]:
    """Levenberg-Marquardt from an estimate; the new one and the error (half squared, whitened) before and after.

    Raises:
        GraphError: GTSAM could not solve it; names the variable.
    """
    values = to_values(estimate)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(iterations)
    parameters.setRelativeErrorTol(relative_tolerance)
    parameters.setVerbosityLM("SILENT")
    try:
        before = graph.error(values)
        result = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
        after = graph.error(result)
    except RuntimeError as error:
        raise named_error(error) from None
    if not np.isfinite(after) or after > before:
        return estimate, before, before
    scales = None if estimate.scale is None else len(estimate.scale)
    return from_values(result, len(estimate.T_world_camera), len(estimate.T_world_landmark), scales), before, after


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
