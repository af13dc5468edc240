"""The E-step of single detections against a map: exact marginals of every frame, with new-landmark and background odds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.geometry.pose import inverse, transform
from nolbo_ppl.inference.slam.detection_features import FeaturePrior
from nolbo_ppl.inference.slam.frame_marginals import frame_marginals
from nolbo_ppl.inference.slam.gaussian import squared_distance
from nolbo_ppl.inference.slam.graph import Linearisation, SlamEstimate
from nolbo_ppl.inference.slam.loop_candidates import TrackletFeatures
from nolbo_ppl.inference.slam.measurements import Measurements
from nolbo_ppl.inference.slam.orientation import UNIFORM_LOG_DENSITY, OrientationModes, mixture_log_density
from nolbo_ppl.inference.slam.slam_problem import NoiseModel, SlamConfig

GATE = 25.0
"""Squared Mahalanobis distance beyond which a detection is no candidate for a landmark."""
MAP_ROTATION = 0.02
"""Standard deviation of each angle that the map's own orientation adds, rad."""
LISTED = 1e-4
"""Marginals below this are not listed."""


@dataclass(frozen=True)
class Associations:
    """Marginal association of every detection, sparse: rows of the table, landmark numbers, probabilities."""

    row: Int[np.ndarray, " p"]
    """Detection of each entry."""
    landmark: Int[np.ndarray, " p"]
    """Landmark of each entry."""
    weight: Float[np.ndarray, " p"]
    """Its probability."""
    new: Float[np.ndarray, " k"]
    """Probability of each detection being an object the map does not hold."""
    background: Float[np.ndarray, " k"]
    """Probability of each detection being no object."""
    log_evidence: Float[np.ndarray, " f"]
    """Log evidence of each frame with detections, nats."""
    exact: bool
    """Whether every frame was summed exactly."""


def associate_detections(
    measurements: Measurements,
    noise: NoiseModel,
    config: SlamConfig,
    prior: FeaturePrior,
    estimate: SlamEstimate,
    features: TrackletFeatures,
    linearisation: Linearisation,
    rng: np.random.Generator,
) -> Associations:
    """Marginals of all detections over the landmarks of a map.

    Detection k of frame t is landmark j with odds `p(score | object) N(x_k; x(T_t, l_j), S + relative covariance) ...`, a new
    object with `p(score | object) lambda_new`, background with `p(score | clutter) lambda_clutter` (docs/em.md).
    """
    log_new = measurements.log_object + np.log(noise.new_rate)
    log_clutter = measurements.log_clutter + np.log(noise.clutter_rate)
    log_null = np.logaddexp(log_new, log_clutter)
    pose_delta, landmark_delta = linearisation.samples(min(config.samples, 48), rng)
    rows, landmarks, square, log_det = _gated(measurements, estimate, pose_delta, landmark_delta)
    value = measurements.log_object[rows] - 0.5 * (square + log_det)
    value += feature_log_ratio(measurements, rows, landmarks, prior, config, estimate, features)
    found = frame_marginals(measurements.frame, rows, landmarks, value, log_null, associator=config.associator)
    listed = found.weight > LISTED
    new = found.null * np.exp(log_new - log_null)
    return Associations(
        row=rows[listed],
        landmark=landmarks[listed],
        weight=found.weight[listed],
        new=new,
        background=np.maximum(found.null - new, 0.0),
        log_evidence=found.log_evidence,
        exact=found.exact,
    )


def feature_log_ratio(
    measurements: Measurements,
    rows: Int[np.ndarray, " p"],
    landmarks: Int[np.ndarray, " p"],
    prior: FeaturePrior,
    config: SlamConfig,
    estimate: SlamEstimate,
    features: TrackletFeatures,
) -> Float[np.ndarray, " p"]:
    """Log ratio of the latent, category and orientation of detections given landmarks to those of any object, nats.

    A pair without an orientation on both sides has no orientation term: the ratio is that to the uniform density.
    """
    seen = measurements
    value = prior.pair_log_ratio(
        seen.latent[rows],
        seen.latent_variance[rows],
        seen.category[rows],
        features.latent[landmarks],
        features.latent_variance[landmarks],
        features.category[landmarks],
    )
    both = np.flatnonzero(seen.oriented[rows] & features.oriented[landmarks])
    if len(both):
        k, j = rows[both], landmarks[both]
        predicted = np.swapaxes(estimate.T_world_camera[seen.frame[k], :3, :3], 1, 2) @ estimate.T_world_landmark[j, :3, :3]
        modes = seen.modes.select(k)
        modes = OrientationModes(modes.log_weight, modes.R, np.hypot(modes.scale, MAP_ROTATION))
        value[both] += mixture_log_density(predicted, modes, seen.symmetry[k], config) - UNIFORM_LOG_DENSITY
    return value


def _gated(
    measurements: Measurements, estimate: SlamEstimate, pose_delta: np.ndarray, landmark_delta: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Detection-landmark pairs inside the gate: rows, landmarks, squared distances and log determinants of 2 pi S."""
    seen, T_world_camera = measurements, estimate.T_world_camera
    position = estimate.T_world_landmark[:, :3, 3]
    world = transform(T_world_camera[seen.frame], seen.position)
    count = pose_delta.shape[2]
    R_landmark, R_camera = estimate.T_world_landmark[:, :3, :3], T_world_camera[:, :3, :3]
    moved_landmark = np.einsum("mij,mjs->mis", R_landmark, landmark_delta[:, 3:])
    scale = np.sqrt(np.trace(seen.covariance, axis1=1, axis2=2))
    # A generous first gate on the sensor's scale plus a fifth of the range for the relative pose.
    reach = 5 * scale + 0.2 * np.linalg.norm(seen.position, axis=1)
    out: list[tuple[np.ndarray, ...]] = []
    for start in range(0, len(seen), 2000):
        part = np.arange(start, min(start + 2000, len(seen)))
        distance = np.linalg.norm(world[part, None] - position[None], axis=2)
        i, j = np.nonzero(distance < reach[part, None])
        k = part[i]
        frame = seen.frame[k]
        local = transform(inverse(T_world_camera[frame]), position[j])
        error = local - seen.position[k]
        # Deviation of the landmark in the camera's frame: R'(dp - R v) - omega x local.
        deviation = np.einsum("pji,pjs->pis", R_camera[frame], moved_landmark[j]) - pose_delta[frame, 3:]
        deviation -= np.cross(pose_delta[frame, :3], local[:, :, None], axis=1)
        S = seen.covariance[k] + deviation @ np.swapaxes(deviation, 1, 2) / count
        squared, log_determinant = squared_distance(error, S)
        inside = squared < GATE
        out.append((k[inside], j[inside], squared[inside], log_determinant[inside]))
    if not out:
        empty = np.zeros(0, dtype=np.int64)
        return empty, empty, np.zeros(0), np.zeros(0)
    rows, landmarks, square, log_det = (np.concatenate(x) for x in zip(*out))
    return rows, landmarks, square, log_det
