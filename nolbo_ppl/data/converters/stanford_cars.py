"""Stanford Cars: one labelled car an image, other cars around it unlabelled; the model of the car by number.

J. Krause, M. Stark, J. Deng, L. Fei-Fei: 3D Object Representations for Fine-Grained Categorization, 3dRR 2013. Its 3D poses:
Y. Wang et al.: 3D Pose Estimation for Fine-Grained Object Categories, ECCV Workshops 2018, a pickle of `{NAME: {"azimuth",
"elevation", "theta" (rad), "distance", "u", "v", "f" (px of an image 300 px wide), "model_id"}}`.

Their camera draws what stands to the left of a model on the left and looks along -z, so that a model is seen mirrored; cars are
symmetric, and what is left is a rotation: azimuth 0 shows the car with its nose to the left, theta turns the picture clockwise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from nolbo_ppl.data.converters.archives import ArchiveImage, ArchiveObject
from nolbo_ppl.data.converters.pascal3d import read_record
from nolbo_ppl.errors import input_error
from nolbo_ppl.io.fields import is_number
from nolbo_ppl.io.images import open_image
from nolbo_ppl.io.plain_pickle import read_plain_pickle

STATED_WIDTH = 300
"""Width of the images that focal lengths and principal points are stated for, px."""


@dataclass(frozen=True)
class CarPose:
    """A pose of the 3D annotations, in the library's terms."""

    viewpoint: tuple[float, float, float]
    """Allocentric azimuth, elevation and in-plane rotation of PASCAL3D+, rad."""
    focal: float
    """px of an image `STATED_WIDTH` wide."""
    offset: tuple[float, float]
    """Principal point from the middle of that image, px: the model's origin lies there."""
    model: str | None
    """CAD model of ShapeNet."""

    def camera(self, width: int, height: int) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy, px of an image of this size."""
        factor = width / STATED_WIDTH
        focal, (u, v) = self.focal * factor, self.offset
        return focal, focal, u * factor + width / 2, v * factor + height / 2


def read_car_poses(path: str | PathLike[str]) -> dict[str, CarPose]:
    """Poses by name of the image; the file is a pickle, of which nothing is run.

    Raises:
        InputError: names the file and the entry.
    """
    file = Path(path)
    content = read_plain_pickle(file)
    if not isinstance(content, dict) or not all(isinstance(row, dict) for row in content.values()):
        raise input_error("not a file of 3D poses", expected='{"00001.jpg": {"azimuth": ...}}', file=file)
    poses = {}
    for name, row in content.items():
        values = {}
        for field in ("azimuth", "elevation", "theta", "f", "u", "v"):
            values[field] = row.get(field)
            if not is_number(values[field], -1e6, 1e6) or (field == "f" and values[field] <= 0):
                expected = "a focal length above 0" if field == "f" else "a number"
                raise input_error(f"{name}: {field}", got=values[field], expected=expected, file=file)
        viewpoint = (math.pi / 2 - values["azimuth"], float(values["elevation"]), -values["theta"])
        model = row.get("model_id")
        offset = (float(values["u"]), float(values["v"]))
        poses[str(name)] = CarPose(viewpoint, float(values["f"]), offset, model if isinstance(model, str) else None)
    return poses


def read_stanford_cars(
    annotations: str | PathLike[str],
    images: str | PathLike[str],
    *,
    only_present: bool = False,
    poses: dict[str, CarPose] | None = None,
) -> Iterator[ArchiveImage]:
    """Images of `cars_train_annos.mat` or `cars_test_annos.mat`, in its order.

    No category is labelled exhaustively: what is not the labelled car is unknown, not background. The number of the model
    (training file only) names no shape, so `instance` stays away.

    Args:
        annotations: the MATLAB file.
        images: folder of the images.
        only_present: skip images that are not there, for parts of the archive; else they are an error.
        poses: 3D poses by name of the image (`read_car_poses`): viewpoints, and the camera that each was annotated with. Images
            without one keep their box alone.

    Raises:
        InputError: names the file and the entry.
    """
    file, folder = Path(annotations), Path(images)
    for k, row in enumerate(np.atleast_1d(read_record(file, "annotations"))):
        name = str(getattr(row, "fname", ""))
        image = folder / Path(name).name
        if not name or not image.is_file():
            if only_present:
                continue
            raise input_error(f"image of annotations({k + 1})", got=name, expected=f"a file in {folder}", file=file)
        try:
            box = [float(getattr(row, f"bbox_{side}")) for side in ("x1", "y1", "x2", "y2")]
        except (AttributeError, TypeError, ValueError) as error:
            raise input_error(f"box of annotations({k + 1})", got=error, expected="bbox_x1 to bbox_y2", file=file) from None
        if not np.isfinite(box).all() or box[0] >= box[2] or box[1] >= box[3]:
            raise input_error(f"box of annotations({k + 1})", got=box, expected="x1 < x2 and y1 < y2", file=file)
        height, width = open_image(image).shape[:2]
        pose = (poses or {}).get(Path(name).name)
        viewpoint, model = (None, None) if pose is None else (pose.viewpoint, pose.model)
        car = ArchiveObject("car", (box[0] - 1, box[1] - 1, box[2], box[3]), viewpoint, model)
        camera = None if pose is None else pose.camera(width, height)
        yield ArchiveImage(image, (width, height), (car,), exhaustive=(), intrinsics=camera)
