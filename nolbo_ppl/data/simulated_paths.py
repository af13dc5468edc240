"""Paths of a level camera for simulated worlds: circle, straight road, figure of eight, a room walked about in.

Every path is `T_world_camera` [n, 4, 4] with the first pose at the identity, x right, y down, z ahead.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import inverse, make_pose

Path3 = Float[np.ndarray, "n 4 4"]


def looking_ahead(position: Float[np.ndarray, "n 3"]) -> Path3:
    """Poses at the positions (m, y down), each looking along the path, relative to the first.

    Raises:
        InputError: fewer than two positions, or two neighbours in one place.
    """
    if len(position) < 2:
        raise input_error("frames of a path", got=len(position), expected="at least 2")
    ahead = np.gradient(position, axis=0)
    length = np.linalg.norm(ahead, axis=1, keepdims=True)
    if (length == 0).any():
        raise input_error("a path that stands still", got=f"frame {int(np.argmin(length))}", expected="positions that differ")
    ahead = ahead / length
    down = np.tile([0.0, 1.0, 0.0], (len(position), 1))
    T = make_pose(np.stack([np.cross(down, ahead), down, ahead], axis=-1), position)
    return inverse(T[0]) @ T


def circle(frames: int, laps: int, radius: float) -> Path3:
    """Laps of a circle of the given radius (m)."""
    angle = np.linspace(0.0, 2 * np.pi * laps, frames, endpoint=False)
    return looking_ahead(radius * np.stack([np.cos(angle), np.zeros(frames), np.sin(angle)], axis=1))


def straight(frames: int, length: float) -> Path3:
    """A straight road of the given length (m)."""
    return looking_ahead(np.linspace(0.0, length, frames)[:, None] * np.array([0.0, 0.0, 1.0]))


def figure_of_eight(frames: int, laps: int, radius: float) -> Path3:
    """Laps of a lemniscate that crosses itself in the middle; radius is half its length, m."""
    angle = np.linspace(0.0, 2 * np.pi * laps, frames, endpoint=False)
    curve = np.stack([np.sin(angle), np.zeros(frames), np.sin(angle) * np.cos(angle)], axis=1)
    return looking_ahead(radius * curve)


def room(frames: int, radius: float, rng: np.random.Generator) -> Path3:
    """A walk in a room of the given radius (m): a closed smooth curve of random harmonics, walked twice, looking ahead."""
    angle = np.linspace(0.0, 4 * np.pi, frames, endpoint=False)
    shift = rng.uniform(0, 2 * np.pi, (2, 3))
    x = sum(np.cos(k * angle + shift[0, k - 1]) / k for k in (1, 2, 3))
    z = sum(np.sin(k * angle + shift[1, k - 1]) / k for k in (1, 2, 3))
    position = 0.5 * radius * np.stack([x, np.zeros(frames), z], axis=1)
    return looking_ahead(position)
