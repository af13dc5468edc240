"""Training steps and observed images a second on a device, the memory they take, and whether its numbers are the CPU's.

    python benchmarks/gpu.py --out gpu.json                     # the GPU where there is one, else the CPU; under 5 minutes
    OMP_NUM_THREADS=1 python benchmarks/gpu.py --quick          # small images, few steps: the same code

Batches are random pixels with labelled boxes, made once: neither rendering nor reading is measured. Each figure is the median
over repeated steps after a warm-up, with their quartiles; on the CPU times are CPU seconds. The numbers are compared in single
precision without TF32: terms of the loss of one step, and everything that `observe_boxes` answers, against the same networks in
double precision on the CPU. (A CPU itself answers queries with kernels in bfloat16 where it multiplies matrices of it; there the
answers differ more.)
"""

from __future__ import annotations

import dataclasses
import platform
import resource
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro

from nolbo_ppl.devices import device_of, peak_memory, pinned, placed, synchronise
from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.elbo import INCLUSIVE
from nolbo_ppl.inference.posterior.model_folder import load
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.inference.svi import OptimizerConfig
from nolbo_ppl.io.files import write_json
from nolbo_ppl.models.model_config import PRESETS, ModelConfig
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.scene_batch import SceneBatch
from nolbo_ppl.training.stages import StageRun, TrainingStage
from nolbo_ppl.training.trainer import compile_networks

TOLERANCE = {"cuda": 2e-3, "mps": 2e-3, "cpu": 0.1}
"""Largest relative difference of a term, and largest difference of an answer over its largest magnitude, that counts as equal."""


@dataclass(frozen=True)
class Settings:
    """What to measure."""

    out: Path | None = None
    """JSON file of the figures."""
    device: str = "auto"
    """`auto`, `cpu`, `cuda`, `cuda:N` or `mps`."""
    presets: tuple[str, ...] = ("tiny", "photo", "paper")
    """Which networks."""
    batches: tuple[int, ...] = ()
    """Scenes a step; by default 64 for tiny, 32 for photo, 1 and 4 for paper."""
    sizes: tuple[int, ...] = ()
    """Sides of the images, px; by default that of the preset, and 416 too for paper."""
    quick: bool = False
    """Small images, a scene or two a step, one repetition."""
    parts: tuple[Literal["training", "observe", "equality"], ...] = ("training", "observe", "equality")
    """What is measured."""
    compile: bool = False
    """Measure training with `torch.compile` as well."""
    seconds: float = 6.0
    """Time for each figure, in which steps are repeated (two at least)."""


def random_scenes(config: ModelConfig, scenes: int, size: int, objects: int = 4, seed: int = 0) -> SceneBatch:
    """Random pixels with fully labelled objects."""
    g = torch.Generator().manual_seed(seed)
    n, d, shape = config.voxel_size, config.latent_dim, (scenes, objects)
    yes = torch.ones(shape, dtype=torch.bool)
    corner = torch.rand(*shape, 2, generator=g) * size * 0.6
    box = torch.cat((corner, corner + 24 + torch.rand(*shape, 2, generator=g) * (size * 0.4 - 24)), -1)
    camera = torch.tensor([float(size), float(size), size / 2, size / 2]).repeat(scenes, 1)
    depth = 2 + 8 * torch.rand(shape, generator=g)
    pixel = (box[..., :2] + box[..., 2:]) / 2
    ray = torch.cat(((pixel - size / 2) / size, torch.ones(*shape, 1)), -1)
    viewpoint = torch.rand(*shape, 3, generator=g) * torch.tensor([6.0, 0.5, 0.1]) - torch.tensor([3.0, 0.1, 0.05])
    return SceneBatch(
        image=torch.randint(0, 256, (scenes, 3, size, size), generator=g, dtype=torch.uint8),
        intrinsics=camera,
        present=yes,
        box=box,
        category=torch.randint(0, len(config.categories), shape, generator=g),
        instance=torch.full(shape, -1),
        viewpoint=viewpoint,
        has_viewpoint=yes,
        symmetry=torch.ones(shape, dtype=torch.long),
        position=ray * depth[..., None],
        has_position=yes,
        diagonal=1 + torch.rand(shape, generator=g),
        has_size=yes,
        voxels=torch.randint(0, 256, (*shape, n**3 // 8), generator=g, dtype=torch.uint8),
        has_voxels=yes,
        visibility=torch.ones(shape),
        shape_loc=torch.randn(*shape, d, generator=g),
        shape_scale=torch.full((*shape, d), 0.3),
        noise=torch.randn(*shape, d, generator=g),
        decode_order=torch.rand(shape, generator=g),
    )


def repeated(action: Callable[[], Any], device: torch.device, seconds: float, warm_up: int) -> dict[str, float]:
    """Median time of an action, s, with quartiles, after some that do not count."""
    for _ in range(warm_up):
        action()
    times: list[float] = []
    began = time.perf_counter()
    while len(times) < 2 or time.perf_counter() - began < seconds:
        synchronise(device)
        clock = time.process_time if device.type == "cpu" else time.perf_counter  # other work on the machine hardly counts
        start = clock()
        action()
        synchronise(device)
        times.append(clock() - start)
    low, middle, high = (float(v) for v in np.quantile(times, (0.25, 0.5, 0.75)))
    return {"seconds": middle, "low": low, "high": high, "repetitions": len(times)}


def fresh(name: str, config: ModelConfig) -> Nolbo:
    """Networks of a preset: the shipped weights where there are any."""
    try:
        return load(name, "cpu").model.requires_grad_(True)
    except InputError:
        return Nolbo.from_seed(config, 0)


def stage_of(name: str, decode: int) -> TrainingStage:
    """A step on scenes, some objects decoded, by the optimiser that the preset is trained with."""
    optimizer = OptimizerConfig(100, optimizer="adamw" if name == "paper" else "muon", warmup=0)
    return TrainingStage("scenes", optimizer, {**INCLUSIVE, "voxels": 0.002}, decode=decode)


def measure_training(
    settings: Settings, name: str, batch: int, size: int, device: torch.device, compiled: bool
) -> dict[str, Any]:
    """Seconds and memory of a step of SVI in bfloat16: encoder, head, story, bound, gradient, optimiser, average."""
    model = fresh(name, PRESETS[name]()).to(device)
    if compiled:
        compile_networks(model)
    run = StageRun(model, stage_of(name, 4), half_precision=True)
    scenes = pinned(random_scenes(model.config, batch, size), device)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)

    def step() -> None:
        run.step(placed(scenes, device, non_blocking=True))

    one = repeated(step, device, settings.seconds, 1 if settings.quick or device.type == "cpu" else 3)
    memory = peak_memory(device)
    if memory is None:  # of the whole process until now: presets run from the smallest on
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    of = {
        "what": "training step",
        "parameters": sum(p.numel() for p in model.parameters()),
        "preset": name,
        "size": size,
        "batch": batch,
        "compiled": compiled,
    }
    return {**of, **one, "per_second": 1 / one["seconds"], "memory_gb": memory / 1e9}


def measure_observing(settings: Settings, name: str, batch: int, size: int, device: torch.device) -> list[dict[str, Any]]:
    """Images a second of `observe` without shapes, and of four objects an image with their shapes (8 samples each)."""
    model = ObservationModel(fresh(name, PRESETS[name]())).to(device)
    scenes = random_scenes(model.config, batch, size)
    images, cameras = list(scenes.image), scenes.intrinsics.numpy()
    boxes = list(scenes.box.numpy())
    actions: dict[str, Callable[[], Any]] = {
        "observe": lambda: model.observe(images, cameras, size=size, batch=batch, decode=False),
        "observe 4 boxes": lambda: model.observe_boxes(images, cameras, boxes, size=size, batch=batch),
    }
    rows = []
    for what, action in actions.items():
        one = repeated(action, device, settings.seconds, 1)
        rows.append({"what": what, "preset": name, "size": size, "batch": batch, **one, "per_second": batch / one["seconds"]})
    return rows


def compare(name: str, size: int, device: torch.device) -> dict[str, Any]:
    """Largest differences from the CPU: terms of a step's loss, answers at given boxes over their largest magnitude.

    A number that is NaN on one side alone is a difference that no tolerance allows.
    """
    config = PRESETS[name]()
    terms, answers = [], []
    scenes = random_scenes(config, 1, size)
    for where, dtype in ((torch.device("cpu"), torch.float64), (device, torch.float32)):
        model = fresh(name, config).to(where, dtype)
        run = StageRun(model, stage_of(name, 4), half_precision=False)
        terms.append(run.step(placed(scenes.to(dtype), where)).terms)
        observer = ObservationModel(fresh(name, config).to(where, dtype))
        found = observer.observe_boxes(list(scenes.image), scenes.intrinsics.numpy(), list(scenes.box.numpy()), size=size)[0]
        answers.append({f.name: getattr(found, f.name) for f in dataclasses.fields(found)})
    term = float(np.max([abs(terms[1][key] - value) / max(abs(value), 1e-3) for key, value in terms[0].items()]))
    numbers = {key: value for key, value in answers[0].items() if isinstance(value, np.ndarray) and value.dtype.kind == "f"}
    differences = []
    for key, value in numbers.items():
        known = ~(np.isnan(value) & np.isnan(answers[1][key]))  # NaN on both sides: there is no answer
        if known.any():
            gap = np.abs(answers[1][key] - value)[known].max()
            differences.append(gap / max(float(np.nanmax(np.abs(value[known]), initial=0.0)), 1e-3))
    answer = float(np.max(differences))
    equal = term < TOLERANCE["cuda"] and answer < TOLERANCE[device.type]
    return {"preset": name, "size": size, "terms": term, "answers": answer, "equal": equal}


def main(settings: Settings) -> dict[str, Any]:
    """Measure and print."""
    device = device_of(settings.device)
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False
    if settings.quick:
        settings = dataclasses.replace(settings, seconds=0.0)
    kind = torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or platform.machine()
    figures: dict[str, Any] = {
        "device": str(device),
        "kind": kind,
        "torch": torch.__version__,
        "threads": torch.get_num_threads(),
    }
    rows: list[dict[str, Any]] = []
    equal: list[dict[str, Any]] = []
    print(f"{device} ({kind}), torch {torch.__version__}")
    print(f"{'what':<16}{'preset':<8}{'size':>5}{'batch':>6}{'seconds':>10}  {'quartiles':<20}{'a second':>9}{'GB':>7}")
    for name in settings.presets:
        own = PRESETS[name]().image_size
        usual = {"tiny": (64,), "photo": (32,), "paper": (1, 4)}.get(name, (16,))
        sizes = settings.sizes or ((64,) if settings.quick else (416, own) if name == "paper" else (own,))
        batches = settings.batches or ((1,) if settings.quick else usual)
        for size in sizes if "training" in settings.parts else ():
            for batch in batches:
                for compiled in (False, True) if settings.compile else (False,):
                    rows.append(measure_training(settings, name, batch, size, device, compiled))
                    show(rows[-1])
        if "observe" in settings.parts:
            for row in measure_observing(settings, name, max(batches), sizes[-1], device):
                rows.append(row)
                show(row)
        if "equality" in settings.parts:
            equal.append(compare(name, sizes[0], device))
    for one in equal:
        said = "equal" if one["equal"] else "DIFFERENT"
        differ = f"terms differ by {one['terms']:.1e}, answers by {one['answers']:.1e}"
        print(f"{one['preset']}: {differ} from float64 on the CPU: {said}")
    figures |= {"rows": rows, "equality": equal}
    if settings.out is not None:
        write_json(settings.out, figures)
    return figures


def show(row: dict[str, Any]) -> None:
    """One line of the table."""
    what = row["what"] + (" c" if row.get("compiled") else "")
    memory = f"{row['memory_gb']:.2f}" if "memory_gb" in row else ""
    span = f"[{row['low']:.3f}, {row['high']:.3f}]"
    middle = f"{row['preset']:<8}{row['size']:>5}{row['batch']:>6}{row['seconds']:>10.3f}  {span:<20}"
    print(f"{what:<16}{middle}{row['per_second']:>9.2f}{memory:>7}", flush=True)


if __name__ == "__main__":
    if not all(one["equal"] for one in main(tyro.cli(Settings, description=__doc__))["equality"]):
        raise SystemExit(1)
