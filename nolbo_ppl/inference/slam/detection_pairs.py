"""Candidate pairs of single detections and landmarks of a map, each detection judged against a landmark it did not place.

A detection that helped to place a landmark lies near it by construction. Its residual and its own share of the landmark's
covariance are taken out in closed form (the leave-one-out prediction of least squares), and likewise its share of the
landmark's latent and orientation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from nolbo_ppl.geometry.pose import inverse, skew, transform
from nolbo_ppl.inference.slam.detection_features import LARGE_VARIANCE, weighted_latents
from nolbo_ppl.inference.slam.gaussian import position_log_density, squared_distance
from nolbo_ppl.inference.slam.graph import inflated
from nolbo_ppl.inference.slam.latent_mixture import resolved_latents
from nolbo_ppl.inference.slam.linearisation import Linearisation
from nolbo_ppl.inference.slam.near_pairs import near_pairs
from nolbo_ppl.inference.slam.orientation import UNIFORM_LOG_DENSITY, OrientationModes, mixture_log_density
from nolbo_ppl.inference.slam.slam_state import SlamState

GATE = 25.0
"""Squared Mahalanobis distance beyond which a detection is no candidate for a landmark."""
MAP_ROTATION = 0.02
"""Standard deviation of each angle that the map's own orientation adds, rad."""
EXACT_MEMBERS = 3
"""Landmarks of at most this many detections: covariances by exact solves. With more, a detection's own share is so small
that samples (a fifth off) do."""
EXACT_PAIRS = 1500
"""Most pairs that exact solves are spent on, those of the smallest landmarks first."""
LARGEST_LEVERAGE = 0.995
"""A detection's own share of the position of its landmark is taken as at most this."""


@dataclass(frozen=True)
class DetectionPairs:
    """Candidate pairs of a detection and a landmark."""

    row: Int[np.ndarray, " p"]
    """Detection."""
    landmark: Int[np.ndarray, " p"]
    """Landmark."""
    member: Float[np.ndarray, " p"]
    """Weight with which the detection placed the landmark; 0 for none."""
    local: Float[np.ndarray, "p 3"]
    """Landmark in the camera frame, m."""
    log_position: Float[np.ndarray, " p"]
    """Log density of the position, predicted from all other detections, m^-3."""
    log_feature: Float[np.ndarray, " p"]
    """Log ratio of latent, category and orientation to the population, predicted from all other detections."""
    log_residual: Float[np.ndarray, " p"]
    """Log density of the position about the landmark as it stands, by the sensor's covariance alone, m^-3."""

    def __len__(self) -> int:
        return len(self.row)


def detection_pairs(state: SlamState, linearisation: Linearisation, rng: np.random.Generator) -> DetectionPairs:
    """All pairs inside the gate, with their log densities."""
    seen, estimate = state.measurements, state.estimate
    pose_delta, landmark_delta = linearisation.samples(linearisation.affordable(min(state.config.samples, 48)), rng)
    row, landmark = _near(state)
    member = _member_weights(state, row, landmark)
    out: list[tuple[np.ndarray, ...]] = []
    R_landmark = estimate.T_world_landmark[:, :3, :3]
    moved = np.einsum("mij,mjs->mis", R_landmark, landmark_delta[:, 3:])
    exact = _exact_rows(state, member, landmark)
    for start in range(0, len(row), 20000):
        part = slice(start, start + 20000)
        k, j = row[part], landmark[part]
        t = seen.frame[k]
        T_camera_world = inverse(estimate.T_world_camera[t])
        at = transform(T_camera_world, estimate.T_world_landmark[j, :3, 3])
        # Deviation of the landmark in the camera's frame: R'(dp - R v) - omega x local.
        deviation = np.einsum("pij,pjs->pis", T_camera_world[:, :3, :3], moved[j]) - pose_delta[t, 3:]
        deviation -= np.cross(pose_delta[t, :3], at[:, :, None], axis=1)
        relative = deviation @ np.swapaxes(deviation, 1, 2) / deviation.shape[2]
        own = np.flatnonzero(exact[part])
        if len(own):
            relative[own] = relative_covariance(
                linearisation, T_camera_world[own, :3, :3] @ R_landmark[j[own]], at[own], t[own], j[own]
            )
        error = at - seen.position[k]
        prediction, S = _without_own(state, k, member[part], error, relative)
        square, log_det = squared_distance(prediction, S)
        inside = np.flatnonzero(square < GATE)
        dof = state.noise.position_dof
        log_residual = position_log_density(*squared_distance(error[inside], seen.covariance[k[inside]]), dof)
        out.append((start + inside, at[inside], position_log_density(square, log_det, dof)[inside], log_residual))
    none = (np.zeros(0, int), np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    use, local, log_position, log_residual = (np.concatenate(x) for x in zip(*out)) if out else none
    row, landmark, member = row[use], landmark[use], member[use]
    log_feature = feature_log_ratio(state, row, landmark, member)
    return DetectionPairs(row, landmark, member, local, log_position, log_feature, log_residual)


def _near(state: SlamState) -> tuple[np.ndarray, np.ndarray]:
    """Pairs inside a generous gate: five times the sensor's scale and a fifth of the range for the relative pose."""
    seen = state.measurements
    position = state.estimate.T_world_landmark[:, :3, 3]
    world = transform(state.estimate.T_world_camera[seen.frame], seen.position)
    reach = 5 * np.sqrt(np.trace(seen.covariance, axis1=1, axis2=2)) + 0.2 * np.linalg.norm(seen.position, axis=1)
    return near_pairs(world, reach**2, position, np.zeros(len(position)))


def _placed(state: SlamState, row: np.ndarray, landmark: np.ndarray) -> tuple[Int[np.ndarray, " p"], Bool[np.ndarray, " p"]]:
    """Place of each pair among those in the graph, and whether it is there at all."""
    m = max(len(state.estimate.T_world_landmark), 1)
    placed = state.rows.astype(np.int64) * m + state.landmark
    order = np.argsort(placed, kind="stable")
    asked = row.astype(np.int64) * m + landmark
    at = np.minimum(np.searchsorted(placed[order], asked), max(len(placed) - 1, 0))
    if not len(placed):
        return at, np.zeros(len(row), dtype=bool)
    return order[at], placed[order][at] == asked


def _member_weights(state: SlamState, row: np.ndarray, landmark: np.ndarray) -> Float[np.ndarray, " p"]:
    """Weight with which each pair is in the graph."""
    place, there = _placed(state, row, landmark)
    return np.where(there, state.weight[place], 0.0) if there.any() else np.zeros(len(row))


def _exact_rows(state: SlamState, member: np.ndarray, landmark: np.ndarray) -> np.ndarray:
    """Pairs whose covariance is worth an exact solve."""
    count = np.bincount(state.landmark, state.weight, minlength=len(state.estimate.T_world_landmark))[landmark]
    wanted = np.flatnonzero((member > 1e-3) & (count <= EXACT_MEMBERS + 0.5))
    wanted = wanted[np.argsort(count[wanted], kind="stable")][:EXACT_PAIRS]
    exact = np.zeros(len(member), dtype=bool)
    exact[wanted] = True
    return exact


def relative_covariance(
    linearisation: Linearisation,
    R_camera_landmark: Float[np.ndarray, "p 3 3"],
    local: Float[np.ndarray, "p 3"],
    pose: Int[np.ndarray, " p"],
    landmark: Int[np.ndarray, " p"],
) -> Float[np.ndarray, "p 3 3"]:
    """Exact covariances of landmarks' positions in camera frames: `H (J'J)^-1 H'`, three solves a pair, m^2."""
    size = linearisation.jacobian.shape[1]
    out = np.empty((len(pose), 3, 3))
    block = np.arange(6)
    for start in range(0, len(pose), 64):
        part = np.arange(start, min(start + 64, len(pose)))
        H_landmark = np.concatenate([np.zeros((len(part), 3, 3)), R_camera_landmark[part]], axis=2)
        H_pose = np.concatenate([skew(local[part]), -np.tile(np.eye(3), (len(part), 1, 1))], axis=2)
        right = np.zeros((size, 3 * len(part)))
        for i, p in enumerate(part):
            columns = slice(3 * i, 3 * i + 3)
            right[6 * landmark[p] + block, columns] = H_landmark[i].T
            right[6 * (linearisation.landmarks + pose[p]) + block, columns] = H_pose[i].T
        solution = linearisation.factor.solve(right)
        for i, p in enumerate(part):
            columns = slice(3 * i, 3 * i + 3)
            own = solution[6 * landmark[p] + block, columns], solution[6 * (linearisation.landmarks + pose[p]) + block, columns]
            out[p] = H_landmark[i] @ own[0] + H_pose[i] @ own[1]
    return 0.5 * (out + np.swapaxes(out, 1, 2))


def _without_own(
    state: SlamState, row: np.ndarray, member: np.ndarray, error: np.ndarray, relative: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Residual and covariance of each detection's position predicted without its own factor.

    With the factor's covariance R and the estimate's P (it holds the factor), the prediction without it has covariance
    `S0 = R (R - P)^-1 R` and residual `S0 R^-1 e`; what the sensor adds to the estimate's part is its own covariance.
    """
    seen, noise = state.measurements, state.noise
    S = seen.covariance[row] + relative
    prediction = error.copy()
    own = np.flatnonzero(member > 1e-3)
    if not len(own):
        return prediction, S
    k = row[own]
    R = inflated(seen.covariance[k], seen.position[k], noise.position_factor, noise.range_factor) / member[own, None, None]
    root = np.linalg.cholesky(R)
    inverse_root = np.linalg.inv(root)
    leverage, axes = np.linalg.eigh(inverse_root @ relative[own] @ np.swapaxes(inverse_root, 1, 2))
    grow = 1.0 / (1.0 - np.clip(leverage, 0.0, LARGEST_LEVERAGE))
    white = np.einsum("pji,pj->pi", axes, np.einsum("pij,pj->pi", inverse_root, error[own]))
    turned = root @ axes
    prediction[own] = np.einsum("pij,pj->pi", turned, grow * white)
    S[own] = seen.covariance[k] + np.einsum("pij,pj,pkj->pik", turned, grow - 1.0, turned)
    return prediction, S


def feature_log_ratio(
    state: SlamState, row: Int[np.ndarray, " p"], landmark: Int[np.ndarray, " p"], member: Float[np.ndarray, " p"]
) -> Float[np.ndarray, " p"]:
    """Log ratio of latent, category and orientation of detections given landmarks to those of any object, nats.

    A pair without an orientation on both sides has no orientation term: the ratio is that to the uniform density.
    """
    seen, features, config, estimate = state.measurements, state.features, state.config, state.estimate
    m = len(estimate.T_world_landmark)
    mean, variance = features.latent[landmark], features.latent_variance[landmark]
    own = np.flatnonzero(member > 1e-3)
    if len(own) and mean.shape[1]:
        mean, variance = mean.copy(), variance.copy()
        k, j = row[own], landmark[own]
        inside = seen.select(state.rows)
        taken = resolved_latents(inside.latent, inside.latent_variance, inside.latent_modes, state.landmark, state.weight)
        raw, raw_variance = weighted_latents(taken, inside.latent_variance, state.landmark, state.weight, m)
        mine = seen.latent[k] if seen.latent_modes is None else taken[_placed(state, k, j)[0]]
        known = seen.latent_variance[k] < LARGE_VARIANCE
        precision = 1.0 / raw_variance[j] - np.where(known, member[own, None] / seen.latent_variance[k], 0.0)
        some = precision > 1e-6 / raw_variance[j]
        total = raw[j] / raw_variance[j] - np.where(known, member[own, None] * mine / seen.latent_variance[k], 0.0)
        # Views that are alike widen a mean of n by 1 + r (n - 1).
        views = np.maximum(variance[own] / raw_variance[j] - (config.latent_correlation or 0.0) * known, 1.0)
        mean[own] = np.where(some, total / np.where(some, precision, 1.0), mean[own])
        variance[own] = np.where(some, views / np.where(some, precision, 1.0), LARGE_VARIANCE)
    value = state.prior.log_likelihood_ratio(
        seen.latent[row],
        seen.latent_variance[row],
        seen.category[row],
        mean,
        variance,
        features.category[landmark],
        None if seen.latent_modes is None else seen.latent_modes.select(row),
    )
    both = np.flatnonzero(seen.oriented[row] & features.oriented[landmark])
    if len(both):
        k, j, w = row[both], landmark[both], member[both]
        predicted = np.swapaxes(estimate.T_world_camera[seen.frame[k], :3, :3], 1, 2) @ estimate.T_world_landmark[j, :3, :3]
        oriented = seen.oriented[state.rows]
        count = np.bincount(state.landmark[oriented], state.weight[oriented], minlength=m)[j]
        # An orientation's own share of a mean of n is 1 / n: squares shrink by (1 - 1 / n)^2 and their scale by half of that.
        rest = np.where(w > 1e-3, 1.0 - np.minimum(w / np.maximum(count, 1e-9), 1.0), 1.0)
        alone = rest < 1e-3
        modes = seen.modes.select(k)
        scale = np.hypot(modes.scale, MAP_ROTATION) * np.sqrt(np.where(alone, 1.0, rest))[:, None]
        modes = OrientationModes(modes.log_weight, modes.R, scale)
        ratio = mixture_log_density(predicted, modes, seen.symmetry[k], config) - UNIFORM_LOG_DENSITY
        value[both] += np.where(alone, 0.0, ratio + 3 * np.log(np.where(alone, 1.0, rest)))
    return value
