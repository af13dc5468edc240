"""Log evidence of a solved map, comparable between runs and phases: which of two maps explains the detections better.

Laplace about the solution, every hypothesis a density over the same space: odometry steps with their normalisers, detections
of landmarks as `q(o) N(x; ...)` against `(1 - q(o)) lambda_clutter`, a density `lambda_new` for each landmark's place, a
uniform orientation, latents and categories of its tracks against the population, and the determinant of the whole graph. A
landmark too many costs its density and its uncertainty; a wrong merge costs the residuals.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse.linalg
from jaxtyping import Bool, Float, Int

from nolbo_ppl.geometry.pose import inverse, relative, transform
from nolbo_ppl.inference.slam.detection_features import LARGE_VARIANCE, fuse_latent
from nolbo_ppl.inference.slam.gaussian import position_log_density, squared_distance
from nolbo_ppl.inference.slam.graph import odometry_rows
from nolbo_ppl.inference.slam.initialise import base_graph
from nolbo_ppl.inference.slam.latent_mixture import chosen_modes
from nolbo_ppl.inference.slam.linearisation import Linearisation, linearise
from nolbo_ppl.inference.slam.orientation import UNIFORM_LOG_DENSITY, mixture_log_density
from nolbo_ppl.inference.slam.slam_state import SlamState

LOG_2PI = float(np.log(2 * np.pi))


def map_log_evidence(state: SlamState) -> float:
    """Log evidence of the state's associations and landmarks, poses and landmarks integrated out, nats.

    Up to a constant that depends on the problem and the tracks alone: states of one problem compare.
    """
    linearisation = linearise(base_graph(state), state.estimate)
    steps = len(state.problem) - 1
    odometry = linearisation.residual[: odometry_rows(steps, state.noise)]
    value = -0.5 * float(odometry @ odometry) - 3 * float(
        np.sum(np.log(state.noise.rotation_step)) + np.sum(np.log(state.noise.translation_step))
    )
    if state.noise.scale_walk is not None:
        value -= max(steps - 1, 0) * float(np.log(state.noise.scale_walk))
    oriented = state.features.oriented
    value += -0.5 * _log_determinant(linearisation, oriented) + 1.5 * (len(oriented) + oriented.sum()) * LOG_2PI
    value += len(oriented) * np.log(state.noise.birth_intensity) + oriented.sum() * UNIFORM_LOG_DENSITY
    return float(value + np.sum(detection_log_odds(state)) + feature_log_evidence(state))


def _log_determinant(linearisation: Linearisation, oriented: Bool[np.ndarray, " m"]) -> float:
    """Log determinant of the normal matrix without the rotations of landmarks that have none: their integral is one."""
    columns = np.ones(linearisation.jacobian.shape[1], dtype=bool)
    columns[: 6 * len(oriented)].reshape(-1, 6)[:, :3] = oriented[:, None]
    J = linearisation.jacobian[:, np.flatnonzero(columns)]
    factor = scipy.sparse.linalg.splu(
        (J.T @ J).tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
    return float(np.sum(np.log(np.abs(factor.U.diagonal()))))


def detection_log_odds(state: SlamState) -> Float[np.ndarray, " k"]:
    """Log density of each detection in the graph at the estimate, over that of being background, by its weight, nats.

    Errors that resemble one another from frame to frame count as the graph counts them: their log densities are divided by
    the factor on their covariances.
    """
    noise = state.noise
    seen = state.measurements.select(state.rows)
    T = relative(state.estimate.T_world_camera[seen.frame], state.estimate.T_world_landmark[state.landmark])
    square, log_det = squared_distance(T[:, :3, 3] - seen.position, seen.covariance)
    factor = (noise.position_factor**2 * noise.range_factor) ** (1 / 3)
    log_density = position_log_density(square, log_det, noise.position_dof) / factor
    oriented = np.flatnonzero(seen.oriented)
    if len(oriented):
        modes, symmetry = seen.modes.select(oriented), seen.symmetry[oriented]
        turn = mixture_log_density(T[oriented, :3, :3], modes, symmetry, state.config) - UNIFORM_LOG_DENSITY
        log_density[oriented] += turn / noise.rotation_factor
    log_background = seen.log_clutter + np.log(noise.clutter_intensity)
    return state.weight * (np.logaddexp(seen.log_object + log_density, log_background) - log_background)


def feature_log_evidence(state: SlamState) -> float:
    """Latents and categories of each landmark's tracks, one after the other, against any object's, nats."""
    prior, seen = state.prior, state.measurements.select(state.rows)
    track = state.tracklets.of_observation[state.rows]
    latent, variance, category = seen.latent, seen.latent_variance, seen.category
    doubt = np.zeros(len(latent))
    if seen.latent_modes is not None:
        # A detection takes its mode in the landmark, at the price of that mode against the one of its track alone.
        row = np.arange(len(latent))
        chosen, alone = (chosen_modes(seen.latent_modes, variance, of, state.weight) for of in (state.landmark, track))
        latent = seen.latent_modes.mean[row, chosen]
        doubt = np.minimum(seen.latent_modes.log_weight[row, chosen] - seen.latent_modes.log_weight[row, alone], 0.0)
        category = np.where(chosen == seen.latent_modes.heaviest, category, -1)  # what it names goes with the heaviest mode
    members: dict[int, dict[int, list[int]]] = {}
    for place, (j, t, weight) in enumerate(zip(state.landmark.tolist(), track.tolist(), state.weight.tolist())):
        if weight <= 0.5:
            continue
        members.setdefault(j, {}).setdefault(t, []).append(place)
    value = float(doubt[state.weight > 0.5].sum())
    correlation = state.config.latent_correlation or 0.0
    for tracks in members.values():
        mean = spread = None
        label = -1
        for rows in tracks.values():
            index = np.array(rows)
            mine = _most_frequent(category[index])
            if label >= 0 and mine >= 0:
                ratio = float(prior.category_log_ratio(np.array([label]), np.array([mine]))[0])
            else:
                ratio = 0.0
            label = mine if label < 0 else label
            known = index[variance[index, 0] < LARGE_VARIANCE] if latent.shape[1] else index[:0]
            if not len(known):
                value += ratio
                continue
            own = 1.0 / np.sum(1.0 / variance[known], axis=0)
            z = own * np.sum(latent[known] / variance[known], axis=0)
            own = own * (1 + correlation * (len(known) - 1))
            if mean is None or spread is None:
                mean, spread = z, own
                continue
            value += float(prior.population.log_ratio(z[None], own[None], mean[None], spread[None])[0]) + min(ratio, 0.0)
            mean, spread = fuse_latent(mean, spread, z, own)
    return value


def _most_frequent(category: Int[np.ndarray, " n"]) -> int:
    named = category[category >= 0]
    return int(np.bincount(named).argmax()) if len(named) else -1


def trajectory_distance(a: Float[np.ndarray, "n 4 4"], b: Float[np.ndarray, "n 4 4"]) -> float:
    """Root mean square distance of the positions of two trajectories that begin at one pose, m."""
    moved = transform(inverse(a[0]), a[:, :3, 3]) - transform(inverse(b[0]), b[:, :3, 3])
    return float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))
