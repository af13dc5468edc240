"""Overheads of the observation model: of Pyro in an SVI step, of the queries in `observe`, and of data in training.

    OMP_NUM_THREADS=1 python benchmarks/observation.py --out observation.json

Each pair runs in one process on the same inputs, interleaved and repeated: the ratio is the median over the pairs, its
spread their quartiles. Times are CPU seconds of this process, so that other work on the machine hardly counts. The
hand-written loop is checked first to give the same loss and gradients.
"""

from __future__ import annotations

import math
import platform
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence
from torch.nn.functional import logsigmoid

from nolbo_ppl.cli.train import TrainConfig, run
from nolbo_ppl.data.loader import render_batch
from nolbo_ppl.errors import InputError
from nolbo_ppl.inference import svi as optimisation
from nolbo_ppl.inference.elbo import INCLUSIVE
from nolbo_ppl.inference.posterior.model_folder import load
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.inference.svi import OptimizerConfig
from nolbo_ppl.io.files import write_json
from nolbo_ppl.models.distributions import VonMisesMixture, WrappedNormal
from nolbo_ppl.models.distributions.von_mises_kl import kl_wrapped_to_mixture
from nolbo_ppl.models.distributions.wrapped_normal import kl_of_angles
from nolbo_ppl.models.model_config import PRESETS
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.scene_batch import SceneBatch
from nolbo_ppl.synthetic.scenes.scene_config import preset
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator
from nolbo_ppl.training.scene_loader import to_batch
from nolbo_ppl.training.stages import StageRun, TrainingStage

STEP_LIMIT, OBSERVE_LIMIT, WAITING_LIMIT = 1.10, 1.30, 0.05
"""What the figures may be at most."""


@dataclass(frozen=True)
class Settings:
    """What to measure."""

    out: Path | None = None
    """JSON file of the figures."""
    model: str = "tiny"
    """Model of the `observe` part; freshly initialised networks where it is not there."""
    batch: int = 64
    """Images a step, and images observed at once."""
    pairs: int = 15
    """Interleaved pairs of each comparison."""
    train_steps: int = 60
    """Steps of the real training run whose waiting is measured; 0 leaves it out."""
    cache: Path = Path("~/.cache/nolbo_ppl")
    """Where the rendered scenes of that run are kept."""


@dataclass(frozen=True)
class Ratio:
    """CPU seconds of the library and of its bare counterpart."""

    name: str
    seconds: float
    bare_seconds: float
    ratio: float
    quartiles: tuple[float, float]
    limit: float


# ---------------------------------------------------------------------------------------------------------------------
# The SVI step by hand: same networks, same loss, no Pyro
# ---------------------------------------------------------------------------------------------------------------------


def hand_loss(model: Nolbo, batch: SceneBatch) -> Tensor:
    """The inclusive objective by its formulas, nats a scene."""
    config, scene = model.config, model.guide.observe(batch)
    where, assigned = scene.assignment, scene.assignment.assigned
    q = scene.posterior.map(lambda value: value[assigned])

    eps, logit = config.objectness_epsilon, scene.encoding.objectness_logit
    p = torch.where(where.is_object, logit.new_tensor(1 - eps), logit.new_tensor(eps))
    objectness = p * (torch.log(p) - logsigmoid(logit)) + (1 - p) * (torch.log1p(-p) - logsigmoid(-logit))

    label = torch.nn.functional.cross_entropy(q.label_logits, batch.category[assigned], reduction="sum")

    known = batch.has_voxels[assigned]
    assert batch.shape_loc is not None
    assert batch.shape_scale is not None
    teacher = Normal(batch.shape_loc[assigned][known], batch.shape_scale[assigned][known])
    shape = kl_divergence(teacher, Normal(q.shape_loc[known], q.shape_scale[known])).sum()

    seen = batch.has_viewpoint[assigned]
    viewpoint, order = batch.viewpoint[assigned][seen], batch.symmetry[assigned][seen]
    truth = WrappedNormal(viewpoint[:, 0], torch.full_like(viewpoint[:, 0], config.orientation_scale))
    mixture = VonMisesMixture(q.azimuth_logits[seen], q.azimuth_natural[seen], max_concentration=config.max_concentration)
    azimuth = kl_wrapped_to_mixture(truth, mixture, order).sum()
    tilt_scale = torch.full_like(viewpoint[:, 1:], config.orientation_scale)
    tilt = kl_of_angles(viewpoint[:, 1:], tilt_scale, q.angle_loc[seen], q.angle_scale[seen]).sum()

    def conjugate(observed: Tensor, scale: float, loc: Tensor, spread: Tensor) -> Tensor:
        shrink = 1 / (1 + scale**2)
        truth = Normal(observed * shrink, torch.full_like(observed, scale * math.sqrt(shrink)))
        return kl_divergence(truth, Normal(loc, spread)).sum()

    box = conjugate(where.box_target[assigned], config.box_scale, q.box_loc, q.box_scale)
    ranged = where.has_range[assigned]
    range_ = conjugate(where.range_target[assigned][ranged], config.range_scale, q.range_loc[ranged], q.range_scale[ranged])
    total = (
        INCLUSIVE["objectness_inclusive"] * objectness.sum()
        + INCLUSIVE["label_inclusive"] * label
        + INCLUSIVE["shape_inclusive"] * shape
        + INCLUSIVE["azimuth_inclusive"] * azimuth
        + INCLUSIVE["tilt_inclusive"] * tilt
        + INCLUSIVE["box_inclusive"] * box
        + INCLUSIVE["range_inclusive"] * range_
    )
    return total / len(batch.image)


class HandLoop:
    """A plain torch training loop: AdamW, clipping, and an exponential moving average of the weights."""

    def __init__(self, model: Nolbo, config: OptimizerConfig, half_precision: bool) -> None:
        self.model, self.config = model, config
        model.set_half_precision(half_precision)
        model.train()
        for part in (model.story, model.shape_guide):
            part.eval().requires_grad_(False)
        self.parameters = list(model.guide.parameters())
        groups = [
            {"params": [p for p in self.parameters if p.dim() > 1], "weight_decay": config.weight_decay},
            {"params": [p for p in self.parameters if p.dim() <= 1], "weight_decay": 0.0},
        ]
        self.optimizer = torch.optim.AdamW(groups, lr=config.learning_rate, betas=(0.9, 0.99), fused=True)
        self.state = [value for value in model.state_dict().values() if value.is_floating_point()]
        self.average = [value.clone() for value in self.state]

    def step(self, batch: SceneBatch) -> float:
        """One step."""
        loss = hand_loss(self.model, batch)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self.parameters, self.config.clip)
        self.optimizer.step()
        with torch.no_grad():
            torch._foreach_lerp_(self.average, self.state, 1 - self.config.ema)
        return float(loss.detach())


def scenes(count: int) -> SceneBatch:
    """A batch of standard training scenes."""
    return to_batch(render_batch(SceneGenerator(preset("standard", 128), seed=77), 0, count))


def taught(model: Nolbo, batch: SceneBatch) -> SceneBatch:
    """The batch with the shape autoencoder's posteriors."""
    with torch.no_grad():
        loc, scale = model.shape_guide.eval().posterior(batch.voxels.flatten(0, 1))
    shape = (*batch.present.shape, -1)
    return batch.replace(shape_loc=loc.reshape(shape), shape_scale=scale.reshape(shape))


def assert_same_step(batch: SceneBatch) -> None:
    """Loss and gradients of the library's step and of the hand-written one agree (double precision, same weights)."""
    stage = StageRun(Nolbo.from_seed(PRESETS["tiny"](), 0).double(), _stage())
    stage.set_modes()
    ours = stage.state.loss(batch.to(torch.float64), decode=0).loss
    ours.backward()
    other = Nolbo.from_seed(PRESETS["tiny"](), 0).double().train()
    other.story.eval()
    by_hand = hand_loss(other, batch.to(torch.float64))
    by_hand.backward()
    assert abs(float(ours.detach() - by_hand.detach())) < 1e-9 * abs(float(by_hand.detach())), (ours, by_hand)
    for (name, a), b in zip(stage.model.guide.named_parameters(), other.guide.parameters()):
        assert a.grad is not None
        assert b.grad is not None
        error = float((a.grad - b.grad).abs().max() / b.grad.abs().max().clamp_min(1e-12))
        assert error < 1e-7, f"gradient of {name} differs by {error}"


def _stage(steps: int = 10**6) -> TrainingStage:
    return TrainingStage("scenes", OptimizerConfig(steps=steps, warmup=1, decay=0.0), INCLUSIVE, freeze=steps)


def compare(name: str, ours: Callable[[], Any], bare: Callable[[], Any], pairs: int, limit: float) -> Ratio:
    """Time both in turn, the first of a pair changing, after one warm-up of each."""
    times = np.empty((pairs, 2))
    for pair in range(-1, pairs):
        for which in (0, 1) if pair % 2 else (1, 0):
            begin = time.process_time()
            (ours, bare)[which]()
            times[max(pair, 0), which] = time.process_time() - begin
    ratios = times[:, 0] / times[:, 1]
    low, high = np.quantile(ratios, [0.25, 0.75])
    seconds, bare_seconds = np.median(times, axis=0)
    return Ratio(name, float(seconds), float(bare_seconds), float(np.median(ratios)), (float(low), float(high)), limit)


def step_ratio(batch: SceneBatch, pairs: int, half_precision: bool) -> Ratio:
    """SVI step over hand-written step."""
    library, stage = Nolbo.from_seed(PRESETS["tiny"](), 0), _stage()
    runner = StageRun(library, stage, half_precision)
    loop = HandLoop(Nolbo.from_seed(PRESETS["tiny"](), 0), stage.optimisation, half_precision)
    name = f"SVI step, {'bf16' if half_precision else 'fp32'}, batch {len(batch.image)}"

    def ours() -> float:
        return optimisation.step(runner.state, batch, decode=0)[1].loss if runner.set_modes() else math.nan

    return compare(name, ours, lambda: loop.step(batch), pairs, STEP_LIMIT)


# ---------------------------------------------------------------------------------------------------------------------
# observe against the bare networks
# ---------------------------------------------------------------------------------------------------------------------


def observation_model(name: str, images: Tensor) -> tuple[ObservationModel, float]:
    """The model, and a threshold at which it finds a few objects an image, whether it is trained or fresh."""
    try:
        return load(name), 0.3
    except InputError:
        model = ObservationModel(Nolbo.from_seed(PRESETS["tiny"](), 0))
        return model, float(torch.sigmoid(torch.quantile(model.encode(images).objectness_logit.flatten(), 0.97)))


def observe_ratio(batch: SceneBatch, settings: Settings, decode: bool, half_precision: bool) -> tuple[Ratio, float]:
    """`observe` over encoder, head on the detected regions and decoder on the same latents; and objects an image."""
    model, threshold = observation_model(settings.model, batch.image)
    model.model.set_half_precision(half_precision)
    images = list(batch.image.numpy().transpose(0, 2, 3, 1))
    camera = batch.intrinsics.numpy()
    samples, count = 8, len(images)

    def ours() -> Any:
        return model.observe(images, camera, threshold=threshold, decode=decode, samples=samples, batch=count)

    found = sum(len(one) for one in ours())
    stacked = batch.image

    @torch.inference_mode()
    def bare() -> None:
        encoding = model.model.guide.encode(stacked)
        index = torch.arange(found)
        count, cells = encoding.features.shape[:2]
        q = model.model.guide.parameters_at(encoding, index % count, index % (cells * model.config.predictors))
        if decode:
            noise = torch.randn(samples, *q.shape_loc.shape)
            latents = torch.cat((q.shape_loc[None], q.shape_loc + q.shape_scale * noise)).flatten(0, 1)
            for part in latents.split(64):
                torch.sigmoid(model.model.story.decoder(part))

    name = f"observe, {'bf16' if half_precision else 'fp32'}, {'shapes decoded' if decode else 'no shapes'}"
    return compare(name, ours, bare, settings.pairs, OBSERVE_LIMIT), found / count


# ---------------------------------------------------------------------------------------------------------------------


def waiting_share(settings: Settings) -> float:
    """Share of a real training run's stages that is spent waiting for data."""
    with tempfile.TemporaryDirectory() as folder:
        config = TrainConfig(
            out=Path(folder) / "run",
            count=2048,
            shape_steps=4,
            single_steps=0,
            scene_steps=settings.train_steps,
            batch=settings.batch,
            cache=settings.cache,
            evaluate_every=10**6,
            evaluate_scenes=64,
            workers=1,
            threads=torch.get_num_threads(),
        )
        return run(config).waiting


def main(settings: Settings) -> None:
    """Measure, print the table, write the figures."""
    batch = scenes(settings.batch)
    batch = taught(Nolbo.from_seed(PRESETS["tiny"](), 0), batch)
    assert_same_step(batch[:8])
    ratios = [step_ratio(batch, settings.pairs, half) for half in (False, True)]
    objects = 0.0
    for half in (False, True):
        for decode in (True, False):
            ratio, objects = observe_ratio(batch, settings, decode, half)
            ratios.append(ratio)
    print(f"{'':<34}{'library, ms':>13}{'bare, ms':>11}{'ratio':>8}{'quartiles':>16}{'limit':>8}")
    for r in ratios:
        low, high = r.quartiles
        print(
            f"{r.name:<34}{1e3 * r.seconds:>13.1f}{1e3 * r.bare_seconds:>11.1f}{r.ratio:>8.3f}"
            f"{f'{low:.3f}-{high:.3f}':>16}{r.limit:>8.2f}{'' if r.ratio <= r.limit else '  above the limit'}"
        )
    print(f"objects an image in observe: {objects:.2f}")
    waiting = None
    if settings.train_steps:
        waiting = waiting_share(settings)
        print(f"{'share of training waiting for data':<34}{waiting:>32.4f}{WAITING_LIMIT:>24.2f}")
    if settings.out is not None:
        figures = {
            "ratios": [asdict(r) for r in ratios],
            "objects_an_image": objects,
            "waiting": waiting,
            "waiting_limit": WAITING_LIMIT,
            "pairs": settings.pairs,
            "batch": settings.batch,
            "threads": torch.get_num_threads(),
            "torch": torch.__version__,
            "machine": platform.machine(),
        }
        write_json(settings.out, figures)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
