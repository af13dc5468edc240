"""The table of SLAM figures: every scenario with its seeds, mean and worst.

    python benchmarks/figures_slam.py [--only distinct identical poles tracking ycb] [--seeds 5] [--data ../shared/data]

A line a run as it ends, a table at the end.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from nolbo_ppl.data.convert import Converted, convert_kitti_poles, convert_kitti_tracking, convert_ycbv_slam
from nolbo_ppl.data.simulate import DetectorConfig, WorldConfig, simulate_drive
from nolbo_ppl.data.trajectories import read_trajectory
from nolbo_ppl.geometry.pose import relative, rotation_angle, se3_log
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, SlamResult, solve, solve_with_associations
from nolbo_ppl.metrics.association import association_pairs, normalised_error_squared
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error, align

KINDS = ("distinct", "identical", "poles", "tracking", "ycb")


@dataclass(frozen=True)
class Arguments:
    """What to run."""

    data: Path = Path("../shared/data")
    """Folder of real data."""
    only: tuple[str, ...] = KINDS
    """Scenarios."""
    seeds: int = 5
    """Seeds where something is simulated."""
    every: int = 5
    """Keyframe distance of the drives, frames."""
    sequences: tuple[str, ...] = ()
    """Sequences instead of the scenario's own."""


def ate(T: np.ndarray, truth: np.ndarray, rows: np.ndarray | None = None) -> float:
    """ATE after alignment over the given rows, m."""
    use = slice(None) if rows is None else rows
    return absolute_trajectory_error(T[use], truth[use]).rmse


def labels(result: SlamResult) -> np.ndarray:
    """Landmark of each detection, -1 for none."""
    found = result.associations
    out = np.full(len(found.new), -1)
    strong = found.weight > 0.5
    out[found.row[strong]] = found.landmark[strong]
    return out


def majority(truth: np.ndarray, label: np.ndarray, count: int) -> np.ndarray:
    """True object most detections of each landmark are of, -1 for clutter."""
    out = np.full(count, -1)
    for j in range(count):
        mine = truth[(label == j) & (truth >= 0)]
        if len(mine):
            out[j] = np.bincount(mine).argmax()
    return out


def simulated(arguments: Arguments, kind: str) -> Iterator[tuple[str, dict[str, float]]]:
    """KITTI 00 with simulated objects, odometry noise giving about 20 to 45 m."""
    path = arguments.data / "kitti_odometry" / "poses" / "00.txt"
    truth = read_trajectory(path).T_world_camera[:: arguments.every]
    world = WorldConfig() if kind == "distinct" else WorldConfig(categories=3, instance_scale=0.0)
    rotation = 0.008 * np.sqrt(arguments.every / 5)
    config = SlamConfig(odometry_rotation_scale=rotation, odometry_translation_ratio=0.01)
    for seed in range(arguments.seeds):
        drive = simulate_drive(truth, np.random.default_rng(seed), world=world, odometry_rotation_scale=rotation,
                               odometry_translation_ratio=0.01, detector=DetectorConfig(maximum_range=30.0))
        assert drive.world is not None
        problem = SlamProblem(drive.odometry, drive.observations)
        result = solve(problem, config)
        oracle = solve_with_associations(problem, drive.object_of, config)
        label = labels(result)
        score = association_pairs(drive.observations.frame, drive.object_of, label, 50)
        covariance = result.pose_covariances()[1:]
        error = se3_log(relative(result.T_world_camera, truth))[1:]
        owner = majority(drive.object_of, label, len(result.landmarks))
        known = np.flatnonzero(owner >= 0)
        gap = np.array([result.landmarks[j].T_world_object[:3, 3] - drive.world.position[owner[j]] for j in known])
        spread = np.array([result.landmarks[j].position_covariance for j in known])
        before, after = ate(drive.odometry, truth), ate(result.T_world_camera, truth)
        best = ate(oracle.estimate.T_world_camera, truth)
        yield (
            f"{kind} {seed}",
            {
                "before": before,
                "after": after,
                "oracle": best,
                "after/oracle": after / best,
                "after/before": after / before,
                "precision": score.precision,
                "recall": score.recall,
                "nees_pose": float(normalised_error_squared(error, covariance).mean()),
                "nees_landmark": float(normalised_error_squared(gap, spread).mean()),
                "seconds": sum(result.seconds.values()),
            },
        )


def converted(name: str, data: Converted, gap: int) -> tuple[SlamResult, dict[str, float]]:
    """One converted drive, with the oracle at the same scales. Objects that move or carry no label do not count."""
    problem = SlamProblem(data.odometry.T_world_camera, data.observations)
    static = np.array([o is not None and not o.startswith("moving") for o in data.objects])
    objects = np.where(static, np.unique([o or "" for o in data.objects], return_inverse=True)[1], -1)
    result = solve(problem)
    oracle = solve_with_associations(problem, objects, result.state.config, result.state.noise)
    truth, label, frame = data.truth.T_world_camera, labels(result), data.observations.frame
    labelled = static if name.startswith("tracking") else np.ones(len(static), bool)
    loops = association_pairs(frame[labelled], objects[labelled], label[labelled], gap)
    pairs = association_pairs(frame[static], objects[static], label[static])
    before = ate(problem.odometry, truth, data.trusted)
    after = ate(result.T_world_camera, truth, data.trusted)
    best = ate(oracle.estimate.T_world_camera, truth, data.trusted)
    return result, {
        "before": before,
        "after": after,
        "oracle": best,
        "after/oracle": after / best,
        "after/before": after / before,
        "precision": loops.precision,
        "recall": loops.recall,
        "f1": pairs.f1,
        "seconds": sum(result.seconds.values()),
    }


def objects_right(result: SlamResult, data: Converted) -> dict[str, float]:
    """Share of true objects with their most observed landmark within 5 cm and 10 degrees, after alignment."""
    T = align(result.T_world_camera, data.truth.T_world_camera)
    correction = T[0] @ np.linalg.inv(result.T_world_camera[0])
    label = labels(result)
    right = {"object": 0, "position": 0}
    for name, true in data.T_world_object.items():
        mine = label[np.array([o == name for o in data.objects]) & (label >= 0)]
        if not len(mine):
            continue
        found = correction @ result.landmarks[int(np.bincount(mine).argmax())].T_world_object
        near = float(np.linalg.norm(found[:3, 3] - true[:3, 3])) < 0.05
        right["position"] += near
        right["object"] += near and float(rotation_angle(found[:3, :3].T @ true[:3, :3])) < np.deg2rad(10)
    count = max(len(data.T_world_object), 1)
    return {"object_right": right["object"] / count, "object_position_right": right["position"] / count}


def runs(arguments: Arguments, kind: str) -> Iterator[tuple[str, dict[str, float]]]:
    """All runs of one scenario."""
    if kind in ("distinct", "identical"):
        yield from simulated(arguments, kind)
    elif kind == "poles":
        for sequence in arguments.sequences or ("00", "02", "08"):
            for seed in range(arguments.seeds):
                data = convert_kitti_poles(
                    arguments.data / "kitti_odometry", sequence, every=arguments.every, seed=seed
                )
                yield f"poles {sequence} {seed}", converted("poles", data, 50)[1]
    elif kind == "tracking":
        for sequence in arguments.sequences or ("0001", "0009"):
            for seed in range(arguments.seeds):
                data = convert_kitti_tracking(arguments.data / "kitti_tracking", sequence, seed=seed)
                yield f"tracking {sequence} {seed}", converted("tracking", data, 50)[1]
    else:
        folder = arguments.data / "ycbv_slam"
        for sequence in arguments.sequences or tuple(sorted(p.stem for p in folder.glob("*.npz"))):
            data = convert_ycbv_slam(folder, sequence)
            result, row = converted("ycb", data, 20)
            yield f"ycb {sequence}", row | objects_right(result, data)


def main() -> None:
    """Command line."""
    arguments = tyro.cli(Arguments)
    lines = []
    for kind in arguments.only:
        rows = []
        for name, row in runs(arguments, kind):
            rows.append(row)
            print(name, "  ".join(f"{k} {v:.3f}" for k, v in row.items()), flush=True)
        for key in rows[0]:
            values = np.array([row[key] for row in rows])
            worst = (
                values.min()
                if key in ("precision", "recall", "f1", "object_right", "object_position_right")
                else values.max()
            )
            lines.append(
                f"| {kind} | {key} | {values.mean():.3f} | {np.median(values):.3f} | {worst:.3f} | {len(values)} |"
            )
    print("\n| scenario | figure | mean | median | worst | runs |\n|---|---|---|---|---|---|")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
