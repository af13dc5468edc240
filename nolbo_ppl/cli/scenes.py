"""Make a data set of rendered scenes: `nolbo scenes --out DIR`, or `python -m nolbo_ppl.cli.scenes --out DIR`."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.synthetic.assets.shape_library import INSTANCES
from nolbo_ppl.synthetic.dataset_writer import write_scenes
from nolbo_ppl.synthetic.scenes.scene_config import photographic, preset
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator


@dataclass(frozen=True)
class ScenesConfig:
    """Render scenes of everyday objects with complete labels into a folder."""

    out: Path
    """Folder of the data set; calling again resumes a run that was stopped."""
    count: int = 1000
    """Number of images."""
    seed: int = 0
    """Which scenes and which shapes; another seed shows unseen scenes of unseen shapes."""
    cad: Path | None = None
    """Folder of CAD meshes (OFF, OBJ, PLY, GLB in a sub-folder per category) in place of the generated shapes, painted with the
    colours of their materials and textures; or a furniture library of Sweet Home 3D (`.sh3f`)."""
    up: str | None = None
    """The axis of the CAD files that points up, x, y or z with its sign; by default +y of GLB and glTF, +z of the others."""
    front: str | None = None
    """The axis that their front faces; by default +z of files with y up, -y of those with z up."""
    backgrounds: Path | None = None
    """Folder of photographs behind the objects. What they show of the twelve categories is not labelled."""
    size: int = 128
    """Height and width of the images, px; a multiple of 32."""
    difficulty: Literal["easy", "standard", "full"] = "standard"
    """How hard: from upright objects on plain ground to heavy clutter, occlusion, truncation and coloured light."""
    photographic: bool = False
    """As a phone would take them: motion, noise, poor exposure, vignetting, JPEG; daylight that goes with the sky; people and
    plants before the objects. Wants 320 px and more."""
    instances: int = INSTANCES
    """Generated shapes a category."""
    workers: int = max(1, min(8, os.cpu_count() or 1))
    """Processes; the images do not depend on it."""


def source_of(config: ScenesConfig) -> SceneGenerator:
    """The sequence of scenes the options describe. Raises `InputError` for unusable options."""
    cad = None
    if config.cad is not None:
        from nolbo_ppl.synthetic.assets.cad import load_cad_folder

        cad = tuple(load_cad_folder(config.cad, CATEGORIES, up=config.up, front=config.front))
    backgrounds = None if config.backgrounds is None else str(config.backgrounds)
    scenes = preset(config.difficulty, config.size)
    scenes = photographic(scenes) if config.photographic else scenes
    return SceneGenerator(scenes, config.seed, config.instances, backgrounds, cad)


def run(config: ScenesConfig) -> dict[str, Any]:
    """Write the data set.

    Returns:
        Numbers of scenes, objects and instances, the folder, and the seconds it took.
    """
    begin = time.perf_counter()
    summary = write_scenes(config.out, source_of(config), config.count, config.workers)
    return {"out": str(config.out), **summary, "seconds": round(time.perf_counter() - begin, 3)}


def main(args: Sequence[str] | None = None) -> dict[str, Any]:
    """Command line: parse the options and run."""
    import tyro

    return run(tyro.cli(ScenesConfig, prog="nolbo scenes", args=args, description=__doc__))


if __name__ == "__main__":
    main()
