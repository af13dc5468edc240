"""An endless, numbered sequence of scenes: what data sets, caches and streams are made from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from nolbo_ppl._moved import renamed
from nolbo_ppl.synthetic.assets.shape_library import INSTANCES, ShapeLibrary
from nolbo_ppl.synthetic.scenes.background_images import BackgroundImages
from nolbo_ppl.synthetic.scenes.render_scene import Rendered, Scene, render_scene
from nolbo_ppl.synthetic.scenes.scene_config import SceneConfig
from nolbo_ppl.synthetic.scenes.scene_sampler import scene_at
from nolbo_ppl.synthetic.shapes import Shape


@dataclass(frozen=True)
class SceneGenerator:
    """Scene `index` of a source depends on its fields and on `index` alone.

    The seed chooses both the scenes and the shapes: `SEED_STRIDE` keeps the parametric instances of different seeds
    apart, so that a source of another seed shows unseen scenes of unseen shapes.
    """

    config: SceneConfig
    """What scenes look like."""
    seed: int = 0
    """Which scenes and shapes."""
    instances: int = INSTANCES
    """Parametric instances a category."""
    backgrounds: str | None = None
    """Folder of photographs behind the objects, or none."""
    cad: tuple[Shape, ...] | None = None
    """CAD shapes in place of the parametric ones, or none."""

    @cached_property
    def pool(self) -> ShapeLibrary:
        """The shapes; made once in each process."""
        return ShapeLibrary(self.config.categories, seed=self.seed, instances=self.instances, cad=self.cad)

    @cached_property
    def photographs(self) -> BackgroundImages | None:
        """The photographs; listed once in each process."""
        return None if self.backgrounds is None else BackgroundImages(self.backgrounds, self.config.size)

    def __getstate__(self) -> dict:
        return {name: self.__dict__[name] for name in self.__dataclass_fields__}

    def scene(self, index: int) -> Scene:
        """Scene of that number."""
        return scene_at(self.config, self.seed, index, self.pool, self.photographs)

    def render(self, index: int) -> Rendered:
        """Image and labels of the scene of that number."""
        return render_scene(self.scene(index))

    def describe(self) -> dict[str, object]:
        """All that the scenes depend on, as plain JSON values."""
        pictures: Sequence[str] = ()
        if self.photographs is not None and self.backgrounds is not None:
            folder = Path(self.backgrounds)
            pictures = [f"{path.relative_to(folder)}:{path.stat().st_size}" for path in self.photographs.paths]
        return {
            "config": self.config.described(),
            "seed": self.seed,
            "shapes": self.pool.describe(),
            "pictures": list(pictures),
        }


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
