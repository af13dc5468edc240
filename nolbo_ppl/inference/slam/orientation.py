"""Orientation likelihoods with several modes: symmetry group, 180-degree flips and an uninformative part."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.data.observations import ObservationTable
from nolbo_ppl.geometry.pose import so3_exp, so3_log
from nolbo_ppl.inference.slam.config import SlamConfig

UNIFORM_LOG_DENSITY = -np.log(8.0 * np.pi**2)
"""Log density of the uniform distribution on SO(3) with respect to rotation vectors at the identity, rad^-3."""
_MAXIMUM_ORDER = 8


def resolved_symmetry(table: ObservationTable, config: SlamConfig) -> Int[np.ndarray, " n"]:
    """Symmetry order of every observation: its own, else its category's, else none (1)."""
    by_category = np.array([config.category_symmetry.get(c, 1) if c else 1 for c in table.category], dtype=np.int64)
    return np.where(table.symmetry >= 0, table.symmetry, by_category.reshape(len(table)))


def vertical_turns(order: int) -> Float[np.ndarray, "g 3 3"]:
    """Rotations about the object's vertical axis that an n-fold symmetry cannot tell apart, and their half turns."""
    order = min(max(order, 1), _MAXIMUM_ORDER)
    angles = 2 * np.pi * np.arange(order) / order
    if order % 2:
        angles = np.concatenate([angles, angles + np.pi])
    return so3_exp(angles[:, None] * np.array([0.0, 0.0, 1.0]))


def _free_alignment(R_predicted: np.ndarray, R_observed: np.ndarray) -> np.ndarray:
    """Angle about the object's z axis that brings each observed rotation closest to the predicted one."""
    M = np.swapaxes(R_observed, -1, -2) @ R_predicted
    return np.arctan2(M[..., 1, 0] - M[..., 0, 1], M[..., 0, 0] + M[..., 1, 1])


def nearest_mode_rotation(
    R_predicted: Float[np.ndarray, "n 3 3"], R_observed: Float[np.ndarray, "n 3 3"], symmetry: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3 3"]:
    """The equivalent of each observed rotation (symmetry, half turn) that is closest to the predicted one."""
    out = R_observed.copy()
    for order in np.unique(symmetry):
        rows = np.flatnonzero(symmetry == order)
        predicted, observed = R_predicted[rows], R_observed[rows]
        if order == 0:
            angle = _free_alignment(predicted, observed)
            out[rows] = observed @ so3_exp(angle[:, None] * np.array([0.0, 0.0, 1.0]))
            continue
        candidates = observed[:, None] @ vertical_turns(int(order))[None]
        closeness = np.einsum("nij,ngij->ng", predicted, candidates)
        out[rows] = candidates[np.arange(len(rows)), np.argmax(closeness, axis=1)]
    return out


def orientation_log_density(
    R_predicted: Float[np.ndarray, "n 3 3"], R_observed: Float[np.ndarray, "n 3 3"], scale: Float[np.ndarray, " n"],
    symmetry: Int[np.ndarray, " n"], config: SlamConfig,
) -> Float[np.ndarray, " n"]:
    """Log density of observed rotations: a mixture over symmetry, half turns and a uniform part, rad^-3.

    Each mode is normal in the rotation vector; a free axis is integrated out (its angle is uniform).
    """
    out = np.full(len(R_predicted), -np.inf)
    outlier = np.log(config.orientation_outlier) + UNIFORM_LOG_DENSITY
    for order in np.unique(symmetry):
        rows = np.flatnonzero(symmetry == order)
        predicted, observed, s = R_predicted[rows], R_observed[rows], scale[rows]
        if order == 0:
            angle = _free_alignment(predicted, observed)
            aligned = observed @ so3_exp(angle[:, None] * np.array([0.0, 0.0, 1.0]))
            tilt = so3_log(np.swapaxes(predicted, 1, 2) @ aligned)[:, :2]
            log_mode = -0.5 * np.sum(tilt**2, axis=1) / s**2 - np.log(2 * np.pi * s**2) - np.log(2 * np.pi)
            out[rows] = np.logaddexp(np.log1p(-config.orientation_outlier) + log_mode, outlier)
            continue
        turns = vertical_turns(int(order))
        group = int(order)
        weight = np.full(len(turns), config.flip_probability / max(len(turns) - group, 1))
        weight[:group] = (1 - (config.flip_probability if len(turns) > group else 0.0)) / group
        error = so3_log(np.swapaxes(predicted, 1, 2)[:, None] @ observed[:, None] @ turns[None])
        log_modes = (np.log(weight) - 0.5 * np.sum(error**2, axis=2) / s[:, None] ** 2
                     - 1.5 * np.log(2 * np.pi * s[:, None] ** 2))
        best = np.logaddexp.reduce(log_modes, axis=1)
        out[rows] = np.logaddexp(np.log1p(-config.orientation_outlier) + best, outlier)
    return out
