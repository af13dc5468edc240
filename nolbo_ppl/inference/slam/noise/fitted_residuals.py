"""Residuals of a solved graph beside those its own model expects: what every correction of a scale is read from.

A fit takes part of the noise away: a residual is smaller than its scale by the row's leverage, and the mean of a track's
residuals by much more. Comparing with samples of `e - J (J'J)^-1 J' e`, the residuals the model expects after the same fit,
counts this for single detections, for halves of tracks and for steps of the odometry alike. Equating both sums of squares
is the fixed point of the evidence (MacKay 1992, Neural Computation 4(3), eq. 4.14), unlike the EM update, which creeps.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.inference.slam.graph import (
    MINIMUM_WEIGHT,
    UNINFORMATIVE_ROTATION_SIGMA,
    ObservationFactors,
    add_landmark_equalities,
    odometry_rows,
)
from nolbo_ppl.inference.slam.linearisation import linearise
from nolbo_ppl.inference.slam.shared_errors import error_root
from nolbo_ppl.inference.slam.slam_state import SlamState, measured_graph

SAMPLES = 48
"""Samples of the residuals that the model expects."""
CLIP = 3.0
"""Residuals beyond as many of the expected scales count as that many."""
MAD_TO_SCALE = 1.4826


@dataclass(frozen=True)
class FittedResiduals:
    """Whitened residuals and samples of what the model expects of them."""

    odometry: Float[np.ndarray, "n 6"]
    """Steps of the odometry: rotation, translation."""
    odometry_expected: Float[np.ndarray, "n 6 s"]
    """Samples of the same."""
    observation: Float[np.ndarray, "k 6"]
    """Detections: rotation, position, in the measured landmark's frame; rotations nobody observed are 0."""
    observation_expected: Float[np.ndarray, "k 6 s"]
    """Samples of the same."""
    row: Int[np.ndarray, " k"]
    """Index of each detection into the state's `rows`."""
    oriented: np.ndarray
    """Whether its orientation is informative."""
    root: Float[np.ndarray, "k 3 3"]
    """Root of the covariance of its position: times the whitened residual it is the residual, m."""
    ray: Float[np.ndarray, "k 3"]
    """Unit vector from the camera to it, in the measured landmark's frame."""


def whole_graph(state: SlamState) -> tuple[gtsam.NonlinearFactorGraph, ObservationFactors]:
    """Odometry, detections, priors and links of a state, in this order, and the detections' factors."""
    graph, factors = measured_graph(state)
    add_landmark_equalities(graph, state.links, state.config.robust_width)
    return graph, factors


def fitted_residuals(state: SlamState, rng: np.random.Generator, count: int = SAMPLES) -> FittedResiduals:
    """Residuals of the state's graph at its estimate, links under their kernels included.

    Raises:
        GraphError: the system is indeterminate.
    """
    graph, factors = whole_graph(state)
    linearisation = linearise(graph, state.estimate)
    # What all views of an object err by alike is expected: no sign of scales that are too small.
    linearisation = linearisation.with_errors(error_root(state, factors, linearisation.jacobian.shape[0]))
    expected = linearisation.residual_samples(count, rng)
    steps = len(state.problem) - 1
    kept = np.flatnonzero(factors.weight > MINIMUM_WEIGHT)  # those add_observation_factors takes
    middle, begin = 6 * (steps + 1), odometry_rows(steps, state.noise)
    end = begin + 6 * len(kept)
    index = factors.index[kept]
    sure = factors.weight[kept] > 0.5
    rotation = factors.covariance[kept][:, [0, 1, 2], [0, 1, 2]]
    residual = linearisation.residual[begin:end].reshape(-1, 6)
    oriented = rotation < (0.3 * UNINFORMATIVE_ROTATION_SIGMA) ** 2
    residual[:, :3] *= oriented
    root = np.linalg.cholesky(factors.covariance[kept][sure, 3:, 3:] / factors.weight[kept][sure, None, None])
    T = factors.T_camera_landmark[kept][sure]
    ray = np.einsum("kji,kj->ki", T[:, :3, :3], T[:, :3, 3])
    return FittedResiduals(
        linearisation.residual[6:middle].reshape(-1, 6),
        expected[6:middle].reshape(-1, 6, count),
        residual[sure],
        expected[begin:end].reshape(-1, 6, count)[sure],
        index[sure],
        oriented[sure],
        root,
        ray / np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-12),
    )


def widths_by_ray(found: FittedResiduals) -> tuple[float, float]:
    """Scale of the bulk of position residuals across the ray and along it, in units of what is expected there."""
    residual = np.einsum("kij,kj->ki", found.root, found.observation[:, 3:])
    expected = np.einsum("kij,kjs->kis", found.root, found.observation_expected[:, 3:])
    along = robust_width(np.sum(found.ray * residual, axis=1), np.einsum("ki,kis->ks", found.ray, expected), least=0.0)
    # Two directions across: any pair that is orthogonal to the ray.
    helper = np.where(np.abs(found.ray[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(found.ray, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    pair = np.stack([first, np.cross(found.ray, first)], axis=1)
    across = np.einsum("kai,ki->ka", pair, residual)
    across_expected = np.einsum("kai,kis->kas", pair, expected)
    return robust_width(across.ravel(), across_expected.reshape(across.size, -1), least=0.0), along


def squared_ratio(residual: Float[np.ndarray, " k"], expected: Float[np.ndarray, "k s"]) -> tuple[float, float]:
    """Sum of squares over the expected one, single terms clipped, and the expected sum (the number of them the data tell)."""
    mean = np.mean(expected**2, axis=-1)
    told = float(mean.sum())
    if told <= 0:
        return 1.0, 0.0
    ratio = 1.0
    for _ in range(5):  # clipped at what the ratio itself makes of the scales
        ratio = max(float(np.minimum(residual**2, CLIP**2 * 4 * max(ratio, 1.0) * mean).sum() / told), 1e-12)
    return ratio, told


def robust_width(residual: Float[np.ndarray, " k"], expected: Float[np.ndarray, "k s"], least: float = 1e-6) -> float:
    """Scale of the bulk of residuals in units of what is expected; NaN without any above `least`."""
    mean = np.mean(expected**2, axis=-1)
    use = mean > least
    return float(MAD_TO_SCALE * np.median(np.abs(residual[use]) / np.sqrt(mean[use]))) if use.any() else float("nan")


def block_ratio(
    residual: Float[np.ndarray, "k c"], expected: Float[np.ndarray, "k c s"], block: Int[np.ndarray, " k"]
) -> tuple[float, int]:
    """Squared ratio of sums over blocks (halves of tracks) over that of single residuals, and the number of blocks.

    One where errors are independent from frame to frame; n where all n of a block are the same.
    """
    names, number, count = np.unique(block, return_inverse=True, return_counts=True)
    use = count[number] >= 2
    if use.sum() < 4:
        return 1.0, 0
    limit = (
        CLIP
        * np.sqrt(np.mean(expected**2, axis=-1))
        * max(robust_width(residual.ravel(), expected.reshape(residual.size, -1)), 1e-9)
    )
    clipped = np.clip(residual, -limit, limit)[use]
    sums = np.zeros((len(names), residual.shape[1]))
    np.add.at(sums, number[use], clipped)
    samples = np.zeros((len(names), *expected.shape[1:]))
    np.add.at(samples, number[use], expected[use])
    single = np.sum(clipped**2) / np.sum(np.mean(expected[use] ** 2, axis=-1))
    blocks = np.sum(sums**2) / np.sum(np.mean(samples**2, axis=-1))
    return float(blocks / max(single, 1e-12)), int((count >= 2).sum())


def halves_of_tracks(track: Int[np.ndarray, " k"], frame: Int[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
    """Block of every detection: each track cut in two where half of its detections are past."""
    order = np.lexsort((frame, track))
    _, start, count = np.unique(track[order], return_index=True, return_counts=True)
    position = np.arange(len(track)) - np.repeat(start, count)
    late = position >= np.repeat((count + 1) // 2, count)
    out = np.empty(len(track), dtype=np.int64)
    out[order] = 2 * np.repeat(np.arange(len(start)), count) + late
    return out
