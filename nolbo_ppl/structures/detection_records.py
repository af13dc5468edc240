"""Detections as plain rows: what a line of `observations.jsonl` says, written in one place for tables and for posteriors."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from nolbo_ppl.geometry.pose import matrix_to_quaternion
from nolbo_ppl.structures.detections import Detections

QUATERNION_DIGITS = 8
"""Decimals of a quaternion: 1e-8 rad is far below what any detector knows."""


def to_records(detections: Detections) -> Iterator[dict[str, Any]]:
    """One JSON-able dictionary a row, without the fields that are missing; reading them back gives the same table."""
    quaternion = rounded_quaternion(np.where(detections.has_rotation[:, None, None], detections.rotation, np.eye(3)))
    mode_quaternion = rounded_quaternion(detections.mode_rotation)
    for i in range(len(detections)):
        yield _record(detections, i, quaternion[i], mode_quaternion[i])


def rounded_quaternion(R: Float[np.ndarray, "... 3 3"]) -> Float[np.ndarray, "... 4"]:
    """Quaternions [qx, qy, qz, qw] of rotations as files hold them: rounded, qw at least 0.

    Rounding and normalising take turns until neither changes anything, so that the rotation that is read back is written as
    the same numbers.
    """
    quaternion = np.round(matrix_to_quaternion(R), QUATERNION_DIGITS)
    for _ in range(8):
        again = np.round(quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True), QUATERNION_DIGITS)
        if np.array_equal(again, quaternion):
            break
        quaternion = again
    first = np.take_along_axis(quaternion, np.argmax(quaternion != 0, axis=-1)[..., None], axis=-1)
    half_turn = (quaternion[..., 3:] == 0) & (first < 0)  # q and -q are the same rotation: qw does not tell them apart
    return np.where(half_turn, -quaternion, quaternion) + 0.0


def _record(d: Detections, i: int, quaternion: np.ndarray, mode_quaternion: np.ndarray) -> dict[str, Any]:
    row: dict[str, Any] = {"frame": int(d.frame[i])}
    if d.image[i] is not None:
        row["image"] = d.image[i]
    if np.isfinite(d.time[i]):
        row["time"] = float(d.time[i])
    row["id"] = d.id[i]
    if np.isfinite(d.box[i]).all():
        row["box"] = d.box[i].tolist()
    row["objectness"] = float(d.objectness[i])
    if d.category[i] is not None:
        row["category"] = d.category[i]
    stated = np.flatnonzero(np.isfinite(d.class_posterior[i]))
    if len(stated):
        row["class_posterior"] = {d.class_names[k]: float(d.class_posterior[i, k]) for k in stated}
    row["position"] = d.position[i].tolist()
    covariance = d.position_covariance[i]
    if np.isfinite(covariance).all():
        if np.array_equal(covariance, np.diag(np.diag(covariance))):
            row["position_std"] = np.sqrt(np.diag(covariance)).tolist()
        else:
            row["position_cov"] = covariance.tolist()
    if np.isfinite(d.position_tails[i]).all():
        row["position_tails"] = d.position_tails[i].tolist()
    if np.isfinite(d.position_shared[i]).all():
        row["position_cov_shared"] = d.position_shared[i].tolist()
    if np.isfinite(d.rotation[i]).all():
        row["rotation"] = quaternion.tolist()
    if np.isfinite(d.rotation_scale[i]):
        row["rotation_std"] = float(d.rotation_scale[i])
    used = np.flatnonzero(d.mode_weight[i] > 0)
    if len(used):
        row["rotation_modes"] = [
            {"weight": float(d.mode_weight[i, k]), "rotation": mode_quaternion[k].tolist(), "std": float(d.mode_std[i, k])}
            for k in used
        ]
    if np.isfinite(d.viewpoint[i]).all():
        row["viewpoint"] = d.viewpoint[i].tolist()
    used = np.flatnonzero(np.isfinite(d.azimuth_weight[i]))
    if len(used):
        row["azimuth_modes"] = [
            {
                "weight": float(d.azimuth_weight[i, k]),
                "azimuth": float(d.azimuth[i, k]),
                "concentration": float(d.azimuth_concentration[i, k]),
            }
            for k in used
        ]
    if d.latent_dim and np.isfinite(d.latent[i]).all():
        row["latent"] = d.latent[i].tolist()
        if np.isfinite(d.latent_scale[i]).all():
            row["latent_std"] = d.latent_scale[i].tolist()
        used = np.flatnonzero(d.latent_mode_weight[i] > 0)
        if len(used):
            row["latent_modes"] = [
                {"weight": float(d.latent_mode_weight[i, k]), "latent": d.latent_mode[i, k].tolist()} for k in used
            ]
    if np.isfinite(d.size[i]).all():
        row["size"] = d.size[i].tolist()
    if d.symmetry[i] >= 0:
        row["symmetry"] = int(d.symmetry[i])
    return row


def significant(values: Float[np.ndarray, " ..."], digits: int = 7) -> Float[np.ndarray, " ..."]:
    """Numbers rounded to some significant digits: those of single precision are seven."""
    values = np.asarray(values, dtype=np.float64)
    rounded = [float(f"{value:.{digits - 1}e}") for value in values.ravel().tolist()]
    return np.array(rounded, dtype=np.float64).reshape(values.shape)
