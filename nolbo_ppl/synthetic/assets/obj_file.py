"""Wavefront OBJ: vertices and faces, with indices that count from either end of the vertices read so far."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.errors import input_error
from nolbo_ppl.io.files import existing_file, reading


@dataclass(frozen=True)
class ObjMesh:
    """Triangles of an OBJ file, with what its faces say of their looks."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    material: Int[np.ndarray, " f"]
    """Row of each face's material in `materials`; -1 for none."""
    texture: Float[np.ndarray, "f 2"]
    """Texture coordinates (right, up) at the middle of each face; NaN where it has none."""
    materials: tuple[str, ...]
    libraries: tuple[str, ...]
    """Names of the files of materials."""


def read_obj(path: Path) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Vertices and triangles of every object of a file; polygons are split into fans, materials and lines are passed over,
    faces of one or two vertices too, as modellers write the edges that bound no surface.

    A negative index counts back from the last vertex read where the face stands, as exporters of several parts write;
    resolving it at the end of the file (as trimesh 4 and 5 do) turns every part into the last.

    Raises:
        InputError: no such file, a vertex or face that cannot be read, an index without a vertex; names file and line.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "two.obj"
        >>> one = "v 0 0 0\\nv 1 0 0\\nv 0 1 0\\nf -3 -2 -1\\n"
        >>> _ = file.write_text(one + one)
        >>> read_obj(file)[1].tolist()
        [[0, 1, 2], [3, 4, 5]]
    """
    mesh = read_obj_mesh(path)
    return mesh.vertices, mesh.faces


def read_obj_mesh(path: Path) -> ObjMesh:
    """Triangles, materials and texture coordinates of every object of a file; see `read_obj`, and raises as it does."""
    path = existing_file(path)
    with reading(path):
        text = path.read_bytes().decode("utf-8-sig", errors="replace")  # names of materials may be in any encoding
    return parse_obj(text, path)


def parse_obj(text: str, path: Path) -> ObjMesh:
    """The content of an OBJ file; `path` names it in errors. See `read_obj_mesh`."""
    vertices: list[list[float]] = []
    points: list[tuple[float, float]] = []
    faces: list[tuple[int, int, int]] = []
    of_face: list[int] = []
    middles: list[tuple[float, float]] = []
    materials: dict[str, int] = {}
    libraries: list[str] = []
    current = -1
    for number, line in enumerate(text.replace("\\\n", " ").splitlines(), start=1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        if words[0] == "usemtl":
            current = materials.setdefault(line.split(maxsplit=1)[1].strip() if len(words) > 1 else "", len(materials))
        elif words[0] == "mtllib" and len(words) > 1:
            libraries.append(line.split(maxsplit=1)[1].strip())
        elif words[0] == "vt":
            points.append(_texture_point(words))
        if words[0] not in ("v", "f"):
            continue
        try:
            if words[0] == "v":
                x, y, z = (float(word) for word in words[1:4])
                vertices.append([x, y, z])
                continue
            corners = [int(word.split("/", 1)[0]) for word in words[1:]]
            corners = [k + len(vertices) if k < 0 else k - 1 for k in corners]
            if not corners or not all(0 <= k < len(vertices) for k in corners):
                raise ValueError
        except ValueError:
            raise input_error(
                "not a vertex or face of an OBJ file",
                got=repr(line[:60]),
                expected="v x y z, or f with numbers of vertices read before",
                file=path,
                line=number,
            ) from None
        seen = [_texture_of(word, points) for word in words[1:]]
        for k in range(1, len(corners) - 1):
            faces.append((corners[0], corners[k], corners[k + 1]))
            of_face.append(current)
            u, v = (sum(seen[j][axis] for j in (0, k, k + 1)) / 3 for axis in (0, 1))
            middles.append((u, v))
    return ObjMesh(
        np.array(vertices, dtype=np.float64).reshape(-1, 3),
        np.array(faces, dtype=np.int64).reshape(-1, 3),
        np.array(of_face, dtype=np.int64),
        np.array(middles, dtype=np.float64).reshape(-1, 2),
        tuple(materials),
        tuple(libraries),
    )


def _texture_point(words: list[str]) -> tuple[float, float]:
    """A texture coordinate; NaN where it is none: colours alone suffer."""
    try:
        return float(words[1]), float(words[2]) if len(words) > 2 else 0.0
    except (ValueError, IndexError):
        return float("nan"), float("nan")


def _texture_of(word: str, points: list[tuple[float, float]]) -> tuple[float, float]:
    """Texture coordinate of a face's corner `v/vt/vn`."""
    parts = word.split("/")
    try:
        k = int(parts[1]) if len(parts) > 1 and parts[1] else 0
    except ValueError:
        k = 0
    k = k + len(points) if k < 0 else k - 1
    return points[k] if 0 <= k < len(points) else (float("nan"), float("nan"))
