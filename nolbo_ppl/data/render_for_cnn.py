"""Rendered pictures with viewpoints as Render for CNN writes them: the viewpoint is in the name of the file.

`ROOT/SYNSET/SHAPE/SYNSET_SHAPE_a064_e020_t-03_d002.png` (depth of the folders is free), angles in degrees: azimuth, elevation,
in-plane rotation, as PASCAL3D+ has them, and the distance. H. Su, C. R. Qi, Y. Li, L. Guibas: Render for CNN, ICCV 2015.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from nolbo_ppl.data.image_crops import coloured, padded_square
from nolbo_ppl.errors import input_error
from nolbo_ppl.io.images import list_images, open_image

SYNSETS = {
    "02691156": "aeroplane", "02834778": "bicycle", "02858304": "boat", "02876657": "bottle", "02924116": "bus",
    "02958343": "car", "03001627": "chair", "04379243": "diningtable", "03790512": "motorbike", "04256520": "sofa",
    "04468005": "train", "03211117": "tvmonitor",
}  # fmt: skip
"""Category of each of the twelve synsets of ShapeNet that are rendered."""
NAME = re.compile(
    r"(?P<synset>\d{8})_(?P<shape>.+)_a(?P<azimuth>-?\d+)_e(?P<elevation>-?\d+)_t(?P<theta>-?\d+)_d(?P<distance>-?\d+)"
)
HELD_OUT = 20
"""A shape in so many is held out: the archive has no split, and views of one shape must not be on both sides."""


class RenderedViewpoints:
    """Rendered pictures, each of one object, with its category and viewpoint.

    Attributes:
        files: the pictures.
        category: number of the category of each.
        viewpoint: azimuth, elevation, in-plane rotation, rad, in the convention of `nolbo_ppl.geometry.rotation`.
        categories: what the numbers stand for.
    """

    def __init__(
        self,
        files: Sequence[Path],
        category: Int[np.ndarray, " n"],
        viewpoint: Float[np.ndarray, "n 3"],
        categories: Sequence[str],
    ) -> None:
        self.files, self.category, self.viewpoint = tuple(files), category, viewpoint
        self.categories = tuple(categories)

    def __len__(self) -> int:
        return len(self.files)

    def part(self, index: Int[np.ndarray, " m"]) -> RenderedViewpoints:
        """Some of the pictures."""
        files = [self.files[int(i)] for i in index]
        return RenderedViewpoints(files, self.category[index], self.viewpoint[index], self.categories)

    def picture(self, index: int, size: int, seed: int | None = None) -> UInt8[np.ndarray, "3 {size} {size}"]:
        """A picture at a size, in random colours by a seed; never turned over, which would change its viewpoint.

        Raises:
            InputError: it cannot be decoded; names the file.
        """
        part = padded_square(open_image(self.files[index]), size)
        if seed is not None:
            part = coloured(part, np.random.default_rng(seed))
        return np.ascontiguousarray(part.transpose(2, 0, 1))


def viewpoint_of_name(file: Path) -> tuple[str, str, tuple[float, float, float]]:
    """Category, shape and viewpoint, rad, that the name of a file states.

    Raises:
        InputError: another name, an unknown synset, or angles out of range; names the file.
    """
    match = NAME.fullmatch(file.stem)
    if match is None:
        raise input_error(
            "name of a rendered picture", got=file.name, expected="SYNSET_SHAPE_aAZIMUTH_eELEVATION_tTHETA_dDISTANCE", file=file
        )
    if match["synset"] not in SYNSETS:
        raise input_error("synset of a rendered picture", got=match["synset"], expected=f"one of {sorted(SYNSETS)}", file=file)
    azimuth, elevation, theta = (int(match[name]) for name in ("azimuth", "elevation", "theta"))
    if abs(elevation) > 90 or abs(azimuth) > 360 or abs(theta) > 360:
        got = f"a{azimuth} e{elevation} t{theta}"
        raise input_error(
            "angles of a rendered picture", got=got, expected="azimuth and theta within 360, elevation within 90", file=file
        )
    turn = np.radians([azimuth, elevation, theta])
    turn[[0, 2]] = np.arctan2(np.sin(turn[[0, 2]]), np.cos(turn[[0, 2]]))
    return SYNSETS[match["synset"]], match["shape"], (float(turn[0]), float(turn[1]), float(turn[2]))


def open_render_for_cnn(
    root: str | PathLike[str], held_out: bool = False, categories: Sequence[str] = tuple(sorted(SYNSETS.values()))
) -> RenderedViewpoints:
    """Pictures of a folder and those in it; every twentieth shape of a category, in the order of their names, is held out.

    Raises:
        InputError: no picture, or one whose name states no viewpoint (names it).
    """
    root = Path(root)
    if not root.is_dir():
        raise input_error("no such folder", file=root)
    stated = [(file, *viewpoint_of_name(file)) for file in list_images(root, recursive=True)]
    of_category: dict[str, set[str]] = {}
    for _, category, shape, _ in stated:
        of_category.setdefault(category, set()).add(shape)
    kept_back = {
        (category, shape)
        for category, shapes in of_category.items()
        for place, shape in enumerate(sorted(shapes))
        if place % HELD_OUT == HELD_OUT - 1 or (len(shapes) < HELD_OUT and len(shapes) > 1 and place == len(shapes) - 1)
    }
    rows = [row for row in stated if row[1] in categories and ((row[1], row[2]) in kept_back) == held_out]
    if not rows:
        raise input_error("rendered pictures", got=f"{len(stated)} of the folder", expected="some of the categories", file=root)
    number = [list(categories).index(category) for _, category, _, _ in rows]
    return RenderedViewpoints([row[0] for row in rows], np.array(number), np.array([row[3] for row in rows]), categories)
