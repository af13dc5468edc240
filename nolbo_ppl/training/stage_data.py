"""The data of a training run's stages: generated scenes from a cache, or a user's folder."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch.distributed as distributed

from nolbo_ppl.data.augment import Augmentation
from nolbo_ppl.data.dataset_folder import SceneFolder
from nolbo_ppl.data.loader import Scenes, prefetch
from nolbo_ppl.data.scene_cache import CachedScenes, write_cache
from nolbo_ppl.errors import input_error
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.scene_batch import SceneBatch
from nolbo_ppl.synthetic.scenes.scene_config import SceneConfig, rendered_size
from nolbo_ppl.synthetic.scenes.scene_config import preset as scene_preset
from nolbo_ppl.synthetic.scenes.scene_source import SceneSource
from nolbo_ppl.synthetic.worlds.world_views import ViewConfig, ViewSource
from nolbo_ppl.training.scene_supply import JoinedScenes, SceneSubset, SceneSupply, ShapeTable
from nolbo_ppl.training.stages import seeded_noise
from nolbo_ppl.training.train_config import TrainConfig

VALIDATION_SEED = 1000
"""Added to the seed of generated scenes for the held-out ones: other scenes, other shapes."""

LEAST_HELD_OUT = 512
"""Least number of generated held-out scenes."""


class TrainingData:
    """The data of all stages: generated and cached, or a folder's."""

    def __init__(self, config: TrainConfig, rank: int, world: int) -> None:
        self.config, self.rank, self.world = config, rank, world
        self.model = config.model()
        self.augmentation: Augmentation | None = None
        if config.augment:
            self.augmentation = Augmentation(mirror_probability=0.5 if config.mirror and not config.instance_labels else 0.0)
        size = self.model.image_size
        self.train: Scenes
        self.single: Scenes
        self._held_out: Scenes
        if config.scenes is not None:
            self._open_folders(config.scenes, size)
        else:
            size = rendered_size(size)
            mixed = config.difficulty == "mixed"
            kinds = ("standard", "full") if mixed else (config.difficulty,)
            bases = [scene_preset(kind, size) for kind in kinds]
            if mixed:  # CAD without materials, and photographs, look like no other generated scene
                bases[1] = dataclasses.replace(bases[1], single_material=0.25, photographs=0.85)
            photographs = None if config.backgrounds is None else str(config.backgrounds)
            root = config.cache.expanduser() / "scenes"
            if world > 1 and rank > 0:
                distributed.barrier()  # the first process renders what is missing
            single = dataclasses.replace(bases[0], objects=(1, 1), clutter=(0, 1), object_pixels=(40.0, 0.9))

            def source(of: SceneConfig, seed: int) -> SceneSource:
                return SceneSource(of, seed, backgrounds=None if mixed and of is bases[0] else photographs)

            def cached(of: SceneSource | ViewSource, count: int) -> CachedScenes:
                return write_cache(root, of, count, config.workers)

            def all_of(seed: int, count: int) -> JoinedScenes:
                sources = [source(base, seed) for base in bases] + ([ViewSource(ViewConfig(size), seed)] if mixed else [])
                return JoinedScenes([cached(one, -(-count // len(sources))) for one in sources])

            train = all_of(config.seed, config.count)
            held_out_scenes = all_of(config.seed + VALIDATION_SEED, max(LEAST_HELD_OUT, config.evaluate_scenes))
            self.train, self._held_out = train, held_out_scenes
            self.single = self.train
            if config.single_steps:
                self.single = cached(source(single, config.seed), config.single_count)
            if world > 1 and rank == 0:
                distributed.barrier()
            self.table, self._held_out_table = ShapeTable(*train.shapes()), ShapeTable(*held_out_scenes.shapes())
        if len(self.table) == 0 and config.shape_steps:
            raise input_error("no shapes to learn", got=config.scenes, do="add voxels.npz, or use --shape-steps 0")

    def _open_folders(self, path: Path, size: int) -> None:
        """A user's folder, and a held-out one or its last tenth."""
        folder = SceneFolder(path, self.model.categories, size=size, symmetry=self.model.symmetry)
        known = 0
        if self.config.instance_labels:
            number, _, category = folder.shapes()
            names = tuple(folder.instances[n] for n in number)
            self.model = dataclasses.replace(self.model, instances=names, instance_category=tuple(int(c) for c in category))
            others = tuple(name for name in folder.instances if name not in set(names))
            folder = SceneFolder(path, self.model.categories, names + others, size=size, symmetry=self.model.symmetry)
            known = len(names)
        self.train = folder
        self.table = ShapeTable(*folder.shapes(), known)
        self.single = folder
        if self.config.validation is None:
            cut = len(folder) - max(1, len(folder) // 10)
            self.train, self._held_out = SceneSubset(folder, np.arange(cut)), SceneSubset(folder, np.arange(cut, len(folder)))
            self.single, self._held_out_table = self.train, self.table
        else:
            held_out_folder = SceneFolder(self.config.validation, self.model.categories, size=size, symmetry=self.model.symmetry)
            self._held_out, self._held_out_table = held_out_folder, ShapeTable(*held_out_folder.shapes())

    def batches(self, stage: str, start: int) -> Iterator[Any]:
        """Batches of a stage from a step on."""
        config, latent = self.config, self.model.latent_dim
        if stage == "shapes":
            size, rank, world = config.shape_batch, self.rank, self.world
            part = slice(rank * size // world, (rank + 1) * size // world)
            seed = 3 * config.seed

            def shapes() -> Iterator[Any]:
                step = start
                while True:
                    yield self.table.batch(config.shape_batch, seed, step, latent, part)
                    step += 1

            return shapes()
        supply = SceneSupply(
            self.single if stage == "single" else self.train,
            self.table,
            config.batch,
            3 * config.seed + (1 if stage == "single" else 2),
            latent,
            self.augmentation,
            self.model.image_size,
            config.sizes,
            len(self.model.instances),
            self.rank,
            self.world,
        )

        def scenes() -> Iterator[SceneBatch]:
            step = start
            while True:
                yield supply.batch(step)
                step += 1

        return prefetch(scenes())

    def validation(self, count: int | None) -> Iterator[SceneBatch]:
        """Held-out batches, without augmentation, with the teacher's latents and the same noise each time."""
        known = len(self.model.instances)
        supply = SceneSupply(
            self._held_out, self._held_out_table, 64, 0, self.model.latent_dim, size=self.model.image_size, known_instances=known
        )
        total = len(self._held_out) if count is None else min(count, len(self._held_out))
        for first in range(0, total, 64):
            batch = supply.prepared(np.arange(first, min(first + 64, total)))
            yield batch.replace(noise=seeded_noise(0, first, *batch.present.shape, self.model.latent_dim))

    def teach(self, model: Nolbo) -> None:
        """Encode the shapes by the trained shape guide, in full precision."""
        model.set_half_precision(False)
        self.table.teach(model, mirrored=self.augmentation is not None and self.augmentation.mirror_probability > 0)
        if self._held_out_table is not self.table:
            self._held_out_table.teach(model)
