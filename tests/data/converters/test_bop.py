"""The layout of BOP: its convention on known cases, what is left out, and malformed files."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nolbo_ppl.cli import main
from nolbo_ppl.data.converters.archive_formats import depth_misfits
from nolbo_ppl.data.converters.bop import read_bop, read_targets, splits
from nolbo_ppl.data.converters.bop_models import YCB_VIDEO, read_models
from nolbo_ppl.data.dataset_folder import SceneFolder
from nolbo_ppl.data.format_registry import check_data
from nolbo_ppl.data.known_formats import stated_categories
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.voxels import unpack_voxels
from nolbo_ppl.io.trajectories import read_trajectory
from tests.archive_layouts import bop_truth, make_bop


def edit(file: Path, change: Callable[[Any], Any]) -> None:
    content = json.loads(file.read_text())
    file.write_text(json.dumps(change(content) or content))


def test_poses_boxes_and_sizes_are_those_of_the_projected_model(tmp_path: Path) -> None:
    """Corners of the labelled 3D box, in m in the library's pixels, project onto BOP's box within a pixel."""
    images = list(read_bop(make_bop(tmp_path)))
    assert [image.number for image in images] == [1, 2, 3] and {image.scene for image in images} == {"000048"}
    for image in images:
        one = image.annotations
        R, t = bop_truth(image.number)
        np.testing.assert_allclose(one.intrinsics, [100.0, 110.0, 48.0, 39.5])
        np.testing.assert_allclose(one.dimensions, [[0.12, 0.06, 0.2]])
        np.testing.assert_allclose(one.diagonal, [np.sqrt(0.12**2 + 0.06**2 + 0.2**2)])
        np.testing.assert_allclose(one.R_camera_object[0], R, atol=1e-12)
        np.testing.assert_allclose(one.position[0], (R @ [30.0, 10.0, 105.0] + t) / 1000)
        corners = one.position + (np.array(list(product((-0.5, 0.5), repeat=3))) * one.dimensions) @ R.T
        pixels = corners[:, :2] / corners[:, 2:] * one.intrinsics[:2] + one.intrinsics[2:]
        expected = np.concatenate((pixels.min(0), pixels.max(0)))
        assert np.abs(one.box[0] - np.clip(expected, 0, [96, 80, 96, 80])).max() <= 1.0, (one.box, expected)
        assert one.category == one.instance == (YCB_VIDEO[1],) and one.symmetry.tolist() == [2]
    upright = images[0].annotations.R_camera_object[0] @ [0.0, 0, 1]
    np.testing.assert_allclose(upright, [0, -1, 0], atol=1e-12)  # the model's z points up in the picture


def test_symmetries_about_the_vertical_axis(tmp_path: Path) -> None:
    models = read_models(make_bop(tmp_path))
    assert (models[1].symmetry, models[2].symmetry) == (0, 2)  # a can turns freely; upside down is no turn about z
    edit(tmp_path / "models" / "models_info.json", lambda all_: all_["1"].update(symmetries_continuous=[{"axis": [1, 0, 0]}]))
    assert read_models(tmp_path)[1].symmetry == 1


def test_the_camera_stands_where_it_is_stated(tmp_path: Path) -> None:
    first = next(iter(read_bop(make_bop(tmp_path))))
    assert first.T_world_camera is not None
    np.testing.assert_allclose(first.T_world_camera[:3, 3], [0.1, 2.0, 1.5])
    np.testing.assert_allclose(first.T_world_camera[:3, :3] @ [0.0, 0, 1], [1, 0, 0])  # forward is the world's x
    np.testing.assert_allclose(first.T_world_camera[:3, :3] @ [0.0, 1, 0], [0, 0, -1])  # down is its -z


def test_depth_is_in_metres(tmp_path: Path) -> None:
    first = next(iter(read_bop(make_bop(tmp_path))))
    depth = first.depth_in_metres()
    assert depth is not None and first.metres_per_step == pytest.approx(1e-4)
    np.testing.assert_allclose(depth, 0.9525)
    assert 0 <= max(depth_misfits(first)) < 0.5
    assert "depth_scale?" not in str(check_data(tmp_path).problems)
    edit(
        tmp_path / "test" / "000048" / "scene_camera.json",
        lambda all_: [one.update(depth_scale=1.0) for one in all_.values()][:0],
    )
    assert "depth_scale?" in str(check_data(tmp_path).problems)


def test_hardly_visible_objects_are_ignored(tmp_path: Path) -> None:
    make_bop(tmp_path)

    def shares(all_: Any) -> None:
        all_["1"][0]["visib_fract"], all_["2"][0]["visib_fract"] = 0.05, 0.6
        all_["3"][0].update(visib_fract=0.0, bbox_visib=[-1, -1, -1, -1])

    edit(tmp_path / "test" / "000048" / "scene_gt_info.json", shares)
    a, b, c = (image.annotations for image in read_bop(tmp_path))
    assert (len(a), len(a.ignore)) == (0, 1) and (len(b), len(b.ignore)) == (1, 0) and (len(c), len(c.ignore)) == (0, 0)
    assert b.visibility.tolist() == [0.6]
    assert len(next(iter(read_bop(tmp_path, minimum_visibility=0.01))).annotations) == 1


def test_splits_and_targets(tmp_path: Path) -> None:
    make_bop(tmp_path, images=1, split="train_real", scene=0)
    make_bop(tmp_path, images=4)
    (tmp_path / "targets.json").write_text(json.dumps([{"scene_id": 48, "im_id": 3, "obj_id": 2, "inst_count": 1}]))
    assert splits(tmp_path) == ["test", "train_real"]
    assert [image.number for image in read_bop(tmp_path, targets=read_targets(tmp_path / "targets.json"))] == [3]
    assert [image.number for image in read_bop(tmp_path, every=2)] == [1, 3]
    assert [image.scene for image in read_bop(tmp_path, "train_real")] == ["000000"]
    with pytest.raises(InputError, match=r"got val, expected one of \['test', 'train_real'\]"):
        list(read_bop(tmp_path, "val"))
    (tmp_path / "targets.json").write_text('[{"scene_id": "48"}]')
    with pytest.raises(InputError, match=r"targets\.json: \[0\]"):
        read_targets(tmp_path / "targets.json")


def test_the_command_writes_scenes_with_shapes_and_paths(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_bop(tmp_path / "ycbv")
    arguments = [
        "convert",
        "bop",
        "--data",
        str(tmp_path / "ycbv"),
        "--out",
        str(tmp_path / "out"),
        "--cache",
        str(tmp_path / "c"),
    ]
    main(arguments)
    assert "3 images, 3 objects, 0 ignore" in capsys.readouterr().out
    folder = SceneFolder(tmp_path / "out", YCB_VIDEO, size=96)
    batch = folder.batch(np.arange(3))
    assert batch["has_voxels"][:, 0].all() and batch["has_viewpoint"][:, 0].all() and batch["has_position"][:, 0].all()
    assert folder.records[0].symmetry.tolist() == [2]
    with np.load(tmp_path / "out" / "voxels.npz", allow_pickle=False) as voxels:
        grid = unpack_voxels(voxels[YCB_VIDEO[1]], 32)
    extent = [np.ptp(np.flatnonzero(grid.any(axis=tuple({0, 1, 2} - {axis})))) + 1 for axis in range(3)]
    assert extent[2] > extent[0] > extent[1]  # as long as the model's own axes: z up
    path = read_trajectory(tmp_path / "out" / "trajectories" / "000048.txt")
    np.testing.assert_allclose(path.T_world_camera[:, :3, 3], [[0.1, 2, 1.5], [0.2, 2, 1.5], [0.3, 2, 1.5]])
    assert path.times is not None and path.times.tolist() == [1.0, 2.0, 3.0]
    assert json.loads((tmp_path / "out" / "source.json").read_text())["categories"] == [YCB_VIDEO[1]]
    main(arguments)  # what was converted before is replaced
    assert stated_categories(tmp_path / "out") == (YCB_VIDEO[1],)
    report = check_data(tmp_path / "out")
    assert report.format == "scenes" and report.facts["categories"] == {YCB_VIDEO[1]: 3} and not report.problems


def test_what_the_check_finds(tmp_path: Path) -> None:
    make_bop(tmp_path)
    report = check_data(tmp_path)
    assert report.format == "bop" and not report.problems
    assert report.facts["splits"] == {"test": 3} and report.facts["categories"] == {YCB_VIDEO[1]: 3}
    assert report.facts["poses_of_cameras"] == 3 and report.facts["depth_images"] == 3
    assert report.pictures is not None and [one.labels for one in report.pictures()] == [(YCB_VIDEO[1],)] * 3
    (tmp_path / "test" / "000048" / "rgb" / "000002.png").unlink()
    assert "image of an annotation: got 2" in check_data(tmp_path).problems[0]


def test_other_data_sets_have_no_names(tmp_path: Path) -> None:
    make_bop(tmp_path, camera="camera.json")
    assert {name for image in read_bop(tmp_path) for name in image.annotations.category} == {"obj_000002"}
    assert {name for image in read_bop(tmp_path, names=["can", "box"]) for name in image.annotations.category} == {"box"}


SCENE = "test/000048/"
MALFORMED = [
    (SCENE + "scene_gt.json", lambda c: c["2"][0].update(obj_id=7), r"scene_gt\.json: 2\[0\]\.obj_id: got 7"),
    (SCENE + "scene_gt.json", lambda c: c["2"][0].update(obj_id=True), r"2\[0\]\.obj_id: got True"),
    (SCENE + "scene_gt.json", lambda c: c["2"][0].update(cam_R_m2c=[1.0] * 9), r"2\[0\]\.cam_R_m2c: .* expected a rotation"),
    (SCENE + "scene_gt.json", lambda c: c["2"][0].update(cam_t_m2c=[1, 2]), r"2\[0\]\.cam_t_m2c: .* 3 finite numbers"),
    (SCENE + "scene_gt.json", lambda c: c.update({"2": 5}), r"scene_gt\.json: image 2: got 5"),
    (SCENE + "scene_gt.json", lambda c: c.update(first=[]), r"number of an image: got first"),
    (SCENE + "scene_gt.json", lambda c: c["2"].append(c["2"][0]), r"scene_gt_info\.json: image 2: got 1, expected 2 objects"),
    (SCENE + "scene_gt_info.json", lambda c: c["1"][0].update(visib_fract=2), r"1\[0\]\.visib_fract: got 2"),
    (SCENE + "scene_gt_info.json", lambda c: c["1"][0].pop("bbox_obj") and None, r"1\[0\]\.bbox_obj: expected 4"),
    (SCENE + "scene_camera.json", lambda c: c["1"].update(depth_scale=-1), r"1\.depth_scale: got -1"),
    (SCENE + "scene_camera.json", lambda c: c["1"].update(cam_K=[0] * 9), r"1\.cam_K"),
    (SCENE + "scene_camera.json", lambda c: c["3"].pop("cam_t_w2c") and None, r"3\.cam_t_w2c: expected 3"),
    (SCENE + "scene_camera.json", lambda c: c.pop("3") and None, r"camera of image 3: expected"),
    ("models/models_info.json", lambda c: c["1"].update(size_x=0), r"models_info\.json: 1\.size"),
    ("models/models_info.json", lambda c: c["1"].update(min_y="low"), r"1\.min_y: got low"),
    ("models/models_info.json", lambda c: c["2"].update(symmetries_discrete=[[0] * 16]), r"2\.symmetries_discrete\[0\]"),
    ("models/models_info.json", lambda c: c["1"].update(symmetries_continuous=[{"axis": 1}]), r"symmetries_continuous\[0\]"),
]  # fmt: skip


@pytest.mark.parametrize(("file", "change", "message"), MALFORMED, ids=range(len(MALFORMED)))
def test_malformed_files_are_named(tmp_path: Path, file: str, change: Callable[[Any], Any], message: str) -> None:
    make_bop(tmp_path)
    edit(tmp_path / file, change)
    with pytest.raises(InputError, match=message):
        list(read_bop(tmp_path))


def test_ycb_video_has_21_objects() -> None:
    assert len(set(YCB_VIDEO)) == 21 and all(name[:3].isdecimal() for name in YCB_VIDEO) and list(YCB_VIDEO) == sorted(YCB_VIDEO)
