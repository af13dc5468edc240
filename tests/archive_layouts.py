"""Tiny data sets in the layouts that archives are distributed in: random pictures, boxes for CAD models."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.io import savemat


def picture(path: Path, width: int = 96, height: int = 80, seed: int = 0) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.random.default_rng(seed).integers(0, 255, (height, width, 3), dtype=np.uint8)).save(path)
    return path


def box_off(path: Path, x: float, y: float, z: float) -> Path:
    """A closed box as an OFF file, its header as ModelNet40 writes some."""
    path.parent.mkdir(parents=True, exist_ok=True)
    corners = [(x * i, y * j, z * k) for k in (0, 1) for j in (0, 1) for i in (0, 1)]
    faces = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    lines = ["OFF8 6 0", *(f"{a} {b} {c}" for a, b, c in corners), *(f"4 {' '.join(map(str, face))}" for face in faces)]
    path.write_text("\n".join(lines) + "\n")
    return path


def make_imagenet(root: Path, train: int = 4, val: int = 2) -> Path:
    for number, name in enumerate(("n01440764", "n02102040")):
        for k in range(train):
            picture(root / "train" / name / f"{name}_{k}.JPEG", seed=10 * number + k)
        for k in range(val):
            picture(root / "val" / name / f"ILSVRC2012_val_{number}{k}.JPEG", seed=100 + 10 * number + k)
    return root


def make_ilsvrc(root: Path, by_csv: bool = False) -> Path:
    """The archive as it comes: validation flat, its labels in XML files or in one table."""
    data, notes = root / "ILSVRC" / "Data" / "CLS-LOC", root / "ILSVRC" / "Annotations" / "CLS-LOC" / "val"
    rows = ["ImageId,PredictionString"]
    for number, name in enumerate(("n01440764", "n02102040")):
        picture(data / "train" / name / f"{name}_1.JPEG", seed=number)
        stem = f"ILSVRC2012_val_0000000{number}"
        picture(data / "val" / f"{stem}.JPEG", seed=20 + number)
        rows.append(f"{stem},{name} 1 2 30 40 ")
        if not by_csv:
            notes.mkdir(parents=True, exist_ok=True)
            (notes / f"{stem}.xml").write_text(f"<annotation><object><name>{name}</name></object></annotation>")
    if by_csv:
        (root / "LOC_val_solution.csv").write_text("\n".join(rows) + "\n")
    return root


def make_rendered(root: Path) -> Path:
    for synset in ("02958343", "03001627"):
        for shape in ("1a2b", "3c4d"):
            for k, angles in enumerate(("a030_e020_t-05_d002", "a200_e-03_t010_d003", "a359_e000_t000_d002")):
                picture(root / synset / shape / f"{synset}_{shape}_{angles}.png", 60, 40, seed=k)
    return root


def make_modelnet(root: Path) -> Path:
    sizes = {"table": (2.0, 1.0, 0.2), "lamp": (0.3, 0.3, 1.5)}
    for name, (x, y, z) in sizes.items():
        for number, split in enumerate(("train", "train", "test"), start=1):
            box_off(root / name / split / f"{name}_{number:04d}.off", x * (1 + 0.1 * number), y, z)
    return root


def make_pascal(root: Path, scenes: int = 6) -> Path:
    """Cars and chairs with viewpoints and CAD models: `scenes` of each for training, two for validation."""
    for offset, name in enumerate(("car", "chair")):
        (root / "Annotations" / f"{name}_imagenet").mkdir(parents=True, exist_ok=True)
        stems: dict[str, list[str]] = {"train": [], "val": []}
        for k in range(scenes + 2):
            stem = f"n{offset}{k}"
            thing: dict[str, Any] = {
                "class": name, "bbox": [11.0 + k, 21.0, 70.0, 70.0], "cad_index": 1 + k % 2, "truncated": 0, "occluded": 0,
                "difficult": 0,
                "viewpoint": {"azimuth": 37.0 * k, "elevation": 10.0, "theta": 2.0, "distance": 8.0, "focal": 1.0},
            }  # fmt: skip
            record = {"record": {"filename": f"{stem}.JPEG", "objects": [thing]}}
            savemat(root / "Annotations" / f"{name}_imagenet" / f"{stem}.mat", record)
            picture(root / "Images" / f"{name}_imagenet" / f"{stem}.JPEG", seed=k + 50 * offset)
            stems["train" if k < scenes else "val"].append(stem)
        (root / "Image_sets").mkdir(exist_ok=True)
        for split, names in stems.items():
            (root / "Image_sets" / f"{name}_imagenet_{split}.txt").write_text("\n".join(names) + "\n")
        for index in (1, 2):
            box_off(root / "CAD" / name / f"{index:02d}.off", 1.0 + index, 1.0, 0.5 + offset)
    return root


def pix3d_row(**changes: Any) -> dict[str, Any]:
    """A row of pix3d.json, in the canonical view two units before the camera."""
    row = {
        "img": "img/sofa/0001.png", "category": "sofa", "img_size": [96, 80], "bbox": [20, 30, 70, 60],
        "model": "model/sofa/A/model.obj",
        "rot_mat": np.eye(3).tolist(), "trans_mat": [0.0, 0.0, 2.0], "focal_length": 32.0, "truncated": False, "occluded": False,
        "slightly_occluded": False,
    }  # fmt: skip
    return {**row, **changes}


def make_pix3d(root: Path, rows: list[dict[str, Any]]) -> Path:
    for row in rows:
        picture(root / row["img"], *row["img_size"])
        model = root / row["model"]
        model.parent.mkdir(parents=True, exist_ok=True)
        corners = [(i, j, k) for k in (-0.25, 0.25) for j in (-0.2, 0.2) for i in (-0.5, 0.5)]
        faces = [(1, 3, 4, 2), (5, 6, 8, 7), (1, 2, 6, 5), (3, 7, 8, 4), (1, 5, 7, 3), (2, 4, 8, 6)]
        lines = [*(f"v {a} {b} {c}" for a, b, c in corners), *(f"f {' '.join(map(str, face))}" for face in faces)]
        model.write_text("\n".join(lines) + "\n")
    (root / "pix3d.json").write_text(json.dumps(rows))
    return root


BOP_CAMERA = np.array([[100.0, 0, 47.5], [0, 110.0, 39.0], [0, 0, 1]])
"""K of every image of `make_bop`: pixel centres at whole numbers."""


def bop_truth(number: int) -> tuple[np.ndarray, np.ndarray]:
    """cam_R_m2c and cam_t_m2c (mm) of the one object of an image: seen from the front, turned further in every image."""
    angle = 0.3 * number
    upright = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # the model's z is the camera's -y
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return upright @ turn, np.array([40.0 * number - 60, 20.0, 900.0 + 50 * number])


def make_bop(root: Path, images: int = 3, split: str = "test", scene: int = 48, camera: str = "camera_uw.json") -> Path:
    """One scene of a box (object 2) off the origin of its model; boxes by projecting its points, as BOP's tools make them."""
    low, size = np.array([-30.0, -20.0, 5.0]), np.array([120.0, 60.0, 200.0])
    (root / "models").mkdir(parents=True, exist_ok=True)
    stated = dict(zip(("min_x", "min_y", "min_z", "size_x", "size_y", "size_z"), [*low.tolist(), *size.tolist()]))
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0]).flatten().tolist()
    upside_down = np.diag([1.0, -1.0, -1.0, 1.0]).flatten().tolist()
    info = {
        "1": {**stated, "diameter": 250.0, "symmetries_continuous": [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]},
        "2": {**stated, "diameter": 250.0, "symmetries_discrete": [half_turn, upside_down]},
    }
    (root / "models" / "models_info.json").write_text(json.dumps(info))
    for number in (1, 2):
        corners = [low + size * (i, j, k) for k in (0, 1) for j in (0, 1) for i in (0, 1)]
        faces = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
        head = ["ply", "format ascii 1.0", "element vertex 8", *(f"property float {axis}" for axis in "xyz"), "element face 6"]
        lines = [*head, "property list uchar int vertex_indices", "end_header", *(f"{a} {b} {c}" for a, b, c in corners)]
        lines += [f"4 {' '.join(map(str, face))}" for face in faces]
        (root / "models" / f"obj_{number:06d}.ply").write_text("\n".join(lines) + "\n")
    (root / camera).write_text("{}")
    folder = root / split / f"{scene:06d}"
    truth, cameras, about = {}, {}, {}
    grid = np.stack(np.meshgrid(*[np.linspace(0, 1, 41)] * 3), -1).reshape(-1, 3)
    for number in range(1, images + 1):
        picture(folder / "rgb" / f"{number:06d}.png", seed=number)
        R, t = bop_truth(number)
        points = (low + size * grid) @ R.T + t
        pixels = np.round(points / points[:, 2:] @ BOP_CAMERA.T)[:, :2].astype(int)
        corner, extent = pixels.min(0), pixels.max(0) - pixels.min(0)
        box = [*corner.tolist(), *extent.tolist()]
        depth = np.full((80, 96), round((t[2] + 2.5) / 0.1), dtype=np.uint16)  # a wall through the object, steps of 0.1 mm
        (folder / "depth").mkdir(exist_ok=True)
        Image.fromarray(depth).save(folder / "depth" / f"{number:06d}.png")
        truth[str(number)] = [{"obj_id": 2, "cam_R_m2c": R.flatten().tolist(), "cam_t_m2c": t.tolist()}]
        turn = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # the world's x is forward, its z up
        centre = np.array([100.0 * number, 2000.0, 1500.0])
        cameras[str(number)] = {
            "cam_K": BOP_CAMERA.flatten().tolist(), "depth_scale": 0.1, "cam_R_w2c": turn.flatten().tolist(),
            "cam_t_w2c": (-turn @ centre).tolist(),
        }  # fmt: skip
        about[str(number)] = [{"bbox_obj": box, "bbox_visib": box, "visib_fract": 1.0, "px_count_all": 9}]
    for name, content in (("scene_gt", truth), ("scene_camera", cameras), ("scene_gt_info", about)):
        (folder / f"{name}.json").write_text(json.dumps(content))
    return root
