"""Messages of ROS as this library's values: images, depth, cameras, poses and fixed transforms between frames."""

from __future__ import annotations

import io
from itertools import islice
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import inverse, make_pose, quaternion_to_matrix
from nolbo_ppl.io.images import MAXIMUM_PIXELS, open_depth_image, open_image
from nolbo_ppl.io.ros_bags import CAMERAS, IMAGES, POSES, TRANSFORMS, Bag, split_topic

ENCODINGS: dict[str, tuple[str, int]] = {
    "mono8": ("u1", 1),
    "8uc1": ("u1", 1),
    "rgb8": ("u1", 3),
    "bgr8": ("u1", 3),
    "8uc3": ("u1", 3),
    "rgba8": ("u1", 4),
    "bgra8": ("u1", 4),
    "8uc4": ("u1", 4),
    "mono16": ("u2", 1),
    "16uc1": ("u2", 1),
    "32fc1": ("f4", 1),
    "bayer_rggb8": ("u1", 1),
    "bayer_bggr8": ("u1", 1),
    "bayer_gbrg8": ("u1", 1),
    "bayer_grbg8": ("u1", 1),
    "yuv422": ("u1", 2),
    "uyvy": ("u1", 2),
    "yuv422_yuy2": ("u1", 2),
    "yuyv": ("u1", 2),
}
"""Type of a value and values a pixel of the encodings that are read."""
MILLIMETRES = 1e-3
"""Unit of depth images of whole numbers, m (REP 118)."""
DEPTH_HEADER = 12
"""Bytes before the picture in a `compressedDepth` message: its format and two parameters."""


def _pixels(message: Any, what: str, file: Path) -> np.ndarray:
    """Values [h, w] or [h, w, c] of an Image, rows without their padding."""
    encoding = message.encoding.lower()
    if encoding not in ENCODINGS:
        raise input_error(f"encoding of {what}", got=message.encoding, expected="one of " + ", ".join(ENCODINGS), file=file)
    kind, channels = ENCODINGS[encoding]
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * channels * int(kind[1])
    if not (min(height, width) > 0 and height * width <= MAXIMUM_PIXELS and step >= row and len(message.data) >= step * height):
        got = f"{width} x {height} px, {step} bytes a row, {len(message.data)} bytes"
        raise input_error(f"{what} does not hold what it states", got=got, expected=f"{row} bytes a row or more", file=file)
    table = np.asarray(message.data, dtype=np.uint8)[: step * height].reshape(height, step)[:, :row]
    values = np.ascontiguousarray(table).view((">" if message.is_bigendian else "<") + kind)
    values = values.astype(kind)  # the machine's own order of bytes
    return values.reshape(height, width) if channels == 1 else values.reshape(height, width, channels)


def image_of(message: Any, what: str, file: Path) -> UInt8[np.ndarray, "h w 3"]:
    """RGB of an Image or CompressedImage: colour, grey of 8 and 16 bits, Bayer patterns, YUV 4:2:2, JPEG, PNG.

    Raises:
        InputError: an encoding that is not read, damaged or truncated data; names the bag.
    """
    if not hasattr(message, "encoding"):
        if "compresseddepth" in message.format.lower():
            raise input_error(f"{what} is a depth image", got=message.format, expected="colour or grey", file=file)
        return open_image(io.BytesIO(bytes(message.data)), label=f"{file}: {what}")
    values, encoding = _pixels(message, what, file), message.encoding.lower()
    if encoding == "32fc1":
        raise input_error(f"{what} is a depth image", got=message.encoding, expected="colour or grey", file=file)
    if encoding.startswith("bayer"):
        import cv2

        pattern = encoding.removeprefix("bayer_").removesuffix("8").upper()
        return cv2.cvtColor(values, getattr(cv2, f"COLOR_BAYER{pattern}2RGB".replace("BAYER", "Bayer")))
    if ENCODINGS[encoding][1] == 2:
        import cv2

        return cv2.cvtColor(values, cv2.COLOR_YUV2RGB_UYVY if encoding in ("yuv422", "uyvy") else cv2.COLOR_YUV2RGB_YUYV)
    if values.ndim == 2:
        grey = (values >> 8).astype(np.uint8) if values.dtype == np.uint16 else values
        return np.repeat(grey[:, :, None], 3, axis=2)
    turned = values[:, :, [2, 1, 0]] if encoding.startswith(("bgr", "8uc")) else values[:, :, :3]
    return np.ascontiguousarray(turned)


def depth_of(message: Any, what: str, file: Path) -> Float[np.ndarray, "h w"]:
    """Depth of an Image or CompressedImage in m, 0 where unknown: whole numbers are mm, real numbers m (REP 118).

    Raises:
        InputError: not a depth image, or damaged.
    """
    if hasattr(message, "encoding"):
        values = _pixels(message, what, file)
        if values.ndim != 2 or values.dtype == np.uint8:
            raise input_error(f"{what} is no depth image", got=message.encoding, expected="16UC1 or 32FC1", file=file)
    else:
        data = bytes(message.data)
        if "compresseddepth" in message.format.lower():
            if "32fc1" in message.format.lower():
                raise input_error(f"{what}: compressed depth of real numbers", expected="16UC1", file=file)
            data = data[DEPTH_HEADER:]
        values = open_depth_image(io.BytesIO(data), label=f"{file}: {what}")
    unit = 1.0 if values.dtype.kind == "f" else MILLIMETRES
    metres = values.astype(np.float64) * unit
    return np.where(np.isfinite(metres) & (metres > 0), metres, 0.0)


def camera_document(message: Any, rectified: bool, file: Path) -> dict[str, Any]:
    """A CameraInfo as the fields of a `camera_info` file; of rectified images its projection matrix, without distortion."""
    names = {name.lower(): getattr(message, name) for name in ("K", "D", "P", "k", "d", "p") if hasattr(message, name)}
    matrix = np.asarray(names["k"], dtype=np.float64).reshape(3, 3)
    if rectified:
        matrix = np.asarray(names["p"], dtype=np.float64).reshape(3, 4)[:, :3]
    if not matrix[0, 0] > 0:
        raise input_error("camera info without a calibration", got=matrix.ravel().tolist(), expected="fx above 0", file=file)
    document: dict[str, Any] = {"camera_matrix": matrix.ravel().tolist()}
    if message.width and message.height:
        document |= {"image_width": int(message.width), "image_height": int(message.height)}
    if not rectified and np.any(names["d"]):
        document |= {"distortion_model": message.distortion_model, "distortion_coefficients": np.asarray(names["d"]).tolist()}
    return document


def info_topic(bag: Bag, image: str | None) -> str | None:
    """The camera info that belongs to a topic of images: the one beside it; None where there is none."""
    names = {topic.name for topic in bag.of_types(CAMERAS)}
    place = "" if image is None else image
    while image is not None and "/" in place:
        place = place.rpartition("/")[0]
        if f"{place}/camera_info" in names:
            return f"{place}/camera_info"
    return next(iter(names)) if image is None and len(names) == 1 else None


def read_camera_info(path: str | PathLike[str], image: str | None = None) -> tuple[dict[str, Any], str] | None:
    """The fields of a `camera_info` file that a bag holds, and their topic; None where it holds none for these images.

    Args:
        path: the bag, with or without the topic of the camera info.
        image: topic of the images, whose camera info lies beside it; one whose name holds `rect` is without distortion.

    Raises:
        InputError: no such topic, or a camera without a calibration.
    """
    file, name = split_topic(path)
    with Bag(file) as bag:
        if name is None and image is not None:
            name = info_topic(bag, image)
            if name is None:
                return None
        topic = bag.topic(name, CAMERAS, "camera info")
        for _, message in islice(bag.messages(topic.name), 1):
            return camera_document(message, "rect" in (image or ""), file), topic.name
    raise input_error(f"topic {topic.name} has no messages", expected="camera info", file=file)


def pose_of(message: Any) -> Float[np.ndarray, "4 4"]:
    """The pose of a message that has one, of any of the types of `POSES`."""
    part = getattr(message, "transform", None)
    if part is not None:
        p, q = part.translation, part.rotation
    else:
        part = message.pose
        part = getattr(part, "pose", part)
        p, q = part.position, part.orientation
    quaternion = np.array([q.x, q.y, q.z, q.w], dtype=np.float64)
    norm = float(np.linalg.norm(quaternion))
    if not (np.isfinite([p.x, p.y, p.z, norm]).all() and abs(norm - 1) < 1e-2):
        return np.full((4, 4), np.nan)
    return make_pose(quaternion_to_matrix(quaternion), np.array([p.x, p.y, p.z]))


class FixedFrames:
    """Transforms between frames that never change (`/tf_static`).

    Args:
        bag: where they are recorded.

    Raises:
        InputError: a transform that is not finite, or without a rotation; names the bag and its frames.
    """

    def __init__(self, bag: Bag) -> None:
        self.edges: dict[str, dict[str, np.ndarray]] = {}
        if "/tf_static" in {topic.name for topic in bag.of_types(TRANSFORMS)}:
            for _, message in bag.messages("/tf_static"):
                for one in message.transforms:
                    T = pose_of(one)
                    a, b = one.header.frame_id.strip("/"), one.child_frame_id.strip("/")
                    if np.isnan(T).any():
                        got = f"{a} to {b}"
                        raise input_error(
                            "a transform of /tf_static is no pose", got=got, expected="a unit quaternion", file=bag.path
                        )
                    self.edges.setdefault(a, {})[b] = T
                    self.edges.setdefault(b, {})[a] = inverse(T[None])[0]

    def between(self, a: str, b: str) -> Float[np.ndarray, "4 4"] | None:
        """T_a_b, None where no chain of fixed transforms leads from one to the other."""
        a, b = a.strip("/"), b.strip("/")
        found = {a: np.eye(4)}
        queue = [a]
        while queue and b not in found:
            at = queue.pop(0)
            for name, T in self.edges.get(at, {}).items():
                if name not in found:
                    found[name] = found[at] @ T
                    queue.append(name)
        return found.get(b)


def camera_frames(bag: Bag) -> set[str]:
    """Names of the frames of the cameras in a bag."""
    names = set()
    for topic in bag.of_types((*CAMERAS, *IMAGES)):
        for _, message in islice(bag.messages(topic.name), 1):  # a topic may be announced and never used
            names.add(message.header.frame_id.strip("/"))
    return names - {""}


def mounting(bag: Bag, frame: str) -> Float[np.ndarray, "4 4"] | None:
    """T_frame_camera of what moves with a camera; the identity for the camera itself, None where nothing tells.

    Of several cameras the first by name that a chain of fixed transforms leads to.
    """
    cameras = camera_frames(bag)
    if not cameras or frame.strip("/") in cameras:
        return np.eye(4)
    fixed = FixedFrames(bag)
    return next((T for T in (fixed.between(frame, name) for name in sorted(cameras)) if T is not None), None)


def read_bag_poses(
    path: str | PathLike[str],
) -> tuple[Float[np.ndarray, "n 4 4"], Float[np.ndarray, " n"], int]:
    """T_world_camera, times in s, and the number of rows left out because they repeat a time, of a topic of poses.

    Poses of a robot's body become those of its camera by the fixed transforms of the bag. Poses without the name of a body
    (PoseStamped), and those of a bag without images, are taken as they are. Those that hold no rotation are NaN.

    Raises:
        InputError: no or several topics of poses, or a body that no fixed transform ties to a camera; names the bag.
    """
    file, name = split_topic(path)
    with Bag(file) as bag:
        topic = bag.topic(name, POSES, "poses")
        poses, times = [], []
        body = ""
        for time, message in bag.messages(topic.name):
            poses.append(pose_of(message))
            times.append(time)
            body = getattr(message, "child_frame_id", "")
        if not poses:
            raise input_error(f"topic {topic.name} has no messages", expected="poses", file=file)
        T_body_camera = mounting(bag, body) if body else np.eye(4)
    if T_body_camera is None:
        raise input_error(
            f"{topic.name} holds poses of `{body}`, which nothing ties to the camera",
            expected="a chain of fixed transforms in /tf_static",
            do="record /tf_static, or write the camera's poses into a file",
            file=file,
        )
    T, at = np.array(poses) @ T_body_camera, np.array(times)
    order = np.argsort(at, kind="stable")
    T, at = T[order], at[order]
    keep = np.concatenate([[True], np.diff(at) > 0])
    return T[keep], at[keep], int((~keep).sum())
