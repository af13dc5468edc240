"""Labelled images of public archives as they are distributed, as lines of `scenes.jsonl`: what their adapters share.

An adapter yields `ArchiveImage`s: the path of an image and the labels that its archive states. Labels it does not state stay away
from the line; truncated, occluded and difficult objects are objects to learn from and regions to ignore in a benchmark.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.camera import guessed_pinhole
from nolbo_ppl.geometry.rotation import allocentric_to_egocentric, matrix_to_quaternion, viewpoint_to_matrix
from nolbo_ppl.io.files import atomic_path, write_json, write_jsonl

MIN_SIDE = 2.0
"""Boxes with a side below, px, are left out: they hold nothing to see."""


@dataclass(frozen=True)
class ArchiveObject:
    """One labelled object as an archive states it."""

    category: str
    """Name in the library's words."""
    box: tuple[float, float, float, float]
    """[x0, y0, x1, y1], px, from 0."""
    viewpoint: tuple[float, float, float] | None = None
    """Allocentric azimuth, elevation and in-plane rotation of PASCAL3D+, rad; None where it is not (finely) annotated."""
    instance: str | None = None
    """Name of its CAD model."""
    difficult: bool = False
    """Marked difficult, or a crowd."""
    truncated: bool = False
    """Cut off by the border of the image."""
    occluded: bool = False
    """Partly hidden."""


@dataclass(frozen=True)
class ArchiveImage:
    """One labelled image of an archive."""

    path: Path
    """The image."""
    size: tuple[int, int]
    """Width and height, px."""
    objects: tuple[ArchiveObject, ...]
    """What is labelled in it."""
    exhaustive: tuple[str, ...] | None = None
    """Categories of which every instance is labelled; None: of all."""
    intrinsics: tuple[float, float, float, float] | None = None
    """fx, fy, cx, cy, px, where the archive states its camera."""


def pascal_rotation(viewpoint: Sequence[float], box: Sequence[float], intrinsics: Sequence[float]) -> Float[np.ndarray, "3 3"]:
    """R_camera_object of a PASCAL3D+ viewpoint, seen through the middle of a box.

    Its camera stands at d (cos e sin a, -cos e cos a, sin e) and the picture is turned by theta counter-clockwise, which is the
    viewpoint of `nolbo_ppl.geometry.rotation`. (The poses of Stanford Cars by other authors turn theta the other way round.)

    Args:
        viewpoint: azimuth, elevation, theta in rad.
        box: [x0, y0, x1, y1], px.
        intrinsics: [fx, fy, cx, cy], px.
    """
    azimuth, elevation, theta = (float(v) for v in viewpoint)
    fx, fy, cx, cy = (float(v) for v in intrinsics)
    ray = torch.tensor([((box[0] + box[2]) / 2 - cx) / fx, ((box[1] + box[3]) / 2 - cy) / fy, 1.0], dtype=torch.float64)
    wrapped = float(np.arctan2(np.sin(azimuth), np.cos(azimuth)))
    allocentric = viewpoint_to_matrix(torch.tensor([wrapped, elevation, theta], dtype=torch.float64))
    return allocentric_to_egocentric(allocentric, ray).numpy()


def scene_line(image: ArchiveImage, name: str, benchmark: bool = False) -> dict[str, Any]:
    """The line of `scenes.jsonl` of an image.

    Args:
        image: the image and its labels.
        name: path of the image in the folder of scenes.
        benchmark: truncated and occluded objects become regions to ignore, as the viewpoint benchmarks of PASCAL3D+ have it.
    """
    # Nothing is learnt from a guessed camera: objects of such archives have no position.
    camera = guessed_pinhole(*image.size).tolist() if image.intrinsics is None else list(image.intrinsics)
    limit = np.array([*image.size, *image.size], dtype=np.float64)
    objects, ignore = [], []
    for thing in image.objects:
        box = np.clip(np.array(thing.box, dtype=np.float64), 0, limit)
        if (box[2:] - box[:2] < MIN_SIDE).any():
            continue
        if thing.difficult or (benchmark and (thing.truncated or thing.occluded)):
            ignore.append(box.tolist())
            continue
        row: dict[str, Any] = {"box": box.tolist(), "category": thing.category}
        if thing.instance is not None:
            row["instance"] = thing.instance
        if thing.viewpoint is not None:
            R = torch.from_numpy(pascal_rotation(thing.viewpoint, box.tolist(), camera))  # the ray a reader takes
            row["rotation"] = [round(v, 9) for v in matrix_to_quaternion(R).tolist()]
        objects.append(row)
    line: dict[str, Any] = {"image": name, "intrinsics": camera, "objects": objects, "ignore": ignore}
    if image.exhaustive is not None:
        line["exhaustive"] = list(image.exhaustive)
    return line


def write_archive(
    out: str | PathLike[str],
    images: Iterable[ArchiveImage],
    source: Mapping[str, Any],
    shapes: Mapping[str, np.ndarray] | None = None,
    benchmark: bool = False,
) -> dict[str, int]:
    """Write scenes that `nolbo train` and `nolbo evaluate` read: images, scenes.jsonl last, voxels.npz where there are shapes.

    Args:
        out: folder, made when missing.
        images: what the archive holds.
        source: where it came from, for `source.json`.
        shapes: packed bits of the occupancy of each instance, canonical pose, all of one side.
        benchmark: truncated and occluded objects are regions to ignore.

    Returns:
        Counts: `images`, `objects`, `viewpoints`, `ignore`.

    Raises:
        InputError: no image.
    """
    out = Path(out)
    (out / "images").mkdir(parents=True, exist_ok=True)
    lines, counts = [], Counter[str]()
    for number, image in enumerate(images):
        name = f"images/{number:06d}{image.path.suffix.lower()}"
        shutil.copyfile(image.path, out / name)
        line = scene_line(image, name, benchmark)
        counts.update(
            images=1,
            objects=len(line["objects"]),
            viewpoints=sum("rotation" in row for row in line["objects"]),
            ignore=len(line["ignore"]),
        )
        lines.append(line)
    if not lines:
        raise input_error("an archive without images", got=out, expected="at least one annotated image")
    if shapes:
        with atomic_path(out / "voxels.npz") as temporary:
            np.savez(temporary, **shapes)  # type: ignore[arg-type]
    write_json(out / "source.json", {**source, **counts})
    write_jsonl(out / "scenes.jsonl", lines)
    return {name: counts[name] for name in ("images", "objects", "viewpoints", "ignore")}
