"""KITTI object detection: real street images with 3D boxes, as labelled scenes that `nolbo evaluate` reads.

Cars become objects. What the labels leave open, or what resembles a category of the model without being labelled as one
(vans, trucks, trams, cyclists), becomes a region where detections are not judged; people do not, so that taking one for an
object is a mistake.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from nolbo_ppl.data.converters.converted import existing
from nolbo_ppl.data.converters.kitti_tracking import car_rotation
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.rotation import matrix_to_quaternion
from nolbo_ppl.io.files import atomic_path, read_text, write_json, write_jsonl
from nolbo_ppl.io.images import image_size, images_of
from nolbo_ppl.synthetic.dataset_writer import SCENES

CATEGORY = {"Car": "car"}
"""Label types that become objects."""
IGNORED = ("DontCare", "Van", "Truck", "Tram", "Cyclist", "Misc")
"""Label types that become regions to ignore."""
RIGID = ("Car", "Van", "Truck", "Tram")
"""Label types whose 3D box projects onto their image box, so that they tell an image's camera."""
SEEN = {0: 1.0, 1: 0.75, 2: 0.35, 3: 0.35}
"""Visible share that stands for each occlusion level (fully visible, partly, largely occluded, unknown). The labels name
levels, not shares: with a least share of one half, what counts is close to KITTI's moderate difficulty."""
PIXEL_CENTRE = 0.5
"""KITTI puts the centre of the first pixel at 0, scenes at 0.5."""


@dataclass(frozen=True)
class KittiCamera:
    """The left colour camera (camera 2) of an image."""

    intrinsics: Float[np.ndarray, " 4"]
    """[fx, fy, cx, cy], px; the centre of the first pixel is (0.5, 0.5)."""
    offset: Float[np.ndarray, " 3"]
    """What is added to positions of the labels (rectified camera 0) to have them in camera 2, m."""


def camera_of_projection(P: Float[np.ndarray, "3 4"]) -> KittiCamera:
    """Camera of a projection `P2 = K [I | t]`."""
    K = P[:, :3]
    intrinsics = np.array([K[0, 0], K[1, 1], K[0, 2] + PIXEL_CENTRE, K[1, 2] + PIXEL_CENTRE])
    return KittiCamera(intrinsics, np.linalg.solve(K, P[:, 3]))


def _projection(focal: float, cx: float, cy: float, last: tuple[float, float, float]) -> np.ndarray:
    return np.array([[focal, 0, cx, last[0]], [0, focal, cy, last[1]], [0, 0, 1, last[2]]])


CAMERAS = {
    "2011_09_26": camera_of_projection(_projection(721.5377, 609.5593, 172.854, (44.85728, 0.2163791, 2.745884e-3))),
    "2011_09_28": camera_of_projection(_projection(707.0493, 604.0814, 180.5066, (45.75831, -0.3454157, 4.981016e-3))),
    "2011_09_29": camera_of_projection(_projection(718.3351, 600.3891, 181.5122, (44.50382, -0.5951107, 2.616315e-3))),
    "2011_09_30": camera_of_projection(_projection(707.0912, 601.8873, 183.1104, (46.88783, 0.1178601, 6.203223e-3))),
    "2011_10_03": camera_of_projection(_projection(718.856, 607.1928, 185.2157, (45.38225, -0.1130887, 3.779761e-3))),
}
"""KITTI's calibrations of camera 2 by recording day; every image of the data set was taken on one of them."""


def read_calibration(path: str | PathLike[str]) -> KittiCamera:
    """Camera 2 of a calibration file. Raises `InputError` naming file and line."""
    for number, text in enumerate(read_text(path).splitlines(), start=1):
        name, _, rest = text.partition(":")
        if name.strip() != "P2":
            continue
        try:
            P = np.array([float(word) for word in rest.split()]).reshape(3, 4)
        except ValueError:
            P = np.full((3, 4), np.nan)
        if not np.isfinite(P).all() or np.abs(P).max() > 1e9 or min(P[0, 0], P[1, 1]) <= 0 or P[2, :3].tolist() != [0, 0, 1]:
            expected = "12 numbers, K [I | t] by rows"
            raise input_error("not a projection", got=repr(rest[:60]), expected=expected, file=path, line=number)
        return camera_of_projection(P)
    raise input_error("no projection of camera 2", expected="a line P2: and 12 numbers", file=path)


@dataclass(frozen=True)
class KittiLabel:
    """One line of a label file, in KITTI's own conventions."""

    kind: str
    truncated: float
    """Share outside the image; -1 in regions without labels."""
    occluded: int
    """0 fully visible, 1 partly, 2 largely occluded, 3 unknown; -1 in regions without labels."""
    box: Float[np.ndarray, " 4"]
    """Left, top, right, bottom, px."""
    dimensions: Float[np.ndarray, " 3"]
    """Height, width, length, m."""
    bottom: Float[np.ndarray, " 3"]
    """Middle of the box's underside in the rectified frame of camera 0, m."""
    rotation_y: float
    """Turn about the camera's y axis, rad; 0 faces along x."""


def _label(words: list[str], path: str | PathLike[str], number: int) -> KittiLabel:
    """A type and its numbers. Raises `InputError` naming file and line."""
    try:
        values = np.array([float(word) for word in words[1:15]])
    except ValueError:
        values = np.empty(0)
    if len(values) != 14 or not np.isfinite(values).all():
        got = repr(" ".join(words)[:60])
        raise input_error("not a label", got=got, expected="a type and 14 numbers", file=path, line=number)
    return KittiLabel(words[0], float(values[0]), int(values[1]), values[3:7], values[7:10], values[10:13], float(values[13]))


def read_object_labels(path: str | PathLike[str]) -> list[KittiLabel]:
    """The labels of an image. Raises `InputError` naming file and line."""
    lines = enumerate(read_text(path).splitlines(), start=1)
    return [_label(text.split(), path, number) for number, text in lines if text.strip()]


def read_track_labels(path: str | PathLike[str]) -> list[list[tuple[int, KittiLabel]]]:
    """Track and label of every object of every frame of a drive (lines that begin with frame and track).

    The list ends with the last frame that has a label. Raises `InputError` naming file and line.
    """
    frames: dict[int, list[tuple[int, KittiLabel]]] = {}
    for number, text in enumerate(read_text(path).splitlines(), start=1):
        words = text.split()
        if not words:
            continue
        if len(words) < 2 or not words[0].isdigit() or not words[1].removeprefix("-").isdigit():
            expected = "frame and track, whole numbers, before the label"
            raise input_error("not a label of a track", got=repr(text[:60]), expected=expected, file=path, line=number)
        frames.setdefault(int(words[0]), []).append((int(words[1]), _label(words[2:], path, number)))
    return [frames.get(k, []) for k in range(max(frames, default=-1) + 1)]


def projected_box(label: KittiLabel, camera: KittiCamera) -> Float[np.ndarray, " 4"]:
    """Tight box of the projected corners of a label's 3D box, px (first pixel centred at 0.5); NaN behind the camera."""
    height, width, length = label.dimensions
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)]) * (width, length, height)
    points = corners @ car_rotation(np.array([label.rotation_y]))[0].T + label.bottom + camera.offset
    if (points[:, 2] < 0.1).any():
        return np.full(4, np.nan)
    pixels = points[:, :2] / points[:, 2:] * camera.intrinsics[:2] + camera.intrinsics[2:]
    return np.concatenate((pixels.min(0), pixels.max(0)))


def likeliest_camera(labels: list[KittiLabel]) -> tuple[str, float]:
    """Recording day whose camera projects the 3D boxes of whole vehicles best onto their image boxes, and how far off, px.

    The right day is about 1 px off, a wrong one 3 to 13. Without a vehicle the residual is infinite.
    """
    whole = [label for label in labels if label.kind in RIGID and label.truncated == 0 and label.bottom[2] > 0]
    residuals = {}
    for day, camera in CAMERAS.items():
        off = [np.abs(projected_box(label, camera) - label.box - PIXEL_CENTRE).max() for label in whole]
        off = [value for value in off if np.isfinite(value)]
        residuals[day] = float(np.median(off)) if off else np.inf
    best = min(residuals, key=residuals.__getitem__)
    return best, residuals[best]


def scene_box(box: Float[np.ndarray, " 4"], width: int, height: int) -> list[float] | None:
    """A label's box in the convention of scenes, cut to the image; None when nothing of it is inside."""
    cut = np.clip(box + PIXEL_CENTRE, 0, [width, height, width, height])
    return [round(float(v), 3) for v in cut] if cut[0] < cut[2] and cut[1] < cut[3] else None


def object_row(label: KittiLabel, camera: KittiCamera, box: list[float]) -> dict[str, Any]:
    """An object of a scene: the box's centre lies half its height above the labelled underside."""
    height, width, length = label.dimensions
    position = label.bottom + np.array([0.0, -height / 2, 0.0]) + camera.offset
    R_camera_object = torch.from_numpy(car_rotation(np.array([label.rotation_y])))[0]
    return {
        "category": CATEGORY[label.kind],
        "box": box,
        "rotation": [round(v, 9) for v in matrix_to_quaternion(R_camera_object).tolist()],
        "position": [round(float(v), 6) for v in position],
        "size": round(float(np.linalg.norm(label.dimensions)), 6),
        "dimensions": [round(float(v), 6) for v in (width, length, height)],
        "visibility": round(SEEN[label.occluded] * (1 - min(max(label.truncated, 0.0), 1.0)), 6),
        "symmetry": 1,
    }


def scene_row(image: str, labels: list[KittiLabel], camera: KittiCamera, width: int, height: int) -> dict[str, Any]:
    """A line of `scenes.jsonl`."""
    objects: list[dict[str, Any]] = []
    ignore: list[list[float]] = []
    for label in labels:
        box = scene_box(label.box, width, height)
        if box is None:
            continue
        if label.kind in CATEGORY and label.occluded in SEEN and label.bottom[2] > 0:
            objects.append(object_row(label, camera, box))
        elif label.kind in CATEGORY or label.kind in IGNORED:
            ignore.append(box)
    return {"image": image, "intrinsics": camera.intrinsics.tolist(), "objects": objects, "ignore": ignore}


def camera_of_image(calib: Path, labels: list[KittiLabel]) -> tuple[KittiCamera, str]:
    """Camera of an image, and where it comes from: its calibration file, else the recording day that its labels fit.

    The size of an image does not tell, since there are copies cut to another camera's size. Where no vehicle is labelled,
    nothing that is measured depends on the camera, and it is that of the first day.
    """
    if calib.is_file():
        return read_calibration(calib), "its own"
    day, residual = likeliest_camera(labels)
    if not np.isfinite(residual):
        return CAMERAS[day], f"{day}, assumed: no vehicle tells"
    return CAMERAS[day], f"{day}, by its labels to {residual:.1f} px"


def convert_kitti_object(data: str | PathLike[str], out: str | PathLike[str]) -> dict[str, Any]:
    """Write the images and labels of a `kitti_object` folder as a folder of scenes.

    Args:
        data: folder with `image_2/`, `label_2/` and `calib/`.
        out: folder for `images/`, `scenes.jsonl` and `source.json`.

    Returns:
        Numbers of images, objects and regions to ignore.

    Raises:
        InputError: files are missing or malformed.
    """
    folder = Path(data)
    pictures = existing(folder / "image_2", "images of KITTI")
    images = images_of(pictures)
    rows, cameras = [], {}
    for path in images:
        labels = read_object_labels(existing(folder / "label_2" / f"{path.stem}.txt", "labels"))
        camera, cameras[path.name] = camera_of_image(folder / "calib" / f"{path.stem}.txt", labels)
        rows.append(scene_row(f"images/{path.name}", labels, camera, *image_size(path)))
    return _write(images, rows, Path(out), {"kind": "kitti-object", "calibration": cameras})


def convert_kitti_drive(
    images: str | PathLike[str], labels: str | PathLike[str], calib: str | PathLike[str], out: str | PathLike[str]
) -> dict[str, Any]:
    """Write the frames of a drive and its labels by track (KITTI tracking) as a folder of scenes.

    Args:
        images: folder of the drive's frames, in the order of their names.
        labels: file of labels that begin with frame and track.
        calib: file with the projection of camera 2.
        out: folder for `images/`, `scenes.jsonl` and `source.json`.

    Returns:
        Numbers of images, objects and regions to ignore.

    Raises:
        InputError: files are missing or malformed, or a label is of a frame that has no image.
    """
    pictures, camera = images_of(existing(Path(images), "frames of a drive")), read_calibration(calib)
    frames = read_track_labels(labels)
    if len(frames) > len(pictures):
        raise input_error("labels of a drive", got=f"frame {len(frames) - 1}", expected=f"below {len(pictures)}", file=labels)
    frames += [[]] * (len(pictures) - len(frames))
    rows = [
        scene_row(f"images/{path.name}", [label for _, label in frame], camera, *image_size(path))
        for path, frame in zip(pictures, frames)
    ]
    return _write(pictures, rows, Path(out), {"kind": "kitti-drive"})


def _write(images: Sequence[Path], rows: list[dict[str, Any]], out: Path, source: dict[str, Any]) -> dict[str, Any]:
    """Images and labels as a folder of scenes; how many there are."""
    for path in images:
        with atomic_path(out / "images" / path.name) as temporary:
            shutil.copyfile(path, temporary)
    write_jsonl(out / SCENES, rows)
    counts = {
        "images": len(rows),
        "objects": sum(len(row["objects"]) for row in rows),
        "ignore": sum(len(row["ignore"]) for row in rows),
    }
    write_json(out / "source.json", {**source, **counts})
    return counts
