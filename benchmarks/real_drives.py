"""Real drives with the weights for photographs: what is observed against tracklets, trajectories before and after.

    python benchmarks/real_drives.py --out build/real_drives [--data ../shared/data] [--only kitti-visual]

Drives: KITTI raw 0005 with visual odometry (camera height), with its OXTS as it is, and with OXTS plus drift, each with the noise
stated; TUM fr1_desk with visual odometry (lengths of the truth). Runs stay in the folder. Prints tables, writes figures.json.
Recall counts cars of at least 16 px that are seen by half; vans are told apart, what else resembles a category is not judged.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from nolbo_ppl.data.converters.kitti_object import CAMERAS, IGNORED, PIXEL_CENTRE, SEEN, KittiLabel, read_track_labels
from nolbo_ppl.data.converters.kitti_raw import camera_poses, step_covariance
from nolbo_ppl.data.converters.kitti_tracking import car_rotation
from nolbo_ppl.data.simulate import simulate_odometry
from nolbo_ppl.errors import input_error
from nolbo_ppl.evaluation.sequence_scores import (
    coverage_scores,
    detection_scores,
    finite,
    landmark_errors,
    matched_ground_truth,
    position_scores,
)
from nolbo_ppl.evaluation.sequence_truth import SequenceGroundTruth, match_detections, object_shown
from nolbo_ppl.geometry.pose import make_pose
from nolbo_ppl.io.files import write_json
from nolbo_ppl.io.npz import save_npz
from nolbo_ppl.io.run_folder import RunFolder
from nolbo_ppl.io.trajectories import COVARIANCE, Trajectory, write_trajectory
from nolbo_ppl.metrics.association import landmark_to_object
from nolbo_ppl.metrics.viewpoint_error import rotation_error
from nolbo_ppl.odometry import OdometryConfig
from nolbo_ppl.pipeline.mapping_pipeline import run_pipeline
from nolbo_ppl.pipeline.run_config import RunConfig
from nolbo_ppl.structures.annotations import Annotations

DAY = "2011_09_26"
CAMERA_HEIGHT = 1.65
"""Of KITTI's car, m."""
DRIFT = {"rotation_scale": 1e-3, "translation_ratio": 0.02}
"""Added to OXTS: standard deviations of each step, rad an axis and m a metre."""
VISUAL = OdometryConfig(features=1500, patch=11)
"""Images of 640 px and more hold more corners than the default's 384 px, and registered patches drift less."""
RANGES = (0.0, 10.0, 20.0, 30.0, 45.0)
"""Edges of the bands of range, m."""
FR1 = "517.3 516.5 318.6 255.3 0.2624 -0.9531 -0.0054 0.0026 1.1633\n"
"""Camera of fr1: fx fy cx cy k1 k2 p1 p2 k3."""
MOVED = 2.0
"""An object whose places in the world lie further apart moves, m."""


@dataclass(frozen=True)
class Arguments:
    """What to run."""

    out: Path = Path("build/real_drives")
    """Folder of the runs."""
    data: Path = Path("../shared/data")
    """Folder with sequences/ and kitti_tracking/."""
    model: str = "photo"
    """Observation model."""
    only: tuple[str, ...] = ()
    """Names of drives to run; all when empty."""
    every: int = 1
    """Use every so many-th image."""
    usual_heights: Literal["auto", "on", "off"] = "auto"
    """Refine positions by the usual heights of categories; `auto`: with the weights `photo`."""
    sizes: tuple[int, ...] = (960,)
    """Longer sides, px, at which the street is looked at."""


def labels_of(path: Path) -> list[list[tuple[str, KittiLabel]]]:
    """Name and label of every object of every frame of a tracking label file, which holds the drive's tracklets."""
    return [[(f"{label.kind} {track}", label) for track, label in frame] for frame in read_track_labels(path)]


def truth_of(labels: list[list[tuple[str, KittiLabel]]], poses: np.ndarray, kinds: tuple[str, ...]) -> SequenceGroundTruth:
    """Labelled objects of some kinds as cars; other kinds that resemble a category are regions that are not judged."""
    camera, frames, places = CAMERAS[DAY], [], dict[str, list[np.ndarray]]()
    size = np.array([1242.0, 375.0, 1242.0, 375.0])
    for seen, pose in zip(labels, poses):
        wanted = [(name, label) for name, label in seen if label.kind in kinds]
        others = [label.box for _, label in seen if label.kind not in kinds and label.kind in (*IGNORED, "Car")]
        rotation = car_rotation(np.array([label.rotation_y for _, label in wanted]))
        position = np.array([label.bottom - [0, label.dimensions[0] / 2, 0] + camera.offset for _, label in wanted]).reshape(
            -1, 3
        )
        made = Annotations.from_arrays(
            intrinsics=camera.intrinsics,
            box=np.clip(np.array([label.box for _, label in wanted]).reshape(-1, 4) + PIXEL_CENTRE, 0, size),
            category=["car"] * len(wanted),
        )
        share = [SEEN.get(label.occluded, 0.35) * (1 - max(label.truncated, 0.0)) for _, label in wanted]
        diagonal = np.array([np.linalg.norm(label.dimensions) for _, label in wanted])
        frames.append(
            replace(
                made,
                id=tuple(name for name, _ in wanted),
                R_camera_object=rotation.reshape(-1, 3, 3),
                position=position,
                diagonal=diagonal,
                visibility=np.array(share, dtype=np.float64),
                ignore=np.clip(np.array(others).reshape(-1, 4) + PIXEL_CENTRE, 0, size),
            )
        )
        for k, (name, _) in enumerate(wanted):
            places.setdefault(name, []).append(pose @ make_pose(rotation[k], position[k]))
    names = tuple(places)
    tracks = [np.array(places[name]) for name in names]
    return SequenceGroundTruth(
        names=names,
        category=("car",) * len(names),
        instance=names,
        T_world_object=np.array([track[len(track) // 2] for track in tracks]).reshape(-1, 4, 4),
        diagonal=np.ones(len(names)),
        symmetry=np.ones(len(names), dtype=np.int64),
        moving=np.array([np.ptp(track[:, [0, 2], 3], axis=0).max() > MOVED for track in tracks], dtype=bool),
        packed={},
        frames=tuple(frames),
    )


def observation_table(run: RunFolder, truth: SequenceGroundTruth) -> dict[str, Any]:
    """Detections of cars against the labels."""
    table = run.detections
    assert table is not None
    table = table.select(np.array([category == "car" for category in table.category], dtype=bool))
    matched = match_detections(table.frame, table.box, table.objectness, truth)
    unjudged = np.zeros(len(table), dtype=bool)  # what lies on something that nobody labels as a car
    for k in np.flatnonzero(matched.object < 0):
        boxes = truth.frames[table.frame[k]].ignore
        low, high = np.maximum(table.box[k, :2], boxes[:, :2]), np.minimum(table.box[k, 2:], boxes[:, 2:])
        inside = np.prod(np.maximum(high - low, 0), axis=1) / max(float(np.prod(table.box[k, 2:] - table.box[k, :2])), 1.0)
        unjudged[k] = bool((inside > 0.5).any())
    judged = (matched.counted | (matched.object < 0)) & ~unjudged
    true = matched_ground_truth(matched, table.frame, truth)
    true["position"][~matched.counted] = np.nan
    rows = np.flatnonzero(matched.counted & table.has_rotation)
    turned = rotation_error(table.rotation[rows], true["rotation"][rows], np.ones(len(rows), dtype=np.int64))
    distance = np.linalg.norm(true["position"], axis=1)
    wanted = np.concatenate([np.linalg.norm(seen.position[seen.counts()], axis=1) for seen in truth.frames])
    recall = {}
    for low, high in zip(RANGES, (*RANGES[1:], np.inf)):
        total = int(np.sum((wanted >= low) & (wanted < high)))
        hit = int(np.sum((distance >= low) & (distance < high)))
        recall[f"{low:g}-{high:g} m"] = {"objects": total, "recall": finite(hit / total) if total else None}
    known = np.isfinite(true["position"]).all(axis=1)
    along = np.linalg.norm(table.position[known], axis=1) / np.maximum(distance[known], 1e-9) - 1.0
    return {
        **detection_scores(matched, table, truth),
        "precision": finite(matched.counted.sum() / judged.sum()) if judged.any() else None,
        "recall_by_range": recall,
        "position_error": position_scores(table.position, true["position"], RANGES),
        "range_bias": finite(float(np.median(along))) if len(along) else None,
        "within_30_degrees": finite(float(np.mean(turned < np.pi / 6))) if len(turned) else None,
        "half_turns": finite(float(np.mean(turned > 5 * np.pi / 6))) if len(turned) else None,
        "coverage90": coverage_scores(matched, table, truth, None),
    }


def map_table(run: RunFolder, truth: SequenceGroundTruth, poses: np.ndarray) -> dict[str, Any]:
    """Landmarks against the cars that stand."""
    table, found = run.detections, run.associations
    assert table is not None and found is not None
    shown = object_shown(table.frame, table.box, truth, 0.3)
    owner, _ = landmark_to_object(shown, found.landmark_of, len(run.landmarks))
    exists = np.array([landmark.in_map for landmark in run.landmarks], dtype=bool)
    still = exists & (owner >= 0)
    still[still] &= ~truth.moving[owner[still]]
    position = np.array([landmark.position for landmark in run.landmarks]).reshape(-1, 3)
    error = landmark_errors(position, owner, truth, run.estimate, poses)[still]
    long_seen = [i for i, name in enumerate(truth.names) if sum(name in (frame.id or ()) for frame in truth.frames) >= 10]
    return {
        "landmarks": int(exists.sum()),
        "of_standing_cars": int(still.sum()),
        "standing_cars_mapped": len(set(owner[still].tolist())),
        "standing_cars_seen_10_frames": sum(not truth.moving[i] for i in long_seen),
        "of_moving_cars": int(np.sum(exists & (owner >= 0)) - still.sum()),
        "of_nothing_labelled": int(np.sum(exists & (owner < 0))),
        "position_error_median": finite(float(np.median(error))) if len(error) else None,
    }


def kitti(arguments: Arguments, name: str) -> dict[str, Any]:
    """KITTI raw 0005 with one source of odometry."""
    data, out = arguments.data / "sequences" / "kitti_raw_0005", arguments.out / name
    inputs = arguments.out / "inputs" / name
    inputs.mkdir(parents=True, exist_ok=True)
    poses = camera_poses(data / "oxts.txt", data)
    write_trajectory(inputs / "truth.txt", Trajectory(poses))
    given: dict[str, Any] = {"camera_height": CAMERA_HEIGHT}
    if name != "kitti-visual":
        covariance, odometry = step_covariance(len(poses) - 1), poses
        if name == "kitti-drift":
            odometry = simulate_odometry(poses, np.random.default_rng(0), **DRIFT)
            length = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
            added = [np.diag(np.repeat([DRIFT["rotation_scale"] ** 2, (DRIFT["translation_ratio"] * s) ** 2], 3)) for s in length]
            covariance = covariance + np.array(added)
        write_trajectory(inputs / "odometry.txt", Trajectory(odometry))
        save_npz(inputs / COVARIANCE, {"covariance": covariance})
        given = {"odometry": inputs / "odometry.txt"}
    summary = run_pipeline(
        RunConfig(
            images=data,
            intrinsics=data / "calib_cam_to_cam.txt",
            truth=inputs / "truth.txt",
            out=out,
            model=arguments.model,
            test_sizes=arguments.sizes,
            usual_heights=arguments.usual_heights,
            visual=VISUAL,
            frame_stride=arguments.every,
            **given,
        )
    )
    run, labels = RunFolder(out), labels_of(arguments.data / "kitti_tracking" / "labels" / "0000.txt")
    labels, poses = (labels + [[]] * len(poses))[: len(poses)][:: arguments.every], poses[:: arguments.every]
    cars, both = truth_of(labels, poses, ("Car",)), truth_of(labels, poses, ("Car", "Van"))
    return {
        "summary": summary,
        "cars": observation_table(run, cars),
        "cars and vans": observation_table(run, both),
        "map": map_table(run, both, poses),
    }


def desk(arguments: Arguments) -> dict[str, Any]:
    """TUM fr1_desk with visual odometry."""
    data, inputs = arguments.data / "sequences" / "tum_fr1_desk", arguments.out / "inputs" / "fr1-visual"
    inputs.mkdir(parents=True, exist_ok=True)
    (inputs / "camera.txt").write_text(FR1, encoding="utf-8")
    if not (inputs / "rgb").exists():
        (inputs / "rgb").symlink_to((data / "rgb").resolve())
    pictures = sorted((data / "rgb").iterdir(), key=lambda path: float(path.stem))
    (inputs / "rgb.txt").write_text("".join(f"{path.stem} rgb/{path.name}\n" for path in pictures), encoding="utf-8")
    summary = run_pipeline(
        RunConfig(
            images=inputs,
            intrinsics=inputs / "camera.txt",
            truth=data / "groundtruth.txt",
            out=arguments.out / "fr1-visual",
            model=arguments.model,
            usual_heights=arguments.usual_heights,
            visual=VISUAL,
            frame_stride=arguments.every,
        )
    )
    run = RunFolder(arguments.out / "fr1-visual")
    kinds = [landmark.category or "none" for landmark in run.landmarks if landmark.in_map]
    return {"summary": summary, "landmarks": {kind: kinds.count(kind) for kind in sorted(set(kinds))}}


def lines_of(name: str, found: dict[str, Any]) -> list[str]:
    """A drive as lines of text."""
    summary = found["summary"]
    lines = [f"## {name}", f"observations {summary['observations']}, landmarks {summary['landmarks']}"]
    if "before" in summary:
        before, after, way = summary["before"]["ate"], summary["after"]["ate"], summary["path_length"]
        lines.append(f"ATE {before:.3f} -> {after:.3f} m on {way:.1f} m")
    if "odometry" in summary:
        lines.append(f"steps of visual odometry: {summary['odometry']}")
    for kind in ("cars", "cars and vans"):
        if kind in found:
            seen = found[kind]
            lines.append(
                f"{kind}: recall {seen['recall']}, precision {seen['precision']}, range bias {seen['range_bias']}, "
                f"within 30 degrees {seen['within_30_degrees']}, half turns {seen['half_turns']}, coverage {seen['coverage90']}"
            )
            for band, row in seen["recall_by_range"].items():
                error = next((e for b, e in seen["position_error"].items() if b.split("-")[0] == band.split("-")[0]), None)
                lines.append(f"  {band}: {row['recall']} of {row['objects']}; position {error}")
    if "map" in found:
        lines.append(f"map: {found['map']}")
    if "landmarks" in found:
        lines.append(f"map: {found['landmarks']}")
    return lines


def main() -> None:
    """Run the drives, print the tables."""
    arguments = tyro.cli(Arguments, description=__doc__)
    if not (arguments.data / "sequences").is_dir():
        raise input_error("no such folder", file=arguments.data / "sequences", do="give --data")
    figures = {}
    for name in arguments.only or ("kitti-visual", "kitti-oxts", "kitti-drift", "fr1-visual"):
        figures[name] = desk(arguments) if name == "fr1-visual" else kitti(arguments, name)
        print("\n".join(lines_of(name, figures[name])), flush=True)
    write_json(arguments.out / "figures.json", figures)


if __name__ == "__main__":
    main()
