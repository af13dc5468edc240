"""Voxel figures: intersection over union and average precision of occupancy, one value an object."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.voxels import voxel_iou as grid_iou


def voxel_iou(
    probability: Float[np.ndarray, "n v v v"], truth: Bool[np.ndarray, "n v v v"], threshold: float = 0.5
) -> Float[np.ndarray, " n"]:
    """Intersection over union of the voxels above the threshold with the true ones.

    Raises:
        InputError: shapes do not match, or a truth has no occupied voxel.
    """
    _checked(probability, truth)
    return grid_iou(np.asarray(probability) > threshold, np.asarray(truth, dtype=bool))


def voxel_average_precision(
    probability: Float[np.ndarray, "n v v v"], truth: Bool[np.ndarray, "n v v v"]
) -> Float[np.ndarray, " n"]:
    """Average precision of occupancy over the voxels of each object: `sum_k (recall_k - recall_k-1) precision_k`.

    Without interpolation; voxels of equal probability enter together (saturated sigmoids tie).

    Raises:
        InputError: shapes do not match, or a truth has no occupied voxel.
    """
    probability, truth = _checked(probability, truth)
    result = np.empty(len(truth))
    for i, (p, occupied) in enumerate(zip(probability, truth)):
        order = np.argsort(-p)
        falling = p[order]
        last = np.flatnonzero(np.append(falling[1:] != falling[:-1], True))
        hits = np.cumsum(occupied[order])[last]
        result[i] = (np.diff(hits, prepend=0) * (hits / (last + 1))).sum() / hits[-1]
    return result


def _checked(
    probability: Float[np.ndarray, "n v v v"], truth: Bool[np.ndarray, "n v v v"]
) -> tuple[Float[np.ndarray, "n voxels"], Bool[np.ndarray, "n voxels"]]:
    """Both as rows of voxels."""
    probability, truth = np.asarray(probability), np.asarray(truth, dtype=bool)
    if probability.shape != truth.shape or truth.ndim != 4:
        raise input_error("voxel grids", got=(probability.shape, truth.shape), expected="two of shape (n, v, v, v)")
    if not np.isfinite(probability).all():
        raise input_error("occupancy probability", got="a value that is not finite", expected="numbers in [0, 1]")
    shape = (len(truth), int(np.prod(truth.shape[1:])))
    probability, truth = probability.reshape(shape), truth.reshape(shape)
    empty = np.flatnonzero(~truth.any(1))
    if len(empty):
        raise input_error("a true shape without an occupied voxel", got=f"object {empty[0]}", expected="a solid shape")
    return probability, truth
