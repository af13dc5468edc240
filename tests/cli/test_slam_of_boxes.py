"""`nolbo slam` of boxes alone, in JSON Lines and in a bag: objects land where they are, what is left out is said."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.cli import main
from nolbo_ppl.geometry.pose import inverse, make_pose, transform
from nolbo_ppl.io.landmarks import read_landmarks
from nolbo_ppl.io.trajectories import Trajectory, write_trajectory
from tests.bags import BagWriter

CAMERA = np.array([320.0, 320.0, 320.0, 240.0])
PLACES = np.array([[-2.0, 0.3, 8.0], [2.5, 0.2, 9.0], [-3.0, 0.4, 13.0], [3.0, 0.1, 14.0], [1.0, 0.3, 16.0]])
SMALL = ["--config.hypotheses", "1", "--config.em-iterations", "1"]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[list[list[float]]]]:
    """A camera that moves to the right and ahead past five posts, 0.8 m tall, seen with a pixel of noise."""
    folder, rng = tmp_path_factory.mktemp("boxes"), np.random.default_rng(0)
    way = np.zeros((20, 3))
    way[:, 0], way[:, 2] = np.linspace(-1.5, 1.5, 20), np.linspace(0, 1.0, 20)
    T = make_pose(np.tile(np.eye(3), (20, 1, 1)), way)
    write_trajectory(folder / "odometry.txt", Trajectory(T, 50 + 0.1 * np.arange(20), "tum"))
    (folder / "camera.json").write_text(json.dumps({**dict(zip(("fx", "fy", "cx", "cy"), CAMERA)), "width": 640, "height": 480}))
    frames = []
    for pose in T:
        local = transform(inverse(pose), PLACES)
        centre = local[:, :2] / local[:, 2:] * CAMERA[:2] + CAMERA[2:] + rng.standard_normal((5, 2))
        half = np.array([0.2, 0.4]) / local[:, 2:] * CAMERA[:2]
        frames.append(np.concatenate([centre - half, centre + half], axis=1).tolist())
    lines = [
        json.dumps({"frame": t, "box": box, "category": f"post{k}", "score": 0.9}) + "\n"
        for t, boxes in enumerate(frames)
        for k, box in enumerate(boxes)
    ]
    (folder / "boxes.jsonl").write_text("".join(lines) + '{"frame": 3, "box": [300, 10, 320, 30], "category": "post0"}\n')
    return folder, frames


def check(out: Path) -> None:
    landmarks = read_landmarks(out / "landmarks.json")
    assert len(landmarks) == 5
    for one in landmarks:
        gap = PLACES - one.position
        nearest = gap[np.argmin(np.linalg.norm(gap, axis=1))]
        assert np.linalg.norm(nearest) < 0.8
        assert nearest @ np.linalg.solve(one.position_covariance, nearest) < 20


@pytest.mark.parametrize("online", [False, True])
def test_lines_of_boxes(online: bool, drive: tuple[Path, list], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, _ = drive
    common = ["slam", "--odometry", str(folder / "odometry.txt"), "--observations", str(folder / "boxes.jsonl")]
    with pytest.raises(SystemExit) as end:
        main([*common, "--out", str(tmp_path / "map")])
    assert end.value.code == 2 and "boxes alone need a camera: expected positions, or --intrinsics" in capsys.readouterr().err
    (tmp_path / "heights.json").write_text('{"post0": [0.8, 0.05]}')
    more = ["--intrinsics", str(folder / "camera.json"), "--heights", str(tmp_path / "heights.json")]
    main([*common, *more, "--out", str(tmp_path / "map"), *SMALL, *(["--online"] if online else [])])
    said = capsys.readouterr().out
    assert (": 1 seen too rarely" in said) != online and "of 101 boxes placed" in said
    check(tmp_path / "map")


def test_boxes_of_a_bag(drive: tuple[Path, list], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rosbags")
    folder, frames = drive
    with BagWriter(tmp_path / "bag", "db3") as bag:
        for t, boxes in enumerate([*frames, frames[-1]]):
            time = 50 + 0.1 * t
            found = []
            for k, (x0, y0, x1, y1) in enumerate(boxes):
                point = bag.make("vision_msgs/msg/Point2D", x=(x0 + x1) / 2, y=(y0 + y1) / 2)
                centre = bag.make("vision_msgs/msg/Pose2D", position=point, theta=0.0)
                box = bag.make("vision_msgs/msg/BoundingBox2D", center=centre, size_x=x1 - x0, size_y=y1 - y0)
                kind = bag.make("vision_msgs/msg/ObjectHypothesis", class_id=f"post{k}", score=0.9)
                pose = bag.make("geometry_msgs/msg/PoseWithCovariance", pose=bag.pose(np.eye(4)), covariance=np.zeros(36))
                results = [bag.make("vision_msgs/msg/ObjectHypothesisWithPose", hypothesis=kind, pose=pose)]
                header = bag.header(time, "camera")
                found.append(bag.make("vision_msgs/msg/Detection2D", header=header, results=results, bbox=box, id=""))
            message = bag.make("vision_msgs/msg/Detection2DArray", header=bag.header(time, "camera"), detections=found)
            bag.write("/boxes", "vision_msgs/msg/Detection2DArray", message, time)
            bag.camera("/camera_info", time, CAMERA.tolist(), (640, 480), [0.0] * 5)
    observations, camera = f"{tmp_path / 'bag'}:/boxes", f"{tmp_path / 'bag'}:/camera_info"
    files = ["--odometry", str(folder / "odometry.txt"), "--observations", observations, "--intrinsics", camera]
    main(["slam", *files, "--out", str(tmp_path / "map"), *SMALL])
    assert "1 of 21 frames lie outside of the odometry's times" in capsys.readouterr().out
    check(tmp_path / "map")
