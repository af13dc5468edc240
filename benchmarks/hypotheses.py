"""Which map comes out may not depend on a seed: small worlds of identical objects where drift makes several maps plausible.

    OMP_NUM_THREADS=1 python benchmarks/hypotheses.py [--out hypotheses.json] [--worlds 40] [--seeds 3]

Every world is solved under several seeds of the EM. A world is at fault when errors of its trajectory differ by more than
0.1 m between seeds and no run says `ambiguous`; the truth is missing when none of a run's hypotheses is at the map that the true
associations give. Runs are kept in the JSON file and not repeated. Worlds below seed 1000 are for tuning.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from nolbo_ppl.data.simulate import DetectorConfig, SimulatedSequence, WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, solve, solve_with_associations
from nolbo_ppl.inference.slam.map_evidence import trajectory_distance
from nolbo_ppl.io.files import read_json, write_json
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error

SPREAD = 0.1
"""Errors that differ by more than this between seeds are different answers, m."""
AT_TRUTH = 0.5
"""A hypothesis closer to the trajectory of the true associations than this share of the odometry's distance is that map.

Distances are of trajectories that begin at one pose; what a few frames before the first loop turn, aligning takes off."""
ROTATION, RATIO = 0.02, 0.05
"""Scales of the odometry: rad a step, m per m."""


@dataclass(frozen=True)
class Arguments:
    """What to run."""

    out: Path = Path("hypotheses.json")
    """Runs done so far; taken up when it exists."""
    worlds: int = 40
    """Worlds."""
    first: int = 5000
    """Seed of the first one."""
    seeds: int = 3
    """Seeds of the EM for each world."""


def simulate(seed: int) -> SimulatedSequence:
    """Two laps round 24 objects of one kind, without orientation or latent, one or two seen a frame; loose odometry."""
    random = np.random.default_rng(seed)
    truth = simulate_circuit(random, laps=2, radius=12.0, frames_per_lap=36)
    return simulate_sequence(
        truth,
        random,
        world=WorldConfig(objects=24, categories=1, latent_dim=0, instance_scale=0.0),
        detector=DetectorConfig(maximum_range=12.0, rotation_scale=None, clutter_rate=0.3),
        odometry_rotation_scale=ROTATION,
        odometry_translation_ratio=RATIO,
    )


def measure(world: int, seeds: int) -> dict[str, Any]:
    """All seeds of one world."""
    drive = simulate(world)
    problem = SlamProblem(drive.odometry, drive.observations)
    stated = {"odometry_rotation_scale": ROTATION, "odometry_translation_ratio": RATIO}
    oracle = solve_with_associations(problem, drive.object_of, SlamConfig(**stated)).estimate.T_world_camera
    away = trajectory_distance(problem.odometry, oracle)
    runs = []
    for seed in range(seeds):
        start = time.process_time()
        result = solve(problem, SlamConfig(seed=seed, **stated))
        runs.append(
            {
                "ate": absolute_trajectory_error(result.T_world_camera, drive.truth).rmse,
                "ambiguous": any(text.startswith("ambiguous") for text in result.state.noise.warnings),
                "distances": [trajectory_distance(h.T_world_camera, oracle) for h in result.hypotheses],
                "aligned": [absolute_trajectory_error(h.T_world_camera, oracle).rmse for h in result.hypotheses],
                "weights": [h.weight for h in result.hypotheses],
                "seconds": time.process_time() - start,
            }
        )
    return {
        "runs": runs,
        "odometry": absolute_trajectory_error(problem.odometry, drive.truth).rmse,
        "oracle": absolute_trajectory_error(oracle, drive.truth).rmse,
        "odometry_to_oracle": away,
        "odometry_to_oracle_aligned": absolute_trajectory_error(problem.odometry, oracle).rmse,
    }


def table(rows: list[dict[str, Any]]) -> str:
    """The figures of all worlds."""
    depend = [max(r["ate"] for r in row["runs"]) - min(r["ate"] for r in row["runs"]) > SPREAD for row in rows]
    unsaid = [d and not any(r["ambiguous"] for r in row["runs"]) for d, row in zip(depend, rows)]
    runs = [(row, r) for row in rows for r in row["runs"]]
    missing = [min(r["distances"], default=np.inf) > AT_TRUTH * row["odometry_to_oracle"] for row, r in runs]
    aligned = [min(r["aligned"], default=np.inf) > AT_TRUTH * row["odometry_to_oracle_aligned"] for row, r in runs]
    worse = [r["ate"] > 1.05 * row["odometry"] for row, r in runs]
    right = np.array([r["distances"][0] <= AT_TRUTH * row["odometry_to_oracle"] for row, r in runs])
    stated = np.array([r["weights"][0] for _, r in runs])
    lines = [
        f"worlds {len(rows)}, runs {len(runs)}",
        f"errors depend on the seed by more than {SPREAD} m       {sum(depend)}",
        f"  of these without `ambiguous`                     {sum(unsaid)}",
        f"runs without the true map among the hypotheses     {np.mean(missing):.3f}",
        f"  the same, trajectories aligned first               {np.mean(aligned):.3f}",
        f"weight of the first hypothesis; it is the true map {stated.mean():.3f}; {right.mean():.3f}",
        f"runs that say `ambiguous`                          {np.mean([r['ambiguous'] for _, r in runs]):.3f}",
        f"runs worse than 1.05 x the odometry                {np.mean(worse):.3f}",
        f"after / oracle, median                             {np.median([r['ate'] / row['oracle'] for row, r in runs]):.3f}",
        f"CPU seconds a run                                  {np.mean([r['seconds'] for _, r in runs]):.2f}",
    ]
    return "\n".join(lines)


def main(arguments: Arguments) -> None:
    """Run what is missing and print the table."""
    done: dict[str, Any] = read_json(arguments.out) if arguments.out.exists() else {}
    for world in range(arguments.first, arguments.first + arguments.worlds):
        if str(world) not in done:
            done[str(world)] = measure(world, arguments.seeds)
            write_json(arguments.out, done)
    print(table([done[str(w)] for w in range(arguments.first, arguments.first + arguments.worlds)]))


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
