"""ImageNet, Render for CNN, ModelNet and Pix3D as they are distributed, in layouts that the tests make."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nolbo_ppl.categories import CATEGORIES, CATEGORY_SYMMETRY, OBJECTNET3D_MORE, PAPER_CATEGORIES, PIX3D_ONLY
from nolbo_ppl.cli import main
from nolbo_ppl.data import known_formats, picture_formats  # noqa: F401 - they register their formats
from nolbo_ppl.data.converters import archive_formats  # noqa: F401 - and this
from nolbo_ppl.data.converters.pix3d import CAMERA, MODEL, pix3d_models, pix3d_viewpoint, read_pix3d
from nolbo_ppl.data.dataset_folder import SceneFolder
from nolbo_ppl.data.format_registry import check_data
from nolbo_ppl.data.image_crops import middle_part, random_part
from nolbo_ppl.data.imagenet import open_imagenet
from nolbo_ppl.data.modelnet import MODELNET10, MODELNET40, modelnet_files, modelnet_voxels
from nolbo_ppl.data.render_for_cnn import SYNSETS, open_render_for_cnn, viewpoint_of_name
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.rotation import viewpoint_to_matrix
from nolbo_ppl.geometry.voxels import pack_voxels, resized_bits, unpack_voxels
from tests.archive_layouts import (
    box_off,
    make_ilsvrc,
    make_imagenet,
    make_modelnet,
    make_pix3d,
    make_rendered,
    picture,
    pix3d_row,
)


def test_forty_categories() -> None:
    assert len(PAPER_CATEGORIES) == len(set(PAPER_CATEGORIES)) == 40 and PAPER_CATEGORIES[:12] == CATEGORIES
    assert len(CATEGORIES) + len(OBJECTNET3D_MORE) == 37 and "bench" in OBJECTNET3D_MORE
    assert set(CATEGORY_SYMMETRY) == set(CATEGORIES)


def test_37_of_them_exist_in_objectnet3d(data_dir: Path) -> None:
    meta = json.loads((data_dir / "objectnet3d_cad" / "meta.json").read_text())
    known = {row["category"] for row in meta.values()}
    assert [name for name in PAPER_CATEGORIES if name not in known] == list(PIX3D_ONLY)


def test_imagenet_in_folders(tmp_path: Path) -> None:
    make_imagenet(tmp_path, train=3, val=2)
    train, val = open_imagenet(tmp_path, "train"), open_imagenet(tmp_path, "val")
    assert train.classes == ("n01440764", "n02102040") and train.label.tolist() == [0, 0, 0, 1, 1, 1]
    assert val.label.tolist() == [0, 0, 1, 1] and not {*train.files} & {*val.files}
    whole = train.picture(1, 64)
    assert whole.shape == (3, 64, 64) and np.array_equal(whole, train.picture(1, 64))
    first, again, other = (train.picture(1, 64, seed) for seed in (7, 7, 8))
    assert np.array_equal(first, again) and not np.array_equal(first, other)
    part = train.part(np.array([5, 0]))
    assert part.label.tolist() == [1, 0] and part.files == (train.files[5], train.files[0])


@pytest.mark.parametrize("by_csv", [False, True])
def test_imagenet_as_it_is_distributed(tmp_path: Path, by_csv: bool) -> None:
    make_ilsvrc(tmp_path, by_csv)
    val = open_imagenet(tmp_path, "val")
    assert [file.stem[-1] for file in val.files] == ["0", "1"] and val.label.tolist() == [0, 1]


def test_imagenet_that_is_none_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a folder of ImageNet"):
        open_imagenet(tmp_path)
    make_imagenet(tmp_path)
    picture(tmp_path / "val" / "n99999999" / "x.JPEG")
    with pytest.raises(InputError, match="class of a split: got n99999999"):
        open_imagenet(tmp_path, "val")
    make_ilsvrc(tmp_path / "flat")
    next((tmp_path / "flat").rglob("*.xml")).unlink()
    with pytest.raises(InputError, match="label of a picture"):
        open_imagenet(tmp_path / "flat", "val")


def test_parts_of_pictures() -> None:
    image = np.zeros((70, 140, 3), np.uint8)
    image[:, 70:] = 255
    middle = middle_part(image, 56)
    assert middle.shape == (56, 56, 3) and middle[:, :26].max() == 0 and middle[:, 30:].min() == 255
    seen = [random_part(image, 32, np.random.default_rng(seed)).mean() for seed in range(40)]
    assert min(seen) < 60 and max(seen) > 195  # parts of either half, and turned over


def test_viewpoints_of_rendered_pictures(tmp_path: Path) -> None:
    make_rendered(tmp_path)
    train, held_out = open_render_for_cnn(tmp_path), open_render_for_cnn(tmp_path, held_out=True)
    assert len(train) == len(held_out) == 6 and not {f.parent for f in train.files} & {f.parent for f in held_out.files}
    assert {train.categories[i] for i in train.category} == {"car", "chair"}
    row = [file.name for file in train.files].index("02958343_1a2b_a200_e-03_t010_d003.png")
    assert np.degrees(train.viewpoint[row]) == pytest.approx([-160.0, -3.0, 10.0])
    assert train.picture(row, 64).shape == (3, 64, 64)
    assert len(SYNSETS) == 12 and set(SYNSETS.values()) == set(CATEGORIES)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("02958343_1a2b_a200_e-03.png", "name of a rendered picture"),
        ("00000001_1a2b_a200_e-03_t010_d003.png", "synset"),
        ("02958343_1a2b_a200_e-93_t010_d003.png", "angles"),
    ],
)
def test_names_without_a_viewpoint_are_refused(name: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        viewpoint_of_name(Path("some") / name)
    assert name in str(error.value)


def test_modelnet_by_its_official_split(tmp_path: Path) -> None:
    make_modelnet(tmp_path)
    assert list(modelnet_files(tmp_path, "train")) == ["lamp/lamp_0001", "lamp/lamp_0002", "table/table_0001", "table/table_0002"]
    assert list(modelnet_files(tmp_path, "test", ["table"])) == ["table/table_0003"]
    packed, label, names = modelnet_voxels(tmp_path, tmp_path / "cache", "test", side=16)
    assert names == ("lamp", "table") and label.tolist() == [0, 1]
    lamp, table = unpack_voxels(packed, 16)
    tall = [len(np.flatnonzero(grid.any(axis=(0, 1)))) for grid in (lamp, table)]
    assert tall[0] >= 14 and tall[1] <= 4  # z is up
    assert len(MODELNET40) == 40 and set(MODELNET10) < set(MODELNET40)
    with pytest.raises(InputError, match=r"classes of ModelNet: got \['sofa'\]"):
        modelnet_files(tmp_path, "train", ["sofa"])
    with pytest.raises(InputError, match="not a folder of ModelNet"):
        modelnet_files(tmp_path / "lamp" / "train")


def test_voxels_of_another_side() -> None:
    grid = np.random.default_rng(0).random((2, 8, 8, 8)) < 0.2
    bits = pack_voxels(grid)
    double = unpack_voxels(resized_bits(bits, 8, 16), 16)
    assert np.array_equal(double[:, ::2, 1::2, ::2], grid) and double.mean() == grid.mean()
    assert np.array_equal(resized_bits(resized_bits(bits, 8, 16), 16, 8), bits)
    with pytest.raises(InputError, match="multiple"):
        resized_bits(pack_voxels(np.zeros((12, 12, 12), bool)), 12, 8)


def pix3d_projection(point: np.ndarray, R: np.ndarray, T: np.ndarray, focal: float, middle: np.ndarray) -> np.ndarray:
    """The archive's own rule: x to the left, y up, so that pixels run against both."""
    seen = R @ point + T
    return middle - focal * seen[:2] / seen[2]


def test_pix3ds_camera_and_models(tmp_path: Path) -> None:
    assert np.linalg.det(CAMERA) == pytest.approx(1) and np.linalg.det(MODEL) == pytest.approx(1)
    assert pix3d_viewpoint(np.eye(3), np.array([0.0, 0.0, 2.0])) == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    a = 0.6  # turned about its vertical axis: one sees another side
    turn = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    tilt = np.array([[1, 0, 0], [0, np.cos(0.3), np.sin(0.3)], [0, -np.sin(0.3), np.cos(0.3)]])
    R, T = tilt @ turn, np.array([0.0, 0.0, 3.0])
    viewpoint = pix3d_viewpoint(R, T)
    ours = viewpoint_to_matrix(torch.tensor(viewpoint, dtype=torch.float64)).numpy()
    rng, middle = np.random.default_rng(0), np.array([48.0, 40.0])
    for point in rng.standard_normal((20, 3)) * 0.3:
        seen = ours @ (MODEL @ point) + CAMERA @ T  # right, down, forward
        pixel = middle + 96 * seen[:2] / seen[2]
        np.testing.assert_allclose(pixel, pix3d_projection(point, R, T, 96.0, middle), atol=1e-9)
    assert abs(abs(viewpoint[0]) - a) < 1e-9 and abs(abs(viewpoint[1]) - 0.3) < 1e-9 and abs(viewpoint[2]) < 1e-9


def test_pix3d_as_it_is_distributed(tmp_path: Path) -> None:
    rows = [
        pix3d_row(),
        pix3d_row(img="img/bed/0002.png", category="bed", slightly_occluded=True),
        pix3d_row(img="img/misc/0003.png", category="misc"),
        pix3d_row(img="img/bookcase/0004.png", category="bookcase", truncated=True, focal_length=64.0),
    ]
    make_pix3d(tmp_path, rows)
    images = list(read_pix3d(tmp_path))
    assert [image.objects[0].category for image in images] == ["sofa", "bed", "bookshelf"]
    assert images[0].intrinsics == (96.0, 96.0, 48.0, 40.0) and images[2].intrinsics == (192.0, 192.0, 48.0, 40.0)
    assert images[1].objects[0].occluded and images[2].objects[0].truncated and images[0].exhaustive == ()
    (tmp_path / "split.txt").write_text("img/bed/0002.png\n")
    assert [image.path.name for image in read_pix3d(tmp_path, tmp_path / "split.txt")] == ["0002.png"]
    (tmp_path / "split.json").write_text(json.dumps({"images": [{"file_name": "img/none.png"}]}))
    with pytest.raises(InputError, match=r"images of a split: got \['img/none.png'\]"):
        list(read_pix3d(tmp_path, tmp_path / "split.json"))
    with pytest.raises(InputError, match=r"CAD model of an annotation: got model/x\.obj"):
        pix3d_models(tmp_path, {"model/x.obj"})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rot_mat": [[1, 0, 0], [0, 2, 0], [0, 0, 1]]}, r"\[0\].rot_mat"),
        ({"rot_mat": [[1, 0], [0, 1]]}, r"\[0\].rot_mat"),
        ({"trans_mat": [0, 0, -1.0]}, r"\[0\].trans_mat"),
        ({"bbox": [70, 30, 20, 60]}, r"\[0\].bbox"),
        ({"focal_length": "long"}, r"\[0\].focal_length"),
        ({"img_size": None}, r"\[0\].img_size"),
    ],
)
def test_malformed_rows_of_pix3d_are_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    make_pix3d(tmp_path, [pix3d_row()])
    (tmp_path / "pix3d.json").write_text(json.dumps([pix3d_row(**changes)]))
    with pytest.raises(InputError, match=message) as error:
        list(read_pix3d(tmp_path))
    assert "pix3d.json" in str(error.value)


def test_pix3d_becomes_scenes_with_shapes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_pix3d(tmp_path / "data", [pix3d_row()])
    cache = str(tmp_path / "cache")
    main(["convert", "pix3d", "--data", str(tmp_path / "data"), "--out", str(tmp_path / "out"), "--cache", cache])
    assert "1 images, 1 objects, 1 viewpoints" in capsys.readouterr().out
    scenes = SceneFolder(tmp_path / "out", PAPER_CATEGORIES, size=96)
    arrays = scenes.batch([0])
    assert arrays["has_voxels"][0, 0] and arrays["viewpoint"][0, 0] == pytest.approx([0, 0, 0], abs=0.1)
    grid = unpack_voxels(arrays["voxels"][0, 0], 32)
    extent = [len(np.flatnonzero(grid.any(axis=tuple({0, 1, 2} - {axis})))) for axis in range(3)]
    assert extent[0] > extent[1] > extent[2]  # width 1, depth 0.5, height 0.4 of the model: its y is up
    assert SceneFolder(tmp_path / "out", PAPER_CATEGORIES, voxel_side=64).batch([0])["voxels"].shape[-1] == 64**3 // 8


def test_nolbo_data_check_knows_them(tmp_path: Path) -> None:
    made = {
        "imagenet": make_imagenet(tmp_path / "imagenet"),
        "render-for-cnn": make_rendered(tmp_path / "rendered"),
        "modelnet": make_modelnet(tmp_path / "ModelNet40"),
        "pix3d": make_pix3d(tmp_path / "pix3d", [pix3d_row()]),
    }
    box_off(made["modelnet"] / "lamp" / "train" / "lamp_0009.off", 1, 1, 1).write_text("OFF\nx y z\n")
    reports = {name: check_data(path) for name, path in made.items()}
    assert {name: report.format for name, report in reports.items()} == {name: name for name in made}
    assert reports["imagenet"].facts | {"train": 8, "val": 4} == reports["imagenet"].facts
    assert reports["render-for-cnn"].facts["elevation"] == [-3.0, 20.0]
    assert (
        reports["modelnet"].facts["train_classes"] == {"lamp": 3, "table": 2} and "lamp_0009" in reports["modelnet"].problems[0]
    )
    assert reports["pix3d"].facts["viewpoints"] == 1
    assert reports["imagenet"].pictures is not None and len(list(reports["imagenet"].pictures())) == 8
