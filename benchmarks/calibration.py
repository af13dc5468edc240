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
from nolbo_ppl.geometry.pose import relative, se3_log, so3_exp, so3_log
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, SlamResult, solve
from nolbo_ppl.io.files import read_json, write_json

MIN_IN_BIN = 50
"""Bins of reliability with fewer cases are joined to the next."""


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


def object_of_landmarks(result: SlamResult, drive: SimulatedSequence) -> tuple[np.ndarray, np.ndarray]:
    """True object of each landmark (-1: none), the one most of its associations are of; and the share that is real."""
    found, m = result.associations, len(result.state.static)
    objects = len(drive.world.position) if drive.world is not None else 0
    votes = np.zeros((m, objects + 1))
    np.add.at(votes, (found.landmark, drive.object_of[found.row]), found.weight)
    owner = np.argmax(votes, axis=1)
    return np.where(owner == objects, -1, owner), 1 - votes[:, -1] / np.maximum(votes.sum(axis=1), 1e-9)


def case(stated: np.ndarray, happened: np.ndarray) -> list[list[float]]:
    """Pairs of a stated probability and what happened."""
    return [[round(float(p), 6), float(y)] for p, y in zip(stated, happened)]


def log_score(stated: np.ndarray, happened: np.ndarray) -> float:
    """Mean log loss, nats."""
    p = np.clip(stated, 1e-6, 1 - 1e-6)
    return float(-np.mean(np.where(happened, np.log(p), np.log1p(-p))))


def measure(kind: Kind, seed: int) -> dict[str, Any]:
    """All figures of one world."""
    drive = simulate(kind, seed)
    start = time.process_time()
    result = solve(
        SlamProblem(drive.odometry, drive.observations), SlamConfig(odometry_rotation_scale=0.01, odometry_translation_ratio=0.01)
    )
    row: dict[str, Any] = {"seconds": time.process_time() - start}
    found, landmarks = result.associations, result.landmarks
    false = drive.object_of < 0
    owner, real = object_of_landmarks(result, drive)
    row["background"] = case(found.background, false)
    row["log_score"] = log_score(found.background, false)
    row["log_score_objectness"] = log_score(1 - drive.observations.objectness, false)
    row["existence"] = case(np.array([x.existence for x in landmarks]), real > 0.5)
    row["landmarks"] = len(landmarks) / max(len(np.unique(drive.object_of[~false])), 1)
    row["class"] = [
        [
            max(x.class_posterior.values()),
            float(max(x.class_posterior, key=x.class_posterior.__getitem__) == f"c{drive.world.category[o]}"),
        ]
        for x, o in zip(landmarks, owner)
        if o >= 0 and drive.world is not None and x.class_posterior
    ]
    row["association"], row["association_few"] = associations(result, drive)
    row |= calibrated_errors(result, drive, owner)
    return row


def associations(result: SlamResult, drive: SimulatedSequence) -> tuple[list[list[float]], list[list[float]]]:
    """Stated probability of every listed pair and whether the detection's object is that of the landmark's other detections;
    all, and those of landmarks with two or three detections."""
    found = result.associations
    hits = np.bincount(found.landmark, found.weight, minlength=len(result.state.static))
    everything, few = [], []
    for j in range(len(hits)):
        mine = np.flatnonzero(found.landmark == j)
        for p in mine:
            others = mine[mine != p]
            if not len(others):
                continue
            objects, inverse = np.unique(drive.object_of[found.row[others]], return_inverse=True)
            most = objects[np.argmax(np.bincount(inverse, found.weight[others]))]
            pair = [round(float(found.weight[p]), 6), float(most >= 0 and drive.object_of[found.row[p]] == most)]
            everything.append(pair)
            if 1.5 < hits[j] < 3.5 and pair[0] > 0.5:
                few.append(pair)
    return everything, few


def calibrated_errors(result: SlamResult, drive: SimulatedSequence, owner: np.ndarray) -> dict[str, float]:
    """Normalised squared errors a degree of freedom of poses, and of positions, orientations, latents of real landmarks."""
    rows = np.arange(5, len(drive.truth), 5)
    error = se3_log(relative(result.T_world_camera[rows], drive.truth[rows]))
    covariance = result.pose_covariances(rows)
    out = {"nees_pose": float(np.mean(np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)) / 6)}
    position, orientation, latent = [], [], []
    world = drive.world
    assert world is not None
    for x, o in zip(result.landmarks, owner):
        if o < 0:
            continue
        e = x.T_world_object[:3, 3] - world.position[o]
        position.append(e @ np.linalg.solve(x.position_covariance, e) / 3)
        if x.oriented:
            R = x.T_world_object[:3, :3].T @ world.rotation[o]
            turned = [so3_log(R), so3_log(R @ so3_exp(np.array([0.0, 0.0, np.pi])))]
            e = min(turned, key=lambda v: float(v @ v))
            orientation.append(e @ np.linalg.solve(x.covariance[:3, :3], e) / 3)
        if x.latent is not None and x.latent_variance is not None:
            latent.append(float(np.mean((x.latent - world.latent[o]) ** 2 / x.latent_variance)))
    for name, values in (("position", position), ("orientation", orientation), ("latent", latent)):
        if values:
            out[f"nees_{name}"] = float(np.mean(values))
    return out


def reliability_gap(cases: np.ndarray, bins: int = 10) -> tuple[float, list[tuple[float, float, int]]]:
    """Largest distance of the stated mean from the share that happened over bins of `MIN_IN_BIN` cases, and the bins."""
    edges = np.linspace(0, 1, bins + 1)
    which = np.clip(np.searchsorted(edges, cases[:, 0], side="right") - 1, 0, bins - 1)
    table, rest = [], np.zeros((0, 2))
    for b in range(bins):
        rest = np.concatenate([rest, cases[which == b]])
        if len(rest) >= MIN_IN_BIN:
            table.append((float(rest[:, 0].mean()), float(rest[:, 1].mean()), len(rest)))
            rest = np.zeros((0, 2))
    if len(rest) and not table:
        table.append((float(rest[:, 0].mean()), float(rest[:, 1].mean()), len(rest)))
    return max((abs(p - y) for p, y, _ in table), default=float("nan")), table


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
    difference: Callable[[list[dict[str, Any]]], float] = lambda r: mean_of("log_score")(r) - mean_of("log_score_objectness")(r)  # noqa: E731
    print(f"  background, log score         {interval(rows, mean_of('log_score'))}")
    print(f"    less that of objectness     {interval(rows, difference)}")
    for which in ("background", "existence", "class", "association"):
        gap, bins = reliability_gap(pooled(rows, which))
        print(f"  {which}, largest gap {gap:.3f}: " + " ".join(f"{p:.2f}>{y:.2f}({n})" for p, y, n in bins))
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
