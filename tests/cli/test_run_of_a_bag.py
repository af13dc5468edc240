"""`nolbo run`, `observe` and `odometry` of a ROS bag, without ROS: the same as of the folder of its images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nolbo_ppl.cli import main
from nolbo_ppl.geometry.pose import make_pose
from nolbo_ppl.io.files import read_json
from nolbo_ppl.io.ros_bags import Bag
from nolbo_ppl.io.trajectories import read_trajectory
from nolbo_ppl.pipeline.mapping_pipeline import run_pipeline
from nolbo_ppl.pipeline.run_config import RunConfig
from tests.bags import FORWARD, BagWriter

pytest.importorskip("rosbags")
SIZE = (96, 64)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five pictures at 10 Hz, odometry of the body at 10 Hz between them, as a bag and as files."""
    folder = tmp_path_factory.mktemp("drive")
    (folder / "images").mkdir()
    T = make_pose(np.tile(np.eye(3), (7, 1, 1)), np.column_stack([np.zeros((7, 2)), 0.1 * np.arange(-1, 6)]))
    with BagWriter(folder / "bag", "mcap") as bag:
        bag.static("base", "camera", FORWARD)
        for k in range(7):
            bag.odometry("/odom", 10.0 + 0.1 * (k - 1) + 0.05, T[k] @ np.linalg.inv(FORWARD), "base")
        for k in range(5):
            picture = np.full((SIZE[1], SIZE[0], 3), (120, 130, 140 + k), np.uint8)  # a wall
            Image.fromarray(picture).save(folder / "images" / f"{k}.png")
            bag.camera("/camera/camera_info", 10.0 + 0.1 * k, [80.0, 80.0, 48.0, 32.0], SIZE, [0.0] * 5)
            bag.image("/camera/image", 10.0 + 0.1 * k, picture, "rgb8")
    (folder / "camera.txt").write_text("80 80 48 32\n")
    rows = [" ".join(map(str, [10 + 0.1 * k, 0, 0, 0.1 * k - 0.05, 0, 0, 0, 1])) for k in range(5)]
    (folder / "odometry.txt").write_text("\n".join(rows) + "\n")
    return folder


def test_a_run_of_a_bag_is_that_of_its_images(drive: Path, tmp_path: Path) -> None:
    same = {"test_sizes": (96,), "report": False, "score_threshold": 0.6}
    bag = drive / "bag"
    config = RunConfig(bag, tmp_path / "bag", topic="/camera/image", odometry=Path(f"{bag}:/odom"), mcap=True, **same)
    of_bag = run_pipeline(config)
    files = RunConfig(
        drive / "images", tmp_path / "files", intrinsics=drive / "camera.txt", odometry=drive / "odometry.txt", **same
    )
    of_files = run_pipeline(files)
    assert of_bag["frames"] == of_files["frames"] == 5 and of_bag["observations"] == of_files["observations"]
    assert of_bag["remarks"] == ["the camera is that of /camera/camera_info"]
    read = [read_trajectory(tmp_path / name / "odometry.txt").T_world_camera for name in ("bag", "files")]
    np.testing.assert_allclose(read[0], read[1], atol=1e-6)
    first, second = ((tmp_path / name / "intrinsics.json") for name in ("bag", "files"))
    assert read_json(first) == read_json(second)
    with Bag(tmp_path / "bag" / "map.mcap") as written:
        assert {"/nolbo/trajectory", "/nolbo/objects", "/tf"} <= set(written.topics)
    assert run_pipeline(config) == of_bag  # nothing is done again


def test_observe_and_odometry(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    common = ["--images", f"{drive / 'bag'}:/camera/image"]
    main(["observe", *common, "--out", str(tmp_path / "seen"), "--model", "tiny", "--size", "96"])
    assert "in 5 images" in capsys.readouterr().out
    assert len(list((tmp_path / "seen").glob("camera_image#*.png"))) == 5
    main(["odometry", *common, "--out", str(tmp_path / "vo"), "--scale", "ground", "--camera-height", "1.5"])
    assert "the camera is that of /camera/camera_info" in capsys.readouterr().out
    assert len(read_trajectory(tmp_path / "vo" / "odometry.txt")) == 5


def test_a_topic_of_a_folder_is_refused(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["observe", "--images", str(drive / "images"), "--topic", "/image", "--out", str(tmp_path / "seen")])
    assert end.value.code == 2 and "--topic: got /image, expected a bag of ROS" in capsys.readouterr().err
