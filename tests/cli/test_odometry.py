"""`nolbo odometry`: files in and out, the sources of scale, and options that do not fit together."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from nolbo_ppl.cli.odometry import main
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import make_pose
from nolbo_ppl.io.trajectories import Trajectory, read_trajectory, write_trajectory
from nolbo_ppl.odometry import lengths_of

FOCAL, SIZE = 150.0, 160
COUNT = 6


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two textured walls across the optical axis, one before the other, seen by a camera that moves sideways and on."""
    out = tmp_path_factory.mktemp("drive")
    rng = np.random.default_rng(0)
    position = np.column_stack([0.3 * np.arange(COUNT), np.zeros(COUNT), 0.05 * np.arange(COUNT) ** 1.5])
    walls = []
    for _ in range(2):
        wall = cv2.resize(rng.uniform(0, 255, (90, 90)).astype(np.float32), (900, 900), interpolation=cv2.INTER_CUBIC)
        walls.append(np.clip(wall, 0, 255))
    (out / "images").mkdir()
    for k, at in enumerate(position):
        image = np.zeros((SIZE, SIZE), np.float32)
        for wall, depth, rows in ((walls[0], 8.0, slice(None)), (walls[1], 4.0, slice(SIZE // 2, None))):
            # Texels of a wall at this depth to pixels: 100 texels a metre, its centre on the first camera's axis.
            scale = FOCAL / (depth - at[2]) / 100.0
            shift = [SIZE / 2 - scale * 450 - FOCAL * at[0] / (depth - at[2]), SIZE / 2 - scale * 450]
            view = cv2.warpAffine(
                wall, np.array([[scale, 0, shift[0]], [0, scale, shift[1]]]), (SIZE, SIZE), flags=cv2.INTER_AREA
            )
            image[rows] = view[rows]
        Image.fromarray(image.astype(np.uint8)).save(out / "images" / f"{k:03d}.png")
    (out / "intrinsics.json").write_text(json.dumps({"fx": FOCAL, "fy": FOCAL, "cx": SIZE / 2, "cy": SIZE / 2}))
    truth = make_pose(np.broadcast_to(np.eye(3), (COUNT, 3, 3)), position)
    write_trajectory(out / "truth.txt", Trajectory(truth))
    write_trajectory(out / "tum.txt", Trajectory(truth, 5.0 + 0.1 * np.arange(COUNT), "tum"))
    (out / "wheel.txt").write_text("".join(f"{length}\n" for length in lengths_of(truth)))
    return out


def arguments(drive: Path, out: Path, *more: object) -> list[str]:
    words = ["--images", drive / "images", "--intrinsics", drive / "intrinsics.json", "--out", out, *more]
    return [str(word) for word in words]


def test_every_file_is_written(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(arguments(drive, tmp_path, "--scale", "truth", "--truth", drive / "truth.txt", "--config.patch", 11))
    assert "ATE" in capsys.readouterr().out
    assert sorted(p.name for p in tmp_path.iterdir()) == ["odometry.json", "odometry.txt", "odometry_covariance.npz"]
    found = read_trajectory(tmp_path / "odometry.txt")
    truth = read_trajectory(drive / "truth.txt").T_world_camera
    assert found.format == "kitti" and len(found) == COUNT
    assert np.linalg.norm(found.T_world_camera[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.1
    with np.load(tmp_path / "odometry_covariance.npz", allow_pickle=False) as stored:
        assert stored["covariance"].shape == (COUNT - 1, 6, 6) and stored["flags"].shape == (COUNT - 1,)
        assert (np.linalg.eigvalsh(stored["covariance"]) > 0).all()
    report = json.loads((tmp_path / "odometry.json").read_text())
    assert report["frames"] == COUNT and report["config"]["detector"] == "orb" and report["options"]["scale"] == "truth"
    assert report["ate"] < 0.1 and report["flags"] == {
        "FEW_MATCHES": 0,
        "STILL": 0,
        "ROTATION": 0,
        "NO_SCALE": 0,
        "TWIN": 0,
        "WEAK": 0,
    }


def test_a_wheel_file_and_a_part_of_the_frames(drive: Path, tmp_path: Path) -> None:
    lengths = np.loadtxt(drive / "wheel.txt")
    main(arguments(drive, tmp_path, "--scale", "file", "--lengths", drive / "wheel.txt", "--first", 2, "--count", 3))
    found = read_trajectory(tmp_path / "odometry.txt")
    np.testing.assert_allclose(lengths_of(found.T_world_camera), lengths[2:4], rtol=1e-6)
    assert "ate" not in json.loads((tmp_path / "odometry.json").read_text())


def test_depth_pictures_give_metres(drive: Path, tmp_path: Path) -> None:
    """Millimetres of the two walls beside the images; with the wrong unit all lengths are wrong by its factor."""
    truth = read_trajectory(drive / "truth.txt").T_world_camera
    (tmp_path / "depth").mkdir()
    for k in range(COUNT):
        walls = np.full((SIZE, SIZE), 8.0 - truth[k, 2, 3])
        walls[SIZE // 2 :] -= 4.0
        Image.fromarray(np.round(1000 * walls).astype(np.uint16)).save(tmp_path / "depth" / f"{k:03d}.png")
    more = ["--depth", tmp_path / "depth", "--depth-unit", 0.001, "--truth", drive / "truth.txt", "--config.patch", 11]
    main(arguments(drive, tmp_path / "out", *more))
    report = json.loads((tmp_path / "out" / "odometry.json").read_text())
    assert report["ate"] < 0.03 and report["flags"]["NO_SCALE"] == 0
    assert report["path_length"] == pytest.approx(report["true_path_length"], rel=0.03)
    main(arguments(drive, tmp_path / "twice", "--scale", "depth", "--depth", tmp_path / "depth", "--depth-unit", 0.002))
    twice = json.loads((tmp_path / "twice" / "odometry.json").read_text())
    assert twice["path_length"] == pytest.approx(2 * report["path_length"], rel=0.05)


def test_truth_by_time(drive: Path, tmp_path: Path) -> None:
    (drive / "times.txt").write_text("".join(f"{5.0 + 0.1 * k}\n" for k in range(COUNT)))
    truth = read_trajectory(drive / "tum.txt")
    longer = Trajectory(np.concatenate([truth.T_world_camera, truth.T_world_camera[-1:]]), np.append(truth.times, 9.0), "tum")
    write_trajectory(tmp_path / "longer.txt", longer)
    main(arguments(drive, tmp_path, "--scale", "truth", "--truth", tmp_path / "longer.txt"))
    assert (tmp_path / "times.txt").read_text().split()[0] == "5.0"
    write_trajectory(tmp_path / "late.txt", Trajectory(longer.T_world_camera, longer.times + 50.0, "tum"))  # type: ignore[operator]
    with pytest.raises(InputError, match="truth has no time of the frames"):
        main(arguments(drive, tmp_path, "--scale", "truth", "--truth", tmp_path / "late.txt"))
    (drive / "times.txt").unlink()


@pytest.mark.parametrize(
    ("more", "match"),
    [
        (["--scale", "truth"], "--scale truth without a trajectory; give --truth FILE"),
        (["--scale", "file"], "--scale file without lengths"),
        (["--scale", "depth"], "--scale depth without depth images"),
        (["--depth", "no-such-folder"], "no such folder"),
        (["--scale", "depth", "--depth", "no-such-folder", "--depth-unit", "0"], "--depth-unit: got 0"),
        (["--scale", "ground"], "--scale ground without the height of the camera"),
        (["--scale", "ground", "--camera-height", "-1"], "height of the camera: got -1"),
        (["--scale", "ground", "--camera-height", "1", "--first", "9"], "frames asked for"),
        (["--scale", "ground", "--camera-height", "1", "--count", "7"], "frames asked for"),
    ],
)
def test_options_that_do_not_fit(drive: Path, tmp_path: Path, more: list[str], match: str) -> None:
    with pytest.raises(InputError, match=match):
        main(arguments(drive, tmp_path / "out", *more))
    assert not (tmp_path / "out").exists()


def test_lengths_and_truth_of_another_sequence(drive: Path, tmp_path: Path) -> None:
    (tmp_path / "wheel.txt").write_text("1\n1\n")
    with pytest.raises(InputError, match=r"wheel\.txt: lengths do not match the frames: got 2 lengths, expected 5"):
        main(arguments(drive, tmp_path, "--scale", "file", "--lengths", tmp_path / "wheel.txt"))
    write_trajectory(tmp_path / "truth.txt", Trajectory(np.tile(np.eye(4), (3, 1, 1))))
    with pytest.raises(InputError, match=r"truth\.txt: truth does not match the frames row by row: got 3 rows, expected 6"):
        main(arguments(drive, tmp_path, "--scale", "truth", "--truth", tmp_path / "truth.txt"))
