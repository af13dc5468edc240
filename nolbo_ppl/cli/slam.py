"""`nolbo slam`: odometry and observations in, corrected trajectory and map of objects out."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from nolbo_ppl._moved import renamed
from nolbo_ppl.data.converters.placed_boxes import read_heights
from nolbo_ppl.data.slam_inputs import read_slam_inputs
from nolbo_ppl.evaluation.map_calibration import map_calibration
from nolbo_ppl.inference.slam import EmStepInfo, SlamConfig, SlamProblem, SlamResult, solve
from nolbo_ppl.inference.slam.map_files import RESULT, is_result, write_result
from nolbo_ppl.io.output_folder import output_folder
from nolbo_ppl.io.ros_bags import is_bag
from nolbo_ppl.io.ros_maps import MCAP, write_map_mcap
from nolbo_ppl.io.trajectories import TIME_TOLERANCE, Trajectory, read_covariance, read_frame_poses
from nolbo_ppl.io.trajectory_tables import TableFormat
from nolbo_ppl.io.true_objects import read_true_objects
from nolbo_ppl.progress import progress_bar
from nolbo_ppl.renamed_options import current_arguments


@dataclass(frozen=True)
class SlamRunConfig:
    """Correct a drifting trajectory by the objects seen along it, and map them with uncertainty."""

    odometry: Path
    """Odometry: KITTI (12 numbers a row), 4 x 4 (16), TUM (`time x y z qx qy qz qw`) or EuRoC (CSV, ns, q_w first);
    T_world_camera, x right, y down, z forward."""
    observations: Path
    """Observations: JSON Lines, one detection a line (see docs/slam.md), with positions, or boxes or masks alone; or
    `BAG:/topic` of detections (vision_msgs), whose messages are then the frames."""
    out: Path
    """Folder for trajectory.txt, landmarks.json, associations.jsonl, summary.json and map.png."""
    odometry_covariance: Path | None = None
    """Covariance of every odometry step: NPZ with `covariance` [n - 1, 6, 6], [rotation rad, translation m] at the later
    camera."""
    intrinsics: Path | None = None
    """The camera, for boxes alone: their objects are triangulated by the odometry."""
    heights: Path | None = None
    """JSON: height and standard deviation, m, by category, for boxes alone, of those that are known."""
    minimum_score: float = 0.0
    """Boxes below are left out."""
    truth: Path | None = None
    """True trajectory, for errors before and after: matched by time where both have times, else row by row. Frames without
    truth, and rows of nothing but nan or inf, are left out of the errors."""
    truth_objects: Path | None = None
    """True objects (objects.json of `nolbo simulate` or `nolbo convert`): what the map states is then compared with them, in
    summary.json and the report."""
    odometry_format: TableFormat | None = None
    """Format of the odometry, where it is not to be told from the file."""
    truth_format: TableFormat | None = None
    """Format of the truth, where it is not to be told from the file."""
    truth_interpolation: bool = False
    """Take the truth between two of its rows, at most 1 s apart, instead of the row nearest in time."""
    time_tolerance: float = TIME_TOLERANCE
    """How far, in s, a frame and its true pose may lie apart."""
    model: str | None = None
    """Model (a name or a folder) that decodes the landmarks' latents into landmarks_voxels.npz."""
    mcap: bool = False
    """Also write trajectory and map as map.mcap, for Foxglove and rviz (extra `ros`)."""
    online: bool = False
    """Run keyframe by keyframe on iSAM2."""
    scale_drift: bool = False
    """The odometry is a single camera's: its unit of length is unknown and wanders. The same as `--config.scale-drift`."""
    config: SlamConfig = field(default_factory=SlamConfig)
    """Settings."""


def run(arguments: SlamRunConfig) -> tuple[SlamResult, dict[str, object]]:
    """Read, solve, write; returns the result and the summary.

    Raises:
        NolboError: bad input, an output folder that holds something else, or a graph that cannot be solved; an older result
            stays as it was.
    """
    inputs = (
        arguments.odometry,
        arguments.observations,
        arguments.odometry_covariance,
        arguments.truth,
        arguments.truth_objects,
        arguments.intrinsics,
        arguments.heights,
    )
    with output_folder(arguments.out, RESULT, is_own=is_result, inputs=inputs) as folder:
        return _solve(arguments, folder)


def _solve(arguments: SlamRunConfig, folder: Path) -> tuple[SlamResult, dict[str, object]]:
    given = read_slam_inputs(
        arguments.odometry,
        arguments.observations,
        form=arguments.odometry_format,
        intrinsics=arguments.intrinsics,
        heights=None if arguments.heights is None else read_heights(arguments.heights),
        minimum_score=arguments.minimum_score,
        causal=arguments.online,
    )
    odometry, table, remarks, truth = given.odometry, given.detections, list(given.remarks), None
    if arguments.truth is not None:
        found = read_frame_poses(
            arguments.truth,
            len(odometry),
            odometry.times,
            form=arguments.truth_format,
            tolerance=arguments.time_tolerance,
            interpolate=arguments.truth_interpolation or is_bag(arguments.truth),
            of="the odometry",
        )
        truth = found.T_world_camera
        remarks += found.remarks()
    covariance = None if arguments.odometry_covariance is None else read_covariance(arguments.odometry_covariance)
    problem = SlamProblem(odometry.T_world_camera, table, covariance)
    objects = None if arguments.truth_objects is None else read_true_objects(arguments.truth_objects, table.id)
    model = None
    if arguments.model is not None:
        from nolbo_ppl.inference.posterior.model_folder import load

        model = load(arguments.model)  # before the solve: a wrong name should not cost a run
    config = replace(arguments.config, scale_drift=True) if arguments.scale_drift else arguments.config
    if arguments.online:
        from nolbo_ppl.inference.slam.incremental.incremental_slam import solve_incremental

        result = solve_incremental(problem, config)
    else:
        with progress_bar(None, "closing loops", "iteration", leave=False) as bar:
            result = solve(problem, config, lambda state, info: _note(bar, info))
    from nolbo_ppl.viz.map_plots import draw_slam_result

    stated = None if truth is None and objects is None else map_calibration(result, truth, objects)
    report = write_result(folder, result, odometry, truth, model=model, calibration=stated)
    draw_slam_result(folder / "map.png", odometry.T_world_camera, result, truth)
    if arguments.mcap:
        corrected = Trajectory(result.T_world_camera, odometry.times)
        write_map_mcap(folder / MCAP, corrected, result.landmarks, odometry.T_world_camera)
    return result, report | {"remarks": remarks}


def _note(bar: Any, info: EmStepInfo) -> None:
    """One more iteration on the bar."""
    bar.set_postfix(phase=info.phase, links=info.links, refresh=False)
    bar.update()


def describe(report: dict[str, object]) -> str:
    """A few lines for the terminal."""
    lines = [
        f"{report['frames']} frames, {report['observations']} observations, {report['landmarks']} landmarks, "
        f"{report['loop_pairs']} loop pairs"
    ]
    before, after = report.get("before"), report.get("after")
    if isinstance(before, dict) and isinstance(after, dict):
        lines.append(f"ATE {before['ate']:.3f} m -> {after['ate']:.3f} m")
    for kind, name in (("remarks", ""), ("warnings", "warning: ")):
        texts = report.get(kind, [])
        lines += [name + text for text in (texts if isinstance(texts, list) else [])]
    return "\n".join(lines)


def main(args: list[str] | None = None) -> None:
    """Command line of `nolbo slam`."""
    arguments = tyro.cli(SlamRunConfig, prog="nolbo slam", args=current_arguments(SlamRunConfig, args))
    _, report = run(arguments)
    sys.stdout.write(describe(report) + f"\nwritten to {arguments.out}\n")


if __name__ == "__main__":
    main()


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
