"""MS-COCO: the boxes of one `instances_*.json`; crowds are regions to ignore."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.data.converters.archives import ArchiveImage, ArchiveObject
from nolbo_ppl.data.converters.voc import known_category
from nolbo_ppl.errors import input_error
from nolbo_ppl.io.files import read_json


def _lists(content: Any, file: Path) -> dict[str, list[dict[str, Any]]]:
    wanted = ("images", "annotations", "categories")
    if not isinstance(content, dict) or not all(isinstance(content.get(name), list) for name in wanted):
        raise input_error(
            "not a COCO file of instances", expected='{"images": [], "annotations": [], "categories": []}', file=file
        )
    for name in wanted:
        if not all(isinstance(row, dict) and "id" in row for row in content[name]):
            raise input_error(f"{name} of a COCO file", expected="objects with an id", file=file)
    return {name: content[name] for name in wanted}


def _box(row: dict[str, Any], file: Path) -> tuple[float, float, float, float]:
    value = row.get("bbox")
    numbers = isinstance(value, list) and len(value) == 4 and all(type(v) in (int, float) and np.isfinite(v) for v in value)
    if not numbers or value[2] < 0 or value[3] < 0:  # type: ignore[index]
        raise input_error(f"bbox of annotation {row['id']}", got=value, expected="[x, y, width, height] in px", file=file)
    x, y, width, height = (float(v) for v in value)  # type: ignore[union-attr]
    return x, y, x + width, y + height


def read_coco(
    path: str | PathLike[str],
    images: str | PathLike[str],
    categories: Collection[str] = CATEGORIES,
    *,
    empty: bool = False,
) -> Iterator[ArchiveImage]:
    """Images of a COCO file with their boxes, in its order; objects of other categories are left out.

    Args:
        path: `instances_train2017.json` and the like.
        images: folder of the images.
        categories: names the labels stand for.
        empty: also images without any of these categories: true negatives, since COCO labels every instance.

    Raises:
        InputError: names the file and the annotation.
    """
    file, folder = Path(path), Path(images)
    content = _lists(read_json(file), file)
    names = {row["id"]: known_category(str(row.get("name")), categories) for row in content["categories"]}
    things: dict[Any, list[ArchiveObject]] = defaultdict(list)
    for row in content["annotations"]:
        if row.get("category_id") not in names:
            raise input_error(
                f"category_id of annotation {row['id']}", got=row.get("category_id"), expected="one listed", file=file
            )
        category = names[row["category_id"]]
        if category is not None:
            things[row.get("image_id")].append(ArchiveObject(category, _box(row, file), difficult=bool(row.get("iscrowd"))))
    for row in content["images"]:
        found = things.get(row["id"], [])
        if not found and not empty:
            continue
        image = folder / Path(str(row.get("file_name"))).name
        if not image.is_file():
            raise input_error("image", got=row.get("file_name"), expected=f"a file in {folder}", file=file)
        yield ArchiveImage(image, (int(row["width"]), int(row["height"])), tuple(found))
