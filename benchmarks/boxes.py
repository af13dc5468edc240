"""2D boxes alone: simulated drives with misses, clutter, gross errors and wrong categories; real boxes of a desk.

    python benchmarks/boxes.py [--drives 20] [--data ../shared/data]

Prints one JSON object. ATE is after alignment, m; the oracle is told which box is of which object. Coverage is the share of
landmarks whose true object lies within their own 90 % ellipsoid: in the frame of the first pose, where all landmarks of a drive
share its drift, and in that of a camera that saw them; with the standard error of independent drives. `online` places boxes by
what was seen before and solves keyframe by keyframe. With `--data`, fr2_desk of TUM RGB-D: boxes of a detector, the trajectory of
ORB-SLAM with steps of an odometry's noise added to it, motion capture as truth.
"""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from jaxtyping import Float

from nolbo_ppl.data.converters.foreign_detections import read_foreign_detections
from nolbo_ppl.data.converters.placed_boxes import observations_by_parallax
from nolbo_ppl.data.simulate import WorldConfig, simulate_circuit, simulate_odometry, simulate_world
from nolbo_ppl.data.simulated_boxes import BoxDetectorConfig, simulate_boxes
from nolbo_ppl.geometry.pose import chain, inverse, relative, se3_exp, skew, transform
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, SlamResult, solve, solve_incremental, solve_with_associations
from nolbo_ppl.io.trajectories import match_times, read_trajectory
from nolbo_ppl.metrics.association import landmark_to_object
from nolbo_ppl.metrics.trajectory import trajectory_errors

CHI_SQUARE_90 = 6.251
"""90 % quantile of chi square with three degrees of freedom."""
INTRINSICS_FR2 = np.array([520.9, 521.0, 325.1, 249.7])
"""Camera of fr2, px."""


@dataclass(frozen=True)
class Arguments:
    """What to run."""

    drives: int = 20
    """Simulated drives."""
    data: Path | None = None
    """Folder of real data; without it simulated drives alone."""
    every: int = 10
    """Every so many-th frame of fr2_desk."""
    seed: int = 0
    """First seed."""


def landmark_objects(result: SlamResult, object_of: np.ndarray) -> np.ndarray:
    """True object of each landmark, by weight; -1 for clutter."""
    found = result.associations
    return landmark_to_object(object_of[found.row], found.landmark, len(result.landmarks), found.weight)[0]


def seen_from_near(
    result: SlamResult, of: np.ndarray, position: np.ndarray, T_world_camera: np.ndarray
) -> Float[np.ndarray, " m"]:
    """Squared errors of landmarks of objects in the camera that saw them in the middle of their views, by their covariance there.

    The drift of the map as a whole, which all landmarks of a drive have in common, is not in it.
    """
    out = []
    frame = result.state.problem.observations.frame
    for one in result.landmarks:
        if not one.in_map or of[one.index] < 0:
            continue
        seen = np.sort(frame[result.associations.row[result.associations.landmark == one.index]])
        t = int(seen[len(seen) // 2])
        T, R = inverse(result.T_world_camera[t]), one.T_world_object[:3, :3]
        local = transform(T, one.position)
        gap = local - transform(inverse(T_world_camera[t]), position[of[one.index]])
        joint = result.joint_covariance(np.array([t]), np.array([one.index])).reshape(12, 12)
        H = np.concatenate([skew(local), -np.eye(3), np.zeros((3, 3)), T[:3, :3] @ R], axis=1)
        out.append(gap @ np.linalg.solve(H @ joint @ H.T, gap))
    return np.array(out)


def simulated(seed: int, with_heights: bool, online: bool = False) -> dict[str, Any]:
    """Two laps of 60 frames through 30 objects."""
    rng = np.random.default_rng(seed)
    truth = simulate_circuit(rng, laps=2, frames_per_lap=60, radius=20.0)
    world = simulate_world(truth, WorldConfig(objects=30, categories=6), rng)
    odometry = simulate_odometry(truth, rng, rotation_scale=0.004, translation_ratio=0.01)
    camera = BoxDetectorConfig()
    boxes = simulate_boxes(truth, world, camera, rng)
    found = boxes.detections
    heights = boxes.heights if with_heights else None
    table, left_out = observations_by_parallax(found, odometry, np.array(camera.intrinsics), camera.size, heights, causal=online)
    object_of = boxes.object_of[[int(name[1:]) for name in table.id]]
    problem = SlamProblem(odometry, table)
    result = solve_incremental(problem) if online else solve(problem)
    oracle = solve_with_associations(problem, object_of)
    of, shown = landmark_objects(result, object_of), [one for one in result.landmarks if one.in_map]
    squares = []
    for one in shown:
        if of[one.index] >= 0:
            gap = one.position - world.position[of[one.index]]
            squares.append(float(gap @ np.linalg.solve(one.position_covariance, gap)))
    counts = np.bincount(object_of[object_of >= 0], minlength=len(world.position))
    return {
        "before": trajectory_errors(odometry, truth)["ate"],
        "after": trajectory_errors(result.T_world_camera, truth)["ate"],
        "oracle": trajectory_errors(oracle.estimate.T_world_camera, truth)["ate"],
        "landmarks": len(shown),
        "objects": int((counts >= 2).sum()),
        "mapped": len({int(of[one.index]) for one in shown} - {-1}),
        "of_clutter": sum(int(of[one.index]) < 0 for one in shown),
        "inside": float(np.mean(np.array(squares) < CHI_SQUARE_90)),
        "inside_from_near": float(np.mean(seen_from_near(result, of, world.position, truth) < CHI_SQUARE_90)),
        "boxes": len(found),
        "placed": len(table),
        "left_out": left_out,
    }


def summarised(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Means with standard errors over the drives."""
    out: dict[str, Any] = {}
    ratio = np.array([row["after"] / row["oracle"] for row in rows])
    columns = {
        name: np.array([row[name] for row in rows]) for name in ("before", "after", "oracle", "inside", "inside_from_near")
    }
    columns |= {
        "after_over_oracle": ratio,
        "after_over_before": np.array([row["after"] / row["before"] for row in rows]),
        "landmarks_per_object": np.array([row["landmarks"] / row["objects"] for row in rows]),
        "objects_mapped": np.array([row["mapped"] / row["objects"] for row in rows]),
        "landmarks_of_clutter": np.array([row["of_clutter"] for row in rows]),
    }
    for name, values in columns.items():
        error = float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else float("nan")
        out[name] = {"mean": round(float(values.mean()), 4), "standard_error": round(error, 4)}
    out["after_over_oracle"]["median"] = round(float(np.median(ratio)), 3)
    return out


def desk(data: Path, every: int) -> dict[str, Any]:
    """fr2_desk: boxes alone, no heights."""
    folder = data / "tum"
    path = read_trajectory(folder / "fr2_desk_ORB.txt")
    assert path.times is not None
    images = json.loads((folder / "fr2_desk_detections.json").read_text())
    stamps = np.array([float(image["file_name"].removesuffix(".png")) for image in images])
    rows, partner = match_times(path.times, stamps, 0.01)
    rows, partner = rows[::every], partner[::every]
    found = read_foreign_detections(
        folder / "fr2_desk_detections.json", "oa-slam", images=[image["file_name"] for image in images]
    )
    place = np.full(len(images), -1)
    place[partner] = np.arange(len(partner))
    keep = np.flatnonzero((place[found.frame] >= 0) & (found.score > 0.4))
    part = type(found)(
        place[found.frame[keep]],
        found.box[keep],
        found.score[keep],
        tuple(found.category[k] for k in keep),
        found.position[keep],
        found.rotation[keep],
        found.size[keep],
    )
    poses, at = path.T_world_camera[rows], path.times[rows]
    truth_file = read_trajectory(folder / "fr2_desk_groundtruth.txt", repeated=True)
    assert truth_file.times is not None
    known, row = match_times(at, truth_file.times, 0.02)
    truth = np.full((len(at), 4, 4), np.nan)
    truth[known] = truth_file.T_world_camera[row]
    # ORB-SLAM's length is free: its steps are brought to metres by the truth, then an odometry's noise is added.
    a, b = poses[known, :3, 3], truth[known, :3, 3]
    scale = np.sqrt(((b - b.mean(0)) ** 2).sum() / ((a - a.mean(0)) ** 2).sum())
    poses = poses.copy()
    poses[:, :3, 3] *= scale
    rng = np.random.default_rng(0)
    steps = relative(poses[:-1], poses[1:])
    length = np.linalg.norm(steps[:, :3, 3], axis=1)
    noise = np.concatenate(
        [0.004 * rng.standard_normal((len(steps), 3)), (0.05 * length)[:, None] * rng.standard_normal((len(steps), 3))], axis=1
    )
    out: dict[str, Any] = {"frames": len(poses), "boxes": len(part)}
    for name, odometry in (("orb_slam", poses), ("odometry", chain(poses[0], steps @ se3_exp(noise)))):
        table, left_out = observations_by_parallax(part, odometry, INTRINSICS_FR2, (640, 480))
        result = solve(SlamProblem(odometry, table), SlamConfig())
        shown = [one for one in result.landmarks if one.in_map]
        out[name] = {
            "placed": len(table),
            "left_out": left_out,
            "before": trajectory_errors(odometry, truth)["ate"],
            "after": trajectory_errors(result.T_world_camera, truth)["ate"],
            "landmarks": dict(Counter(one.category for one in shown).most_common()),
            "median_spread": float(np.median([one.spread for one in shown])) if shown else None,
        }
    return out


def main() -> None:
    """Run and print."""
    arguments = tyro.cli(Arguments)
    out: dict[str, Any] = {}
    for name, heights, online in (("without_heights", False, False), ("with_heights", True, False), ("online", False, True)):
        rows = [simulated(arguments.seed + k, heights, online) for k in range(arguments.drives)]
        if rows:
            out[name] = summarised(rows)
    if arguments.data is not None:
        out["fr2_desk"] = desk(arguments.data, arguments.every)
    print(json.dumps(out, indent=1))


if __name__ == "__main__":
    main()
