"""What each part of the recipe is worth: variants of training at equal compute, measured on the same unseen scenes.

    OMP_NUM_THREADS=1 python benchmarks/ablations.py --out ablations --seconds 1800

Every variant changes one thing of the default recipe. With `--seconds` it gets as many steps as that many CPU-seconds of
training pay for at its own measured cost of a step (rendering, shared between variants through the cache, is not counted);
with `--seconds 0` every variant makes the given steps. A stopped run goes on where it was: variants that are measured are
not trained again, and one under way continues from its checkpoint. `table.md` and `results.json` are rewritten after every
variant.
"""

from __future__ import annotations

import math
import platform
import statistics
import time
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

from nolbo_ppl import __version__
from nolbo_ppl.cli import evaluate
from nolbo_ppl.cli.evaluate import EvaluateConfig
from nolbo_ppl.cli.train import TrainConfig, run
from nolbo_ppl.data.loader import prefetch
from nolbo_ppl.errors import input_error
from nolbo_ppl.inference.elbo import INCLUSIVE
from nolbo_ppl.io.files import atomic_path, read_json, write_json
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.synthetic.dataset_writer import write_scenes
from nolbo_ppl.synthetic.scenes.scene_config import preset as scene_preset
from nolbo_ppl.synthetic.scenes.scene_config import rendered_size
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator
from nolbo_ppl.training.stage_data import TrainingData
from nolbo_ppl.training.stages import StageRun

SHARES = {"shapes": 0.25, "single": 0.02, "scenes": 0.73}
"""Shares of the seconds that the stages get; a variant without a stage gives its share to the scenes."""
PROBE_STEPS = 12
"""Steps behind the measured cost of a step; the first third warms up."""
FIGURES = (
    "ap50",
    "map50",
    "category_accuracy",
    "acc_pi6",
    "med_err_deg",
    "azimuth_log_score",
    "voxel_iou_gain",
    "retrieval_recall1",
    "ece_class",
    "coverage90_orientation",
    "coverage90_latent",
)
"""Columns of the table."""


@dataclass(frozen=True)
class Variant:
    """One change of the default recipe."""

    question: str
    """What it is compared for: variants of one question stand together."""
    words: str
    """What is different."""
    training: dict[str, Any] = field(default_factory=dict)
    """Fields of `TrainConfig`."""
    networks: dict[str, Any] = field(default_factory=dict)
    """Fields of `ModelConfig`."""
    folder: bool = False
    """Trained on a data set whose instances recur and have names."""


OWN_SHAPES = {"shape_inclusive": 0.0, "shape_kl": 1.0, "voxels": 0.003}
"""Without a shape autoencoder there is no latent of the true shape to follow: the bound's own terms teach the shape. Voxel
terms are thousands of nats an object and drown every other head at full weight."""

VARIANTS = {
    "default": Variant("default", "inclusive objective, every stage, mixture of azimuths, 16 dimensions, second look"),
    "elbo": Variant("objective", "the pure bound", {"objective": "elbo"}),
    "elbo-light-voxels": Variant("objective", "the bound, voxels at 0.003", {"objective": "elbo", "weights": {"voxels": 0.003}}),
    "paper": Variant(
        "objective", "the bound, objectness turned, voxels at 0.003", {"objective": "paper", "weights": {"voxels": 0.003}}
    ),
    "no-shapes": Variant(
        "shape pretraining", "none: shapes learnt with everything else", {"shape_steps": 0, "freeze": 0.0, "weights": OWN_SHAPES}
    ),
    "no-single": Variant("single objects", "no stage of single objects", {"single_steps": 0}),
    "no-label-term": Variant("auxiliary terms", "no term of the category head", {"weights": {"label_inclusive": 0.0}}),
    "equal-weights": Variant("auxiliary terms", "every inclusive term at weight 1", {"weights": dict.fromkeys(INCLUSIVE, 1.0)}),
    "size-96": Variant("image size", "96 px", networks={"image_size": 96}),
    "size-192": Variant("image size", "192 px", networks={"image_size": 192}),
    "angle": Variant("orientation", "one wrapped normal an angle", {"orientation": "angle"}),
    "sincos": Variant("orientation", "factorised Gaussian on (sin, cos)", {"orientation": "sincos"}),
    "latent-128": Variant("latent", "128 dimensions", {"latent_dim": 128}),
    "adamw": Variant("optimiser", "AdamW throughout", {"optimizer": "adamw"}),
    "no-glimpse": Variant("second look", "none", networks={"glimpse": 0}),
    "deep-glimpse": Variant(
        "second look",
        "three maps, a residual block, details",
        networks={"glimpse_maps": 3, "glimpse_blocks": 1, "glimpse_detail": True},
    ),
    "category-prior": Variant("prior", "named instances, category prior only", folder=True),
    "instance-prior": Variant("prior", "named instances, category and instance prior", {"instance_labels": True}, folder=True),
}
"""All variants by name."""


@dataclass(frozen=True)
class Settings:
    """What to train and how long."""

    out: Path
    """Folder of the runs, results.json and table.md."""
    only: tuple[str, ...] = ()
    """Names of variants; all by default."""
    seconds: float = 1800.0
    """CPU-seconds of training for each variant; 0 to count steps instead."""
    steps: tuple[int, int, int] = (1200, 60, 4000)
    """Steps of the shapes, single objects and scenes, with `--seconds 0`."""
    preset: Literal["nano", "tiny"] = "tiny"
    """Networks of every variant."""
    image_size: int = 128
    """Side in px of the images the networks look at, where a variant does not change it: smaller than the preset's, so that
    a small budget pays for enough steps."""
    difficulty: Literal["easy", "standard", "full"] = "standard"
    """Scenes of training and evaluation."""
    count: int = 16384
    """Training scenes."""
    single_count: int = 1024
    """Training scenes of one object."""
    instances: int = 40
    """Instances a category of the data set with named instances."""
    seed: int = 0
    """Seed of every run."""
    evaluated: int = 500
    """Unseen scenes of the evaluation."""
    gallery: int = 50
    """Instances of a category in the retrieval; 0 leaves it out."""
    cache: Path = Path("~/.cache/nolbo_ppl")
    """Where rendered scenes are kept."""
    batch: int = 64
    """Scenes a step."""
    threads: int = 1
    """Threads of torch."""
    workers: int = 2
    """Processes that render."""


@dataclass(frozen=True)
class AblationConfig(TrainConfig):
    """A training run whose networks depart from the preset's."""

    networks: dict[str, Any] = field(default_factory=dict)
    """Fields of `ModelConfig` in place of the preset's."""

    def model(self) -> ModelConfig:
        """Configuration of the networks."""
        return replace(super().model(), **self.networks)


def training_config(name: str, settings: Settings) -> AblationConfig:
    """The run of a variant, at the steps of the settings."""
    variant = VARIANTS[name]
    shapes, single, scenes = settings.steps
    config = AblationConfig(
        out=settings.out / name / "run",
        preset=settings.preset,
        difficulty=settings.difficulty,
        count=settings.count,
        single_count=settings.single_count,
        cache=settings.cache,
        seed=settings.seed,
        shape_steps=shapes,
        single_steps=single,
        scene_steps=scenes,
        batch=settings.batch,
        threads=settings.threads,
        workers=settings.workers,
        networks={"image_size": settings.image_size, **variant.networks},
        scenes=named_instances(settings) if variant.folder else None,
    )
    return replace(config, **variant.training)


def named_instances(settings: Settings) -> Path:
    """Folder of a data set in which each of a few instances is seen many times."""
    folder = settings.out / "named_instances"
    if not (folder / "scenes.jsonl").is_file():
        source = SceneGenerator(scene_preset(settings.difficulty), seed=settings.seed, instances=settings.instances)
        write_scenes(folder, source, settings.count, settings.workers)
    return folder


def seconds_a_step(config: TrainConfig) -> dict[str, float]:
    """CPU-seconds of a step of each stage, data preparation in this process included, rendering left out."""
    data = TrainingData(config, 0, 1)
    model = Nolbo.from_seed(data.model, config.seed)
    costs = {}
    for stage in config.stages():
        if stage.name != "shapes":
            data.encode_shapes(model)
        stage_run, taken = StageRun(model, stage, config.bf16), []
        batches = data.batches(stage.name, 0)
        with batches if isinstance(batches, prefetch) else nullcontext():
            for _ in range(PROBE_STEPS):
                start = time.process_time()
                stage_run.step(next(batches))
                taken.append(time.process_time() - start)
        costs[stage.name] = statistics.fmean(taken[PROBE_STEPS // 3 :])
    return costs


def steps_for(seconds: float, costs: dict[str, float]) -> dict[str, int]:
    """Steps of each stage that the seconds pay for; what a missing stage would take goes to the scenes."""
    shares = {name: share for name, share in SHARES.items() if name in costs}
    shares["scenes"] = 1 - sum(share for name, share in shares.items() if name != "scenes")
    return {name: max(1, round(seconds * share / costs[name])) for name, share in shares.items()}


def planned(name: str, settings: Settings) -> tuple[AblationConfig, dict[str, Any]]:
    """The run of a variant with its steps; they are decided once, so that a stopped run goes on with the same."""
    config, file = training_config(name, settings), settings.out / name / "plan.json"
    if settings.seconds <= 0:
        return config, {"steps": {stage.name: stage.optimisation.steps for stage in config.stages()}}
    if not file.is_file():
        torch.set_num_threads(settings.threads)
        costs = seconds_a_step(config)
        write_json(file, {"seconds": settings.seconds, "seconds_a_step": costs, "steps": steps_for(settings.seconds, costs)})
    plan = read_json(file)
    if plan["seconds"] != settings.seconds:
        raise input_error(
            "another budget than before",
            got=settings.seconds,
            expected=plan["seconds"],
            file=file,
            do="choose another --out",
        )
    steps = {
        f"{'shape' if key == 'shapes' else 'single' if key == 'single' else 'scene'}_steps": value
        for key, value in plan["steps"].items()
    }
    return replace(config, **steps), plan


def measured(name: str, settings: Settings) -> dict[str, Any]:
    """Train and evaluate a variant, unless that was done before."""
    file = settings.out / name / "result.json"
    if file.is_file():
        return read_json(file)
    config, plan = planned(name, settings)
    start = time.process_time()
    summary = run(config)
    size = rendered_size(config.model().image_size)
    evaluation = EvaluateConfig(
        out=settings.out / name / "figures",
        model=str(summary.out),
        count=settings.evaluated,
        difficulty=settings.difficulty,
        retrieval=settings.gallery > 0,
        gallery=max(settings.gallery, 2),
        least_side=12.0 * size / 128,
        pictures=False,
    )
    trained = time.process_time() - start
    evaluate.run(evaluation)
    values = read_json(evaluation.out / "metrics.json")
    result = {
        "variant": name,
        "question": VARIANTS[name].question,
        "words": VARIANTS[name].words,
        **plan,
        "cpu_seconds_of_this_run": round(trained, 1),
        "figures": {figure: values.get(figure) for figure in FIGURES},
        "intervals": {figure: values["intervals"].get(figure) for figure in FIGURES},
    }
    write_json(file, result)
    return result


def markdown(results: list[dict[str, Any]]) -> str:
    """The table: a row a variant, intervals in brackets."""
    head = ["question", "variant", "steps", *(figure.replace("_", " ") for figure in FIGURES)]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for result in results:
        steps = " + ".join(str(value) for value in result["steps"].values())
        cells = [result["question"], f"{result['variant']}: {result['words']}", steps]
        cells += [_cell(result["figures"][figure], result["intervals"][figure]) for figure in FIGURES]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _cell(value: float | None, interval: list[float] | None) -> str:
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:.3f}" + (f" ({interval[0]:.3f} to {interval[1]:.3f})" if interval else "")


def main(settings: Settings) -> None:
    """Train and measure every variant; write the table after each."""
    names = settings.only or tuple(VARIANTS)
    unknown = sorted(set(names) - set(VARIANTS))
    if unknown:
        raise input_error("unknown variants", got=unknown, expected=", ".join(VARIANTS))
    for name in names:
        measured(name, settings)
        done = [read_json(file) for key in VARIANTS if (file := settings.out / key / "result.json").is_file()]
        about = {"nolbo_ppl": __version__, "torch": torch.__version__, "machine": platform.machine()}
        write_json(
            settings.out / "results.json",
            {
                "settings": {key: str(value) if isinstance(value, Path) else value for key, value in asdict(settings).items()},
                "versions": about,
                "results": done,
            },
        )
        with atomic_path(settings.out / "table.md") as temporary:
            temporary.write_text(markdown(done), encoding="utf-8")
        print(markdown(done[-1:] if len(done) == 1 else [r for r in done if r["variant"] == name]))


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
