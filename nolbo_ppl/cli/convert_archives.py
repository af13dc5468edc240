"""Sub-commands of `nolbo convert` that make scenes of labelled image archives, read as they are distributed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from nolbo_ppl.data.converters.archives import ArchiveImage, write_archive
from nolbo_ppl.data.converters.coco import read_coco
from nolbo_ppl.data.converters.pascal3d import cad_files, read_objectnet3d, read_pascal3d
from nolbo_ppl.data.converters.stanford_cars import read_stanford_cars
from nolbo_ppl.data.converters.voc import read_voc
from nolbo_ppl.synthetic.assets.cad import load_cad_folder

GRID = 32
"""Voxels along an edge of a shape, as data sets hold them."""


def written(counts: dict[str, int]) -> str:
    """What is said of an archive that was converted."""
    return ", ".join(f"{count} {name}" for name, count in counts.items())


def shapes_of(root: Path, images: Iterable[ArchiveImage]) -> dict[str, np.ndarray]:
    """Voxels of every CAD model that the annotations name, by `CLASS/NN`.

    Raises:
        InputError: a model is missing, or cannot be read.
    """
    files = cad_files(root, {thing.instance for image in images for thing in image.objects if thing.instance is not None})
    shapes: dict[str, np.ndarray] = {}
    for folder in sorted({file.parent.parent for file in files.values()}):
        classes = {name.split("/")[0] for name in files}
        for shape in load_cad_folder(folder, classes, diagonals=dict.fromkeys(classes, 1.0)):
            name = f"{shape.category}/{shape.instance.removeprefix(shape.category + '-')}"
            if name in files:
                shapes[name] = shape.voxels(GRID)
    return shapes


@dataclass(frozen=True)
class Pascal3d:
    """PASCAL3D+ 1.1: boxes, viewpoints and aligned CAD models of twelve categories, as scenes."""

    data: Path
    """Folder `PASCAL3D+_release1.1` with Annotations/, Images/, CAD/ and Image_sets/."""
    out: Path
    """Folder for images/, scenes.jsonl, voxels.npz, source.json."""
    split: Literal["train", "val", "all"] = "train"
    """Official split; they are never mixed."""
    benchmark: bool = False
    """Truncated and occluded objects are regions to ignore, as the viewpoint benchmark has it."""

    def write(self) -> str:
        """Run it and say what was written."""
        images = list(read_pascal3d(self.data, None if self.split == "all" else self.split))
        source = {"archive": "PASCAL3D+ 1.1", "split": self.split, "benchmark": self.benchmark}
        return written(write_archive(self.out, images, source, shapes_of(self.data, images), self.benchmark))


@dataclass(frozen=True)
class ObjectNet3d:
    """ObjectNet3D: boxes, viewpoints and aligned CAD models, as scenes."""

    data: Path
    """Folder with Annotations/, Images/, CAD/off/ and Image_sets/."""
    out: Path
    """Folder for images/, scenes.jsonl, voxels.npz, source.json."""
    split: Literal["train", "val", "test", "all"] = "train"
    """Official split; they are never mixed."""
    benchmark: bool = False
    """Truncated and occluded objects are regions to ignore."""

    def write(self) -> str:
        """Run it and say what was written."""
        images = list(read_objectnet3d(self.data, None if self.split == "all" else self.split))
        source = {"archive": "ObjectNet3D", "split": self.split, "benchmark": self.benchmark}
        return written(write_archive(self.out, images, source, shapes_of(self.data, images), self.benchmark))


@dataclass(frozen=True)
class Voc:
    """PASCAL VOC: boxes of twelve of its categories, as scenes without viewpoints."""

    data: Path
    """Folder `VOC2012` with Annotations/, JPEGImages/ and ImageSets/."""
    out: Path
    """Folder for images/, scenes.jsonl, source.json."""
    split: str | None = None
    """Name of a file of ImageSets/Main, such as train or val; every annotation by default."""

    def write(self) -> str:
        """Run it and say what was written."""
        source = {"archive": "PASCAL VOC", "split": self.split}
        return written(write_archive(self.out, read_voc(self.data, self.split), source))


@dataclass(frozen=True)
class Coco:
    """MS-COCO: boxes of twelve of its categories, as scenes without viewpoints; crowds are ignored."""

    annotations: Path
    """`instances_train2017.json` and the like."""
    images: Path
    """Folder of the images."""
    out: Path
    """Folder for images/, scenes.jsonl, source.json."""
    empty: bool = False
    """Also images without an object of the categories: true negatives."""

    def write(self) -> str:
        """Run it and say what was written."""
        source = {"archive": "MS-COCO", "annotations": self.annotations.name}
        return written(write_archive(self.out, read_coco(self.annotations, self.images, empty=self.empty), source))


@dataclass(frozen=True)
class StanfordCars:
    """Stanford Cars: the labelled car of each image, as scenes; other cars are unknown, not background."""

    annotations: Path
    """`cars_train_annos.mat` or `cars_test_annos.mat`."""
    images: Path
    """Folder of the images."""
    out: Path
    """Folder for images/, scenes.jsonl, source.json."""
    only_present: bool = False
    """Skip images that are not there."""

    def write(self) -> str:
        """Run it and say what was written."""
        source = {"archive": "Stanford Cars", "annotations": self.annotations.name}
        images = read_stanford_cars(self.annotations, self.images, only_present=self.only_present)
        return written(write_archive(self.out, images, source))
