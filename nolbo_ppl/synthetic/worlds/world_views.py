"""Single images from generated worlds: scenes to learn from that look like drives do.

Each block of scenes shows a world of its own, street and floor by turns, from random places beside the camera's track,
looking anywhere. It has the interface of `nolbo_ppl.synthetic.scenes.scene_generator.SceneGenerator`.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.structures.label_arrays import SLOTS
from nolbo_ppl.synthetic.scenes.render_scene import Rendered
from nolbo_ppl.synthetic.worlds.camera_path import camera_pose
from nolbo_ppl.synthetic.worlds.sequence_folder import LAYOUT
from nolbo_ppl.synthetic.worlds.world import World, make_world
from nolbo_ppl.synthetic.worlds.world_config import SequenceConfig
from nolbo_ppl.synthetic.worlds.world_frame import render_frame

FIRST_WORLD = 1_000_000
"""Worlds to learn from have seeds from here on; drives for evaluation have smaller ones."""
WORLDS_A_SEED = 10_000
"""Worlds of successive seeds of a source are this far apart."""
NUMBERS = 1_000_000
"""Instances of a world are numbered from this times its number, plus one, apart from those of scenes and of each other."""
VERSION = 2
"""Raised when the same seed gives other views than before."""
MAX_ATTEMPTS = 6
"""Places tried for an image that holds no object, or more than there are slots."""


@dataclass(frozen=True)
class ViewConfig:
    """Ranges are (least, greatest)."""

    size: int = 128
    """Height and width of the image, px; a multiple of 32."""
    scenes: int = 128
    """Images from one world."""
    objects: int = 90
    """Objects wanted in a world."""
    focal: tuple[float, float] = (0.9, 2.4)
    """Focal length over image size, drawn log-uniformly."""
    height: tuple[float, float] = (1.0, 2.2)
    """Height of the camera above the ground, m."""
    tilt: tuple[float, float] = (-2.0, 22.0)
    """Downward tilt, degrees."""
    roll: float = 2.0
    """Scale of the roll, degrees."""
    sideways: float = 0.7
    """Greatest distance from the camera's track, m."""
    least_visibility: float = 0.15
    """Objects of which less is seen are not labelled."""
    least_box: float = 9.0
    """Objects whose box has a shorter side below this many px are not labelled: far ones are everywhere."""

    def __post_init__(self) -> None:
        if self.size <= 0 or self.size % 32:
            raise input_error("size of the views", got=self.size, expected="a positive multiple of 32")
        if self.scenes < 1:
            raise input_error("images from one world", got=self.scenes, expected="at least 1")


@lru_cache(maxsize=1)
def _world(kind: str, seed: int, objects: int) -> World:
    indoor = kind == "indoor"
    step, height = (0.25, 1.5) if indoor else (0.9, 1.65)
    config = SequenceConfig(
        world="indoor" if indoor else "street",
        seed=seed,
        frames=120,
        laps=1.0,
        step=step,
        objects=objects,
        clutter=objects // 2,
        camera_height=height,
    )
    return make_world(config)


@dataclass(frozen=True)
class ViewSource:
    """Scene `index` depends on the fields and on `index` alone."""

    config: ViewConfig = field(default_factory=ViewConfig)
    seed: int = 0
    """Which worlds."""

    def world(self, index: int) -> World:
        """The world that scene `index` shows."""
        number = index // self.config.scenes
        seed = FIRST_WORLD + WORLDS_A_SEED * self.seed + number
        return _world(("street", "indoor")[number % 2], seed, self.config.objects)

    def render(self, index: int) -> Rendered:
        """Image and labels of the scene of that number."""
        world, number = self.world(index), index // self.config.scenes
        rng = np.random.default_rng([self.seed, 7300, index])
        rendered = self._look(world, rng)
        for _ in range(MAX_ATTEMPTS):
            if 1 <= len(rendered.annotations) <= SLOTS:
                break
            rendered = self._look(world, rng)
        box = rendered.annotations.box
        largest = np.argsort(-np.prod(box[:, 2:] - box[:, :2], axis=1), kind="stable")[:SLOTS]
        first = NUMBERS * (WORLDS_A_SEED * self.seed + number + 1)
        assets = tuple(replace(rendered.assets[k], number=first + rendered.assets[k].number) for k in largest)
        return replace(rendered, annotations=rendered.annotations.select(largest), assets=assets)

    def _look(self, world: World, rng: np.random.Generator) -> Rendered:
        """One image from a random place."""
        config = self.config
        low, high = np.log(config.focal)
        camera = replace(
            world.config,
            size=(config.size, config.size),
            focal=float(np.exp(rng.uniform(low, high))),
            least_visibility=config.least_visibility,
            least_box=config.least_box,
            noise=float(rng.uniform(0, 0.02)),
            seed=int(rng.integers(2**31)),
        )
        exposure = world.exposure * float(np.exp(rng.uniform(-0.25, 0.25)))
        seen = replace(world, config=camera, T_ground_camera=self._pose(world, rng)[None], exposure=exposure)
        return render_frame(seen, 0).rendered

    def _pose(self, world: World, rng: np.random.Generator) -> Float[np.ndarray, "4 4"]:
        config = self.config
        near = world.T_ground_camera[int(rng.integers(len(world.T_ground_camera)))]
        x, y = near[:2, 3] + rng.uniform(-1, 1, 2) * config.sideways / np.sqrt(2)
        height, tilt = rng.uniform(*config.height), np.radians(rng.uniform(*config.tilt))
        roll = np.radians(config.roll) * rng.standard_normal()
        return camera_pose(float(x), float(y), float(height), float(rng.uniform(-np.pi, np.pi)), float(tilt), float(roll))

    def describe(self) -> dict[str, object]:
        """All that the scenes depend on, as plain JSON values."""
        return {"views": asdict(self.config), "seed": self.seed, "views_version": VERSION, "layout": LAYOUT}
