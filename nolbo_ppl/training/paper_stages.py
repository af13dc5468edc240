"""The paper's training programme: encoder core, decoder and prior, single objects, whole scenes (NOLBO, training details).

Every stage is a run: its batches are functions of seed and step, its checkpoint holds all a step changes, and a killed run goes
on where that stands (`nolbo_ppl.training.paper_loop`). Phases of the single-object stage are numbered in the checkpoint: they
end at an accuracy.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from typing import Any

import numpy as np
import torch
import torch.distributed as distributed

from nolbo_ppl.data.modelnet import modelnet_voxels
from nolbo_ppl.devices import device_of
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.voxels import unpack_voxels
from nolbo_ppl.inference.elbo import SHAPE_STAGE
from nolbo_ppl.io.tensors import save_tensors
from nolbo_ppl.metrics.voxel import voxel_iou
from nolbo_ppl.models.classifiers import PictureClassifier
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.training.paper_config import PaperConfig
from nolbo_ppl.training.paper_loop import CORE, PaperSummary, Phase, adopt_core, finished, optimizer_of, run_phases
from nolbo_ppl.training.picture_stages import PictureRun, open_pictures, picture_batches, validate_pictures
from nolbo_ppl.training.scene_loader import ShapeTable
from nolbo_ppl.training.scene_stages import scenes_stage
from nolbo_ppl.training.stages import StageRun, TrainingStage
from nolbo_ppl.training.trainer import compile_networks, join_processes
from nolbo_ppl.training.training_log import run_folder


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
        started = time.perf_counter()
        summary = STAGES[config.stage](config, device, rank, world)
        summary.seconds = time.perf_counter() - started
    if world > 1:
        distributed.barrier()
        distributed.destroy_process_group()
    return summary


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
    run = PictureRun(model, optimizer_of(config, steps), config.bf16)
    phase = Phase(config.stage, lambda start: picture_batches(config, train, start, rank, world), lambda *_: False)

    def evaluate(averaged: PictureClassifier, _: Phase) -> dict[str, float]:
        return validate_pictures(averaged, config, held_out, device)

    run_phases(config, run, [phase], steps, device, rank, evaluate)
    file = config.out / CORE
    figures: dict[str, float] = {}
    if rank == 0:
        figures = evaluate(run.averaged(), phase)
        meta = {"stage": config.stage, "width": config.width, "held_out": figures, "labels": len(labels)}
        save_tensors(file, model.core.state_dict(), meta)
    return PaperSummary(file, steps, 0.0, figures)


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
    stage = TrainingStage("shapes", optimizer_of(config, steps, warmup=min(50, steps), clip=5000.0, ema=0.99), weights)
    part = slice(rank * batch // world, (rank + 1) * batch // world)

    def batches(start: int) -> Iterator[Any]:
        step = start
        while True:
            yield table.batch(batch, config.seed, step, config.latent_dim, part)
            step += 1

    def evaluate(averaged: Nolbo, _: Phase) -> dict[str, float]:
        return shape_figures(averaged, test[: config.evaluate_pictures], test_label[: config.evaluate_pictures])

    run = StageRun(model, stage, config.bf16)
    phase = Phase("shapes", batches, lambda *_: False)
    run_phases(config, run, [phase], steps, device, rank, evaluate)
    return finished(config, model, steps, rank, lambda: evaluate(model, phase), None)


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


STAGES: dict[str, Callable[[PaperConfig, torch.device, int, int], PaperSummary]] = {
    "imagenet": _pictures,
    "viewpoint": _pictures,
    "vae": _shapes,
    "single": scenes_stage,
    "multi": scenes_stage,
}
"""The stages by name."""
