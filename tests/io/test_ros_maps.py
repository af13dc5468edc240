"""Maps as MCAP: what is written is what another reader of bags finds, its own types and all."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.geometry.pose import make_pose, quaternion_to_matrix, so3_exp
from nolbo_ppl.io.ros_bags import Bag
from nolbo_ppl.io.ros_maps import R_UPRIGHT_WORLD, write_map_mcap
from nolbo_ppl.io.trajectories import Trajectory, read_trajectory
from nolbo_ppl.structures.landmark import Landmark

pytest.importorskip("rosbags")


def drive() -> tuple[Trajectory, list[Landmark], np.ndarray]:
    rng = np.random.default_rng(0)
    T = make_pose(so3_exp(0.1 * rng.standard_normal((5, 3))), rng.standard_normal((5, 3)))
    A = 0.1 * rng.standard_normal((6, 6))
    landmarks = [
        Landmark(
            "L0",
            make_pose(so3_exp(np.array([0.3, 0.2, 0.1])), np.array([1.0, -0.5, 4.0])),
            covariance=A @ A.T + 0.01 * np.eye(6),
            position_covariance=np.diag([0.01, 0.04, 0.09]),
            oriented=True,
            existence=0.9,
            class_posterior={"chair": 0.8, "table": 0.2},
            size=np.array([0.5, 0.6, 0.9]),
        ),
        Landmark("L1", make_pose(np.eye(3), np.array([0.0, 0.0, 9.0])), existence=0.1),
        Landmark("L2", make_pose(np.eye(3), np.array([2.0, 0.0, 3.0]))),
    ]
    return Trajectory(T, 1000.0 + 0.5 * np.arange(5)), landmarks, T @ make_pose(np.eye(3), np.array([0.1, 0.0, 0.0]))


def test_what_is_written_is_read_by_its_own_types(tmp_path: Path) -> None:
    """AnyReader knows nothing but the definitions in the file: the schemas are complete."""
    from rosbags.highlevel import AnyReader

    trajectory, landmarks, odometry = drive()
    path = tmp_path / "map.mcap"
    write_map_mcap(path, trajectory, landmarks, odometry)
    assert [entry.name for entry in tmp_path.iterdir()] == ["map.mcap"]
    found: dict[str, list] = {}
    with AnyReader([path]) as reader:
        for connection, time, data in reader.messages():
            found.setdefault(connection.topic, []).append((time, reader.deserialize(data, connection.msgtype)))
    assert {topic: len(rows) for topic, rows in found.items()} == {
        "/tf_static": 2,
        "/tf": 5,
        "/nolbo/trajectory": 2,
        "/nolbo/odometry": 2,
        "/nolbo/landmarks": 2,
        "/nolbo/objects": 2,
    }
    T = trajectory.T_world_camera
    for topic, expected in (("/nolbo/trajectory", T), ("/nolbo/odometry", odometry)):
        poses = found[topic][1][1].poses
        positions = [[p.pose.position.x, p.pose.position.y, p.pose.position.z] for p in poses]
        np.testing.assert_allclose(positions, expected[:, :3, 3])
        q = np.array([[getattr(p.pose.orientation, name) for name in "xyzw"] for p in poses])
        np.testing.assert_allclose(quaternion_to_matrix(q), expected[:, :3, :3], atol=1e-9)
    objects = found["/nolbo/objects"][0][1].detections
    assert [one.id for one in objects] == ["L0", "L2"]  # L1 is more likely background
    best = objects[0].results[0]
    assert best.hypothesis.class_id == "chair" and best.hypothesis.score == pytest.approx(0.72)
    covariance = best.pose.covariance.reshape(6, 6)
    np.testing.assert_allclose(covariance[:3, :3], landmarks[0].position_covariance)
    R = landmarks[0].T_world_object[:3, :3]
    np.testing.assert_allclose(covariance[3:, 3:], R @ landmarks[0].covariance[:3, :3] @ R.T)
    markers = found["/nolbo/landmarks"][0][1].markers
    assert {(m.ns, m.id) for m in markers} == {("box", 0), ("name", 0), ("one standard deviation", 0), ("box", 1), ("name", 1)}
    sphere = next(m for m in markers if m.type == 2)
    np.testing.assert_allclose(sorted([sphere.scale.x, sphere.scale.y, sphere.scale.z]), [0.2, 0.4, 0.6])
    up = R_UPRIGHT_WORLD @ [0.0, -1.0, 0.0]
    np.testing.assert_allclose(up, [0, 0, 1])


def test_it_is_read_back_as_a_trajectory_and_as_objects(tmp_path: Path) -> None:
    trajectory, landmarks, _ = drive()
    write_map_mcap(tmp_path / "map.mcap", trajectory, landmarks)
    with Bag(tmp_path / "map.mcap") as bag:
        assert [topic.name for topic in bag.of_types(["nav_msgs/msg/Path"])] == ["/nolbo/trajectory"]
    with pytest.raises(ValueError, match="no topic of poses"):
        read_trajectory(tmp_path / "map.mcap")


def test_rows_without_times_are_a_tenth_of_a_second_apart(tmp_path: Path) -> None:
    trajectory, landmarks, _ = drive()
    write_map_mcap(tmp_path / "map.mcap", Trajectory(trajectory.T_world_camera), landmarks)
    with Bag(tmp_path / "map.mcap") as bag:
        times = [time for time, _ in bag.raw("/tf")]
    assert times == [100_000_000 * k for k in range(1, 6)]
