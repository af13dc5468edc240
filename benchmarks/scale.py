"""The batch on growing drives: seconds, memory, landmarks and errors, so that what grows faster than the drive is seen.

    python benchmarks/scale.py [--sizes 0.1 0.2 0.4] [--laps 2]

A drive of size 1 has 5 000 keyframes round 3 000 objects and about 100 000 detections. Each size runs in a process of its own:
seconds are those of its processor, memory its peak over what it held before `solve`. `--frame N` instead puts N detections into
each of three frames. `--out` writes the rows as JSON.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from nolbo_ppl.data.simulate import DetectorConfig, WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, solve
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error
from nolbo_ppl.structures.detections import Detections


@dataclass(frozen=True)
class Arguments:
    """Which drives."""

    sizes: tuple[float, ...] = (0.05, 0.1, 0.2)
    """Shares of the full drive."""
    laps: int = 2
    """Laps; the objects stand along one."""
    frame: int = 0
    """Detections of each of three frames, in place of a drive."""
    hypotheses: int = 2
    """Annealed runs at most."""
    seed: int = 0
    """Of the world."""
    out: Path | None = None
    """JSON file for the rows."""
    alone: bool = False
    """Run the first size in this process (what each process of the others is told)."""


def peak() -> float:
    """Most memory this process ever held, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def one(arguments: Arguments) -> dict[str, float]:
    """Solve one drive."""
    rng = np.random.default_rng(arguments.seed)
    config = SlamConfig(odometry_rotation_scale=0.002, odometry_translation_ratio=0.01, hypotheses=arguments.hypotheses)
    if arguments.frame:
        n, frames = arguments.frame, 3
        objects = rng.uniform([-60, -2, 2], [60, 2, 2 + 120], (n, 3))
        position = np.concatenate([objects + 0.1 * rng.standard_normal((n, 3)) for _ in range(frames)])
        table = Detections.from_arrays(
            np.repeat(np.arange(frames), n), position, position_scale=0.1, objectness=np.full(frames * n, 0.9)
        )
        odometry = truth = np.tile(np.eye(4), (frames, 1, 1))
    else:
        size, laps = arguments.sizes[0], arguments.laps
        per_lap = round(5000 * size / laps)
        truth = simulate_circuit(rng, laps=laps, radius=477 * size * 2 / laps, frames_per_lap=per_lap)
        detector = DetectorConfig(maximum_range=40.0)
        drive = simulate_sequence(
            truth,
            rng,
            world=WorldConfig(objects=round(3000 * size), latent_dim=8),
            detector=detector,
            odometry_rotation_scale=0.002,
        )
        odometry, table = drive.odometry, drive.observations
    before, start = peak(), time.process_time()
    result = solve(SlamProblem(odometry, table), config)
    return {
        "detections": len(table),
        "frames": len(odometry),
        "landmarks": len(result.landmarks),
        "seconds": time.process_time() - start,
        "memory": peak() - before,
        "before": before,
        "ate": absolute_trajectory_error(result.T_world_camera, truth).rmse,
        "ate_odometry": absolute_trajectory_error(odometry, truth).rmse,
        **{f"seconds_{name}": value for name, value in result.seconds.items()},
    }


def main() -> None:
    """Command line."""
    arguments = tyro.cli(Arguments, description=__doc__)
    if arguments.alone:
        print(json.dumps(one(arguments)))
        return
    rows = []
    for size in arguments.sizes if not arguments.frame else (1.0,):
        options = ["--sizes", str(size), "--laps", str(arguments.laps), "--hypotheses", str(arguments.hypotheses), "--alone"]
        options += ["--seed", str(arguments.seed), "--frame", str(arguments.frame)]
        done = subprocess.run([sys.executable, __file__, *options], capture_output=True, text=True, check=False)
        if done.returncode:
            print(f"size {size} ends with {done.returncode}: {done.stderr.strip().splitlines()[-1:]}", flush=True)
            continue
        rows.append({"size": size, **json.loads(done.stdout)})
        print(" ".join(f"{name} {value:.4g}" for name, value in rows[-1].items()), flush=True)
    if arguments.out is not None:
        arguments.out.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
