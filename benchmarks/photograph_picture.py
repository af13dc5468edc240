"""Draw the posterior over a photograph: `python benchmarks/photograph_picture.py --out picture.jpg`.

`coffee`, carried by scikit-image, is the picture of the documents (CC0, Rachel Michetti). The others are drawn where you are
and are not part of this project. `desk` is a frame of TUM RGB-D freiburg1_desk (CC BY 4.0, J. Sturm, N. Engelhard, F. Endres,
W. Burgard and D. Cremers, TU Munich; vision.in.tum.de/data/datasets/rgbd-dataset), with `--data` the folder that holds
`sequences/tum_fr1_desk`; its lens is known and undone. `motorcycle` is one of the Middlebury stereo pictures, under its
authors' terms. Its camera is known (focal length 995 px), and so is the truth: the motorbike stands 2.4 m away (median of
the disparities around its engine).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from PIL import Image
from skimage import data

import nolbo_ppl
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.distortion import undistort_image
from nolbo_ppl.inference.posterior.predictor import guessed_intrinsics
from nolbo_ppl.io.camera_files import CameraIntrinsics
from nolbo_ppl.io.images import open_image
from nolbo_ppl.viz.posterior_plots import draw_observations

MOTORCYCLE = (994.978, 994.978, 311.193, 254.877)
"""fx fy cx cy of the left camera, px (scikit-image, `stereo_motorcycle`)."""

DESK = "1305031468.395860.jpg"
"""Frame of the desk that is drawn."""
FR1 = CameraIntrinsics(517.3, 516.5, 318.6, 255.3, 640, 480, "radial-tangential", (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
"""Camera of freiburg1."""


@dataclass(frozen=True)
class PictureConfig:
    """What to draw."""

    out: Path
    """Picture to write; JPEG or PNG."""
    name: Literal["coffee", "motorcycle", "desk"] = "coffee"
    """Which photograph."""
    data: Path = Path("../shared/data")
    """Folder with `sequences/tum_fr1_desk`, for `desk`."""
    frame: str = DESK
    """Image of the desk."""
    width: int = 1100
    """Of the picture, px."""
    model: str = "photo"
    """Weights."""


def photograph(config: PictureConfig) -> tuple[np.ndarray, np.ndarray | None]:
    """The photograph, and its camera where it is known."""
    if config.name == "coffee":
        return data.coffee(), None
    if config.name == "motorcycle":
        return data.stereo_motorcycle()[0], np.array(MOTORCYCLE)
    path = config.data / "sequences" / "tum_fr1_desk" / "rgb" / config.frame
    if not path.is_file():
        raise input_error("no such image", file=path, do="give --data, the folder with sequences/tum_fr1_desk of TUM RGB-D")
    assert FR1.model is not None
    target = FR1.undistorted((640, 480)).vector
    return undistort_image(open_image(path), FR1.vector, FR1.model, FR1.distortion, target), target


def main(config: PictureConfig) -> None:
    """Observe, draw, and scale."""
    image, camera = photograph(config)
    model = nolbo_ppl.load(config.model)
    found = model.observe(image, camera)
    large = config.out.with_suffix(".large.png")
    drawn = guessed_intrinsics(image) if camera is None else camera
    draw_observations(image, found, drawn, prior_mean=model.prior_mean(), path=large)
    with Image.open(large) as picture:
        height = round(picture.height * config.width / picture.width)
        small = picture.convert("RGB").resize((config.width, height), Image.Resampling.LANCZOS)
    small.save(config.out, quality=80, optimize=True)
    large.unlink()
    for k, category in enumerate(found.category):
        print(category, round(float(found.objectness[k]), 2), "at", found.position[k].round(2), "m")


if __name__ == "__main__":
    main(tyro.cli(PictureConfig, description=__doc__))
