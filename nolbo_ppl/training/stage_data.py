"""The data of a training run's stages: generated scenes from a cache, or a user's folder."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as distributed
from jaxtyping import Bool, Int, UInt8

from nolbo_ppl.data.augment import Augmentation
from nolbo_ppl.data.dataset_folder import SceneFolder
from nolbo_ppl.data.loader import BatchedScenes, prefetch
from nolbo_ppl.data.scene_cache import write_cache
from nolbo_ppl.devices import each_pinned
from nolbo_ppl.errors import input_error
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.scene_batch import SceneBatch
from nolbo_ppl.synthetic.dataset_writer import is_generated
from nolbo_ppl.synthetic.scenes.scene_config import SceneConfig, photographic, rendered_size
from nolbo_ppl.synthetic.scenes.scene_config import preset as scene_preset
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator
from nolbo_ppl.synthetic.worlds.world_views import ViewConfig, ViewSource
from nolbo_ppl.training.scene_loader import ConcatScenes, MixedSceneLoader, SceneLoader, SceneSubset, ShapeTable
from nolbo_ppl.training.stages import DECODE_STREAM, JOINT, seeded_noise
from nolbo_ppl.training.train_config import TrainConfig

VALIDATION_SEED = 1000
"""Added to the seed of generated scenes for the held-out ones: other scenes, other shapes."""

HELD_OUT_EVERY = 10
"""One scene of so many of each data set of a mix is held out."""
MIN_HELD_OUT = 512
"""Least number of generated held-out scenes."""


class TrainingData:
    """The data of all stages: generated and cached, of a folder, or of several of these in fixed shares."""

    def __init__(self, config: TrainConfig, rank: int, world: int, device: torch.device | None = None) -> None:
        self.config, self.rank, self.world = config, rank, world
        self.device = torch.device("cpu") if device is None else device
        self.model = config.model()
        self.augmentation: Augmentation | None = None
        if config.augment:
            self.augmentation = Augmentation(mirror_probability=0.5 if config.mirror and not config.instance_labels else 0.0)
        self.train: BatchedScenes
        self.single: BatchedScenes
        self._held_out: BatchedScenes
        self._mix: list[tuple[BatchedScenes, ShapeTable, int]] = []
        self._held_out_mix: list[tuple[BatchedScenes, ShapeTable]] = []
        if len(config.scenes) + config.generated > 1:
            self._open_mix()
        elif config.scenes:
            self._open_folders(config.scenes[0])
        else:
            self._generate()
        if len(self.table) == 0 and config.shape_steps:
            raise input_error("no shapes to learn", got=config.scenes, do="add voxels.npz, or use --shape-steps 0")

    def _sources(self, seed: int) -> list[SceneGenerator | ViewSource]:
        """Where generated scenes come from: a source for each kind of scene and each size."""
        config = self.config
        mixed = config.difficulty == "mixed"
        photographs = None if config.backgrounds is None else str(config.backgrounds)
        sources: list[SceneGenerator | ViewSource] = []
        sizes = config.render_sizes or (rendered_size(self.model.image_size),)
        for size in sizes:
            for kind in ("standard", "full") if mixed else (config.difficulty,):
                base = scene_preset(kind, size)
                if mixed and kind == "full":  # CAD without materials, and photographs, look like no other generated scene
                    base = dataclasses.replace(base, single_material=0.25, photographs=0.85)
                base = photographic(base) if config.photographic else base
                behind = None if mixed and kind == "standard" else photographs
                sources.append(SceneGenerator(base, seed, backgrounds=behind))
        if mixed:
            sources.append(ViewSource(ViewConfig(min(sizes)), seed))
        return sources

    def _cached(self, sources: Sequence[SceneGenerator | ViewSource], count: int) -> ConcatScenes:
        """Scenes of some sources, as many of each; the first process renders what is missing."""
        root = self.config.cache.expanduser() / "scenes"
        parts = [write_cache(root, one, -(-count // len(sources)), self.config.workers) for one in sources]
        return ConcatScenes(parts, self.model.voxel_size)

    def _generate(self) -> None:
        """Generated scenes, and held-out ones of another seed."""
        config = self.config
        if self.world > 1 and self.rank > 0:
            distributed.barrier()
        train = self._cached(self._sources(config.seed), config.count)
        held_out = self._cached(self._sources(config.seed + VALIDATION_SEED), max(MIN_HELD_OUT, config.evaluate_scenes))
        self.train, self._held_out = train, held_out
        self.single = self.train
        if config.single_steps:
            base = self._sources(config.seed)[0].config
            assert isinstance(base, SceneConfig)  # views of worlds come last
            single = dataclasses.replace(base, objects=(1, 1), clutter=(0, 1), object_pixels=(40.0, 0.9))
            behind = None if config.difficulty == "mixed" or config.backgrounds is None else str(config.backgrounds)
            source = SceneGenerator(single, config.seed, backgrounds=behind)
            self.single = self._cached([source], config.single_count)
        if self.world > 1 and self.rank == 0:
            distributed.barrier()
        self.table, self._held_out_table = ShapeTable(*train.shapes()), ShapeTable(*held_out.shapes())

    def _open_mix(self) -> None:
        """Folders and generated scenes in fixed shares; every tenth scene of each is held out."""
        config = self.config
        parts: list[SceneFolder | ConcatScenes] = [self._folder(path) for path in config.scenes]
        if config.generated:
            if self.world > 1 and self.rank > 0:
                distributed.barrier()
            parts.append(self._cached(self._sources(config.seed), config.count))
            if self.world > 1 and self.rank == 0:
                distributed.barrier()
        for part, scenes in zip(parts, shares(config.mix or (1.0,) * len(parts), config.batch)):
            held = np.arange(len(part)) % HELD_OUT_EVERY == HELD_OUT_EVERY - 1
            table = ShapeTable(*part.shapes())
            self._mix.append((SceneSubset(part, np.flatnonzero(~held)), table, scenes))
            self._held_out_mix.append((SceneSubset(part, np.flatnonzero(held)), table))
        self.table = self._held_out_table = self._mix[-1][1]
        self.train = self.single = self._mix[-1][0]
        self._held_out = self._held_out_mix[-1][0]

    def _folder(self, path: Path, instances: Sequence[str] | None = None) -> SceneFolder:
        """A data set on disk, its images and voxels at the networks' sizes."""
        model = self.model
        return SceneFolder(
            path, model.categories, instances, model.image_size, symmetry=model.symmetry, voxel_side=model.voxel_size
        )

    def _open_folders(self, path: Path) -> None:
        """A user's folder, and a held-out one or its last tenth."""
        folder = self._folder(path)
        known = 0
        if self.config.instance_labels:
            number, _, category = folder.shapes()
            names = tuple(folder.instances[n] for n in number)
            self.model = dataclasses.replace(self.model, instances=names, instance_category=tuple(int(c) for c in category))
            others = tuple(name for name in folder.instances if name not in set(names))
            folder = self._folder(path, names + others)
            known = len(names)
        self.train = folder
        self.table = ShapeTable(*folder.shapes(), known)
        self.single = folder
        if self.config.validation is None:
            cut = len(folder) - max(1, len(folder) // 10)
            self.train, self._held_out = SceneSubset(folder, np.arange(cut)), SceneSubset(folder, np.arange(cut, len(folder)))
            self.single, self._held_out_table = self.train, self.table
        else:
            held_out_folder = self._folder(self.config.validation)
            self._held_out, self._held_out_table = held_out_folder, ShapeTable(*held_out_folder.shapes())

    @property
    def _crop(self) -> int:
        """Side of crops of one object, px; 0 where whole scenes are seen."""
        return self.model.image_size if self.model.description.one_object else 0

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

            return each_pinned(shapes(), self.device)
        seed = 3 * config.seed + (1 if stage == "single" else 2)  # one for all parts: they choose the same size
        if stage == JOINT:  # on from where the scenes ended
            start += config.scene_steps - config.joint_steps

        def loader_of(scenes: BatchedScenes, table: ShapeTable, batch: int) -> SceneLoader:
            return SceneLoader(
                scenes, table, batch, seed, latent, self.augmentation, self.model.image_size, config.sizes,
                len(self.model.instances), self.rank, self.world, crop=self._crop,
            )  # fmt: skip

        supply: SceneLoader | MixedSceneLoader
        if self._mix:
            supply = MixedSceneLoader([loader_of(*part) for part in self._mix])
        else:
            supply = loader_of(self.single if stage == "single" else self.train, self.table, config.batch)

        def scenes() -> Iterator[SceneBatch]:
            step = start
            while True:
                yield supply.batch(step)
                step += 1

        return prefetch(each_pinned(scenes(), self.device), depth=config.prefetch)

    def validation(self, count: int | None) -> Iterator[SceneBatch]:
        """Held-out batches, without augmentation, with the teacher's latents and the same noise each time."""
        parts = self._held_out_mix or [(self._held_out, self._held_out_table)]
        for scenes, table in parts:
            supply = SceneLoader(
                scenes, table, 64, 0, self.model.latent_dim, size=self.model.image_size,
                known_instances=len(self.model.instances), crop=self._crop,
            )  # fmt: skip
            total = len(scenes) if count is None else min(-(-count // len(parts)), len(scenes))
            step = 64 if self.model.image_size <= 256 else 16
            for first in range(0, total, step):
                batch = supply.prepared(np.arange(first, min(first + step, total)))
                yield batch.replace(
                    noise=seeded_noise(0, first, *batch.present.shape, self.model.latent_dim),
                    decode_order=seeded_noise(0, first + DECODE_STREAM, *batch.present.shape),
                )

    def plain_generated(self, held_out: bool, most: int) -> Bool[torch.Tensor, " n"]:
        """Which scenes of `plain` are generated ones, in its order."""
        train = [scenes for scenes, _, _ in self._mix] or [self.train]
        sizes = [len(scenes) for scenes in ([one for one, _ in self._held_out_mix] or [self._held_out] if held_out else train)]
        kinds = [is_generated(path) for path in self.config.scenes] + [True] * self.config.generated
        return torch.tensor([kind for kind, size in zip(kinds, sizes) for _ in range(min(most, size))])

    def plain_images(self, most: int) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """Training images of every data set, at most so many of each, as they were given: not brought to a square."""
        for scenes in [scenes for scenes, _, _ in self._mix] or [self.train]:
            part = scenes if isinstance(scenes, SceneSubset) else SceneSubset(scenes, np.arange(len(scenes)))
            for index in part.index[evenly(len(part), most)]:
                if isinstance(part.scenes, SceneFolder):
                    yield part.scenes.image(int(index))
                else:
                    yield np.ascontiguousarray(part.scenes.batch(index[None])["image"][0].transpose(1, 2, 0))

    def plain(self, held_out: bool, most: int) -> Iterator[SceneBatch]:
        """Scenes of every data set of a mix as they are, at most so many of each, evenly spread over it.

        Args:
            held_out: those that are not trained on.
            most: scenes of a data set at most.
        """
        train = self._mix or [(self.train, self.table, 0)]
        parts = self._held_out_mix or [(self._held_out, self._held_out_table)]
        for scenes, table in parts if held_out else [(scenes, table) for scenes, table, _ in train]:
            supply = SceneLoader(scenes, table, 16, 0, self.model.latent_dim, size=self.model.image_size)
            chosen = evenly(len(scenes), most)
            for first in range(0, len(chosen), 16):
                yield supply.prepared(chosen[first : first + 16])

    def encode_shapes(self, model: Nolbo) -> None:
        """Encode the shapes by the trained shape guide, in full precision."""
        model.set_half_precision(False)
        mirrored = self.augmentation is not None and self.augmentation.mirror_probability > 0
        for table in [table for _, table, _ in self._mix] or [self.table]:
            table.encode_shapes(model, mirrored=mirrored)
        if self._held_out_table is not self.table:
            self._held_out_table.encode_shapes(model)


def evenly(count: int, most: int) -> Int[np.ndarray, " n"]:
    """At most so many of the numbers below `count`, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int))


def shares(mix: Sequence[float], batch: int) -> list[int]:
    """Scenes of each part in a batch: the shares, rounded so that they sum to it, each at least one.

    Raises:
        InputError: a batch smaller than the number of parts.
    """
    if batch < len(mix):
        raise input_error("batch", got=batch, expected=f"at least one scene of each of {len(mix)} data sets")
    ends = np.round(np.cumsum(mix) / np.sum(mix) * batch).astype(int)
    counts = np.diff(ends, prepend=0)
    while counts.min() < 1:
        counts[counts.argmax()] -= 1
        counts[counts.argmin()] += 1
    return counts.tolist()
