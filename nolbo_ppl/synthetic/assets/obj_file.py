"""Wavefront OBJ: vertices and faces, with indices that count from either end of the vertices read so far."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.errors import input_error
from nolbo_ppl.io.files import existing_file, reading


def read_obj(path: Path) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Vertices and triangles of every object of a file; polygons are split into fans, materials and lines are passed over.

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
    vertices: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    path = existing_file(path)
    with reading(path):
        text = path.read_bytes().decode("utf-8-sig", errors="replace")  # names of materials may be in any encoding
    for number, line in enumerate(text.replace("\\\n", " ").splitlines(), start=1):
        words = line.split("#", 1)[0].split()
        if not words or words[0] not in ("v", "f"):
            continue
        try:
            if words[0] == "v":
                x, y, z = (float(word) for word in words[1:4])
                vertices.append([x, y, z])
                continue
            corners = [int(word.split("/", 1)[0]) for word in words[1:]]
            corners = [k + len(vertices) if k < 0 else k - 1 for k in corners]
            if len(corners) < 3 or not all(0 <= k < len(vertices) for k in corners):
                raise ValueError
        except ValueError:
            raise input_error(
                "not a vertex or face of an OBJ file",
                got=repr(line[:60]),
                expected="v x y z, or f with three or more numbers of vertices",
                file=path,
                line=number,
            ) from None
        faces += [(corners[0], corners[k], corners[k + 1]) for k in range(1, len(corners) - 1)]
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), np.array(faces, dtype=np.int64).reshape(-1, 3)
