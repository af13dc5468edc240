"""Poses in tables of numbers: which columns hold what in KITTI, TUM, EuRoC and 4 x 4 files, and rows that were lost."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import is_rotation, make_pose, nearest_rotation, quaternion_to_matrix

TableFormat = Literal["kitti", "tum", "euroc", "matrix", "colmap", "nuscenes"]
"""`kitti` 12 numbers a row (3 x 4), `matrix` 16 (4 x 4, or four rows of four), both with an optional leading number of the
frame or time; `tum` time, position, quaternion x y z w; `euroc` time in ns, position, quaternion w x y z; `colmap` and
`nuscenes` are no tables (`trajectory_documents`)."""
EXPECTED = "12 (KITTI), 16 (4 x 4) or 8 (TUM, EuRoC)"
MOST_FRAMES = 10_000_000
"""Whole numbers below count frames; from there on they are times in ns, µs or ms."""
MAX_DISTANCE = 1e9
"""Largest coordinate, m: beyond, squares of distances lose what is asked for, and singular values do not converge."""
_UNITS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))
"""Times above are no seconds: 1e11 s after 1970 is the year 5138."""
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+([eE][-+]?\d+)?")


@dataclass(frozen=True)
class PoseTable:
    """What a table says, row by row."""

    T_world_camera: Float[np.ndarray, "n 4 4"]
    """Poses; NaN where the row holds none."""
    lines: Int[np.ndarray, " n"]
    """Line of each row."""
    times: Float[np.ndarray, " n"] | None
    """Times, s."""
    numbers: Int[np.ndarray, " n"] | None
    """Numbers of the frames, where the rows begin with them."""
    format: TableFormat


@dataclass(frozen=True)
class _Rows:
    """Numbers of a file with their lines, and the names of its columns where it gives them."""

    table: Float[np.ndarray, "n c"]
    lines: Int[np.ndarray, " n"]
    header: str
    commas: bool


def _header_like(text: str) -> bool:
    """Whether a line names columns: the file's first, with a time and four letters of a quaternion."""
    return len(re.findall(r"[A-Za-z]\w*", text)) >= 4 and not re.match(r"\s*[-+.\d]", text)


def _words(text: str, path: Path, line: int) -> list[float]:
    """Numbers of a line. Raises `InputError` where there is anything else."""
    separated = text.split()
    if len(separated) > 1 and any(_DECIMAL_COMMA.fullmatch(word.rstrip(";")) for word in separated):
        raise input_error("decimal commas", got=repr(text[:80]), expected="decimal points", file=path, line=line)
    try:
        return [float(word) for word in re.split(r"[\s,;]+", text.strip(" \t,;"))]
    except ValueError:
        raise input_error("not a row of numbers", got=repr(text[:80]), file=path, line=line) from None


def _rows(path: Path, lines: Sequence[str]) -> _Rows:
    header, commas = "", False
    values: list[list[float]] = []
    numbers: list[int] = []
    for number, whole in enumerate(lines, start=1):
        text, _, comment = whole.partition("#")
        if not text.strip(" \t,;"):
            header = comment if not values and _header_like(comment) else header
            continue
        if not values and not header and _header_like(text):
            header = text
            continue
        row = _words(text, path, number)
        if values and len(row) != len(values[0]):
            raise input_error(
                "row of another length",
                got=f"{len(row)} numbers",
                expected=len(values[0]),
                do="is the file truncated?",
                file=path,
                line=number,
            )
        commas |= "," in text
        values.append(row)
        numbers.append(number)
    if not values:
        raise input_error("the trajectory is empty", file=path)
    return _Rows(np.array(values), np.array(numbers), header, commas)


def _axis(name: str, axes: str) -> str | None:
    """The axis a column's name ends with."""
    return name[-1] if name and name[-1] in axes else None


def columns_of(header: str, width: int) -> tuple[list[int], bool] | None:
    """Columns of time, x, y, z, qx, qy, qz, qw that a header names, and whether it names the quaternion's order.

    Example:
        >>> columns_of("timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []", 8)
        ([0, 1, 2, 3, 5, 6, 7, 4], True)
        >>> columns_of("ground truth trajectory of the second drive", 8) is None
        True
    """
    names = [name for name in re.split(r"[\s,;]+", re.sub(r"\[.*?\]|\(.*?\)", " ", header).lower()) if name]
    if len(names) < 8 or len(names) > width:
        return None
    found: dict[str, int] = {}
    for k, name in enumerate(names):
        turned = re.match(r"(.*[_.])?(q|quat|orient|rot)", name) is not None
        axis = _axis(name, "wxyz" if turned else "xyz")
        moved = re.fullmatch(r"([xyz]|([tp]|tr|pos|position|trans|translation|p_.*|t_.*)[_.]?[xyz]|.*position\.[xyz])", name)
        if k == 0 and re.match(r"(#|time|stamp|t$|sec|nsec)", name):
            found["time"] = 0
        elif axis is not None and turned:
            found.setdefault("q" + axis, k)
        elif axis is not None and moved:
            found.setdefault(axis, k)
    order = ["time", "x", "y", "z", "qx", "qy", "qz", "qw"]
    return ([found[name] for name in order], True) if all(name in found for name in order) else None


def _seconds(values: Float[np.ndarray, " n"], header: str) -> Float[np.ndarray, " n"]:
    """Times in s: the unit a header states for its first column, or what their size says."""
    unit = re.match(r"[^,;]*?[\[(]\s*(ns|us|µs|ms|s)\s*[\])]", header)
    if unit:
        return values * {"ns": 1e-9, "us": 1e-6, "µs": 1e-6, "ms": 1e-3, "s": 1.0}[unit[1]]
    largest = float(np.abs(values).max())
    return values * next((factor for limit, factor in _UNITS if largest >= limit), 1.0)


def detected_format(table: Float[np.ndarray, "n c"], header: str, commas: bool) -> TableFormat | None:
    """The format of a table by its width, and of eight columns by what the header, or times and commas, say.

    EuRoC and TUM-VI write commas, times in ns and q_w first; TUM writes blanks, seconds and q_w last. Times in ns with
    blanks are what ORB-SLAM writes: q_w last.
    """
    width = table.shape[1]
    if width in (12, 13):
        return "kitti"
    if width == 4 and len(table) % 4 == 0 and _bottoms(table[3::4]):
        return "matrix"
    if width in (16, 17) and _bottoms(table[:, -4:]):
        return "matrix"
    if width == 8 or (width > 8 and columns_of(header, width)) or (width == 17 and commas):
        named = columns_of(header, width)
        if named is not None:
            return "euroc" if named[0][7] < named[0][4] else "tum"
        return "euroc" if commas and float(np.abs(table[:, 0]).max()) >= _UNITS[0][0] else "tum"
    return None


def _bottoms(rows: Float[np.ndarray, "n 4"]) -> bool:
    """Whether last rows of 4 x 4 matrices are 0 0 0 1, but for lost ones."""
    known = np.isfinite(rows).all(axis=1)
    return bool(np.allclose(rows[known], [0, 0, 0, 1], atol=1e-6))


def _without_bottoms(path: Path, rows: _Rows) -> tuple[np.ndarray, np.ndarray]:
    """The 3 x 4 part of 4 x 4 matrices, and lines."""
    table, lines = rows.table, rows.lines
    if table.shape[1] == 4:
        if len(table) % 4:
            raise input_error(
                "rows of 4 x 4 matrices",
                got=f"{len(table)} rows of 4",
                expected="a multiple of 4",
                file=path,
                line=int(lines[-1]),
            )
        table, lines = table.reshape(-1, 16), lines[::4]
    if not _bottoms(table[:, -4:]):
        raise input_error("last row of a 4 x 4 matrix", expected="0 0 0 1", file=path)
    return table[:, :-4], lines


def _first_column(values: Float[np.ndarray, " n"], header: str) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Times, or numbers of frames: whole, from 0 on, rising."""
    if (values == np.round(values)).all() and values.min() >= 0 and values.max() < MOST_FRAMES and (np.diff(values) > 0).all():
        return None, values.astype(np.int64)
    return _seconds(values, header), None


def _check_lost(path: Path, rows: np.ndarray, lines: np.ndarray, lost: bool) -> Bool[np.ndarray, " n"]:
    """Rows that hold a pose. Raises `InputError` for one that is not finite, or in part where whole rows may be."""
    finite = np.isfinite(rows)
    bad = ~finite.all(axis=1) if not lost else finite.any(axis=1) & ~finite.all(axis=1)
    if bad.any():
        k = int(np.argmax(bad))
        raise input_error(
            "a value is not finite",
            got=repr(" ".join(f"{v:g}" for v in rows[k])[:80]),
            expected="numbers, or nothing but nan or inf in a row" if lost else None,
            do=None if lost else "every row needs a pose; only a truth may have lost ones",
            file=path,
            line=int(lines[k]),
        )
    far = np.abs(np.where(finite, rows, 0.0)).max(axis=1) > MAX_DISTANCE
    if far.any():
        k = int(np.argmax(far))
        raise input_error("a value is out of range", expected=f"within {MAX_DISTANCE:g}", file=path, line=int(lines[k]))
    complete: np.ndarray = finite.all(axis=1)
    return complete


def parse_table(path: Path, lines: Sequence[str], form: TableFormat | None = None, *, lost: bool = False) -> PoseTable:
    """Poses of the lines of a file.

    Rotations that are orthonormal to three digits are made exactly so; quaternions may be off unit length by 1 %.

    Args:
        path: the file, for messages.
        lines: its lines.
        form: the format, where it is not to be told from the file.
        lost: rows of nothing but nan or inf are poses that are not known.

    Raises:
        InputError: an unknown format, a malformed row, no rotation; names file and line.
    """
    rows = _rows(path, lines)
    found = form or detected_format(rows.table, rows.header, rows.commas)
    width, first = rows.table.shape[1], int(rows.lines[0])
    fitting = {"kitti": width in (12, 13), "matrix": width in (4, 16, 17), "tum": width >= 8, "euroc": width >= 8}
    if found is None or not fitting.get(found, False):
        raise input_error(
            "unknown trajectory format" if form is None else f"not in the format {form}",
            got=f"{width} numbers a row",
            expected=EXPECTED,
            file=path,
            line=first,
        )
    times = numbers = None
    if found in ("kitti", "matrix"):
        table, at = (rows.table, rows.lines) if found == "kitti" else _without_bottoms(path, rows)
        if table.shape[1] == 13:
            times, numbers = _first_column(table[:, 0], rows.header)
            table = table[:, 1:]
        known = _check_lost(path, table, at, lost)
        matrices = np.where(known[:, None], table, np.eye(3, 4).ravel()).reshape(-1, 3, 4)
        good = is_rotation(matrices[:, :, :3], tolerance=1e-2)
        if not good.all():
            raise input_error(
                "the left 3x3 block is no rotation",
                expected="orthonormal, determinant +1",
                file=path,
                line=int(at[int(np.argmin(good))]),
            )
        T = make_pose(nearest_rotation(matrices[:, :, :3]), matrices[:, :, 3])
    else:
        named = columns_of(rows.header, width) if form is None else None
        order = named[0] if named is not None else [0, 1, 2, 3, 5, 6, 7, 4] if found == "euroc" else list(range(8))
        table, at = rows.table[:, order], rows.lines
        if not np.isfinite(table[:, 0]).all():
            line = int(at[int(np.argmin(np.isfinite(table[:, 0])))])
            raise input_error("a time is not finite", file=path, line=line)
        times = _seconds(table[:, 0], rows.header if named is not None or "[" in rows.header else "")
        known = _check_lost(path, table[:, 1:], at, lost)
        table = np.where(known[:, None], table, [0, 0, 0, 0, 0, 0, 0, 1])
        norms = np.linalg.norm(table[:, 4:], axis=1)
        if (np.abs(norms - 1) > 1e-2).any():
            row = int(np.argmax(np.abs(norms - 1)))
            raise input_error("quaternion of another length than 1", got=f"{norms[row]:.4g}", file=path, line=int(at[row]))
        T = make_pose(quaternion_to_matrix(table[:, 4:]), table[:, 1:4])
    T[~known] = np.nan
    return PoseTable(T, at, times, numbers, found)
