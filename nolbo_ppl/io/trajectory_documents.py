"""Poses of other systems that are no tables of numbers: COLMAP's `images.txt`, and `ego_pose.json` of nuScenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import inverse, make_pose, quaternion_to_matrix
from nolbo_ppl.io.fields import is_number, number_array
from nolbo_ppl.io.files import read_json
from nolbo_ppl.io.images import natural
from nolbo_ppl.io.trajectory_tables import MAX_DISTANCE

MICROSECOND = 1e-6
"""Unit of nuScenes' times, s."""


@dataclass(frozen=True)
class PoseDocument:
    """Poses in order, and what else a file says of them."""

    T_world_camera: Float[np.ndarray, "n 4 4"]
    """Poses; nuScenes': of the car's body."""
    times: Float[np.ndarray, " n"] | None
    """Times, s."""
    names: tuple[str, ...] = ()
    """Names of the images, natural order."""


def is_colmap(lines: Sequence[str]) -> bool:
    """Whether these are lines of COLMAP's `images.txt`: nine numbers and a name."""
    plain = [line for line in lines if line.strip() and not line.lstrip().startswith("#")]
    return bool(plain) and _header(plain[0]) is not None


def _header(line: str) -> tuple[list[float], str] | None:
    """Quaternion (w first) and translation of an image's line, and its name; None for another line."""
    words = line.split(maxsplit=9)
    try:
        values = [float(word) for word in words[:9]]
    except ValueError:
        return None
    if len(words) < 10 or all(_is_number(word) for word in words[9].split()):
        return None  # a table of numbers
    whole = values[0].is_integer() and values[8].is_integer()
    return (values[1:8], words[9].strip()) if whole else None


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def parse_colmap(path: Path, lines: Sequence[str]) -> PoseDocument:
    """Cameras of `images.txt`, in natural order of the images' names; the length of COLMAP's unit is free.

    Two lines an image: `ID QW QX QY QZ TX TY TZ CAMERA NAME` (world to camera), and its points, which are passed over.

    Raises:
        InputError: a malformed line, no unit quaternion, two images of one name; names file and line.
    """
    plain = [(number, line) for number, line in enumerate(lines, start=1) if not line.lstrip().startswith("#")]
    while plain and not plain[-1][1].strip():
        plain.pop()
    second = plain[1][1] if len(plain) > 1 else ""
    heads = plain if _header(second) is not None else plain[::2]
    rows: dict[str, Float[np.ndarray, " 7"]] = {}
    for number, line in heads:
        found = _header(line)
        if found is None:
            expected = "ID QW QX QY QZ TX TY TZ CAMERA NAME, and a line of points after it"
            raise input_error("not an image of COLMAP", got=repr(line[:80]), expected=expected, file=path, line=number)
        values, name = np.array(found[0]), found[1]
        if name in rows:
            raise input_error("two images of one name", got=name, file=path, line=number)
        norm = float(np.linalg.norm(values[:4]))
        if not (np.isfinite(values).all() and abs(norm - 1) < 1e-2 and np.abs(values).max() <= MAX_DISTANCE):
            raise input_error("no pose", got=repr(line[:80]), expected="a unit quaternion", file=path, line=number)
        rows[name] = values
    names = tuple(sorted(rows, key=lambda name: natural(Path(name))))
    table = np.array([rows[name] for name in names]).reshape(-1, 7)
    T_camera_world = make_pose(quaternion_to_matrix(table[:, [1, 2, 3, 0]]), table[:, 4:])
    return PoseDocument(inverse(T_camera_world), None, names)


def parse_nuscenes(path: Path) -> PoseDocument:
    """Poses of `ego_pose.json` of nuScenes in order of their times (µs): the car's body, x forward, z up.

    Raises:
        InputError: not such a file, or a record without a pose; names file and record.
    """
    content = read_json(path)
    if not isinstance(content, list) or not content:
        raise input_error("not ego poses of nuScenes", expected='[{"timestamp", "rotation", "translation"}, ...]', file=path)
    rows: list[tuple[float, np.ndarray]] = []
    for k, item in enumerate(content):
        row: Any = item if isinstance(item, dict) else {}
        rotation, translation = number_array(row.get("rotation"), (4,)), number_array(row.get("translation"), (3,), MAX_DISTANCE)
        time = row.get("timestamp")
        if rotation is None or translation is None or not is_number(time) or abs(float(np.linalg.norm(rotation)) - 1) > 1e-2:
            expected = "timestamp in microseconds, rotation [w, x, y, z], translation [x, y, z]"
            raise input_error(f"record {k} is no ego pose", got=repr(item)[:120], expected=expected, file=path)
        rows.append((float(time) * MICROSECOND, np.concatenate([rotation, translation])))
    rows.sort(key=lambda item: item[0])
    table = np.array([values for _, values in rows])
    T = make_pose(quaternion_to_matrix(table[:, [1, 2, 3, 0]]), table[:, 4:])
    return PoseDocument(T, np.array([time for time, _ in rows]))
