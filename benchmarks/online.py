"""The online system lap after lap round the same objects: cost of a keyframe, memory, landmarks, and the trajectory.

    python benchmarks/online.py [--laps 6] [--radius 150] [--objects 300] [--seeds 1] [--no-history] [--no-batch] [--every 1]

Prints a row at the end of every lap (or every few) and one of the whole for each seed; `--out` writes them as JSON. Times are CPU
ms of this process, the first keyframe (which calibrates) left out; memory is what the process holds more than before the first
one. `growth` is the mean of a lap over that of the last quarter of the first one, where the ground is still new.
"""

from __future__ import annotations

import json
import resource
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from nolbo_ppl.data.simulate import WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.inference.slam import IncrementalSlam, SlamConfig, SlamProblem, solve
from nolbo_ppl.inference.slam.incremental.keyframes import KeyframeConfig
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error


def ate(T: np.ndarray, truth: np.ndarray) -> float:
    """ATE after alignment, m."""
    return absolute_trajectory_error(T, truth).rmse


Row = dict[str, float]


@dataclass(frozen=True)
class Arguments:
    """The drive."""

    laps: int = 6
    """Laps."""
    radius: float = 150.0
    """m."""
    frames_per_lap: int = 400
    """Keyframes a lap."""
    objects: int = 300
    """Objects beside the road."""
    seeds: int = 1
    """Worlds."""
    seed: int = 0
    """The first one."""
    history: bool = True
    """Keep all detections, for the final map."""
    batch: bool = True
    """Also the final map and the batch, for their errors."""
    every: int = 1
    """Laps between two rows."""
    out: Path | None = None
    """JSON file for the rows."""


def resident() -> float:
    """Memory of this process, MB."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return float(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def drive_laps(arguments: Arguments, seed: int) -> tuple[list[Row], Row]:
    """One world: a row a lap, and one of the whole."""
    rng = np.random.default_rng(seed)
    truth = simulate_circuit(rng, laps=arguments.laps, radius=arguments.radius, frames_per_lap=arguments.frames_per_lap)
    world = WorldConfig(objects=arguments.objects, categories=12, latent_dim=8)
    drive = simulate_sequence(truth, rng, world=world)
    config = SlamConfig(odometry_rotation_scale=0.004, odometry_translation_ratio=0.01)
    table = drive.observations
    order = np.argsort(table.frame, kind="stable")
    bounds = np.searchsorted(table.frame[order], np.arange(len(truth) + 1))
    first = table.select(table.frame < 100)
    slam = IncrementalSlam(config, SlamProblem(drive.odometry[:100], first), keyframes=KeyframeConfig(history=arguments.history))
    rows: list[Row] = []
    latency: list[float] = []
    seen: set[int] = set()
    before = 0.0
    for t, pose in enumerate(drive.odometry):
        part = table.select(order[bounds[t] : bounds[t + 1]])
        seen.update(drive.object_of[order[bounds[t] : bounds[t + 1]]].tolist())
        start = time.process_time()
        info = slam.update(pose, part)
        latency.append(1e3 * (time.process_time() - start))
        if t == 0:
            before = resident()
        lap_number = (t + 1) // arguments.frames_per_lap
        if (t + 1) % arguments.frames_per_lap == 0 and (lap_number == 1 or lap_number % arguments.every == 0):
            lap = np.array(latency[max(t + 1 - arguments.frames_per_lap, 1) :])
            rows.append(
                {
                    "keyframes": t + 1,
                    "mean": float(lap.mean()),
                    "p99": float(np.percentile(lap, 99)),
                    "max": float(lap.max()),
                    "growth": float(lap.mean() / np.mean(latency[3 * arguments.frames_per_lap // 4 : arguments.frames_per_lap])),
                    "memory": resident() - before,
                    "landmarks": info.landmarks,
                    "objects": len(seen - {-1}),
                    "poses": info.keyframes,
                    "factors": len(slam.graph.factors),
                    "ate": ate(slam.graph.trajectory(), truth[: t + 1]),
                }
            )
            print(" ".join(f"{name} {value:.4g}" for name, value in rows[-1].items()), flush=True)
    whole: Row = {
        "seed": seed,
        "landmarks_over_objects": rows[-1]["landmarks"] / rows[-1]["objects"],
        "mean_last_over_first": rows[-1]["mean"] / rows[0]["mean"],
        "p99_last_over_first": rows[-1]["p99"] / rows[0]["p99"],
        "ate_odometry": ate(drive.odometry, truth),
        "ate_running": ate(slam.trajectory(), truth),
    }
    if arguments.batch and arguments.history:
        whole["ate_finish"] = ate(slam.finish().T_world_camera, truth)
        whole["ate_batch"] = ate(solve(SlamProblem(drive.odometry, table), config).T_world_camera, truth)
    print(" ".join(f"{name} {value:.4g}" for name, value in whole.items()), flush=True)
    return rows, whole


def main() -> None:
    """Command line."""
    arguments = tyro.cli(Arguments, description=__doc__)
    report = [
        {"laps": rows, "whole": whole}
        for rows, whole in (drive_laps(arguments, arguments.seed + k) for k in range(arguments.seeds))
    ]
    if arguments.out is not None:
        arguments.out.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
