"""Stanford Cars: one labelled car an image, other cars around it unlabelled; the model of the car by number.

J. Krause, M. Stark, J. Deng, L. Fei-Fei: 3D Object Representations for Fine-Grained Categorization, 3dRR 2013.
"""

from __future__ import annotations

from collections.abc import Iterator
from os import PathLike
from pathlib import Path

import numpy as np

from nolbo_ppl.data.converters.archives import ArchiveImage, ArchiveObject
from nolbo_ppl.data.converters.pascal3d import read_record
from nolbo_ppl.errors import input_error
from nolbo_ppl.io.images import open_image


def read_stanford_cars(
    annotations: str | PathLike[str], images: str | PathLike[str], *, only_present: bool = False
) -> Iterator[ArchiveImage]:
    """Images of `cars_train_annos.mat` or `cars_test_annos.mat`, in its order.

    No category is labelled exhaustively: what is not the labelled car is unknown, not background. The number of the model
    (training file only) names no shape, so `instance` stays away.

    Args:
        annotations: the MATLAB file.
        images: folder of the images.
        only_present: skip images that are not there, for parts of the archive; else they are an error.

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
        car = ArchiveObject("car", (box[0] - 1, box[1] - 1, box[2], box[3]))
        yield ArchiveImage(image, (width, height), (car,), exhaustive=())
