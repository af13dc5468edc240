"""Cubic voxel grids over the canonical box [-0.5, 0.5]^3: packing, overlap, and the surface inside.

Grids are indexed [ix, iy, iz]; voxel i of n has its centre at (i + 0.5) / n - 0.5 along its axis.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from nolbo_ppl.errors import input_error


def voxel_centres(n: int) -> Float[np.ndarray, " {n}"]:
    """Coordinates of the n voxel centres along one axis, in units of the box."""
    return (np.arange(n) + 0.5) / n - 0.5


def pack_voxels(voxels: Bool[np.ndarray, "*batch n n n"]) -> UInt8[np.ndarray, "*batch bytes"]:
    """Pack grids to bits (C order, most significant bit first, zeros filled up to a byte): `numpy.packbits`.

    Raises:
        InputError: the last three sizes differ, or the grid is not boolean.
    """
    if voxels.ndim < 3 or len(set(voxels.shape[-3:])) != 1:
        raise input_error("voxel grid to pack", got=f"shape {voxels.shape}", expected="[..., n, n, n]")
    if voxels.dtype != bool:
        raise input_error(
            "voxel grid to pack", got=f"dtype {voxels.dtype}", expected="bool", do="compare with a threshold first"
        )
    return np.packbits(voxels.reshape(*voxels.shape[:-3], voxels.shape[-1] ** 3), axis=-1)


def unpack_voxels(packed: UInt8[np.ndarray, "*batch bytes"], n: int) -> Bool[np.ndarray, "*batch {n} {n} {n}"]:
    """Undo `pack_voxels` for grids of size n.

    Raises:
        InputError: the number of bytes is not that of n^3 bits, or the dtype is not uint8.
    """
    expected = (n**3 + 7) // 8
    if packed.dtype != np.uint8 or packed.ndim < 1 or packed.shape[-1] != expected:
        raise input_error(
            "packed voxels", got=f"{packed.dtype} {packed.shape}", expected=f"uint8 [..., {expected}] for a {n}^3 grid"
        )
    return np.unpackbits(packed, axis=-1, count=n**3).astype(bool).reshape(*packed.shape[:-1], n, n, n)


def voxel_iou(
    a: Bool[np.ndarray, "*batch n n n"], b: Bool[np.ndarray, "*batch n n n"]
) -> Float[np.ndarray, "*batch"]:
    """Intersection over union of paired grids (broadcast); two empty grids agree: 1.

    Raises:
        InputError: the grids have different sizes.
    """
    if a.shape[-3:] != b.shape[-3:]:
        raise input_error("voxel grids of different sizes", got=f"{a.shape} and {b.shape}", expected="the same n")
    intersection = np.count_nonzero(a & b, axis=(-3, -2, -1))
    union = np.count_nonzero(a | b, axis=(-3, -2, -1))
    return np.where(union > 0, intersection / np.maximum(union, 1), 1.0)


def voxels_to_mesh(
    occupancy: Float[np.ndarray, "n n n"] | Bool[np.ndarray, "n n n"], level: float = 0.5
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Surface at `level` of an occupancy grid by marching cubes, in canonical coordinates.

    The grid is padded with empty voxels, so that an object reaching its border is closed. Faces run
    counter-clockwise seen from outside.

    Args:
        occupancy: occupancy or its probability at the voxel centres; any cubic size.
        level: the value the surface lies at, in (0, 1).

    Returns:
        Vertices [v, 3] in units of the box and faces [f, 3]; both have no rows when nothing exceeds the level.

    Raises:
        InputError: the grid is not cubic, holds NaN or infinity, or the level is not in (0, 1).
    """
    if occupancy.ndim != 3 or len(set(occupancy.shape)) != 1:
        raise input_error("occupancy grid", got=f"shape {occupancy.shape}", expected="[n, n, n]")
    if not 0 < level < 1:
        raise input_error("level of the surface", got=level, expected="a number between 0 and 1, both excluded")
    values = np.asarray(occupancy, dtype=np.float64)
    if not np.isfinite(values).all():
        raise input_error("occupancy grid", got="NaN or infinity", expected="finite values")
    if not (values > level).any():
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    from skimage.measure import marching_cubes  # delayed: heavy to import

    n = values.shape[0]
    vertices, faces, _, _ = marching_cubes(np.pad(values, 1), level, gradient_direction="ascent")
    return (vertices.astype(np.float64) - 0.5) / n - 0.5, faces.astype(np.int64)
