"""A camera from files: YAML and JSON of the calibration tools, a KITTI calibration, or numbers; its distortion, if any."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.distortion import COUNTS, DistortionModel, zoom_without_rims
from nolbo_ppl.io.camera_documents import FORMATS, distortion_of, fields_of, load_yaml, unknown_fields
from nolbo_ppl.io.files import read_json, write_json
from nolbo_ppl.io.ros_bags import is_bag
from nolbo_ppl.io.text import read_lines, read_words

NAMES = ("fx", "fy", "cx", "cy")
KITTI_ROWS = ("P2", "P0", "P_rect_02", "P_rect_00")
"""Rows of a KITTI calibration that are looked for, in this order: left colour camera, left grey camera."""


@dataclass(frozen=True)
class CameraIntrinsics:
    """A pinhole camera, with what its lens distorts; the centre of the first pixel is at (0.5, 0.5).

    Example:
        >>> CameraIntrinsics(200.0, 200.0, 160.0, 120.0).is_distorted
        False
    """

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
    model: DistortionModel | None = None
    """Model of the lens distortion; None without one."""
    distortion: tuple[float, ...] = ()
    """Its coefficients in OpenCV's order."""

    @property
    def is_distorted(self) -> bool:
        """Whether the images have to be undistorted before straight lines are straight."""
        return self.model is not None

    def undistorted(self, size: tuple[int, int]) -> CameraIntrinsics:
        """The pinhole camera of the undistorted images of this size; focal lengths grow where corners were not seen."""
        if self.model is None:
            return self
        factor = zoom_without_rims(self.vector, size, self.model, self.distortion)
        return CameraIntrinsics(factor * self.fx, factor * self.fy, self.cx, self.cy, *size)

    @property
    def vector(self) -> Float[np.ndarray, " 4"]:
        """[fx, fy, cx, cy] in px."""
        return np.array([self.fx, self.fy, self.cx, self.cy], dtype=np.float64)

    def as_dict(self) -> dict[str, Any]:
        """What `intrinsics.json` holds."""
        plain = {name: getattr(self, name) for name in (*NAMES, "width", "height")}
        return plain if self.model is None else plain | {"distortion_model": self.model, "distortion": list(self.distortion)}


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
    return replace(values, width=width, height=height)


def _from_fields(fields: Mapping[str, Any], path: Path) -> CameraIntrinsics:
    """A camera of flat fields. Raises `InputError` naming the field."""
    values: dict[str, Any] = {}
    for name in (*NAMES, "width", "height"):
        value = fields.get(name)
        missing = value is None and name in NAMES
        if missing or isinstance(value, bool) or not isinstance(value, int | float | None):
            raise input_error(
                f"intrinsics: {name}", got="nothing" if value is None else repr(value), expected="a number", file=path
            )
        values[name] = value
    for name in ("width", "height"):
        value = values[name]
        if value is not None and not (0 < value < 1e6 and value == int(value)):
            raise input_error(f"intrinsics: {name}", got=value, expected="a whole number of pixels", file=path)
        values[name] = None if value is None else int(value)
    values |= dict(zip(("model", "distortion"), distortion_of(fields, path)))
    return CameraIntrinsics(**values)


def _from_json(path: Path) -> CameraIntrinsics:
    content = read_json(path)
    if not isinstance(content, dict):
        raise input_error("not intrinsics", got=type(content).__name__, expected='{"fx", "fy", "cx", "cy", ...}', file=path)
    strange = unknown_fields(content)
    if strange:
        raise input_error(
            "unknown fields of a camera",
            got=", ".join(strange),
            expected="fx, fy, cx, cy, width, height, distortion, distortion_model, or k1 k2 p1 p2 k3",
            do="what is not understood may be what the images need",
            file=path,
        )
    if "fx" not in content and ("fl_x" in content or not any(name in content for name in NAMES)):
        return _from_fields(fields_of(content, path), path)
    extra = fields_of({**dict.fromkeys(NAMES, 0.0), **content}, path)
    return _from_fields({**extra, **{name: content.get(name) for name in NAMES}}, path)


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
            "no known row of a KITTI calibration",
            got=", ".join(labelled),
            expected="one of " + ", ".join(KITTI_ROWS),
            do=f"read are: {FORMATS}",
            file=path,
        )
    flat = [value for number, words in rows for value in _numbers(words, path, number)]
    rest: list[float] = []
    if len(flat) >= 9 and flat[3] == flat[6] == flat[7] == 0 and flat[8] == 1:  # a camera matrix
        if flat[1]:
            raise input_error("camera matrix with skew", got=flat[1], expected="0", file=path, line=rows[0][0])
        flat, rest = [flat[0], flat[4], flat[2], flat[5]], flat[9:]
    elif len(flat) > 4:
        flat, rest = flat[:4], flat[4:]
    if len(flat) != 4 or len(rest) not in (0, *COUNTS["radial-tangential"], *COUNTS["rational"]):
        raise input_error(
            "intrinsics",
            got=f"{len(flat) + len(rest)} numbers",
            expected="fx fy cx cy, or after them the distortion k1 k2 p1 p2 [k3 [k4 k5 k6]]",
            file=path,
            line=rows[0][0],
        )
    model, distortion = distortion_of({"distortion": rest}, path)
    fx, fy, cx, cy = flat
    return CameraIntrinsics(fx, fy, cx, cy, None, None, model, distortion), rows[0][0]


def _numbers(words: list[str], path: Path, line: int) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError:
        raise input_error("not a row of numbers", got=repr(" ".join(words)[:80]), file=path, line=line) from None


def read_intrinsics(path: str | PathLike[str], size: tuple[int, int] | None = None) -> Float[np.ndarray, " 4"]:
    """[fx, fy, cx, cy] in px of a file that `read_camera` reads, of a camera without distortion.

    Raises:
        InputError: as there, or a distortion, which four numbers cannot hold; names file and line.
    """
    camera = read_camera(path, size)
    if camera.is_distorted:
        raise input_error(
            "camera with distortion",
            got=f"{camera.model} {list(camera.distortion)}",
            expected="images that were undistorted, and their intrinsics",
            do="read_camera keeps the distortion; data.sequences.undistorted applies it",
            file=path,
        )
    return camera.vector


def read_camera(path: str | PathLike[str], size: tuple[int, int] | None = None) -> CameraIntrinsics:
    """Read a camera: YAML of OpenCV, ROS (`camera_info`), Kalibr, EuRoC, ORB-SLAM, OpenVSLAM or VINS; JSON with fx, fy, cx, cy
    (and width, height, distortion); a KITTI calibration (P2, else P0); numbers, fx fy cx cy and the distortion; or a bag of ROS,
    `BAG` or `BAG:/camera_info` (extra `ros`).

    A distortion that is given is kept (`is_distorted`), one of zeros is none. Unknown fields of JSON are refused.

    Values are taken as they stand; calibrations that place the first pixel's centre at (0, 0), as OpenCV's do, are half
    a pixel off in cx and cy.

    Args:
        path: the file.
        size: width and height of the images, px, that the intrinsics are checked against.

    Raises:
        InputError: a malformed file, or intrinsics that cannot be those of such images; names file and line.
    """
    path = Path(path)
    if is_bag(path):
        from nolbo_ppl.io.ros_messages import read_camera_info  # only a bag needs it

        found = read_camera_info(path)
        assert found is not None  # None is for images that have no camera info beside them
        return checked(_from_fields(fields_of(found[0], path), path), size, path, None)
    if path.suffix.lower() == ".json":
        return checked(_from_json(path), size, path, None)
    if path.suffix.lower() in (".yaml", ".yml"):
        return checked(_from_fields(fields_of(load_yaml(path, read_lines(path)), path), path), size, path, None)
    values, line = _from_text(path)
    return checked(values, size, path, line)


def camera_of_images(path: str | PathLike[str], topic: str, size: tuple[int, int]) -> tuple[CameraIntrinsics, str] | None:
    """The camera whose info lies beside a topic of images in a bag, and its topic; None where there is none.

    Raises:
        InputError: a camera without a calibration, or one of images of another size.
    """
    from nolbo_ppl.io.ros_messages import read_camera_info

    found = read_camera_info(path, topic)
    if found is None:
        return None
    file = Path(path)
    return checked(_from_fields(fields_of(found[0], file), file), size, file, None), found[1]


def write_camera(path: str | PathLike[str], values: CameraIntrinsics) -> None:
    """Write `intrinsics.json`, atomically."""
    write_json(path, values.as_dict())
