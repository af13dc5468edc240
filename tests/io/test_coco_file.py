"""COCO's JSON: what belongs to an image is put together, and what cannot be used is named."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.io.coco_file import read_coco_images


def write(folder: Path, **changes: Any) -> Path:
    content: dict[str, Any] = {
        "images": [{"id": k, "file_name": f"{k}.jpg", "width": 10 * k, "height": 5, "source": "s"} for k in (2, 1)],
        "annotations": [
            {"id": 5, "image_id": 1, "category_id": 9, "bbox": [1, 2, 3, 4]},
            {"id": 6, "image_id": 1, "category_id": 3, "bbox": [0, 0, 1.5, 1], "iscrowd": 1, "azimuth": 30},
        ],
        "categories": [{"id": 3, "name": "car"}, {"id": 9, "name": "boat"}],
    } | changes
    file = folder / "instances.json"
    file.write_text(json.dumps(content), encoding="utf-8")
    return file


def test_objects_come_with_their_image_in_the_order_of_the_file(tmp_path: Path) -> None:
    second, first = read_coco_images(write(tmp_path), tmp_path / "images")
    assert (second.path, second.size, second.annotations) == (tmp_path / "images" / "2.jpg", (20, 5), ())
    assert [one.category for one in first.annotations] == ["boat", "car"]
    assert [one.box for one in first.annotations] == [(1.0, 2.0, 4.0, 6.0), (0.0, 0.0, 1.5, 1.0)]
    assert [one.crowd for one in first.annotations] == [False, True]
    assert first.annotations[1].fields["azimuth"] == 30 and first.fields["source"] == "s"


IMAGE = {"id": 1, "file_name": "a.jpg", "width": 3, "height": 3}
OBJECT = {"id": 5, "image_id": 1, "category_id": 9, "bbox": [1, 2, 3, 4]}


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"images": None}, "not a COCO file"),
        ({"images": [{"file_name": "a.jpg"}]}, "images of a COCO file"),
        ({"categories": [{"id": [1], "name": "car"}]}, "categories of a COCO file"),
        ({"annotations": [7]}, "annotations of a COCO file"),
        ({"images": [IMAGE | {"file_name": "../a.jpg"}]}, "file_name of image 1"),
        ({"images": [IMAGE | {"file_name": 4}]}, "file_name of image 1"),
        ({"images": [IMAGE | {"width": "3"}]}, "size of image 1"),
        ({"images": [IMAGE | {"height": 0}]}, "size of image 1"),
        ({"annotations": [OBJECT | {"category_id": 1}]}, "category_id of annotation 5"),
        ({"annotations": [OBJECT | {"category_id": [9]}]}, "category_id of annotation 5"),
        ({"annotations": [OBJECT | {"image_id": {}}]}, "image_id of annotation 5"),
        ({"annotations": [OBJECT | {"bbox": [1, 2, -3, 4]}]}, "bbox of annotation 5"),
        ({"annotations": [OBJECT | {"bbox": [1, 2, float("nan"), 4]}]}, "bbox of annotation 5|NaN"),
    ],
)
def test_what_cannot_be_used_is_named(tmp_path: Path, changes: dict[str, Any], match: str) -> None:
    with pytest.raises(InputError, match=match):
        read_coco_images(write(tmp_path, **changes), tmp_path)
