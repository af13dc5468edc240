"""Procedural textures: value noise, wood, stripes and checks as functions of position, without any picture.

The noise is compiled: in NumPy its many temporaries took a fifth of the rendering time.
"""

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
def _noise(points: np.ndarray, seed: int, octaves: int) -> np.ndarray:
    n, d = points.shape
    result = np.empty(n, dtype=np.float32)
    for i in range(n):
        total, weight = np.float32(0), np.float32(0)
        for octave in range(octaves):
            scale = np.float32(1 << octave)
            x, y = points[i, 0] * scale, points[i, 1] * scale
            z = points[i, 2] * scale if d == 3 else np.float32(0)
            fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
            ix, iy, iz = np.uint32(np.int64(fx)), np.uint32(np.int64(fy)), np.uint32(np.int64(fz))
            ux, uy, uz = np.float32(x - fx), np.float32(y - fy), np.float32(z - fz)
            ux, uy, uz = ux * ux * (3 - 2 * ux), uy * uy * (3 - 2 * uy), uz * uz * (3 - 2 * uz)
            s = np.uint32(seed + octave)
            value = np.float32(0)
            for k in range(2 if d == 3 else 1):
                wz = (uz if k else 1 - uz) if d == 3 else np.float32(1)
                for j in range(2):
                    wy = uy if j else 1 - uy
                    a = _lattice(ix, np.uint32(iy + np.uint32(j)), np.uint32(iz + np.uint32(k)), s)
                    b = _lattice(
                        np.uint32(ix + np.uint32(1)), np.uint32(iy + np.uint32(j)), np.uint32(iz + np.uint32(k)), s
                    )
                    value += wz * wy * (a * (1 - ux) + b * ux)
            share = np.float32(1) / scale
            total += share * value
            weight += share
        result[i] = total / weight
    return result


def fractal_noise(points: Float[np.ndarray, "n d"], seed: int, octaves: int = 3) -> Float[np.ndarray, " n"]:
    """Smooth noise in [0, 1): one random value per corner of the unit grid, in two or three dimensions.

    Args:
        points: positions in units of the coarsest cell.
        seed: which of the 2^32 noise fields.
        octaves: how many fields are summed, each twice as fine and half as strong as the one before.
    """
    return _noise(np.ascontiguousarray(points, dtype=np.float32), int(seed) & 0x7FFFFFFF, octaves)


def value_noise(points: Float[np.ndarray, "n d"], seed: int) -> Float[np.ndarray, " n"]:
    """One octave of `fractal_noise`."""
    return fractal_noise(points, seed, 1)


def checker(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """Zero and one on alternating unit squares."""
    return (np.floor(points).sum(axis=1) % 2).astype(np.float32)


def stripes(position: Float[np.ndarray, " n"], duty: float = 0.5) -> Float[np.ndarray, " n"]:
    """One on a share `duty` of every unit period, else zero."""
    return (position - np.floor(position) < duty).astype(np.float32)


def tiles(points: Float[np.ndarray, "n 2"], joint: float = 0.06) -> Float[np.ndarray, " n"]:
    """One inside unit tiles, zero on the joints between them."""
    fraction = points - np.floor(points)
    return ((fraction > joint) & (fraction < 1.0 - joint)).all(axis=1).astype(np.float32)


def wood(points: Float[np.ndarray, "n 3"], seed: int) -> Float[np.ndarray, " n"]:
    """Grain along the x axis, in [0, 1]: rings disturbed by noise. Positions in units of the ring spacing."""
    stretched = points * np.array([0.1, 1.0, 1.0], dtype=np.float32)
    rings = stretched[:, 1] + 2.0 * value_noise(stretched, seed)
    return (0.5 + 0.5 * np.sin(2 * np.pi * rings)).astype(np.float32)
