"""`nolbo slam`: odometry and observations in, corrected trajectory and map of objects out."""

from __future__ import annotations

import sys
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro

from nolbo_ppl.data.observations import read_observations
from nolbo_ppl.data.trajectories import Trajectory, match_times, read_trajectory
from nolbo_ppl.errors import NolboError, input_error
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, SlamResult, solve
from nolbo_ppl.inference.slam.export import write_result


@dataclass(frozen=True)
class SlamArguments:
    """Correct a drifting trajectory by the objects seen along it, and map them with uncertainty."""

    odometry: Path
    """Odometry: KITTI (12 numbers a row) or TUM (`time x y z qx qy qz qw`), T_world_camera, x right, y down, z forward."""
    observations: Path
    """Observations: JSON Lines, one detection a line (see docs/slam.md)."""
    out: Path
    """Folder for trajectory.txt, landmarks.json, associations.jsonl, summary.json and map.png."""
    odometry_covariance: Path | None = None
    """Covariance of every odometry step: NPZ with `covariance` [n - 1, 6, 6], [rotation rad, translation m] at the later
    camera."""
    truth: Path | None = None
    """True trajectory, for errors before and after: rows of the odometry, or TUM rows matched by time."""
    model: str | None = None
    """Model (a name or a folder) that decodes the landmarks' latents into landmarks_voxels.npz."""
    online: bool = False
    """Run keyframe by keyframe on iSAM2."""
    config: SlamConfig = field(default_factory=SlamConfig)
    """Settings."""


def matched_truth(odometry: Trajectory, path: Path) -> np.ndarray:
    """True poses of the odometry's rows.

    Raises:
        InputError: the rows do not match, by number (KITTI) or time (TUM).
    """
    truth = read_trajectory(path)
    if len(truth) == len(odometry):
        return truth.T_world_camera
    if truth.times is None or odometry.times is None:
        raise input_error("truth does not match the odometry row by row", got=f"{len(truth)} rows",
                          expected=f"{len(odometry)} rows", file=path)
    rows, partner = match_times(odometry.times, truth.times)
    if len(rows) < len(odometry):
        raise input_error(
            "truth lacks times of the odometry",
            got=f"{len(rows)} of {len(odometry)} rows matched within 20 ms",
            file=path,
        )
    return truth.T_world_camera[partner]


def read_covariance(path: Path) -> np.ndarray:
    """Array `covariance` of an NPZ file.

    Raises:
        InputError: no such file, or it holds no such array.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            if "covariance" not in file.files:
                raise input_error("no array `covariance`", got=file.files, file=path)
            return np.asarray(file["covariance"], dtype=np.float64)
    except (OSError, ValueError, zipfile.BadZipFile, AttributeError) as error:
        if isinstance(error, NolboError):
            raise
        raise input_error("odometry covariance cannot be read", got=str(error), expected="an NPZ file with `covariance`",
                          file=path) from None


def run(arguments: SlamArguments) -> tuple[SlamResult, dict[str, object]]:
    """Read, solve, write; returns the result and the summary.

    Raises:
        NolboError: bad input, or a graph that cannot be solved; nothing half-written is left.
    """
    odometry = read_trajectory(arguments.odometry)
    table = read_observations(arguments.observations, frames=len(odometry))
    truth = None if arguments.truth is None else matched_truth(odometry, arguments.truth)
    covariance = None if arguments.odometry_covariance is None else read_covariance(arguments.odometry_covariance)
    problem = SlamProblem(odometry.T_world_camera, table, covariance)
    model = None
    if arguments.model is not None:
        from nolbo_ppl.inference.weights import load

        model = load(arguments.model)  # before the solve: a wrong name should not cost a run
    if arguments.online:
        from nolbo_ppl.inference.slam.online import solve_online

        result = solve_online(problem, arguments.config)
    else:
        result = solve(problem, arguments.config)
    return result, write_result(arguments.out, result, odometry, truth, model=model)


def describe(report: dict[str, object]) -> str:
    """A few lines for the terminal."""
    lines = [f"{report['frames']} frames, {report['observations']} observations, {report['landmarks']} landmarks, "
             f"{report['loop_pairs']} loop pairs"]
    before, after = report.get("before"), report.get("after")
    if isinstance(before, dict) and isinstance(after, dict):
        lines.append(f"ATE {before['ate']:.3f} m -> {after['ate']:.3f} m")
    warnings = report["warnings"]
    lines += [f"warning: {text}" for text in (warnings if isinstance(warnings, list) else [])]
    return "\n".join(lines)


def main(args: list[str] | None = None) -> None:
    """Command line of `nolbo slam`."""
    arguments = tyro.cli(SlamArguments, prog="nolbo slam", args=args)
    _, report = run(arguments)
    sys.stdout.write(describe(report) + f"\nwritten to {arguments.out}\n")


if __name__ == "__main__":
    main()
