"""NPZ files: names, types and shapes are known before anything is unpacked; no pickle, no bomb, one error for all damage."""

from __future__ import annotations

import math
import os
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import numpy as np
from jaxtyping import UInt8
from numpy.lib import format as npy

from nolbo_ppl.errors import InputError, input_error
from nolbo_ppl.io.files import atomic_path, existing_file, reading

LARGEST_ARRAY = 1 << 28
"""Bytes above which one array is refused before it is unpacked: a file of 1 MB may hold gigabytes of zeros."""
MOST_ARRAYS = 1 << 17
"""Arrays above which a file is refused."""
KINDS = {"f": "floating point", "i": "whole", "u": "whole", "b": "true or false", "U": "text"}
"""Types of arrays that are read, by NumPy's letters."""

Shape = tuple[int | None, ...]


@dataclass(frozen=True)
class ArrayHeader:
    """What a member says of itself."""

    shape: tuple[int, ...]
    """Its shape."""
    dtype: np.dtype
    """Its type."""

    @property
    def nbytes(self) -> int:
        """Its size in memory."""
        return math.prod(self.shape) * self.dtype.itemsize


class Npz:
    """An NPZ file that is open for reading: `names`, `headers`, and `array`, which unpacks one member.

    Raises:
        InputError: missing, damaged, not an archive of arrays, arrays of objects or above `largest` bytes; names file and
            member.

    Example:
        >>> import tempfile, pathlib
        >>> file = pathlib.Path(tempfile.mkdtemp()) / "steps.npz"
        >>> save_npz(file, {"covariance": np.zeros((3, 6, 6))})
        >>> with Npz(file) as archive:
        ...     archive.names, archive.array("covariance", (None, 6, 6)).shape
        (('covariance',), (3, 6, 6))
    """

    def __init__(self, path: str | os.PathLike[str], largest: int = LARGEST_ARRAY) -> None:
        self.path, self.largest = existing_file(path), largest
        with reading(self.path):
            try:
                self._zip = zipfile.ZipFile(self.path)
            except OSError:
                raise
            except Exception as error:  # zipfile raises whatever damaged bytes make it run into
                raise self._damaged(error) from None
        try:
            self.headers: Mapping[str, ArrayHeader] = self._headers()
        except BaseException:
            self._zip.close()
            raise

    def __enter__(self) -> Npz:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._zip.close()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the arrays."""
        return tuple(self.headers)

    def _damaged(self, error: object, name: str | None = None) -> InputError:
        what = "not a readable NPZ file" if name is None else f"array `{name}` cannot be read"
        got = f"{type(error).__name__}: {error}" if isinstance(error, Exception) and not str(error) else error
        return input_error(what, got=got, do="is it truncated?", file=self.path)

    def _headers(self) -> dict[str, ArrayHeader]:
        found: dict[str, ArrayHeader] = {}
        members = self._zip.infolist()
        if len(members) > MOST_ARRAYS:
            raise input_error("NPZ file", got=f"{len(members)} arrays", expected=f"at most {MOST_ARRAYS}", file=self.path)
        for member in members:
            name = member.filename.removesuffix(".npy")
            if name in found or not member.filename.endswith(".npy"):
                got = "a name that stands twice" if name in found else "a member that is no array"
                raise input_error(f"array `{name}`", got=got, file=self.path)
            found[name] = self._header(member, name)
        return found

    def _header(self, member: zipfile.ZipInfo, name: str) -> ArrayHeader:
        try:
            with self._zip.open(member) as file:
                version = npy.read_magic(file)
                read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
                shape, _, dtype = read(file)
        except Exception as error:  # zlib, zipfile, tokenizer and NumPy each raise their own
            raise self._damaged(error, name) from None
        header = ArrayHeader(shape, dtype)
        if dtype.kind not in KINDS:
            raise input_error(f"array `{name}`", got=f"type {dtype}", expected="numbers, truth values or text", file=self.path)
        if any(length < 0 for length in shape) or not header.nbytes <= min(self.largest, member.file_size):
            got = f"shape {shape} of {dtype}"
            expected = f"what its {member.file_size} bytes hold, at most {self.largest} bytes"
            raise input_error(f"array `{name}`", got=got, expected=expected, file=self.path)
        return header

    def array(self, name: str, shape: Shape | None = None, kinds: str = "fiu", finite: bool = True) -> np.ndarray:
        """Unpack one array.

        Args:
            name: its name.
            shape: what its shape must be, None for any length; checked before it is unpacked.
            kinds: NumPy's letters of the types it may have: f, i, u, b, U.
            finite: refuse NaN and infinity.

        Raises:
            InputError: no such array, another shape or type, damaged, or not finite; names file and array.
        """
        header = self.headers.get(name)
        if header is None:
            raise input_error(f"no array `{name}`", got=list(self.names), file=self.path)
        if shape is not None and (
            len(shape) != len(header.shape) or any(want not in (None, have) for want, have in zip(shape, header.shape))
        ):
            expected = "[" + ", ".join("any" if length is None else str(length) for length in shape) + "]"
            raise input_error(f"array `{name}`", got=f"shape {list(header.shape)}", expected=expected, file=self.path)
        if header.dtype.kind not in kinds:
            wanted = " or ".join(dict.fromkeys(KINDS[kind] for kind in kinds))
            raise input_error(f"array `{name}`", got=f"type {header.dtype}", expected=f"{wanted} values", file=self.path)
        try:
            with self._zip.open(f"{name}.npy") as file:
                value = npy.read_array(file, allow_pickle=False)
        except Exception as error:  # as above
            raise self._damaged(error, name) from None
        if finite and header.dtype.kind == "f" and not bool(np.isfinite(value).all()):
            raise input_error(f"array `{name}`", got="NaN or infinity", expected="finite numbers", file=self.path)
        return value


def read_npz(
    path: str | os.PathLike[str], shapes: Mapping[str, Shape | None], largest: int = LARGEST_ARRAY
) -> dict[str, np.ndarray]:
    """The named arrays of numbers of an NPZ file, checked as `Npz.array` does. Raises `InputError` as that does."""
    with Npz(path, largest) as archive:
        return {name: archive.array(name, shape) for name, shape in shapes.items()}


def read_voxels(path: str | os.PathLike[str], side: int = 32) -> dict[str, UInt8[np.ndarray, " bytes"]]:
    """Packed occupancy of instances, `side`^3 bits each, by name.

    Raises:
        InputError: as `Npz`, or an array of another form.
    """
    with Npz(path) as archive:
        for name, header in archive.headers.items():
            if header.dtype != np.uint8 or header.shape != (side**3 // 8,):
                got, expected = f"{header.dtype} {list(header.shape)}", f"uint8 [{side**3 // 8}]: {side}^3 packed bits"
                raise input_error(f"voxels of {name}", got=got, expected=expected, file=archive.path)
        return {name: archive.array(name) for name in archive.names}


def voxel_side(path: str | os.PathLike[str], usual: int = 32) -> int:
    """Side of the grids that a file of packed voxels holds, by its first one; the usual one where it holds none.

    Raises:
        InputError: as `Npz`, or bytes of no cube.
    """
    with Npz(path) as archive:
        header = next(iter(archive.headers.values()), None)
        if header is None:
            return usual
        side = round((8 * header.shape[0]) ** (1 / 3)) if len(header.shape) == 1 else 0
        if side**3 != 8 * (header.shape[0] if header.shape else 0) or side == 0:
            got = f"{header.dtype} {list(header.shape)}"
            raise input_error(f"voxels of {archive.names[0]}", got=got, expected="uint8 [n^3 / 8]", file=archive.path)
        return side


def read_npy(path: str | os.PathLike[str], shape: Shape, largest: int = LARGEST_ARRAY) -> np.ndarray:
    """The array of numbers of an NPY file; NaN and infinity stay. Raises `InputError` naming the file."""
    path = existing_file(path)
    try:
        with reading(path), path.open("rb") as file:
            version = npy.read_magic(file)
            found, _, dtype = (npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0)(file)
            wrong = len(found) != len(shape) or any(want not in (None, have) for want, have in zip(shape, found))
            if wrong or dtype.kind not in "fiu" or ArrayHeader(found, dtype).nbytes > largest:
                expected = f"numbers of shape {shape}, at most {largest} bytes"
                raise input_error("array", got=f"shape {found} of {dtype}", expected=expected, file=path)
            file.seek(0)
            return npy.read_array(file, allow_pickle=False)
    except InputError:
        raise
    except Exception as error:  # as in `Npz`
        raise input_error("not a readable NPY file", got=error, do="is it truncated?", file=path) from None


def save_npz(path: str | os.PathLike[str], arrays: Mapping[str, Any], compressed: bool = True) -> None:
    """Write arrays as one NPZ file, atomically."""
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        (np.savez_compressed if compressed else np.savez)(file, **arrays)
