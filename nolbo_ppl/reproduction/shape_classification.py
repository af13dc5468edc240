"""Classification of shapes by maximum likelihood over the prior means of the 3D VAE's latent (NOLBO, appendix II).

The shape autoencoder of the first training stage (`models/shape_vae`: 3D encoder, prior networks, decoder) is trained on
labelled shapes; a held-out shape is given the class whose prior N(mu_psi(l), I) its posterior mean is likeliest under.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nolbo_ppl.data.voxel_archive import VoxelArchive
from nolbo_ppl.devices import device_of, placed
from nolbo_ppl.errors import input_error
from nolbo_ppl.inference import svi as optimisation
from nolbo_ppl.inference.elbo import SHAPE_LABEL, SHAPE_STAGE
from nolbo_ppl.inference.posterior.decode import category_log_likelihood
from nolbo_ppl.inference.posterior.decoded_shapes import decode_latents
from nolbo_ppl.inference.posterior.model_folder import load
from nolbo_ppl.inference.svi import OptimizerConfig
from nolbo_ppl.io.tensors import load_tensors, save_tensors
from nolbo_ppl.metrics.voxel import voxel_iou
from nolbo_ppl.models.model_config import ModelConfig, nano, tiny
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.scene_batch import pack_bits
from nolbo_ppl.models.shape_vae import ShapeBatch
from nolbo_ppl.progress import progress_bar
from nolbo_ppl.training.initial_weights import SHAPE_FEATURES, adopt_features
from nolbo_ppl.training.stages import StageRun, TrainingStage, seeded_noise


@dataclass(frozen=True)
class ShapeVaeConfig:
    """Training of the shape autoencoder on an archive of shapes."""

    steps: int = 500
    """Optimiser steps."""
    batch: int = 32
    """Shapes a step."""
    latent_dim: int = 16
    """Dimensions of the latent."""
    initial: str | None = "tiny"
    """Weights whose convolutions of 3D encoder and decoder are started from; latent and prior start afresh. None for none."""
    decode: int = 8
    """Shapes decoded a step, which stand for all: the decoder costs four times what the encoder does."""
    learning_rate: float = 2e-3
    """Rate after the warm-up; it falls along a cosine over the second half."""
    label_weight: float = 200.0
    """Weight of the term that keeps classes apart (`shape_label`), beside voxels of a thousand nats and more: after 400 steps on
    ModelNet10, on shapes kept for such choices, accuracy was 0.85 at a weight of 20, 0.89 at 200, 0.90 without voxels."""
    balance: float = 0.5
    """Shapes of a class of n shapes are drawn in proportion to n^-balance: 0 takes all shapes alike, 1 all classes."""
    mirror: bool = True
    """Half of the shapes are mirrored, left for right (`augmented`). Mirrored front to back as well, the encoder alone reached
    0.87 in place of 0.90."""
    stretch: float = 0.15
    """Shapes are stretched along every axis by a factor of up to 1 + stretch or its inverse, at the same longest side."""
    shift: int = 0
    """Shapes are moved by up to so many voxels along every axis. Where an archive's shapes lie in the middle, as ModelNet10's,
    the latent would spend itself on places that never come: 2 370 nats of voxels after 400 steps, 2 000 without."""
    half_precision: bool = False
    """Networks in bfloat16: on processors without instructions for it a step takes 1.8 times as long."""
    seed: int = 0
    """Seed of weights, order, augmentation and noise."""
    checkpoint_every: int = 200
    """Steps between checkpoints."""

    def model(self, names: tuple[str, ...]) -> ModelConfig:
        """The networks: shape networks of `tiny`, and the smallest image encoder, which is not trained."""
        shapes = tiny() if self.initial is None else load(self.initial, "cpu").config
        return dataclasses.replace(
            nano(),
            categories=names,
            symmetry=(1,) * len(names),
            latent_dim=self.latent_dim,
            prior_width=shapes.prior_width,
            voxel_size=shapes.voxel_size,
            voxel_patches=shapes.voxel_patches,
            voxel_encoder_channels=shapes.voxel_encoder_channels,
            decoder_channels=shapes.decoder_channels,
        )


def balanced_rows(category: Int[Tensor, " n"], count: int, balance: float, generator: torch.Generator) -> Int[Tensor, " count"]:
    """Numbers of the shapes of a batch, none twice; a shape of a class of n shapes is drawn in proportion to n^-balance.

    Raises:
        InputError: fewer shapes than are wanted.
    """
    if count > len(category):
        raise input_error("shapes of a batch", got=count, expected=f"at most the {len(category)} there are")
    weight = torch.bincount(category).double().clamp_min(1).pow(-balance)[category]
    return torch.multinomial(weight, count, replacement=False, generator=generator)


def augmented(
    voxels: Bool[Tensor, "n v v v"], generator: torch.Generator, mirror: bool = True, stretch: float = 0.0, shift: int = 0
) -> Bool[Tensor, "n v v v"]:
    """Other shapes of the same classes: mirrored, stretched and moved at random, in voxels of the nearest place.

    Args:
        voxels: shapes, none empty; the third axis points upwards.
        generator: of the random numbers.
        mirror: half of the shapes are mirrored along the horizontal axis that changes them less, left for right. The other
            one would turn front to back: a set of aligned shapes has no such ones.
        stretch: factors along the three axes are log-uniform up to 1 + stretch, brought to the shape's longest side.
        shift: voxels along every axis at most; what leaves the grid is lost.
    """
    n, side = len(voxels), voxels.shape[1]
    chosen = torch.rand(n, 1, generator=generator) < 0.5
    factor = torch.exp((2 * torch.rand(n, 3, generator=generator) - 1) * math.log1p(stretch))
    offset = torch.randint(-shift, shift + 1, (n, 3), generator=generator)
    sign = torch.ones(n, 3)
    if mirror:
        same = torch.stack([(voxels & voxels.flip(axis)).flatten(1).sum(1) for axis in (1, 2)], 1)
        sign.scatter_(1, same.argmax(1, keepdim=True), torch.where(chosen, -1.0, 1.0))
    flat = voxels.any(3)
    extent = torch.stack((flat.any(2).sum(1), flat.any(1).sum(1), voxels.any(2).any(1).sum(1)), 1).float()
    factor = factor * (extent.amax(1) / (extent * factor).amax(1))[:, None]
    place = torch.arange(side) + 0.5 - side / 2  # of the voxels' centres from the grid's
    source = (place - offset[..., None]) / factor[..., None] * sign[..., None] + side / 2
    inside = (source >= 0) & (source < side)
    x, y, z = source.floor().long().clamp(0, side - 1).unbind(1)
    in_x, in_y, in_z = inside.unbind(1)
    out = voxels[torch.arange(n)[:, None, None, None], x[:, :, None, None], y[:, None, :, None], z[:, None, None, :]]
    return out & in_x[:, :, None, None] & in_y[:, None, :, None] & in_z[:, None, None, :]


def fit_shape_vae(
    archive: VoxelArchive,
    config: ShapeVaeConfig,
    checkpoint: Path | None = None,
    report: Callable[[optimisation.StepInfo], None] | None = None,
    device: str = "cpu",
) -> Nolbo:
    """Train the shape autoencoder; a killed run goes on from its checkpoint, bit for bit.

    Args:
        archive: shapes to learn from.
        config: networks and optimisation.
        checkpoint: file to keep the state in and to go on from.
        report: called after each step.
        device: where to train; the networks come back to the CPU.

    Raises:
        InputError: no shapes, or the checkpoint belongs to another configuration.
    """
    if not len(archive):
        raise input_error("no shapes to learn")
    model = Nolbo.from_seed(config.model(archive.names), config.seed)
    if config.initial is not None:
        adopt_features(model, load(config.initial, "cpu").model, SHAPE_FEATURES)
    where = device_of(device)
    model = model.to(where, torch.get_default_dtype())
    schedule = OptimizerConfig(config.steps, config.learning_rate, warmup=min(50, config.steps), clip=5000.0, ema=0.99)
    weights = {**SHAPE_STAGE, SHAPE_LABEL: config.label_weight}
    run = StageRun(model, TrainingStage("shapes", schedule, weights, decode=config.decode), config.half_precision)
    identity = {**dataclasses.asdict(config), "shapes": len(archive)}
    identity = {name: list(v) if isinstance(v, tuple) else v for name, v in identity.items() if name != "checkpoint_every"}
    if checkpoint is not None and checkpoint.is_file():
        tensors, meta = load_tensors(checkpoint)
        if meta.get("identity") != identity:
            raise input_error("the checkpoint belongs to another configuration", got=meta.get("identity"), file=checkpoint)
        optimisation.restore(run.state, tensors, meta["step"])
    voxels, category = torch.from_numpy(archive.voxels), torch.from_numpy(archive.category)
    bar = progress_bar(None, "shapes", "step", total=config.steps, done=run.state.step)
    with bar:
        while not run.finished:
            step = run.state.step
            generator = torch.Generator().manual_seed(config.seed * 1_000_003 + step)
            index = balanced_rows(category, min(config.batch, len(archive)), config.balance, generator)
            shapes = augmented(voxels[index], generator, config.mirror, config.stretch, config.shift)
            noise = seeded_noise(config.seed, step, len(index), config.latent_dim).to(torch.get_default_dtype())
            batch = ShapeBatch(pack_bits(shapes), category[index], torch.full((len(index),), -1), noise)
            info = run.step(placed(batch, where))
            bar.update()
            if report is not None:
                report(info)
            if checkpoint is not None and (run.state.step % config.checkpoint_every == 0 or run.finished):
                save_tensors(checkpoint, optimisation.state_tensors(run.state), {"identity": identity, "step": run.state.step})
    run.load_ema()
    model.set_half_precision(False)
    return model.cpu().eval().requires_grad_(False)


@dataclass(frozen=True)
class ShapeScores:
    """What the autoencoder makes of held-out shapes, a row each."""

    category: Int[np.ndarray, " n"]
    """True class."""
    predicted: Int[np.ndarray, " n"]
    """Class of the highest likelihood."""
    iou: Float[np.ndarray, " n"]
    """Intersection over union of the decoded posterior mean, at one half, with the shape itself."""
    category_iou: Float[np.ndarray, " n"]
    """The same of the decoded prior mean of the true class: what knowing the class alone gives."""


@torch.inference_mode()
def score_shapes(model: Nolbo, archive: VoxelArchive, batch: int = 128) -> ShapeScores:
    """Classify and rebuild shapes.

    Args:
        model: trained by `fit_shape_vae`.
        archive: shapes that were held out.
        batch: shapes at once.
    """
    prior, mean = model.story.prior, model.story.prior.label_mean()
    of_class = decode_latents(model.story.decoder, mean)
    predicted, iou, class_iou = [], [], []
    for start in range(0, len(archive), batch):
        truth, label = archive.voxels[start : start + batch], archive.category[start : start + batch]
        loc, _ = model.shape_guide.posterior(pack_bits(torch.from_numpy(truth)))
        predicted.append(category_log_likelihood(loc, prior, mean).argmax(-1).numpy())
        iou.append(voxel_iou(decode_latents(model.story.decoder, loc), truth))
        class_iou.append(voxel_iou(of_class[label], truth))
    return ShapeScores(archive.category, *(np.concatenate(values) for values in (predicted, iou, class_iou)))
