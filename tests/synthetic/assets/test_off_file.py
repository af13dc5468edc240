"""OFF files as data sets distribute them, and voxels that are kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.voxels import unpack_voxels
from nolbo_ppl.synthetic.assets import voxel_cache
from nolbo_ppl.synthetic.assets.off_file import read_off
from nolbo_ppl.synthetic.assets.voxel_cache import cached_voxels, cached_voxels_of

CUBE = """OFF
8 6 12
0 0 0
2 0 0
2 1 0
0 1 0
0 0 1
2 0 1
2 1 1
0 1 1
4 0 3 2 1
4 4 5 6 7
4 0 1 5 4
4 1 2 6 5
4 2 3 7 6
4 3 0 4 7
"""


def written(folder: Path, text: str, name: str = "box.off") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "head", ["OFF\n8 6 12\n", "OFF8 6 12\n", "OFF 8 6 12\n", "# made by hand\noff\n\n8 6 0 # counts\n", "COFF\n8 6 12\n"]
)
def test_headers_of_all_kinds(tmp_path: Path, head: str) -> None:
    vertices, faces = read_off(written(tmp_path, head + CUBE.split("\n", 2)[2]))
    assert vertices.shape == (8, 3) and faces.shape == (12, 3)
    edge = vertices[faces[:, 1:]] - vertices[faces[:, :1]]
    normal = np.cross(edge[:, 0], edge[:, 1])
    assert 0.5 * np.linalg.norm(normal, axis=1).sum() == pytest.approx(2 * (2 + 2 + 1))  # the surface of the box
    inside = vertices[faces].mean(1) - [1, 0.5, 0.5]
    assert ((inside * normal).sum(1) > 0).all()  # counter-clockwise from outside, as the polygons are


def test_colours_and_triangles(tmp_path: Path) -> None:
    text = "OFF\n3 2 0\n0 0 0 255 0 0\n1 0 0 255 0 0\n0 1 0 255 0 0\n3 0 1 2 0.5 0.5 0.5\n2 0 1\n"
    vertices, faces = read_off(written(tmp_path, text))
    assert vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]] and faces.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("PLY\n1 1 1\n", "header"),
        ("", "header"),
        ("OFF\nmany 6 12\n", "counts"),
        ("OFF\n8 6 12\n0 0 0\n", "is it truncated"),
        ("OFF\n1000000000 0 0\n", "counts"),
        ("OFF\n2 1 0\n0 0 0\n0 x 0\n3 0 1 1\n", "vertices"),
        ("OFF\n2 1 0\n0 0\n0 0 0\n3 0 1 1\n", "vertices"),
        ("OFF\n3 1 0\n0 0 0\n0 1 0\n1 0 0\n3 0 1 3\n", "face 0"),
        ("OFF\n3 1 0\n0 0 0\n0 1 0\n1 0 0\n3 0 1\n", "face 0"),
    ],
)
def test_malformed_files_are_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        read_off(written(tmp_path, text))
    assert "box.off" in str(error.value)


def test_voxels_are_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, cache = written(tmp_path, CUBE), tmp_path / "cache"
    first = cached_voxels(file, 16, cache)
    grid = unpack_voxels(first, 16)
    extent = [len(np.flatnonzero(grid.any(axis=tuple({0, 1, 2} - {axis})))) for axis in range(3)]
    side = 16 / np.sqrt(6)
    assert np.abs(np.array(extent) - [2 * side, side, side]).max() <= 1.5  # a box of 2 x 1 x 1, unit diagonal
    monkeypatch.setattr(voxel_cache, "load_mesh", lambda *_: pytest.fail("the mesh was filled again"))
    assert np.array_equal(cached_voxels(file, 16, cache), first)
    copy = written(tmp_path / "other", CUBE, "same.off")
    assert np.array_equal(cached_voxels_of({"a": file, "b": copy}, 16, cache)["b"], first)  # the content counts, not the name


def test_a_damaged_entry_is_made_anew_and_changes_are_seen(tmp_path: Path) -> None:
    file, cache = written(tmp_path, CUBE), tmp_path / "cache"
    first = cached_voxels(file, 8, cache)
    (entry,) = (cache / "voxels").iterdir()
    entry.write_bytes(entry.read_bytes()[:-3])
    assert np.array_equal(cached_voxels(file, 8, cache), first)
    file.write_text(CUBE.replace("2 0 0", "3 0 0"))
    assert not np.array_equal(cached_voxels(file, 8, cache), first)
