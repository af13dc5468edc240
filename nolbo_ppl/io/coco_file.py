"""COCO's JSON of labelled images: `images`, `annotations` and `categories`, put together and checked."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from nolbo_ppl.errors import input_error
from nolbo_ppl.io.files import read_json


@dataclass(frozen=True)
class CocoAnnotation:
    """One labelled object."""

    category: str
    """Name of its category, as the file has it."""
    box: tuple[float, float, float, float]
    """[x0, y0, x1, y1], px, from 0."""
    crowd: bool
    """A region with many objects that are not told apart."""
    fields: Mapping[str, Any]
    """All that the file says of it."""


@dataclass(frozen=True)
class CocoImage:
    """One image with its objects."""

    path: Path
    """The image file."""
    size: tuple[int, int]
    """Width and height, px."""
    annotations: tuple[CocoAnnotation, ...]
    """Its objects, in the order of the file."""
    fields: Mapping[str, Any]
    """All that the file says of it."""


def read_coco_images(path: str | PathLike[str], images: str | PathLike[str]) -> list[CocoImage]:
    """Images of a file of instances with their objects, in its order.

    Args:
        path: `instances_train2017.json` and the like.
        images: folder of the images; they need not be there yet.

    Raises:
        InputError: names the file, and the entry that cannot be used.

    Example:
        >>> import json, pathlib, tempfile
        >>> file = pathlib.Path(tempfile.mkdtemp()) / "val.json"
        >>> content = {"images": [{"id": 1, "file_name": "a.png", "width": 90, "height": 60}],
        ...            "annotations": [{"id": 7, "image_id": 1, "category_id": 6, "bbox": [10, 20, 40, 30]}],
        ...            "categories": [{"id": 6, "name": "car"}]}
        >>> _ = file.write_text(json.dumps(content))
        >>> read_coco_images(file, "images")[0].annotations[0].box
        (10.0, 20.0, 50.0, 50.0)
    """
    file, folder = Path(path), Path(images)
    content = coco_lists(file)
    names = {row["id"]: str(row.get("name")) for row in content["categories"]}
    of_image: dict[Any, list[CocoAnnotation]] = defaultdict(list)
    for row in content["annotations"]:
        if not isinstance(row.get("image_id"), int | str):
            raise input_error(f"image_id of annotation {row['id']}", got=row.get("image_id"), expected="an id", file=file)
        if not isinstance(row.get("category_id"), int | str) or row["category_id"] not in names:
            raise input_error(
                f"category_id of annotation {row['id']}", got=row.get("category_id"), expected="one listed", file=file
            )
        of_image[row["image_id"]].append(
            CocoAnnotation(names[row["category_id"]], _box(row, file), bool(row.get("iscrowd")), row)
        )
    return [
        CocoImage(_path(row, folder, file), _size(row, file), tuple(of_image.get(row["id"], ())), row)
        for row in content["images"]
    ]


def coco_lists(file: Path) -> dict[str, list[dict[str, Any]]]:
    """`images`, `annotations` and `categories` of a file, each a list of objects with an id. Raises `InputError` naming it."""
    content, wanted = read_json(file), ("images", "annotations", "categories")
    if not isinstance(content, dict) or not all(isinstance(content.get(name), list) for name in wanted):
        raise input_error("not a COCO file", expected='{"images": [...], "annotations": [...], "categories": [...]}', file=file)
    for name in wanted:
        for row in content[name]:
            if not isinstance(row, dict) or not isinstance(row.get("id"), int | str):
                raise input_error(f"{name} of a COCO file", got=row, expected="objects with an id", file=file)
    return {name: content[name] for name in wanted}


def _path(row: Mapping[str, Any], folder: Path, file: Path) -> Path:
    name = row.get("file_name")
    if not isinstance(name, str) or not name or ".." in Path(name).parts or Path(name).is_absolute():
        raise input_error(
            f"file_name of image {row['id']}", got=name, expected="a name within the folder of the images", file=file
        )
    return folder / name


def _size(row: Mapping[str, Any], file: Path) -> tuple[int, int]:
    width, height = row.get("width"), row.get("height")
    if type(width) is not int or type(height) is not int or min(width, height) < 1:
        raise input_error(f"size of image {row['id']}", got=(width, height), expected="width and height in px", file=file)
    return width, height


def _box(row: Mapping[str, Any], file: Path) -> tuple[float, float, float, float]:
    value = row.get("bbox")
    numbers = isinstance(value, list) and len(value) == 4 and all(type(v) in (int, float) and np.isfinite(v) for v in value)
    if not numbers or value[2] < 0 or value[3] < 0:  # type: ignore[index]
        raise input_error(f"bbox of annotation {row['id']}", got=value, expected="[x, y, width, height] in px", file=file)
    x, y, width, height = (float(v) for v in value)  # type: ignore[union-attr]
    return x, y, x + width, y + height
