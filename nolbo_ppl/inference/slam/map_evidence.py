"""Log evidence of a solved map, comparable between runs and phases: which of two maps explains the detections better.

Laplace about the solution, every hypothesis a density over the same space: odometry steps with their normalisers, detections
of landmarks as `q(o) N(x; ...)` against `(1 - q(o)) lambda_clutter`, a density `lambda_new` for each landmark's place, a
uniform orientation, latents and categories of its tracks against the population, and the determinant of the whole graph. A
landmark too many costs its density and its uncertainty; a wrong merge costs the residuals.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.geometry.pose import inverse, relative, transform
from nolbo_ppl.inference.slam.detection_features import LARGE_VARIANCE, fuse_latent, latent_log_density
from nolbo_ppl.inference.slam.gaussian import squared_distance
from nolbo_ppl.inference.slam.graph import LOOSE_ROTATION, PRIOR_ROTATION, linearise
from nolbo_ppl.inference.slam.initialise import base_graph
from nolbo_ppl.inference.slam.orientation import UNIFORM_LOG_DENSITY, mixture_log_density
from nolbo_ppl.inference.slam.slam_state import SlamState

LOG_2PI = float(np.log(2 * np.pi))


def map_log_evidence(state: SlamState) -> float:
    """Log evidence of the state's associations and landmarks, poses and landmarks integrated out, nats.

    Up to a constant that depends on the problem and the tracks alone: states of one problem compare.
    """
    linearisation = linearise(base_graph(state), state.estimate)
    steps = len(state.problem) - 1
    odometry = linearisation.residual[: 6 * (steps + 1)]
    value = -0.5 * float(odometry @ odometry) - 3 * float(
        np.sum(np.log(state.noise.rotation_step)) + np.sum(np.log(state.noise.translation_step))
    )
    m = len(state.static)
    value += -0.5 * linearisation.log_determinant() + 0.5 * 6 * m * LOG_2PI
    value += m * (np.log(state.noise.new_rate) + UNIFORM_LOG_DENSITY)
    return value + float(np.sum(detection_log_odds(state))) + _orientation_volume(state) + feature_log_evidence(state)


def detection_log_odds(state: SlamState) -> Float[np.ndarray, " k"]:
    """Log density of each detection in the graph at the estimate, over that of being background, nats.

    Errors that resemble one another from frame to frame count as the graph counts them: their log densities are divided by
    the factor on their covariances.
    """
    noise = state.noise
    seen = state.measurements.select(state.rows)
    T = relative(state.estimate.T_world_camera[seen.frame], state.estimate.T_world_landmark[state.landmark])
    square, log_det = squared_distance(T[:, :3, 3] - seen.position, seen.covariance)
    factor = (noise.position_factor**2 * noise.range_factor) ** (1 / 3)
    log_density = -0.5 * (square + log_det) / factor
    oriented = np.flatnonzero(seen.oriented)
    if len(oriented):
        modes, symmetry = seen.modes.select(oriented), seen.symmetry[oriented]
        turn = mixture_log_density(T[oriented, :3, :3], modes, symmetry, state.config) - UNIFORM_LOG_DENSITY
        log_density[oriented] += turn / noise.rotation_factor
    log_background = seen.log_clutter + np.log(noise.clutter_rate)
    return np.logaddexp(seen.log_object + log_density, log_background) - log_background


def _orientation_volume(state: SlamState) -> float:
    """What the loose rotations of landmarks without an orientation add to the determinant, taken off again."""
    total = np.bincount(state.landmark, weights=state.weight, minlength=len(state.static))
    information = (total + PRIOR_ROTATION**-2) / LOOSE_ROTATION**2
    unoriented = ~state.features.oriented
    # An integral over all orientations of a density that does not depend on them is one.
    return float(np.sum(1.5 * np.log(information[unoriented]) - 1.5 * LOG_2PI - UNIFORM_LOG_DENSITY))


def feature_log_evidence(state: SlamState) -> float:
    """Latents and categories of each landmark's tracks, one after the other, against any object's, nats."""
    prior, seen = state.prior, state.measurements
    track = state.tracklets.of_observation[state.rows]
    latent, variance, category = seen.latent, seen.latent_variance, seen.category
    members: dict[int, dict[int, list[int]]] = {}
    for row, j, t in zip(state.rows.tolist(), state.landmark.tolist(), track.tolist()):
        members.setdefault(j, {}).setdefault(t, []).append(row)
    value = 0.0
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
            population = float(latent_log_density(z, prior.mean, prior.variance + own))
            value += float(latent_log_density(z, mean, spread + own)) - population + min(ratio, 0.0)
            mean, spread = fuse_latent(mean, spread, z, own)
    return value


def _most_frequent(category: Int[np.ndarray, " n"]) -> int:
    named = category[category >= 0]
    return int(np.bincount(named).argmax()) if len(named) else -1


def trajectory_distance(a: Float[np.ndarray, "n 4 4"], b: Float[np.ndarray, "n 4 4"]) -> float:
    """Root mean square distance of the positions of two trajectories that begin at one pose, m."""
    moved = transform(inverse(a[0]), a[:, :3, 3]) - transform(inverse(b[0]), b[:, :3, 3])
    return float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))
