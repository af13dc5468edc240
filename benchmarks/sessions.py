"""Two drives, no common frame: are places found, is the relative pose right and its covariance true, is anything joined wrongly?

    OMP_NUM_THREADS=1 python benchmarks/sessions.py [--out sessions.json] [--pairs 20]

`--pairs` pairs of drives that share a stretch of road and as many that share none, on other days: a fifth of the objects of the
first day are gone on the second, a fifth have moved by 3 m or more. Odometry drifts, each drive has a world of its own. Seeds
from 5000 on; settings were looked at on seeds below 1000. Runs are kept in the JSON file and not repeated.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from scipy.stats import beta, chi2

from nolbo_ppl.data.simulate import (
    DetectorConfig,
    SimulatedSequence,
    SimulatedWorld,
    WorldConfig,
    simulate_circuit,
    simulate_detections,
    simulate_odometry,
    simulate_world,
)
from nolbo_ppl.geometry.pose import inverse, relative, rotation_angle, se3_log
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, solve, solve_sessions
from nolbo_ppl.inference.slam.sessions import joined_problem
from nolbo_ppl.io.files import read_json, write_json
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error

CONFIG = SlamConfig(odometry_rotation_scale=0.003, odometry_translation_ratio=0.01, hypotheses=1)
DETECTOR = DetectorConfig(clutter_rate=0.3, miss_rate=0.2)


@dataclass(frozen=True)
class Arguments:
    """What to run."""

    out: Path = Path("sessions.json")
    """Runs done so far; taken up when it exists."""
    pairs: int = 20
    """Pairs with a common place, and as many without."""
    first_seed: int = 5000
    """Seed of the first."""
    seconds: float = float("inf")
    """Begin no further run after this many seconds."""


def another_day(world: SimulatedWorld, rng: np.random.Generator) -> SimulatedWorld:
    """A fifth of the objects gone, a fifth moved by 3 to 6 m."""
    kind = rng.random(len(world.position))
    position = world.position.copy()
    angle, length = rng.uniform(-np.pi, np.pi, len(kind)), rng.uniform(3.0, 6.0, len(kind))
    away = np.stack([length * np.cos(angle), np.zeros(len(kind)), length * np.sin(angle)], axis=1)
    position[kind > 0.8] += away[kind > 0.8]
    stay = np.flatnonzero(kind > 0.2)
    return replace(
        world,
        position=position[stay],
        rotation=world.rotation[stay],
        category=world.category[stay],
        latent=world.latent[stay],
    )


def drive(truth: np.ndarray, world: SimulatedWorld, rng: np.random.Generator) -> SimulatedSequence:
    """A drive along the true path (its truth stays in the common world) in a world of its own."""
    local = inverse(truth[0]) @ truth
    odometry = simulate_odometry(local, rng, rotation_scale=0.003, translation_ratio=0.01)
    table, source = simulate_detections(truth, world, DETECTOR, rng)
    return SimulatedSequence(truth, odometry, table, source, world)


def simulated(seed: int, common: bool) -> tuple[SimulatedSequence, SimulatedSequence]:
    """Two drives of 45 frames on a circle; with a common place they share half of it, else the second world is another one."""
    rng = np.random.default_rng(seed)
    circle = simulate_circuit(rng, laps=2, radius=25.0, frames_per_lap=60)
    first = circle[:45]
    start = int(rng.integers(15, 30))
    second = circle[start : start + 45]
    world = simulate_world(circle[:60], WorldConfig(objects=30, categories=6, latent_dim=6), rng)
    other = (
        another_day(world, rng)
        if common
        else simulate_world(circle[:60], WorldConfig(objects=30, categories=6, latent_dim=6), rng)
    )
    if not common:  # the same kinds of objects: the categories look as they did
        latent = other.latent - other.category_latent[other.category] + world.category_latent[other.category]
        other = replace(other, latent=latent, category_latent=world.category_latent)
    return drive(first, world, rng), drive(second, other, rng)


def ate_of_both(T: list[np.ndarray], truth: list[np.ndarray]) -> float:
    """Error of both trajectories under one alignment, m."""
    return absolute_trajectory_error(np.concatenate(T), np.concatenate(truth)).rmse


def measure(seed: int, common: bool) -> dict[str, float]:
    """One pair."""
    drives = simulated(seed, common)
    problems = [SlamProblem(d.odometry, d.observations) for d in drives]
    start = time.process_time()
    found = solve_sessions(problems, CONFIG)
    row: dict[str, float] = {"common": float(common), "joined": float(len(found.maps) == 1)}
    row["seconds"] = time.process_time() - start
    true = relative(drives[0].truth[0], drives[1].truth[0])  # both worlds begin at their first cameras
    if len(found.maps) == 1:
        joint = found.maps[0]
        error = relative(joint.T_world_session[1], true)
        row["position_error"] = float(np.linalg.norm(error[:3, 3]))
        row["rotation_error"] = float(np.degrees(rotation_angle(error[:3, :3])))
        xi = se3_log(error)
        row["nees"] = float(xi @ np.linalg.solve(joint.covariance[1], xi))
        # At the place itself: cameras of the second drive in the nearest ones of the first, over the stretch both drove.
        # Between the two worlds lies the first drive's own drift besides.
        away = np.linalg.norm(drives[1].truth[:, None, :3, 3] - drives[0].truth[None, :, :3, 3], axis=2)
        rows = np.flatnonzero(away.min(axis=1) < 4.0)
        near = away[rows].argmin(axis=1)
        seen = relative(joint.trajectory(0)[near], joint.trajectory(1)[rows])
        gap = relative(seen, relative(drives[0].truth[near], drives[1].truth[rows]))
        row["place_position_error"] = float(np.median(np.linalg.norm(gap[:, :3, 3], axis=1)))
        row["place_rotation_error"] = float(np.median(np.degrees(rotation_angle(gap[:, :3, :3]))))
        row["log_odds"] = found.places[0, 1].log_odds
        row["wrong"] = float(not common or row["position_error"] > 5.0)
        truth = [d.truth for d in drives]
        row["ate"] = ate_of_both([joint.trajectory(0), joint.trajectory(1)], truth)
        # One run over both, the second begun at its true place: what a single drive would have known.
        single = joined_problem(problems, [np.eye(4), true])
        single = replace(single, odometry_covariance=None)
        row["ate_single"] = ate_of_both([solve(single, CONFIG).T_world_camera], truth)
    return row


def interval(values: list[float]) -> str:
    """Mean and its 95 % interval, runs resampled."""
    rng = np.random.default_rng(0)
    x = np.array(values)
    low, high = np.quantile(x[rng.integers(len(x), size=(2000, len(x)))].mean(axis=1), [0.025, 0.975])
    return f"{x.mean():.3f} [{low:.3f}, {high:.3f}]"


def share(count: int, total: int) -> str:
    """A share with its 95 % interval (Clopper and Pearson)."""
    low = beta.ppf(0.025, count, total - count + 1) if count else 0.0
    high = beta.ppf(0.975, count + 1, total - count) if count < total else 1.0
    return f"{count} of {total} [{low:.3f}, {high:.3f}]"


def main(arguments: Arguments) -> None:
    """Run what is missing and print the table."""
    done: dict[str, Any] = read_json(arguments.out) if arguments.out.exists() else {}
    keys = [f"{kind}/{arguments.first_seed + k}" for k in range(arguments.pairs) for kind in ("common", "apart")]
    start = time.monotonic()
    for key in keys:
        if key not in done and time.monotonic() - start < arguments.seconds:
            kind, seed = key.split("/")
            done[key] = measure(int(seed), kind == "common")
            write_json(arguments.out, done)
            print(key, " ".join(f"{name} {value:.3f}" for name, value in done[key].items()), flush=True)
    rows = [done[key] for key in keys if key in done]
    common = [row for row in rows if row["common"]]
    joined = [row for row in common if row["joined"]]  # wrong ones too: what they state is judged with the rest
    print(f"pairs {len(rows)}, seconds each {np.mean([row['seconds'] for row in rows]):.1f}")
    print("wrong merges          ", share(sum(int(row.get("wrong", 0.0)) for row in rows), len(rows)))
    print("common places found   ", share(sum(not row["wrong"] for row in joined), len(common)))
    if not joined:
        return
    for name in (
        "place_position_error",
        "place_rotation_error",
        "position_error",
        "rotation_error",
        "ate",
        "ate_single",
    ):
        print(f"{name:22s}", interval([row[name] for row in joined]))
    worst = (max(row[name] for row in joined) for name in ("place_position_error", "place_rotation_error"))
    print("worst at the place    ", *(f"{value:.3f}" for value in worst), "m, degrees")
    print("NEES / 6              ", interval([row["nees"] / 6 for row in joined]))
    for level in (0.5, 0.9):
        inside = sum(row["nees"] < chi2.ppf(level, 6) for row in joined)
        print(f"inside the {level:.0%} region ", share(int(inside), len(joined)))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
