"""The gate: a few ratios, each measured against a peer in the same run, compared with those stored in `baseline.json`.

    OMP_NUM_THREADS=1 python benchmarks/gate.py                 # fails (status 1) when a ratio is worse than the stored one
    OMP_NUM_THREADS=1 python benchmarks/gate.py --store         # stores what was measured as the new baseline

Every figure is a ratio of CPU seconds of the library over CPU seconds of a peer on the same input: it carries over between
machines, where seconds do not. Smaller is better. `--tolerance` is what noise may add.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from observation import Settings as ObservationSettings
from observation import compare, observe_ratio, scenes, step_ratio, taught

from nolbo_ppl.data.simulate import SimulatedSequence, WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.inference.association import Associator, association_marginals
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, solve, solve_with_associations
from nolbo_ppl.io.files import read_json, write_json
from nolbo_ppl.models.model_config import PRESETS
from nolbo_ppl.models.observation_model import Nolbo

BASELINE = Path(__file__).with_name("baseline.json")


@dataclass(frozen=True)
class Settings:
    """What to do with what is measured."""

    store: bool = False
    """Write the measured ratios to `baseline.json` instead of comparing with it."""
    tolerance: float = 1.35
    """A ratio may be this many times the stored one: medians of a few pairs move by a quarter on a busy machine."""
    pairs: int = 5
    """Interleaved pairs of each comparison."""


def association_ratio(pairs: int) -> float:
    """Exact marginals of 8 detections and 50 landmarks, over belief propagation on the same problems."""
    random = np.random.default_rng(0)
    problems = [(random.normal(0, 3, (8, 50)), random.normal(0, 1, 8)) for _ in range(20)]

    def all_of(associator: Associator) -> Callable[[], None]:
        def run() -> None:
            for log_likelihood, log_null in problems:
                association_marginals(log_likelihood, log_null, associator=associator)

        return run

    return compare("exact marginals", all_of("exact"), all_of("belief_propagation"), pairs, np.inf).ratio


def sequence(frames: int) -> SimulatedSequence:
    """Laps of a circle among objects: twice the frames are twice the laps."""
    random = np.random.default_rng(1)
    truth = simulate_circuit(random, laps=frames // 100, radius=20.0, frames_per_lap=100)
    return simulate_sequence(truth, random, world=WorldConfig(objects=40, categories=8))


def slam_seconds(drive: SimulatedSequence, hypotheses: int, repeats: int = 3) -> tuple[float, float]:
    """CPU seconds of the batch EM, and of least squares on the true associations with the same noise; medians."""
    problem = SlamProblem(drive.odometry, drive.observations)
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        result = solve(problem, SlamConfig(hypotheses=hypotheses))
        middle = time.process_time()
        solve_with_associations(problem, drive.object_of, noise=result.state.noise)
        seconds.append((middle - start, time.process_time() - middle))
    mine, oracle = np.median(seconds, axis=0).tolist()
    return mine, oracle


def measure(pairs: int) -> dict[str, float]:
    """All ratios by name."""
    batch = taught(Nolbo.from_seed(PRESETS["tiny"](), 0), scenes(16))
    slam_seconds(sequence(100), 1, 1)  # compiles what is compiled
    short, oracle = slam_seconds(sequence(200), 1)
    default, _ = slam_seconds(sequence(200), SlamConfig().hypotheses)
    long, _ = slam_seconds(sequence(400), 1)
    settings = ObservationSettings(batch=16, pairs=pairs)
    return {
        "SVI step over a hand-written torch loop": step_ratio(batch, pairs, half_precision=False).ratio,
        "observe with shapes over the bare networks": observe_ratio(batch, settings, decode=True, half_precision=False)[0].ratio,
        "exact marginals 8x50 over belief propagation": association_ratio(pairs),
        "batch EM, one hypothesis, over least squares with true associations": short / oracle,
        "batch EM, hypotheses by default, over one": default / short,
        "batch EM of twice the drive over twice the time": long / (2 * short),
    }


def worse(measured: dict[str, float], stored: dict[str, float], tolerance: float) -> list[str]:
    """Names of the ratios that are worse than the stored ones by more than the tolerance, or that are not measured."""
    return [name for name, ratio in stored.items() if not measured.get(name, np.inf) <= tolerance * ratio]


def main(settings: Settings) -> int:
    """Measure, compare, print; the exit status."""
    measured = measure(settings.pairs)
    stored = read_json(BASELINE) if BASELINE.is_file() else {}
    for name, ratio in measured.items():
        print(f"{name:<72}{ratio:>8.2f}   stored {stored.get(name, float('nan')):>6.2f}")
    if settings.store:
        write_json(BASELINE, {name: round(ratio, 3) for name, ratio in measured.items()})
        return 0
    failed = worse(measured, stored, settings.tolerance)
    print(json.dumps({"worse": failed}))
    return 1 if failed or not stored else 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Settings, description=__doc__)))
