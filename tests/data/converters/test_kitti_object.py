"""KITTI street images as scenes: geometry by hand, by projection, and on real labels."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nolbo_ppl.cli.convert import main
from nolbo_ppl.data.converters.kitti_object import (
    CAMERAS,
    IGNORED,
    KittiLabel,
    convert_kitti_drive,
    convert_kitti_object,
    likeliest_camera,
    projected_box,
    read_calibration,
    read_object_labels,
    read_track_labels,
    scene_box,
)
from nolbo_ppl.data.converters.kitti_tracking import read_labels
from nolbo_ppl.data.dataset_folder import SceneFolder
from nolbo_ppl.errors import InputError
from nolbo_ppl.evaluation.labelled_scenes import FolderScenes

CAR = "Car 0.25 1 1.57 100.00 50.00 199.00 119.00 1.50 1.70 4.00 2.00 1.60 10.00 {ry}"
REGION = "DontCare -1 -1 -10 10.00 20.00 30.00 40.00 -1 -1 -1 -1000 -1000 -1000 -10"
CALIB = "P0: 1 0 0 0 0 1 0 0 0 0 1 0\nP2: 200 0 99.5 8 0 210 59.5 0 0 0 1 0.02\n"


def made_folder(tmp_path: Path, label: str, calib: str | None = CALIB) -> Path:
    for name in ("image_2", "label_2", "calib"):
        (tmp_path / "kitti" / name).mkdir(parents=True)
    Image.fromarray(np.zeros((120, 200, 3), dtype=np.uint8)).save(tmp_path / "kitti" / "image_2" / "000001.png")
    (tmp_path / "kitti" / "label_2" / "000001.txt").write_text(label)
    if calib is not None:
        (tmp_path / "kitti" / "calib" / "000001.txt").write_text(calib)
    return tmp_path / "kitti"


def converted(tmp_path: Path, label: str, calib: str | None = CALIB) -> dict:
    convert_kitti_object(made_folder(tmp_path, label, calib), tmp_path / "out")
    (line,) = (tmp_path / "out" / "scenes.jsonl").read_text().splitlines()
    return json.loads(line)


def test_a_car_by_hand(tmp_path: Path) -> None:
    """KITTI names the underside's middle in camera 0; the scene wants the box's centre in camera 2."""
    row = converted(tmp_path, CAR.format(ry="0.00"))
    assert row["intrinsics"] == [200.0, 210.0, 100.0, 60.0]
    (car,) = row["objects"]
    t = [(8 - 99.5 * 0.02) / 200, (0 - 59.5 * 0.02) / 210, 0.02]  # K^-1 times the fourth column
    assert car["position"] == pytest.approx([2 + t[0], 1.6 - 0.75 + t[1], 10 + t[2]], abs=1e-6)
    assert car["dimensions"] == [1.7, 4.0, 1.5] and car["size"] == pytest.approx(math.sqrt(1.7**2 + 16 + 1.5**2))
    assert car["box"] == [100.5, 50.5, 199.5, 119.5]
    assert car["visibility"] == pytest.approx(0.75 * 0.75)
    assert car["category"] == "car" and car["symmetry"] == 1


def test_frames_of_a_drive(tmp_path: Path) -> None:
    """Each frame has the labels that name its number, the same as an image of its own; a frame nobody labelled has none."""
    one = converted(tmp_path, CAR.format(ry="0.30"))
    drive = tmp_path / "drive"
    (drive / "frames").mkdir(parents=True)
    for number in range(3):
        Image.fromarray(np.full((120, 200, 3), number, dtype=np.uint8)).save(drive / "frames" / f"{number:010d}.png")
    (drive / "0000.txt").write_text(f"1 7 {CAR.format(ry='0.30')}\n0 -1 {REGION}\n")
    (drive / "calib.txt").write_text(CALIB)
    options = ["--images", str(drive / "frames"), "--labels", str(drive / "0000.txt"), "--calib", str(drive / "calib.txt")]
    main(["kitti-drive", *options, "--out", str(tmp_path / "scenes")])
    rows = [json.loads(line) for line in (tmp_path / "scenes" / "scenes.jsonl").read_text().splitlines()]
    assert [len(row["objects"]) for row in rows] == [0, 1, 0] and [len(row["ignore"]) for row in rows] == [1, 0, 0]
    assert rows[1]["objects"] == one["objects"] and rows[1]["intrinsics"] == one["intrinsics"]
    assert len(SceneFolder(tmp_path / "scenes")) == 3
    (drive / "0000.txt").write_text(f"3 7 {CAR.format(ry='0.30')}\n")
    with pytest.raises(InputError, match="labels of a drive"):
        convert_kitti_drive(drive / "frames", drive / "0000.txt", drive / "calib.txt", tmp_path / "again")


@pytest.mark.parametrize(("rotation_y", "front"), [(0.0, [1, 0, 0]), (-math.pi / 2, [0, 0, 1]), (math.pi / 2, [0, 0, -1])])
def test_the_front_faces_where_rotation_y_says(tmp_path: Path, rotation_y: float, front: list[float]) -> None:
    """rotation_y 0 drives along the camera's x, -pi/2 away from the camera; the object's front is -y, its up z."""
    converted(tmp_path, CAR.format(ry=rotation_y))
    scene = FolderScenes(SceneFolder(tmp_path / "out"), 1)[0]
    R = scene.R_camera_object[0]
    np.testing.assert_allclose(R @ [0, -1, 0], front, atol=1e-8)
    np.testing.assert_allclose(R @ [0, 0, 1], [0, -1, 0], atol=1e-8)
    assert scene.diagonal[0] == pytest.approx(math.sqrt(1.7**2 + 16 + 1.5**2), abs=1e-5)


def test_regions_people_and_what_is_behind(tmp_path: Path) -> None:
    kinds = ("Van", "Truck", "Tram", "Cyclist", "Misc", "Pedestrian", "Person_sitting")
    others = [CAR.format(ry="0").replace("Car", kind) for kind in kinds]
    behind = CAR.format(ry="0").replace("10.00 0", "-3.00 0")
    row = converted(tmp_path, "\n".join([REGION, *others, behind, ""]))
    assert row["objects"] == []
    # The region, everything that resembles a category, and the car without a position; no person.
    assert len(row["ignore"]) == 1 + 5 + 1
    assert row["ignore"][0] == [10.5, 20.5, 30.5, 40.5]
    assert set(kinds) - set(IGNORED) == {"Pedestrian", "Person_sitting"}


def test_boxes_are_cut_to_the_image() -> None:
    assert scene_box(np.array([-3.0, 10, 250, 30]), 200, 120) == [0.0, 10.5, 200.0, 30.5]
    assert scene_box(np.array([201.0, 10, 250, 30]), 200, 120) is None


def test_the_camera_is_told_by_the_labels() -> None:
    """Boxes projected by one day's camera, with errors of a pixel, tell that day."""
    rng = np.random.default_rng(0)
    for day, camera in CAMERAS.items():
        labels = []
        for x, z, turn in ((-8, 20, 0.3), (4, 12, 1.5), (1, 35, -1.5), (9, 28, 3.0)):
            label = KittiLabel("Car", 0.0, 0, np.zeros(4), np.array([1.5, 1.7, 4.0]), np.array([x, 1.65, z]), turn)
            box = projected_box(label, camera) - 0.5 + rng.normal(size=4) * 0.5
            labels.append(KittiLabel("Car", 0.0, 0, box, label.dimensions, label.bottom, turn))
        best, residual = likeliest_camera(labels)
        assert best == day and residual < 2.0
    assert likeliest_camera([])[1] == math.inf


def test_an_image_without_calibration(tmp_path: Path) -> None:
    """The label's box is not one any camera gives, yet the image is usable; one without a vehicle is too."""
    row = converted(tmp_path, REGION, calib=None)
    assert row["intrinsics"] == CAMERAS["2011_09_26"].intrinsics.tolist()
    source = json.loads((tmp_path / "out" / "source.json").read_text())
    assert source["calibration"] == {"000001.png": "2011_09_26, assumed: no vehicle tells"}


@pytest.mark.parametrize(
    ("label", "calib", "message"),
    [
        ("Car 1 2 3", CALIB, r"000001\.txt:1: not a label"),
        (REGION + "\n" + CAR.format(ry="nan"), CALIB, r"000001\.txt:2: not a label"),
        (REGION, "P0: 1\n", r"no projection of camera 2"),
        (REGION, "P2: 1 2 3\n", r"not a projection"),
        (REGION, CALIB.replace("200", "-200"), r"not a projection"),
        (REGION, CALIB.replace("0 0 1 0.02", "0 0 0 0.02"), r"not a projection"),
    ],
)
def test_errors(tmp_path: Path, label: str, calib: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        converted(tmp_path, label, calib)
    assert not (tmp_path / "out").exists()


def test_missing_folders(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="images of KITTI not found"):
        convert_kitti_object(tmp_path, tmp_path / "out")
    folder = made_folder(tmp_path, REGION)
    (folder / "image_2" / "000001.png").unlink()
    with pytest.raises(InputError, match="no image"):
        convert_kitti_object(folder, tmp_path / "out")


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = made_folder(tmp_path, CAR.format(ry="0") + "\n" + REGION)
    main(["kitti-object", "--data", str(folder), "--out", str(tmp_path / "out")])
    assert "1 images, 1 cars, 1 regions to ignore written to" in capsys.readouterr().out


def test_real_boxes_project_onto_each_other(data_dir: Path, tmp_path: Path) -> None:
    """Whole real cars: the projected 3D box is the labelled image box, whichever way the camera was found."""
    data = data_dir / "kitti_object"
    if not data.is_dir():
        pytest.skip("kitti_object is not among the real data")
    counts = convert_kitti_object(data, tmp_path)
    scenes = FolderScenes(SceneFolder(tmp_path), 10_000)
    assert len(scenes) == counts["images"] == len(list((data / "image_2").iterdir()))
    assert sum(len(scenes[i].box) for i in range(len(scenes))) == counts["objects"] > 0
    cameras = json.loads((tmp_path / "source.json").read_text())["calibration"]
    off = []
    for name, source in cameras.items():
        labels = read_object_labels(data / "label_2" / f"{Path(name).stem}.txt")
        own = source == "its own"
        camera = read_calibration(data / "calib" / f"{Path(name).stem}.txt") if own else CAMERAS[source.split(",")[0]]
        off += [
            np.abs(projected_box(label, camera) - label.box - 0.5).max()
            for label in labels
            if label.kind == "Car" and label.truncated == 0
        ]
    assert np.median(off) < 1.5 and np.max(off) < 5.0


@pytest.mark.parametrize(
    ("ignore", "message"),
    [
        ('{"a": 1}', r"scenes\.jsonl:1: ignore: got \{'a': 1\}, expected a list of boxes"),
        ("[[1, 2, 3]]", r"scenes\.jsonl:1: ignore\[0\]\.box"),
        ("[[0, 0, 20, 20], [5, 5, 4, 20]]", r"ignore\[1\]\.box.*x0 < x1"),
        ("[[0, 0, 900, 20]]", r"ignore\[0\]\.box.*inside the image of 200 x 120 px"),
    ],
)
def test_regions_to_ignore_are_checked(tmp_path: Path, ignore: str, message: str) -> None:
    converted(tmp_path, REGION)
    file = tmp_path / "out" / "scenes.jsonl"
    row = {**json.loads(file.read_text()), "ignore": "HERE"}
    file.write_text(json.dumps(row).replace('"HERE"', ignore))
    with pytest.raises(InputError, match=message):
        SceneFolder(tmp_path / "out")
    file.write_text(json.dumps({**row, "ignore": None}))
    assert SceneFolder(tmp_path / "out").records[0].ignore.shape == (0, 4)


def test_labels_of_a_drive_by_track(tmp_path: Path) -> None:
    """Frame and track before the label; frames without one are empty; what is wrong is named with file and line."""
    file = tmp_path / "0000.txt"
    file.write_text(f"0 -1 {REGION}\n2 3 {CAR.format(ry='0.5')}\n\n2 5 {CAR.format(ry='0.7')}\n")
    frames = read_track_labels(file)
    assert [[(track, label.kind, label.rotation_y) for track, label in frame] for frame in frames] == [
        [(-1, "DontCare", -10.0)],
        [],
        [(3, "Car", 0.5), (5, "Car", 0.7)],
    ]
    for bad in ("x 3 " + CAR.format(ry="0"), "1.5 3 " + CAR.format(ry="0"), "0", "0 1 Car 1 2", "0 1 " + CAR.format(ry="left")):
        file.write_text(f"0 -1 {REGION}\n{bad}\n")
        with pytest.raises(InputError, match=r"0000\.txt:2: not a label"):
            read_track_labels(file)
        with pytest.raises(InputError, match=r"0000\.txt:2: not a label"):
            read_labels(file)
