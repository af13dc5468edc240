"""One line of `scenes.jsonl`: the labels of one image, written, and read with every check.

A line is `{"image": "images/000000.png", "intrinsics": [fx, fy, cx, cy], "objects": [...]}`; an object is
`{"box": [x0, y0, x1, y1] px, "category", "instance", "rotation": [qx, qy, qz, qw] of R_camera_object, "position":
[x, y, z] m of the box centre in the camera frame, "size": m (box diagonal), "dimensions": [3] m, "visibility",
"symmetry", "confidence", "category_confidence"}`, the last two of labels that a model gave: probabilities that the object is
there and that its category is right. A line may have `"ignore"`, boxes of parts of the image that are not labelled, and
`"exhaustive"`, the categories of which every instance is labelled (all of them when it is missing). Only `image`, `intrinsics`,
`objects` and each object's `box` are required: what is missing is unlabelled.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nolbo_ppl.categories import CATEGORY_SYMMETRY
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.rotation import matrix_to_quaternion, quaternion_to_matrix
from nolbo_ppl.io.fields import is_number
from nolbo_ppl.io.files import inside, is_file
from nolbo_ppl.structures.annotations import Annotations

LARGEST = 1e6
"""Largest number of a line: px, m or a share."""
SMALLEST = 1e-6
"""Least length and focal length, m and px: below, 32 bits and divisions by it make infinities."""
NEAREST = 1e-3
"""Least distance of an object before the camera, m."""
UNIT_TOLERANCE = 1e-3
"""How far a quaternion's length may lie from 1."""
BORDER_TOLERANCE = 1.0
"""How far a box may stick out of its image, px; it is cut to the image."""


def _is_number(value: object) -> bool:
    """A number of a size that objects and images have; true and false are none."""
    return is_number(value, -LARGEST, LARGEST)


class _Line:
    """Where a value came from, for the errors."""

    def __init__(self, file: Path, line: int) -> None:
        self.file, self.line = file, line

    def error(self, what: str, got: object, expected: str, do: str | None = None) -> Exception:
        return input_error(what, got=got, expected=expected, do=do, file=self.file, line=self.line)

    def numbers(self, row: dict[str, Any], field: str, where: str, n: int, expected: str) -> np.ndarray:
        """A list of n finite numbers."""
        value = row.get(field)
        if not isinstance(value, list) or len(value) != n or not all(_is_number(v) for v in value):
            raise self.error(f"{where}{field}", value, expected)
        return np.array(value, dtype=np.float64)

    def number(self, row: dict[str, Any], field: str, where: str, expected: str) -> float:
        """One finite number."""
        value = row[field]
        if not _is_number(value):
            raise self.error(f"{where}{field}", value, expected)
        return float(value)


def _parse_box(at: _Line, row: dict[str, Any], where: str, width: int, height: int) -> np.ndarray:
    """A box inside the image."""
    box = at.numbers(row, "box", where, 4, "[x0, y0, x1, y1] in px")
    if box[0] >= box[2] or box[1] >= box[3]:
        raise at.error(f"{where}box", box.tolist(), "x0 < x1 and y0 < y1")
    limit = np.array([width, height, width, height])
    if (box < -BORDER_TOLERANCE).any() or (box > limit + BORDER_TOLERANCE).any():
        raise at.error(f"{where}box", box.tolist(), f"inside the image of {width} x {height} px", "cut it to the image")
    inside: np.ndarray = np.clip(box, 0, limit)
    return inside


def _parse_rotation(at: _Line, row: dict[str, Any], where: str) -> np.ndarray:
    quaternion = at.numbers(row, "rotation", where, 4, "[qx, qy, qz, qw] of R_camera_object")
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1) > UNIT_TOLERANCE:
        raise at.error(f"{where}rotation", f"{quaternion.tolist()} of length {length:.6g}", "a unit quaternion")
    return quaternion_to_matrix(torch.from_numpy(quaternion)).numpy()


def _parse_object(
    at: _Line, row: object, number: int, width: int, height: int, categories: Sequence[str], symmetries: Mapping[str, int]
) -> dict[str, Any]:
    where = f"objects[{number}]."
    if not isinstance(row, dict):
        raise at.error(f"objects[{number}]", row, 'an object such as {"box": [x0, y0, x1, y1]}')
    box = _parse_box(at, row, where, width, height)
    known = {field for field, value in row.items() if value is not None}
    category = row["category"] if "category" in known else None
    if category is not None and category not in categories:
        raise at.error(f"{where}category", repr(category), "one of " + ", ".join(categories))
    instance = row["instance"] if "instance" in known else None
    if instance is not None and not isinstance(instance, str):
        raise at.error(f"{where}instance", repr(instance), "a name (string)")
    R = _parse_rotation(at, row, where) if "rotation" in known else None
    position = size = None
    if "position" in known:
        position = at.numbers(row, "position", where, 3, "[x, y, z] in m")
        if position[2] < NEAREST:
            raise at.error(f"{where}position", position.tolist(), "a point before the camera (z > 0)")
    if "size" in known:
        size = at.number(row, "size", where, "the box diagonal in m, positive")
        if size < SMALLEST:
            raise at.error(f"{where}size", size, "the box diagonal in m, positive")
    dimensions = None
    if "dimensions" in known:
        dimensions = at.numbers(row, "dimensions", where, 3, "three side lengths in m, positive")
        if (dimensions < SMALLEST).any():
            raise at.error(f"{where}dimensions", dimensions.tolist(), "three side lengths in m, positive")
    visibility = at.number(row, "visibility", where, "a share from 0 to 1") if "visibility" in known else 1.0
    if not 0 <= visibility <= 1:
        raise at.error(f"{where}visibility", visibility, "a share from 0 to 1")
    symmetry = row["symmetry"] if "symmetry" in known else symmetries.get(category or "", 1)
    if isinstance(symmetry, bool) or not isinstance(symmetry, int) or symmetry < 0:
        raise at.error(f"{where}symmetry", symmetry, "0 (free about the vertical axis), 1 (none) or n (n-fold)")
    sure: dict[str, float | None] = {}
    for field in ("confidence", "category_confidence"):
        sure[field] = at.number(row, field, where, "a probability above 0") if field in known else None
        value = sure[field]
        if value is not None and not 0 < value <= 1:
            raise at.error(f"{where}{field}", value, "a probability above 0, at most 1")
    name = row["id"] if "id" in known else None
    return {
        **sure,
        "box": box,
        "category": category,
        "instance": instance,
        "id": None if name is None else str(name),
        "R_camera_object": R,
        "position": position,
        "diagonal": size,
        "dimensions": dimensions,
        "visibility": visibility,
        "symmetry": symmetry,
    }


def parse_record(
    row: dict[str, Any],
    file: Path,
    line: int,
    categories: Sequence[str],
    image_size: tuple[int, int],
    image: Path,
    symmetries: Mapping[str, int] = CATEGORY_SYMMETRY,
) -> Annotations:
    """Check one line and turn it into the annotations of its image.

    Args:
        row: the parsed JSON.
        file: the file it came from.
        line: its line, from 1.
        categories: known category names.
        image_size: width and height of the image, px.
        image: path of the image.
        symmetries: symmetry of an object that states none, by category; 1 for names that are missing.

    Raises:
        InputError: names file, line and field, what was got and what was expected.
    """
    at = _Line(file, line)
    expected = "[fx, fy, cx, cy] in px, all positive"
    intrinsics = at.numbers(row, "intrinsics", "", 4, expected)
    if (intrinsics < SMALLEST).any():
        raise at.error("intrinsics", intrinsics.tolist(), expected)
    objects = row.get("objects")
    if not isinstance(objects, list):
        raise at.error("objects", objects, "a list of objects (empty when there is none)")
    parsed = [_parse_object(at, thing, k, *image_size, categories, symmetries) for k, thing in enumerate(objects)]
    regions = [] if row.get("ignore") is None else row["ignore"]
    if not isinstance(regions, list):
        raise at.error("ignore", regions, "a list of boxes [x0, y0, x1, y1] in px")
    exhaustive = row.get("exhaustive")
    if exhaustive is not None and not (isinstance(exhaustive, list) and all(name in list(categories) for name in exhaustive)):
        raise at.error("exhaustive", exhaustive, "a list of categories among " + ", ".join(categories))
    ignore = [_parse_box(at, {"box": box}, f"ignore[{k}].", *image_size) for k, box in enumerate(regions)]
    columns: tuple[str, ...] = ("box", "category", "instance", "id", "R_camera_object", "position", "diagonal", "dimensions")
    columns += ("visibility", "symmetry", "confidence", "category_confidence")
    values: dict[str, Any] = {name: [thing[name] for thing in parsed] for name in columns}
    return Annotations.from_arrays(intrinsics, **values, ignore=ignore, exhaustive=exhaustive, file=image)


def annotations_record(scene: Annotations, image: str) -> dict[str, Any]:
    """The line of an image's annotations: px, m and shares to 1e-6, quaternions to 1e-9; what is missing stays away.

    Args:
        scene: the labels.
        image: path of the image, relative to the folder of the file.
    """

    def rounded(values: np.ndarray) -> list[float]:
        return [round(float(v), 6) for v in values]

    objects = []
    for k in range(len(scene)):
        row: dict[str, Any] = {"category": scene.category[k], "instance": scene.instance[k], "box": rounded(scene.box[k])}
        if np.isfinite(scene.R_camera_object[k]).all():
            quaternion = matrix_to_quaternion(torch.from_numpy(scene.R_camera_object[k]))
            row["rotation"] = [round(v, 9) for v in quaternion.tolist()]
        if np.isfinite(scene.position[k]).all():
            row["position"] = rounded(scene.position[k])
        if np.isfinite(scene.diagonal[k]):
            row["size"] = round(float(scene.diagonal[k]), 6)
        if np.isfinite(scene.dimensions[k]).all():
            row["dimensions"] = rounded(scene.dimensions[k])
        for field in ("confidence", "category_confidence"):
            values = getattr(scene, field)
            row[field] = None if values is None else round(float(values[k]), 6)
        row |= {"visibility": round(float(scene.visibility[k]), 6), "symmetry": int(scene.symmetry[k]), "id": scene.id[k]}
        objects.append({name: value for name, value in row.items() if value is not None})
    line: dict[str, Any] = {"image": image, "intrinsics": rounded(scene.intrinsics), "objects": objects}
    if len(scene.ignore):
        line["ignore"] = [rounded(box) for box in scene.ignore]
    if scene.exhaustive is not None:
        line["exhaustive"] = list(scene.exhaustive)
    return line


def image_field(row: dict[str, Any], folder: Path, file: Path, line: int) -> Path:
    """Path of a line's image, which must exist."""
    name = row.get("image")
    if not isinstance(name, str) or not name:
        raise input_error("image", got=name, expected="a path relative to the folder", file=file, line=line)
    path = inside(folder, name, follow=True)
    if path is None:
        do = "link the images into the folder"
        raise input_error("image", got=name, expected="a path within the folder", do=do, file=file, line=line)
    if not is_file(path):
        raise input_error(
            "image",
            got=name,
            expected=f"an image file in {folder}",
            do="is the data set complete?",
            file=file,
            line=line,
        )
    return path
