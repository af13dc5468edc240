"""A shape in its canonical frame: surface with material roles, size in metres, symmetry, and solid voxels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float, Int

from nolbo_ppl.errors import input_error
from nolbo_ppl.synthetic.shapes.primitives import ROUND, Primitive

MATERIAL_ROLES: tuple[str, ...] = (
    "body",  # the main colour of the object
    "body2",  # its second colour: livery, back shell, second tone
    "trim",  # dark plastic: bumpers, frames, housings
    "windscreen",  # the large front window of a vehicle
    "glass",  # all other windows: darker
    "tyre",
    "rim",
    "light_front",  # white
    "light_rear",  # red
    "grille",  # dark openings: radiator grilles, vents, air intakes
    "plate",  # number plate, pale signs
    "display",  # a lit destination display
    "metal",
    "dark_metal",
    "wood",
    "fabric",  # upholstery
    "cushion",  # cushions laid on the upholstery: another tone
    "plastic",
    "screen",  # dark glossy screen of a television
    "label",
    "bottle",  # the wall of a bottle
    "cap",
    "liquid",
    "wing",
    "propeller",
    "sail",
    "hull",
    "deck",
    "saddle",
)
"""Every role a face may have; a renderer chooses its materials by these names."""

MIN_HALF_VOXELS = 0.6
"""Parts thinner than this to each side, in voxels, are filled as if they were this thick."""


class Solid(Protocol):
    """The filled volume of a shape in its canonical frame."""

    def fill(self, n: int) -> Bool[np.ndarray, "{n} {n} {n}"]:
        """Occupancy at the centres of n^3 voxels over [-0.5, 0.5]^3, index [ix, iy, iz]."""


@dataclass(frozen=True)
class AnalyticSolid:
    """The union of primitives, in metres in the builder's frame.

    Attributes:
        primitives: the solid parts.
        centre: the box centre [3] in that frame, in metres.
        diagonal: the box diagonal in metres.
    """

    primitives: tuple[Primitive, ...]
    centre: Float[np.ndarray, " 3"]
    diagonal: float

    @cached_property
    def _bounds(self) -> list[list[list[float]]]:
        return [primitive.bounds().tolist() for primitive in self.primitives]

    def fill(self, n: int) -> Bool[np.ndarray, "{n} {n} {n}"]:
        """Fill every primitive in its own part of the grid (see `Solid.fill`).

        Walls and panels thinner than 0.6 voxel to each side (`MIN_HALF_VOXELS`) are thickened to that, round rods to
        0.75.
        """
        step = self.diagonal / n
        thin = MIN_HALF_VOXELS * step
        pad = ROUND * thin
        ticks = (np.arange(n) + 0.5) * step - 0.5 * self.diagonal
        axes = [ticks + c for c in self.centre]
        first = [float(axis[0]) for axis in axes]
        grid = np.zeros((n, n, n), dtype=bool)
        for primitive, (low, high) in zip(self.primitives, self._bounds):
            window = tuple(
                slice(max(int((low[i] - pad - first[i]) / step), 0), max(int((high[i] + pad - first[i]) / step) + 1, 0))
                for i in range(3)
            )
            grid[window] |= primitive.inside(axes[0][window[0]], axes[1][window[1]], axes[2][window[2]], thin)
        return grid


@dataclass(frozen=True)
class Shape:
    """One object instance in its canonical frame: front to -y, x right, z up, box centred, box diagonal 1.

    Attributes:
        category: category name.
        instance: name of the instance, unique within its source.
        vertices: corners [v, 3] in units of the box diagonal.
        faces: triangles [f, 3], counter-clockwise seen from outside.
        part: index into `parts` for each face.
        parts: names of material roles (`MATERIAL_ROLES`).
        diagonal: the box diagonal in metres.
        symmetry: order about the vertical axis: 1 none, n for n-fold, 0 for free.
        solid: what fills the voxels.
        licence: who made it and under which licence, where a file says so.
    """

    category: str
    instance: str
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    part: Int[np.ndarray, " f"]
    parts: tuple[str, ...]
    diagonal: float
    symmetry: int
    solid: Solid
    licence: str = ""

    def voxels(self, n: int) -> Bool[np.ndarray, "{n} {n} {n}"]:
        """Solid occupancy at the centres of n^3 voxels over [-0.5, 0.5]^3, index [ix, iy, iz].

        Parts thinner than 0.6 voxel to each side (0.75 for round ones) are thickened to that, so that bicycle tubes and
        chair legs survive.
        Raises `InputError` unless n is at least 1.
        """
        if n < 1:
            raise input_error("voxel grid size", got=n, expected="at least 1")
        return self.solid.fill(n)

    @property
    def dimensions(self) -> Float[np.ndarray, " 3"]:
        """Side lengths of the box along x, y and z in metres."""
        return (self.vertices.max(axis=0) - self.vertices.min(axis=0)) * self.diagonal


def assemble(category: str, instance: str, solids: Sequence[Primitive], decals: Sequence[Primitive], symmetry: int) -> Shape:
    """Join primitives in metres into one shape in its canonical frame; decals are drawn but fill no voxels.

    Raises:
        InputError: there is no solid, or the box is degenerate.
    """
    vertices, faces, roles, offset = [], [], [], 0
    for primitive in (*solids, *decals):
        corners, triangles, names = primitive.mesh()
        vertices.append(corners)
        faces.append(triangles + offset)
        roles.extend(names)
        offset += len(corners)
    if not solids:
        raise input_error("shape without a solid part", got=f"{category} {instance}")
    points = np.concatenate(vertices)
    low, high = points.min(axis=0), points.max(axis=0)
    centre, diagonal = 0.5 * (low + high), float(np.linalg.norm(high - low))
    if not (np.isfinite(diagonal) and diagonal > 0):
        raise input_error("degenerate shape", got=f"{category} {instance} with box diagonal {diagonal}")
    parts = tuple(role for role in MATERIAL_ROLES if role in set(roles))
    index = {role: i for i, role in enumerate(parts)}
    unknown = sorted(set(roles) - set(parts))
    if unknown:
        raise input_error("unknown material role", got=unknown, expected="names of MATERIAL_ROLES")
    return Shape(
        category=category,
        instance=instance,
        vertices=(points - centre) / diagonal,
        faces=np.concatenate(faces).astype(np.int64),
        part=np.array([index[role] for role in roles], dtype=np.int64),
        parts=parts,
        diagonal=diagonal,
        symmetry=symmetry,
        solid=AnalyticSolid(tuple(solids), centre, diagonal),
    )
