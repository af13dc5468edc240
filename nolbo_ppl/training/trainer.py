"""Training: stochastic variational inference in stages, from shapes to single objects to scenes.

Stages (NOLBO, training details; docs/training.md): the shape autoencoder (decoder, prior networks, 3D encoder); the
guide on images of one object; the guide on scenes, decoder and prior frozen. Every batch is a function of the seed and
the step, checkpoints hold all that a step changes, and a killed run goes on exactly where its last checkpoint stands.
Started by `torchrun`, several processes or machines share each batch.
"""

from __future__ import annotations

import os
import time
from contextlib import nullcontext, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
import torch.distributed as distributed

from nolbo_ppl._version import __version__
from nolbo_ppl.data.converters.photographs import read_photographs
from nolbo_ppl.data.loader import prefetch
from nolbo_ppl.devices import device_of, placed
from nolbo_ppl.inference import svi as optimisation
from nolbo_ppl.inference.posterior.model_folder import load, save
from nolbo_ppl.io.files import read_json_object, write_json
from nolbo_ppl.io.images import images_of, open_image
from nolbo_ppl.io.tensors import load_tensors, save_tensors
from nolbo_ppl.models.hybrid_guide import HybridGuide
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.posterior_calibration import Calibration
from nolbo_ppl.models.scene_batch import SceneBatch
from nolbo_ppl.progress import progress_bar
from nolbo_ppl.training.calibrate import TooFewObjects, calibrate
from nolbo_ppl.training.domain_fit import contexts_of, fit_domain, learn_sizes
from nolbo_ppl.training.evidence_fit import EvidenceTable, fit_fusion, gather_table, join_tables, table_of, table_tensors
from nolbo_ppl.training.initial_weights import adopt, adopt_detection, adopt_features
from nolbo_ppl.training.model_card import write_card
from nolbo_ppl.training.net2net import grow
from nolbo_ppl.training.photograph_fit import PARTS, PhotographFit, adopt_fit, find_objects, fit_found
from nolbo_ppl.training.stage_data import TrainingData
from nolbo_ppl.training.stages import JOINT, StageRun
from nolbo_ppl.training.train_config import TrainConfig as TrainConfig
from nolbo_ppl.training.training_log import TrainingLogger, run_folder
from nolbo_ppl.training.validation import validate

DOMAIN_IMAGES = 300
"""Images of each data set, at most, that teach what tells photographs from generated scenes, and how unlike an image is."""


@dataclass
class TrainSummary:
    """What a run reports."""

    out: Path
    """Folder of the model."""
    steps: int
    """Optimiser steps made, over all stages."""
    seconds: float
    """Of this process, from start to end."""
    waiting: float
    """Share of the stages' time spent waiting for data."""
    held_out: dict[str, float] = field(default_factory=dict)
    """Held-out figures of the averaged weights at the end."""


def run(config: TrainConfig) -> TrainSummary:
    """Train as configured; returns when the model is written.

    Networks and batches are on the configured device; scenes are rendered, read and augmented on the CPU meanwhile.

    Raises:
        InputError: the configuration or the data cannot be used, or the folder holds a run of another configuration or
            something else, or another process writes into it.
    """
    device = device_of(config.device)
    rank, world = join_processes(device)
    with run_folder(config.out) if rank == 0 else nullcontext():
        return _run(config, rank, world, device)


def _run(config: TrainConfig, rank: int, world: int, device: torch.device) -> TrainSummary:
    started = time.perf_counter()
    if config.threads:
        torch.set_num_threads(config.threads)
    data = TrainingData(config, rank, world, device)
    model = Nolbo.from_seed(data.model, config.seed)
    given = Calibration()
    if config.start is not None:
        loaded = load(config.start, "cpu")
        initial, given = loaded.model, loaded.calibration
        if config.grow:
            initial = grow(initial, model.config, config.seed)
        if config.initial_part == "all":
            adopt(model, initial, config.detector)
        else:
            (adopt_features if config.initial_part == "features" else adopt_detection)(model, initial)
    model.to(device)
    if config.compile:
        compile_networks(model)
    training_logger = TrainingLogger(config, rank)
    stages = config.stages()
    first, tensors, at_step = training_logger.resume(model, stages)
    waited = busy = 0.0
    for number, stage in enumerate(stages):
        if number < first:
            continue
        if stage.name != "shapes":
            data.encode_shapes(model)
        stage_run = StageRun(model, stage, config.bf16, config.average_every)
        if number == first and tensors is not None:
            optimisation.restore(stage_run.state, tensors, at_step)
        w, b = _train_stage(stage_run, number, data, training_logger, config)
        waited, busy = waited + w, busy + b
        stage_run.load_ema()
        training_logger.checkpoint(number + 1, model)
    summary = TrainSummary(
        config.out / "model",
        sum(stage.optimisation.steps for stage in stages),
        0.0,
        waited / max(waited + busy, 1e-9),
    )
    if rank == 0:
        model.set_half_precision(False)
        detects = bool(model.config.detector) and config.learn == "all"
        weighed = weigh_evidence(model, data, config) if detects else {}
        photographs = fit_photographs(model, config) if detects else {}
        calibration = Calibration()
        if any(stage.name != "shapes" for stage in stages):
            data.encode_shapes(model)
            summary.held_out = validate(model, data.validation(config.evaluate_scenes))
            with suppress(TooFewObjects):  # a small folder of a user's own: the scales stay as they were learnt
                calibration = calibrate(model, data.validation(None))
            if photographs:  # fitted within the evidence, for photographs and generated scenes apart
                calibration = replace(calibration, objectness_slope=1.0, objectness_shift=0.0, label_slope=1.0)
            if config.learn == "shape_look":  # all other answers are those of the initial weights
                shapes = {name: getattr(calibration, name) for name in ("shape_scale", "shape_correlation")}
                calibration = replace(given, **shapes) if calibration != Calibration() else given
        summary.seconds = time.perf_counter() - started
        meta = {
            "calibrated": calibration != Calibration(),
            "training": config.to_json(),
            "held_out": {**summary.held_out, **weighed},
            "photographs": photographs,
            "versions": {"nolbo_ppl": __version__, "torch": torch.__version__},
        }
        save(config.out / "model", model, calibration, meta)
        defaults = {name: value for name, value in TrainConfig().to_json().items() if name != "out"}
        write_card(config.out / "model", model.config, meta, sum(p.numel() for p in model.parameters()), defaults)
        training_logger.close()
    if world > 1:
        distributed.barrier()
        distributed.destroy_process_group()
    return summary


def weigh_evidence(model: Nolbo, data: TrainingData, config: TrainConfig) -> dict[str, float]:
    """The last stage of a model with a detector (`nolbo_ppl.training.evidence_fit`); returns held-out terms."""
    guide = model.eval().guide
    assert isinstance(guide, HybridGuide)

    def gathered(held_out: bool) -> EvidenceTable:
        file = config.out / f"evidence_{'held_out' if held_out else 'train'}.safetensors"
        if file.is_file():  # a run that is resumed need not gather again
            return table_of(load_tensors(file)[0])
        batches = progress_bar(data.plain(held_out, config.evidence_scenes), "evidence", "batch")
        table = join_tables(gather_table(guide, placed(batch, data.device)) for batch in batches)
        save_tensors(file, table_tensors(table), {})
        return table

    train, held_out = gathered(False), gathered(True)
    kinds = [data.plain_generated(held, config.evidence_scenes) for held in (False, True)]
    terms = fit_fusion(model, train, held_out, (kinds[0], kinds[1]), config.seed)  # on the CPU
    images = progress_bar(data.plain_images(DOMAIN_IMAGES), "domains", "image")
    context, generated = contexts_of(guide, images), data.plain_generated(False, DOMAIN_IMAGES)
    if config.unlabelled is not None:
        images = (open_image(path) for path in sorted(images_of(config.unlabelled, recursive=True)))
        more = contexts_of(guide, progress_bar(images, "unlabelled", "image"))
        context, generated = torch.cat((context, more)), torch.cat((generated, torch.zeros(len(more), dtype=torch.bool)))
    mixed = torch.randperm(len(context), generator=torch.Generator().manual_seed(config.seed))  # held-out ones of every source
    figures = fit_domain(guide, context[mixed].to(data.device), generated[mixed].to(data.device))
    learn_sizes(guide, model.config.categories, config.seed)
    return {**{f"evidence/{name}": value for name, value in terms.items()}, **figures}


def fit_photographs(model: Nolbo, config: TrainConfig) -> dict[str, Any]:
    """Fit how the detector's evidence is read on photographs (`nolbo_ppl.training.photograph_fit`), for the model's card.

    Nothing is fitted without labelled photographs, or where they hold too few objects.
    """
    if config.photographs is None:
        return {}
    labelled = read_photographs(config.photographs, categories=model.config.categories)
    photos, others = labelled[::PARTS], labelled[PARTS - 1 :: PARTS] or labelled[::PARTS]
    made_of = {"file": str(config.photographs), "photographs": len(photos), "others": len(others), "every": PARTS}
    file = config.out / "photographs.json"
    if file.is_file():
        stored = read_json_object(file)
        if stored.get("made_of") == made_of:  # a run that is resumed need not look at them again
            adopt_fit(model, PhotographFit(**stored["fit"]))
            return stored["fit"]
    fit = fit_found(find_objects(model, photos), photos, find_objects(model, others), others)
    if fit is None:
        return {}
    adopt_fit(model, fit)
    write_json(file, {"made_of": made_of, "fit": asdict(fit)})
    return asdict(fit)


def _train_stage(
    stage_run: StageRun, number: int, data: TrainingData, training_logger: TrainingLogger, config: TrainConfig
) -> tuple[float, float]:
    """Make the steps of a stage; returns the seconds waited for data and those spent on everything else."""
    name, steps = stage_run.stage.name, stage_run.stage.optimisation.steps
    waited, start = 0.0, time.perf_counter()
    batches = data.batches(name, stage_run.state.step)
    bar = progress_bar(None, name, "step", total=steps, done=stage_run.state.step, shown=not training_logger.rank)
    with bar, batches if isinstance(batches, prefetch) else nullcontext():
        while not stage_run.finished:
            before = time.perf_counter()
            batch = placed(next(batches), data.device, non_blocking=True)
            waited += time.perf_counter() - before
            info = stage_run.step(batch)
            bar.update()
            at = stage_run.state.step
            if at % config.log_every == 0 or at == steps:
                scenes = len(batch.image) if isinstance(batch, SceneBatch) else len(batch.voxels)
                training_logger.log(name, info, scenes, time.perf_counter() - start, waited)
                bar.set_postfix(loss=f"{info.loss:.3f}")
            if name != "shapes" and at % config.evaluate_every == 0 and at < steps and training_logger.rank == 0:
                averaged = stage_run.averaged()
                if name == JOINT:
                    data.encode_shapes(averaged)
                figures = validate(averaged, data.validation(config.evaluate_scenes))
                training_logger.write({"stage": name, "step": at, **figures})
            if at % config.checkpoint_every == 0 and at < steps:
                training_logger.checkpoint(number, stage_run)
    return waited, time.perf_counter() - start - waited


def compile_networks(model: Nolbo) -> None:
    """Let torch compile the encoder and the decoder, each anew for every shape of its input; weights keep their names."""
    for part in (model.guide.encoder, model.story.decoder.layers):
        part.compile()


def join_processes(device: torch.device) -> tuple[int, int]:
    """Rank and number of processes; joins the group when `torchrun` started several: NCCL on CUDA devices, else Gloo."""
    if device.type == "cuda":
        torch.cuda.set_device(device)
    world = int(os.environ.get("WORLD_SIZE", "1"))
    if world > 1 and not distributed.is_initialized():
        distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    return (distributed.get_rank(), world) if world > 1 else (0, 1)
