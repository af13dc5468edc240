"""Viewpoint errors: geodesic angles up to the object's symmetry."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import rotation_angle, so3_exp

ACCURATE = math.pi / 6
"""The error below which a viewpoint counts as right (Acc_pi/6 of PASCAL3D+ and of NOLBO Table 1), rad."""


def rotation_error(
    R_estimate: Float[np.ndarray, "n 3 3"], R_truth: Float[np.ndarray, "n 3 3"], symmetry: Int[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Geodesic angle in rad between orientations, the least over the object's symmetry about its vertical axis.

    `||log(R_estimate' R_truth)||_F / sqrt 2` for order 1 (the error of PASCAL3D+); its minimum over the turns 2 pi j / n
    for order n; for order 0 (a free axis) the minimum over all turns, which is the angle between the vertical axes.

    Raises:
        InputError: shapes do not match or an order is negative.
    """
    R_estimate, R_truth = np.asarray(R_estimate, dtype=np.float64), np.asarray(R_truth, dtype=np.float64)
    symmetry = np.asarray(symmetry)
    n = len(symmetry)
    if R_estimate.shape != (n, 3, 3) or R_truth.shape != (n, 3, 3):
        raise input_error("rotations", got=(R_estimate.shape, R_truth.shape), expected=f"({n}, 3, 3) twice")
    if (symmetry < 0).any():
        raise input_error("order of a symmetry", got=int(symmetry.min()), expected="0 (free axis) or at least 1")
    error = np.empty(n)
    for order in np.unique(symmetry):
        rows = symmetry == order
        relative = np.swapaxes(R_truth[rows], -1, -2) @ R_estimate[rows]
        error[rows] = _axis_angle(relative) if order == 0 else _least_angle(relative, int(order))
    return error


def _axis_angle(relative: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, " n"]:
    """Angle between the vertical axes of two frames, accurate at both ends."""
    across = np.hypot(relative[:, 0, 2], relative[:, 1, 2])
    angle: np.ndarray = np.arctan2(across, relative[:, 2, 2])
    return angle


def _least_angle(relative: Float[np.ndarray, "n 3 3"], order: int) -> Float[np.ndarray, " n"]:
    """Least angle over the group of turns about the vertical axis."""
    turns = so3_exp(np.arange(order)[:, None] * (2 * math.pi / order) * np.array([0.0, 0.0, 1.0]))
    least: np.ndarray = rotation_angle(turns[:, None] @ relative).min(0)
    return least
