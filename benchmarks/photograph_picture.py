"""Draw the posterior over a photograph that scikit-image carries: `python benchmarks/photograph_picture.py --out picture.jpg`.

`coffee` is the picture of docs/howto/photographs.md (CC0, Rachel Michetti). `motorcycle` is one of the Middlebury stereo
pictures, under its authors' terms: it is drawn where you are and not part of this project. Its camera is known (focal length
995 px), and so is the truth: the motorbike stands 2.4 m away (median of the disparities around its engine).
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
from nolbo_ppl.inference.posterior.predictor import guessed_intrinsics
from nolbo_ppl.viz.posterior_plots import draw_observations

MOTORCYCLE = (994.978, 994.978, 311.193, 254.877)
"""fx fy cx cy of the left camera, px (scikit-image, `stereo_motorcycle`)."""


@dataclass(frozen=True)
class PictureConfig:
    """What to draw."""

    out: Path
    """Picture to write; JPEG or PNG."""
    name: Literal["coffee", "motorcycle"] = "coffee"
    """Which of scikit-image's photographs."""
    width: int = 1100
    """Of the picture, px."""
    model: str = "photo"
    """Weights."""


def main(config: PictureConfig) -> None:
    """Observe, draw, and scale."""
    image = data.coffee() if config.name == "coffee" else data.stereo_motorcycle()[0]
    camera = None if config.name == "coffee" else np.array(MOTORCYCLE)
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
