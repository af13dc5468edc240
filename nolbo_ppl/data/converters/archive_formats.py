"""Labelled archives for `nolbo data check`: what each holds, as its converter reads it.

A new archive needs one line: `labelled(name, what, looks_like, read)` with a reader that yields `ArchiveImage`s.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.data.converters.archives import ArchiveImage
from nolbo_ppl.data.converters.bop import BopImage, looks_like_bop, read_bop, splits
from nolbo_ppl.data.converters.bop_models import read_models
from nolbo_ppl.data.converters.pascal3d import read_objectnet3d, read_pascal3d, read_record
from nolbo_ppl.data.converters.pix3d import read_pix3d
from nolbo_ppl.data.converters.voc import read_voc, read_voc_annotation
from nolbo_ppl.data.format_registry import LIKELY, SURE, FormatReport, LabelledPicture, Look, register, spread
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.masks import mask_moments
from nolbo_ppl.io.coco_file import coco_lists
from nolbo_ppl.io.fields import number_array
from nolbo_ppl.io.images import open_image


def labelled(name: str, what: str, looks_like: Callable[[Look], float], read: Callable[[Path], Iterable[ArchiveImage]]) -> None:
    """Register an archive of labelled images by its reader."""

    def report(path: Path) -> FormatReport:
        return images_report(name, what, list(read(path)))

    register(name, what, looks_like)(report)


def images_report(name: str, what: str, images: list[ArchiveImage]) -> FormatReport:
    """Counts, sizes and problems of labelled images."""
    things = [(image, thing) for image in images for thing in image.objects]
    facts: dict[str, Any] = {"images": len(images), "objects": len(things)}
    facts["categories"] = dict(Counter(thing.category for _, thing in things).most_common())
    for flag in ("difficult", "truncated", "occluded"):
        count = sum(bool(getattr(thing, flag)) for _, thing in things)
        facts |= {flag: count} if count else {}
    facts["viewpoints"] = sum(thing.viewpoint is not None for _, thing in things)
    facts["instances"] = len({thing.instance for _, thing in things} - {None})
    missing = [image.path for image in images if not image.path.is_file()]
    outside = sum(
        min(thing.box[:2]) < -1 or thing.box[2] > image.size[0] + 1 or thing.box[3] > image.size[1] + 1 for image, thing in things
    )
    problems = [f"{len(missing)} images are not there, the first {missing[0]}"] if missing else []
    problems += [f"{outside} boxes stick out of their images"] if outside else []

    def pictures() -> Iterator[LabelledPicture]:
        shown = [image for image in images if image.path.is_file()]
        for k in spread(len(shown)):
            one = shown[k]
            boxes = np.array([thing.box for thing in one.objects], dtype=np.float64).reshape(-1, 4)
            yield LabelledPicture(one.path.name, open_image(one.path), boxes, tuple(thing.category for thing in one.objects))

    return FormatReport(name, what, facts, tuple(problems), pictures=pictures)


labelled(
    "pascal3d",
    "PASCAL3D+ 1.1",
    lambda look: SURE if {"Annotations", "Images", "CAD"} <= look.names and "PASCAL" in look.names else 0.0,
    lambda path: read_pascal3d(path, None),
)
labelled(
    "objectnet3d",
    "ObjectNet3D",
    lambda look: LIKELY if {"Annotations", "Images", "Image_sets"} <= look.names and "PASCAL" not in look.names else 0.0,
    lambda path: read_objectnet3d(path, None),
)
labelled(
    "pix3d",
    "Pix3D",
    lambda look: SURE if "pix3d.json" in look.names else 0.0,
    lambda path: read_pix3d(path),
)
labelled(
    "voc",
    "PASCAL VOC",
    lambda look: SURE if {"Annotations", "JPEGImages"} <= look.names else 0.0,
    lambda path: read_voc(path),
)


@register("bop", "a data set in the layout of BOP", lambda look: SURE if looks_like_bop(look.names, look.path) else 0.0)
def report_bop(path: Path) -> FormatReport:
    """Splits, images, objects by name, visible shares, and whether depth images fit the poses."""
    models = read_models(path)
    found = {split: list(read_bop(path, split, minimum_visibility=0.0)) for split in splits(path)}
    images = [image for part in found.values() for image in part]
    names = Counter(str(name) for image in images for name in image.annotations.category)
    facts: dict[str, Any] = {"models": len(models), "images": len(images), "objects": sum(names.values())}
    facts["splits"] = {split: len(part) for split, part in found.items()}
    facts["scenes"] = len({(split, image.scene) for split, part in found.items() for image in part})
    facts["categories"] = dict(names.most_common())
    shares = np.concatenate([image.annotations.visibility for image in images]) if images else np.zeros(0)
    facts["visible"] = [round(float(v), 4) for v in np.quantile(shares, [0, 0.5, 1])] if len(shares) else []
    facts["poses_of_cameras"] = sum(image.T_world_camera is not None for image in images)
    facts["depth_images"] = sum(image.depth is not None for image in images)
    problems, off = [], []
    with_depth = [image for image in images if image.depth is not None]
    for k in spread(len(with_depth)):
        try:
            off += depth_misfits(with_depth[k])
        except InputError as error:
            problems.append(str(error))
    if off:
        facts["depth_misfit"] = round(float(np.median(off)), 3)
        if facts["depth_misfit"] > 1:
            problems.append(f"depth images miss the objects by {facts['depth_misfit']} of their diagonals: depth_scale?")

    def pictures() -> Iterator[LabelledPicture]:
        for k in spread(len(images)):
            one = images[k].annotations
            assert one.file is not None
            labels = tuple(str(name) for name in one.category)
            yield LabelledPicture(one.file.name, open_image(one.file), one.box, labels)

    return FormatReport("bop", "a data set in the layout of BOP", facts, tuple(problems), pictures=pictures)


def depth_misfits(image: BopImage) -> list[float]:
    """How far the depth in the middle of each object's box lies from its centre, in its diagonals, where most of it is seen."""
    depth, labels = image.depth_in_metres(), image.annotations
    if depth is None:
        return []
    middle = ((labels.box[:, :2] + labels.box[:, 2:]) / 2).astype(int)
    rows = np.flatnonzero((labels.visibility > 0.9) & (middle < [depth.shape[1], depth.shape[0]]).all(1))
    off = np.abs(depth[middle[rows, 1], middle[rows, 0]] - labels.position[rows, 2]) / labels.diagonal[rows]
    return off[np.isfinite(off)].tolist()


def _xml_folder(look: Look) -> float:
    xml = sorted(name for name in look.names if name.endswith(".xml"))
    return LIKELY if xml and 2 * len(xml) >= len(look.names) and "<annotation" in Look(look.path / xml[0]).text else 0.0


@register("voc-annotations", "annotation files of PASCAL VOC", _xml_folder)
def report_voc_annotations(path: Path) -> FormatReport:
    """A folder of XML files without their images."""
    images, problems = [], []
    for file in sorted(path.glob("*.xml")):
        try:
            images.append(read_voc_annotation(file, None))
        except InputError as error:
            problems.append(str(error))
    report = images_report("voc-annotations", "annotation files of PASCAL VOC", images)
    kept = [text for text in report.problems if "are not there" not in text]
    return FormatReport(report.format, report.what, report.facts, (*kept, *problems[:20]))


def _coco(look: Look) -> float:
    start = look.text.lstrip()
    named = any(f'"{word}"' in start for word in ("images", "annotations", "categories", "licenses", "info"))
    return LIKELY if look.suffix == ".json" and start.startswith("{") and named else 0.0


@register("coco", "MS-COCO instances", _coco)
def report_coco(path: Path) -> FormatReport:
    """Images, objects by category, masks; the categories of the library among them."""
    content = coco_lists(path)
    names, known = {row["id"]: str(row.get("name")) for row in content["categories"]}, {row["id"] for row in content["images"]}
    rows = content["annotations"]
    facts: dict[str, Any] = {"images": len(content["images"]), "objects": len(rows)}
    labels = [names.get(label, "?") if isinstance(label := row.get("category_id"), int | str) else "?" for row in rows]
    facts["categories"] = dict(Counter(labels).most_common())
    facts["crowds"] = sum(bool(row.get("iscrowd")) for row in rows)
    facts["of_the_library"] = sorted(set(facts["categories"]) & set(CATEGORIES))
    problems, masks = [], 0
    for row in rows:
        image, box = row.get("image_id"), number_array(row.get("bbox"), (4,))
        if not isinstance(image, int | str) or image not in known:
            problems.append(f"annotation {row['id']} is of an image that is not listed")
        if box is None or (box[2:] <= 0).any():
            problems.append(f"annotation {row['id']}: box {row.get('bbox')}")
        try:
            masks += mask_moments(row["segmentation"]) is not None if row.get("segmentation") else 0
        except InputError as error:
            problems.append(f"annotation {row['id']}: {error}")
    facts["masks"] = masks
    return FormatReport("coco", "MS-COCO instances", facts, tuple(problems[:20]))


@register(
    "matlab-annotations",
    "annotations in a MATLAB file",
    lambda look: LIKELY if look.suffix == ".mat" and look.head[:6] == b"MATLAB" else 0.0,
)
def report_matlab(path: Path) -> FormatReport:
    """Stanford Cars' list, or one image of PASCAL3D+ or ObjectNet3D."""
    try:
        rows = np.atleast_1d(read_record(path, "annotations"))
    except InputError:
        record = read_record(path)
        objects = np.atleast_1d(getattr(record, "objects", []))
        facts: dict[str, Any] = {"image": str(getattr(record, "filename", "")), "objects": len(objects)}
        facts["categories"] = dict(Counter(str(getattr(one, "class_", getattr(one, "class", "?"))) for one in objects))
        return FormatReport("pascal3d-annotation", "one image of PASCAL3D+ or ObjectNet3D", facts)
    return FormatReport("stanford-cars", "Stanford Cars", {"images": len(rows), "fields": sorted(rows[0]._fieldnames)})
