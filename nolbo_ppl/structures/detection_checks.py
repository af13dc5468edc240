"""What a table of detections must satisfy before any inference uses it; the first bad row is named."""

from __future__ import annotations

import numpy as np

from nolbo_ppl.errors import input_error
from nolbo_ppl.structures.detections import Detections

MAX_POSITION = 1e5
"""Positions farther than this from the camera, in m, are refused as malformed."""


def check_table(table: Detections, frames: int) -> None:
    """Refuse what no inference can use: the first bad row is named by its id.

    Raises:
        InputError: frames out of range, values not finite, covariances not positive definite, no rotations, scales not
            positive, objectness outside [0, 1].
    """

    def refuse(bad: np.ndarray, what: str, values: np.ndarray, expected: str) -> None:
        if bad.any():
            row = int(np.argmax(bad))
            raise input_error(f"observation {table.id[row]!r} (row {row}): {what}", got=values[row], expected=expected)

    refuse((table.frame < 0) | (table.frame >= frames), "frame out of range", table.frame, f"0 to {frames - 1}")
    refuse(~np.isfinite(table.position).all(axis=1), "position is not finite", table.position, "3 finite numbers in m")
    refuse(
        np.abs(table.position).max(axis=1, initial=0) > MAX_POSITION,
        "position out of range",
        table.position,
        f"within {MAX_POSITION:g} m",
    )
    given = ~np.isnan(table.position_covariance).all(axis=(1, 2))
    covariance = np.where(given[:, None, None], table.position_covariance, np.eye(3))
    finite = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    refuse(~finite, "position covariance is not finite", covariance, "finite m^2")
    symmetric = np.abs(covariance - np.swapaxes(covariance, 1, 2)).max(axis=(1, 2), initial=0) <= 1e-6 * np.abs(covariance).max(
        axis=(1, 2), initial=0
    )
    refuse(~symmetric, "position covariance is not symmetric", covariance, "a symmetric matrix")
    eigenvalues = np.linalg.eigvalsh(covariance) if len(covariance) else np.ones((0, 3))
    refuse(
        eigenvalues[:, 0] <= 1e-12 * np.maximum(eigenvalues[:, 2], 1e-300),
        "position covariance is not positive definite",
        covariance,
        "positive eigenvalues",
    )
    tails = np.where(np.isnan(table.position_tails), 2.0, table.position_tails)
    bad = np.isnan(table.position_tails).any(axis=1) != np.isnan(table.position_tails).all(axis=1)
    bad |= ~np.isfinite(tails).all(axis=1) | (tails <= 0).any(axis=1)
    refuse(bad, "position_tails are no law", table.position_tails, "degrees of freedom and a factor, above 0")
    shared = np.where(np.isnan(table.position_shared), 0.0, table.position_shared)
    stated = shared.any(axis=(1, 2))
    refuse(np.asarray(~np.isfinite(shared).all(axis=(1, 2))), "shared position covariance is not finite", shared, "finite m^2")
    skewed = np.abs(shared - np.swapaxes(shared, 1, 2)).max(axis=(1, 2), initial=0) > 1e-6 * np.abs(shared).max(
        axis=(1, 2), initial=0
    )
    refuse(skewed, "shared position covariance is not symmetric", shared, "a symmetric matrix")
    rest = np.where(given[:, None, None], covariance - shared, shared)  # without a covariance it is part of one that is estimated
    least = np.minimum(np.linalg.eigvalsh(rest)[:, 0], np.linalg.eigvalsh(shared)[:, 0]) if len(rest) else np.zeros(0)
    refuse(
        stated & (least < -1e-9 * np.abs(covariance).max(axis=(1, 2), initial=0)),
        "shared position covariance is no part of the position covariance",
        shared,
        "eigenvalues of 0 or more, of the rest as well",
    )
    rotation = np.where(table.has_rotation[:, None, None], table.rotation, np.eye(3))
    residual = np.abs(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(3)).max(axis=(1, 2), initial=0)
    refuse(~(residual < 1e-3) | (np.linalg.det(rotation) < 0), "rotation is no rotation", rotation, "orthonormal")
    for name in ("rotation_scale", "latent_scale"):
        scale = getattr(table, name).reshape(len(table), -1 if len(table) else 0)
        bad = ((scale <= 0) | np.isinf(scale)).any(axis=1)
        refuse(bad, f"{name} is not a positive number", scale, "greater than 0")
    weight = table.mode_weight
    refuse(~(np.isfinite(weight) & (weight >= 0)).all(axis=1), "mode_weight is no weight", weight, "0 or more")
    stated = weight.sum(axis=1) > 0
    refuse(stated & ~table.has_rotation, "modes without a rotation", weight, "`rotation`, the best mode, as well")
    turned = table.mode_rotation
    residual = np.abs(np.swapaxes(turned, 2, 3) @ turned - np.eye(3)).max(axis=(1, 2, 3), initial=0)
    mirrored = (np.linalg.det(turned) < 0).any(axis=1)
    refuse(~(residual < 1e-3) | mirrored, "mode_rotation is no rotation", turned, "orthonormal")
    bad = (~(table.mode_std > 0) | np.isinf(table.mode_std)).any(axis=1)
    refuse(bad, "mode_std is not a positive number", table.mode_std, "greater than 0")
    weight = table.latent_mode_weight
    shape = (*weight.shape, table.latent_dim)
    if weight.shape[1] and table.latent_mode.shape != shape:
        raise input_error("latent_mode has the wrong shape", got=table.latent_mode.shape, expected=shape)
    refuse(~(np.isfinite(weight) & (weight >= 0)).all(axis=1), "latent_mode_weight is no weight", weight, "0 or more")
    stated = weight.sum(axis=1) > 0
    refuse(stated & ~table.has_latent, "modes without a latent", weight, "`latent`, the heaviest mode, as well")
    refuse(~np.isfinite(table.latent_mode).all(axis=(1, 2)), "latent_mode is not finite", table.latent_mode, "finite numbers")
    refuse(np.isinf(table.latent).any(axis=1), "latent is not finite", table.latent, "finite numbers")
    refuse(~((table.objectness >= 0) & (table.objectness <= 1)), "objectness is no probability", table.objectness, "0 to 1")
