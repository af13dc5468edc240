"""Pix3D: photographs of furniture with the true camera and a CAD model aligned with the object, one object an image.

`ROOT/pix3d.json` is a list of rows with `img`, `category`, `img_size`, `bbox`, `model`, `rot_mat`, `trans_mat`, `focal_length`
(mm on a sensor 32 mm wide), `truncated`, `occluded` and `slightly_occluded`. X. Sun et al.: Pix3D, CVPR 2018.

Its camera looks along +z with x to the left and y up, and a model in its canonical view has x to the left, y up, and z away from
who looks: the front faces -z. Both are turned here: R_camera_object = diag(-1, -1, 1) R A', A taking the model's axes to the
library's (x right, y away, z up).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nolbo_ppl.categories import PAPER_CATEGORIES
from nolbo_ppl.data.converters.archives import ArchiveImage, ArchiveObject
from nolbo_ppl.data.converters.voc import known_category
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.rotation import egocentric_to_allocentric, matrix_to_viewpoint
from nolbo_ppl.io.files import read_json, read_text

SENSOR = 32.0
"""Width of the sensor that focal lengths are stated for, mm."""
RENAMED = {"bookcase": "bookshelf", "table": "diningtable"}
"""Words of Pix3D for categories that the library names otherwise."""
CAMERA = np.diag([-1.0, -1.0, 1.0])
"""From Pix3D's camera (left, up, forward) to the library's (right, down, forward)."""
MODEL = np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]])
"""From the axes of a model (left, up, away) to the library's (right, away, up)."""


def _numbers(row: dict[str, Any], name: str, shape: tuple[int, ...], where: str, file: Path) -> np.ndarray:
    try:
        value = np.asarray(row.get(name), dtype=np.float64)
    except (TypeError, ValueError):
        value = np.zeros(0)
    if value.shape != shape or not np.isfinite(value).all():
        raise input_error(f"{where}.{name}", got=row.get(name), expected=f"finite numbers of shape {shape}", file=file)
    return value


def pix3d_viewpoint(R: np.ndarray, translation: np.ndarray) -> tuple[float, float, float]:
    """Allocentric azimuth, elevation and in-plane rotation, rad, of a row's `rot_mat` and `trans_mat`."""
    R_camera_object = torch.from_numpy(CAMERA @ R @ MODEL.T)
    ray = torch.from_numpy(CAMERA @ translation)
    azimuth, elevation, theta = matrix_to_viewpoint(egocentric_to_allocentric(R_camera_object, ray)).tolist()
    return azimuth, elevation, theta


def read_pix3d(
    root: str | PathLike[str], split: str | PathLike[str] | None = None, categories: Collection[str] = PAPER_CATEGORIES
) -> Iterator[ArchiveImage]:
    """Images of Pix3D with their one labelled object, in the order of pix3d.json; other categories are left out.

    No category is labelled exhaustively. An object counts as occluded where the archive says so or says slightly so.

    Args:
        root: folder with pix3d.json.
        split: list of images, a name a line as `img/sofa/0001.png`, or COCO-style JSON with `images[].file_name`.
        categories: names the labels stand for.

    Raises:
        InputError: names the file and the row's field.
    """
    root = Path(root)
    file = root / "pix3d.json"
    rows = read_json(file)
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise input_error("not a file of Pix3D", expected="a list of objects", file=file)
    wanted = None if split is None else _split(Path(split))
    known_names = {str(row.get("img")) for row in rows}
    if wanted is not None and (strange := sorted(wanted - known_names)):
        raise input_error("images of a split", got=strange[:3], expected="names of pix3d.json", file=split)
    for number, row in enumerate(rows):
        where = f"[{number}]"
        name = str(row.get("img"))
        if wanted is not None and name not in wanted:
            continue
        stated = str(row.get("category"))
        category = known_category(RENAMED.get(stated, stated), categories)
        if category is None:
            continue
        image = root / name
        if not image.is_file():
            raise input_error(f"{where}.img", got=name, expected="an image of the archive", file=file)
        width, height = _numbers(row, "img_size", (2,), where, file)
        box = _numbers(row, "bbox", (4,), where, file)
        if box[0] >= box[2] or box[1] >= box[3]:
            raise input_error(f"{where}.bbox", got=box.tolist(), expected="x0 < x1 and y0 < y1", file=file)
        R = _numbers(row, "rot_mat", (3, 3), where, file)
        if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
            raise input_error(f"{where}.rot_mat", got=R.tolist(), expected="a rotation", file=file)
        translation = _numbers(row, "trans_mat", (3,), where, file)
        if translation[2] <= 0:
            raise input_error(f"{where}.trans_mat", got=translation.tolist(), expected="a point before the camera", file=file)
        focal = float(_numbers(row, "focal_length", (), where, file)) / SENSOR * width
        if not focal > 0:
            raise input_error(f"{where}.focal_length", got=row.get("focal_length"), expected="above 0", file=file)
        thing = ArchiveObject(
            category,
            (float(box[0]), float(box[1]), float(box[2]), float(box[3])),
            pix3d_viewpoint(R, translation),
            str(row["model"]) if isinstance(row.get("model"), str) else None,
            truncated=bool(row.get("truncated")),
            occluded=bool(row.get("occluded")) or bool(row.get("slightly_occluded")),
        )
        camera = (focal, focal, float(width) / 2, float(height) / 2)
        yield ArchiveImage(image, (int(width), int(height)), (thing,), exhaustive=(), intrinsics=camera)


def _split(file: Path) -> set[str]:
    if file.suffix != ".json":
        return {line.strip() for line in read_text(file).splitlines() if line.strip()}
    content = read_json(file)
    images = content.get("images") if isinstance(content, dict) else None
    if not isinstance(images, list) or not all(isinstance(row, dict) and isinstance(row.get("file_name"), str) for row in images):
        raise input_error("not a split", expected='{"images": [{"file_name": ...}]}', file=file)
    return {row["file_name"] for row in images}


def pix3d_models(root: str | PathLike[str], names: Collection[str]) -> dict[str, Path]:
    """The file of each model that annotations name. Raises `InputError` where one is missing."""
    found = {name: Path(root) / name for name in sorted(names)}
    for name, file in found.items():
        if not file.is_file():
            raise input_error("CAD model of an annotation", got=name, expected="a file of the archive", file=root)
    return found
