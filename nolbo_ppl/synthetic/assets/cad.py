"""Shapes from folders of CAD meshes: users' own OFF, OBJ, PLY, GLB files, or an archive with ready voxels."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nolbo_ppl.errors import NolboError, input_error
from nolbo_ppl.geometry.voxels import voxels_to_mesh
from nolbo_ppl.io.files import inside, is_file, read_json_object
from nolbo_ppl.io.images import is_passed_over
from nolbo_ppl.io.npz import Npz
from nolbo_ppl.progress import progress_bar
from nolbo_ppl.synthetic.assets.cad_mesh import Faces, GridSolid, Vertices, mesh_to_shape
from nolbo_ppl.synthetic.assets.cad_sizes import TYPICAL_DIAGONAL
from nolbo_ppl.synthetic.assets.face_colours import PLAIN, Colours, obj_colours, trimesh_colours
from nolbo_ppl.synthetic.assets.obj_file import read_obj, read_obj_mesh
from nolbo_ppl.synthetic.assets.off_file import read_off
from nolbo_ppl.synthetic.assets.sh3f_file import MAXIMUM_BYTES, load_sh3f
from nolbo_ppl.synthetic.shapes.canonical_shape import Shape

SUFFIXES = (".off", ".obj", ".ply", ".stl", ".glb", ".gltf")
AXES = dict.fromkeys((".glb", ".gltf"), ("+y", "+z"))
"""Up and front of files whose format fixes them (glTF 2.0, 3.4 Coordinate System); of others, `DEFAULT_AXES`."""
DEFAULT_AXES = ("+z", "-y")
ARCHIVE_FILES = ("meshes.npz", "meta.json", "voxels64.npz")
ARCHIVE_VOXELS = 64
BOX_TOLERANCE = 0.03
"""How far (in diagonals; two voxels of 64^3) a simplified mesh may miss its box before its voxels replace it."""


def load_cad_folder(
    path: str | os.PathLike[str],
    categories: Collection[str] | None = None,
    *,
    up: str | None = None,
    front: str | None = None,
    max_faces: int | None = 20_000,
    diagonals: Mapping[str, float] | None = None,
) -> list[Shape]:
    """Load every CAD model of a folder as a `Shape`, sorted by file name; a part for each colour of its faces, else one, "body".

    Colours are those of materials and textures of OBJ (with its MTL), GLB and PLY files, read at the middle of each face. In
    place of a folder a library of Sweet Home 3D is taken too (`.sh3f`, `nolbo_ppl.synthetic.assets.sh3f_file`), whose models
    have real sizes.

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
        up: the axis of the files that points up; by default "+y" for GLB and glTF, as their standard has it, else "+z".
        front: the axis of the files that the front faces; by default "+z" for GLB and glTF, else "-y" for z up and "+z" for
            y up.
        max_faces: meshes with more faces are simplified by clustering their vertices; None never.
        diagonals: metric box diagonals by category, overriding the table.

    Raises:
        InputError: no such folder, no model in it, or a model that is unreadable, empty or degenerate (names it).
    """
    folder = Path(path)
    if folder.suffix.lower() == ".sh3f":
        return load_sh3f(folder, categories, max_faces)
    if not folder.is_dir():
        raise input_error("no such folder of CAD models", file=folder)
    turns = {suffix: axis_rotation(*axes_of(suffix, up, front)) for suffix in SUFFIXES}
    if max_faces is not None and max_faces < 4:
        raise input_error("max_faces", got=max_faces, expected="at least 4, or None")
    wanted = None if categories is None else set(categories)
    if all((folder / name).is_file() for name in ARCHIVE_FILES):
        shapes = list(_load_archive(folder, wanted, diagonals))
    else:
        files = [entry for entry in _list_files(folder) if wanted is None or entry[0] in wanted]
        shapes = []
        for category, instance, file in progress_bar(files, "CAD", "mesh"):
            vertices, faces, colours = _read_coloured(file)
            vertices = vertices @ turns[file.suffix.lower()].T
            shapes.append(mesh_to_shape(category, instance, vertices, faces, max_faces, diagonals, colours=colours, file=file))
    if not shapes:
        which = "any category" if wanted is None else ", ".join(sorted(wanted))
        raise input_error(
            "no CAD model found",
            expected=f"models of {which} as {', '.join(SUFFIXES)}",
            do="name them CATEGORY/NAME.EXT or CATEGORY_NAME.EXT",
            file=folder,
        )
    return shapes


def load_mesh(file: Path, up: str | None = None, front: str | None = None) -> tuple[Vertices, Faces]:
    """One mesh turned to the canonical frame (front to -y, z up), neither centred nor scaled.

    Raises:
        InputError: it is unreadable; names the file.
    """
    vertices, faces = _read_mesh(file)
    return vertices @ axis_rotation(*axes_of(file.suffix.lower(), up, front)).T, faces


def axes_of(suffix: str, up: str | None = None, front: str | None = None) -> tuple[str, str]:
    """Up and front of files of this ending: what is asked for, else what their format fixes.

    Example:
        >>> axes_of(".glb"), axes_of(".obj"), axes_of(".obj", up="+y")
        (('+y', '+z'), ('+z', '-y'), ('+y', '+z'))
    """
    default = AXES.get(suffix, DEFAULT_AXES)
    up = default[0] if up is None else up if up[:1] in ("+", "-") else f"+{up}"
    if front is None:
        front = default[1] if up == default[0] else {"y": "+z", "z": "-y", "x": "-y"}.get(up[1:], default[1])
    return up, front if front[:1] in ("+", "-") else f"+{front}"


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


def _list_files(folder: Path) -> list[tuple[str, str, Path]]:
    """List (category, instance, file) of the two layouts of loose files, sorted; instance names are unique."""
    found: dict[str, tuple[str, str, Path]] = {}
    for file in sorted(folder.rglob("*")):
        if file.suffix.lower() not in SUFFIXES or not file.is_file():
            continue
        if any(is_passed_over(Path(part)) for part in file.relative_to(folder).parts):
            continue
        parts = file.relative_to(folder).with_suffix("").parts
        if len(parts) == 1:
            category, name = _split_name(parts[0], file)
        else:
            category, name = parts[0], "-".join(parts[1:])
        instance = f"{category}-{name}"
        if instance in found:
            raise input_error(
                "two CAD models of one name",
                got=f"{file.name} and {found[instance][2].name}",
                do="rename one",
                file=file,
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
            "CAD file whose category is not told",
            got=file.name,
            expected="CATEGORY_NAME.EXT, or CATEGORY/NAME.EXT",
            file=file,
        )
    return category, name


def _read_mesh(file: Path) -> tuple[Vertices, Faces]:
    """Read one mesh; the parts of a scene are joined in their places. Raises `InputError` naming the file."""
    return read_obj(file) if file.suffix.lower() == ".obj" else _read_coloured(file)[:2]  # textures of OBJ files are other files


def _read_coloured(file: Path) -> tuple[Vertices, Faces, Colours | None]:
    """Read one mesh and the display colour of each face, where the file tells it."""
    if file.suffix.lower() == ".obj":
        mesh = read_obj_mesh(file)
        return mesh.vertices, mesh.faces, obj_colours(mesh, lambda name: _beside(file, name))
    if file.suffix.lower() == ".off":
        return *read_off(file), None
    import trimesh  # delayed: heavy to import

    try:
        loaded: Any = trimesh.load_scene(file, process=False)
        parts: list[Any] = list(loaded.dump()) if len(loaded.geometry) else []
        parts = [part for part in parts if hasattr(part, "faces")]
        first = np.cumsum([0, *(len(part.vertices) for part in parts)])
        vertices = np.concatenate([np.zeros((0, 3)), *(np.asarray(part.vertices, dtype=np.float64) for part in parts)])
        faces = np.concatenate(
            [np.zeros((0, 3), np.int64), *(np.asarray(p.faces, dtype=np.int64) + k for p, k in zip(parts, first))]
        )
        own = [trimesh_colours(part) for part in parts]
    except NolboError:
        raise
    except Exception as error:  # the readers of eight formats raise whatever they meet
        raise input_error("unreadable CAD file", got=f"{type(error).__name__}: {error}", file=file) from error
    if all(one is None for one in own):
        return vertices, faces, None
    plain = [np.tile(PLAIN, (len(part.faces), 1)) if one is None else one for part, one in zip(parts, own)]
    return vertices, faces, np.concatenate(plain)


def _beside(file: Path, name: str) -> bytes | None:
    """Content of a file that a model names, within the model's folder."""
    path = inside(file.parent, name.replace("\\", "/"))
    if path is None or not is_file(path) or path.stat().st_size > MAXIMUM_BYTES:
        return None
    return path.read_bytes()


def _load_archive(folder: Path, wanted: set[str] | None, diagonals: Mapping[str, float] | None) -> Iterator[Shape]:
    """Yield the shapes of an archive with ready voxels (see `load_cad_folder`)."""
    meta = read_json_object(folder / "meta.json")
    mesh_file, voxel_file = folder / "meshes.npz", folder / "voxels64.npz"
    try:
        with Npz(mesh_file) as meshes, Npz(voxel_file) as grids:
            row = {str(name): i for i, name in enumerate(grids.array("names", kinds="U"))}
            solids = grids.array("solid")
            for name, info in meta.items():
                if wanted is None or info["category"] in wanted:
                    yield _archive_shape(name, info, meshes, solids[row[name]], diagonals, mesh_file)
    except NolboError:
        raise
    except (KeyError, IndexError, TypeError, AttributeError, ValueError, OverflowError) as error:
        raise input_error(
            "malformed CAD archive",
            got=f"{type(error).__name__}: {error}",
            do="see load_cad_folder for its layout",
            file=folder,
        ) from error


def _archive_shape(
    name: str,
    info: Mapping[str, Any],
    meshes: Npz,
    packed: np.ndarray,
    diagonals: Mapping[str, float] | None,
    file: Path,
) -> Shape:
    """Make one shape of an archive; its voxels follow the surface where that is moved by half a voxel or more."""
    vertices = meshes.array(f"{name}_v", (None, 3)).astype(np.float64)
    faces = meshes.array(f"{name}_f", (None, 3)).astype(np.int64)
    solid = GridSolid(packed, ARCHIVE_VOXELS)
    box = np.array([info["bbox_min"], info["bbox_max"]])
    missed = np.inf if len(vertices) == 0 else np.abs(np.stack([vertices.min(0), vertices.max(0)]) - box).max()
    if missed > BOX_TOLERANCE:
        vertices, faces = voxels_to_mesh(solid.fill(ARCHIVE_VOXELS))
    if len(vertices):
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        centre, scale = 0.5 * (low + high), float(np.linalg.norm(high - low))
        if max(np.abs(centre).max(), abs(scale - 1.0)) > 0.5 / ARCHIVE_VOXELS:
            solid = GridSolid(packed, ARCHIVE_VOXELS, (float(centre[0]), float(centre[1]), float(centre[2])), scale)
    return mesh_to_shape(info["category"], name, vertices, faces, None, diagonals, solid=solid, file=f"{file}[{name}]")
