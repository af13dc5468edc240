"""Cubic voxel grids over the canonical box [-0.5, 0.5]^3: packing, overlap, and the surface inside.

Grids are indexed [ix, iy, iz]; voxel i of n has its centre at (i + 0.5) / n - 0.5 along its axis.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from nolbo_ppl.errors import input_error


def voxel_centres(n: int) -> Float[np.ndarray, " {n}"]:
    """Coordinates of the n voxel centres along one axis, in units of the box."""
    return (np.arange(n) + 0.5) / n - 0.5


def pack_voxels(voxels: Bool[np.ndarray, "*batch _ _ _"]) -> UInt8[np.ndarray, "*batch bytes"]:
    """Pack grids to bits (C order, most significant bit first, zeros filled up to a byte): `numpy.packbits`.

    Raises:
        InputError: the last three sizes differ, or the grid is not boolean.
    """
    if voxels.ndim < 3 or len(set(voxels.shape[-3:])) != 1:
        raise input_error("voxel grid to pack", got=f"shape {voxels.shape}", expected="[..., n, n, n]")
    if voxels.dtype != bool:
        raise input_error("voxel grid to pack", got=f"dtype {voxels.dtype}", expected="bool", do="compare with a threshold first")
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


def resized_bits(packed: UInt8[np.ndarray, "*batch bytes"], n: int, wanted: int) -> UInt8[np.ndarray, "*batch bytes2"]:
    """Packed grids of n^3 voxels as grids of `wanted`^3: each voxel repeated, or blocks filled where any of them is.

    Raises:
        InputError: one size is no multiple of the other, or the bytes are not those of n^3 bits.
    """
    if n == wanted:
        return packed
    grid = unpack_voxels(packed, n)
    if wanted % n == 0:
        for axis in (-3, -2, -1):
            grid = np.repeat(grid, wanted // n, axis=axis)
    elif n % wanted == 0:
        k = n // wanted
        grid = np.asarray(grid.reshape(*grid.shape[:-3], wanted, k, wanted, k, wanted, k).any(axis=(-5, -3, -1)))
    else:
        raise input_error("size of a voxel grid", got=f"{n} for {wanted}", expected="one a multiple of the other")
    return pack_voxels(grid)


def voxel_iou(a: Bool[np.ndarray, "*#batch _ _ _"], b: Bool[np.ndarray, "*#batch _ _ _"]) -> Float[np.ndarray, "*batch"]:
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
    occupancy: Float[np.ndarray, "_ _ _"] | Bool[np.ndarray, "_ _ _"], level: float = 0.5
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
    vertices, faces, _, _ = marching_cubes(np.pad(values, 1), level, gradient_direction="ascent")  # type: ignore[no-untyped-call]
    return (vertices.astype(np.float64) - 0.5) / n - 0.5, faces.astype(np.int64)


def reduce_voxels(
    grid: Bool[np.ndarray, "m m m"],
    n: int,
    centre: Float[np.ndarray, " 3"] | tuple[float, float, float] = (0.0, 0.0, 0.0),
    scale: float = 1.0,
) -> Bool[np.ndarray, "{n} {n} {n}"]:
    """Resample a grid to n^3: a voxel is filled when its centre is, or when it holds a part thinner than a voxel.

    The grid is first resampled to k n, the least multiple that is no coarser. What an opening by a cube of
    2 (k // 2) + 1 removes, and does not touch what is left, is thin; all voxels it touches are filled, so that rods
    and plates survive while solids keep their size. For even k the eight samples around the centre decide, four
    suffice. n = m changes nothing.

    Args:
        grid: the fine grid, over [-0.5, 0.5]^3 of its own frame.
        n: size of the result.
        centre: where the result's origin lies in the frame of the grid.
        scale: length of the result's unit in the frame of the grid.
    """
    m = grid.shape[0]
    k = max(1, math.ceil(m / n))
    radius = k // 2
    ticks = voxel_centres(n * k) * scale
    fine = np.pad(grid, 1)  # what lies outside the grid is empty
    for axis in range(3):
        index = np.clip(np.floor((ticks + centre[axis] + 0.5) * m).astype(np.int64), -1, m)
        fine = np.take(fine, index + 1, axis=axis)
    if k == 1:
        return fine
    bulk = _spread(~_spread(~np.pad(fine, radius), radius), 2 * radius)
    thin = fine & ~bulk[radius:-radius, radius:-radius, radius:-radius]
    filled = thin.reshape(n, k, n, k, n, k).any(axis=5).any(axis=3).any(axis=1)
    if k % 2:
        closed: np.ndarray = filled | fine[radius::k, radius::k, radius::k]
        return closed
    around = np.zeros((n, n, n), dtype=np.uint8)
    for corner in np.ndindex(2, 2, 2):
        x, y, z = (slice(radius - 1 + c, None, k) for c in corner)
        around += fine[x, y, z]
    closed = filled | (around >= 4)
    return closed


def _spread(grid: Bool[np.ndarray, "a b c"], radius: int) -> Bool[np.ndarray, "a b c"]:
    """Dilation by a cube of 2 radius + 1, one axis after the other."""
    for axis in range(3):
        source, spread = np.moveaxis(grid, axis, 0), grid.copy()
        target = np.moveaxis(spread, axis, 0)
        for shift in range(1, radius + 1):
            target[shift:] |= source[:-shift]
            target[:-shift] |= source[shift:]
        grid = spread
    return grid


def mesh_to_voxels(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], n: int, gap: int = 0
) -> Bool[np.ndarray, "{n} {n} {n}"]:
    """Solid occupancy of a mesh that need not be closed: the voxels its surface touches and those it shuts in.

    The surface is sampled at half a voxel; the outside is flooded from the border through faces of voxels (six
    neighbours), so that a surface one voxel thick holds. For meshes with small holes the surface is thickened by
    `gap` voxels before the flood and the result thinned again; a mesh with a wider hole stays a shell.

    Args:
        vertices: in canonical coordinates; what lies outside [-0.5, 0.5]^3 is left out.
        faces: triangles, of any orientation.
        n: size of the grid.
        gap: holes up to 2 `gap` voxels wide are closed. On 77 CAD models (simplified, many open) against solids made
            from the full meshes, 1 raises the mean overlap from 0.71 to 0.78, 2 no further.
    """
    from scipy.ndimage import label  # delayed: heavy to import

    border = 1 + gap  # empty, for the flood to go around the object
    padded = np.zeros((n + 2 * border,) * 3, dtype=bool)
    if len(faces):
        for samples in _surface_samples(vertices[faces], 0.5 / n):
            index = np.floor((samples.T + 0.5) * n).astype(np.int32)
            if index.min() < 0 or index.max() >= n:
                index = index[:, ((index >= 0) & (index < n)).all(axis=0)]
            padded[tuple(index + border)] = True
    region, _ = label(~_spread(padded, gap))  # the corner of the border is outside
    solid = ~_spread(region == region[0, 0, 0], gap) | padded
    return solid[border:-border, border:-border, border:-border]


def _surface_samples(triangles: Float[np.ndarray, "f 3 3"], spacing: float) -> Iterator[Float[np.ndarray, "s 3"]]:
    """Points about `spacing` apart at most on every triangle, in batches of triangles cut equally finely.

    A triangle is cut along its longest side and along the height on it, so that slender ones cost little.
    """
    length = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=-1)
    longest = length.argmax(axis=1)
    order = (longest[:, None] + np.arange(3)) % 3  # corners 0 and 1 span the longest side
    triangles = np.take_along_axis(triangles, order[:, :, None], axis=1)
    base = np.maximum(length.max(axis=1), 1e-12)
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    height = np.linalg.norm(cross, axis=-1) / base
    # Powers of two keep the number of batches small.
    wanted = np.maximum(np.stack([base, height], axis=-1) / spacing, 1.0)
    cuts = 2 ** np.ceil(np.log2(wanted)).astype(np.int64)
    kinds, kind = np.unique(cuts, axis=0, return_inverse=True)
    for i, (along, up) in enumerate(kinds):
        s, t = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 1, along + 1), np.linspace(0, 1, up + 1)))
        weights = np.stack([(1 - t) * (1 - s), (1 - t) * s, t], axis=-1)
        group = triangles[kind.reshape(-1) == i]
        step = max(1, 500_000 // len(weights))
        for first in range(0, len(group), step):
            yield np.matmul(weights, group[first : first + step]).reshape(-1, 3)
