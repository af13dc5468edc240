"""The paper's training programme: encoder core, decoder and prior, single objects, whole scenes (NOLBO, training details).

Every stage is a run: its batches are functions of seed and step, its checkpoint holds all a step changes, and a killed run goes
on where that stands. Phases of the single-object stage are numbered in the checkpoint: they end at an accuracy.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as distributed
from torch import nn

from nolbo_ppl._version import __version__
from nolbo_ppl.data.augment import Augmentation
from nolbo_ppl.data.dataset_folder import SceneFolder
from nolbo_ppl.data.loader import prefetch
from nolbo_ppl.data.modelnet import modelnet_voxels
from nolbo_ppl.devices import device_of, each_pinned, placed
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.voxels import unpack_voxels
from nolbo_ppl.inference import svi as optimisation
from nolbo_ppl.inference.elbo import SHAPE_STAGE
from nolbo_ppl.inference.posterior.model_folder import load, save
from nolbo_ppl.inference.svi import OptimizerConfig
from nolbo_ppl.io.tensors import check_tensors, load_tensors, save_tensors
from nolbo_ppl.metrics.voxel import voxel_average_precision, voxel_iou
from nolbo_ppl.models.classifiers import PictureClassifier
from nolbo_ppl.models.observation_model import Nolbo, evaluation_mode
from nolbo_ppl.models.posterior_calibration import Calibration
from nolbo_ppl.models.scene_batch import SceneBatch
from nolbo_ppl.progress import progress_bar
from nolbo_ppl.training.calibrate import TooFewObjects, calibrate
from nolbo_ppl.training.model_card import write_card
from nolbo_ppl.training.paper_config import PaperConfig
from nolbo_ppl.training.picture_stages import PictureRun, open_pictures, picture_batches, validate_pictures
from nolbo_ppl.training.scene_loader import SceneLoader, SceneSubset, ShapeTable
from nolbo_ppl.training.stages import StageRun, TrainingStage, scene_weights
from nolbo_ppl.training.trainer import compile_networks, join_processes
from nolbo_ppl.training.training_log import TrainingLogger, run_folder
from nolbo_ppl.training.validation import validate

CORE = "core.safetensors"
"""The encoder core in the folder of a run of a stage on pictures."""


LARGEST_READ = 640
"""Longest side, px, of images that single objects are cut out of, where crops are smaller."""


@dataclass
class PaperSummary:
    """What a stage reports."""

    out: Path
    """What the next stage takes: the encoder core, or the folder of a model."""
    steps: int
    """Optimiser steps of the whole run."""
    seconds: float
    """Of this process, from start to end."""
    held_out: dict[str, float] = field(default_factory=dict)
    """Held-out figures of the averaged weights at the end."""


@dataclass(frozen=True)
class _Phase:
    """A part of a stage with batches of its own; its name stands in the rows of metrics.jsonl."""

    name: str
    batches: Callable[[int], Iterator[Any]]
    """Batches from a step on."""
    ends: Callable[[dict[str, float], int], bool]
    """Whether it is over, by held-out figures and the steps it has had."""


def run_paper(config: PaperConfig) -> PaperSummary:
    """Run a stage as configured.

    Raises:
        InputError: the configuration, the data or the weights cannot be used, or the folder holds another run or something else.
    """
    device = device_of(config.device)
    rank, world = join_processes(device)
    if config.default("batch") % world:
        raise input_error("batch", got=config.default("batch"), expected=f"a multiple of the {world} processes")
    if config.threads:
        torch.set_num_threads(config.threads)
    with run_folder(config.out) if rank == 0 else nullcontext():
        stage = {"imagenet": _pictures, "viewpoint": _pictures, "vae": _shapes, "single": _scenes, "multi": _scenes}[config.stage]
        started = time.perf_counter()
        summary = stage(config, device, rank, world)
        summary.seconds = time.perf_counter() - started
    if world > 1:
        distributed.barrier()
        distributed.destroy_process_group()
    return summary


def _loop(
    config: PaperConfig,
    run: StageRun | PictureRun,
    phases: list[_Phase],
    steps: int,
    device: torch.device,
    rank: int,
    evaluate: Callable[[Any, _Phase], dict[str, float]],
) -> None:
    """Make the steps of a stage, phase by phase, from its checkpoint on."""
    logger = TrainingLogger(config, rank)
    number, tensors, at_step = logger.resume(run.model, phases)
    begun = int(logger.resumed.get("begun", 0))
    if tensors is not None:
        optimisation.restore(run.state, tensors, at_step)
    start, waited = time.perf_counter(), 0.0
    bar = progress_bar(None, config.stage, "step", total=steps, done=at_step, shown=not rank)
    with bar:
        while number < len(phases) and run.state.step < steps:
            phase = phases[number]
            with prefetch(each_pinned(phase.batches(run.state.step), device), depth=config.prefetch) as batches:
                over = False
                while run.state.step < steps and not over:
                    before = time.perf_counter()
                    batch = placed(next(batches), device, non_blocking=True)
                    waited += time.perf_counter() - before
                    info = run.step(batch)
                    bar.update()
                    at = run.state.step
                    if at % config.log_every == 0 or at == steps:
                        logger.log(phase.name, info, _size(batch), time.perf_counter() - start, waited)
                    figures: dict[str, float] = {}
                    if at % config.evaluate_every == 0 and at < steps:
                        figures = evaluate(run.averaged(), phase) if rank == 0 else {}
                        figures = _told(figures, device)
                        if rank == 0:
                            logger.write({"stage": phase.name, "step": at, **figures})
                    over = number + 1 < len(phases) and phase.ends(figures, at - begun)
                    if over:
                        number, begun = number + 1, at
                    if (over or at % config.checkpoint_every == 0) and at < steps:
                        logger.checkpoint(number, run, {"begun": begun})
    run.load_ema()
    logger.checkpoint(number, run, {"begun": begun})
    logger.close()


def _size(batch: Any) -> int:
    """Pictures, scenes or shapes of a batch."""
    return len(batch.image) if hasattr(batch, "image") else len(batch.voxels)


def _told(figures: dict[str, float], device: torch.device) -> dict[str, float]:
    """What the first process measured, known to all: they must end a phase together."""
    if not (distributed.is_available() and distributed.is_initialized()):
        return figures
    box: list[Any] = [figures]
    distributed.broadcast_object_list(box, src=0, device=device if device.type == "cuda" else None)
    return box[0]


def _optimizer(config: PaperConfig, steps: int, **changes: Any) -> OptimizerConfig:
    own = {"warmup": min(100, steps), "ema": 0.998, "optimizer": config.default("optimizer"), **changes}
    return OptimizerConfig(steps, config.default("learning_rate"), **own)


def _pictures(config: PaperConfig, device: torch.device, rank: int, world: int) -> PaperSummary:
    """Classes of ImageNet, or viewpoints of Render for CNN."""
    train, held_out, labels = open_pictures(config)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        model = PictureClassifier(len(labels), config.stage == "viewpoint", config.width)
    if config.core is not None:
        adopt_core(model.core, config.core)
    model.to(device)
    if config.compile:
        model.core.compile()
    steps = config.steps_of(len(train))
    run = PictureRun(model, _optimizer(config, steps), config.bf16)
    phase = _Phase(config.stage, lambda start: picture_batches(config, train, start, rank, world), lambda *_: False)

    def evaluate(averaged: PictureClassifier, _: _Phase) -> dict[str, float]:
        return validate_pictures(averaged, config, held_out, device)

    _loop(config, run, [phase], steps, device, rank, evaluate)
    file = config.out / CORE
    figures: dict[str, float] = {}
    if rank == 0:
        figures = evaluate(run.averaged(), phase)
        meta = {"stage": config.stage, "width": config.width, "held_out": figures, "labels": len(labels)}
        save_tensors(file, model.core.state_dict(), meta)
    return PaperSummary(file, steps, 0.0, figures)


def adopt_core(core: nn.Module, path: Path) -> None:
    """Give an encoder core the weights of a run on pictures.

    Raises:
        InputError: no such file, or a core of another width (names the file).
    """
    file = path / CORE if path.is_dir() else path
    tensors, _ = load_tensors(file)
    check_tensors(core.state_dict(), tensors, file)
    core.load_state_dict(tensors)


def _shapes(config: PaperConfig, device: torch.device, rank: int, world: int) -> PaperSummary:
    """The 3D autoencoder: decoder, prior and 3D encoder on the official split of ModelNet."""
    if world > 1 and rank > 0:
        distributed.barrier()  # the first process fills the meshes
    side = config.model(config.categories).voxel_size
    packed, label, classes = modelnet_voxels(config.data, config.cache, "train", side, config.workers)
    test, test_label, _ = modelnet_voxels(config.data, config.cache, "test", side, config.workers, classes)
    if world > 1 and rank == 0:
        distributed.barrier()
    table = ShapeTable(np.arange(len(packed)), packed, label)
    model = Nolbo.from_seed(config.model(classes), config.seed).to(device)
    if config.compile:
        compile_networks(model)
    steps, batch = config.steps_of(len(packed)), config.default("batch")
    weights = {**SHAPE_STAGE, **config.weights}
    stage = TrainingStage("shapes", _optimizer(config, steps, warmup=min(50, steps), clip=5000.0, ema=0.99), weights)
    part = slice(rank * batch // world, (rank + 1) * batch // world)

    def batches(start: int) -> Iterator[Any]:
        step = start
        while True:
            yield table.batch(batch, config.seed, step, config.latent_dim, part)
            step += 1

    def evaluate(averaged: Nolbo, _: _Phase) -> dict[str, float]:
        return shape_figures(averaged, test[: config.evaluate_pictures], test_label[: config.evaluate_pictures])

    run = StageRun(model, stage, config.bf16)
    phase = _Phase("shapes", batches, lambda *_: False)
    _loop(config, run, [phase], steps, device, rank, evaluate)
    return _finished(config, model, steps, rank, lambda: evaluate(model, phase), None)


@torch.no_grad()
def shape_figures(model: Nolbo, packed: np.ndarray, label: np.ndarray) -> dict[str, float]:
    """Of held-out shapes: `voxel_iou` of what their own latent decodes to, and `category`, the share whose likeliest prior mean
    is that of their own category."""
    model.eval()
    device, side = next(model.parameters()).device, model.config.voxel_size
    mean = model.story.prior.category_mean()
    iou, right = [], []
    for first in range(0, len(packed), 64):
        bits = packed[first : first + 64]
        loc, _ = model.shape_guide.posterior(torch.from_numpy(bits).to(device))
        decoded = torch.sigmoid(model.story.decoder(loc)).float().cpu().numpy()
        truth = unpack_voxels(bits, side)
        solid = truth.any(axis=(1, 2, 3))
        iou.append(voxel_iou(decoded[solid], truth[solid]))
        nearest = (loc[:, None, : mean.shape[1]] - mean).square().sum(-1).argmin(-1)
        right.append(nearest.cpu().numpy() == label[first : first + 64])
    return {"voxel_iou": float(np.concatenate(iou).mean()), "category": float(np.concatenate(right).mean())}


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


def _scenes(config: PaperConfig, device: torch.device, rank: int, world: int) -> PaperSummary:
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
        stage = TrainingStage("single", _optimizer(config, steps, decay=0.2), weights, decode=config.decode)
    else:
        hold = min(epoch, steps)
        optimizer = _optimizer(
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

    phases = [_Phase(f"{config.stage}-{max(c)}" if len(c) == 1 else config.stage, batches_of(c), ends) for c in sizes]
    chosen_of = {phase.name: chosen for phase, chosen in zip(phases, sizes)}

    def evaluate(averaged: Nolbo, phase: _Phase) -> dict[str, float]:
        chosen = chosen_of[phase.name]
        return {**validate(averaged, held_out_batches(chosen)), **voxel_precision(averaged, held_out_batches(chosen))}

    run = StageRun(model, stage, config.bf16)
    _loop(config, run, phases, steps, device, rank, evaluate)
    return _finished(config, model, steps, rank, lambda: evaluate(model, phases[-1]), lambda: held_out_batches(sizes[-1]))


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


def _finished(
    config: PaperConfig,
    model: Nolbo,
    steps: int,
    rank: int,
    evaluate: Callable[[], dict[str, float]],
    held_out: Callable[[], Iterator[SceneBatch]] | None,
) -> PaperSummary:
    """Write the model with its card."""
    folder, figures = config.out / "model", {}
    if rank == 0:
        model.eval().set_half_precision(False)
        figures = evaluate()
        calibration = Calibration()
        if held_out is not None:
            with suppress(TooFewObjects):
                calibration = calibrate(model, held_out())
        meta = {
            "calibrated": calibration != Calibration(),
            "training": config.to_json(),
            "held_out": figures,
            "versions": {"nolbo_ppl": __version__, "torch": torch.__version__},
        }
        save(folder, model, calibration, meta)
        default = PaperConfig(config.stage, Path(), Path(), initial=config.initial).to_json()
        default = {name: value for name, value in default.items() if name not in ("stage", "data", "out", "initial")}
        write_card(folder, model.config, meta, sum(p.numel() for p in model.parameters()), default)
    return PaperSummary(folder, steps, 0.0, figures)
