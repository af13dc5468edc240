"""ModelNet40 and ModelNet10 as distributed: OFF meshes by class and official split, voxelised once.

Layout: `ModelNet40/CLASS/{train,test}/CLASS_0001.off`, z up. Z. Wu et al.: 3D ShapeNets, CVPR 2015. Only the orientations of
ModelNet10 are aligned about the vertical axis.
"""

from __future__ import annotations

from collections.abc import Collection
from os import PathLike
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Int, UInt8

from nolbo_ppl.errors import input_error
from nolbo_ppl.io.images import is_passed_over, natural
from nolbo_ppl.synthetic.assets.voxel_cache import cached_voxels_of

MODELNET10 = ("bathtub", "bed", "chair", "desk", "dresser", "monitor", "night_stand", "sofa", "table", "toilet")
"""The classes of ModelNet10."""
MODELNET40 = (
    "airplane", "bathtub", "bed", "bench", "bookshelf", "bottle", "bowl", "car", "chair", "cone", "cup",
    "curtain", "desk", "door", "dresser", "flower_pot", "glass_box", "guitar", "keyboard", "lamp", "laptop",
    "mantel", "monitor", "night_stand", "person", "piano", "plant", "radio", "range_hood", "sink", "sofa",
    "stairs", "stool", "table", "tent", "toilet", "tv_stand", "vase", "wardrobe", "xbox",
)  # fmt: skip
"""The classes of ModelNet40."""


def modelnet_files(
    root: str | PathLike[str], split: Literal["train", "test"] = "train", classes: Collection[str] | None = None
) -> dict[str, Path]:
    """Files of a split by `CLASS/NAME`, classes and names sorted.

    Args:
        root: folder of the classes.
        split: official split; the two are never mixed.
        classes: only these.

    Raises:
        InputError: not such a folder, no class of a name, or one without the split; names what is missing.
    """
    root = Path(root)
    folders = sorted(path for path in root.iterdir() if path.is_dir() and not is_passed_over(path)) if root.is_dir() else []
    present = [path for path in folders if (path / "train").is_dir() or (path / "test").is_dir()]
    if not present:
        raise input_error("not a folder of ModelNet", expected="CLASS/train/*.off and CLASS/test/*.off", file=root)
    absent = sorted(set(classes or ()) - {path.name for path in present})
    if absent:
        raise input_error("classes of ModelNet", got=absent, expected=f"among {[path.name for path in present]}", file=root)
    found: dict[str, Path] = {}
    for folder in present:
        if classes is not None and folder.name not in classes:
            continue
        if not (folder / split).is_dir():
            raise input_error("split of a class", got=f"no {folder.name}/{split}", expected="train and test", file=root)
        for file in sorted((folder / split).glob("*.off"), key=natural):
            if not is_passed_over(file):
                found[f"{folder.name}/{file.stem}"] = file
    if not found:
        raise input_error("a split without meshes", got=split, expected=".off files", file=root)
    return found


def modelnet_voxels(
    root: str | PathLike[str],
    cache: str | PathLike[str],
    split: Literal["train", "test"] = "train",
    side: int = 64,
    workers: int = 1,
    classes: Collection[str] | None = None,
) -> tuple[UInt8[np.ndarray, "n bytes"], Int[np.ndarray, " n"], tuple[str, ...]]:
    """Packed voxels of a split, the label of each, and the names that labels stand for.

    Raises:
        InputError: as `modelnet_files`, or a mesh that cannot be read or filled (names it).
    """
    files = modelnet_files(root, split, classes)
    names = tuple(sorted({name.split("/")[0] for name in files}))
    packed = cached_voxels_of(files, side, cache, workers)
    label = np.array([names.index(name.split("/")[0]) for name in files], dtype=np.int64)
    return np.stack(list(packed.values())), label, names
