"""Intrinsics of a camera from files: our JSON, a KITTI calibration, or four numbers."""

from __future__ import annotations

import re
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.io.files import read_json, write_json
from nolbo_ppl.io.text import read_words

NAMES = ("fx", "fy", "cx", "cy")
KITTI_ROWS = ("P2", "P0", "P_rect_02", "P_rect_00")
"""Rows of a KITTI calibration that are looked for, in this order: left colour camera, left grey camera."""


@dataclass(frozen=True)
class CameraIntrinsics:
    """A pinhole camera without distortion; the centre of the first pixel is at (0.5, 0.5)."""

    fx: float
    """Focal length along the rows, px."""
    fy: float
    """Focal length along the columns, px."""
    cx: float
    """Principal point, px."""
    cy: float
    """Principal point, px."""
    width: int | None = None
    """Width of the images it was stated for, px."""
    height: int | None = None
    """Their height, px."""

    @property
    def vector(self) -> Float[np.ndarray, " 4"]:
        """[fx, fy, cx, cy] in px."""
        return np.array([self.fx, self.fy, self.cx, self.cy])

    def as_dict(self) -> dict[str, float | int | None]:
        """What `intrinsics.json` holds."""
        return {name: getattr(self, name) for name in (*NAMES, "width", "height")}


def checked(values: CameraIntrinsics, size: tuple[int, int] | None, file: Path, line: int | None) -> CameraIntrinsics:
    """The intrinsics, with the size of the images filled in.

    Raises:
        InputError: focal lengths that are not positive, or a camera that does not belong to images of this size.
    """
    vector = values.vector
    if not np.isfinite(vector).all() or (vector[:2] <= 0).any():
        raise input_error(
            "intrinsics", got=vector.tolist(), expected="finite fx fy cx cy, focal lengths above 0", file=file, line=line
        )
    if size is None:
        return values
    width, height = size
    stated = (values.width or width, values.height or height)
    if stated != (width, height):
        raise input_error(
            "intrinsics of images of another size",
            got=f"{stated[0]} x {stated[1]} px",
            expected=f"{width} x {height} px",
            do="scale fx, cx by the widths and fy, cy by the heights",
            file=file,
            line=line,
        )
    if not (0 < values.cx < width and 0 < values.cy < height):
        raise input_error(
            "principal point outside the image",
            got=f"({values.cx:g}, {values.cy:g})",
            expected=f"inside {width} x {height} px",
            do="are these the intrinsics of these images?",
            file=file,
            line=line,
        )
    longer = max(width, height)
    if not (0.1 * longer < values.fx < 20 * longer and 0.1 * longer < values.fy < 20 * longer):
        raise input_error(
            "focal length does not fit the image",
            got=f"{values.fx:g}, {values.fy:g} px",
            expected=f"between {0.1 * longer:g} and {20 * longer:g} px",
            file=file,
            line=line,
        )
    return CameraIntrinsics(values.fx, values.fy, values.cx, values.cy, width, height)


def _from_json(path: Path) -> CameraIntrinsics:
    content = read_json(path)
    if not isinstance(content, dict):
        raise input_error("not intrinsics", got=type(content).__name__, expected='{"fx", "fy", "cx", "cy", ...}', file=path)
    values: dict[str, float | int | None] = {}
    for name in (*NAMES, "width", "height"):
        value = content.get(name)
        missing = value is None and name in NAMES
        if missing or isinstance(value, bool) or not isinstance(value, int | float | None):
            raise input_error(
                f"intrinsics: {name}", got="nothing" if value is None else repr(value), expected="a number", file=path
            )
        values[name] = value
    for name in ("width", "height"):
        value = values[name]
        if value is not None and (value != int(value) or value <= 0):
            raise input_error(f"intrinsics: {name}", got=value, expected="a whole number of pixels", file=path)
        values[name] = None if value is None else int(value)
    return CameraIntrinsics(**values)  # type: ignore[arg-type]


def _from_text(path: Path) -> tuple[CameraIntrinsics, int]:
    """Intrinsics of a text file, and their line."""
    rows = read_words(path)
    if not rows:
        raise input_error("no intrinsics in the file", expected="fx fy cx cy, or a KITTI calibration", file=path)
    labelled = {words[0].removesuffix(":"): (number, words[1:]) for number, words in rows if re.match(r"[A-Za-z_]", words[0])}
    if labelled:
        for label in KITTI_ROWS:
            if label in labelled:
                number, words = labelled[label]
                values = _numbers(words, path, number)
                if len(values) != 12:
                    raise input_error(
                        f"{label} of a KITTI calibration", got=f"{len(values)} numbers", expected="12", file=path, line=number
                    )
                matrix = np.array(values).reshape(3, 4)
                if abs(matrix[0, 1]) > 1e-6 or not np.allclose(matrix[2, :3], [0, 0, 1]):
                    raise input_error(f"{label} is no projection of a rectified camera", file=path, line=number)
                return CameraIntrinsics(values[0], values[5], values[2], values[6]), number
        raise input_error(
            "no known row of a KITTI calibration", got=", ".join(labelled), expected="one of " + ", ".join(KITTI_ROWS), file=path
        )
    flat = [value for number, words in rows for value in _numbers(words, path, number)]
    if len(flat) == 9 and flat[3] == flat[6] == flat[7] == 0 and flat[8] == 1:
        flat = [flat[0], flat[4], flat[2], flat[5]]  # a camera matrix
    if len(flat) != 4:
        raise input_error(
            "intrinsics",
            got=f"{len(flat)} numbers",
            expected="fx fy cx cy",
            do="images must be undistorted",
            file=path,
            line=rows[0][0],
        )
    fx, fy, cx, cy = flat
    return CameraIntrinsics(fx, fy, cx, cy), rows[0][0]


def _numbers(words: list[str], path: Path, line: int) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError:
        raise input_error("not a row of numbers", got=repr(" ".join(words)[:80]), file=path, line=line) from None


def read_intrinsics(path: str | PathLike[str], size: tuple[int, int] | None = None) -> Float[np.ndarray, " 4"]:
    """[fx, fy, cx, cy] in px of a file that `read_camera` reads. Raises `InputError` naming file and line."""
    return read_camera(path, size).vector


def read_camera(path: str | PathLike[str], size: tuple[int, int] | None = None) -> CameraIntrinsics:
    """Read intrinsics: JSON with fx, fy, cx, cy (and width, height), a KITTI calibration (P2, else P0), or four numbers.

    Values are taken as they stand; calibrations that place the first pixel's centre at (0, 0), as OpenCV's do, are half
    a pixel off in cx and cy.

    Args:
        path: the file.
        size: width and height of the images, px, that the intrinsics are checked against.

    Raises:
        InputError: a malformed file, or intrinsics that cannot be those of such images; names file and line.
    """
    path = Path(path)
    if path.suffix.lower() == ".json":
        return checked(_from_json(path), size, path, None)
    values, line = _from_text(path)
    return checked(values, size, path, line)


def write_camera(path: str | PathLike[str], values: CameraIntrinsics) -> None:
    """Write `intrinsics.json`, atomically."""
    write_json(path, values.as_dict())
