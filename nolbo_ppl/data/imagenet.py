"""Folders of labelled pictures as ImageNet is distributed: a folder a class, validation flat with its labels beside it.

Understood are `ROOT/train/CLASS/*.JPEG` with `ROOT/val/CLASS/*.JPEG`, and the original ILSVRC archive
`ILSVRC/Data/CLS-LOC/{train/CLASS,val}` whose validation labels are `ILSVRC/Annotations/CLS-LOC/val/NAME.xml` or
`LOC_val_solution.csv` beside `ILSVRC`. O. Russakovsky et al.: ImageNet Large Scale Visual Recognition Challenge, IJCV 2015.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Int, UInt8

from nolbo_ppl.data.image_crops import coloured, middle_part, random_part
from nolbo_ppl.errors import input_error
from nolbo_ppl.io.files import read_text
from nolbo_ppl.io.images import list_images, open_image


class LabelledPictures:
    """Pictures with one label each.

    Attributes:
        files: the pictures.
        label: number of the class of each.
        classes: what the numbers stand for, sorted.
    """

    def __init__(self, files: Sequence[Path], label: Int[np.ndarray, " n"], classes: Sequence[str]) -> None:
        self.files, self.label, self.classes = tuple(files), np.asarray(label, dtype=np.int64), tuple(classes)

    def __len__(self) -> int:
        return len(self.files)

    def part(self, index: Int[np.ndarray, " m"]) -> LabelledPictures:
        """Some of the pictures."""
        return LabelledPictures([self.files[int(i)] for i in index], self.label[index], self.classes)

    def picture(self, index: int, size: int, seed: int | None = None) -> UInt8[np.ndarray, "3 {size} {size}"]:
        """A picture at a size: a random part in random colours by a seed, the middle without one.

        Raises:
            InputError: it cannot be decoded; names the file.
        """
        image = open_image(self.files[index])
        if seed is None:
            part = middle_part(image, size)
        else:
            rng = np.random.default_rng(seed)
            part = coloured(random_part(image, size, rng), rng)
        return np.ascontiguousarray(part.transpose(2, 0, 1))


def open_imagenet(
    root: str | PathLike[str], split: Literal["train", "val"] = "train", classes: Sequence[str] | None = None
) -> LabelledPictures:
    """Pictures of a split.

    Args:
        root: see the module's docstring.
        split: official split; the two are never mixed.
        classes: names in the order of the labels; by default those of the training folder, sorted.

    Raises:
        InputError: not such a folder, a class without pictures, or a validation picture without a known label (names it).
    """
    root = Path(root)
    top = next((place for place in (root, root / "Data" / "CLS-LOC", root / "ILSVRC" / "Data" / "CLS-LOC") if _has(place)), None)
    if top is None:
        raise input_error("not a folder of ImageNet", expected="train/CLASS/*.JPEG and val/", file=root)
    named = tuple(classes) if classes is not None else tuple(sorted(path.name for path in _folders(top / "train")))
    number = {name: i for i, name in enumerate(named)}
    folder = top / split
    if not folder.is_dir():
        raise input_error("split", got=f"no {split}", expected="folders train and val", file=top)
    inside = _folders(folder)
    files: list[Path] = []
    label: list[int] = []
    for place in inside:
        if place.name not in number:
            raise input_error("class of a split", got=place.name, expected="a class of the training folder", file=folder)
        pictures = list_images(place)
        if not pictures:
            raise input_error("a class without pictures", got=place.name, file=folder)
        files += pictures
        label += [number[place.name]] * len(pictures)
    if not inside:
        files = list_images(folder)
        stated = _stated_labels(top, folder)
        for file in files:
            name = stated.get(file.stem) or _xml_label(top, file)
            if name not in number:
                raise input_error("label of a picture", got=name, expected="a class of the training folder", file=file)
            label.append(number[name])
    if not files:
        raise input_error("a split without pictures", got=split, file=top)
    return LabelledPictures(files, np.array(label), named)


def _has(place: Path) -> bool:
    return (place / "train").is_dir() and bool(_folders(place / "train"))


def _folders(place: Path) -> list[Path]:
    return sorted(path for path in place.iterdir() if path.is_dir() and not path.name.startswith("."))


def _stated_labels(top: Path, folder: Path) -> dict[str, str]:
    """Labels of `LOC_val_solution.csv`: `ImageId,PredictionString`, the latter beginning with the class."""
    places = (folder.parent, *top.parents[:3])
    file = next((place / "LOC_val_solution.csv" for place in places if (place / "LOC_val_solution.csv").is_file()), None)
    if file is None:
        return {}
    found = {}
    for line, row in enumerate(csv.reader(read_text(file).splitlines()), start=1):
        if line == 1 and row[:1] == ["ImageId"]:
            continue
        if len(row) < 2 or not row[1].split():
            raise input_error("PredictionString", got=row, expected="ImageId, class and boxes", file=file, line=line)
        found[row[0]] = row[1].split()[0]
    return found


def _xml_label(top: Path, file: Path) -> str | None:
    """Class of the first object of a picture's annotation."""
    from nolbo_ppl.data.converters.voc import parse_annotation

    annotation = top.parents[1] / "Annotations" / "CLS-LOC" / file.parent.name / f"{file.stem}.xml"
    return parse_annotation(annotation).findtext("object/name") if annotation.is_file() else None
