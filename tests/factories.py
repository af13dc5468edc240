"""Tiny networks, random scenes and random posteriors for the tests: everything by seed, in double precision."""

from __future__ import annotations

import dataclasses
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor

from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.observed_scene import Encoding, ObservedScene, RegionParameters
from nolbo_ppl.models.scene_batch import Assignment, SceneBatch, cell_of, encode_box, encode_range, grid_size, pack_bits

FOCAL = 80.0


def tiny_config(**changes: Any) -> ModelConfig:
    """Four categories (one of each kind of symmetry), a network of a few thousand weights, 4 x 4 cells."""
    values: dict[str, Any] = {
        "categories": ("aeroplane", "bottle", "car", "diningtable"),
        "symmetry": (1, 0, 1, 2),
        "encoder_channels": (4, 6, 8, 12),
        "encoder_blocks": (0, 1, 1),
        "head_width": 16,
        "glimpse": 4,
        "glimpse_width": 4,
        "image_size": 64,
        "latent_dim": 4,
        "prior_width": 8,
        "decoder_channels": (8, 6, 4),
        "voxel_encoder_channels": (4, 4, 8),
    }
    values.update(changes)
    if values.get("orientation", "mixture") != "mixture":
        values.setdefault("azimuth_components", 1)
    return ModelConfig(**values)


def instance_config(**changes: Any) -> ModelConfig:
    """With five named instances: none of aeroplanes, one bottle, three cars, one table."""
    return tiny_config(instances=("b0", "c0", "c1", "c2", "t0"), instance_category=(1, 2, 2, 2, 3), **changes)


def tiny_model(config: ModelConfig | None = None, seed: int = 0, scatter: float = 0.0) -> Nolbo:
    """A freshly initialised model in double precision; `scatter` adds noise to the last layer, so that heads differ."""
    model = Nolbo.from_seed(config or tiny_config(), seed).double()
    if scatter:
        generator = torch.Generator().manual_seed(seed + 1)
        with torch.no_grad():
            last = [model.guide.head.outputs[-1].weight, model.guide.head.objectness.weight]
            if model.guide.head.glimpse is not None:
                last.append(model.guide.head.glimpse.judge[-1].weight)
            for parameter in last:
                parameter.add_(scatter * torch.randn(parameter.shape, generator=generator, dtype=parameter.dtype))
    return model


def random_batch(
    config: ModelConfig,
    scenes: int = 2,
    slots: int = 3,
    seed: int = 0,
    objects: int | None = None,
    size: int | None = None,
) -> SceneBatch:
    """Scenes of random pixels with fully labelled objects, each in a cell of its own; later slots are empty."""
    g = torch.Generator().manual_seed(seed)
    side = size or config.image_size
    objects = slots if objects is None else objects

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=g, dtype=torch.float64)

    cells = (side // config.stride) ** 2
    columns = side // config.stride
    cell = torch.stack([torch.randperm(cells, generator=g)[:slots] for _ in range(scenes)])
    corner = torch.stack((cell % columns, cell // columns), -1)
    centre = config.stride * (corner + uniform(0.2, 0.8, scenes, slots, 2))
    half = torch.exp(uniform(math.log(5.0), math.log(32.0), scenes, slots, 2))
    present = (torch.arange(slots) < objects).expand(scenes, slots).clone()
    box = torch.cat((centre - half, centre + half), -1) * present[..., None]
    intrinsics = torch.tensor([FOCAL, FOCAL * 1.1, side / 2, side / 2 - 3]).double().expand(scenes, 4).clone()
    depth = uniform(2.0, 9.0, scenes, slots)
    pixel = centre + uniform(-1.0, 1.0, scenes, slots, 2)
    xy = (pixel - intrinsics[:, None, 2:]) / intrinsics[:, None, :2] * depth[..., None]
    position = torch.cat((xy, depth[..., None]), -1) * present[..., None]
    category = torch.randint(0, len(config.categories), (scenes, slots), generator=g)
    category = torch.where(present, category, -1)
    viewpoint = torch.stack(
        (uniform(-3.1, 3.1, scenes, slots), uniform(-0.2, 0.6, scenes, slots), uniform(-0.2, 0.2, scenes, slots)), -1
    )
    n = config.voxel_size
    voxels = torch.rand(scenes, slots, n, n, n, generator=g) < 0.3
    instance = torch.full((scenes, slots), -1)
    if config.instances:
        for i, own in enumerate(config.instance_category):
            instance = torch.where(category == own, i, instance)
    d = config.latent_dim
    return SceneBatch(
        image=torch.randint(0, 256, (scenes, 3, side, side), generator=g, dtype=torch.uint8),
        intrinsics=intrinsics,
        present=present,
        box=box,
        category=category,
        instance=instance,
        viewpoint=viewpoint * present[..., None],
        has_viewpoint=present.clone(),
        symmetry=torch.where(present, torch.tensor(config.symmetry)[category.clamp_min(0)], 1),
        position=position,
        has_position=present.clone(),
        diagonal=uniform(0.5, 4.0, scenes, slots) * present,
        has_size=present.clone(),
        voxels=pack_bits(voxels & present[..., None, None, None]),
        has_voxels=present.clone(),
        visibility=torch.ones(scenes, slots, dtype=torch.float64),
        shape_loc=torch.randn(scenes, slots, d, generator=g, dtype=torch.float64),
        shape_scale=uniform(0.2, 0.6, scenes, slots, d),
        noise=torch.randn(scenes, slots, d, generator=g, dtype=torch.float64),
        decode_order=torch.rand(scenes, slots, generator=g, dtype=torch.float64),
    )


def random_posterior(config: ModelConfig, shape: tuple[int, ...], seed: int = 0, near: Tensor | None = None) -> RegionParameters:
    """Random parameters of q(. | I); with `near` (viewpoints) the angles are narrow and close to them."""
    g = torch.Generator().manual_seed(seed)

    def normal(*trailing: int, scale: float = 1.0) -> Tensor:
        return scale * torch.randn(*shape, *trailing, generator=g, dtype=torch.float64)

    d, modes = config.latent_dim, config.azimuth_components
    mean = normal(modes, scale=1.5)
    angle_loc = normal(2, scale=0.2)
    if near is not None:
        mean = near[..., :1] + 0.1 * normal(modes)
        angle_loc = near[..., 1:] + 0.05 * normal(2)
    kappa = 60.0 * torch.exp(0.5 * normal(modes))
    return RegionParameters(
        label_logits=normal(len(config.categories)),
        shape_loc=normal(d),
        shape_scale=torch.exp(0.3 * normal(d) - 0.5),
        azimuth_logits=normal(modes),
        azimuth_natural=kappa[..., None] * torch.stack((torch.cos(mean), torch.sin(mean)), -1),
        angle_loc=angle_loc,
        angle_scale=0.08 * torch.exp(0.3 * normal(2)),
        box_loc=normal(4),
        box_scale=0.3 * torch.exp(0.3 * normal(4)),
        range_loc=normal(4),
        range_scale=0.3 * torch.exp(0.3 * normal(4)),
    )


def observed_scene(
    config: ModelConfig, batch: SceneBatch, posterior: RegionParameters | None = None, seed: int = 0
) -> ObservedScene:
    """A batch with a random posterior in place of an encoder's: predictor 0 is responsible in each object's cell."""
    rows, columns = grid_size(*batch.image.shape[2:], config)
    scenes, slots = batch.present.shape
    cell = cell_of(batch.box, rows, columns, config.stride)
    regions = rows * columns * config.predictors
    is_object = torch.zeros(scenes, regions, dtype=torch.bool)
    for b, m in batch.present.nonzero().tolist():
        is_object[b, cell[b, m] * config.predictors] = True
    batch = batch.neutral()
    camera = batch.intrinsics[:, None].expand(-1, slots, -1)
    assignment = Assignment(
        cell=cell,
        predictor=torch.zeros_like(cell),
        assigned=batch.present,
        is_object=is_object,
        box_target=encode_box(batch.box, cell, columns, config),
        range_target=encode_range(batch.position, batch.diagonal, batch.box, camera, config),
        has_range=batch.has_position & batch.has_size,
    )
    g = torch.Generator().manual_seed(seed + 100)
    logit = 2 * torch.randn(scenes, regions, generator=g, dtype=torch.float64) - 1
    encoding = Encoding(torch.zeros(scenes, rows * columns, 1), logit, rows, columns)
    if posterior is None:
        posterior = random_posterior(config, (scenes, slots), seed, near=batch.viewpoint)
    return ObservedScene(batch, encoding, assignment, posterior)


def repeat_scene(scene: ObservedScene, count: int) -> ObservedScene:
    """The same scenes `count` times over: independent samples of the guide for each copy in one run."""

    def repeated(value: Any) -> Any:
        if isinstance(value, Tensor):
            return value.repeat(count, *(1,) * (value.dim() - 1))
        if dataclasses.is_dataclass(value):
            return dataclasses.replace(value, **{f.name: repeated(getattr(value, f.name)) for f in dataclasses.fields(value)})
        return value

    return repeated(scene)


def assert_within(samples: Tensor, expected: Tensor | float, errors: float = 5.0, slack: float = 0.0) -> None:
    """The mean over the first dimension agrees with a value within so many of its standard errors."""
    expected = torch.as_tensor(expected, dtype=samples.dtype)
    bound = errors * samples.std(0) / math.sqrt(len(samples)) + slack
    difference = (samples.mean(0) - expected).abs()
    assert bool((difference <= bound).all()), f"off by {difference.max():.3e}, allowed {bound.min():.3e}"


def run_in_two_processes(task: str, folder: Path) -> list[dict[str, Tensor]]:
    """Run a task of `gloo_worker` in two gloo processes and return the tensors of each."""
    worker = Path(__file__).with_name("gloo_worker.py")
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    processes = []
    for rank in range(2):
        arguments = [task, str(rank), str(folder / "store"), str(folder / f"{rank}.safetensors")]
        with (folder / f"{rank}.log").open("w") as log:
            processes.append(subprocess.Popen([sys.executable, str(worker), *arguments], env=environment, stderr=log))
    try:
        codes = [process.wait(timeout=400) for process in processes]
    finally:
        for process in processes:
            process.kill()
            process.wait()
    assert codes == [0, 0], "\n".join((folder / f"{rank}.log").read_text()[-2000:] for rank in range(2))
    return [load_file(folder / f"{rank}.safetensors") for rank in range(2)]
