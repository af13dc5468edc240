"""A map as one MCAP file for Foxglove and rviz (extra `ros`): paths, markers, 3D boxes and transforms.

| topic | type | |
|---|---|---|
| `/nolbo/trajectory`, `/nolbo/odometry` | nav_msgs/Path | corrected, and as it was |
| `/nolbo/landmarks` | visualization_msgs/MarkerArray | box, name and the ellipsoid of one standard deviation of each |
| `/nolbo/objects` | vision_msgs/Detection3DArray | categories with probabilities, poses with covariances, sizes |
| `/tf_static` | tf2_msgs/TFMessage | `map` (z up) to `nolbo_world` (the odometry's: y down) |
| `/tf` | tf2_msgs/TFMessage | `nolbo_world` to `nolbo_camera`, a message a frame |
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import make_pose, matrix_to_quaternion
from nolbo_ppl.io.files import atomic_path
from nolbo_ppl.io.trajectories import Trajectory
from nolbo_ppl.structures.landmark import Landmark

MCAP = "map.mcap"
"""Its name beside the other files of a map."""
WORLD, CAMERA, UPRIGHT = "nolbo_world", "nolbo_camera", "map"
"""Frames: the odometry's world (x right, y down, z forward), the camera, and the world as robots have it (z up)."""
R_UPRIGHT_WORLD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""x forward, y left, z up of x right, y down, z forward."""
R_OBJECT_ROS = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""An object's axes as ROS has them (x to its front, y to its left, z up) in ours (front -y, z up)."""
UNKNOWN_SIZE = 0.3
"""Side of the box of a landmark whose size nobody stated, m."""
PALETTE = ((0.12, 0.47, 0.71), (0.89, 0.47, 0.13), (0.17, 0.63, 0.17), (0.58, 0.40, 0.74), (0.55, 0.34, 0.29), (0.89, 0.47, 0.76))
"""Colours of the categories in order of their names."""


class _Messages:
    """Messages of the types that are written, from this library's values."""

    def __init__(self) -> None:
        try:
            from rosbags.typesys import Stores, get_types_from_msg, get_typestore
        except ImportError:
            raise input_error("MCAP files need the package rosbags", do="pip install 'nolbo-ppl[ros]'") from None
        from nolbo_ppl.io.ros_definitions import PARTS, WRITTEN

        self.store: Any = get_typestore(Stores.EMPTY)
        types: dict[str, Any] = {}
        for name, text in (PARTS | WRITTEN).items():
            types.update(get_types_from_msg(text, name))
        self.store.register(types)

    def make(self, name: str, *values: Any) -> Any:
        """A message of its values in order."""
        package, kind = name.split("/")
        return self.store.types[f"{package}/msg/{kind}"](*values)

    def header(self, nanoseconds: int, frame: str) -> Any:
        time = self.make("builtin_interfaces/Time", nanoseconds // 10**9, nanoseconds % 10**9)
        return self.make("std_msgs/Header", time, frame)

    def vector(self, name: str, values: np.ndarray) -> Any:
        return self.make(f"geometry_msgs/{name}", *(float(v) for v in values))

    def pose(self, T: Float[np.ndarray, "4 4"]) -> Any:
        q = matrix_to_quaternion(T[:3, :3])
        return self.make("geometry_msgs/Pose", self.vector("Point", T[:3, 3]), self.vector("Quaternion", q))

    def path(self, T: Float[np.ndarray, "n 4 4"], times: Sequence[int]) -> Any:
        poses = [self.make("geometry_msgs/PoseStamped", self.header(t, WORLD), self.pose(one)) for t, one in zip(times, T)]
        return self.make("nav_msgs/Path", self.header(times[-1], WORLD), poses)

    def transform(self, T: Float[np.ndarray, "4 4"], time: int, parent: str, child: str) -> Any:
        q = self.vector("Quaternion", matrix_to_quaternion(T[:3, :3]))
        moved = self.make("geometry_msgs/Transform", self.vector("Vector3", T[:3, 3]), q)
        stamped = self.make("geometry_msgs/TransformStamped", self.header(time, parent), child, moved)
        return self.make("tf2_msgs/TFMessage", [stamped])

    def marker(
        self, time: int, space: str, number: int, kind: int, T: np.ndarray, scale: np.ndarray, colour: Sequence[float], text: str
    ) -> Any:
        """A marker that stays until it is replaced."""
        nothing = self.make("sensor_msgs/CompressedImage", self.header(0, ""), "", np.zeros(0, np.uint8))
        mesh = self.make("visualization_msgs/MeshFile", "", np.zeros(0, np.uint8))
        rgba = self.make("std_msgs/ColorRGBA", *(float(v) for v in colour))
        forever = self.make("builtin_interfaces/Duration", 0, 0)
        drawn: tuple[Any, ...] = (self.pose(T), self.vector("Vector3", scale), rgba, forever, False, [], [])
        rest: tuple[Any, ...] = ("", nothing, [], text, "", mesh, False)
        return self.make("visualization_msgs/Marker", self.header(time, WORLD), space, number, kind, 0, *drawn, *rest)

    def objects(self, landmarks: Sequence[Landmark], time: int) -> Any:
        """Landmarks as 3D boxes: what each may be, where with its covariance, and how large."""
        found = []
        for one in landmarks:
            covariance = np.full(36, 0.0)
            if np.isfinite(one.position_covariance).all():
                table = np.zeros((6, 6))
                table[:3, :3] = one.position_covariance
                if one.oriented and np.isfinite(one.covariance[:3, :3]).all():
                    R = one.T_world_object[:3, :3]
                    table[3:, 3:] = R @ one.covariance[:3, :3] @ R.T  # ROS states it about the axes of the fixed frame
                covariance = table.ravel()
            T = one.T_world_object @ make_pose(R_OBJECT_ROS, np.zeros(3))
            pose = self.make("geometry_msgs/PoseWithCovariance", self.pose(T), covariance)
            likely = one.class_posterior or {one.category or "object": 1.0}
            existence = one.existence if np.isfinite(one.existence) else 1.0
            results = [
                self.make(
                    "vision_msgs/ObjectHypothesisWithPose",
                    self.make("vision_msgs/ObjectHypothesis", name, float(p * existence)),
                    pose,
                )
                for name, p in sorted(likely.items(), key=lambda item: -item[1])
            ]
            size = np.zeros(3) if one.size is None else one.size[[1, 0, 2]]
            box = self.make("vision_msgs/BoundingBox3D", self.pose(T), self.vector("Vector3", size))
            found.append(self.make("vision_msgs/Detection3D", self.header(time, WORLD), results, box, one.name))
        return self.make("vision_msgs/Detection3DArray", self.header(time, WORLD), found)

    def markers(self, landmarks: Sequence[Landmark], time: int) -> Any:
        """Boxes, names and ellipsoids."""
        names = sorted({one.category or "object" for one in landmarks})
        made = []
        for k, one in enumerate(landmarks):
            colour = PALETTE[names.index(one.category or "object") % len(PALETTE)]
            size = np.full(3, UNKNOWN_SIZE) if one.size is None else one.size
            sure = float(np.clip(one.existence, 0.2, 1.0)) if np.isfinite(one.existence) else 1.0
            made.append(self.marker(time, "box", k, 1, one.T_world_object, size, (*colour, 0.6 * sure), ""))
            above = make_pose(np.eye(3), one.position - np.array([0.0, 0.6 * float(size.max()) + 0.1, 0.0]))
            label = f"{one.name} {one.category or ''}".strip()
            made.append(self.marker(time, "name", k, 9, above, np.array([0.0, 0.0, 0.2]), (1.0, 1.0, 1.0, 1.0), label))
            if np.isfinite(one.position_covariance).all():
                variance, axes = np.linalg.eigh(one.position_covariance)
                axes = axes * np.sign(np.linalg.det(axes))
                scale = 2 * np.sqrt(np.maximum(variance, 1e-12))
                at = make_pose(axes, one.position)
                made.append(self.marker(time, "one standard deviation", k, 2, at, scale, (*colour, 0.25), ""))
        return self.make("visualization_msgs/MarkerArray", made)


def write_map_mcap(
    path: str | PathLike[str],
    trajectory: Trajectory,
    landmarks: Sequence[Landmark],
    odometry: Float[np.ndarray, "n 4 4"] | None = None,
) -> None:
    """Write trajectory and map as one MCAP file, atomically.

    Landmarks and paths stand at the first time and again at the last, so that they are seen wherever playing begins. Rows
    without times are a tenth of a second apart.

    Args:
        path: the file.
        trajectory: corrected poses, with times where they are known.
        landmarks: the map; those that are more likely background are left out.
        odometry: poses as they were.

    Raises:
        InputError: the extra `ros` is not installed, or there is no pose.
    """
    path = Path(path)
    messages = _Messages()
    T = trajectory.T_world_camera
    if not len(T):
        raise input_error("a map without a pose", file=path)
    times = 0.1 * np.arange(1, len(T) + 1) if trajectory.times is None else trajectory.times
    stamps = [max(round(float(t) * 1e9), 0) for t in times]
    shown = [one for one in landmarks if one.in_map]
    from rosbags.rosbag2 import StoragePlugin, Writer

    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary, TemporaryDirectory(prefix=".", dir=path.parent) as scratch:
        bag = Path(scratch) / "map"
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            kinds = {
                "/tf_static": "tf2_msgs/msg/TFMessage",
                "/tf": "tf2_msgs/msg/TFMessage",
                "/nolbo/trajectory": "nav_msgs/msg/Path",
                "/nolbo/odometry": "nav_msgs/msg/Path",
                "/nolbo/landmarks": "visualization_msgs/msg/MarkerArray",
                "/nolbo/objects": "vision_msgs/msg/Detection3DArray",
            }
            if odometry is None:
                del kinds["/nolbo/odometry"]
            connections = {topic: writer.add_connection(topic, kind, typestore=messages.store) for topic, kind in kinds.items()}

            def write(topic: str, time: int, message: Any) -> None:
                writer.write(connections[topic], time, messages.store.serialize_cdr(message, kinds[topic]))

            for time in dict.fromkeys((stamps[0], stamps[-1])):
                upright = messages.transform(make_pose(R_UPRIGHT_WORLD, np.zeros(3)), time, UPRIGHT, WORLD)
                write("/tf_static", time, upright)
                write("/nolbo/trajectory", time, messages.path(T, stamps))
                if odometry is not None:
                    write("/nolbo/odometry", time, messages.path(odometry, stamps))
                write("/nolbo/landmarks", time, messages.markers(shown, time))
                write("/nolbo/objects", time, messages.objects(shown, time))
            for time, pose in zip(stamps, T):
                write("/tf", time, messages.transform(pose, time, WORLD, CAMERA))
        os.replace(bag / "map.mcap", temporary)
