"""Clutter: things that are no object of any category, made of boxes, balls, cylinders and cones."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float, Int

KINDS: tuple[str, ...] = ("box", "ball", "cylinder", "cone")
"""The unit primitives: each fills [-0.5, 0.5]^3."""


@dataclass(frozen=True)
class DistractorPart:
    """A unit primitive placed by an affine map in the frame of its piece of clutter."""

    kind: str
    """One of `KINDS`."""
    linear: Float[np.ndarray, "3 3"]
    """Maps the unit primitive's frame to the piece's frame: rotation times scale."""
    offset: Float[np.ndarray, " 3"]
    """Centre of the primitive in the piece's frame."""


@cache
def unit_mesh(kind: str) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Vertices and faces of a unit primitive; round ones stand upright along z."""
    if kind == "box":
        corner = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
        quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        return corner, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    segments = 16
    angle = 2 * np.pi * np.arange(segments) / segments
    circle = 0.5 * np.stack((np.cos(angle), np.sin(angle)), axis=1)
    if kind == "ball":
        latitude = np.linspace(-np.pi / 2, np.pi / 2, 9)[1:-1]
        radius, height = np.cos(latitude), 0.5 * np.sin(latitude)
    else:
        radius, height = np.array([1.0, 0.0 if kind == "cone" else 1.0]), np.array([-0.5, 0.5])
    rings = np.concatenate([np.column_stack((r * circle, np.full(segments, z))) for r, z in zip(radius, height)])
    vertices = np.concatenate((rings, [[0, 0, -0.5], [0, 0, 0.5]]))
    south, north = len(rings), len(rings) + 1
    faces = []
    for i in range(segments):
        j = (i + 1) % segments
        for k in range(len(radius) - 1):
            a, b, c, d = k * segments + i, k * segments + j, (k + 1) * segments + j, (k + 1) * segments + i
            faces += [(a, b, c), (a, c, d)]
        top = (len(radius) - 1) * segments
        faces += [(south, j, i), (north, top + i, top + j)]
    return vertices, np.array(faces)


def _turn(rng: np.random.Generator, tilt: float) -> np.ndarray:
    """A random turn about the vertical axis, with a lean of at most `tilt` radians."""
    a, b = rng.uniform(-np.pi, np.pi), rng.uniform(-tilt, tilt)
    ca, sa, cb, sb = np.cos(a), np.sin(a), np.cos(b), np.sin(b)
    return np.array([[ca, -sa, 0], [sa, ca, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, cb, -sb], [0, sb, cb]])


def _primitive(kind: str, size: np.ndarray, rotation: np.ndarray, offset: np.ndarray) -> DistractorPart:
    return DistractorPart(kind, rotation * size[None, :], offset)


def sample_distractors(rng: np.random.Generator) -> tuple[list[DistractorPart], Float[np.ndarray, "2 3"]]:
    """Draw one piece of clutter and its box (least and greatest corner), scaled to a box diagonal of 1 and centred.

    A third are single solids, some are posts and slabs, the rest are heaps of two to five solids.
    """
    style = rng.random()
    if style < 0.35:
        kind = KINDS[int(rng.choice(4, p=[0.4, 0.25, 0.2, 0.15]))]
        parts = [_primitive(kind, np.exp(rng.normal(0, 0.4, 3)), _turn(rng, 0.0), np.zeros(3))]
    elif style < 0.5:
        thin = rng.uniform(0.03, 0.12)
        size = np.array([thin, thin, 1.0]) if rng.random() < 0.6 else np.array([thin, rng.uniform(0.5, 1.5), 0.8])
        kind = "cylinder" if rng.random() < 0.5 and size[1] == thin else "box"
        parts = [_primitive(kind, size, _turn(rng, 0.0), np.zeros(3))]
        if rng.random() < 0.4:
            top = np.array([0, 0, 0.5])
            parts.append(_primitive(KINDS[int(rng.integers(3))], rng.uniform(0.1, 0.4, 3), _turn(rng, 0.0), top))
    else:
        parts = []
        for _ in range(int(rng.integers(2, 6))):
            kind = KINDS[int(rng.integers(4))]
            size = np.exp(rng.normal(-0.7, 0.5, 3))
            parts.append(_primitive(kind, size, _turn(rng, 1.2), rng.normal(0, 0.35, 3)))
    corners = np.concatenate([unit_mesh(p.kind)[0] @ p.linear.T + p.offset for p in parts])
    low, high = corners.min(axis=0), corners.max(axis=0)
    scale = 1.0 / float(np.linalg.norm(high - low))
    centre = 0.5 * (low + high)
    placed = [DistractorPart(p.kind, p.linear * scale, (p.offset - centre) * scale) for p in parts]
    return placed, np.stack((low - centre, high - centre)) * scale
