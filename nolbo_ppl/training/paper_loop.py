"""The loop of a stage of the paper's programme: phases, logs, looks at held-out data, checkpoints, the model at its end."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import torch.distributed as distributed
from torch import nn

from nolbo_ppl._version import __version__
from nolbo_ppl.data.loader import prefetch
from nolbo_ppl.devices import each_pinned, placed
from nolbo_ppl.inference import svi as optimisation
from nolbo_ppl.inference.posterior.model_folder import save
from nolbo_ppl.inference.svi import OptimizerConfig
from nolbo_ppl.io.tensors import check_tensors, load_tensors
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.posterior_calibration import Calibration
from nolbo_ppl.models.scene_batch import SceneBatch
from nolbo_ppl.progress import progress_bar
from nolbo_ppl.training.calibrate import TooFewObjects, calibrate
from nolbo_ppl.training.model_card import write_card
from nolbo_ppl.training.paper_config import PaperConfig
from nolbo_ppl.training.picture_stages import PictureRun
from nolbo_ppl.training.stages import StageRun
from nolbo_ppl.training.training_log import TrainingLogger

CORE = "core.safetensors"
"""The encoder core in the folder of a run of a stage on pictures."""


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
class Phase:
    """A part of a stage with batches of its own; its name stands in the rows of metrics.jsonl."""

    name: str
    batches: Callable[[int], Iterator[Any]]
    """Batches from a step on."""
    ends: Callable[[dict[str, float], int], bool]
    """Whether it is over, by held-out figures and the steps it has had."""


def optimizer_of(config: PaperConfig, steps: int, **changes: Any) -> OptimizerConfig:
    """Optimiser and schedule of a stage: its defaults, with changes."""
    own = {"warmup": min(100, steps), "ema": 0.998, "optimizer": config.default("optimizer"), **changes}
    return OptimizerConfig(steps, config.default("learning_rate"), **own)


def run_phases(
    config: PaperConfig,
    run: StageRun | PictureRun,
    phases: list[Phase],
    steps: int,
    device: torch.device,
    rank: int,
    evaluate: Callable[[Any, Phase], dict[str, float]],
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


def adopt_core(core: nn.Module, path: Path) -> None:
    """Give an encoder core the weights of a run on pictures.

    Raises:
        InputError: no such file, or a core of another width (names the file).
    """
    file = path / CORE if path.is_dir() else path
    tensors, _ = load_tensors(file)
    check_tensors(core.state_dict(), tensors, file)
    core.load_state_dict(tensors)


def finished(
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
