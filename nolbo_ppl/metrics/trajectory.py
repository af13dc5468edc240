"""Trajectory errors: alignment (Umeyama 1991), absolute and relative errors. Positions in m, angles in rad."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import inverse, relative, rotation_angle

Alignment = Literal["none", "origin", "se3", "sim3", "pose"]
"""`se3` and `sim3` lay positions on positions (Umeyama); `pose` is `se3` in which the cameras' orientations, with little
weight, decide what positions leave open: the turn about a straight road."""
LEVER = 0.1
"""Length of the arms that stand for an orientation in the alignment `pose`, in root mean square extents of the path: a
hundredth of the positions' weight."""


@dataclass(frozen=True)
class ErrorSummary:
    """Statistics of one error over a trajectory."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float
    count: int
    errors: Float[np.ndarray, " n"]

    def as_dict(self) -> dict[str, float]:
        """The numbers without the raw errors, for a summary file."""
        return {k: float(getattr(self, k)) for k in ("rmse", "mean", "median", "std", "min", "max", "count")}


def summarise(errors: Float[np.ndarray, " n"]) -> ErrorSummary:
    """Statistics of non-negative errors."""
    e = np.asarray(errors, dtype=np.float64)
    return ErrorSummary(
        rmse=float(np.sqrt(np.mean(e**2))),
        mean=float(e.mean()),
        median=float(np.median(e)),
        std=float(e.std()),
        min=float(e.min()),
        max=float(e.max()),
        count=len(e),
        errors=e,
    )


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
    return ~np.isnan(T).all(axis=(1, 2))


def _validated(T_estimate: np.ndarray, T_truth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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
    T_estimate, T_truth, both = _validated(T_estimate, T_truth)
    if alignment == "none":
        return T_estimate
    if alignment == "origin":
        first = int(np.argmax(both))
        return (T_truth[first] @ inverse(T_estimate[first])) @ T_estimate
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


def absolute_trajectory_error(
    T_estimate: Float[np.ndarray, "n 4 4"], T_truth: Float[np.ndarray, "n 4 4"], alignment: Alignment = "se3"
) -> ErrorSummary:
    """Distance between estimated and true positions in m after alignment (Sturm et al. 2012; evo's APE, translation
    part).

    Rows in which one of both is unknown (nothing but NaN) are left out; `count` says over how many the error is.

    Raises:
        InputError: shapes differ, no rows, values not finite, or an unknown alignment.
    """
    aligned = align(T_estimate, T_truth, alignment)
    distance = np.linalg.norm(aligned[:, :3, 3] - np.asarray(T_truth)[:, :3, 3], axis=1)
    return summarise(distance[np.isfinite(distance)])


def relative_pose_error(
    T_estimate: Float[np.ndarray, "n 4 4"],
    T_truth: Float[np.ndarray, "n 4 4"],
    delta: int = 1,
    part: Literal["translation", "rotation"] = "translation",
) -> ErrorSummary:
    """Error of the motion over `delta` rows, in m or rad: `(Q_i^-1 Q_i+d)^-1 (P_i^-1 P_i+d)` (Sturm et al. 2012).

    Pairs follow one another without overlap for delta > 1 (0, d, 2d, ...), as evo does by default. Needs no alignment. Pairs
    of which a row is unknown (nothing but NaN) are left out.

    Raises:
        InputError: shapes differ, fewer rows than `delta + 1`, or no pair of known rows.
    """
    T_estimate, T_truth, both = _validated(T_estimate, T_truth)
    if delta < 1 or len(T_truth) <= delta:
        raise input_error("no pair of rows at this distance", got=f"delta {delta}", expected=f"1 to {len(T_truth) - 1}")
    first = np.arange(0, len(T_truth) - delta, delta)
    first = first[both[first] & both[first + delta]]
    if not len(first):
        raise input_error("no pair of known rows at this distance", got=f"delta {delta}")
    motion = relative(T_estimate[first], T_estimate[first + delta])
    motion_true = relative(T_truth[first], T_truth[first + delta])
    error = relative(motion_true, motion)
    if part == "rotation":
        return summarise(rotation_angle(error[:, :3, :3]))
    return summarise(np.linalg.norm(error[:, :3, 3], axis=1))


def path_length(T: Float[np.ndarray, "n 4 4"]) -> float:
    """Length of the way in m, straight across rows that are unknown (nothing but NaN)."""
    return float(np.linalg.norm(np.diff(T[known_rows(T), :3, 3], axis=0), axis=1).sum())
