"""Voxels of CAD files, made once and kept: filling a mesh at 64^3 takes seconds, and a data set has thousands."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.voxels import pack_voxels
from nolbo_ppl.io.files import atomic_path
from nolbo_ppl.io.npz import read_npy
from nolbo_ppl.parallel import parallel
from nolbo_ppl.progress import progress_bar
from nolbo_ppl.synthetic.assets.cad import load_mesh
from nolbo_ppl.synthetic.assets.cad_mesh import mesh_to_shape

VERSION = 1
"""Of the filling; another one does not read what an older one kept."""


def voxel_key(content: bytes, side: int, up: str | None, front: str | None) -> str:
    """Name of a mesh's voxels in a cache: by its content, not by its path or time."""
    stated = f"{VERSION} {side} {up} {front} ".encode()
    return hashlib.sha256(stated + content).hexdigest()


def cached_voxels(
    file: str | PathLike[str], side: int, cache: str | PathLike[str], up: str | None = None, front: str | None = None
) -> UInt8[np.ndarray, " bytes"]:
    """Packed bits of a CAD file's voxels, side^3, centred with unit diagonal; kept in a cache.

    A damaged entry of the cache is made anew.

    Raises:
        InputError: the mesh cannot be read or filled; names the file.
    """
    file = Path(file)
    place = Path(cache).expanduser() / "voxels" / f"{voxel_key(file.read_bytes(), side, up, front)}.npy"
    size = side**3 // 8
    if place.is_file():
        try:
            kept = read_npy(place, (size,))
        except InputError:
            kept = np.zeros(0, np.float64)
        if kept.dtype == np.uint8:
            return kept
    vertices, faces = load_mesh(file, up, front)
    shape = mesh_to_shape("object", file.stem, vertices, faces, None, {"object": 1.0}, file=file)
    packed = pack_voxels(shape.voxels(side))
    with atomic_path(place) as temporary, temporary.open("wb") as stream:
        np.save(stream, packed)
    return packed


def cached_voxels_of(
    files: Mapping[str, Path], side: int, cache: str | PathLike[str], workers: int = 1, axes: Sequence[str | None] = (None, None)
) -> dict[str, UInt8[np.ndarray, " bytes"]]:
    """The voxels of many files by name, in several processes.

    Raises:
        InputError: as `cached_voxels`.
    """
    jobs = ((cached_voxels, (file, side, cache, *axes)) for file in files.values())
    found = parallel(jobs, workers)
    with progress_bar(None, "voxels", "mesh", total=len(files)) as bar:
        result = {}
        for name, packed in zip(files, found):
            result[name] = packed
            bar.update()
    return result
