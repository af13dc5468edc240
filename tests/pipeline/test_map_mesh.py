"""The map as GLB: read back, every shape lies where its landmark is, at its size, upright for a viewer; crops."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from nolbo_ppl.geometry.pose import make_pose, matrix_to_quaternion, so3_exp
from nolbo_ppl.io.landmarks import parse_landmark
from nolbo_ppl.io.run_folder import RunFolder
from nolbo_ppl.pipeline.map_mesh import build_scene, landmark_mesh, write_glb
from nolbo_ppl.pipeline.thumbnails import LONGEST, Crop, all_views, best_views, cut, spread_views, write_thumbnails
from nolbo_ppl.structures.association_table import AssociationTable
from nolbo_ppl.structures.detections import Detections
from nolbo_ppl.structures.landmark import Landmark


def slab() -> np.ndarray:
    """Occupancy of a slab: 0.8 x 0.4 x 0.2 of the box, along x, y, z."""
    grid = np.zeros((20, 20, 20))
    grid[2:18, 6:14, 8:12] = 1.0
    return grid


def row(name: str = "L0", **change: Any) -> Landmark:
    """A landmark as a file states it."""
    stated = {"name": name, "position": [3.0, 0.5, 8.0], "existence": 0.9, "category": "car", "size": [2.0, 1.0, 2.0]}
    return parse_landmark({**stated, **change}, {})


def test_a_landmark_lies_at_its_place_at_its_size() -> None:
    R = so3_exp(np.array([0.0, 0.7, 0.0]))
    vertices, faces = landmark_mesh(row(rotation=matrix_to_quaternion(R).tolist()), slab())
    local = (vertices - [3.0, 0.5, 8.0]) @ R  # the diagonal of [2, 1, 2] is 3 m
    np.testing.assert_allclose(np.ptp(local, axis=0), 3.0 * np.array([0.8, 0.4, 0.2]), rtol=1e-6)
    np.testing.assert_allclose((local.max(axis=0) + local.min(axis=0)) / 2, 0.0, atol=1e-6)
    assert trimesh.Trimesh(vertices, faces).volume > 0  # faces look outwards


def test_a_landmark_without_orientation_stands_upright() -> None:
    """The object's z is up; the world's y is down."""
    np.testing.assert_allclose(row().T_world_object[:3, 2], [0.0, -1.0, 0.0], atol=1e-12)


def test_the_file_can_be_read_back(tmp_path: Path) -> None:
    landmarks = [
        row(),
        row("L1", position=[-2.0, 0.0, 4.0], category="chair"),
        row("L2", existence=0.1),
        row("L3"),
        row("L4", detections=0.0),
    ]
    voxels = {"L0": slab(), "L1": 0.3 * slab(), "L2": slab(), "L4": slab()}
    # L1 is nowhere sure, L2 hardly exists, L3 has no shape, L4 no detection.
    path = make_pose(np.tile(np.eye(3), (4, 1, 1)), np.array([[0, 0, z] for z in range(4)], dtype=float))
    write_glb(tmp_path / "map.glb", build_scene(landmarks, voxels, path))
    scene = trimesh.load_scene(tmp_path / "map.glb")
    assert set(scene.graph.nodes_geometry) == {"L0", "L1", "trajectory"}
    for name, position in (("L0", [3.0, 0.5, 8.0]), ("L1", [-2.0, 0.0, 4.0])):
        transform, geometry = scene.graph[name]
        bounds = trimesh.transform_points(scene.geometry[geometry].vertices, transform)
        middle = (bounds.max(axis=0) + bounds.min(axis=0)) / 2
        # glTF has y up: the world's y (down) and z (forward) change their signs.
        np.testing.assert_allclose(middle, np.array(position) * [1, -1, -1], atol=1e-4)
    colours = [tuple(scene.geometry[scene.graph[name][1]].visual.material.baseColorFactor) for name in ("L0", "L1")]
    assert colours[0] != colours[1]


def test_an_empty_map_is_a_file_too(tmp_path: Path) -> None:
    write_glb(tmp_path / "map.glb", build_scene([], {}, np.eye(4)[None]))
    assert (tmp_path / "map.glb").stat().st_size > 0


def test_best_views_weigh_probability_objectness_and_size(tmp_path: Path) -> None:
    box = np.array([[0, 0, 10, 10], [0, 0, 40, 40], [0, 0, 50, 50], [np.nan] * 4])  # the last of a detector without boxes
    seen = Detections.from_arrays([0, 1, 2, 2], np.ones((4, 3)), objectness=[0.9, 0.5, 0.9, 1.0], box=box)
    row_of, landmark, weight = np.array([0, 1, 2, 2, 3]), np.array([0, 0, 0, 1, 1]), np.array([1.0, 1.0, 0.1, 0.8, 1.0])
    found = AssociationTable(seen.id, row_of, landmark, weight, np.zeros(4), np.zeros(4))
    views = best_views(seen, found, ["L0", "L1"])
    assert (views["L0"].frame, views["L1"].frame) == (1, 2)
    assert views["L0"].value == pytest.approx(0.5 * 40)
    read: list[int] = []

    def image(k: int) -> np.ndarray:
        read.append(k)
        return np.full((48, 64, 3), 10 * k, dtype=np.uint8)

    every = all_views(seen, found, ["L0", "L1"])
    assert [(view.frame, view.weight) for view in every["L0"]] == [(0, 1.0), (1, 1.0), (2, 0.1)]
    write_thumbnails(tmp_path / "crops", {**every, "L2": every["L1"]}, image)
    assert read == [0, 1, 2]  # each image once
    names = sorted(path.name for path in (tmp_path / "crops").iterdir())
    assert names == ["L0.png", "L1.png", "L2.png", "views", "views.json"]
    assert int(np.asarray(Image.open(tmp_path / "crops" / "L0.png")).mean()) == 10
    kept = RunFolder(tmp_path).views
    assert {name: (seen.count, [view.frame for view in seen.pictures]) for name, seen in kept.items()} == {
        "L0": (3, [0, 1, 2]),
        "L1": (1, [2]),
        "L2": (1, [2]),
    }
    assert int(np.asarray(Image.open(kept["L0"].pictures[2].file)).mean()) == 20
    listed = json.loads((tmp_path / "crops" / "views.json").read_text())
    listed["L1"]["views"][0]["file"] = "../L1.png"  # a list from anywhere opens nothing outside of the views
    (tmp_path / "crops" / "views.json").write_text(json.dumps(listed | {"L9": 3, "L8": {"count": 1, "views": [7]}}))
    assert {name: len(seen.pictures) for name, seen in RunFolder(tmp_path).views.items()} == {"L0": 3, "L1": 0, "L2": 1, "L8": 0}
    write_thumbnails(tmp_path / "none", {}, image)
    assert sorted(path.name for path in (tmp_path / "none").iterdir()) == ["views", "views.json"]


def test_views_are_spread_over_the_time_a_landmark_was_seen() -> None:
    views = [Crop(k, np.zeros(4), value=float(k % 5)) for k in range(50)]
    kept = spread_views(views, 10)
    assert [view.frame for view in kept] == list(range(4, 50, 5))  # the best of each stretch
    assert spread_views(views[:7], 10) == views[:7]


def test_a_crop_shows_the_box_with_a_margin() -> None:
    image = np.zeros((100, 200, 3), dtype=np.uint8)
    image[40:60, 80:120] = 255
    part = cut(image, np.array([80.0, 40.0, 120.0, 60.0]))
    assert part.shape == (LONGEST // 2, LONGEST, 3)  # 40 x 20 px with 15 % on each side, enlarged
    assert (part[48, 96] == 255).all() and (part[2, 2] == 0).all()
    assert cut(image, np.array([80.0, 40.0, 100.0, 60.0])).shape == (4 * 26, 4 * 26, 3)  # no more than four times
    assert max(cut(image, np.array([-5.0, -5.0, 205.0, 105.0])).shape) == LONGEST
    assert min(cut(image, np.array([199.9, 99.9, 200.0, 100.0])).shape) >= 1
