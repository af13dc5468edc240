"""COLMAP and nuScenes: the same poses as a table of them, and what is malformed is named."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import inverse, make_pose, matrix_to_quaternion, so3_exp
from nolbo_ppl.io.trajectories import read_trajectory


def poses(count: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    return make_pose(so3_exp(rng.standard_normal((count, 3))), rng.standard_normal((count, 3)))


def colmap(T: np.ndarray, names: list[str], points: str) -> str:
    lines = ["# Image list with two lines of data per image:", "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"]
    for k, (pose, name) in enumerate(zip(inverse(T), names)):
        x, y, z, w = matrix_to_quaternion(pose[:3, :3])
        values = " ".join(f"{v:.12f}" for v in (w, x, y, z, *pose[:3, 3]))
        lines += [f"{k + 1} {values} 1 {name}", points]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("points", ["", "1.5 2.5 -1 3.5 4.5 7"])
def test_colmap_in_natural_order_of_the_names(tmp_path: Path, points: str) -> None:
    T, names = poses(3), ["left image/f10.png", "left image/f2.png", "left image/f1.png"]
    (tmp_path / "images.txt").write_text(colmap(T, names, points))
    found = read_trajectory(tmp_path / "images.txt")
    np.testing.assert_allclose(found.T_world_camera, T[[2, 1, 0]], atol=1e-9)
    assert found.times is None
    np.testing.assert_allclose(read_trajectory(tmp_path / "images.txt", "colmap").T_world_camera, found.T_world_camera)


def nuscenes(T: np.ndarray, times: list[int]) -> list[dict]:
    q = matrix_to_quaternion(T[:, :3, :3])[:, [3, 0, 1, 2]]
    return [
        {"token": f"{k:032x}", "timestamp": t, "rotation": q[k].tolist(), "translation": T[k, :3, 3].tolist()}
        for k, t in enumerate(times)
    ]


def test_nuscenes_in_order_of_time(tmp_path: Path) -> None:
    T, times = poses(3), [1532402927647951, 1532402928147847, 1532402927814384]
    (tmp_path / "ego_pose.json").write_text(json.dumps(nuscenes(T, times)))
    found = read_trajectory(tmp_path / "ego_pose.json")
    assert found.times is not None
    np.testing.assert_allclose(found.T_world_camera, T[[0, 2, 1]], atol=1e-9)
    np.testing.assert_allclose(found.times, np.sort(times) * 1e-6)


def test_damage_is_named(tmp_path: Path) -> None:
    T = poses(2)
    rows = colmap(T, ["a.png", "b.png"], "").splitlines()
    file = tmp_path / "images.txt"
    for change, match in (
        (rows[:4] + ["2 1 0 0"], "images.txt:5: not an image of COLMAP"),
        (rows[:4] + [rows[2]], "images.txt:5: two images of one name: got a.png"),
        (rows[:2] + ["1 2 0 0 0 1 1 1 1 a.png"], "images.txt:3: no pose"),
    ):
        file.write_text("\n".join(change) + "\n")
        with pytest.raises(InputError, match=match):
            read_trajectory(file)
    file = tmp_path / "ego_pose.json"
    good = nuscenes(T, [1, 2])
    for content, match in (
        ([good[0], {**good[1], "rotation": [1, 1, 0, 0]}], "record 1 is no ego pose"),
        ({"a": 1}, "not ego poses of nuScenes"),
        (nuscenes(T, [1, 1]), "time does not increase"),
    ):
        file.write_text(json.dumps(content))
        with pytest.raises(InputError, match=match):
            read_trajectory(file)
