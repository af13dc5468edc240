"""Labelled voxel shapes in one NPZ file: packed grids, a class number each, the names of the classes."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int

from nolbo_ppl.errors import input_error
from nolbo_ppl.io.npz import Npz


@dataclass(frozen=True)
class VoxelArchive:
    """Shapes with their class."""

    voxels: Bool[np.ndarray, "n v v v"]
    """Occupancy; the third axis points upwards."""
    category: Int[np.ndarray, " n"]
    """Class number."""
    names: tuple[str, ...]
    """Names of the classes, in the order of their numbers."""

    def __len__(self) -> int:
        return len(self.category)

    def select(self, rows: Int[np.ndarray, " m"]) -> VoxelArchive:
        """The shapes of these rows."""
        return VoxelArchive(self.voxels[rows], self.category[rows], self.names)


def read_voxel_archive(path: str | os.PathLike[str], side: int = 32) -> VoxelArchive:
    """Shapes of a file with the arrays `X` (packed bits, a row a shape), `y` (class number), `classes` (names), `shape` (grid).

    Grids smaller than `side` are put in the middle of one of that side; empty ones are left out.

    Raises:
        InputError: arrays are missing or do not fit each other, or the grid is larger than `side`; names file and array.
    """
    with Npz(path) as archive:
        grid = tuple(int(length) for length in archive.array("shape", (3,), "iu"))
        if len(set(grid)) != 1 or not 1 <= grid[0] <= side:
            raise input_error("array `shape`", got=grid, expected=f"a cube of at most {side}^3", file=archive.path)
        own = grid[0]
        packed = archive.array("X", (None, -(-(own**3) // 8)), "u")
        category = archive.array("y", (len(packed),), "iu").astype(np.int64)
        names = tuple(str(name) for name in archive.array("classes", (None,), "U"))
    if packed.dtype != np.uint8:
        raise input_error("array `X`", got=str(packed.dtype), expected="uint8: packed bits", file=path)
    if len(category) and not (category.min() >= 0 and category.max() < len(names)):
        got = f"{category.min()} to {category.max()}"
        raise input_error("array `y`", got=got, expected=f"numbers of the {len(names)} classes", file=path)
    filled = np.flatnonzero(packed.any(1))
    low = (side - own) // 2
    voxels = np.zeros((len(filled), side, side, side), dtype=bool)
    inner = np.unpackbits(packed[filled], axis=1, count=own**3).reshape(-1, own, own, own)
    voxels[:, low : low + own, low : low + own, low : low + own] = inner
    return VoxelArchive(voxels, category[filled], names)


def stratified_split(
    category: Int[np.ndarray, " n"], held_out: float, seed: int
) -> tuple[Int[np.ndarray, " a"], Int[np.ndarray, " b"]]:
    """Rows to learn from and rows held out, the same share of every class, at least one of each.

    Raises:
        InputError: the share is not in (0, 1).

    Example:
        >>> train, test = stratified_split(np.array([0, 0, 0, 0, 1, 1, 1, 1]), held_out=0.25, seed=0)
        >>> len(train), len(test)
        (6, 2)
    """
    if not 0 < held_out < 1:
        raise input_error("share held out", got=held_out, expected="a number in (0, 1)")
    rng = np.random.default_rng(seed)
    train, test = [], []
    for label in np.unique(category):
        rows = rng.permutation(np.flatnonzero(category == label))
        cut = max(1, round(held_out * len(rows)))
        test.append(rows[:cut])
        train.append(rows[cut:])
    return np.sort(np.concatenate(train)), np.sort(np.concatenate(test))
