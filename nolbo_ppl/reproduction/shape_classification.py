"""Classification of shapes by maximum likelihood over the prior means of the 3D VAE's latent (NOLBO, appendix II).

The shape autoencoder of the first training stage (`models/shape_vae`: 3D encoder, prior networks, decoder) is trained on
labelled shapes; a held-out shape is given the class whose prior N(mu_psi(l), I) its posterior mean is likeliest under.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nolbo_ppl.data.loader import batch_indices
from nolbo_ppl.data.voxel_archive import VoxelArchive
from nolbo_ppl.devices import device_of, placed
from nolbo_ppl.errors import input_error
from nolbo_ppl.inference import svi as optimisation
from nolbo_ppl.inference.elbo import SHAPE_STAGE
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
    shift: int = 1
    """Shapes are moved by up to so many voxels along every axis."""
    half_precision: bool = True
    """Networks in bfloat16."""
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


def augmented(voxels: Bool[Tensor, "n v v v"], shift: int, generator: torch.Generator) -> Bool[Tensor, "n v v v"]:
    """Shapes mirrored at random along each of the two horizontal axes, and moved by up to `shift` voxels along every axis.

    A mirrored shape is another shape of its class. What leaves the grid on one side is lost: no shape may reach the border.
    """
    out = voxels
    for axis in (1, 2):
        flip = torch.rand(len(out), generator=generator) < 0.5
        out = torch.where(flip[:, None, None, None], out.flip(axis), out)
    if shift:
        moved = torch.zeros_like(out)
        offset = torch.randint(-shift, shift + 1, (len(out), 3), generator=generator).tolist()
        for row, by in enumerate(offset):
            to = tuple(slice(max(b, 0), out.shape[1] + min(b, 0)) for b in by)
            of = tuple(slice(max(-b, 0), out.shape[1] + min(-b, 0)) for b in by)
            moved[row][to] = out[row][of]
        out = moved
    return out


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
    run = StageRun(model, TrainingStage("shapes", schedule, SHAPE_STAGE, decode=config.decode), config.half_precision)
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
            index = torch.from_numpy(batch_indices(len(archive), config.batch, config.seed, step))
            generator = torch.Generator().manual_seed(config.seed * 1_000_003 + step)
            shapes = augmented(voxels[index], config.shift, generator)
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
