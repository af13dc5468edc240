"""Labelled photographs (COCO's JSON) as scenes to learn from and to evaluate on.

Beside COCO's own fields an image may have `exhaustive`, the categories of which every instance is labelled (all of them when
it is missing), and an annotation `difficult` and a viewpoint `azimuth`, `elevation`, `theta` in degrees (PASCAL3D+).
"""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.data.converters.archives import ArchiveImage, ArchiveObject, write_archive
from nolbo_ppl.errors import input_error
from nolbo_ppl.io.files import read_json


@dataclass(frozen=True)
class Photograph:
    """One labelled photograph."""

    image: Path
    width: int
    height: int
    source: str
    """Name of the collection it is from; empty when it is not stated."""
    exhaustive: frozenset[int]
    """Categories of which every instance is labelled."""
    box: Float[np.ndarray, "m 4"]
    """[x0, y0, x1, y1], px."""
    category: Int[np.ndarray, " m"]
    ignore: Bool[np.ndarray, " m"]
    """Crowds and difficult objects: neither to be found nor to be missed."""
    viewpoint: Float[np.ndarray, "m 3"]
    """Allocentric azimuth, elevation, in-plane rotation, rad; NaN where unknown."""
    licence: str = field(default="")


def read_photographs(
    path: str | os.PathLike[str], images: str | os.PathLike[str] | None = None, categories: Sequence[str] = CATEGORIES
) -> list[Photograph]:
    """The photographs of a COCO-style file, in its order; annotations of other categories are left out.

    Args:
        path: the JSON file, or a folder with `val.json`.
        images: folder of the images; `images` beside the file by default.
        categories: names the labels stand for.

    Raises:
        InputError: the file or an entry cannot be used, naming it.
    """
    file = Path(path)
    file = file / "val.json" if file.is_dir() else file
    folder = file.parent / "images" if images is None else Path(images)
    content = read_json(file)
    if not isinstance(content, dict) or not all(
        isinstance(content.get(k), list) for k in ("images", "annotations", "categories")
    ):
        raise input_error("not a COCO file", expected='{"images": [...], "annotations": [...], "categories": [...]}', file=file)
    label = {one["id"]: categories.index(one["name"]) for one in content["categories"] if one.get("name") in categories}
    of_image: dict[Any, list[dict[str, Any]]] = defaultdict(list)
    for row in content["annotations"]:
        of_image[row.get("image_id")].append(row)
    found = []
    for row in content["images"]:
        name = row.get("file_name")
        if not isinstance(name, str) or not (folder / name).is_file():
            raise input_error("image", got=name, expected=f"an image file in {folder}", file=file)
        things = [_thing(one, label, file) for one in of_image[row.get("id")] if one.get("category_id") in label]
        known = row.get("exhaustive")
        found.append(
            Photograph(
                folder / name, int(row["width"]), int(row["height"]), str(row.get("source", "")),
                frozenset(range(len(categories)) if known is None else (categories.index(c) for c in known if c in categories)),
                np.array([thing[0] for thing in things], dtype=np.float64).reshape(-1, 4),
                np.array([thing[1] for thing in things], dtype=np.int64),
                np.array([thing[2] for thing in things], dtype=bool),
                np.array([thing[3] for thing in things], dtype=np.float64).reshape(-1, 3),
                str(row.get("licence", "")),
            )
        )  # fmt: skip
    if not found:
        raise input_error("a data set without images", got=file, expected="at least one")
    return found


def _thing(row: dict[str, Any], label: dict[Any, int], file: Path) -> tuple[list[float], int, bool, list[float]]:
    box = row.get("bbox")
    if not isinstance(box, list) or len(box) != 4 or not np.isfinite(np.array(box, dtype=np.float64)).all():
        raise input_error(f"bbox of annotation {row.get('id')}", got=box, expected="[x, y, width, height] in px", file=file)
    x, y, width, height = (float(v) for v in box)
    angles = [float("nan")] * 3
    if row.get("azimuth") is not None:
        angles = [float(np.radians(row.get(name) or 0.0)) for name in ("azimuth", "elevation", "theta")]
        angles[2] = -angles[2]  # these poses turn the picture clockwise, PASCAL3D+ the other way (seen on tilted cars)
        angles[0] = float(np.arctan2(np.sin(angles[0]), np.cos(angles[0])))
    return [x, y, x + width, y + height], label[row["category_id"]], bool(row.get("difficult") or row.get("iscrowd")), angles


def convert_photographs(
    photographs: Sequence[Photograph], out: str | os.PathLike[str], categories: Sequence[str] = CATEGORIES
) -> dict[str, int]:
    """Write scenes that `nolbo train` and `nolbo evaluate` read: images, scenes.jsonl, source.json.

    Cameras are unknown: intrinsics are those of a camera that sees 60 degrees across, which nothing is learnt from, since
    no position is known. Crowds and difficult objects become regions to ignore.
    """
    sources = Counter(f"{photo.source}: {photo.licence}" for photo in photographs)
    images = [
        ArchiveImage(
            photo.image,
            (photo.width, photo.height),
            tuple(
                ArchiveObject(
                    categories[label],
                    tuple(box),
                    tuple(viewpoint) if np.isfinite(viewpoint).all() else None,
                    difficult=bool(ignored),
                )
                for label, box, viewpoint, ignored in zip(photo.category, photo.box.tolist(), photo.viewpoint, photo.ignore)
            ),
            tuple(categories[label] for label in sorted(photo.exhaustive)),
        )
        for photo in photographs
    ]
    counts = write_archive(out, images, {"photographs": len(images), "sources": dict(sources)})
    return {name: counts[name] for name in ("images", "objects", "viewpoints")}
