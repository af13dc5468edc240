"""Views of given instances, one object a picture: other light, colours, backdrop and viewpoint in each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nolbo_ppl.errors import NolboError
from nolbo_ppl.structures.annotations import Annotations
from nolbo_ppl.synthetic.assets.shape_library import ShapeLibrary
from nolbo_ppl.synthetic.scenes.render_scene import Rendered, render_scene
from nolbo_ppl.synthetic.scenes.scene_config import SceneConfig
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator
from nolbo_ppl.synthetic.scenes.scene_sampler import sample_scene

STREAM = 7
"""Keeps the random numbers of views apart from those of scenes of the same seed."""
MAX_ATTEMPTS = 50
"""Scenes drawn for one view before it is given up: the object may find no place, or be seen too little."""
MIN_PIXELS = 0.375
"""Least box diagonal in a view, over image size: 48 px of 128."""
MIN_VISIBILITY = 0.7
"""Least visible share in a view."""


def view_config(config: SceneConfig) -> SceneConfig:
    """The same look with one whole object of some size and nothing before it."""
    return replace(
        config,
        objects=(1, 1),
        empty_probability=0.0,
        clutter=(0, 0),
        truncation_probability=0.0,
        near_probability=0.0,
        object_pixels=(MIN_PIXELS * config.size, 0.9),
        least_visibility=MIN_VISIBILITY,
    )


def render_view(source: SceneGenerator, category: str, number: int, view: int) -> Rendered:
    """Picture of instance `number` of a category; a function of the source's fields and of these arguments alone.

    Raises:
        NolboError: the instance found no place in any scene (it never happened).
    """
    config = view_config(source.config)
    # A pool of this one shape: whatever a scene draws from it is the wanted instance.
    pool = ShapeLibrary([category], cad=[source.pool.item(category, number).shape])
    label = source.pool.categories.index(category)
    for attempt in range(MAX_ATTEMPTS):
        rng = np.random.default_rng([source.seed, STREAM, label, number, view, attempt])
        rendered = render_scene(sample_scene(config, rng, pool, source.photographs))
        if len(rendered.labels) == 1:
            return rendered
    raise NolboError(f"no view of instance {number} of {category} in {MAX_ATTEMPTS} scenes")


@dataclass(frozen=True)
class InstanceViews:
    """Two views of each of the first instances of every category of a source."""

    source: SceneGenerator
    most: int
    """Instances of a category at most."""
    categories: tuple[str, ...]
    """The model's categories: what the labels are numbered by."""

    @property
    def instances(self) -> list[tuple[str, int]]:
        """Category and number of every instance, category by category; a category of one instance has nothing to tell."""
        pool = self.source.pool
        known: Sequence[str] = [name for name in pool.categories if name in self.categories and pool.count(name) > 1]
        return [(name, number) for name in known for number in range(min(self.most, pool.count(name)))]

    def pair(self, category: str, number: int) -> tuple[Annotations, Annotations]:
        """The two views of an instance."""
        first, second = (render_view(self.source, category, number, view).with_voxels() for view in (0, 1))
        return first, second
