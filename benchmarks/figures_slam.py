"""The table of SLAM figures: every scenario with its seeds, mean and worst, beside the least that is asked for.

    python benchmarks/figures_slam.py [--out figures_slam.json] [--only distinct identical tracking ycb poles online] [--seeds 5]

A line a run as it ends, the table at the end. Runs are kept in the JSON file and not repeated: an interrupted table is taken
up where it stopped. The figures of speed are those of `benchmarks/slam.py` and `benchmarks/association.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import tyro

from nolbo_ppl.data.converters import Converted, convert_kitti_poles, convert_kitti_tracking, convert_ycbv_slam
from nolbo_ppl.data.simulate import DetectorConfig, SimulatedSequence, WorldConfig, simulate_sequence
from nolbo_ppl.geometry.pose import inverse, relative, rotation_angle, se3_log
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, SlamResult, solve, solve_incremental, solve_with_associations
from nolbo_ppl.inference.slam.map_files import association_table
from nolbo_ppl.io.files import read_json, write_json
from nolbo_ppl.io.trajectories import read_trajectory
from nolbo_ppl.metrics.association import association_pairs, landmark_to_object, normalised_error_squared
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error, align

KINDS = ("distinct", "identical", "lookalike", "tracking", "ycb", "poles", "online")
LEAST = {
    ("distinct", "after/oracle"): 1.5,
    ("distinct", "precision"): 0.99,
    ("distinct", "recall"): 0.90,
    ("distinct", "nees_pose"): 1.4,
    ("distinct", "nees_landmark"): 1.4,
    ("identical", "after"): 8.0,
    ("lookalike", "after/oracle"): 1.5,
    ("lookalike", "after/before"): 1.05,
    ("lookalike", "precision"): 0.99,
    ("poles", "after/oracle"): 1.5,
    ("tracking", "after/oracle"): 1.5,
    ("tracking", "f1"): 0.90,
    ("ycb", "after/before"): 1.1,
    ("ycb", "object_right"): 0.6,
    ("online", "from_batch"): 0.2,
}
"""What is asked for at least (median of YCB's after/before: 0.85; after/before of every run: 1.1)."""
MORE_IS_BETTER = ("precision", "recall", "f1", "object_right", "object_right_aligned", "objects")
Row = dict[str, float]


@dataclass(frozen=True)
class Arguments:
    """What to run."""

    data: Path = Path("../shared/data")
    """Folder of real data."""
    out: Path = Path("figures_slam.json")
    """Runs done so far; taken up when it exists."""
    only: tuple[str, ...] = KINDS
    """Scenarios."""
    seeds: int = 5
    """Seeds where something is simulated."""
    first_seed: int = 0
    """The first of them (others than the table's for tuning)."""
    every: int = 5
    """Keyframe distance of the drives, frames."""
    sequences: tuple[str, ...] = ()
    """Sequences instead of the scenario's own."""


def ate(T: np.ndarray, truth: np.ndarray, rows: np.ndarray | None = None) -> float:
    """ATE after alignment over the given rows, m."""
    use = slice(None) if rows is None else rows
    return absolute_trajectory_error(T[use], truth[use]).rmse


def make_drive(arguments: Arguments, kind: str, seed: int, sequence: str = "00") -> tuple[SimulatedSequence, SlamConfig]:
    """A path of KITTI with simulated objects, odometry noise giving about 20 to 45 m on 00."""
    path = arguments.data / "kitti_odometry" / "poses" / f"{sequence}.txt"
    truth = read_trajectory(path).T_world_camera[:: arguments.every]
    world = WorldConfig(categories=3, instance_scale=0.0) if kind in ("identical", "lookalike") else WorldConfig()
    rotation = 0.008 * np.sqrt(arguments.every / 5)
    drive = simulate_sequence(
        truth,
        np.random.default_rng(seed),
        world=world,
        odometry_rotation_scale=rotation,
        odometry_translation_ratio=0.01,
        detector=DetectorConfig(maximum_range=30.0),
    )
    return drive, SlamConfig(odometry_rotation_scale=rotation, odometry_translation_ratio=0.01)


def simulated(arguments: Arguments, kind: str, seed: int, sequence: str = "00") -> Row:
    """One simulated drive: errors, loop pairs, consistency."""
    drive, config = make_drive(arguments, kind, seed, sequence)
    assert drive.world is not None
    problem = SlamProblem(drive.odometry, drive.observations)
    result = solve(problem, config)
    oracle = solve_with_associations(problem, drive.object_of, config)
    label = association_table(result).landmark_of
    score = association_pairs(drive.observations.frame, drive.object_of, label, 50)
    covariance = result.pose_covariances()[1:]
    error = se3_log(relative(result.T_world_camera, drive.truth))[1:]
    owner, _ = landmark_to_object(drive.object_of, label, len(result.landmarks))
    known = np.flatnonzero(owner >= 0)
    gap = np.array([result.landmarks[j].T_world_object[:3, 3] - drive.world.position[owner[j]] for j in known])
    spread = np.array([result.landmarks[j].position_covariance for j in known])
    row = errors(drive.odometry, result.T_world_camera, oracle.estimate.T_world_camera, drive.truth, None)
    return row | {
        "precision": score.precision,
        "recall": score.recall,
        "nees_pose": float(normalised_error_squared(error, covariance).mean()),
        "nees_landmark": float(normalised_error_squared(gap, spread).mean()),
        "ambiguous": float(any(text.startswith("ambiguous") for text in result.state.noise.warnings)),
        "seconds": sum(result.seconds.values()),
    }


def errors(odometry: np.ndarray, found: np.ndarray, oracle: np.ndarray, truth: np.ndarray, rows: np.ndarray | None) -> Row:
    """ATE before, after, and with true associations, and their ratios."""
    before, after, best = (ate(T, truth, rows) for T in (odometry, found, oracle))
    return {"before": before, "after": after, "oracle": best, "after/oracle": after / best, "after/before": after / before}


def online(arguments: Arguments, seed: int) -> Row:
    """The online system's end on the drive of `simulated`, and how far it is from the batch's."""
    drive, config = make_drive(arguments, "distinct", seed)
    problem = SlamProblem(drive.odometry, drive.observations)
    after = ate(solve_incremental(problem, config).T_world_camera, drive.truth)
    batch = ate(solve(problem, config).T_world_camera, drive.truth)
    before = ate(drive.odometry, drive.truth)
    return {"before": before, "after": after, "batch": batch, "from_batch": abs(after - batch), "after/before": after / before}


def converted(name: str, data: Converted, gap: int) -> tuple[SlamResult, Row]:
    """One converted drive, with the oracle at the same scales. Objects that move or carry no label do not count."""
    problem = SlamProblem(data.odometry.T_world_camera, data.observations, data.odometry_covariance)
    static = np.array([o is not None and not o.startswith("moving") for o in data.objects])
    objects = np.where(static, np.unique([o or "" for o in data.objects], return_inverse=True)[1], -1)
    result = solve(problem)
    oracle = solve_with_associations(problem, objects, result.state.config, result.state.noise)
    label, frame = association_table(result).landmark_of, data.observations.frame
    labelled = static if name.startswith("tracking") else np.ones(len(static), bool)
    loops = association_pairs(frame[labelled], objects[labelled], label[labelled], gap)
    pairs = association_pairs(frame[static], objects[static], label[static])
    row = errors(problem.odometry, result.T_world_camera, oracle.estimate.T_world_camera, data.truth.T_world_camera, data.trusted)
    return result, row | {
        "precision": loops.precision,
        "recall": loops.recall,
        "f1": pairs.f1,
        "seconds": sum(result.seconds.values()),
    }


def objects_right(result: SlamResult, data: Converted) -> Row:
    """Share of true objects whose most observed landmark is within 5 cm and 10 degrees of truth.

    `object_right`: as the cameras that detected it see it, by the medians over those keyframes of the errors of
    `T_camera_object` (the trajectory's own drift is the other figure). `object_right_aligned`: in the world, after the
    trajectory was aligned to truth. Objects never found count as wrong.
    """
    truth = data.truth.T_world_camera
    correction = align(result.T_world_camera, truth)[0] @ inverse(result.T_world_camera[0])
    label, frame = association_table(result).landmark_of, data.observations.frame
    seen = aligned = 0
    for name, true in data.T_world_object.items():
        rows = np.flatnonzero(np.array([o == name for o in data.objects]) & (label >= 0))
        if not len(rows):
            continue
        best = int(np.bincount(label[rows]).argmax())
        found = result.landmarks[best].T_world_object
        at = frame[rows[label[rows] == best]]
        seen += within(relative(result.T_world_camera[at], found[None]), relative(truth[at], true[None]))
        aligned += within((correction @ found)[None], true[None])
    count = max(len(data.T_world_object), 1)
    return {"object_right": seen / count, "object_right_aligned": aligned / count, "objects": float(len(data.T_world_object))}


def within(found: np.ndarray, true: np.ndarray) -> bool:
    """Whether the median errors of poses [n, 4, 4] are below 5 cm and 10 degrees."""
    distance = np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=1)
    angle = rotation_angle(np.swapaxes(found[:, :3, :3], 1, 2) @ true[:, :3, :3])
    return bool(np.median(distance) < 0.05 and np.median(angle) < np.deg2rad(10))


def ycb(arguments: Arguments, sequence: str, seed: int) -> Row:
    """One sequence of YCB-Video."""
    data = convert_ycbv_slam(arguments.data / "ycbv_slam", sequence, seed=seed)
    result, row = converted("ycb", data, 20)
    return row | objects_right(result, data)


def drive(arguments: Arguments, kind: str, folder: Path, sequence: str, seed: int) -> Row:
    """One real drive: poles of the map, or detections of cars."""
    if kind == "poles":
        return converted(kind, convert_kitti_poles(folder, sequence, every=arguments.every, seed=seed), 50)[1]
    return converted(kind, convert_kitti_tracking(folder, sequence, seed=seed), 50)[1]


def jobs(arguments: Arguments, kind: str) -> Iterator[tuple[str, Callable[[], Row]]]:
    """Names of the runs of a scenario, and what computes them; seeds one after the other over all sequences."""
    folders = {"tracking": arguments.data / "kitti_tracking", "poles": arguments.data / "kitti_odometry"}
    every_sequence = {
        "lookalike": ("10", "06", "00", "08", "02"),
        "poles": ("00", "02", "08"),
        "tracking": ("0001", "0009"),
        "ycb": tuple(sorted(p.stem for p in (arguments.data / "ycbv_slam").glob("*.npz"))),
    }
    for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds):
        if kind in ("distinct", "identical"):
            yield f"{kind} {seed}", partial(simulated, arguments, kind, seed)
        elif kind == "online":
            yield f"online {seed}", partial(online, arguments, seed)
        else:
            for name in arguments.sequences or every_sequence[kind]:
                if kind == "lookalike":
                    yield f"lookalike {name} {seed}", partial(simulated, arguments, kind, seed, name)
                elif kind == "ycb":
                    yield f"ycb {name} {seed}", partial(ycb, arguments, name, seed)
                else:
                    yield f"{kind} {name} {seed}", partial(drive, arguments, kind, folders[kind], name, seed)


def table(done: dict[str, Row]) -> str:
    """The table of all runs in Markdown; poles and tracking also by sequence."""
    groups: dict[str, list[Row]] = {}
    for name, row in done.items():
        words = name.split()
        groups.setdefault(words[0], []).append(row)
        if words[0] in ("poles", "tracking", "lookalike"):
            groups.setdefault(" ".join(words[:2]), []).append(row)
    lines = ["| scenario | figure | mean | median | worst | runs | asked for |", "|---|---|---|---|---|---|---|"]
    for kind in sorted(groups):
        rows = groups[kind]
        for key in rows[0]:
            values = np.array([row[key] for row in rows])
            worst = values.min() if key in MORE_IS_BETTER else values.max()
            figures = f"{values.mean():.3f} | {np.median(values):.3f} | {worst:.3f} | {len(rows)}"
            lines.append(f"| {kind} | {key} | {figures} | {LEAST.get((kind.split()[0], key), '')} |")
    if "ycb" in groups:
        rows = groups["ycb"]
        total = sum(row["objects"] for row in rows)
        for key in ("object_right", "object_right_aligned"):
            share = sum(row[key] * row["objects"] for row in rows) / total
            lines.append(f"| ycb | {key}, of all objects | {share:.3f} | | | {total:.0f} | {LEAST.get(('ycb', key), '')} |")
    ratio = max((row["after/before"], name) for name, row in done.items())
    lines.append(f"| all | after/before | | | {ratio[0]:.3f} ({ratio[1]}) | {len(done)} | 1.1 |")
    return "\n".join(lines)


def main() -> None:
    """Command line."""
    arguments = tyro.cli(Arguments)
    done: dict[str, Row] = read_json(arguments.out) if arguments.out.exists() else {}
    for kind in arguments.only:
        for name, run in jobs(arguments, kind):
            if name in done:
                continue
            done[name] = row = run()
            write_json(arguments.out, done)
            print(name, "  ".join(f"{k} {v:.3f}" for k, v in row.items()), flush=True)
    print("\n" + table(done))


if __name__ == "__main__":
    main()
