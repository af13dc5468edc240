"""`nolbo merge`: several drives joined into one map where they share a place, or the answer that they do not.

A drive is a folder with odometry.txt and observations.jsonl, as `nolbo run`, `nolbo simulate` and `nolbo convert` write it;
odometry_covariance.npz and truth.txt beside them are used. How the worlds of the drives lie to each other need not be known.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from nolbo_ppl.errors import input_error
from nolbo_ppl.inference.slam import SessionsResult, SlamConfig, SlamProblem, solve_sessions
from nolbo_ppl.inference.slam.map_files import write_result
from nolbo_ppl.io.files import read_json_object, write_json
from nolbo_ppl.io.observations import read_observations
from nolbo_ppl.io.output_folder import output_folder
from nolbo_ppl.io.trajectories import Trajectory, covariance_beside, read_frame_poses, read_trajectory, write_trajectory
from nolbo_ppl.metrics.trajectory import trajectory_errors
from nolbo_ppl.renamed_options import current_arguments

SESSIONS = "sessions.json"
"""What is said of each drive and of each pair of drives."""


@dataclass(frozen=True)
class MergeConfig:
    """Join the maps of several drives: unknown relative poses, other days, objects that have gone or moved."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of the drives, two or more."""
    out: Path
    """Folder for sessions.json and map_0, map_1, ...: one map where all drives share places."""
    config: SlamConfig = field(default_factory=SlamConfig)
    """Settings of every solve."""


@dataclass(frozen=True)
class Session:
    """One drive as it was read."""

    path: Path
    """Its folder."""
    odometry: Trajectory
    """Its odometry."""
    problem: SlamProblem
    """Odometry and observations."""
    truth: np.ndarray | None
    """True poses, where the folder has them."""


def read_session(path: Path) -> Session:
    """A drive from its folder.

    Raises:
        InputError: no such folder, a file is missing or malformed.
    """
    for name in ("odometry.txt", "observations.jsonl"):
        if not (path / name).is_file():
            raise input_error(
                f"no {name} in the folder of a drive",
                got=str(path),
                expected="odometry.txt and observations.jsonl, as `nolbo run` and `nolbo simulate` write them",
                do="put beside the map of `nolbo slam` what it was made from",
            )
    odometry = read_trajectory(path / "odometry.txt")
    table = read_observations(path / "observations.jsonl", frames=len(odometry))
    truth = None
    if (path / "truth.txt").is_file():
        truth = read_frame_poses(path / "truth.txt", len(odometry), odometry.times, of="the odometry").T_world_camera
    problem = SlamProblem(odometry.T_world_camera, table, covariance_beside(path / "odometry.txt"))
    return Session(path, odometry, problem, truth)


def is_merged(folder: Path) -> bool:
    """Whether a folder holds an older result of this verb."""
    file = folder / SESSIONS
    return file.is_file() and {"sessions", "places", "maps"} <= set(read_json_object(file))


def describe(sessions: Sequence[Session], found: SessionsResult) -> dict[str, Any]:
    """What sessions.json holds."""
    rows = []
    for k, session in enumerate(sessions):
        joint = found.map_of(k)
        place = joint.sessions.index(k)
        row: dict[str, Any] = {
            "run": str(session.path),
            "map": found.maps.index(joint),
            "frames": len(session.problem),
            "T_world_session": joint.T_world_session[place].tolist(),
            "covariance": joint.covariance[place].tolist(),
        }
        if session.truth is not None:
            row["before"] = trajectory_errors(session.problem.odometry, session.truth)
            row["alone"] = trajectory_errors(found.alone[k].T_world_camera, session.truth)
            row["after"] = trajectory_errors(joint.trajectory(k), session.truth)
        rows.append(row)
    places = [
        {
            "sessions": list(pair),
            "objects": len(place.a),
            "log_odds": place.log_odds,
            "margin": place.margin,
            "T_a_b": place.T_a_b.tolist(),
            "covariance": place.covariance.tolist(),
        }
        for pair, place in sorted(found.places.items())
    ]
    return {"sessions": rows, "places": places, "maps": len(found.maps)}


def run(config: MergeConfig) -> tuple[SessionsResult, dict[str, Any]]:
    """Read, solve, write; returns the result and what sessions.json holds.

    Raises:
        NolboError: fewer than two drives, bad input, an output folder that holds something else, or a graph that cannot be
            solved; an older result stays as it was.
    """
    if len(config.runs) < 2:
        raise input_error("drives to join", got=len(config.runs), expected="two or more")
    own = (SESSIONS, *(f"map_{k}" for k in range(max(len(config.runs), 64))))
    with output_folder(config.out, own, is_own=is_merged, inputs=config.runs) as folder:
        sessions = [read_session(path) for path in config.runs]
        found = solve_sessions([session.problem for session in sessions], config.config)
        for number, joint in enumerate(found.maps):
            place = folder / f"map_{number}"
            place.mkdir()
            write_result(place, joint.result, Trajectory(joint.result.state.problem.odometry))
            for k in joint.sessions:
                given = sessions[k].odometry
                write_trajectory(place / f"trajectory_{k}.txt", Trajectory(joint.trajectory(k), given.times, given.format))
        report = describe(sessions, found)
        write_json(folder / SESSIONS, report)
    return found, report


def main(args: Sequence[str] | None = None) -> None:
    """Command line of `nolbo merge`."""
    config = tyro.cli(MergeConfig, prog="nolbo merge", args=current_arguments(MergeConfig, args), description=__doc__)
    found, report = run(config)
    lines = []
    for number, joint in enumerate(found.maps):
        names = ", ".join(str(config.runs[k]) for k in joint.sessions)
        lines.append(f"map_{number}: {len(joint.result.landmarks)} landmarks from {names}")
    for place in report["places"]:
        a, b = place["sessions"]
        lines.append(f"{config.runs[a]} and {config.runs[b]} share {place['objects']} objects ({place['log_odds']:.0f} nats)")
    if len(found.maps) > 1:
        lines.append("no common place" if not report["places"] else "not all drives share a place")
    sys.stdout.write("\n".join(lines) + f"\nwritten to {config.out}\n")


if __name__ == "__main__":
    main()
