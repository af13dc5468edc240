"""KITTI tracking: real 3D detections of cars, ego motion rebuilt from parked cars, with drift added to it."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from nolbo_ppl.data.converters.converted import Converted, existing
from nolbo_ppl.data.simulate import simulate_odometry
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import make_pose, so3_exp, transform
from nolbo_ppl.io.files import read_text
from nolbo_ppl.io.npz import read_npz
from nolbo_ppl.io.trajectories import Trajectory
from nolbo_ppl.structures.detections import Detections


def planar_poses(states: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 4 4"]:
    """Camera poses (x right, y down, z forward) of rows X forward, Y left, theta to the left, in the frame of camera
    0.
    """
    R = so3_exp(-states[:, 2:3] * np.array([0.0, 1.0, 0.0]))
    return make_pose(R, np.stack([-states[:, 1], np.zeros(len(states)), states[:, 0]], axis=1))


def longest_run(mask: Bool[np.ndarray, " n"]) -> tuple[int, int]:
    """First and one past the last index of the longest run of True; the whole range when there is none."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    starts, ends = edges[::2], edges[1::2]
    if not len(starts):
        return 0, len(mask)
    best = int(np.argmax(ends - starts))
    return int(starts[best]), int(ends[best])


def car_rotation(rotation_y: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3 3"]:
    """R_camera_object of cars: KITTI's rotation_y in the object frame of PASCAL3D+ (front -y, z up)."""
    c, s, zero = np.cos(rotation_y), np.sin(rotation_y), np.zeros_like(rotation_y)
    front = np.stack([c, zero, -s], axis=1)
    up = np.tile([0.0, -1.0, 0.0], (len(c), 1))
    return np.stack([np.cross(-front, up), -front, up], axis=-1)


def read_detections(path: str | PathLike[str]) -> Float[np.ndarray, "k 15"]:
    """Rows: frame, type, x1 y1 x2 y2, score, h w l, x y z, rotation_y, alpha. Raises `InputError` naming the line."""
    rows = []
    for number, text in enumerate(read_text(path).splitlines(), start=1):
        if not text.strip():
            continue
        try:
            values = [float(v) for v in text.split(",")]
        except ValueError:
            values = []
        if len(values) != 15 or not np.isfinite(values).all():
            raise input_error("not a detection", got=repr(text[:60]), expected="15 numbers", file=path, line=number)
        rows.append(values)
    return np.array(rows).reshape(-1, 15)


def read_labels(path: str | PathLike[str]) -> tuple[Int[np.ndarray, "k 2"], Float[np.ndarray, "k 4"], list[str]]:
    """Frame and track, position of the box centre and rotation_y, and type of every labelled object."""
    numbers, poses, kinds = [], [], []
    for number, text in enumerate(read_text(path).splitlines(), start=1):
        words = text.split()
        if not words:
            continue
        try:
            frame, track = (int(word) for word in words[:2])
            values = [float(word) for word in words[3:17]]
        except ValueError:
            values = []
        if len(values) != 14 or not np.isfinite(values).all():
            expected = "frame, track, type and 14 numbers"
            raise input_error("not a label", got=repr(text[:60]), expected=expected, file=path, line=number)
        if words[2] == "DontCare":
            continue
        h, x, y, z, rotation = values[7], *values[10:14]
        numbers.append((frame, track))
        poses.append((x, y - h / 2, z, rotation))
        kinds.append(words[2])
    return np.array(numbers, dtype=np.int64).reshape(-1, 2), np.array(poses).reshape(-1, 4), kinds


def parked_tracks(
    numbers: Int[np.ndarray, "k 2"],
    poses: Float[np.ndarray, "k 4"],
    kinds: list[str],
    truth: Float[np.ndarray, "n 4 4"],
    trusted: Bool[np.ndarray, " n"],
    limit: float = 1.0,
) -> dict[int, np.ndarray]:
    """Median world position of cars whose label stays within `limit` m of it in four fifths of its trusted frames."""
    out = {}
    car = np.array([k in ("Car", "Van") for k in kinds], dtype=bool)
    for track in np.unique(numbers[car, 1]):
        rows = np.flatnonzero(car & (numbers[:, 1] == track))
        rows = rows[trusted[numbers[rows, 0]] & (np.linalg.norm(poses[rows, :3], axis=1) < 50)]
        if len(rows) < 3:
            continue
        world = transform(truth[numbers[rows, 0]], poses[rows, :3])
        centre = np.median(world, axis=0)
        if np.mean(np.linalg.norm((world - centre)[:, [0, 2]], axis=1) < limit) > 0.8:
            out[int(track)] = centre
    return out


def convert_kitti_tracking(
    data: str | PathLike[str],
    sequence: str,
    *,
    seed: int = 0,
    rotation_drift: float = np.deg2rad(0.3),
    translation_drift: float = 0.02,
    minimum_score: float = 0.0,
    match_distance: float = 2.0,
    trusted_only: bool = True,
) -> Converted:
    """Real detections of one drive; odometry is the pseudo ego motion with seeded planar drift.

    Args:
        data: folder with `labels/`, `detections_car/` and `pseudo_ego/` (`kitti_tracking`).
        sequence: four digits.
        rotation_drift: scale of the heading error of one frame, rad.
        translation_drift: scale of the position error of one frame, m per m.
        minimum_score: detections below are left out.
        match_distance: a detection is a labelled car when within this distance of it, m.
        trusted_only: keep the longest stretch of frames whose rebuilt ego motion can be trusted.

    Raises:
        InputError: files are missing or malformed.
    """
    folder = Path(data)
    ego = read_npz(existing(folder / "pseudo_ego" / f"{sequence}.npz", "pseudo ego motion"), {"P": None, "cov": None})
    truth = planar_poses(ego["P"])
    trusted = ego["cov"] >= 1
    first, last = longest_run(trusted) if trusted_only else (0, len(truth))
    truth, trusted = truth[first:last], trusted[first:last]
    numbers, poses, kinds = read_labels(existing(folder / "labels" / f"{sequence}.txt", "labels"))
    rows = read_detections(existing(folder / "detections_car" / f"{sequence}.txt", "detections"))
    rows[:, 0] -= first
    numbers[:, 0] -= first
    known = (numbers[:, 0] >= 0) & (numbers[:, 0] < len(truth))
    numbers, poses, kinds = numbers[known], poses[known], [k for k, use in zip(kinds, known) if use]
    rows = rows[(rows[:, 6] >= minimum_score) & (rows[:, 0] >= 0) & (rows[:, 0] < len(truth))]
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    frame, h, w, length = rows[:, 0].astype(np.int64), rows[:, 7], rows[:, 8], rows[:, 9]
    position = np.stack([rows[:, 10], rows[:, 11] - h / 2, rows[:, 12]], axis=1)
    objectness = 1.0 / (1.0 + np.exp(-rows[:, 6]))
    counter = np.array([int(np.sum(frame[:i] == t)) for i, t in enumerate(frame)]) if len(frame) else frame
    table = Detections.from_arrays(
        frame,
        position,
        rotation=car_rotation(rows[:, 13]),
        objectness=objectness,
        category=["car"] * len(rows),
        size=np.stack([w, length, h], axis=1),
        id=[f"{t:06d}-{k:02d}" for t, k in zip(frame, counter)],
    )
    parked = parked_tracks(numbers, poses, kinds, truth, trusted)
    objects: list[str | None] = []
    for t, p in zip(frame, position):
        here = np.flatnonzero(numbers[:, 0] == t)
        distance = np.linalg.norm(poses[here][:, [0, 2]] - p[[0, 2]], axis=1)
        best = here[np.argmin(distance)] if len(here) and distance.min() < match_distance else None
        if best is None:
            objects.append(None)
        else:
            track = int(numbers[best, 1])
            objects.append(f"{'car' if track in parked else 'moving'}-{track}")
    odometry = simulate_odometry(
        truth, np.random.default_rng(seed), rotation_scale=rotation_drift, translation_ratio=translation_drift, planar=True
    )
    settings = {
        "kind": "kitti-tracking",
        "sequence": sequence,
        "seed": seed,
        "rotation_drift": rotation_drift,
        "translation_drift": translation_drift,
        "minimum_score": minimum_score,
    }
    poses_out = {f"car-{k}": make_pose(np.eye(3), v) for k, v in parked.items()}
    return Converted(
        odometry=Trajectory(odometry),
        truth=Trajectory(truth),
        observations=table,
        objects=tuple(objects),
        trusted=trusted,
        T_world_object=poses_out,
        source=settings,
    )
