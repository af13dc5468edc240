"""One of two gloo processes: run as `python tests/gloo_worker.py TASK RANK FILE_STORE OUT`, started by the tests.

Each task is also called by the tests themselves, in one process with the joint batch, to compare with.
"""

from __future__ import annotations

import sys
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch
import torch.distributed as distributed
from safetensors.torch import save_file
from torch import Tensor

from nolbo_ppl.models.normalisation import SyncBatchNorm2d

if TYPE_CHECKING:
    from nolbo_ppl.models.scene_batch import SceneBatch
    from nolbo_ppl.training.stages import StageRun


def part_of(rows: Tensor, rank: int | None, first: int) -> Tensor:
    """Rows of one process: the first ones for rank 0, the others for rank 1, all without a rank."""
    return rows if rank is None else rows[:first] if rank == 0 else rows[first:]


def normalisation(rank: int | None) -> dict[str, Tensor]:
    """Outputs, gradients and running statistics of batch normalisation over unequal shares of a batch."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(5, 3, 4, 6, generator=generator) * 2 + 1
    target = torch.randn(5, 3, 4, 6, generator=generator)
    layer = SyncBatchNorm2d(3)
    with torch.no_grad():
        layer.weight.copy_(torch.tensor([0.5, 1.5, -1.0]))
        layer.bias.copy_(torch.tensor([0.1, 0.2, 0.3]))
    mine = part_of(x, rank, 2).clone().requires_grad_()
    outputs = []
    for _ in range(2):
        out = layer(mine)
        outputs.append(out.detach())
        (out * part_of(target, rank, 2)).sum().backward()
    for parameter in layer.parameters():
        if rank is not None:
            distributed.all_reduce(parameter.grad)
    layer.eval()
    return {
        "first": outputs[0],
        "second": outputs[1],
        "gradient": mine.grad,
        "evaluated": layer(mine).detach(),
        "weight": layer.weight.grad,
        "bias": layer.bias.grad,
        "mean": layer.running_mean,
        "var": layer.running_var,
        "steps": layer.num_batches_tracked,
    }


def training(rank: int | None) -> dict[str, Tensor]:
    """State after steps of shapes, then of scenes: frozen, then free and decoding."""
    from nolbo_ppl.inference.svi import OptimizerConfig
    from nolbo_ppl.models.shape_vae import ShapeBatch
    from nolbo_ppl.training.stages import StageRun, TrainingStage, scene_weights
    from tests.factories import random_batch, tiny_config, tiny_model

    def scenes_of(step: int) -> SceneBatch:
        """Two scenes a process; those of the second process have no voxels at all in the last step."""
        batch = random_batch(tiny_config(), scenes=4, slots=3, objects=3 if step else 2, seed=step)
        if step == 2:
            batch.has_voxels[2:] = False
        return batch if rank is None else batch[2 * rank : 2 * rank + 2]

    def shapes_of(step: int) -> ShapeBatch:
        """Three shapes a process."""
        batch = random_batch(tiny_config(), scenes=1, slots=6, seed=10 + step)
        values = (batch.voxels[0], batch.category[0], batch.instance[0], batch.noise[0])
        return ShapeBatch(*(part_of(value, rank, 3) for value in values))

    model = tiny_model(scatter=0.1)
    quick = OptimizerConfig(steps=2, learning_rate=1e-2, warmup=1, decay=0.0, ema=0.5)
    shapes = StageRun(model, TrainingStage("shapes", quick, {"shape_kl": 1.0, "voxels": 0.01}))
    for step in range(2):
        shapes.step(shapes_of(step))
    shapes.load_ema()
    quick = OptimizerConfig(steps=3, learning_rate=1e-2, warmup=1, decay=0.0, ema=0.5)
    weights = scene_weights("inclusive", {"rotation": 0.01, "voxels": 0.01})
    scenes = StageRun(model, TrainingStage("scenes", quick, weights, freeze=1, decode=64))
    for step in range(3):
        scenes.step(scenes_of(step))
    state = {f"model/{name}": value for name, value in model.state_dict().items()}
    return {**state, **{f"average/{name}": value for name, value in scenes.state.average.items()}}


def local_run(seed: int) -> StageRun:
    """Scenes, three steps in all, averaged after every second one."""
    from nolbo_ppl.inference.svi import OptimizerConfig
    from nolbo_ppl.training.stages import StageRun, TrainingStage, scene_weights
    from tests.factories import tiny_model

    quick = OptimizerConfig(steps=3, learning_rate=1e-2, warmup=1, decay=0.0, ema=0.5)
    stage = TrainingStage("scenes", quick, scene_weights("inclusive"), freeze=3)
    return StageRun(tiny_model(scatter=0.1, seed=seed), stage, average_every=2)


def local_batch(rank: int, step: int) -> SceneBatch:
    """What one process sees in a step."""
    from tests.factories import random_batch, tiny_config

    return random_batch(tiny_config(), scenes=2, slots=3, objects=3, seed=10 * rank + step)


def local(rank: int) -> dict[str, Tensor]:
    """State of steps made alone, after the average of two and after the last average."""
    from nolbo_ppl.inference.svi import state_tensors

    run, tensors = local_run(0), {}
    for step in range(3):
        run.step(local_batch(rank, step))
        if step:
            tensors |= {f"{step}/{name}": value for name, value in state_tensors(run.state).items()}
    return tensors


TASKS = {"normalisation": normalisation, "training": training, "local": local}


def main() -> None:
    """Join the other process, run the task, save its tensors."""
    task, rank, store, out = sys.argv[1], int(sys.argv[2]), sys.argv[3], sys.argv[4]
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    distributed.init_process_group("gloo", init_method=f"file://{store}", rank=rank, world_size=2, timeout=timedelta(seconds=120))
    tensors = TASKS[task](rank)
    save_file({name: value.detach().contiguous().clone() for name, value in tensors.items()}, out)
    distributed.destroy_process_group()


if __name__ == "__main__":
    main()
