"""Sub-commands of `nolbo convert` that make scenes of labelled image archives, read as they are distributed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from nolbo_ppl.categories import PAPER_CATEGORIES
from nolbo_ppl.data.converters.archives import ArchiveImage, write_archive
from nolbo_ppl.data.converters.bop import MINIMUM_VISIBILITY, read_bop, read_targets, write_bop
from nolbo_ppl.data.converters.bop_models import model_files
from nolbo_ppl.data.converters.coco import read_coco
from nolbo_ppl.data.converters.pascal3d import cad_files, read_objectnet3d, read_pascal3d
from nolbo_ppl.data.converters.pix3d import pix3d_models, read_pix3d
from nolbo_ppl.data.converters.stanford_cars import read_car_poses, read_stanford_cars
from nolbo_ppl.data.converters.voc import read_voc
from nolbo_ppl.errors import input_error
from nolbo_ppl.io.text import read_words
from nolbo_ppl.synthetic.assets.voxel_cache import cached_voxels_of
from nolbo_ppl.training.train_config import DEFAULT_CACHE

GRID = 32
"""Voxels along an edge of a shape, as data sets hold them; networks of 64^3 take either."""


def written(counts: dict[str, int]) -> str:
    """What is said of an archive that was converted."""
    return ", ".join(f"{count} {name}" for name, count in counts.items())


def shapes_of(root: Path, images: Iterable[ArchiveImage], side: int, cache: Path, workers: int) -> dict[str, np.ndarray]:
    """Packed voxels of every CAD model that the annotations name, by `CLASS/NN`, from the cache where they are known.

    Raises:
        InputError: a model is missing, or cannot be read.
    """
    files = cad_files(root, {thing.instance for image in images for thing in image.objects if thing.instance is not None})
    return cached_voxels_of(files, side, cache, workers)


@dataclass(frozen=True)
class Shapes:
    """How shapes are filled."""

    grid: Literal[32, 64] = GRID  # type: ignore[assignment]
    """Voxels along an edge of each shape."""
    cache: Path = DEFAULT_CACHE
    """Where voxels of CAD files are kept between runs."""
    workers: int = 1
    """Processes that fill CAD files."""


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
    shapes: Annotated[Shapes, tyro.conf.arg(name="")] = Shapes()
    """How its CAD models are filled."""

    def write(self) -> str:
        """Run it and say what was written."""
        images = list(read_pascal3d(self.data, None if self.split == "all" else self.split))
        source = {"archive": "PASCAL3D+ 1.1", "split": self.split, "benchmark": self.benchmark}
        filled = shapes_of(self.data, images, self.shapes.grid, self.shapes.cache, self.shapes.workers)
        return written(write_archive(self.out, images, source, filled, self.benchmark))


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
    shapes: Annotated[Shapes, tyro.conf.arg(name="")] = Shapes()
    """How its CAD models are filled."""

    def write(self) -> str:
        """Run it and say what was written."""
        images = list(read_objectnet3d(self.data, None if self.split == "all" else self.split))
        source = {"archive": "ObjectNet3D", "split": self.split, "benchmark": self.benchmark}
        filled = shapes_of(self.data, images, self.shapes.grid, self.shapes.cache, self.shapes.workers)
        return written(write_archive(self.out, images, source, filled, self.benchmark))


@dataclass(frozen=True)
class Pix3d:
    """Pix3D: one object an image with its true camera, viewpoint and CAD model, as scenes; other objects are unknown."""

    data: Path
    """Folder with pix3d.json, img/, mask/ and model/."""
    out: Path
    """Folder for images/, scenes.jsonl, voxels.npz, source.json."""
    split: Path | None = None
    """A list of images, one a line, or a COCO-style JSON file with `images[].file_name`: the archive itself has no split."""
    categories: tuple[str, ...] = PAPER_CATEGORIES
    """Names to keep."""
    benchmark: bool = False
    """Truncated and occluded objects are regions to ignore."""
    shapes: Annotated[Shapes, tyro.conf.arg(name="")] = Shapes()
    """How its CAD models are filled."""

    def write(self) -> str:
        """Run it and say what was written."""
        images = list(read_pix3d(self.data, self.split, self.categories))
        names = {thing.instance for image in images for thing in image.objects if thing.instance is not None}
        filled = cached_voxels_of(
            pix3d_models(self.data, names), self.shapes.grid, self.shapes.cache, self.shapes.workers, axes=("+y", "-z")
        )
        source = {"archive": "Pix3D", "split": None if self.split is None else self.split.name, "benchmark": self.benchmark}
        return written(write_archive(self.out, images, source, filled, self.benchmark))


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
    poses: Path | None = None
    """3D poses of the cars (`train_anno.pkl` of StanfordCars3D): viewpoints and cameras. It is read as plain data, not run."""

    def write(self) -> str:
        """Run it and say what was written."""
        source = {"archive": "Stanford Cars", "annotations": self.annotations.name}
        poses = None if self.poses is None else read_car_poses(self.poses)
        images = read_stanford_cars(self.annotations, self.images, only_present=self.only_present, poses=poses)
        return written(write_archive(self.out, images, source))


@dataclass(frozen=True)
class Bop:
    """A data set in the layout of BOP, such as YCB-Video: rigid objects with their models and true poses, as scenes."""

    data: Path
    """Folder with models/, test/ and the like."""
    out: Path
    """Folder for images/, scenes.jsonl, voxels.npz, trajectories/, source.json."""
    split: str = "test"
    """Folder of the scenes: test, train_real, train_pbr, ..."""
    targets: Path | None = None
    """Only the images of this list (`test_targets_bop19.json`)."""
    every: int = 1
    """Only every this many images of a scene."""
    names: Path | None = None
    """Names of the objects, one a line, from number 1 on; YCB-Video's where the folder is it, else obj_000001 and so on."""
    minimum_visibility: float = MINIMUM_VISIBILITY
    """Objects of which less is seen are regions to ignore."""
    shapes: Annotated[Shapes, tyro.conf.arg(name="")] = Shapes()
    """How its models are filled."""

    def write(self) -> str:
        """Run it and say what was written."""
        if self.every < 1:
            raise input_error("every", got=self.every, expected="at least 1")
        names = None if self.names is None else [" ".join(words) for _, words in read_words(self.names)]
        targets = None if self.targets is None else read_targets(self.targets)
        files = model_files(self.data, names)
        filled = cached_voxels_of(files, self.shapes.grid, self.shapes.cache, self.shapes.workers)
        images = read_bop(
            self.data,
            self.split,
            names=names,
            targets=targets,
            every=self.every,
            minimum_visibility=self.minimum_visibility,
        )
        return written(write_bop(self.out, images, {"archive": self.data.resolve().name, "split": self.split}, filled))
