"""PASCAL VOC: one XML file an image, boxes from 1, coarse poses that are no viewpoint."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Iterator
from os import PathLike
from pathlib import Path

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.data.converters.archives import ArchiveImage, ArchiveObject
from nolbo_ppl.errors import input_error
from nolbo_ppl.io.files import read_text

RENAMED = {
    "airplane": "aeroplane",
    "motorcycle": "motorbike",
    "couch": "sofa",
    "dining table": "diningtable",
    "dining_table": "diningtable",
    "tv": "tvmonitor",
}
"""Words of COCO and ObjectNet3D for categories that VOC, and this library, name otherwise."""
MOST_BYTES = 10**7
"""An annotation file is a few kB; larger ones are refused before they are parsed."""


def known_category(name: str, categories: Collection[str]) -> str | None:
    """The library's name of a category of VOC, PASCAL3D+, ObjectNet3D or COCO; None where it has none."""
    for candidate in (name, RENAMED.get(name, name)):
        if candidate in categories:
            return candidate
    return None


def parse_annotation(file: Path) -> ElementTree.Element:
    """Root of an XML file. Raises `InputError` naming the file where it is missing, large, or no plain XML."""
    if not file.is_file():
        raise input_error("no such annotation", file=file)
    if file.stat().st_size > MOST_BYTES:
        raise input_error(
            "size of an annotation", got=f"{file.stat().st_size} bytes", expected=f"at most {MOST_BYTES}", file=file
        )
    text = file.read_bytes()
    if b"<!ENTITY" in text or b"<!DOCTYPE" in text:  # entities that expand without end
        raise input_error("an XML file with a document type", expected="plain elements, as VOC writes them", file=file)
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise input_error("not an XML file", got=error, file=file, line=error.position[0]) from None


def _number(element: ElementTree.Element, path: str, where: str, file: Path) -> float:
    text = element.findtext(path)
    try:
        return float(text or "")
    except ValueError:
        raise input_error(f"{where}{path}", got=repr(text), expected="a number", file=file) from None


def _flag(element: ElementTree.Element, path: str) -> bool:
    return (element.findtext(path) or "0").strip() not in ("0", "")


def read_voc_annotation(
    path: str | PathLike[str], images: str | PathLike[str] | None, categories: Collection[str] = CATEGORIES
) -> ArchiveImage:
    """The labels of one XML file; objects of other categories are left out.

    VOC counts pixels from 1 with both ends inside the box, so x0 and y0 lose one here. Its `pose` (Left, Right, Frontal,
    Rear) is a quadrant, no viewpoint, and is not read.

    Args:
        path: the XML file.
        images: folder of the images; None: the labels alone, wherever the image is.
        categories: names the labels stand for.

    Raises:
        InputError: names the file and the field.
    """
    file = Path(path)
    root = parse_annotation(file)
    name = root.findtext("filename")
    if not name:
        raise input_error("filename", got=repr(name), expected="the name of the image", file=file)
    image = Path(file.parent if images is None else images) / Path(name).name
    if images is not None and not image.is_file():
        raise input_error("image of the annotation", got=name, expected=f"a file in {images}", file=file)
    size = (int(_number(root, "size/width", "", file)), int(_number(root, "size/height", "", file)))
    objects = []
    for k, thing in enumerate(root.findall("object")):
        where = f"object[{k}]."
        category = known_category((thing.findtext("name") or "").strip(), categories)
        box = [_number(thing, f"bndbox/{side}", where, file) for side in ("xmin", "ymin", "xmax", "ymax")]
        if box[0] > box[2] or box[1] > box[3]:
            raise input_error(f"{where}bndbox", got=box, expected="xmin <= xmax and ymin <= ymax", file=file)
        if category is not None:
            objects.append(
                ArchiveObject(
                    category,
                    (box[0] - 1, box[1] - 1, box[2], box[3]),
                    difficult=_flag(thing, "difficult"),
                    truncated=_flag(thing, "truncated"),
                    occluded=_flag(thing, "occluded"),
                )
            )
    return ArchiveImage(image, size, tuple(objects))


def read_voc(
    root: str | PathLike[str], split: str | None = None, categories: Collection[str] = CATEGORIES
) -> Iterator[ArchiveImage]:
    """Images of a VOC folder (`Annotations`, `JPEGImages`, `ImageSets/Main/SPLIT.txt`), in the order of the split.

    Raises:
        InputError: no such folder, split or annotation.
    """
    root = Path(root)
    annotations = root / "Annotations"
    if not annotations.is_dir():
        raise input_error("not a folder of PASCAL VOC", expected="Annotations and JPEGImages", file=root)
    if split is None:
        files = sorted(path for path in annotations.glob("*.xml") if not path.name.startswith("."))
    else:
        listing = root / "ImageSets" / "Main" / f"{split}.txt"
        if not listing.is_file():
            raise input_error("no such split", got=split, expected="a file of ImageSets/Main", file=listing)
        files = [annotations / f"{line.split()[0]}.xml" for line in read_text(listing).splitlines() if line.strip()]
    if not files:
        raise input_error("a folder without annotations", file=annotations)
    for file in files:
        yield read_voc_annotation(file, root / "JPEGImages", categories)
