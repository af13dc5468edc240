"""Detections of bags: every version of vision_msgs, positions moved into the camera, odometry at their times."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nolbo_ppl.data.converters.ros_detections import odometry_at, read_bag_detections
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import make_pose, so3_exp, transform
from nolbo_ppl.io.ros_definitions import PARTS
from nolbo_ppl.io.ros_maps import write_map_mcap
from nolbo_ppl.io.trajectories import Trajectory
from nolbo_ppl.structures.landmark import Landmark
from tests.bags import FORWARD, BagWriter

pytest.importorskip("rosbags")

OLD = "\n".join(
    [
        "std_msgs/Header header\nvision_msgs/Detection2D[] detections",
        *(
            f"{'=' * 80}\nMSG: {name}\n{text}"
            for name, text in {
                "std_msgs/Header": PARTS["std_msgs/msg/Header"],
                "vision_msgs/Detection2D": (
                    "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox2D bbox\n"
                ),
                "vision_msgs/ObjectHypothesisWithPose": "string id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose\n",
                "vision_msgs/BoundingBox2D": "geometry_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n",
                "geometry_msgs/Pose2D": "float64 x\nfloat64 y\nfloat64 theta\n",
                "geometry_msgs/PoseWithCovariance": PARTS["geometry_msgs/msg/PoseWithCovariance"],
                "geometry_msgs/Pose": PARTS["geometry_msgs/msg/Pose"],
                "geometry_msgs/Point": PARTS["geometry_msgs/msg/Point"],
                "geometry_msgs/Quaternion": PARTS["geometry_msgs/msg/Quaternion"],
                "builtin_interfaces/Time": PARTS["builtin_interfaces/msg/Time"],
            }.items()
        ),
    ]
)
"""vision_msgs as ROS 2 Foxy has it: `id` and `score` stand in the hypothesis itself, centres are geometry_msgs/Pose2D."""


def posed(bag: BagWriter, T: np.ndarray, covariance: np.ndarray) -> Any:
    return bag.make("geometry_msgs/msg/PoseWithCovariance", pose=bag.pose(T), covariance=covariance.ravel())


@pytest.mark.parametrize("old", [False, True])
def test_boxes(tmp_path: Path, old: bool) -> None:
    path = tmp_path / "boxes"
    with BagWriter(path, "mcap", vision=OLD if old else None) as bag:
        for k in range(3):
            pose = posed(bag, np.eye(4), np.zeros((6, 6)))
            if old:
                make = "vision_msgs/msg/ObjectHypothesisWithPose"
                results = [bag.make(make, id=name, score=p, pose=pose) for name, p in (("cup", 0.2), ("stop sign", 0.7))]
                centre = bag.make("geometry_msgs/msg/Pose2D", x=100.0 + k, y=50.0, theta=0.0)
                more = {}
            else:
                results = [
                    bag.make(
                        "vision_msgs/msg/ObjectHypothesisWithPose",
                        hypothesis=bag.make("vision_msgs/msg/ObjectHypothesis", class_id=name, score=p),
                        pose=pose,
                    )
                    for name, p in (("cup", 0.2), ("stop sign", 0.7))
                ]
                point = bag.make("vision_msgs/msg/Point2D", x=100.0 + k, y=50.0)
                centre, more = bag.make("vision_msgs/msg/Pose2D", position=point, theta=0.0), {"id": "7"}
            box = bag.make("vision_msgs/msg/BoundingBox2D", center=centre, size_x=20.0, size_y=10.0)
            one = bag.make("vision_msgs/msg/Detection2D", header=bag.header(5.0 + k, "camera"), results=results, bbox=box, **more)
            message = bag.make(
                "vision_msgs/msg/Detection2DArray", header=bag.header(5.0 + k, "camera"), detections=[one] if k != 1 else []
            )
            bag.write("/detections", "vision_msgs/msg/Detection2DArray", message, 5.0 + k)
    seen = read_bag_detections(path)
    assert seen.times.tolist() == [5.0, 6.0, 7.0] and seen.found.frame.tolist() == [0, 2]
    np.testing.assert_allclose(seen.found.box, [[90, 45, 110, 55], [92, 45, 112, 55]])
    assert seen.found.category == ("stop_sign",) * 2 and seen.found.score.tolist() == [0.7, 0.7]
    assert np.isnan(seen.found.position).all()


def test_positions_are_moved_into_the_camera(tmp_path: Path) -> None:
    """A lidar detects in its own frame (x forward, z up); an identity for the orientation states none."""
    path, lidar = tmp_path / "lidar", make_pose(so3_exp(np.array([0.0, 0.0, 0.2])), np.array([0.0, 0.1, 1.7]))
    place, turn = np.array([8.0, 1.0, -0.8]), so3_exp(np.array([0.0, 0.0, 0.6]))
    C = np.diag([0.01, 0.02, 0.03, 0.1, 0.1, 0.1])
    with BagWriter(path, "db3") as bag:
        bag.static("base", "camera", FORWARD)
        bag.static("base", "lidar", lidar)
        bag.image("/image", 1.0, np.zeros((4, 4), np.uint8), "mono8")
        for k, R in enumerate((turn, np.eye(3))):
            T = make_pose(R, place)
            result = bag.make(
                "vision_msgs/msg/ObjectHypothesisWithPose",
                hypothesis=bag.make("vision_msgs/msg/ObjectHypothesis", class_id="car", score=0.9),
                pose=posed(bag, T, C),
            )
            size = bag.make("geometry_msgs/msg/Vector3", x=4.2, y=1.8, z=1.5)
            box = bag.make("vision_msgs/msg/BoundingBox3D", center=bag.pose(T), size=size)
            one = bag.make("vision_msgs/msg/Detection3D", header=bag.header(1.0 + k, "lidar"), results=[result], bbox=box, id="a")
            message = bag.make("vision_msgs/msg/Detection3DArray", header=bag.header(1.0 + k, "lidar"), detections=[one])
            bag.write("/cars", "vision_msgs/msg/Detection3DArray", message, 1.0 + k)
    found = read_bag_detections(f"{path}:/cars").found
    T_camera_lidar = np.linalg.inv(FORWARD) @ lidar
    np.testing.assert_allclose(found.position, np.tile(transform(T_camera_lidar, place), (2, 1)))
    assert found.size[0].tolist() == [1.8, 4.2, 1.5]
    R = T_camera_lidar[:3, :3]
    assert found.covariance is not None
    np.testing.assert_allclose(found.covariance[0], R @ C[:3, :3] @ R.T)
    np.testing.assert_allclose(found.rotation[0] @ [0, -1, 0], R @ turn @ [1, 0, 0], atol=1e-9)  # the front
    np.testing.assert_allclose(found.rotation[0] @ [0, 0, 1], R @ turn @ [0, 0, 1], atol=1e-9)
    assert np.isnan(found.rotation[1]).all()


def test_a_map_that_was_written_is_read_as_detections(tmp_path: Path) -> None:
    R = so3_exp(np.array([[0.3, 0.2, 0.1], [1.0, 0.0, -0.4]]))
    landmarks = [
        Landmark(
            f"L{k}", make_pose(R[k], np.array([k, 0.0, 4.0])), size=np.array([0.5, 0.7, 1.0]), class_posterior={"chair": 1.0}
        )
        for k in range(2)
    ]
    write_map_mcap(tmp_path / "map.mcap", Trajectory(np.tile(np.eye(4), (3, 1, 1))), landmarks)
    found = read_bag_detections(tmp_path / "map.mcap").found
    np.testing.assert_allclose(found.rotation[:2], R, atol=1e-9)
    np.testing.assert_allclose(found.size[:2], np.tile([0.5, 0.7, 1.0], (2, 1)))
    np.testing.assert_allclose(found.position[:2, 2], 4.0)


def test_odometry_at_the_times_of_detections(tmp_path: Path) -> None:
    rows = [f"{10 + k} {k} 0 0 0 0 0 1" for k in range(4)]
    (tmp_path / "odometry.txt").write_text("\n".join(rows) + "\n")
    trajectory, known = odometry_at(tmp_path / "odometry.txt", np.array([9.0, 10.25, 12.5, 13.5]))
    assert known.tolist() == [False, True, True, False]
    np.testing.assert_allclose(trajectory.T_world_camera[:, 0, 3], [0.25, 2.5])
    with pytest.raises(InputError, match="odometry has no time of the detections"):
        odometry_at(tmp_path / "odometry.txt", np.array([1.0]))
