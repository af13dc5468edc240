"""OFF files as data sets distribute them: counts beside the word OFF, polygons, colours behind the corners, comments."""

from __future__ import annotations

import re
from itertools import pairwise
from os import PathLike
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.errors import input_error
from nolbo_ppl.io.files import read_text

LARGEST = 20_000_000
"""Vertices or faces that a file may announce."""


def read_off(path: str | PathLike[str]) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Vertices and triangles of an OFF or COFF file; polygons are cut into fans.

    Some 1 000 files of ModelNet40 write `OFF490 518 0` in one word, which their own code reads.

    Raises:
        InputError: names the file and what is wrong: the header, a number, a count, a face past the vertices.
    """
    file = Path(path)
    lines = [line.split("#", 1)[0].split() for line in read_text(file).splitlines()]
    lines = [words for words in lines if words]
    match = re.fullmatch(r"(?:ST)?C?N?OFF(.*)", lines[0][0], re.IGNORECASE) if lines else None
    if match is None:
        raise input_error(
            "unreadable CAD file: header", got=" ".join(lines[0][:3]) if lines else "nothing", expected="OFF", file=file
        )
    rest = [word for word in (match[1], *lines[0][1:]) if word]
    body = lines[1:]
    if not rest and body:
        rest, body = body[0], body[1:]
    try:
        vertices, faces = (int(word) for word in rest[:2])
    except ValueError:
        got = " ".join(rest[:3]) or "nothing"
        raise input_error("unreadable CAD file: counts", got=got, expected="vertices faces edges", file=file) from None
    if not 0 <= vertices <= LARGEST or not 0 <= faces <= LARGEST or vertices + faces > len(body):
        got = f"{vertices} vertices and {faces} faces in {len(body)} lines"
        raise input_error("unreadable CAD file: counts", got=got, expected="a line for each", do="is it truncated?", file=file)
    try:
        points = np.array([[float(word) for word in words[:3]] for words in body[:vertices]], dtype=np.float64).reshape(-1, 3)
    except ValueError as error:
        raise input_error("unreadable CAD file: vertices", got=error, expected="three numbers a line", file=file) from None
    return points, _triangles(body[vertices : vertices + faces], vertices, file)


def _triangles(rows: list[list[str]], vertices: int, file: Path) -> Int[np.ndarray, "f 3"]:
    """Corners of the faces, polygons cut into fans."""
    found: list[tuple[int, int, int]] = []
    for number, words in enumerate(rows):
        try:
            count = int(words[0])
            corners = [int(word) for word in words[1 : 1 + count]]
        except ValueError:
            corners, count = [], -1
        if count < 0 or len(corners) != count or any(not 0 <= corner < vertices for corner in corners):
            got, expected = " ".join(words[:6]), f"a count and as many corners of 0 to {vertices - 1}"
            raise input_error(f"unreadable CAD file: face {number}", got=got, expected=expected, file=file)
        found += [(corners[0], a, b) for a, b in pairwise(corners[1:])]
    return np.array(found, dtype=np.int64).reshape(-1, 3)
