"""Covariances of steps joined to those between keyframes, to first order; which frames are keyframes."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import adjoint, inverse, relative, rotation_angle
from nolbo_ppl.odometry.odometry_state import Odometry


def compose_covariance(
    first: Float[np.ndarray, "6 6"], T_b_c: Float[np.ndarray, "4 4"], second: Float[np.ndarray, "6 6"]
) -> Float[np.ndarray, "6 6"]:
    """Covariance of T_a_b T_b_c from that of T_a_b and of T_b_c, errors independent (Barfoot 2017, eq. 7.310).

    `T_ab Exp(x) T_bc Exp(y) = T_ab T_bc Exp(Ad(T_bc^-1) x) Exp(y)`, so the first is carried into the frame of c.
    """
    carry = adjoint(inverse(T_b_c))
    return carry @ first @ carry.T + second


def between(odometry: Odometry, rows: Int[np.ndarray, " m"]) -> Float[np.ndarray, "m-1 6 6"]:
    """Covariance of the motion between successive rows of the odometry, [rotation, translation] in the later camera.

    Raises:
        InputError: rows that are not there or do not increase.
    """
    rows = np.asarray(rows, dtype=np.int64)
    if len(rows) and (rows[0] < 0 or rows[-1] >= len(odometry) or (np.diff(rows) <= 0).any()):
        raise input_error("rows of the odometry", got=rows[:8].tolist(), expected=f"increasing, from 0 to {len(odometry) - 1}")
    T = odometry.T_world_camera
    steps = relative(T[:-1], T[1:])
    result = np.zeros((max(len(rows) - 1, 0), 6, 6))
    for i, (start, end) in enumerate(pairwise(rows)):
        total = odometry.covariance[start]
        for k in range(start + 1, end):
            total = compose_covariance(total, steps[k], odometry.covariance[k])
        result[i] = total
    return result


def keyframes(odometry: Odometry, distance: float, angle: float) -> Int[np.ndarray, " m"]:
    """Rows of frames so far from the last keyframe: the first one, and each that is `distance` m or `angle` rad away.

    Frames that were guessed are passed over for the next measured one, unless none follows within twice the way.

    Raises:
        InputError: a distance or angle that is not positive.
    """
    if not (distance > 0 and angle > 0):
        raise input_error("spacing of keyframes", got=f"{distance} m, {angle} rad", expected="both above 0")
    T = odometry.T_world_camera
    rows = [0]
    for k in range(1, len(T)):
        motion = relative(T[rows[-1]], T[k])
        way = max(float(np.linalg.norm(motion[:3, 3]) / distance), float(rotation_angle(motion[:3, :3])) / angle)
        if way >= (2.0 if odometry.flags[k - 1] else 1.0):
            rows.append(k)
    return np.array(rows, dtype=np.int64)


def at_keyframes(odometry: Odometry, rows: Int[np.ndarray, " m"]) -> Odometry:
    """The odometry at these rows alone: poses, joined covariances and flags, least inliers and matches on the way.

    The world stays that of the first frame of the odometry.

    Raises:
        InputError: rows that are not there or do not increase.
    """
    covariance = between(odometry, rows)
    pieces = [slice(start, end) for start, end in pairwise(rows)]
    return replace(
        odometry,
        T_world_camera=odometry.T_world_camera[rows],
        covariance=covariance,
        matches=np.array([odometry.matches[piece].min() for piece in pieces], dtype=np.int64),
        inliers=np.array([odometry.inliers[piece].min() for piece in pieces], dtype=np.int64),
        flags=np.array([np.bitwise_or.reduce(odometry.flags[piece]) for piece in pieces], dtype=np.uint8),
    )
