"""Where scenes draw their shapes from: parametric families by number, or a list of CAD shapes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from nolbo_ppl._moved import renamed
from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.errors import input_error
from nolbo_ppl.synthetic.renderer.camera_view import Mesh
from nolbo_ppl.synthetic.shapes import Shape, shape_from_seed

INSTANCES = 2000
"""Default number of parametric instances a category has."""
SEED_STRIDE = 100_000
"""Instance k of the scenes with seed s is `shape_from_seed(category, s * SEED_STRIDE + k)`: no two seeds share one."""
CACHE_SIZE = 1024
"""Shapes with their ray-casting structures held in memory: more than one block of scenes draws from."""
BLOCK = 1024
"""Scenes that share a window of instances, so that a shape made once is used about five times."""
WINDOW = 60
"""Instances a category in the window of a block; the windows of successive blocks follow each other."""
VOXELS = 32
"""Resolution of the stored occupancy grids."""


@dataclass(frozen=True)
class ShapeAsset:
    """A shape ready to be rendered."""

    shape: Shape
    mesh: Mesh
    number: int
    """Number of the instance in its pool, over all categories."""

    @cached_property
    def voxels(self) -> UInt8[np.ndarray, " bytes"]:
        """Occupancy at 32^3, packed to bits in C order."""
        return packed_voxels(self.shape)


class ShapeLibrary:
    """A fixed, ordered set of instances, made or prepared when first drawn.

    Two pools of different seeds share no parametric instance, so that scenes of another seed show unseen shapes.
    """

    def __init__(
        self,
        categories: Sequence[str] = CATEGORIES,
        *,
        seed: int = 0,
        instances: int = INSTANCES,
        cad: Sequence[Shape] | None = None,
    ) -> None:
        if cad is None and not 1 <= instances <= SEED_STRIDE:
            raise input_error("instances a category", got=instances, expected=f"1 to {SEED_STRIDE}")
        if cad is None and seed < 0:
            raise input_error("seed of the shapes", got=seed, expected="a whole number of at least 0")
        self.seed, self.instances = seed, instances
        self.cad: dict[str, list[Shape]] | None = None
        if cad is not None:
            self.cad = {name: [s for s in cad if s.category == name] for name in categories}
            self.cad = {name: shapes for name, shapes in self.cad.items() if shapes}
            if not self.cad:
                raise input_error(
                    "no CAD shape of the wanted categories", got=sorted({s.category for s in cad}), expected=categories
                )
        self.categories: tuple[str, ...] = tuple(categories) if self.cad is None else tuple(self.cad)
        counts = [self.count(category) for category in self.categories]
        self._first = dict(zip(self.categories, np.cumsum([0, *counts[:-1]]).tolist()))
        self.total: int = sum(counts)
        self._kept: OrderedDict[tuple[str, int], ShapeAsset] = OrderedDict()

    def __getstate__(self) -> dict:
        return {**self.__dict__, "_kept": OrderedDict()}

    def count(self, category: str) -> int:
        """Number of instances of a category."""
        return self.instances if self.cad is None else len(self.cad[category])

    def item(self, category: str, number: int) -> ShapeAsset:
        """Instance `number` of a category."""
        key = (category, number)
        if key not in self._kept:
            if self.cad is None:
                shape = shape_from_seed(category, self.seed * SEED_STRIDE + number)
            else:
                shape = self.cad[category][number]
            mesh = Mesh(shape.vertices, shape.faces, shape.part)
            self._kept[key] = ShapeAsset(shape, mesh, self._first[category] + number)
            if len(self._kept) > CACHE_SIZE:
                self._kept.popitem(last=False)
        else:
            self._kept.move_to_end(key)
        return self._kept[key]

    def draw(self, rng: np.random.Generator, block: int) -> ShapeAsset:
        """A random instance, within the window of a block, of a random category; all categories equally likely."""
        category = self.categories[int(rng.integers(len(self.categories)))]
        count = self.count(category)
        within = int(rng.integers(min(WINDOW, count)))
        return self.item(category, (block * WINDOW + within) % count)

    def asset_of(self, number: int) -> ShapeAsset:
        """The instance of that number over all categories."""
        category = next(name for name in reversed(self.categories) if self._first[name] <= number)
        return self.item(category, number - self._first[category])

    def describe(self) -> dict[str, object]:
        """What identifies the pool: the key of a cache depends on it."""
        if self.cad is None:
            windows = {"block": BLOCK, "window": WINDOW}
            return {"seed": self.seed, "instances": self.instances, "categories": list(self.categories), **windows}
        described: dict[str, object] = {"cad": {name: [shape.instance for shape in shapes] for name, shapes in self.cad.items()}}
        licences = {shape.instance: shape.licence for shapes in self.cad.values() for shape in shapes if shape.licence}
        return {**described, "licences": licences} if licences else described


def packed_voxels(shape: Shape, n: int = VOXELS) -> UInt8[np.ndarray, " bytes"]:
    """The occupancy of a shape at n^3, packed to bits in C order."""
    return np.packbits(np.ascontiguousarray(shape.voxels(n)).reshape(-1))


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
