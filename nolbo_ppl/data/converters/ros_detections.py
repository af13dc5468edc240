"""Detections of a ROS bag (vision_msgs, 2D and 3D), a frame a message, and the odometry at their times."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
from jaxtyping import Float

from nolbo_ppl.data.converters.foreign_detections import ForeignDetections
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import is_rotation, quaternion_to_matrix
from nolbo_ppl.io.ros_bags import DETECTIONS, Bag, split_topic
from nolbo_ppl.io.ros_maps import R_OBJECT_ROS
from nolbo_ppl.io.ros_messages import FixedFrames, camera_frames
from nolbo_ppl.io.trajectories import Trajectory, interpolate_poses, read_trajectory


@dataclass(frozen=True)
class BagDetections:
    """What a topic of detections holds."""

    times: Float[np.ndarray, " n"]
    """Time of every message, s."""
    found: ForeignDetections
    """Detections; `frame` is the number of the message."""
    topic: str
    """The topic."""


def _hypothesis(result: Any) -> tuple[str, float]:
    """Category and score of a hypothesis, of any version of vision_msgs."""
    inner = getattr(result, "hypothesis", result)
    name = getattr(inner, "class_id", getattr(inner, "id", ""))
    return str(name).strip().replace(" ", "_") or "object", float(inner.score)


def _box(detection: Any) -> list[float]:
    """Corners of a 2D box; NaN of a detection in 3D."""
    box = detection.bbox
    if not hasattr(box, "size_x"):
        return [np.nan] * 4
    centre = getattr(box.center, "position", box.center)
    return [
        centre.x - box.size_x / 2,
        centre.y - box.size_y / 2,
        centre.x + box.size_x / 2,
        centre.y + box.size_y / 2,
    ]


def _rotation(pose: Any) -> Float[np.ndarray, "3 3"]:
    """R_camera_object of a pose; NaN where the detector gives none: no unit quaternion, or the camera's own axes."""
    q = np.array([pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w])
    if abs(np.linalg.norm(q) - 1) > 1e-2 or abs(q[3]) > 1 - 1e-9:
        return np.full((3, 3), np.nan)
    return quaternion_to_matrix(q / np.linalg.norm(q)) @ R_OBJECT_ROS.T


def _place(detection: Any, best: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Position, covariance, rotation and size of a detection in 3D; NaN where they are not stated."""
    if hasattr(detection.bbox, "size_x"):
        return np.full(3, np.nan), np.full((3, 3), np.nan), np.full((3, 3), np.nan), np.full(3, np.nan)
    pose = detection.bbox.center
    position = np.array([pose.position.x, pose.position.y, pose.position.z])
    covariance = np.full((3, 3), np.nan)
    if best is not None:
        table = np.asarray(best.pose.covariance, dtype=np.float64).reshape(6, 6)[:3, :3]
        if np.isfinite(table).all() and np.linalg.eigvalsh(0.5 * (table + table.T))[0] > 0:
            covariance = 0.5 * (table + table.T)
        if not position.any():  # boxes are optional, poses of hypotheses too
            pose = best.pose.pose
            position = np.array([pose.position.x, pose.position.y, pose.position.z])
    length, width, height = (float(getattr(detection.bbox.size, axis)) for axis in "xyz")
    size = np.array([width, length, height]) if min(length, width, height) > 0 else np.full(3, np.nan)
    return position, covariance, _rotation(pose), size


def read_bag_detections(path: str | PathLike[str]) -> BagDetections:
    """Detections of a bag, `BAG` or `BAG:/topic`: Detection3DArray or Detection2DArray, any version of vision_msgs.

    Of several hypotheses the best is taken. Positions in a frame that fixed transforms tie to a camera are moved into it; a box
    in 3D has x to its front, y to its left and z up.

    Raises:
        InputError: no such topic, or a value out of range; names the bag.
    """
    file, name = split_topic(path)
    rows: list[tuple[Any, ...]] = []
    times: list[float] = []
    with Bag(file) as bag:
        topic = bag.topic(name, DETECTIONS, "detections")
        cameras, fixed = sorted(camera_frames(bag)), FixedFrames(bag)
        moved: dict[str, np.ndarray] = {}
        for time, message in bag.messages(topic.name):
            if times and time <= times[-1]:
                raise input_error(f"times of {topic.name} do not increase", got=f"message {len(times)}", file=file)
            frame = message.header.frame_id.strip("/")
            if frame not in moved:
                chains = [
                    T for T in (fixed.between(camera, frame) for camera in cameras if frame not in cameras) if T is not None
                ]
                moved[frame] = chains[0] if chains else np.eye(4)
            T = moved[frame]
            for detection in message.detections:
                best = max(detection.results, key=lambda one: _hypothesis(one)[1], default=None)
                category, certainty = ("object", 1.0) if best is None else _hypothesis(best)
                position, covariance, rotation, size = _place(detection, best)
                R = T[:3, :3]
                placed = (R @ position + T[:3, 3], R @ covariance @ R.T, R @ rotation, size)
                rows.append((len(times), _box(detection), certainty, category, *placed))
            times.append(time)
    if not times:
        raise input_error(f"topic {topic.name} has no messages", expected="detections", file=file)

    def column(k: int, *shape: int) -> np.ndarray:
        return np.array([row[k] for row in rows], dtype=np.float64).reshape(-1, *shape)

    score, position, rotation = column(2), column(4, 3), column(6, 3, 3)
    if not ((score >= 0) & (score <= 1)).all():
        raise input_error(f"score in {topic.name}", got=float(score[(score < 0) | (score > 1)][0]), expected="0 to 1", file=file)
    rotation[~is_rotation(np.nan_to_num(rotation))] = np.nan
    found = ForeignDetections(
        np.array([row[0] for row in rows], dtype=np.int64),
        column(1, 4),
        score,
        tuple(row[3] for row in rows),
        position,
        rotation,
        column(7, 3),
        covariance=column(5, 3, 3),
    )
    return BagDetections(np.array(times), found, topic.name)


def odometry_at(path: str | PathLike[str], times: Float[np.ndarray, " n"]) -> tuple[Trajectory, np.ndarray]:
    """Poses of an odometry at some times, between its own by constant velocity, and which of the times lie within it.

    Raises:
        InputError: an odometry without times, or one that holds none of these; names it.
    """
    found = read_trajectory(path)
    if found.times is None:
        raise input_error("an odometry without times", expected="the times of the bag", file=path)
    T = interpolate_poses(found.times, found.T_world_camera, times)
    known = np.isfinite(T).all(axis=(1, 2))
    if not known.any():
        got = f"{found.times[0]:.3f} s to {found.times[-1]:.3f} s"
        raise input_error("odometry has no time of the detections", got=got, expected=f"{times[0]:.3f} s and later", file=path)
    return Trajectory(T[known], times[known], "tum"), known
