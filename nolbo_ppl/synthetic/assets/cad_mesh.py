"""One CAD mesh as a shape: centred and scaled, simplified, voxelised whether closed or not, its symmetry measured."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from nolbo_ppl.categories import CATEGORY_SYMMETRY
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.voxels import mesh_to_voxels, reduce_voxels, unpack_voxels, voxel_centres, voxel_iou
from nolbo_ppl.synthetic.assets.cad_sizes import typical_diagonal
from nolbo_ppl.synthetic.assets.face_colours import painted_parts
from nolbo_ppl.synthetic.shapes.canonical_shape import Shape, Solid

SYMMETRY_GRID = 32
"""Size of the voxel grid on which symmetry is measured."""

SYMMETRY_OVERLAP = 0.85
"""Least overlap of a grid with its turned copy that counts as a symmetry."""

Vertices = Float[np.ndarray, "v 3"]
Faces = Int[np.ndarray, "f 3"]


@dataclass
class MeshSolid:
    """A mesh, open or closed, voxelised on demand at three times the resolution (see `mesh_to_voxels`) and kept.

    Holes up to two thirds of a voxel wide are closed.
    """

    vertices: Vertices
    faces: Faces
    _cache: dict[int, np.ndarray] = field(default_factory=dict, repr=False)

    def fill(self, n: int) -> Bool[np.ndarray, "{n} {n} {n}"]:
        """Occupancy of n^3 voxels over [-0.5, 0.5]^3."""
        if n not in self._cache:
            self._cache[n] = reduce_voxels(mesh_to_voxels(self.vertices, self.faces, 3 * n, gap=1), n)
        return self._cache[n].copy()


@dataclass(frozen=True)
class GridSolid:
    """Voxels that came with the data, resampled on demand.

    Attributes:
        packed: bits of the grid, over [-0.5, 0.5]^3 of its own frame.
        size: its size.
        centre: where the shape's box centre lies in that frame.
        scale: length of the shape's unit in that frame.
    """

    packed: UInt8[np.ndarray, " bytes"]
    size: int
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: float = 1.0

    def fill(self, n: int) -> Bool[np.ndarray, "{n} {n} {n}"]:
        """Occupancy of n^3 voxels over [-0.5, 0.5]^3."""
        return reduce_voxels(unpack_voxels(self.packed, self.size), n, centre=self.centre, scale=self.scale)


def mesh_to_shape(
    category: str,
    instance: str,
    vertices: Vertices,
    faces: Faces,
    max_faces: int | None = None,
    diagonals: Mapping[str, float] | None = None,
    *,
    solid: Solid | None = None,
    colours: Float[np.ndarray, "f 3"] | None = None,
    licence: str = "",
    file: str | os.PathLike[str] | None = None,
) -> Shape:
    """Make a `Shape` of a mesh that stands in the canonical orientation; it is centred and scaled here.

    Faces with colours (display values, 0 to 1) make parts of one colour each; else there is one part, "body".

    Raises:
        InputError: no faces, faces pointing past the vertices, vertices that are not finite, or no area.
    """
    if len(faces) == 0:
        raise input_error("CAD mesh without faces", got=f"{len(vertices)} vertices", file=file)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise input_error("CAD mesh with faces past its vertices", got=int(faces.max()), expected=f"< {len(vertices)}", file=file)
    used = vertices[np.unique(faces)]
    if not np.isfinite(used).all():
        raise input_error("CAD mesh with vertices that are NaN or infinite", file=file)
    low, high = used.min(axis=0), used.max(axis=0)
    diagonal = float(np.linalg.norm(high - low))
    points = (vertices - 0.5 * (low + high)) / (diagonal if diagonal > 0 else 1.0)
    edge = points[faces[:, 1:]] - points[faces[:, :1]]
    area = np.linalg.norm(np.cross(edge[:, 0], edge[:, 1]), axis=-1)
    if not area.sum() > 1e-9:
        raise input_error("degenerate CAD mesh: its faces have no area", got=f"{len(faces)} faces", file=file)
    points, faces, kept = _simplify(points, faces[area > 0], max_faces)
    part = np.zeros(len(faces), dtype=np.int64)
    parts: tuple[str, ...] = ("body",)
    if colours is not None:
        part, parts = painted_parts(colours[area > 0][kept])
    fill: Solid = MeshSolid(points, faces) if solid is None else solid
    return Shape(
        category=category,
        instance=instance,
        vertices=points,
        faces=faces,
        part=part,
        parts=parts,
        diagonal=typical_diagonal(category, diagonals),
        symmetry=_symmetry(category, fill),
        solid=fill,
        licence=licence,
    )


def _symmetry(category: str, solid: Solid) -> int:
    """Symmetry order of a model, by the overlap of its voxels with their turned copy."""
    declared = CATEGORY_SYMMETRY.get(category)
    if declared == 1:
        return 1
    grid = solid.fill(SYMMETRY_GRID)

    def overlap(degrees: float) -> float:
        return float(voxel_iou(grid, _turned(grid, degrees)))

    if min(overlap(45.0), overlap(20.0)) > SYMMETRY_OVERLAP:
        return 0
    if declared is None or overlap(180.0) <= SYMMETRY_OVERLAP:
        return 1
    return 4 if overlap(90.0) > SYMMETRY_OVERLAP else 2


def _turned(grid: np.ndarray, degrees: float) -> np.ndarray:
    """Turn a grid about its vertical axis, each column from the nearest one; what comes from outside is empty."""
    n = len(grid)
    x, y = np.meshgrid(voxel_centres(n), voxel_centres(n), indexing="ij")
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    index = np.floor((np.stack([cos * x + sin * y, cos * y - sin * x]) + 0.5) * n + 1e-9).astype(np.int64)
    inside = np.logical_and.reduce((index >= 0) & (index < n), axis=0)
    i, j = np.clip(index, 0, n - 1)
    return np.asarray(grid[i, j] & inside[:, :, None])


def _simplify(vertices: Vertices, faces: Faces, max_faces: int | None) -> tuple[Vertices, Faces, Int[np.ndarray, " kept"]]:
    """Drop unused vertices; merge those in one cell of a grid, ever coarser, until at most `max_faces` are left.

    Clustering moves a vertex to the mean of its cell; it takes any mesh, open or not. The result is put back into the
    unit box. The third result is the face that each of the remaining ones was.
    """
    index, inverse = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[index], inverse.reshape(-1, 3)
    cells, points, triangles, kept = 512.0, vertices, faces, np.arange(len(faces))
    while max_faces is not None and len(triangles) > max_faces and cells > 4:
        _, label = np.unique(np.floor((vertices + 0.5) * cells).astype(np.int64), axis=0, return_inverse=True)
        label = label.reshape(-1)
        count = np.bincount(label)
        points = np.stack([np.bincount(label, vertices[:, i]) / count for i in range(3)], axis=-1)
        triangles = label[faces]
        a, b, c = triangles.T
        kept = np.flatnonzero((a != b) & (b != c) & (c != a))
        kept = kept[np.unique(np.sort(triangles[kept], axis=1), axis=0, return_index=True)[1]]
        triangles = triangles[kept]
        cells *= 0.8
    if points is not vertices:
        index, inverse = np.unique(triangles, return_inverse=True)
        points, triangles = points[index], inverse.reshape(-1, 3)
        low, high = points.min(axis=0), points.max(axis=0)
        points = (points - 0.5 * (low + high)) / np.linalg.norm(high - low)
    return points, triangles.astype(np.int64), kept
