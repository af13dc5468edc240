"""MS-COCO: the boxes of one `instances_*.json`; crowds are regions to ignore."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from os import PathLike
from pathlib import Path

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.data.converters.archives import ArchiveImage, ArchiveObject
from nolbo_ppl.data.converters.voc import known_category
from nolbo_ppl.errors import input_error
from nolbo_ppl.io.coco_file import read_coco_images


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
    for image in read_coco_images(path, images):
        named = [(known_category(one.category, categories), one) for one in image.annotations]
        found = tuple(ArchiveObject(name, one.box, difficult=one.crowd) for name, one in named if name is not None)
        if not found and not empty:
            continue
        places = (image.path, Path(images) / image.path.name)  # some files name the folder of the split, too
        place = next((place for place in places if place.is_file()), None)
        if place is None:
            raise input_error("image", got=image.fields["file_name"], expected=f"a file in {images}", file=Path(path))
        yield ArchiveImage(place, image.size, found)
