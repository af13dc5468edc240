"""Bags for the tests: rosbag1, rosbag2 in SQLite and MCAP, written on the fly."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from nolbo_ppl.geometry.pose import make_pose, matrix_to_quaternion
from nolbo_ppl.io.ros_definitions import VISION, WRITTEN

KINDS = ("bag", "db3", "mcap")


class BagWriter:
    """Messages of either ROS into a bag of either kind; `None` stands for a header's sequence number."""

    def __init__(self, path: Path, kind: str, vision: str | None = None) -> None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.path, self.kind = path, kind
        self.first = kind == "bag"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.first else Stores.ROS2_HUMBLE)
        for name, text in (VISION | {"tf2_msgs/msg/TFMessage": WRITTEN["tf2_msgs/msg/TFMessage"]}).items():
            types = get_types_from_msg(vision or text if name in VISION else text, name)
            new = {k: v for k, v in types.items() if k.startswith(("vision_msgs/", "tf2_msgs/")) and k not in self.store.types}
            self.store.register(new)
        self.connections: dict[str, Any] = {}

    def __enter__(self) -> BagWriter:
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import StoragePlugin, Writer

        if self.first:
            self.writer: Any = Writer1(self.path)
        else:
            plugin = StoragePlugin.SQLITE3 if self.kind == "db3" else StoragePlugin.MCAP
            self.writer = Writer(self.path, version=9, storage_plugin=plugin)
        self.writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.writer.close()

    def make(self, name: str, **values: Any) -> Any:
        return self.store.types[name](**values)

    def header(self, time: float, frame: str) -> Any:
        nanoseconds = round(time * 1e9)
        stamp = self.make("builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        more = {"seq": 0} if self.first else {}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **more)

    def write(self, topic: str, name: str, message: Any, time: float) -> None:
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, name, typestore=self.store)
        data = self.store.serialize_ros1(message, name) if self.first else self.store.serialize_cdr(message, name)
        self.writer.write(self.connections[topic], round(time * 1e9), data)

    def image(self, topic: str, time: float, values: np.ndarray, encoding: str, frame: str = "camera") -> None:
        data = np.ascontiguousarray(values)
        step = data[0].nbytes
        padded = np.zeros((len(data), step + 3), np.uint8)  # rows may be longer than their pixels
        padded[:, :step] = data.view(np.uint8).reshape(len(data), step)
        message = self.make(
            "sensor_msgs/msg/Image",
            header=self.header(time, frame),
            height=data.shape[0],
            width=data.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=step + 3,
            data=padded.ravel(),
        )
        self.write(topic, "sensor_msgs/msg/Image", message, time)

    def compressed(self, topic: str, time: float, data: bytes, form: str) -> None:
        message = self.make(
            "sensor_msgs/msg/CompressedImage",
            header=self.header(time, "camera"),
            format=form,
            data=np.frombuffer(data, np.uint8),
        )
        self.write(topic, "sensor_msgs/msg/CompressedImage", message, time)

    def camera(self, topic: str, time: float, matrix: list[float], size: tuple[int, int], distortion: Iterable[float]) -> None:
        names = ("D", "K", "R", "P") if self.first else ("d", "k", "r", "p")
        fx, fy, cx, cy = matrix
        k = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0])
        p = np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1.0, 0])
        values = dict(zip(names, (np.array(list(distortion), float), k, np.eye(3).ravel(), p)))
        roi = self.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        message = self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(time, "camera"),
            height=size[1],
            width=size[0],
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=roi,
            **values,
        )
        self.write(topic, "sensor_msgs/msg/CameraInfo", message, time)

    def pose(self, T: np.ndarray) -> Any:
        q = matrix_to_quaternion(T[:3, :3])
        return self.make(
            "geometry_msgs/msg/Pose",
            position=self.make("geometry_msgs/msg/Point", x=T[0, 3], y=T[1, 3], z=T[2, 3]),
            orientation=self.make("geometry_msgs/msg/Quaternion", x=q[0], y=q[1], z=q[2], w=q[3]),
        )

    def odometry(self, topic: str, time: float, T: np.ndarray, child: str) -> None:
        zero = self.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        twist = self.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
        message = self.make(
            "nav_msgs/msg/Odometry",
            header=self.header(time, "odom"),
            child_frame_id=child,
            pose=self.make("geometry_msgs/msg/PoseWithCovariance", pose=self.pose(T), covariance=np.zeros(36)),
            twist=self.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )
        self.write(topic, "nav_msgs/msg/Odometry", message, time)

    def pose_stamped(self, topic: str, time: float, T: np.ndarray) -> None:
        message = self.make("geometry_msgs/msg/PoseStamped", header=self.header(time, "world"), pose=self.pose(T))
        self.write(topic, "geometry_msgs/msg/PoseStamped", message, time)

    def static(self, parent: str, child: str, T: np.ndarray) -> None:
        q = matrix_to_quaternion(T[:3, :3])
        moved = self.make(
            "geometry_msgs/msg/Transform",
            translation=self.make("geometry_msgs/msg/Vector3", x=T[0, 3], y=T[1, 3], z=T[2, 3]),
            rotation=self.make("geometry_msgs/msg/Quaternion", x=q[0], y=q[1], z=q[2], w=q[3]),
        )
        one = self.make(
            "geometry_msgs/msg/TransformStamped", header=self.header(1.0, parent), child_frame_id=child, transform=moved
        )
        self.write("/tf_static", "tf2_msgs/msg/TFMessage", self.make("tf2_msgs/msg/TFMessage", transforms=[one]), 1.0)


def path_of(folder: Path, kind: str) -> Path:
    """Where a bag of a kind is written."""
    return folder / ("drive.bag" if kind == "bag" else f"drive_{kind}")


FORWARD = make_pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([0.3, 0.0, 1.2]))
"""T_base_camera of a camera that looks ahead: x right, y down, z forward in x forward, y left, z up."""
