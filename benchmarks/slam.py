"""Speed of the object SLAM: batch EM against LM with true associations, growth with the drive, online latency.

    python benchmarks/slam.py --data ../shared/data [--online] [--large]

Prints one JSON object; times are CPU seconds of this process.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from nolbo_ppl.data.simulate import DetectorConfig, SimulatedSequence, simulate_sequence
from nolbo_ppl.inference.slam import IncrementalSlam, SlamConfig, SlamProblem, solve, solve_with_associations
from nolbo_ppl.io.trajectories import read_trajectory


@dataclass(frozen=True)
class Arguments:
    """What to time."""

    data: Path = Path("../shared/data")
    """Folder of real data."""
    large: bool = False
    """Also 4 541 keyframes."""
    online: bool = False
    """Also the online system, on 4 541 keyframes with --large."""
    seed: int = 0
    """Seed of the world."""


def make_drive(data: Path, every: int, seed: int, frames: int | None = None) -> tuple[SimulatedSequence, SlamConfig]:
    """KITTI 00 with 400 objects of 20 categories, cut to its first frames; noise per metre does not depend on `every`."""
    truth = read_trajectory(data / "kitti_odometry" / "poses" / "00.txt").T_world_camera[::every]
    rotation = 0.008 * np.sqrt(every / 5)
    drive = simulate_sequence(
        truth,
        np.random.default_rng(seed),
        odometry_rotation_scale=rotation,
        odometry_translation_ratio=0.01,
        detector=DetectorConfig(maximum_range=30.0),
    )
    early = drive.observations.frame < (frames or len(truth))
    drive = replace(
        drive,
        truth=drive.truth[:frames],
        odometry=drive.odometry[:frames],
        object_of=drive.object_of[early],
        observations=drive.observations.select(early),
    )
    return drive, SlamConfig(odometry_rotation_scale=rotation, odometry_translation_ratio=0.01)


def time_batch(drive: SimulatedSequence, config: SlamConfig) -> dict[str, float]:
    """Batch EM and plain LM with true associations."""
    problem = SlamProblem(drive.odometry, drive.observations)
    start = time.process_time()
    result = solve(problem, config)
    middle = time.process_time()
    solve_with_associations(problem, drive.object_of, config, result.state.noise)
    end = time.process_time()
    return {
        "keyframes": len(problem),
        "observations": len(problem.observations),
        "em": middle - start,
        "oracle": end - middle,
        "ratio": (middle - start) / (end - middle),
    }


def time_online(drive: SimulatedSequence, config: SlamConfig) -> dict[str, float]:
    """Latency of each update in ms."""
    table = drive.observations
    first = table.select(table.frame < 100)
    slam = IncrementalSlam(config, calibration=SlamProblem(drive.odometry[:100], first))
    latency = []
    for t, pose in enumerate(drive.odometry):
        rows = table.select(table.frame == t)
        start = time.process_time()
        slam.update(pose, rows)
        latency.append(1e3 * (time.process_time() - start))
    x = np.array(latency[1:])  # the first update calibrates
    return {
        "mean": float(x.mean()),
        "p99": float(np.percentile(x, 99)),
        "first_500": float(x[:500].mean()),
        "last_500": float(x[-500:].mean()),
        "last_over_first": float(x[-500:].mean() / x[:500].mean()),
    }


def main() -> None:
    """Command line."""
    arguments = tyro.cli(Arguments)
    drive, config = make_drive(arguments.data, 5, arguments.seed)
    time_batch(*make_drive(arguments.data, 5, arguments.seed, frames=60))  # compiles what is compiled
    report: dict[str, object] = {"batch_909": time_batch(drive, config)}
    if arguments.large:
        part = time_batch(*make_drive(arguments.data, 1, arguments.seed, frames=1000))
        whole = time_batch(*make_drive(arguments.data, 1, arguments.seed))
        report["batch_1000"], report["batch_4541"] = part, whole
        report["growth_over_linear"] = whole["em"] / part["em"] / (whole["keyframes"] / part["keyframes"])
    if arguments.online:
        report["online"] = time_online(*(make_drive(arguments.data, 1, arguments.seed) if arguments.large else (drive, config)))
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
