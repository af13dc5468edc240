"""Objects whose sizes a detector misjudges: each is seen nearer or farther than it is, by a factor of its own, in all its views.

A single camera tells range by size, so that this is how its ranges err, and covariances that are stated view by view do not say
so. Prints, for each spread of the factors, the error of the trajectory before and after SLAM, how much worse the worst drive
ended than its odometry, and how often the odometry was kept against looser one.

    python benchmarks/misjudged_ranges.py --drives 12
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from nolbo_ppl.data.simulate import WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, solve
from nolbo_ppl.metrics.trajectory import trajectory_errors

STATED = {"odometry_translation_scale": 0.02, "odometry_rotation_scale": 0.004}
"""The odometry's true scales (1 % of a step of 2 m)."""


def errors(seed: int, spread: float, stated: bool, hypotheses: int) -> tuple[float, float, bool]:
    """ATE of odometry and of SLAM, m, and whether the odometry was kept."""
    rng = np.random.default_rng(seed)
    drive = simulate_sequence(simulate_circuit(rng, frames_per_lap=100), rng, world=WorldConfig(objects=40))
    factor = np.exp(rng.normal(0.0, spread, drive.object_of.max() + 2))[drive.object_of]
    seen = replace(drive.observations, position=drive.observations.position * factor[:, None])
    config = SlamConfig(hypotheses=hypotheses, **(STATED if stated else {}))
    result = solve(SlamProblem(drive.odometry, seen), config)
    before, after = (trajectory_errors(T, drive.truth)["ate"] for T in (drive.odometry, result.T_world_camera))
    return before, after, result.state.odometry_kept


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=12, help="drives of each row")
    parser.add_argument("--first", type=int, default=6100, help="seed of the first drive")
    parser.add_argument("--hypotheses", type=int, default=1, help="runs at most")
    args = parser.parse_args()
    print(f"{'spread':>6} {'scales':>8} {'before, m':>10} {'after, m: median [quartiles]':>30} {'worst ratio':>12} {'kept':>6}")
    for spread in (0.0, 0.1, 0.2, 0.3):
        for stated in (False, True):
            rows = [errors(args.first + k, spread, stated, args.hypotheses) for k in range(args.drives)]
            before, after, kept = (np.array(column) for column in zip(*rows))
            low, middle, high = np.percentile(after, [25, 50, 75])
            told = f"{middle:.2f} [{low:.2f}, {high:.2f}]"
            name = "stated" if stated else "unknown"
            print(
                f"{spread:6.1f} {name:>8} {np.median(before):10.2f} {told:>30} {np.max(after / before):12.2f} {kept.mean():6.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
