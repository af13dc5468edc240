"""The stages of the paper's programme on images of objects: crops of single objects, then whole scenes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nolbo_ppl.data.augment import Augmentation
from nolbo_ppl.data.dataset_folder import SceneFolder
from nolbo_ppl.devices import placed
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.voxels import unpack_voxels
from nolbo_ppl.inference.posterior.model_folder import load
from nolbo_ppl.io.tensors import check_tensors
from nolbo_ppl.metrics.voxel import voxel_average_precision
from nolbo_ppl.models.observation_model import Nolbo, evaluation_mode
from nolbo_ppl.models.scene_batch import SceneBatch
from nolbo_ppl.training.paper_config import PaperConfig
from nolbo_ppl.training.paper_loop import PaperSummary, Phase, adopt_core, finished, optimizer_of, run_phases
from nolbo_ppl.training.scene_loader import SceneLoader, SceneSubset, ShapeTable
from nolbo_ppl.training.stages import StageRun, TrainingStage, scene_weights
from nolbo_ppl.training.trainer import compile_networks
from nolbo_ppl.training.validation import validate

LARGEST_READ = 640
"""Longest side, px, of images that single objects are cut out of, where crops are smaller."""


class _SceneData:
    """A folder of scenes, and held-out ones, at the size of a phase."""

    def __init__(self, config: PaperConfig, size: int) -> None:
        self.config, model = config, config.model(config.categories)
        options: dict[str, Any] = {"size": size, "symmetry": model.symmetry, "voxel_side": model.voxel_size}
        folder = SceneFolder(config.data, model.categories, **options)
        self.table = ShapeTable(*folder.shapes())
        if config.validation is None:
            cut = len(folder) - max(1, len(folder) // 10)
            self.train: Any = SceneSubset(folder, np.arange(cut))
            self.held_out: Any = SceneSubset(folder, np.arange(cut, len(folder)))
            self.held_out_table = self.table
        else:
            held_out = SceneFolder(config.validation, model.categories, **options)
            self.train, self.held_out, self.held_out_table = folder, held_out, ShapeTable(*held_out.shapes())
        if config.objective == "inclusive" and not len(self.table):
            raise input_error(
                "shapes for the inclusive objective", got="no voxels.npz", do="convert with CAD models", file=config.data
            )

    def teach(self, model: Nolbo) -> None:
        """Encode the shapes by the 3D encoder: the truth of the shape latent, where the objective asks for it."""
        if self.config.objective == "inclusive":
            self.table.encode_shapes(model, mirrored=self.config.augment and self.config.mirror)
            if self.held_out_table is not self.table:
                self.held_out_table.encode_shapes(model)


def scenes_stage(config: PaperConfig, device: torch.device, rank: int, world: int) -> PaperSummary:
    """Crops of single objects, or whole scenes."""
    single = config.stage == "single"
    model = Nolbo.from_seed(config.model(config.categories), config.seed)
    _adopt(config, model)
    model.to(device)
    if config.compile:
        compile_networks(model)
    scales = tuple(config.default("sizes"))
    sizes = [(size,) for size in config.phases] * single + [scales]
    data = {max(chosen): _SceneData(config, _read_size(chosen, single)) for chosen in sizes}
    some = next(iter(data.values()))
    for one in data.values():
        one.teach(model)
    steps, epoch = config.steps_of(len(some.train)), config.epoch(len(some.train))
    weights = scene_weights(config.objective, config.scene_terms())
    if single:
        stage = TrainingStage("single", optimizer_of(config, steps, decay=0.2), weights, decode=config.decode)
    else:
        hold = min(epoch, steps)
        optimizer = optimizer_of(
            config, steps, start_rate=config.first_rate, hold=hold, warmup=min(100, max(1, epoch // 10)), decay=0.2
        )
        stage = TrainingStage("scenes", optimizer, weights, min(steps, config.freeze_epochs * epoch), decode=config.decode)
    augmentation = None
    if config.augment:
        augmentation = Augmentation(mirror_probability=0.5 if config.mirror else 0.0)

    def loader(chosen: tuple[int, ...], held_out: bool = False) -> SceneLoader:
        one = data[max(chosen)]
        return SceneLoader(
            one.held_out if held_out else one.train,
            one.held_out_table if held_out else one.table,
            config.default("batch"),
            config.seed,
            config.latent_dim,
            None if held_out else augmentation,
            size=_read_size(chosen, single),
            sizes=None if held_out or single else chosen,
            rank=0 if held_out else rank,
            world=1 if held_out else world,
            crop=_crop(chosen) if single else 0,
        )

    def batches_of(chosen: tuple[int, ...]) -> Callable[[int], Iterator[SceneBatch]]:
        def batches(start: int) -> Iterator[SceneBatch]:
            supply, step = loader(chosen), start
            while True:
                if single and len(chosen) > 1:  # crops of another side each step
                    supply.crop = chosen[int(np.random.default_rng([config.seed, step, 4]).integers(len(chosen)))]
                yield supply.batch(step)
                step += 1

        return batches

    def held_out_batches(chosen: tuple[int, ...]) -> Iterator[SceneBatch]:
        supply, total = loader(chosen, held_out=True), min(config.evaluate_pictures, len(data[max(chosen)].held_out))
        for first in range(0, total, 16):
            yield supply.prepared(np.arange(first, min(first + 16, total)))

    def ends(figures: dict[str, float], steps_of_phase: int) -> bool:
        known = figures.get("voxel_map", 0.0) >= config.switch
        return known or 0 < config.phase_steps <= steps_of_phase

    phases = [Phase(f"{config.stage}-{max(c)}" if len(c) == 1 else config.stage, batches_of(c), ends) for c in sizes]
    chosen_of = {phase.name: chosen for phase, chosen in zip(phases, sizes)}

    def evaluate(averaged: Nolbo, phase: Phase) -> dict[str, float]:
        chosen = chosen_of[phase.name]
        return {**validate(averaged, held_out_batches(chosen)), **voxel_precision(averaged, held_out_batches(chosen))}

    run = StageRun(model, stage, config.bf16)
    run_phases(config, run, phases, steps, device, rank, evaluate)
    return finished(config, model, steps, rank, lambda: evaluate(model, phases[-1]), lambda: held_out_batches(sizes[-1]))


def _crop(chosen: tuple[int, ...]) -> int:
    """Side of the crops that held-out objects are looked at in."""
    return chosen[len(chosen) // 2]


def _read_size(chosen: tuple[int, ...], single: bool) -> int:
    """Longer side, px, that images are read at: objects are cut out of larger ones than their crops, up to a limit."""
    return max(chosen) if not single else max(max(chosen), min(2 * max(chosen), LARGEST_READ))


def _adopt(config: PaperConfig, model: Nolbo) -> None:
    """The weights a stage goes on with."""
    if config.core is not None:
        adopt_core(model.guide.encoder.core, config.core)  # type: ignore[union-attr, arg-type]
    if config.decoder is not None:
        part = load(_model_folder(config.decoder), "cpu").model
        for name in ("story.decoder", "shape_guide"):  # the prior is fresh: its labels are others
            own, given = model.get_submodule(name), part.get_submodule(name)
            check_tensors(own.state_dict(), given.state_dict(), config.decoder)
            own.load_state_dict(given.state_dict())
    if config.initial is not None:
        given_model = load(_model_folder(config.initial), "cpu").model
        if given_model.config.categories != config.categories:
            got = ", ".join(given_model.config.categories)
            raise input_error(
                "categories of the initial weights", got=got, expected=", ".join(config.categories), file=config.initial
            )
        check_tensors(model.state_dict(), given_model.state_dict(), config.initial)
        model.load_state_dict(given_model.state_dict())


def _model_folder(path: Path) -> Path:
    """The model in the folder of a run, or the folder itself."""
    return path / "model" if (path / "model" / "config.json").is_file() else path


def _rows(mask: torch.Tensor, value: torch.Tensor) -> torch.Tensor:
    """Rows of a value."""
    return value[mask]


@torch.no_grad()
def voxel_precision(model: Nolbo, batches: Iterator[SceneBatch]) -> dict[str, float]:
    """Average precision of the voxels that the latent of each held-out object decodes to, at its responsible region: `voxel_map`,
    the mean over categories of the means over objects. Empty without known shapes."""
    device, of_category = next(model.parameters()).device, {}  # type: ignore[var-annotated]
    with evaluation_mode(model):
        for batch in batches:
            batch = placed(batch, device)
            scene = model.guide.observe(batch)
            mask = scene.assignment.assigned & batch.has_voxels & (batch.category >= 0)
            if not bool(mask.any()):
                continue
            q = scene.posterior.map(partial(_rows, mask)).at_map_category(model.story.prior.label_mean())
            probability = torch.sigmoid(model.story.decoder(q.shape_loc)).float().cpu().numpy()
            truth = unpack_voxels(batch.voxels[mask].cpu().numpy(), model.config.voxel_size)
            solid = truth.any(axis=(1, 2, 3))
            for label, value in zip(
                batch.category[mask].cpu().numpy()[solid], voxel_average_precision(probability[solid], truth[solid])
            ):
                of_category.setdefault(int(label), []).append(float(value))
    return {"voxel_map": float(np.mean([np.mean(values) for values in of_category.values()]))} if of_category else {}
