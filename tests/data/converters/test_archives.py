"""Adapters of public archives: layouts made by the tests, real annotation files where they are at hand."""

import json
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.io import savemat

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.cli import main
from nolbo_ppl.data.converters.archives import ArchiveImage, ArchiveObject, pascal_rotation, scene_line, write_archive
from nolbo_ppl.data.converters.coco import read_coco
from nolbo_ppl.data.converters.pascal3d import cad_files, read_objectnet3d, read_pascal3d, read_pascal3d_annotation
from nolbo_ppl.data.converters.stanford_cars import read_car_poses, read_stanford_cars
from nolbo_ppl.data.converters.voc import read_voc, read_voc_annotation
from nolbo_ppl.data.dataset_folder import SceneFolder
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.rotation import egocentric_to_allocentric, geodesic_angle, matrix_to_viewpoint, quaternion_to_matrix
from nolbo_ppl.geometry.voxels import unpack_voxels

CAMERA = [100.0, 100.0, 50.0, 40.0]


def picture(path: Path, width: int = 100, height: int = 80) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (height, width, 3), dtype=np.uint8)).save(path)


def benchmark_projection(points: np.ndarray, azimuth: float, elevation: float, theta: float) -> np.ndarray:
    """Where PASCAL3D+ draws points of an object in an image (y down), very far away, up to scale; written from its camera.

    The camera stands at (cos e sin a, -cos e cos a, sin e) and looks at the origin with z up; then the picture is turned.
    """
    eye = np.array([np.cos(elevation) * np.sin(azimuth), -np.cos(elevation) * np.cos(azimuth), np.sin(elevation)])
    right = np.cross(-eye, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, -eye)
    u, v = points @ right, points @ up
    turned = np.stack([np.cos(theta) * u - np.sin(theta) * v, np.sin(theta) * u + np.cos(theta) * v])
    return np.stack([turned[0], -turned[1]], axis=1)


@pytest.mark.parametrize("viewpoint", [(0.0, 0.0, 0.0), (0.4, 0.3, 0.2), (2.5, -0.2, -0.4), (5.0, 0.9, 0.1)])
def test_rotation_is_the_benchmarks_camera(viewpoint: tuple[float, float, float]) -> None:
    points = np.random.default_rng(1).standard_normal((20, 3))
    middle = [CAMERA[2] - 5, CAMERA[3] - 5, CAMERA[2] + 5, CAMERA[3] + 5]  # on the axis: egocentric is allocentric
    R = pascal_rotation(viewpoint, middle, CAMERA)
    np.testing.assert_allclose((points @ R.T)[:, :2], benchmark_projection(points, *viewpoint), atol=1e-9)
    assert abs(np.linalg.det(R) - 1) < 1e-12


def test_known_viewpoints() -> None:
    middle = [45.0, 35.0, 55.0, 45.0]
    front = np.array([0.0, -1.0, 0.0])
    towards = pascal_rotation((0.0, 0.0, 0.0), middle, CAMERA) @ front
    np.testing.assert_allclose(towards, [0, 0, -1], atol=1e-12)  # azimuth 0: the front faces the camera
    left = pascal_rotation((np.pi / 2, 0.0, 0.0), middle, CAMERA) @ front
    np.testing.assert_allclose(left, [-1, 0, 0], atol=1e-12)  # azimuth 90 degrees: the nose points left
    up = pascal_rotation((0.3, np.pi / 2 - 1e-9, 0.0), middle, CAMERA) @ np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(up, [0, 0, -1], atol=1e-8)  # seen from above: the roof faces the camera


def test_the_viewpoint_is_that_of_the_ray_through_the_box() -> None:
    box = (0.0, 10.0, 30.0, 50.0)
    line = scene_line(ArchiveImage(Path("x.jpg"), (100, 80), (ArchiveObject("car", box, (0.7, 0.1, -0.2)),)), "images/0.jpg")
    fx, fy, cx, cy = line["intrinsics"]
    R = quaternion_to_matrix(torch.tensor(line["objects"][0]["rotation"], dtype=torch.float64))
    ray = torch.tensor([(15.0 - cx) / fx, (30.0 - cy) / fy, 1.0], dtype=torch.float64)
    np.testing.assert_allclose(matrix_to_viewpoint(egocentric_to_allocentric(R, ray)), [0.7, 0.1, -0.2], atol=1e-8)
    assert "position" not in line["objects"][0]


def test_a_box_that_sticks_out_is_seen_through_its_middle_inside_the_image() -> None:
    box = (-40.0, 10.0, 30.0, 50.0)
    line = scene_line(ArchiveImage(Path("x.jpg"), (100, 80), (ArchiveObject("car", box, (0.7, 0.1, -0.2)),)), "images/0.jpg")
    fx, fy, cx, cy = line["intrinsics"]
    assert line["objects"][0]["box"] == [0.0, 10.0, 30.0, 50.0]
    R = quaternion_to_matrix(torch.tensor(line["objects"][0]["rotation"], dtype=torch.float64))
    ray = torch.tensor([(15.0 - cx) / fx, (30.0 - cy) / fy, 1.0], dtype=torch.float64)
    np.testing.assert_allclose(matrix_to_viewpoint(egocentric_to_allocentric(R, ray)), [0.7, 0.1, -0.2], atol=1e-8)


def make_pascal(root: Path) -> None:
    objects = [
        {
            "class": "car", "bbox": [11.0, 21.0, 60.0, 70.0], "cad_index": 3, "truncated": 0, "occluded": 0, "difficult": 0,
            "viewpoint": {
                "azimuth": 30.0, "elevation": 10.0, "theta": 5.0, "distance": 8.0, "azimuth_coarse": 20.0, "focal": 1.0,
            },
        },
        {
            "class": "car", "bbox": [61.0, 1.0, 90.0, 30.0], "cad_index": 4, "truncated": 1, "occluded": 0, "difficult": 0,
            "viewpoint": {
                "azimuth": np.array([]), "elevation": np.array([]), "theta": 0.0, "distance": 0.0, "azimuth_coarse": 90.0,
                "focal": 1.0,
            },
        },
        {
            "class": "person", "bbox": [1.0, 1.0, 20.0, 20.0], "cad_index": np.array([]), "truncated": 0, "occluded": 0,
            "difficult": 0, "viewpoint": np.array([]),
        },
    ]  # fmt: skip
    for name, stem, split in (("car_imagenet", "n1", "train"), ("car_imagenet", "n2", "val"), ("car_pascal", "p1", "train")):
        (root / "Annotations" / name).mkdir(parents=True, exist_ok=True)
        savemat(root / "Annotations" / name / f"{stem}.mat", {"record": {"filename": f"{stem}.JPEG", "objects": objects}})
        picture(root / "Images" / name / f"{stem}.JPEG")
        if name.endswith("imagenet"):
            (root / "Image_sets").mkdir(exist_ok=True)
            (root / "Image_sets" / f"{name}_{split}.txt").write_text(f"{stem}\n")
    lists = root / "PASCAL" / "VOCdevkit" / "VOC2012" / "ImageSets" / "Main"
    lists.mkdir(parents=True)
    (lists / "car_train.txt").write_text("p1  1\n")
    (lists / "car_val.txt").write_text("p9  1\n")
    for index in (3, 4):
        (root / "CAD" / "car").mkdir(parents=True, exist_ok=True)
        (root / "CAD" / "car" / f"{index:02d}.off").write_text(
            "OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"
        )


def test_pascal3d_as_it_is_distributed(tmp_path: Path) -> None:
    make_pascal(tmp_path)
    train, val = list(read_pascal3d(tmp_path, "train")), list(read_pascal3d(tmp_path, "val"))
    assert [image.path.stem for image in train] == ["n1", "p1"]
    assert [image.path.stem for image in val] == ["n2"]  # never mixed with the training images
    fine, coarse = train[0].objects
    assert fine.box == (10.0, 20.0, 60.0, 70.0)
    assert fine.viewpoint == pytest.approx(np.radians([30.0, 10.0, 5.0]))
    assert fine.instance == "car/03"
    assert coarse.viewpoint is None  # a coarse viewpoint alone: kept without one
    assert coarse.truncated
    assert set(cad_files(tmp_path, {"car/03", "car/04"})) == {"car/03", "car/04"}
    with pytest.raises(InputError, match="CAD model of an annotation: got car/09"):
        cad_files(tmp_path, {"car/09"})


def test_objects_without_a_viewpoint_stay_and_benchmarks_ignore_what_is_cut(tmp_path: Path) -> None:
    make_pascal(tmp_path / "data")
    counts = write_archive(tmp_path / "all", read_pascal3d(tmp_path / "data", "train"), {"archive": "PASCAL3D+"})
    assert counts == {"images": 2, "objects": 4, "viewpoints": 2, "ignore": 0}
    counts = write_archive(tmp_path / "clear", read_pascal3d(tmp_path / "data", "train"), {}, benchmark=True)
    assert counts == {"images": 2, "objects": 2, "viewpoints": 2, "ignore": 2}
    scenes = SceneFolder(tmp_path / "all")
    assert len(scenes) == 2


def test_the_command_writes_scenes_with_their_shapes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_pascal(tmp_path / "data")
    main(["convert", "pascal3d", "--data", str(tmp_path / "data"), "--out", str(tmp_path / "scenes")])
    assert "2 images, 4 objects, 2 viewpoints" in capsys.readouterr().out
    with np.load(tmp_path / "scenes" / "voxels.npz", allow_pickle=False) as voxels:
        assert set(voxels.files) == {"car/03", "car/04"}
        assert unpack_voxels(voxels["car/03"], 32).any()
    batch = SceneFolder(tmp_path / "scenes").batch(np.array([0]))
    assert batch["has_voxels"][0, :2].all()
    assert batch["has_viewpoint"][0, :2].tolist() == [True, False]
    np.testing.assert_allclose(batch["viewpoint"][0, 0], np.radians([30.0, 10.0, 5.0]), atol=1e-6)


def test_objectnet3d_takes_one_list_for_all_classes(tmp_path: Path) -> None:
    thing = {
        "class": "diningtable", "bbox": [1.0, 1.0, 50.0, 50.0], "cad_index": 1,
        "viewpoint": {"azimuth": 350.0, "elevation": 0.0, "theta": 0.0, "distance": 3.0},
    }  # fmt: skip
    (tmp_path / "Annotations").mkdir()
    savemat(tmp_path / "Annotations" / "a.mat", {"record": {"objects": [thing], "imgsize": [100, 80, 3]}})
    picture(tmp_path / "Images" / "a.JPEG")
    (tmp_path / "Image_sets").mkdir()
    (tmp_path / "Image_sets" / "val.txt").write_text("a\n")
    (only,) = read_objectnet3d(tmp_path, "val")
    assert only.objects[0].category == "diningtable"
    assert only.size == (100, 80)


def voc(root: Path, body: str) -> Path:
    picture(root / "JPEGImages" / "a.jpg")
    (root / "Annotations").mkdir(exist_ok=True)
    size = "<size><width>100</width><height>80</height><depth>3</depth></size>"
    file = root / "Annotations" / "a.xml"
    file.write_text(f"<annotation><filename>a.jpg</filename>{size}{body}</annotation>")
    return file


BOX = "<bndbox><xmin>{}</xmin><ymin>2</ymin><xmax>30</xmax><ymax>40</ymax></bndbox>"


def test_voc_counts_pixels_from_one(tmp_path: Path) -> None:
    car = f"<object><name>car</name><pose>Left</pose><difficult>1</difficult>{BOX.format(1)}</object>"
    cow = f"<object><name>cow</name>{BOX.format(5)}</object>"
    (only,) = read_voc_annotation(voc(tmp_path, car + cow), tmp_path / "JPEGImages").objects
    assert only.box == (0.0, 1.0, 30.0, 40.0)
    assert only.difficult
    assert only.viewpoint is None  # "Left" is a quadrant


@pytest.mark.parametrize(
    ("body", "match"),
    [
        (f"<object><name>car</name>{BOX.format('x')}</object>", r"a\.xml: object\[0\]\.bndbox/xmin: got 'x', expected a number"),
        (f"<object><name>car</name>{BOX.format(60)}</object>", r"a\.xml: object\[0\]\.bndbox: got \[60"),
        ("<object>", r"a\.xml:\d+: not an XML file"),
        ("<!ENTITY a 'b'>", "document type"),
    ],
)
def test_malformed_voc_files_name_file_and_field(tmp_path: Path, body: str, match: str) -> None:
    with pytest.raises(InputError, match=match):
        read_voc_annotation(voc(tmp_path, body), tmp_path / "JPEGImages")


def test_damaged_matlab_files_are_named(tmp_path: Path) -> None:
    make_pascal(tmp_path)
    file = tmp_path / "Annotations" / "car_imagenet" / "n1.mat"
    whole = file.read_bytes()
    for content in (b"", b"no MATLAB", whole[: len(whole) // 2], bytes(reversed(whole))):
        file.write_bytes(content)
        with pytest.raises(InputError, match=r"n1\.mat"):
            read_pascal3d_annotation(file, tmp_path / "Images" / "car_imagenet")


def coco(folder: Path, **annotation: object) -> Path:
    picture(folder / "images" / "1.jpg")
    picture(folder / "images" / "2.jpg")
    row = {"id": 7, "image_id": 1, "category_id": 4, "bbox": [10, 20, 30, 40], "iscrowd": 0} | annotation
    content = {
        "images": [{"id": k, "file_name": f"{k}.jpg", "width": 100, "height": 80} for k in (1, 2)],
        "annotations": [row],
        "categories": [{"id": 4, "name": "motorcycle"}, {"id": 1, "name": "person"}],
    }
    file = folder / "instances.json"
    file.write_text(json.dumps(content))
    return file


def test_coco_names_and_boxes(tmp_path: Path) -> None:
    (only,) = read_coco(coco(tmp_path), tmp_path / "images")
    assert only.objects == (ArchiveObject("motorbike", (10.0, 20.0, 40.0, 60.0)),)
    assert len(list(read_coco(coco(tmp_path), tmp_path / "images", empty=True))) == 2
    (crowd,) = read_coco(coco(tmp_path, iscrowd=1), tmp_path / "images")
    assert scene_line(crowd, "x")["ignore"] == [[10.0, 20.0, 40.0, 60.0]]


@pytest.mark.parametrize("bbox", [[1, 2, 3], [1, 2, -3, 4], [True, 2, 3, 4], "box", [1, 2, float("inf"), 4]])
def test_malformed_coco_boxes_are_named(tmp_path: Path, bbox: object) -> None:
    with pytest.raises(InputError, match=r"instances\.json"):
        list(read_coco(coco(tmp_path, bbox=bbox), tmp_path / "images"))


def test_stanford_cars_label_one_car_and_leave_the_others_unknown(tmp_path: Path) -> None:
    picture(tmp_path / "cars" / "00001.jpg")
    row = {"bbox_x1": 5, "bbox_y1": 6, "bbox_x2": 50, "bbox_y2": 60, "class": 2, "fname": "00001.jpg"}
    savemat(tmp_path / "annos.mat", {"annotations": [row, row | {"fname": "00002.jpg"}]})
    (only,) = read_stanford_cars(tmp_path / "annos.mat", tmp_path / "cars", only_present=True)
    assert only.objects[0].box == (4.0, 5.0, 50.0, 60.0)
    assert scene_line(only, "x")["exhaustive"] == []
    with pytest.raises(InputError, match=r"image of annotations\(2\): got 00002.jpg"):
        list(read_stanford_cars(tmp_path / "annos.mat", tmp_path / "cars"))


@pytest.mark.parametrize("angles", [(0.3, 0.2, -0.1), (2.9, -0.15, 0.3), (5.4, 0.5, 0.0)])
def test_poses_of_cars_project_as_their_authors_do(tmp_path: Path, angles: tuple[float, float, float]) -> None:
    """Points of a car's plane of symmetry, by the authors' projection (x ahead, y up, behind a camera that looks along -z) and by
    the library's rotation and camera."""
    azimuth, elevation, theta = angles
    row = {"azimuth": azimuth, "elevation": elevation, "theta": theta, "distance": 2.5, "f": 346.0, "u": 25.0, "v": -26.0}
    (tmp_path / "anno.pkl").write_bytes(pickle.dumps({"00001.jpg": {**row, "model_id": "abc"}}, protocol=0))
    pose = read_car_poses(tmp_path / "anno.pkl")["00001.jpg"]
    ahead, up = np.random.default_rng(0).uniform(-0.4, 0.4, (2, 20))
    ca, sa, ce, se, ct, st = (f(angle) for angle in angles for f in (np.cos, np.sin))
    Ry = np.array([[ca, 0, -sa], [0, 1, 0], [sa, 0, ca]])
    Rx = np.array([[1, 0, 0], [0, ce, -se], [0, se, ce]])
    Rz = np.array([[ct, -st, 0], [st, ct, 0], [0, 0, 1]])
    theirs = np.stack([ahead, up, np.zeros(20)]).T @ (Rz @ Rx @ Ry).T - [0, 0, 2.5]
    drawn = 346.0 * theirs[:, :2] / theirs[:, 2:] + [25.0 + 150, -26.0 + 100]  # of an image of 300 x 200
    fx, fy, cx, cy = pose.camera(600, 400)
    R = pascal_rotation(pose.viewpoint, [cx - 5, cy - 5, cx + 5, cy + 5], [fx, fy, cx, cy])
    ours = np.stack([np.zeros(20), -ahead, up]).T @ R.T + [0, 0, 2.5]
    np.testing.assert_allclose(ours[:, :2] / ours[:, 2:] * [fx, fy] + [cx, cy], 2 * drawn, atol=1e-9)


def test_cars_take_their_poses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [{"bbox_x1": 5, "bbox_y1": 6, "bbox_x2": 50, "bbox_y2": 60, "class": 2, "fname": f"0000{k}.jpg"} for k in (1, 2)]
    for row in rows:
        picture(tmp_path / "cars" / row["fname"])
    savemat(tmp_path / "annos.mat", {"annotations": rows})
    pose = {"azimuth": 0.0, "elevation": 0.1, "theta": 0.0, "distance": 1.0, "f": 300.0, "u": 0.0, "v": 0.0, "model_id": "abc"}
    (tmp_path / "anno.pkl").write_bytes(pickle.dumps({"00001.jpg": pose}, protocol=2))
    arguments = ["--annotations", "annos.mat", "--images", "cars", "--poses", "anno.pkl", "--out", "out"]
    main(["convert", "stanford-cars", *(str(tmp_path / one) if k % 2 else one for k, one in enumerate(arguments))])
    assert "2 images, 2 objects, 1 viewpoints" in capsys.readouterr().out
    folder = SceneFolder(tmp_path / "out")
    np.testing.assert_allclose(folder.labels["viewpoint"][0, 0], [np.pi / 2, 0.1, 0.0], atol=1e-6)  # its nose points left
    assert folder.labels["has_viewpoint"][:, 0].tolist() == [True, False]
    np.testing.assert_allclose(folder.intrinsics(0), [100.0, 100.0, 50.0, 40.0])
    for change, message in (({"f": 0.0}, "00001.jpg: f: got 0.0"), ({"theta": "x"}, "00001.jpg: theta: got x")):
        (tmp_path / "anno.pkl").write_bytes(pickle.dumps({"00001.jpg": {**pose, **change}}))
        with pytest.raises(InputError, match=message):
            read_car_poses(tmp_path / "anno.pkl")


def test_real_annotation_files(data_dir: Path, tmp_path: Path) -> None:
    folder = data_dir / "annotations"
    if not folder.is_dir():
        pytest.skip(f"no annotation files at {folder}")
    files = sorted((folder / "voc2012").glob("*.xml"))
    for file in files:
        picture(tmp_path / "JPEGImages" / f"{file.stem}.jpg", 4, 4)
        image = read_voc_annotation(file, tmp_path / "JPEGImages")
        assert all(0 <= thing.box[0] < thing.box[2] <= image.size[0] for thing in image.objects)
    content = json.loads((folder / "coco" / "instances_val2017.json").read_text())
    for row in content["images"]:
        picture(tmp_path / "coco" / row["file_name"], 4, 4)
    images = list(read_coco(folder / "coco" / "instances_val2017.json", tmp_path / "coco"))
    names = {row["id"]: row["name"] for row in content["categories"]}
    cars = sum(names[row["category_id"]] == "car" for row in content["annotations"])
    assert sum(thing.category == "car" for image in images for thing in image.objects) == cars
    found = {thing.category for image in images for thing in image.objects}
    assert found <= set(CATEGORIES)
    picture(tmp_path / "cars" / "00001.jpg", 600, 400)
    for name in ("cars_train_annos.mat", "cars_test_annos.mat"):
        (car,) = read_stanford_cars(folder / "stanford_cars" / name, tmp_path / "cars", only_present=True)
        assert car.objects[0].category == "car"


def test_voc_splits(tmp_path: Path) -> None:
    voc(tmp_path, "")
    with pytest.raises(InputError, match="no such split"):
        list(read_voc(tmp_path, "train"))
    (tmp_path / "ImageSets" / "Main").mkdir(parents=True)
    (tmp_path / "ImageSets" / "Main" / "train.txt").write_text("a\n")
    assert [image.path.name for image in read_voc(tmp_path, "train")] == ["a.jpg"]


def test_rotations_of_opposite_azimuths_differ_by_half_a_turn() -> None:
    box = [0.0, 0.0, 20.0, 20.0]
    a, b = (torch.from_numpy(pascal_rotation((azimuth, 0.2, 0.1), box, CAMERA)) for azimuth in (0.5, 0.5 + np.pi))
    assert float(geodesic_angle(a, b)) == pytest.approx(np.pi, abs=1e-6)
