"""`nolbo train`: stochastic variational inference in stages, from shapes to single objects to scenes.

Stages (NOLBO, training details; method section 3): the shape autoencoder (decoder, prior networks, 3D encoder); the
guide on images of one object; the guide on scenes, decoder and prior frozen. Every batch is a function of the seed and
the step, checkpoints hold all that a step changes, and a killed run goes on exactly where its last checkpoint stands.
Started by `torchrun`, several processes or machines share each batch.
"""

from __future__ import annotations

import dataclasses
import json
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import torch.distributed as distributed
from tqdm import tqdm

from nolbo_ppl import __version__
from nolbo_ppl.data.augment import Augmentation
from nolbo_ppl.data.cache import CachedScenes, write_cache
from nolbo_ppl.data.folder import SceneFolder
from nolbo_ppl.data.loader import Scenes, prefetch
from nolbo_ppl.data.scene_config import SceneConfig
from nolbo_ppl.data.scene_config import preset as scene_preset
from nolbo_ppl.data.source import SceneSource
from nolbo_ppl.data.supply import Part, SceneSupply, ShapeTable
from nolbo_ppl.errors import input_error
from nolbo_ppl.inference import optimisation
from nolbo_ppl.inference.calibrate import TooFewObjects, calibrate
from nolbo_ppl.inference.checkpoint import load_tensors, save_tensors
from nolbo_ppl.inference.elbo import PURE_BOUND
from nolbo_ppl.inference.monitor import held_out
from nolbo_ppl.inference.optimisation import OptimisationConfig, StepInfo
from nolbo_ppl.inference.stages import Stage, StageRun, scene_weights, seeded_noise
from nolbo_ppl.inference.weights import save
from nolbo_ppl.io import atomic_path, read_jsonl, write_json
from nolbo_ppl.models.calibration import Calibration
from nolbo_ppl.models.config import PRESETS, ModelConfig
from nolbo_ppl.models.nolbo import Nolbo
from nolbo_ppl.models.scene import SceneBatch

DEFAULT_CACHE = Path("~/.cache/nolbo_ppl")
"""Where rendered scenes are kept between runs."""
VALIDATION_SEED = 1000
"""Added to the seed of generated scenes for the held-out ones: other scenes, other shapes."""


@dataclass(frozen=True)
class TrainConfig:
    """Everything a training run depends on."""

    out: Path = Path("runs/tiny")
    """Folder of the run: configuration, metrics.jsonl, checkpoint, and at the end the model."""
    preset: Literal["nano", "tiny", "paper"] = "tiny"
    """Networks: `tiny` for CPUs, `paper` for darknet19 and 64^3 voxels, `nano` for demonstrations."""
    objective: Literal["inclusive", "elbo", "paper"] = "inclusive"
    """What is maximised: the inclusive objective, the pure bound, or the paper's (the bound with objectness turned)."""
    orientation: Literal["mixture", "angle", "sincos"] | None = None
    """Form of the orientation latent; the preset's by default."""
    instance_labels: bool = False
    """Give every instance of `scenes` a label: the latent is split in halves for category and instance."""
    latent_dim: int | None = None
    """Dimensions of the shape latent; the preset's by default."""
    scenes: Path | None = None
    """Folder of a data set written by `nolbo scenes`, or of your own; without it scenes are generated."""
    validation: Path | None = None
    """Folder of held-out scenes; with `scenes` and without this, the last tenth of `scenes` is held out."""
    count: int = 20480
    """Number of generated training scenes."""
    single_count: int = 1024
    """Number of generated scenes with one object, for the second stage."""
    difficulty: Literal["easy", "standard", "full"] = "standard"
    """Difficulty of the generated scenes."""
    backgrounds: Path | None = None
    """Folder of photographs behind the generated scenes."""
    cache: Path = DEFAULT_CACHE
    """Where generated scenes are kept."""
    seed: int = 0
    """Seed of weights, scenes, order, augmentation and noise."""
    shape_steps: int = 1200
    """Steps of the shape autoencoder."""
    single_steps: int = 100
    """Steps on images of one object."""
    scene_steps: int = 6000
    """Steps on scenes."""
    freeze: float = 1.0
    """Share of the scene steps during which decoder and prior networks stay frozen."""
    decode: int = 12
    """Objects decoded a step where the objective has voxels; their term stands for all objects."""
    voxel_weight: float | None = None
    """Weight of the voxel term in the stages on images; by default the objective's own (the inclusive one has none)."""
    batch: int = 64
    """Scenes a step, over all processes."""
    shape_batch: int = 32
    """Shapes a step."""
    learning_rate: float = 2.5e-3
    """Rate of the stages on images after their warm-up."""
    sizes: tuple[int, ...] = ()
    """Image sides to choose from each step, multiples of 32; empty for the preset's own."""
    augment: bool = True
    """Blur, colour, scale and translation at random; never a flip."""
    bf16: bool = True
    """Networks in bfloat16."""
    threads: int = 0
    """Threads of torch; 0 leaves torch's own choice."""
    workers: int = 2
    """Processes that render scenes."""
    log_every: int = 20
    """Steps between rows of metrics.jsonl."""
    evaluate_every: int = 500
    """Steps between looks at the held-out scenes."""
    evaluate_scenes: int = 512
    """Held-out scenes of each look; the calibration at the end uses all."""
    checkpoint_every: int = 100
    """Steps between checkpoints."""
    tensorboard: bool = False
    """Write TensorBoard files into the run's folder too (needs the extra `tensorboard`)."""
    resume: bool = True
    """Go on from the run's checkpoint where there is one; otherwise a folder with a checkpoint is refused."""

    def __post_init__(self) -> None:
        for name in ("batch", "shape_batch", "log_every", "evaluate_every", "checkpoint_every", "count", "workers"):
            if getattr(self, name) < 1:
                raise input_error(name, got=getattr(self, name), expected="at least 1")
        if not 0 <= self.freeze <= 1:
            raise input_error("freeze", got=self.freeze, expected="a share from 0 to 1")
        if any(size % 32 or size <= 0 for size in self.sizes):
            raise input_error("sizes", got=self.sizes, expected="positive multiples of 32")
        if self.instance_labels and self.scenes is None:
            raise input_error("instance labels", got="generated scenes", do="give --scenes with its own instances")
        if self.validation is not None and self.scenes is None:
            raise input_error("held-out scenes without training scenes", do="give --scenes too")

    def model(self) -> ModelConfig:
        """Configuration of the networks."""
        changes: dict[str, Any] = {}
        if self.orientation is not None:
            changes["orientation"] = self.orientation
            changes["azimuth_components"] = 4 if self.orientation == "mixture" else 1
        if self.latent_dim is not None:
            changes["latent_dim"] = self.latent_dim
        return dataclasses.replace(PRESETS[self.preset](), **changes)

    def stages(self) -> list[Stage]:
        """The stages that have steps."""
        weights = scene_weights(self.objective, self.voxel_weight)
        images = OptimisationConfig(learning_rate=self.learning_rate)
        stages = [
            Stage(
                "shapes",
                OptimisationConfig(self.shape_steps, 2e-3, warmup=min(50, self.shape_steps), clip=5000.0, ema=0.99),
                PURE_BOUND,
            ),
            Stage(
                "single",
                dataclasses.replace(images, steps=self.single_steps, decay=0.0, warmup=min(100, self.single_steps)),
                weights,
                freeze=self.single_steps,
            ),
            Stage(
                "scenes",
                dataclasses.replace(images, steps=self.scene_steps, warmup=min(100, self.scene_steps)),
                weights,
                freeze=round(self.freeze * self.scene_steps),
                decode=self.decode if weights.get("voxels") else 0,
            ),
        ]
        return [stage for stage in stages if stage.optimisation.steps > 0]


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

    Raises:
        InputError: the configuration or the data cannot be used, or the folder holds a run of another configuration.
    """
    started = time.perf_counter()
    rank, world = _join()
    if config.threads:
        torch.set_num_threads(config.threads)
    data = _Data(config, rank, world)
    model = Nolbo.from_seed(data.model, config.seed)
    journal = _Journal(config, rank)
    stages = config.stages()
    first, tensors, at_step = journal.resume(model, stages)
    waited = busy = 0.0
    for number, stage in enumerate(stages):
        if number < first:
            continue
        if stage.name != "shapes":
            data.teach(model)
        stage_run = StageRun(model, stage, config.bf16)
        if number == first and tensors is not None:
            optimisation.restore(stage_run.state, tensors, at_step)
        w, b = _train_stage(stage_run, number, data, journal, config)
        waited, busy = waited + w, busy + b
        stage_run.adopt_average()
        journal.checkpoint(number + 1, model)
    summary = TrainSummary(
        config.out / "model",
        sum(stage.optimisation.steps for stage in stages),
        0.0,
        waited / max(waited + busy, 1e-9),
    )
    if rank == 0:
        model.set_half_precision(False)
        calibration = Calibration()
        if any(stage.name != "shapes" for stage in stages):
            data.teach(model)
            summary.held_out = held_out(model, data.validation(config.evaluate_scenes))
            with suppress(TooFewObjects):  # a small folder of a user's own: the scales stay as they were learnt
                calibration = calibrate(model, data.validation(None))
        summary.seconds = time.perf_counter() - started
        meta = {
            "calibrated": calibration != Calibration(),
            "training": _plain(dataclasses.asdict(config)),
            "held_out": summary.held_out,
            "versions": {"nolbo_ppl": __version__, "torch": torch.__version__},
        }
        save(config.out / "model", model, calibration, meta)
        journal.close()
    if world > 1:
        distributed.barrier()
        distributed.destroy_process_group()
    return summary


def _train_stage(
    stage_run: StageRun, number: int, data: _Data, journal: _Journal, config: TrainConfig
) -> tuple[float, float]:
    """Make the steps of a stage; returns the seconds waited for data and those spent on everything else."""
    name, steps = stage_run.stage.name, stage_run.stage.optimisation.steps
    waited, start = 0.0, time.perf_counter()
    batches = data.batches(name, stage_run.state.step)
    quiet = True if journal.rank else None
    bar = tqdm(total=steps, initial=stage_run.state.step, desc=name, unit="step", disable=quiet)
    with bar, batches if isinstance(batches, prefetch) else nullcontext():
        while not stage_run.finished:
            before = time.perf_counter()
            batch = next(batches)
            waited += time.perf_counter() - before
            info = stage_run.step(batch)
            bar.update()
            at = stage_run.state.step
            if at % config.log_every == 0 or at == steps:
                scenes = len(batch.image) if isinstance(batch, SceneBatch) else len(batch.voxels)
                journal.log(name, info, scenes, time.perf_counter() - start, waited)
                bar.set_postfix(loss=f"{info.loss:.3f}")
            if name != "shapes" and at % config.evaluate_every == 0 and at < steps and journal.rank == 0:
                figures = held_out(stage_run.averaged(), data.validation(config.evaluate_scenes))
                journal.write({"stage": name, "step": at, **figures})
            if at % config.checkpoint_every == 0 and at < steps:
                journal.checkpoint(number, stage_run)
    return waited, time.perf_counter() - start - waited


class _Data:
    """The data of all stages: generated and cached, or a folder's."""

    def __init__(self, config: TrainConfig, rank: int, world: int) -> None:
        self.config, self.rank, self.world = config, rank, world
        self.model = config.model()
        size = self.model.image_size
        self.train: Scenes
        self.single: Scenes
        self._held_out: Scenes
        if config.scenes is not None:
            self._open_folders(config.scenes, size)
        else:
            base = scene_preset(config.difficulty, size)
            backgrounds = None if config.backgrounds is None else str(config.backgrounds)
            root = config.cache.expanduser() / "scenes"
            if world > 1 and rank > 0:
                distributed.barrier()  # the first process renders what is missing
            single = dataclasses.replace(base, objects=(1, 1), clutter=(0, 1), object_pixels=(40.0, 0.9))

            def cached(of: SceneConfig, seed: int, count: int) -> CachedScenes:
                return write_cache(root, SceneSource(of, seed, backgrounds=backgrounds), count, config.workers)

            train = cached(base, config.seed, config.count)
            held_out_scenes = cached(base, config.seed + VALIDATION_SEED, max(512, config.evaluate_scenes))
            self.train, self._held_out = train, held_out_scenes
            self.single = self.train
            if config.single_steps:
                self.single = cached(single, config.seed, config.single_count)
            if world > 1 and rank == 0:
                distributed.barrier()
            self.table, self._held_out_table = ShapeTable(*train.shapes()), ShapeTable(*held_out_scenes.shapes())
        if len(self.table) == 0 and config.shape_steps:
            raise input_error("no shapes to learn", got=config.scenes, do="add voxels.npz, or use --shape-steps 0")

    def _open_folders(self, path: Path, size: int) -> None:
        """A user's folder, and a held-out one or its last tenth."""
        folder = SceneFolder(path, self.model.categories, size=size)
        known = 0
        if self.config.instance_labels:
            number, _, category = folder.shapes()
            names = tuple(folder.instances[n] for n in number)
            self.model = dataclasses.replace(
                self.model, instances=names, instance_category=tuple(int(c) for c in category)
            )
            others = tuple(name for name in folder.instances if name not in set(names))
            folder = SceneFolder(path, self.model.categories, names + others, size=size)
            known = len(names)
        self.train = folder
        self.table = ShapeTable(*folder.shapes(), known)
        self.single = folder
        if self.config.validation is None:
            cut = len(folder) - max(1, len(folder) // 10)
            self.train, self._held_out = Part(folder, np.arange(cut)), Part(folder, np.arange(cut, len(folder)))
            self.single, self._held_out_table = self.train, self.table
        else:
            held_out_folder = SceneFolder(self.config.validation, self.model.categories, size=size)
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
            self.single if stage == "single" else self.train, self.table, config.batch,
            3 * config.seed + (1 if stage == "single" else 2), latent,
            Augmentation() if config.augment else None, config.sizes, len(self.model.instances), self.rank, self.world,
        )  # fmt: skip

        def scenes() -> Iterator[SceneBatch]:
            step = start
            while True:
                yield supply.batch(step)
                step += 1

        return prefetch(scenes())

    def validation(self, count: int | None) -> Iterator[SceneBatch]:
        """Held-out batches, without augmentation, with the teacher's latents and the same noise each time."""
        known = len(self.model.instances)
        supply = SceneSupply(self._held_out, self._held_out_table, 64, 0, self.model.latent_dim, known_instances=known)
        total = len(self._held_out) if count is None else min(count, len(self._held_out))
        for first in range(0, total, 64):
            batch = supply.prepared(np.arange(first, min(first + 64, total)))
            yield batch.replace(noise=seeded_noise(0, first, *batch.present.shape, self.model.latent_dim))

    def teach(self, model: Nolbo) -> None:
        """Encode the shapes by the trained shape guide, in full precision."""
        model.set_half_precision(False)
        self.table.teach(model)
        self._held_out_table.teach(model)


class _Journal:
    """metrics.jsonl, checkpoint and configuration of a run; only the first process writes."""

    def __init__(self, config: TrainConfig, rank: int) -> None:
        self.config, self.rank = config, rank
        self.path = config.out / "metrics.jsonl"
        self.file = config.out / "checkpoint.safetensors"
        self._board: Any = None
        if rank == 0:
            config.out.mkdir(parents=True, exist_ok=True)
            if config.tensorboard:
                from torch.utils.tensorboard import SummaryWriter

                self._board = SummaryWriter(str(config.out / "tensorboard"))

    def resume(self, model: Nolbo, stages: Sequence[Stage]) -> tuple[int, dict[str, Any] | None, int]:
        """Stage to go on with, the tensors of its state if it was under way, and its step.

        Raises:
            InputError: there is a checkpoint but resuming is off, or it belongs to another configuration.
        """
        identity = _identity(self.config)
        if not self.file.is_file():
            if self.rank == 0:
                self.path.unlink(missing_ok=True)
                write_json(self.config.out / "config.json", _plain(dataclasses.asdict(self.config)))
            return 0, None, 0
        if not self.config.resume:
            raise input_error("the folder holds a run", got=self.config.out, do="choose another --out, or resume")
        tensors, meta = load_tensors(self.file)
        if meta.get("identity") != identity:
            differing = sorted(k for k in identity if identity[k] != meta.get("identity", {}).get(k))
            raise input_error(
                "the checkpoint belongs to another configuration", got=f"differing fields {differing}",
                file=self.file, do="choose another --out, or repeat the run's own options",
            )
        number, at_step = int(meta["stage"]), int(meta["step"])
        self._cut(number, at_step, stages)
        # The networks too: before a stage goes on, the shape guide in them teaches the latents of all shapes.
        model.load_state_dict(optimisation.module_tensors(tensors) if at_step else tensors)
        return number, tensors if at_step else None, at_step

    def _cut(self, number: int, at_step: int, stages: Sequence[Stage]) -> None:
        """Drop the rows of metrics that were written after the checkpoint: they will be written again."""
        if self.rank or not self.path.is_file():
            return
        order = {stage.name: i for i, stage in enumerate(stages)}
        rows = _complete_rows(self.path)
        kept = [row for row in rows if (order.get(row["stage"], 0), row["step"]) <= (number, at_step)]
        with atomic_path(self.path) as temporary:
            temporary.write_text("".join(json.dumps(row) + "\n" for row in kept), encoding="utf-8")

    def log(self, stage: str, info: StepInfo, scenes: int, seconds: float, waited: float) -> None:
        """One row of the running stage: terms in nats a scene (a shape, in the first stage)."""
        if self.rank:
            return
        terms = {f"terms/{name}": round(value / scenes, 5) for name, value in info.terms.items()}
        row = {
            "stage": stage, "step": info.step + 1, "loss": round(info.loss, 5), **terms,
            "gradient_norm": round(info.gradient_norm, 4), "learning_rate": info.learning_rate,
            "seconds": round(seconds, 2), "waited": round(waited, 3),
        }  # fmt: skip
        self.write(row)

    def write(self, row: dict[str, Any]) -> None:
        """Append a row."""
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        if self._board is not None:
            for key, value in row.items():
                if isinstance(value, float):
                    self._board.add_scalar(f"{row['stage']}/{key}", value, row["step"])

    def checkpoint(self, stage: int, state: StageRun | Nolbo) -> None:
        """Save a stage under way, or the networks between two stages."""
        if self.rank:
            return
        if isinstance(state, StageRun):
            tensors, step = optimisation.state_tensors(state.state), state.state.step
        else:
            tensors, step = state.state_dict(), 0
        save_tensors(self.file, tensors, {"stage": stage, "step": step, "identity": _identity(self.config)})

    def close(self) -> None:
        """Close TensorBoard's files."""
        if self._board is not None:
            self._board.close()


def _complete_rows(path: Path) -> list[dict[str, Any]]:
    """Rows of metrics; the last line may have been cut when the process was killed."""
    *whole, last = path.read_text(encoding="utf-8").split("\n")
    if last:
        with atomic_path(path) as temporary:
            temporary.write_text("".join(line + "\n" for line in whole), encoding="utf-8")
    return [row for _, row in read_jsonl(path)]


_FREE = (
    "out", "cache", "threads", "workers", "log_every", "checkpoint_every", "tensorboard", "resume", "evaluate_every"
)
"""Fields a resumed run may change: they do not touch what is learnt."""


def _identity(config: TrainConfig) -> dict[str, Any]:
    return {key: value for key, value in _plain(dataclasses.asdict(config)).items() if key not in _FREE}


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """Values as JSON keeps them."""
    return json.loads(json.dumps(values, default=str))


def _join() -> tuple[int, int]:
    """Rank and number of processes; joins the group when `torchrun` started several."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    if world > 1 and not distributed.is_initialized():
        distributed.init_process_group("gloo")
    return (distributed.get_rank(), world) if world > 1 else (0, 1)


def main(args: Sequence[str] | None = None) -> None:
    """Parse the command line and train."""
    import sys

    import tyro

    summary = run(tyro.cli(TrainConfig, args=args, prog="nolbo train", description=__doc__))
    sys.stdout.write(json.dumps(_plain(dataclasses.asdict(summary)), indent=2) + "\n")


if __name__ == "__main__":
    main()
