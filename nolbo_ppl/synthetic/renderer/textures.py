"""Procedural textures: value noise, wood, stripes, checks, tiles and masonry as compiled functions of position."""

from __future__ import annotations

import math

import numba
import numpy as np
from jaxtyping import Float


@numba.njit(cache=True, inline="always")
def _lattice(x: np.uint32, y: np.uint32, z: np.uint32, seed: np.uint32) -> np.float32:
    """A hashed number in [0, 1) for a lattice point."""
    h = np.uint32(x * np.uint32(73856093)) ^ np.uint32(y * np.uint32(19349663)) ^ np.uint32(z * np.uint32(83492791))
    h = np.uint32(h + np.uint32(seed * np.uint32(2654435761)))
    h = np.uint32(h ^ (h >> np.uint32(15)))
    h = np.uint32(h * np.uint32(0x2C1B3C6D))
    h = np.uint32(h ^ (h >> np.uint32(12)))
    h = np.uint32(h * np.uint32(0x297A2D39))
    h = np.uint32(h ^ (h >> np.uint32(15)))
    return np.float32(h >> np.uint32(8)) * np.float32(2.0**-24)


@numba.njit(cache=True)
def noise_at(x: float, y: float, z: float, seed: int, octaves: int, solid: bool) -> np.float32:
    """Fractal noise in [0, 1) at one point; without `solid` the noise is two-dimensional and z is not used."""
    total, weight = np.float32(0), np.float32(0)
    for octave in range(octaves):
        scale = np.float32(1 << octave)
        sx, sy, sz = x * scale, y * scale, z * scale
        fx, fy, fz = math.floor(sx), math.floor(sy), math.floor(sz)
        ix, iy, iz = np.uint32(np.int64(fx)), np.uint32(np.int64(fy)), np.uint32(np.int64(fz))
        ux, uy, uz = np.float32(sx - fx), np.float32(sy - fy), np.float32(sz - fz)
        ux, uy, uz = ux * ux * (3 - 2 * ux), uy * uy * (3 - 2 * uy), uz * uz * (3 - 2 * uz)
        s = np.uint32(seed + octave)
        value = np.float32(0)
        for k in range(2 if solid else 1):
            kz = np.uint32(iz + np.uint32(k)) if solid else np.uint32(0)
            wz = (uz if k else 1 - uz) if solid else np.float32(1)
            for j in range(2):
                ky = np.uint32(iy + np.uint32(j))
                wy = uy if j else 1 - uy
                low, high = _lattice(ix, ky, kz, s), _lattice(np.uint32(ix + np.uint32(1)), ky, kz, s)
                value += wz * wy * (low * (1 - ux) + high * ux)
        total += value / scale
        weight += np.float32(1) / scale
    return total / weight


@numba.njit(cache=True)
def _noise(points: np.ndarray, seed: int, octaves: int) -> np.ndarray:
    result = np.empty(len(points), dtype=np.float32)
    solid = points.shape[1] == 3
    for i in range(len(points)):
        result[i] = noise_at(points[i, 0], points[i, 1], points[i, 2] if solid else 0.0, seed, octaves, solid)
    return result


def fractal_noise(points: Float[np.ndarray, "n d"], seed: int, octaves: int = 3) -> Float[np.ndarray, " n"]:
    """Smooth noise in [0, 1): one random value per corner of the unit grid, in two or three dimensions.

    Args:
        points: positions in units of the coarsest cell.
        seed: which of the 2^32 noise fields.
        octaves: how many fields are summed, each twice as fine and half as strong as the one before.
    """
    return _noise(np.ascontiguousarray(points, dtype=np.float32), int(seed) & 0x7FFFFFFF, octaves)


@numba.njit(cache=True)
def wood_at(x: float, y: float, z: float, seed: int) -> float:
    """Grain along the x axis, in [0, 1]: rings disturbed by noise. Position in units of the ring spacing."""
    rings = y + 2 * noise_at(0.1 * x, y, z, seed, 1, True)
    return 0.5 + 0.5 * math.sin(2 * math.pi * rings)


PLANE_PATTERNS: tuple[str, ...] = ("plain", "noise", "checker", "stripes", "tiles")
"""Textures of large planes, by number for `plane_pattern`."""


@numba.njit(cache=True)
def plane_pattern(pattern: int, u: float, v: float, seed: int) -> float:
    """How much of the second colour a plane shows at (u, v), in [0, 1]; positions in units of the period."""
    if pattern == 1:
        mix = 1.6 * float(noise_at(u, v, 0.0, seed, 4, False)) - 0.3
        return min(max(mix, 0.0), 1.0)
    if pattern == 2:
        return float((math.floor(u) + math.floor(v)) % 2)
    if pattern == 3:
        return 1.0 if u - math.floor(u) < 0.5 else 0.0
    if pattern == 4:
        a, b = u - math.floor(u), v - math.floor(v)
        return 1.0 if 0.06 < a < 0.94 and 0.06 < b < 0.94 else 0.0
    return 0.5


SOLID = 4
"""Number of the first of `SURFACE_PATTERNS` among the patterns of materials: those before are solid textures."""
SURFACE_PATTERNS: tuple[str, ...] = ("grain", "leaves", "brick", "slabs", "planks", "siding", "lattice")
"""Textures laid out on the faces of a mesh: along z and across it on upright faces, along x and y on level ones."""


@numba.njit(cache=True)
def _masonry(u: float, v: float, shift: float, joint_u: float, joint_v: float, seed: int) -> float:
    """Rows of unit cells: 0 in the joints, else a hashed brightness of the cell in [0.3, 1]; `shift` moves each row."""
    row = math.floor(v)
    x = u + shift * row
    column = math.floor(x)
    if x - column < joint_u or v - row < joint_v:
        return 0.0
    cell = _lattice(np.uint32(np.int64(column)), np.uint32(np.int64(row)), np.uint32(0), np.uint32(seed))
    return 0.3 + 0.7 * float(cell)


@numba.njit(cache=True)
def _grain(x: float, y: float, z: float, seed: int, pixel: float, solid: bool) -> float:
    """Noise of three scales, 1, 1/4 and 1/12, each left out where a pixel covers it; stretched to [0, 1]."""
    total = 0.0
    for level in range(3):
        scale = 1.0 if level == 0 else (4.0 if level == 1 else 12.0)
        fade = 1.0 / (1.0 + (1.5 * scale * pixel) ** 4)
        if fade > 0.03:
            noise = float(noise_at(x * scale, y * scale, z * scale, seed + 7 * level, 1, solid))
            total += fade * (noise - 0.5) * (0.8 if level == 0 else 0.7)
    return min(max(0.5 + total, 0.0), 1.0)


@numba.njit(cache=True)
def surface_pattern(pattern: int, q: np.ndarray, normal: np.ndarray, seed: int, pixel: float) -> float:
    """Brightness in [0, 1] of pattern `SURFACE_PATTERNS[pattern - SOLID]` at a point of a face.

    Args:
        pattern: number among the patterns of materials, at least `SOLID`.
        q: point [3] in the mesh's frame, in units of the period.
        normal: unit normal [3] of the face in the mesh's frame.
        seed: which random texture.
        pixel: side of what one pixel covers, in units of the period; detail below it fades.
    """
    kind = pattern - SOLID
    if kind == 1:
        return _grain(q[0], q[1], q[2], seed, pixel, True)
    u, v = float(q[0]), float(q[1])
    across = math.sqrt(normal[0] ** 2 + normal[1] ** 2)
    if across > 0.7:
        u, v = (normal[0] * q[1] - normal[1] * q[0]) / across, float(q[2])
    if kind == 0:
        return _grain(u, v, 0.0, seed, pixel, False)
    if kind == 2:
        mean, value, detail = 0.55, _masonry(u, 3 * v, 0.5, 0.05, 0.14, seed), 2.0
    elif kind == 3:
        mean, value, detail = 0.6, _masonry(u, v, 0.0, 0.04, 0.04, seed), 1.2
    elif kind == 4:
        mean, value, detail = 0.6, _masonry(0.14 * u, v, 0.37, 0.006, 0.05, seed), 1.5
        value *= 0.85 + 0.15 * wood_at(0.5 * u, 2 * v, 0.0, seed)
    elif kind == 5:
        mean, value, detail = 0.5, v - math.floor(v), 1.0
    else:
        a, b = abs(u - math.floor(u) - 0.5), abs(v - math.floor(v) - 0.5)
        mean, value, detail = 0.5, (1.0 if a + b < 0.3 else (0.0 if a + b < 0.42 else 0.6)), 1.5
    return mean + (value - mean) / (1.0 + (detail * pixel) ** 4)
