"""Labelled photographs (COCO's JSON) as scenes to learn from and to evaluate on.

Beside COCO's own fields an image may have `exhaustive`, the categories of which every instance is labelled (all of them when
it is missing), and an annotation `difficult` and a viewpoint `azimuth`, `elevation`, `theta` in degrees: the first two as
PASCAL3D+ has them, `theta` turns the picture clockwise, against PASCAL3D+.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.data.converters.archives import ArchiveImage, ArchiveObject, write_archive
from nolbo_ppl.errors import input_error
from nolbo_ppl.io.coco_file import read_coco_images


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
    found = []
    for image in read_coco_images(file, folder):
        if not image.path.is_file():
            raise input_error("image", got=image.fields["file_name"], expected=f"an image file in {folder}", file=file)
        objects = [one for one in image.annotations if one.category in categories]
        known = image.fields.get("exhaustive")
        found.append(
            Photograph(
                image.path,
                *image.size,
                str(image.fields.get("source", "")),
                frozenset(range(len(categories)) if known is None else (categories.index(c) for c in known if c in categories)),
                np.array([one.box for one in objects], dtype=np.float64).reshape(-1, 4),
                np.array([categories.index(one.category) for one in objects], dtype=np.int64),
                np.array([bool(one.crowd or one.fields.get("difficult")) for one in objects], dtype=bool),
                np.array([_viewpoint(one.fields) for one in objects], dtype=np.float64).reshape(-1, 3),
                str(image.fields.get("licence", "")),
            )
        )
    if not found:
        raise input_error("a data set without images", got=file, expected="at least one")
    return found


def _viewpoint(fields: Mapping[str, Any]) -> list[float]:
    """Allocentric azimuth, elevation and in-plane rotation, rad; NaN where not stated."""
    if fields.get("azimuth") is None:
        return [float("nan")] * 3
    angles = [float(np.radians(fields.get(name) or 0.0)) for name in ("azimuth", "elevation", "theta")]
    angles[2] = -angles[2]  # these poses turn the picture clockwise, PASCAL3D+ the other way (seen on tilted cars)
    angles[0] = float(np.arctan2(np.sin(angles[0]), np.cos(angles[0])))
    return angles


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
