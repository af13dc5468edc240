"""Laying one trajectory onto another (Umeyama 1991), and the plane that a path runs in."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import inverse

Alignment = Literal["none", "origin", "se3", "sim3", "pose"]
"""`se3` and `sim3` lay positions on positions (Umeyama); `pose` is `se3` in which the cameras' orientations, with little
weight, decide what positions leave open: the turn about a straight road."""
LEVER = 0.1
"""Length of the arms that stand for an orientation in the alignment `pose`, in root mean square extents of the path: a
hundredth of the positions' weight."""


def umeyama(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"], with_scale: bool = False
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"], float]:
    """Rotation, translation and scale with `target ~ scale * R source + t` in least squares (Umeyama 1991, eq. 38-42).

    Points on a line or in one place leave rotations free: one of the best is returned, always a proper rotation.
    """
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    centred_source, centred_target = source - mean_source, target - mean_target
    covariance = centred_target.T @ centred_source / len(source)  # eq. 38
    U, singular, Vt = np.linalg.svd(covariance)
    sign = np.ones(3)
    if np.linalg.det(U) * np.linalg.det(Vt) < 0:
        sign[2] = -1.0  # eq. 43: no reflection
    R = U @ np.diag(sign) @ Vt  # eq. 40
    variance = np.mean(np.sum(centred_source**2, axis=1))
    scale = float(singular @ sign / variance) if with_scale and variance > 0 else 1.0  # eq. 42
    return R, mean_target - scale * R @ mean_source, scale  # eq. 41


def pose_alignment(
    T_source: Float[np.ndarray, "n 4 4"], T_target: Float[np.ndarray, "n 4 4"]
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]]:
    """Rotation and translation that lay poses on poses: positions, and the ends of short arms along the cameras' axes.

    Positions alone leave the turn about a straight road open, which moves landmarks beside the road and turns every
    camera; the arms settle it. They are `LEVER` of the path's extent long, so that they hardly weigh where positions say
    something; a path of one place is aligned by orientation.
    """
    source = T_source[:, :3, 3]
    extent = float(np.sqrt(np.mean(np.sum((source - source.mean(axis=0)) ** 2, axis=1))))
    arm = LEVER * extent if extent > 0 else 1.0
    ends = [
        np.concatenate([T[:, :3, 3], *(T[:, :3, 3] + sign * arm * T[:, :3, k] for k in range(3) for sign in (-1, 1))])
        for T in (T_source, T_target)
    ]
    R, t, _ = umeyama(ends[0], ends[1])
    return R, t


def known_rows(T: Float[np.ndarray, "n 4 4"]) -> Bool[np.ndarray, " n"]:
    """Rows of a trajectory that hold a pose: rows of nothing but NaN are not known."""
    known: np.ndarray = ~np.isnan(T).all(axis=(1, 2))
    return known


def validated(T_estimate: np.ndarray, T_truth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Both trajectories, and the rows in which both are known."""
    T_estimate, T_truth = np.asarray(T_estimate, dtype=np.float64), np.asarray(T_truth, dtype=np.float64)
    for name, T in (("estimate", T_estimate), ("truth", T_truth)):
        if T.ndim != 3 or T.shape[1:] != (4, 4):
            raise input_error(f"{name} is no trajectory", got=f"shape {T.shape}", expected="[n, 4, 4]")
        if not np.isfinite(T[known_rows(T)]).all():
            raise input_error(f"{name} holds values that are not finite")
    if len(T_estimate) != len(T_truth) or len(T_truth) == 0:
        raise input_error(
            "trajectories do not match row by row",
            got=f"{len(T_estimate)} estimated poses",
            expected=f"{len(T_truth)} as in the truth, at least one",
            do="pass rows of the same instants",
        )
    both = known_rows(T_estimate) & known_rows(T_truth)
    if not both.any():
        raise input_error("no row with both an estimate and a truth", expected="at least one")
    return T_estimate, T_truth, both


def align(
    T_estimate: Float[np.ndarray, "n 4 4"], T_truth: Float[np.ndarray, "n 4 4"], alignment: Alignment = "se3"
) -> Float[np.ndarray, "n 4 4"]:
    """The estimate moved onto the truth: not at all, by its first pose, by a rigid motion, or with scale.

    Rows of nothing but NaN, on either side, are unknown: the others decide.

    Raises:
        InputError: shapes differ, no rows, values not finite, or an unknown alignment.
    """
    T_estimate, T_truth, both = validated(T_estimate, T_truth)
    if alignment == "none":
        return T_estimate
    if alignment == "origin":
        first = int(np.argmax(both))
        aligned: np.ndarray = (T_truth[first] @ inverse(T_estimate[first])) @ T_estimate
        return aligned
    if alignment not in ("se3", "sim3", "pose"):
        raise input_error("unknown alignment", got=alignment, expected="none, origin, se3, sim3 or pose")
    if alignment == "pose":
        R, t = pose_alignment(T_estimate[both], T_truth[both])
        scale = 1.0
    else:
        R, t, scale = umeyama(T_estimate[both, :3, 3], T_truth[both, :3, 3], with_scale=alignment == "sim3")
    aligned = T_estimate.copy()
    aligned[:, :3, :3] = R @ T_estimate[:, :3, :3]
    aligned[:, :3, 3] = scale * T_estimate[:, :3, 3] @ R.T + t
    return aligned


def principal_plane(points: Float[np.ndarray, "n 3"]) -> tuple[int, int]:
    """The two axes along which points spread most: x and z for a car (seen from above)."""
    spread = np.ptp(points, axis=0) if len(points) else np.ones(3)
    first, second = sorted(np.argsort(-spread, kind="stable")[:2].tolist())
    return first, second
