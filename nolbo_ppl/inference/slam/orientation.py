"""Orientation likelihoods with several modes: those a detector states, symmetry group, half turns, an uninformative part.

An observed orientation is a mixture of modes; each of them stands for its orbit under the object's symmetry and, with a
small probability, for its half turn about the vertical axis. The E-step uses the density of the whole mixture; the M-step
splits a factor by the responsibilities of what is left of it (`resolve_modes`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.geometry.pose import rotation_angle, so3_exp, so3_log
from nolbo_ppl.inference.slam.slam_problem import SlamConfig
from nolbo_ppl.io.observations import Detections

UNIFORM_LOG_DENSITY = -np.log(8.0 * np.pi**2)
"""Log density of the uniform distribution on SO(3) with respect to rotation vectors at the identity, rad^-3."""
SURE_MODE = 0.99
"""A mode with this responsibility is kept alone."""
_MAXIMUM_ORDER = 8
_Z = np.array([0.0, 0.0, 1.0])
_TABLE_LOG_SCALE = np.linspace(np.log(1e-4), np.log(1e4), 4001)


@cache
def _log_normalisers(components: int) -> Float[np.ndarray, " t"]:
    """Log normalisers over the table's scales, less those of a Gaussian in flat space; by Gauss-Legendre quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(200)
    scale = np.exp(_TABLE_LOG_SCALE)[:, None]
    upper = np.minimum(np.pi, 9.0 * scale)
    angle = 0.5 * upper * (nodes + 1)
    area = 8 * np.pi * (1 - np.cos(angle)) if components == 3 else 2 * np.pi * np.sin(angle)
    # Small angles: 1 - cos loses digits.
    area = np.where(angle < 1e-3, 4 * np.pi * angle**2 if components == 3 else 2 * np.pi * angle, area)
    total = 0.5 * upper[:, 0] * ((np.exp(-0.5 * (angle / scale) ** 2) * area) @ weights)
    return np.log(total) - 0.5 * components * np.log(2 * np.pi * scale[:, 0] ** 2)


def angle_log_normaliser(scale: Float[np.ndarray, " n"], components: int = 3) -> Float[np.ndarray, " n"]:
    """Log of the integral of `exp(-angle^2 / 2 scale^2)` over SO(3) (3 components) or over the sphere of a tilted axis (2).

    The measure is that of rotation vectors at the identity (8 pi^2 and 4 pi in all), so that the quotient is a density beside
    `UNIFORM_LOG_DENSITY` at every scale. The Gaussian normaliser of flat space leaves mass 0.94 at 0.5 rad and 0.34 at 2 rad.
    A matrix Fisher density would be proper too, but its log is no quadratic form, and the M-step is least squares.
    """
    log_scale = np.log(scale)
    return np.interp(log_scale, _TABLE_LOG_SCALE, _log_normalisers(components)) + 0.5 * components * (
        np.log(2 * np.pi) + 2 * np.minimum(log_scale, _TABLE_LOG_SCALE[-1])
    )


@dataclass(frozen=True)
class OrientationModes:
    """Modes of observed orientations, padded to the same number."""

    log_weight: Float[np.ndarray, "n K"]
    """Log weights, -inf where there are fewer."""
    R: Float[np.ndarray, "n K 3 3"]
    """Rotations."""
    scale: Float[np.ndarray, "n K"]
    """Standard deviation of each angle, rad."""

    def __len__(self) -> int:
        return len(self.log_weight)

    def select(self, rows: np.ndarray) -> OrientationModes:
        """Some of the rows."""
        return OrientationModes(self.log_weight[rows], self.R[rows], self.scale[rows])

    def turned(self, R: Float[np.ndarray, "... 3 3"]) -> OrientationModes:
        """The same in another frame: every mode multiplied by R (one, or one a row) from the left."""
        return OrientationModes(self.log_weight, (R[:, None] if R.ndim == 3 else R) @ self.R, self.scale)

    def padded(self, count: int) -> OrientationModes:
        """With room for `count` modes."""
        n, more = len(self), count - self.log_weight.shape[1]
        if more <= 0:
            return self
        return OrientationModes(
            np.concatenate([self.log_weight, np.full((n, more), -np.inf)], axis=1),
            np.concatenate([self.R, np.tile(np.eye(3), (n, more, 1, 1))], axis=1),
            np.concatenate([self.scale, np.ones((n, more))], axis=1),
        )


def resolved_symmetry(table: Detections, config: SlamConfig) -> Int[np.ndarray, " n"]:
    """Symmetry order of every observation: its own, else its category's, else none (1)."""
    by_category = np.array([config.category_symmetry.get(c, 1) if c else 1 for c in table.category], dtype=np.int64)
    return np.where(table.symmetry >= 0, table.symmetry, by_category.reshape(len(table)))


def observed_modes(
    table: Detections, rotation_scale: Float[np.ndarray, " n"], rows: Int[np.ndarray, " k"] | None = None
) -> OrientationModes:
    """Modes of the given detections: as stated, else one at the observed rotation (the identity where there is none).

    Stated scales of modes are corrected as those of the best mode were (`rotation_scale` over the table's).
    """
    rows = np.arange(len(table)) if rows is None else rows
    n, count = len(rows), max(table.modes, 1)
    oriented = table.has_rotation[rows]
    log_weight = np.full((n, count), -np.inf)
    log_weight[:, 0] = 0.0
    R, scale = np.tile(np.eye(3), (n, count, 1, 1)), np.ones((n, count))
    R[oriented, 0] = table.rotation[rows[oriented]]
    scale[:, 0] = rotation_scale[rows]
    if table.modes:
        weight = table.mode_weight[rows]
        k = np.flatnonzero(oriented & (weight.sum(axis=1) > 0))
        with np.errstate(divide="ignore"):
            log_weight[k] = np.log(weight[k] / weight[k].sum(axis=1, keepdims=True))
        stated = table.rotation_scale[rows[k]]
        correction = np.where(np.isfinite(stated), rotation_scale[rows[k]] / np.where(np.isfinite(stated), stated, 1.0), 1.0)
        R[k], scale[k] = table.mode_rotation[rows[k]], table.mode_std[rows[k]] * correction[:, None]
    return OrientationModes(log_weight, R, scale)


@cache
def vertical_turns(order: int) -> Float[np.ndarray, "g 3 3"]:
    """Rotations about the object's vertical axis that an n-fold symmetry cannot tell apart, and their half turns."""
    order = min(max(order, 1), _MAXIMUM_ORDER)
    angles = 2 * np.pi * np.arange(order) / order
    if order % 2:
        angles = np.concatenate([angles, angles + np.pi])
    return so3_exp(angles[:, None] * _Z)


def turn_shares(order: int, turns: int, config: SlamConfig) -> Float[np.ndarray, " g"]:
    """Prior weight of each of the `vertical_turns`."""
    group = min(max(order, 1), _MAXIMUM_ORDER)
    flip = config.flip_probability if turns > group else 0.0
    return np.where(np.arange(turns) < group, (1 - flip) / group, flip / max(turns - group, 1))


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
            out[rows] = observed @ so3_exp(_free_alignment(predicted, observed)[:, None] * _Z)
            continue
        candidates = observed[:, None] @ vertical_turns(int(order))[None]
        closeness = np.einsum("nij,ngij->ng", predicted, candidates)
        out[rows] = candidates[np.arange(len(rows)), np.argmax(closeness, axis=1)]
    return out


def nearest_of_modes(
    R_predicted: Float[np.ndarray, "n 3 3"], modes: OrientationModes, symmetry: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3 3"]:
    """The equivalent, over all modes of each observed orientation, that is closest to the predicted one."""
    n, count = modes.log_weight.shape
    turned = nearest_mode_rotation(np.repeat(R_predicted, count, axis=0), modes.R.reshape(-1, 3, 3), np.repeat(symmetry, count))
    closeness = np.einsum("nij,nkij->nk", R_predicted, turned.reshape(n, count, 3, 3))
    best = np.argmax(np.where(np.isfinite(modes.log_weight), closeness, -np.inf), axis=1)
    return turned.reshape(n, count, 3, 3)[np.arange(n), best]


def _turned(
    predicted: np.ndarray, observed: np.ndarray, scale: np.ndarray, order: int, config: SlamConfig
) -> tuple[np.ndarray, np.ndarray]:
    """All turns [r, g, 3, 3] of observed rotations of one symmetry order, and their log densities [r, g], weights included.

    Each is normal in the angle, normalised over SO(3); a free axis is integrated out (its angle is uniform).
    """
    if order == 0:
        aligned = observed @ so3_exp(_free_alignment(predicted, observed)[:, None] * _Z)
        tilt = so3_log(np.swapaxes(predicted, 1, 2) @ aligned)[:, :2]
        log_density = -0.5 * np.sum(tilt**2, axis=1) / scale**2 - angle_log_normaliser(scale, 2) - np.log(2 * np.pi)
        return aligned[:, None], log_density[:, None]
    turns = vertical_turns(order)
    rotations = observed[:, None] @ turns[None]
    error = rotation_angle(np.swapaxes(predicted, 1, 2)[:, None] @ rotations)
    s = scale[:, None]
    with np.errstate(divide="ignore"):
        log_share = np.log(turn_shares(order, len(turns), config))
    return rotations, log_share - 0.5 * error**2 / s**2 - angle_log_normaliser(scale)[:, None]


def orientation_log_density(
    R_predicted: Float[np.ndarray, "n 3 3"],
    R_observed: Float[np.ndarray, "n 3 3"],
    scale: Float[np.ndarray, " n"],
    symmetry: Int[np.ndarray, " n"],
    config: SlamConfig,
) -> Float[np.ndarray, " n"]:
    """Log density of observed rotations of one mode: a mixture over symmetry, half turns and a uniform part, rad^-3."""
    out = np.full(len(R_predicted), -np.inf)
    outlier = np.log(config.orientation_outlier) + UNIFORM_LOG_DENSITY
    for order in np.unique(symmetry):
        rows = np.flatnonzero(symmetry == order)
        _, log_modes = _turned(R_predicted[rows], R_observed[rows], scale[rows], int(order), config)
        out[rows] = np.logaddexp(np.log1p(-config.orientation_outlier) + np.logaddexp.reduce(log_modes, axis=1), outlier)
    return out


def mixture_log_density(
    R_predicted: Float[np.ndarray, "n 3 3"], modes: OrientationModes, symmetry: Int[np.ndarray, " n"], config: SlamConfig
) -> Float[np.ndarray, " n"]:
    """Log density of observed orientations with all their modes, rad^-3."""
    n, count = modes.log_weight.shape
    by_mode = orientation_log_density(
        np.repeat(R_predicted, count, axis=0), modes.R.reshape(-1, 3, 3), modes.scale.ravel(), np.repeat(symmetry, count), config
    ).reshape(n, count)
    return np.logaddexp.reduce(modes.log_weight + by_mode, axis=1)


@dataclass(frozen=True)
class ResolvedModes:
    """What an observed orientation says given a prediction: a weighted list of rotations."""

    row: Int[np.ndarray, " g"]
    """Detection of each."""
    R: Float[np.ndarray, "g 3 3"]
    """Rotation, turned as the symmetry allows; the predicted one for the uninformative part."""
    scale: Float[np.ndarray, " g"]
    """Standard deviation of each angle, rad; infinite for the uninformative part."""
    responsibility: Float[np.ndarray, " g"]
    """Share of each, summing to one over a detection."""


def resolve_modes(
    R_predicted: Float[np.ndarray, "n 3 3"],
    modes: OrientationModes,
    symmetry: Int[np.ndarray, " n"],
    config: SlamConfig,
    *,
    minimum: float = 1e-3,
) -> ResolvedModes:
    """Responsibilities of all modes, turns and the uninformative part; one with `SURE_MODE` stands alone.

    Parts below `minimum` are left out and their share goes to the rest.
    """
    n, count = modes.log_weight.shape
    row, rotation, scale, log_joint = (
        [np.arange(n)],
        [R_predicted],
        [np.full(n, np.inf)],
        [np.full(n, np.log(config.orientation_outlier) + UNIFORM_LOG_DENSITY)],
    )
    for order in np.unique(symmetry):
        rows = np.flatnonzero(symmetry == order)
        repeated = np.repeat(rows, count)
        R, value = _turned(R_predicted[repeated], modes.R[rows].reshape(-1, 3, 3), modes.scale[rows].ravel(), int(order), config)
        turns = R.shape[1]
        row.append(np.repeat(repeated, turns))
        rotation.append(R.reshape(-1, 3, 3))
        scale.append(np.repeat(modes.scale[rows].ravel(), turns))
        log_joint.append((value + modes.log_weight[rows].reshape(-1, 1)).ravel() + np.log1p(-config.orientation_outlier))
    rows, value = np.concatenate(row), np.concatenate(log_joint)
    total = np.full(n, -np.inf)
    np.logaddexp.at(total, rows, value)
    share = np.exp(value - total[rows])
    sure = np.zeros(n)
    np.maximum.at(sure, rows, share)
    keep = np.where(sure[rows] >= SURE_MODE, share >= SURE_MODE, share >= minimum)
    rows, share = rows[keep], share[keep]
    share = share / np.bincount(rows, weights=share, minlength=n)[rows]
    return ResolvedModes(rows, np.concatenate(rotation)[keep], np.concatenate(scale)[keep], share)
