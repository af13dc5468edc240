"""Shapes from folders of CAD meshes: users' own OFF, OBJ, PLY, GLB files, or an archive with ready voxels."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from tqdm import tqdm

from nolbo_ppl.categories import CATEGORY_SYMMETRY
from nolbo_ppl.data.cad_sizes import TYPICAL_DIAGONAL, typical_diagonal
from nolbo_ppl.data.shapes.shape import Shape, Solid
from nolbo_ppl.errors import NolboError, input_error
from nolbo_ppl.geometry.voxels import (
    mesh_to_voxels,
    reduce_voxels,
    unpack_voxels,
    voxel_centres,
    voxel_iou,
    voxels_to_mesh,
)
from nolbo_ppl.io import read_json

SUFFIXES = (".off", ".obj", ".ply", ".glb")
ARCHIVE_FILES = ("meshes.npz", "meta.json", "voxels64.npz")
ARCHIVE_VOXELS = 64
BOX_TOLERANCE = 0.03
"""How far (in diagonals; two voxels of 64^3) a simplified mesh may miss its box before its voxels replace it."""

Vertices = Float[np.ndarray, "v 3"]
Faces = Int[np.ndarray, "f 3"]


@dataclass
class MeshSolid:
    """A mesh, open or closed, voxelised on demand at twice the resolution (see `mesh_to_voxels`) and kept.

    Holes up to one voxel wide are closed.
    """

    vertices: Vertices
    faces: Faces
    _cache: dict[int, np.ndarray] = field(default_factory=dict, repr=False)

    def fill(self, n: int) -> Bool[np.ndarray, "{n} {n} {n}"]:
        """Occupancy of n^3 voxels over [-0.5, 0.5]^3."""
        if n not in self._cache:
            self._cache[n] = reduce_voxels(mesh_to_voxels(self.vertices, self.faces, 2 * n, gap=1), n)
        return self._cache[n].copy()


@dataclass(frozen=True)
class GridSolid:
    """Voxels that came with the data, resampled on demand."""

    packed: UInt8[np.ndarray, " bytes"]
    size: int

    def fill(self, n: int) -> Bool[np.ndarray, "{n} {n} {n}"]:
        """Occupancy of n^3 voxels over [-0.5, 0.5]^3."""
        return reduce_voxels(unpack_voxels(self.packed, self.size), n)


def load_cad_folder(
    path: str | os.PathLike[str],
    categories: Collection[str] | None = None,
    *,
    up: str = "+z",
    front: str = "-y",
    max_faces: int | None = 20_000,
    diagonals: Mapping[str, float] | None = None,
) -> list[Shape]:
    """Load every CAD model of a folder as a `Shape` with one part, "body", sorted by file name.

    Three layouts are understood:

    - sub-folders named by category, each with OFF, OBJ, PLY or GLB files (at any depth): `car/beetle.obj`;
    - files named `CATEGORY_NAME.EXT` in the folder itself: `car_beetle.obj`;
    - an archive of `meshes.npz` (`NAME_v` vertices, `NAME_f` faces), `meta.json` (NAME: `category`, `bbox_min`,
      `bbox_max`) and `voxels64.npz` (`names`, `solid`: packed bits of 64^3), all in the canonical frame already. Where
      a mesh misses its box by more than 0.03 (a simplification that lost parts), marching cubes of its voxels
      replace it.

    Meshes are turned to the canonical frame (front to -y, z up), centred, and scaled to unit diagonal. Voxels are the
    surface and all it shuts in, so that open meshes work. Files carry no unit: the metric diagonal comes from
    `diagonals`, else from `TYPICAL_DIAGONAL`. The symmetry of the categories declared symmetric is measured on the
    voxels (0, 4, 2 or 1); a category outside the twelve keeps its own name and is 0 (a solid of revolution) or 1.

    Args:
        path: the folder.
        categories: only these; all by default.
        up: the axis of the files that points up, e.g. "+y" for GLB by its standard.
        front: the axis of the files that the front faces, e.g. "+z" for GLB.
        max_faces: meshes with more faces are simplified by clustering their vertices; None never.
        diagonals: metric box diagonals by category, overriding the table.

    Raises:
        InputError: no such folder, no model in it, or a model that is unreadable, empty or degenerate (names it).
    """
    folder = Path(path)
    if not folder.is_dir():
        raise input_error("no such folder of CAD models", file=folder)
    turn = axis_rotation(up, front)
    if max_faces is not None and max_faces < 4:
        raise input_error("max_faces", got=max_faces, expected="at least 4, or None")
    wanted = None if categories is None else set(categories)
    if all((folder / name).is_file() for name in ARCHIVE_FILES):
        shapes = list(_load_archive(folder, wanted, diagonals))
    else:
        files = [entry for entry in _list_files(folder) if wanted is None or entry[0] in wanted]
        shapes = []
        for category, instance, file in tqdm(files, desc="CAD", unit="mesh", disable=None):
            vertices, faces = _read_mesh(file)
            vertices = vertices @ turn.T
            shapes.append(mesh_to_shape(category, instance, vertices, faces, max_faces, diagonals, file=file))
    if not shapes:
        which = "any category" if wanted is None else ", ".join(sorted(wanted))
        raise input_error(
            "no CAD model found", expected=f"models of {which} as {', '.join(SUFFIXES)}",
            do="name them CATEGORY/NAME.EXT or CATEGORY_NAME.EXT", file=folder,
        )
    return shapes


def axis_rotation(up: str, front: str) -> Float[np.ndarray, "3 3"]:
    """Rotation from a frame with the given up and front axes to the canonical one (z up, front to -y).

    Raises:
        InputError: a name that is no signed axis, or both on one axis.
    """
    axes = {sign + name: (1.0 if sign == "+" else -1.0) * np.eye(3)[i] for sign in "+-" for i, name in enumerate("xyz")}
    for name, value in (("up", up), ("front", front)):
        if value not in axes:
            raise input_error(f"{name} axis", got=repr(value), expected="one of " + ", ".join(axes))
    z, y = axes[up], -axes[front]
    if abs(z @ y) > 0.5:
        raise input_error("up and front axes", got=f"{up} and {front}", expected="two different axes")
    return np.stack([np.cross(y, z), y, z])


def mesh_to_shape(
    category: str,
    instance: str,
    vertices: Vertices,
    faces: Faces,
    max_faces: int | None = None,
    diagonals: Mapping[str, float] | None = None,
    *,
    solid: Solid | None = None,
    file: str | os.PathLike[str] | None = None,
) -> Shape:
    """Make a `Shape` of a mesh that stands in the canonical orientation; it is centred and scaled here.

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
    points, faces = _simplify(points, faces[area > 0], max_faces)
    fill: Solid = MeshSolid(points, faces) if solid is None else solid
    return Shape(
        category=category, instance=instance, vertices=points, faces=faces, part=np.zeros(len(faces), dtype=np.int64),
        parts=("body",), diagonal=typical_diagonal(category, diagonals), symmetry=_symmetry(category, fill), solid=fill,
    )


def _symmetry(category: str, solid: Solid) -> int:
    """Symmetry order of a model, by the overlap of its voxels with their turned copy."""
    declared = CATEGORY_SYMMETRY.get(category)
    if declared == 1:
        return 1
    grid = solid.fill(ARCHIVE_VOXELS // 2)

    def overlap(degrees: float) -> float:
        return float(voxel_iou(grid, _turned(grid, degrees)))

    if min(overlap(45.0), overlap(20.0)) > 0.85:
        return 0
    if declared is None or overlap(180.0) <= 0.85:
        return 1
    return 4 if overlap(90.0) > 0.85 else 2


def _turned(grid: np.ndarray, degrees: float) -> np.ndarray:
    """Turn a grid about its vertical axis, each column from the nearest one; what comes from outside is empty."""
    n = len(grid)
    x, y = np.meshgrid(voxel_centres(n), voxel_centres(n), indexing="ij")
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    index = np.floor((np.stack([cos * x + sin * y, cos * y - sin * x]) + 0.5) * n + 1e-9).astype(np.int64)
    inside = ((index >= 0) & (index < n)).all(axis=0)
    i, j = np.clip(index, 0, n - 1)
    return np.asarray(grid[i, j] & inside[..., None])


def _simplify(vertices: Vertices, faces: Faces, max_faces: int | None) -> tuple[Vertices, Faces]:
    """Drop unused vertices; merge those in one cell of a grid, ever coarser, until at most `max_faces` are left.

    Clustering moves a vertex to the mean of its cell; it takes any mesh, open or not. The result is put back into the
    unit box.
    """
    index, inverse = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[index], inverse.reshape(-1, 3)
    cells, points, triangles = 512.0, vertices, faces
    while max_faces is not None and len(triangles) > max_faces and cells > 4:
        _, label = np.unique(np.floor((vertices + 0.5) * cells).astype(np.int64), axis=0, return_inverse=True)
        label = label.reshape(-1)
        count = np.bincount(label)
        points = np.stack([np.bincount(label, vertices[:, i]) / count for i in range(3)], axis=-1)
        triangles = label[faces]
        a, b, c = triangles.T
        triangles = triangles[(a != b) & (b != c) & (c != a)]
        triangles = triangles[np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)[1]]
        cells *= 0.8
    if points is not vertices:
        index, inverse = np.unique(triangles, return_inverse=True)
        points, triangles = points[index], inverse.reshape(-1, 3)
        low, high = points.min(axis=0), points.max(axis=0)
        points = (points - 0.5 * (low + high)) / np.linalg.norm(high - low)
    return points, triangles.astype(np.int64)


def _list_files(folder: Path) -> list[tuple[str, str, Path]]:
    """List (category, instance, file) of the two layouts of loose files, sorted; instance names are unique."""
    found: dict[str, tuple[str, str, Path]] = {}
    for file in sorted(folder.rglob("*")):
        if file.suffix.lower() not in SUFFIXES or not file.is_file():
            continue
        parts = file.relative_to(folder).with_suffix("").parts
        if len(parts) == 1:
            category, name = _split_name(parts[0], file)
        else:
            category, name = parts[0], "-".join(parts[1:])
        instance = f"{category}-{name}"
        if instance in found:
            raise input_error(
                "two CAD models of one name", got=f"{file.name} and {found[instance][2].name}", do="rename one", file=file
            )
        found[instance] = (category, instance, file)
    return list(found.values())


def _split_name(stem: str, file: Path) -> tuple[str, str]:
    """Split CATEGORY_NAME: at the end of a known category when it starts with one, else at the first underscore."""
    known = [c for c in TYPICAL_DIAGONAL if stem.startswith(c + "_")]
    category = max(known, key=len) if known else stem.partition("_")[0]
    name = stem[len(category) + 1 :]
    if not category or not name:
        raise input_error(
            "CAD file whose category is not told", got=file.name, expected="CATEGORY_NAME.EXT, or CATEGORY/NAME.EXT", file=file
        )
    return category, name


def _read_mesh(file: Path) -> tuple[Vertices, Faces]:
    """Read one mesh; the parts of a scene are joined in their places. Raises `InputError` naming the file."""
    import trimesh  # delayed: heavy to import

    try:
        loaded: Any = trimesh.load_scene(file, process=False)
        mesh: Any = loaded.to_mesh() if len(loaded.geometry) else None
        vertices = np.zeros((0, 3)) if mesh is None else np.asarray(mesh.vertices, dtype=np.float64)
        faces = np.zeros((0, 3), np.int64) if mesh is None else np.asarray(mesh.faces, dtype=np.int64)
    except NolboError:
        raise
    except Exception as error:  # the readers of eight formats raise whatever they meet
        raise input_error("unreadable CAD file", got=f"{type(error).__name__}: {error}", file=file) from error
    return vertices, faces


def _load_archive(folder: Path, wanted: set[str] | None, diagonals: Mapping[str, float] | None) -> Iterator[Shape]:
    """Yield the shapes of an archive with ready voxels (see `load_cad_folder`)."""
    meta = read_json(folder / "meta.json")
    mesh_file, voxel_file = folder / "meshes.npz", folder / "voxels64.npz"
    try:
        with np.load(mesh_file, allow_pickle=False) as meshes, np.load(voxel_file, allow_pickle=False) as grids:
            row = {str(name): i for i, name in enumerate(grids["names"])}
            solids = grids["solid"]
            for name, info in meta.items():
                if wanted is None or info["category"] in wanted:
                    yield _archive_shape(name, info, meshes, solids[row[name]], diagonals, mesh_file)
    except (KeyError, zipfile.BadZipFile, OSError, TypeError, AttributeError) as error:
        raise input_error(
            "malformed CAD archive", got=f"{type(error).__name__}: {error}", do="see load_cad_folder for its layout", file=folder
        ) from error


def _archive_shape(
    name: str, info: Mapping[str, Any], meshes: Mapping[str, np.ndarray], packed: np.ndarray,
    diagonals: Mapping[str, float] | None, file: Path,
) -> Shape:
    """Make one shape of an archive; its voxels stay where they are, the surface is centred on them."""
    vertices = meshes[f"{name}_v"].astype(np.float64)
    faces = meshes[f"{name}_f"].astype(np.int64)
    solid = GridSolid(packed, ARCHIVE_VOXELS)
    box = np.array([info["bbox_min"], info["bbox_max"]])
    missed = np.inf if len(vertices) == 0 else np.abs(np.stack([vertices.min(0), vertices.max(0)]) - box).max()
    if missed > BOX_TOLERANCE:
        vertices, faces = voxels_to_mesh(solid.fill(ARCHIVE_VOXELS))
    return mesh_to_shape(info["category"], name, vertices, faces, None, diagonals, solid=solid, file=f"{file}[{name}]")
