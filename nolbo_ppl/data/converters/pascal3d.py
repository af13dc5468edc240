"""PASCAL3D+ and ObjectNet3D: MATLAB records with boxes, viewpoints and the CAD model aligned with each object.

Layouts, as the archives are distributed:

    PASCAL3D+_release1.1/  Annotations/CLASS_imagenet/*.mat  Images/CLASS_imagenet/*.JPEG  CAD/CLASS/NN.off
                           Image_sets/CLASS_imagenet_{train,val}.txt   (CLASS_pascal: split files of VOC 2012)
    ObjectNet3D/           Annotations/*.mat  Images/*.JPEG  CAD/off/CLASS/NN.off  Image_sets/{train,val,test}.txt

Y. Xiang, R. Mottaghi, S. Savarese: Beyond PASCAL: A Benchmark for 3D Object Detection in the Wild, WACV 2014; Y. Xiang et al.:
ObjectNet3D, ECCV 2016.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.data.converters.archives import ArchiveImage, ArchiveObject
from nolbo_ppl.data.converters.voc import known_category
from nolbo_ppl.errors import input_error
from nolbo_ppl.io.files import read_text

IMAGE_SUFFIXES = (".JPEG", ".jpg", ".jpeg", ".png", ".JPG")


def read_record(path: str | PathLike[str], field: str = "record") -> Any:
    """A structure of a MATLAB file, as SciPy's `mat_struct`.

    Raises:
        InputError: the file is no MATLAB file of version 7 or older, or has no such field.
    """
    file = Path(path)
    if not file.is_file():
        raise input_error("no such annotation", file=file)
    try:
        content = loadmat(file, squeeze_me=True, struct_as_record=False)
    except Exception as error:  # SciPy's reader raises whatever a damaged byte leads it to
        raise input_error("not a readable MATLAB file", got=f"{type(error).__name__}: {error}", file=file) from None
    if field not in content:
        raise input_error(f"no {field} in the MATLAB file", got=sorted(k for k in content if k[0] != "_"), file=file)
    return content[field]


def _numbers(value: Any, count: int, name: str, file: Path) -> list[float]:
    """A field of numbers."""
    try:
        values = [float(v) for v in np.atleast_1d(value).ravel()]
    except (TypeError, ValueError):
        values = []
    if len(values) != count or not np.isfinite(values).all():
        raise input_error(name, got=value, expected=f"{count} finite numbers" if count > 1 else "a finite number", file=file)
    return values


def _flag(thing: Any, name: str) -> bool:
    value = np.atleast_1d(getattr(thing, name, 0)).ravel()
    return bool(len(value) and value[0])


def fine_viewpoint(viewpoint: Any, name: str, file: Path) -> tuple[float, float, float] | None:
    """(azimuth, elevation, theta) in rad; None where only a coarse one was annotated (distance 0 or missing)."""
    if not hasattr(viewpoint, "azimuth") or not hasattr(viewpoint, "distance"):
        return None
    if np.size(viewpoint.azimuth) == 0 or _numbers(viewpoint.distance, 1, f"{name}.viewpoint.distance", file)[0] == 0:
        return None
    degrees = [
        _numbers(getattr(viewpoint, angle), 1, f"{name}.viewpoint.{angle}", file)[0]
        for angle in ("azimuth", "elevation", "theta")
    ]
    azimuth, elevation, theta = np.radians(degrees).tolist()
    return azimuth, elevation, theta


def _image_of(folder: Path, stem: str, file: Path) -> Path:
    for suffix in IMAGE_SUFFIXES:
        if (path := folder / f"{stem}{suffix}").is_file():
            return path
    raise input_error("image of the annotation", got=stem, expected=f"{stem}.JPEG or .jpg in {folder}", file=file)


def read_pascal3d_annotation(
    path: str | PathLike[str], images: str | PathLike[str], categories: Collection[str] = CATEGORIES
) -> ArchiveImage:
    """The labels of one MATLAB file of PASCAL3D+ or ObjectNet3D; objects of other categories are left out.

    Objects with a coarse viewpoint alone keep their box and category and have no viewpoint. `instance` is `CLASS/NN`, the
    CAD model of the archive that was aligned with the object.

    Args:
        path: the `.mat` file.
        images: folder of its image.
        categories: names the labels stand for.

    Raises:
        InputError: names the file and the field.
    """
    file = Path(path)
    record = read_record(file)
    objects = []
    for k, thing in enumerate(np.atleast_1d(getattr(record, "objects", np.array([], dtype=object)))):
        where = f"objects({k + 1})"
        name = str(getattr(thing, "class", ""))
        category = known_category(name, categories)
        if category is None:
            continue
        x0, y0, x1, y1 = _numbers(getattr(thing, "bbox", None), 4, f"{where}.bbox", file)
        viewpoint = fine_viewpoint(getattr(thing, "viewpoint", None), where, file)
        index = np.atleast_1d(getattr(thing, "cad_index", np.array([]))).ravel()
        instance = (
            f"{name}/{int(index[0]):02d}" if len(index) and np.issubdtype(index.dtype, np.number) and index[0] > 0 else None
        )
        objects.append(
            ArchiveObject(
                category,
                (x0 - 1, y0 - 1, x1, y1),
                viewpoint,
                instance,
                difficult=_flag(thing, "difficult"),
                truncated=_flag(thing, "truncated"),
                occluded=_flag(thing, "occluded"),
            )
        )
    image = _image_of(Path(images), file.stem, file)
    size = getattr(record, "imgsize", None)
    if size is None or np.size(size) < 2:
        from nolbo_ppl.io.images import open_image

        height, width = open_image(image).shape[:2]
    else:
        width, height = (int(v) for v in np.ravel(size)[:2])
    return ArchiveImage(image, (width, height), tuple(objects))


def _listed(file: Path) -> list[str]:
    if not file.is_file():
        raise input_error("no such split", expected="a list of image names", file=file)
    return [line.split()[0] for line in read_text(file).splitlines() if line.strip()]


def read_pascal3d(
    root: str | PathLike[str], split: str | None = "train", categories: Collection[str] = CATEGORIES
) -> Iterator[ArchiveImage]:
    """Images of PASCAL3D+: those of `Image_sets/CLASS_imagenet_SPLIT.txt`; for the VOC images those of the VOC split files.

    VOC images without a split file in the archive (`PASCAL/VOCdevkit/VOC2012/ImageSets/Main/CLASS_SPLIT.txt`) are left out,
    since training and validation images must not be mixed; `split=None` reads every annotation.

    Raises:
        InputError: not such a folder, a missing list or annotation.
    """
    root = Path(root)
    folders = sorted(path for path in (root / "Annotations").glob("*_*") if path.is_dir())
    if not folders:
        raise input_error("not a folder of PASCAL3D+", expected="Annotations/CLASS_imagenet and Images/CLASS_imagenet", file=root)
    for folder in folders:
        name, origin = folder.name.rsplit("_", 1)
        if known_category(name, categories) is None:
            continue
        if split is None:
            stems = sorted(path.stem for path in folder.glob("*.mat"))
        elif origin == "imagenet":
            stems = _listed(root / "Image_sets" / f"{folder.name}_{split}.txt")
        else:
            listing = root / "PASCAL" / "VOCdevkit" / "VOC2012" / "ImageSets" / "Main" / f"{name}_{split}.txt"
            known = set(_listed(listing)) if listing.is_file() else set()
            stems = sorted(path.stem for path in folder.glob("*.mat") if path.stem in known)
        for stem in stems:
            yield read_pascal3d_annotation(folder / f"{stem}.mat", root / "Images" / folder.name, categories)


def read_objectnet3d(
    root: str | PathLike[str], split: str | None = "train", categories: Collection[str] = CATEGORIES
) -> Iterator[ArchiveImage]:
    """Images of ObjectNet3D: those of `Image_sets/SPLIT.txt`, or all of them for `split=None`.

    Raises:
        InputError: not such a folder, a missing list or annotation.
    """
    root = Path(root)
    if not (root / "Annotations").is_dir():
        raise input_error("not a folder of ObjectNet3D", expected="Annotations/*.mat and Images/*.JPEG", file=root)
    if split is None:
        stems = sorted(path.stem for path in (root / "Annotations").glob("*.mat"))
    else:
        stems = _listed(root / "Image_sets" / f"{split}.txt")
    for stem in stems:
        image = read_pascal3d_annotation(root / "Annotations" / f"{stem}.mat", root / "Images", categories)
        if image.objects:
            yield image


def cad_files(root: str | PathLike[str], names: Collection[str]) -> dict[str, Path]:
    """The OFF file of each instance `CLASS/NN` in `CAD/CLASS/NN.off` (PASCAL3D+) or `CAD/off/CLASS/NN.off` (ObjectNet3D).

    Raises:
        InputError: a model that annotations name is not there.
    """
    root = Path(root)
    found = {}
    for name in sorted(names):
        candidates = [root / "CAD" / f"{name}.off", root / "CAD" / "off" / f"{name}.off"]
        path = next((candidate for candidate in candidates if candidate.is_file()), None)
        if path is None:
            raise input_error("CAD model of an annotation", got=name, expected=f"{candidates[0]} or {candidates[1]}", file=root)
        found[name] = path
    return found
