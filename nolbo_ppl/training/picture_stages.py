"""The paper's first two stages: the encoder core learns classes of pictures, then viewpoints of rendered objects."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Protocol, Self

import numpy as np
import torch
import torch.distributed as distributed
from jaxtyping import Int
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from nolbo_ppl.data.imagenet import LabelledPictures, open_imagenet
from nolbo_ppl.data.loader import batch_indices
from nolbo_ppl.data.render_for_cnn import RenderedViewpoints, open_render_for_cnn
from nolbo_ppl.devices import placed
from nolbo_ppl.geometry.rotation import geodesic_angle, viewpoint_to_matrix
from nolbo_ppl.inference import svi as optimisation
from nolbo_ppl.inference.elbo import ElboResult
from nolbo_ppl.inference.svi import OptimizerConfig, OptimizerState
from nolbo_ppl.models.classifiers import PictureBatch, PictureClassifier, classification_terms, predicted_viewpoint
from nolbo_ppl.parallel import parallel
from nolbo_ppl.training.paper_config import PaperConfig


class Pictures(Protocol):
    """Pictures of one object each, read when they are asked for."""

    def __len__(self) -> int:
        """How many."""

    def part(self, index: Int[np.ndarray, " n"]) -> Self:
        """Some of them: what is sent to a process that reads them."""

    def picture(self, index: int, size: int, seed: int | None = None) -> np.ndarray:
        """One of them at a size; by a seed changed at random."""


class PictureLoss(nn.Module):
    """Negative log likelihood of a batch as one module."""

    def __init__(self, model: PictureClassifier) -> None:
        super().__init__()
        self.model = model

    def forward(self, batch: PictureBatch) -> ElboResult:
        """Terms in nats summed over the batch, loss in nats a picture."""
        terms = classification_terms(self.model, self.model(batch), batch)
        return ElboResult(terms, -torch.stack(list(terms.values())).sum() / len(batch.image))


class PictureRun:
    """A stage on pictures under way, as `nolbo_ppl.training.stages.StageRun`."""

    def __init__(self, model: PictureClassifier, config: OptimizerConfig, half_precision: bool) -> None:
        self.model = model
        model.half_precision = half_precision
        loss: nn.Module = PictureLoss(model)
        if distributed.is_available() and distributed.is_initialized():
            loss = DistributedDataParallel(loss)
        self.state: OptimizerState = optimisation.init(model, loss, config)

    def step(self, batch: PictureBatch) -> optimisation.StepInfo:
        """One optimiser step."""
        self.model.train()
        self.state, info = optimisation.step(self.state, batch)
        return info

    def averaged(self) -> PictureClassifier:
        """A copy with the averaged weights, in evaluation mode."""
        own, like = self.model, self.model.head.weight
        copy = PictureClassifier(own.labels, own.viewpoints, own.width).to(like.device, like.dtype)
        copy.load_state_dict(self.state.average)
        return copy.eval().requires_grad_(False)

    def load_ema(self) -> None:
        """End the stage: the networks take the averaged weights."""
        self.model.load_state_dict(self.state.average)


def open_pictures(config: PaperConfig) -> tuple[Pictures, Pictures, tuple[str, ...]]:
    """Pictures to learn from, held-out ones, and what the labels stand for."""
    if config.stage == "imagenet":
        train = open_imagenet(config.data, "train")
        return train, open_imagenet(config.data, "val", train.classes), train.classes
    rendered = open_render_for_cnn(config.data)
    return rendered, open_render_for_cnn(config.data, held_out=True), rendered.categories


def read_part(pictures: Pictures, size: int, seeds: list[int] | None) -> np.ndarray:
    """Pictures as one array; run in a process of its own."""
    return np.stack([pictures.picture(i, size, None if seeds is None else seeds[i]) for i in range(len(pictures))])


def to_picture_batch(pictures: Pictures, image: np.ndarray) -> PictureBatch:
    """Pictures with their labels."""
    if isinstance(pictures, RenderedViewpoints):
        viewpoint = torch.from_numpy(pictures.viewpoint.astype(np.float32))
        return PictureBatch(torch.from_numpy(image), torch.from_numpy(pictures.category), viewpoint)
    assert isinstance(pictures, LabelledPictures)
    return PictureBatch(torch.from_numpy(image), torch.from_numpy(pictures.label))


def picture_batches(config: PaperConfig, pictures: Pictures, start: int, rank: int, world: int) -> Iterator[PictureBatch]:
    """Endless shuffled batches from a step on, each a function of seed and step, read by `workers` processes."""
    size, batch = config.default("sizes")[0], config.default("batch")
    mine = slice(rank * batch // world, (rank + 1) * batch // world)

    def parts() -> Iterator[tuple[Pictures, list[int] | None]]:
        step = start
        while True:
            part = pictures.part(batch_indices(len(pictures), batch, config.seed, step)[mine])
            seeds = (
                np.random.default_rng([config.seed, step]).integers(2**62, size=batch)[mine].tolist() if config.augment else None
            )
            yield part, seeds
            step += 1

    waiting: list[Pictures] = []

    def jobs() -> Iterator[Any]:
        for part, seeds in parts():
            waiting.append(part)
            yield read_part, (part, size, seeds)

    for image in parallel(jobs(), config.workers):
        yield to_picture_batch(waiting.pop(0), image)


@torch.no_grad()
def validate_pictures(
    model: PictureClassifier, config: PaperConfig, pictures: Pictures, device: torch.device
) -> dict[str, float]:
    """Held-out figures: `top1` and `top5` of classes; `acc_pi6` and `med_err_deg` of viewpoints (the true category given)."""
    chosen = np.unique(np.linspace(0, len(pictures) - 1, min(config.evaluate_pictures, len(pictures))).round().astype(int))
    size, found = config.default("sizes")[0], []
    model.eval()
    for first in range(0, len(chosen), 64):
        part = pictures.part(chosen[first : first + 64])
        batch = placed(to_picture_batch(part, read_part(part, size, None)), device)
        found.append(_judged(model(batch), batch))
    value = torch.cat(found)
    if not model.viewpoints:
        return {"top1": float((value == 0).double().mean()), "top5": float((value < 5).double().mean())}
    return {"acc_pi6": float((value < math.pi / 6).double().mean()), "med_err_deg": math.degrees(float(value.median()))}


def _judged(outputs: Tensor, batch: PictureBatch) -> Tensor:
    """Classes more likely than the true one, or the angle to the true rotation, of every picture."""
    if batch.viewpoint is None:
        own = outputs.gather(1, batch.label[:, None])
        return (outputs > own).sum(1).cpu()
    predicted = viewpoint_to_matrix(predicted_viewpoint(outputs).cpu().double())
    return geodesic_angle(predicted, viewpoint_to_matrix(batch.viewpoint.cpu().double()))
