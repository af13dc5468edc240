"""Trajectory errors, absolute and relative. Positions in m, angles in rad."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.alignment import Alignment, align, known_rows, umeyama, validated
from nolbo_ppl.geometry.pose import relative, rotation_angle


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
    T_estimate, T_truth, both = validated(T_estimate, T_truth)
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
        return summarise(np.asarray(rotation_angle(error[:, :3, :3])))
    return summarise(np.linalg.norm(error[:, :3, 3], axis=1))


def path_length(T: Float[np.ndarray, "n 4 4"]) -> float:
    """Length of the way in m, straight across rows that are unknown (nothing but NaN)."""
    return float(np.linalg.norm(np.diff(T[known_rows(T), :3, 3], axis=0), axis=1).sum())


def trajectory_errors(T_estimate: Float[np.ndarray, "n 4 4"], T_truth: Float[np.ndarray, "n 4 4"]) -> dict[str, float]:
    """ATE (aligned by a rigid motion) and RPE over one row, as root mean squares, m and rad, over the rows whose truth is known.

    Without two known rows in succession there is no RPE.
    """
    out = {"ate": absolute_trajectory_error(T_estimate, T_truth).rmse}
    known = known_rows(T_truth)
    if (known[1:] & known[:-1]).any():
        out["rpe_translation"] = relative_pose_error(T_estimate, T_truth).rmse
        out["rpe_rotation"] = relative_pose_error(T_estimate, T_truth, part="rotation").rmse
    return out


__all__ = [
    "ErrorSummary",
    "absolute_trajectory_error",
    "align",
    "known_rows",
    "path_length",
    "relative_pose_error",
    "summarise",
    "trajectory_errors",
    "umeyama",
]
