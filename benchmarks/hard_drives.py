"""Random hard drives: how many end worse than the odometry, and is it said?

    OMP_NUM_THREADS=1 python benchmarks/hard_drives.py [--drives 60] [--out hard_drives.json] [--list]

Everything about a drive is drawn from its seed: the path, few or many objects, look-alikes, misses, clutter, noise and bias of
odometry and detector, what is stated and whether it is true (`Hardness`). Nothing was tuned on seeds from 7000 on. Drives are
kept in the JSON file and not repeated. A word is `ambiguous`, or any other warning of the result; how many of the good drives
have one is told too, for warnings that always come say nothing.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from nolbo_ppl.data.simulate import DetectorConfig, SimulatedSequence, WorldConfig, simulate_sequence
from nolbo_ppl.data.simulated_paths import circle, figure_of_eight, room, straight
from nolbo_ppl.geometry.pose import chain, relative, se3_exp
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, solve
from nolbo_ppl.io.files import read_json, write_json
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error

WORSE = 1.05
"""A drive ends worse when its error is more than this times the odometry's, ..."""
FLOOR = 0.002
"""... and by more than this, m."""
DETECTORS = ("stated", "unstated", "understated", "overstated")
"""What the detections say of their own noise: the truth, nothing, a third of it, three times it."""


@dataclass(frozen=True)
class Arguments:
    """What to run."""

    out: Path = Path("hard_drives.json")
    """Drives done so far; taken up when it exists."""
    drives: int = 60
    """Drives."""
    first: int = 7000
    """Seed of the first one."""
    list: bool = False
    """Also a line for each drive that ends worse."""


@dataclass(frozen=True)
class Hardness:
    """What is hard about a drive."""

    path: str
    """circle, eight, room or straight."""
    frames: int
    """Keyframes."""
    radius: float
    """Of the path, m."""
    objects: int
    """Objects along it."""
    categories: int
    """1: all of one kind."""
    latent_dim: int
    """0: no latent."""
    look_alikes: bool
    """Objects of a category are identical."""
    oriented: bool
    """Whether orientations are detected."""
    miss_rate: float
    """Share of the objects in view that are missed."""
    clutter_rate: float
    """False detections a frame."""
    confused: float
    """Share of the objects that are taken for another category again and again."""
    position_scale: float
    """Noise of a detected position at range 0, m."""
    position_ratio: float
    """Its growth with range."""
    range_bias: float
    """Factor on all detected positions: a detector that measures too far or too near."""
    rotation_scale: float
    """Noise of an odometry step, rad."""
    translation_ratio: float
    """Noise of an odometry step, m per m."""
    turn_bias: float
    """Constant error of a step, in its noise's standard deviations."""
    length_scale: float
    """Factor on the odometry's lengths."""
    odometry_stated: bool
    """Whether the odometry's scales are stated (without its biases)."""
    detector: str
    """What detections say of their noise (`DETECTORS`)."""


def draw(seed: int) -> Hardness:
    """The hardness of a seed."""
    rng = np.random.default_rng([seed, 1])

    def often(share: float) -> bool:
        return bool(rng.random() < share)

    def between(low: float, high: float) -> float:
        """Uniform in the logarithm."""
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    return Hardness(
        path=str(rng.choice(["circle", "circle", "eight", "room", "straight"])),
        frames=int(rng.integers(50, 91)),
        radius=between(5.0, 30.0),
        objects=round(between(4, 50)),
        categories=int(rng.choice([1, 2, 6])),
        latent_dim=int(rng.choice([0, 4, 8])),
        look_alikes=often(0.4),
        oriented=often(0.6),
        miss_rate=float(rng.uniform(0.15, 0.6)),
        clutter_rate=float(rng.uniform(0.5, 3.0)),
        confused=float(rng.choice([0.0, 0.0, 0.2])),
        position_scale=between(0.03, 0.6),
        position_ratio=between(0.01, 0.1),
        range_bias=1.0 + (0.05 * rng.standard_normal() if often(0.25) else 0.0),
        rotation_scale=between(3e-4, 2e-2),
        translation_ratio=between(2e-3, 5e-2),
        turn_bias=float(rng.standard_normal()) if often(0.3) else 0.0,
        length_scale=1.0 + (0.03 * rng.standard_normal() if often(0.3) else 0.0),
        odometry_stated=often(0.5),
        detector=str(rng.choice(DETECTORS, p=[0.45, 0.3, 0.15, 0.1])),
    )


def simulate(hard: Hardness, seed: int) -> SimulatedSequence:
    """The drive."""
    rng = np.random.default_rng([seed, 2])
    match hard.path:
        case "circle":
            truth = circle(hard.frames, 2, hard.radius)
        case "eight":
            truth = figure_of_eight(hard.frames, 2, hard.radius)
        case "room":
            truth = room(hard.frames, hard.radius, rng)
        case _:
            truth = straight(hard.frames, 4 * hard.radius)
    drive = simulate_sequence(
        truth,
        rng,
        world=WorldConfig(
            objects=hard.objects,
            categories=hard.categories,
            latent_dim=hard.latent_dim,
            instance_scale=0.0 if hard.look_alikes else 1.0,
            lateral=(min(4.0, 0.4 * hard.radius), min(12.0, hard.radius)),
            minimum_spacing=0.8,
        ),
        detector=DetectorConfig(
            maximum_range=min(25.0, 2 * hard.radius),
            miss_rate=hard.miss_rate,
            clutter_rate=hard.clutter_rate,
            position_scale=hard.position_scale,
            position_ratio=hard.position_ratio,
            rotation_scale=0.1 if hard.oriented else None,
            objectness=(0.8, 0.35),
            confused_objects=hard.confused,
        ),
        odometry_rotation_scale=hard.rotation_scale,
        odometry_translation_ratio=hard.translation_ratio,
    )
    steps = relative(drive.odometry[:-1], drive.odometry[1:]).copy()
    steps[:, :3, 3] *= hard.length_scale
    steps = steps @ se3_exp(np.array([0.0, hard.turn_bias * hard.rotation_scale, 0.0, 0.0, 0.0, 0.0]))
    table = drive.observations
    table = replace(table, position=table.position * hard.range_bias)
    if hard.detector == "unstated":
        unknown = np.full(len(table), np.nan)
        table = replace(
            table,
            position_covariance=unknown[:, None, None] * np.eye(3),
            rotation_scale=unknown,
            latent_scale=unknown[:, None] * np.ones(table.latent_dim),
        )
    elif hard.detector != "stated":
        factor = 3.0 if hard.detector == "overstated" else 1 / 3
        table = replace(table, position_covariance=factor**2 * table.position_covariance)
    return replace(drive, odometry=chain(truth[0], steps), observations=table)


def measure(seed: int) -> dict[str, Any]:
    """One drive: errors, words, seconds."""
    hard = draw(seed)
    drive = simulate(hard, seed)
    config = SlamConfig()
    if hard.odometry_stated:
        config = SlamConfig(
            odometry_rotation_scale=hard.rotation_scale, odometry_translation_ratio=max(hard.translation_ratio, 1e-3)
        )
    start = time.process_time()
    result = solve(SlamProblem(drive.odometry, drive.observations), config)
    return {
        "seconds": time.process_time() - start,
        "before": absolute_trajectory_error(drive.odometry, drive.truth).rmse,
        "after": absolute_trajectory_error(result.T_world_camera, drive.truth).rmse,
        "warnings": list(result.state.noise.warnings),
        "landmarks": len(result.landmarks),
        "detections": len(drive.observations),
        "hardness": asdict(hard),
    }


def is_worse(row: dict[str, Any]) -> bool:
    """Whether a drive ends worse than its odometry."""
    return bool(row["after"] > WORSE * row["before"] and row["after"] - row["before"] > FLOOR)


def table(rows: dict[str, dict[str, Any]]) -> str:
    """The figures of all drives."""
    all_rows = list(rows.values())
    worse = [row for row in all_rows if is_worse(row)]
    said = [row for row in worse if row["warnings"]]
    ambiguous = [row for row in worse if any(text.startswith("ambiguous") for text in row["warnings"])]
    good = [row for row in all_rows if not is_worse(row)]
    ratio = np.array([row["after"] / row["before"] for row in all_rows])
    seconds = np.array([row["seconds"] for row in all_rows])
    lines = [
        f"drives                                        {len(all_rows)}",
        f"end worse than {WORSE} x the odometry            {len(worse)}",
        f"  with a word, `ambiguous` among them         {len(said)}, {len(ambiguous)}",
        f"  in silence                                  {len(worse) - len(said)}",
        f"the others that have a word                   {sum(bool(row['warnings']) for row in good)} of {len(good)}",
        f"after / before: median, 90 %, worst           {np.median(ratio):.2f}, {np.quantile(ratio, 0.9):.2f}, {ratio.max():.2f}",
        f"CPU seconds a drive: mean, most               {seconds.mean():.1f}, {seconds.max():.1f}",
    ]
    return "\n".join(lines)


def describe(seed: str, row: dict[str, Any]) -> str:
    """A drive in a line or two."""
    words = "; ".join(text[:110] for text in row["warnings"]) or "IN SILENCE"
    hardness = " ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in row["hardness"].items())
    return f"{seed}: {row['before']:.3f} -> {row['after']:.3f} m, {row['landmarks']} landmarks: {words}\n      {hardness}"


def main(arguments: Arguments) -> None:
    """Run what is missing and print the table."""
    done: dict[str, Any] = read_json(arguments.out) if arguments.out.exists() else {}
    seeds = [str(seed) for seed in range(arguments.first, arguments.first + arguments.drives)]
    for seed in seeds:
        if seed not in done:
            done[seed] = measure(int(seed))
            write_json(arguments.out, done)
    rows = {seed: done[seed] for seed in seeds}
    print(table(rows))
    if arguments.list:
        for seed, row in rows.items():
            if is_worse(row):
                print(describe(seed, row))


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
