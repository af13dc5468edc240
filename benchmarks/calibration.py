"""Are the map's probabilities true? Simulated worlds whose truth is known, every stated probability beside what happened.

    OMP_NUM_THREADS=1 python benchmarks/calibration.py [--out calibration.json] [--only weak cluttered] [--worlds 40]

Settings are tuned on seeds below 1000 alone; the table is of seeds from 5000 on. Runs are kept in the JSON file and not
repeated: an interrupted table is taken up where it stopped. Objectness is the exact posterior of a true detection given the
score, so that the baseline is calibrated.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from scipy.stats import beta

from nolbo_ppl.data.simulate import DetectorConfig, SimulatedSequence, WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.evaluation.map_calibration import (
    Cases,
    association_cases,
    background_cases,
    class_cases,
    existence_cases,
    landmark_regions,
    pose_regions,
)
from nolbo_ppl.geometry.pose import make_pose
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, solve
from nolbo_ppl.io.files import read_json, write_json
from nolbo_ppl.io.true_objects import TrueObjects
from nolbo_ppl.metrics.stated_probabilities import log_score, reliability_bins, reliability_gap


@dataclass(frozen=True)
class Kind:
    """A kind of world."""

    world: WorldConfig
    """Objects."""
    detector: DetectorConfig
    """What is seen of them."""
    stated: bool = True
    """Whether scales of detections are stated."""
    persistent: float = 0.0
    """Share of the variance of a true detection's score that is its object's."""


WORLD = WorldConfig(objects=25, categories=6, latent_dim=6)
WEAK = DetectorConfig(objectness=(0.65, 0.4), clutter_rate=0.5, miss_rate=0.2)
KINDS: dict[str, Kind] = {
    "weak": Kind(WORLD, WEAK),
    "cluttered": Kind(WORLD, replace(WEAK, clutter_rate=3.0, miss_rate=0.3)),
    "missed": Kind(WORLD, replace(WEAK, miss_rate=0.6)),
    "identical": Kind(replace(WORLD, categories=1, latent_dim=0), replace(WEAK, rotation_scale=None)),
    "confused": Kind(WORLD, replace(WEAK, confused_objects=0.15)),
    "unstated": Kind(WORLD, WEAK, stated=False),
}


@dataclass(frozen=True)
class Arguments:
    """What to run."""

    out: Path = Path("calibration.json")
    """Runs done so far; taken up when it exists."""
    only: tuple[str, ...] = tuple(KINDS)
    """Kinds of worlds."""
    worlds: int = 40
    """Worlds of each kind."""
    first_seed: int = 5000
    """Seed of the first world."""


def simulate(kind: Kind, seed: int) -> SimulatedSequence:
    """A world of this kind: a lap and a third, so that some objects are seen in two passes; objectness is exact."""
    rng = np.random.default_rng(seed)
    truth = simulate_circuit(rng, laps=2, radius=22.0, frames_per_lap=45)[:60]
    drive = simulate_sequence(truth, rng, world=kind.world, detector=kind.detector, odometry_rotation_scale=0.01)
    table, real = drive.observations, drive.object_of >= 0
    score = np.clip(table.objectness, 1e-6, 1 - 1e-6)
    true, false = (beta(10 * mean, 10 * (1 - mean)).pdf(score) for mean in kind.detector.objectness)
    share = real.mean()
    table = replace(table, objectness=share * true / (share * true + (1 - share) * false))
    if not kind.stated:
        unknown = np.full(len(table), np.nan)
        table = replace(
            table,
            position_covariance=unknown[:, None, None] * np.eye(3),
            rotation_scale=unknown,
            latent_scale=unknown[:, None] * np.ones(table.latent_dim),
        )
    return replace(drive, observations=table)


def case(cases: Cases) -> list[list[float]]:
    """Pairs of a stated probability and what happened, for the file."""
    return [[round(float(p), 6), float(y)] for p, y in zip(*cases)]


def measure(kind: Kind, seed: int) -> dict[str, Any]:
    """All figures of one world."""
    drive = simulate(kind, seed)
    start = time.process_time()
    result = solve(
        SlamProblem(drive.odometry, drive.observations), SlamConfig(odometry_rotation_scale=0.01, odometry_translation_ratio=0.01)
    )
    row: dict[str, Any] = {"seconds": time.process_time() - start}
    of, world = drive.object_of, drive.world
    assert world is not None
    category = tuple(f"c{k}" for k in world.category)
    objects = TrueObjects(of, make_pose(world.rotation, world.position), category, world.latent)
    background, false = background_cases(result, of)
    row["background"] = case((background, false))
    row["log_score"] = log_score(background, false > 0.5)
    row["log_score_objectness"] = log_score(1 - drive.observations.objectness, false > 0.5)
    row["existence"] = case(existence_cases(result, of))
    row["landmarks"] = len(result.landmarks) / max(len(np.unique(of[of >= 0])), 1)
    row["class"] = case(class_cases(result, of, category))
    row["association"] = case(association_cases(result, of))
    row["association_few"] = case(association_cases(result, of, few=True))
    regions = {"pose": pose_regions(result, drive.truth, every=5), **landmark_regions(result, objects, np.eye(4))}
    for name, found in regions.items():
        if len(found.squared):
            row[f"nees_{name.removeprefix('landmark_')}"] = float(found.squared.mean() / found.degrees)
    return row


def interval(rows: list[dict[str, Any]], figure: Callable[[list[dict[str, Any]]], float], resamples: int = 200) -> str:
    """A figure of all worlds and its 95 % interval, worlds resampled."""
    rng = np.random.default_rng(0)
    values = [figure([rows[i] for i in rng.integers(len(rows), size=len(rows))]) for _ in range(resamples)]
    low, high = np.nanquantile(values, [0.025, 0.975])
    return f"{figure(rows):.3f} [{low:.3f}, {high:.3f}]"


def pooled(rows: list[dict[str, Any]], name: str) -> np.ndarray:
    """All cases of some worlds."""
    return np.array([c for row in rows for c in row[name]]).reshape(-1, 2)


def mean_of(name: str) -> Callable[[list[dict[str, Any]]], float]:
    """Mean over worlds."""
    return lambda rows: float(np.mean([row[name] for row in rows if name in row]))


def share(name: str, column: int, low: float = 0.0, high: float = 1.0) -> Callable[[list[dict[str, Any]]], float]:
    """Mean of the stated (0) or happened (1) among cases stated from low to high."""

    def figure(rows: list[dict[str, Any]]) -> float:
        cases = pooled(rows, name)
        cases = cases[(cases[:, 0] >= low) & (cases[:, 0] <= high)]
        return float(cases[:, column].mean()) if len(cases) else float("nan")

    return figure


def table(name: str, rows: list[dict[str, Any]]) -> None:
    """Print the figures of a kind."""
    print(f"\n{name}: {len(rows)} worlds, {np.mean([row['seconds'] for row in rows]):.1f} s each")

    def difference(rows: list[dict[str, Any]]) -> float:
        return mean_of("log_score")(rows) - mean_of("log_score_objectness")(rows)

    print(f"  background, log score         {interval(rows, mean_of('log_score'))}")
    print(f"    less that of objectness     {interval(rows, difference)}")
    for which in ("background", "existence", "class", "association"):
        cases = pooled(rows, which)
        bins = reliability_bins(cases[:, 0], cases[:, 1] > 0.5)
        shown = " ".join(f"{b.stated:.2f}>{b.happened:.2f}({b.count})" for b in bins)
        print(f"  {which}, largest gap {reliability_gap(bins):.3f}: {shown}")
    middle = pooled(rows, "existence")
    middle = middle[(middle[:, 0] > 0.1) & (middle[:, 0] < 0.9)]
    stated, real = (middle[:, 0].mean(), middle[:, 1].mean()) if len(middle) else (np.nan, np.nan)
    print(f"  existence stated 0.1 to 0.9   {len(middle)} landmarks, mean {stated:.2f}, real {real:.2f}")
    for which in ("existence", "class", "association_few"):
        print(f"  {which}, stated / right".ljust(32) + f"{interval(rows, share(which, 0))} / {interval(rows, share(which, 1))}")
    for figure in ("landmarks", "nees_pose", "nees_position", "nees_orientation", "nees_latent"):
        if any(figure in row for row in rows):
            print(f"  {figure}".ljust(32) + interval(rows, mean_of(figure)))


def main(arguments: Arguments) -> None:
    """Run what is missing and print the table."""
    done: dict[str, Any] = read_json(arguments.out) if arguments.out.exists() else {}
    for name in arguments.only:
        for seed in range(arguments.first_seed, arguments.first_seed + arguments.worlds):
            key = f"{name}/{seed}"
            if key not in done:
                done[key] = measure(KINDS[name], seed)
                write_json(arguments.out, done)
        table(name, [done[f"{name}/{s}"] for s in range(arguments.first_seed, arguments.first_seed + arguments.worlds)])


if __name__ == "__main__":
    main(tyro.cli(Arguments))
