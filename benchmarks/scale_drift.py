"""Monocular odometry whose scale drifts: error before, after and with true associations, on the same graph with scales.

    OMP_NUM_THREADS=1 python benchmarks/scale_drift.py [--out scale_drift.json] [--worlds 12] [--data ../shared/data]

Simulated circuits of two laps, objects of 20 categories, a log scale that walks 0.01 a step about an unknown unit; and real
monocular odometry of KITTI 06 and 10 with simulated objects. Nothing is stated but `scale_drift`. Seeds from 5000 on; settings
were looked at on seeds below 1000. Runs are kept in the JSON file and not repeated.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from sessions import interval

from nolbo_ppl.data.simulate import (
    DetectorConfig,
    SimulatedSequence,
    WorldConfig,
    simulate_circuit,
    simulate_detections,
    simulate_odometry,
    simulate_world,
)
from nolbo_ppl.geometry.pose import relative
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, solve, solve_with_associations
from nolbo_ppl.io.files import read_json, write_json
from nolbo_ppl.io.trajectories import read_trajectory
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error


@dataclass(frozen=True)
class Arguments:
    """What to run."""

    out: Path = Path("scale_drift.json")
    """Runs done so far; taken up when it exists."""
    worlds: int = 12
    """Simulated worlds."""
    first_seed: int = 5000
    """Seed of the first."""
    data: Path | None = None
    """Folder of real data: also KITTI's monocular odometry."""
    sequences: tuple[str, ...] = ("06", "10")
    """Which of it."""
    every: int = 5
    """Keyframe distance on it, frames."""


def simulated(seed: int) -> SimulatedSequence:
    """A circuit of two laps with 40 objects."""
    rng = np.random.default_rng(seed)
    truth = simulate_circuit(rng, frames_per_lap=60, radius=32.0)
    world = simulate_world(truth, WorldConfig(objects=40), rng)
    odometry = simulate_odometry(
        truth,
        rng,
        rotation_scale=0.006,
        translation_ratio=0.01,
        length_scale=float(np.exp(rng.uniform(-1.5, 1.5))),
        scale_drift=0.01,
    )
    table, source = simulate_detections(truth, world, DetectorConfig(), rng)
    return SimulatedSequence(truth, odometry, table, source, world)


def real(data: Path, sequence: str, every: int) -> SimulatedSequence:
    """Real monocular odometry, simulated objects along the true path."""
    folder = data / "kitti_odometry"
    truth = read_trajectory(folder / "poses" / f"{sequence}.txt").T_world_camera
    odometry = read_trajectory(folder / "odometry_mono" / f"{sequence}.txt").T_world_camera
    rows = np.arange(0, min(len(truth), len(odometry)), every)
    rng = np.random.default_rng(int(sequence))
    world = simulate_world(truth[rows], WorldConfig(objects=200), rng)
    table, source = simulate_detections(truth[rows], world, DetectorConfig(maximum_range=30.0), rng)
    return SimulatedSequence(truth[rows], odometry[rows], table, source, world)


def measure(drive: SimulatedSequence) -> dict[str, float]:
    """Errors aligned by SE(3), and how far the stated scales are from the true ones."""
    problem, config = SlamProblem(drive.odometry, drive.observations), SlamConfig(scale_drift=True)
    start = time.process_time()
    result = solve(problem, config)
    seconds = time.process_time() - start
    oracle = solve_with_associations(problem, drive.object_of, config, result.state.noise)
    before, after, best = (
        absolute_trajectory_error(T, drive.truth).rmse
        for T in (drive.odometry, result.T_world_camera, oracle.estimate.T_world_camera)
    )
    step, given = (np.linalg.norm(relative(T[:-1], T[1:])[:, :3, 3], axis=1) for T in (drive.truth, drive.odometry))
    row = {"before": before, "after": after, "oracle": best, "after/oracle": after / best, "seconds": seconds}
    if result.scale is not None and result.scale_standard_deviation is not None:
        # The truth of a step holds the noise of its translation; sums over 20 steps hold a fifth of it.
        moving = given > 1e-3
        true, stated = (
            np.array([np.sum(x[k : k + 20]) for k in range(0, len(x) - 19, 20)])
            for x in (step * moving, result.scale * given * moving)
        )
        row["scale_error"] = float(np.sqrt(np.mean((stated / np.maximum(true, 1e-9) - 1) ** 2)))
    return row


def main(arguments: Arguments) -> None:
    """Run what is missing and print the table."""
    done: dict[str, Any] = read_json(arguments.out) if arguments.out.exists() else {}
    keys = [f"simulated/{seed}" for seed in range(arguments.first_seed, arguments.first_seed + arguments.worlds)]
    if arguments.data is not None:
        keys += [f"kitti/{sequence}" for sequence in arguments.sequences]
    for key in keys:
        if key not in done:
            kind, name = key.split("/")
            drive = (
                simulated(int(name))
                if kind == "simulated" or arguments.data is None
                else real(arguments.data, name, arguments.every)
            )
            done[key] = measure(drive)
            write_json(arguments.out, done)
        print(key, " ".join(f"{name} {value:.3f}" for name, value in done[key].items()), flush=True)
    rows = [done[key] for key in keys if key.startswith("simulated")]
    if rows:
        for name in ("before", "after", "oracle", "after/oracle", "scale_error"):
            print(f"{name:14s} {interval([row[name] for row in rows])}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
