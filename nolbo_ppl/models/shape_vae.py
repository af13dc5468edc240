"""The shape autoencoder of the first stage: prior network, decoder and a 3D encoder, as a Pyro model and guide."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn

from nolbo_ppl._moved import renamed
from nolbo_ppl.models.distributions import NoisyNormal
from nolbo_ppl.models.generative import GenerativeModel, voxel_site
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.pyro_parameters import declare_parameters
from nolbo_ppl.models.scene_batch import unpack_bits
from nolbo_ppl.models.shape_networks import VoxelEncoder


@dataclass
class ShapeBatch:
    """Voxels with their labels."""

    voxels: UInt8[Tensor, "n bytes"]
    """Canonical voxels, packed bits in C order."""
    category: Int[Tensor, " n"]
    """Category label."""
    instance: Int[Tensor, " n"]
    """Instance label, -1 for none of the known ones."""
    noise: Float[Tensor, "n d"] | None = None
    """Standard normal noise of the latent's sample."""


class ShapeGenerativeModel(nn.Module):
    """The part of the story that makes voxels from labels; shares prior and decoder with the story of scenes."""

    def __init__(self, story: GenerativeModel) -> None:
        super().__init__()
        self.story = story

    def forward(self, batch: ShapeBatch, decode: int | None = None) -> None:
        """p(z | l) p(voxels | z) of each shape; an instance of -1 is "novel" here, the prior's zero mean.

        Args:
            batch: the shapes, in random order.
            decode: only the first so many are decoded; their voxel term is scaled up to stand for all. None decodes all.
        """
        declare_parameters("model", self.story)
        prior, size = self.story.prior, self.story.config.voxel_size
        with pyro.plate("scenes", 1, dim=-2), pyro.plate("objects", len(batch.voxels), dim=-1):
            mean = prior.category_mean()[batch.category][None]
            if prior.instance is not None:
                instance = torch.where(batch.instance < 0, len(prior.instance_category), batch.instance)
                mean = torch.cat((mean, prior.instance_mean()[instance][None]), -1)
            latent = pyro.sample("shape_latent", dist.Normal(mean, torch.ones_like(mean)).to_event(1))
            category = latent[..., : prior.category_dim]
            squared = (category[..., None, :] - prior.category_mean()).square().sum(-1)
            pyro.sample("shape_label", dist.Categorical(logits=-0.5 * squared), obs=batch.category[None])
        logits = self.story.decoder(latent[0, :decode])
        observed = unpack_bits(batch.voxels[:decode], size).to(logits.dtype)
        voxel_site(logits, observed, len(batch.voxels) / max(len(observed), 1))


class ShapeGuide(nn.Module):
    """q(z | true shape): the teacher of the image guide."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = VoxelEncoder(config)

    def posterior(self, packed: UInt8[Tensor, "n bytes"]) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d"]]:
        """Mean and scale of the latent of each packed grid."""
        dtype = self.encoder.dense.weight.dtype
        loc, scale = self.encoder(unpack_bits(packed, self.config.voxel_size).to(dtype))
        return loc, torch.ones_like(scale) if self.config.description.point else scale

    def forward(self, batch: ShapeBatch, decode: int | None = None) -> None:
        """The Pyro guide of `ShapeGenerativeModel`, whose argument `decode` is without use here."""
        declare_parameters("guide", self)
        loc, scale = self.posterior(batch.voxels)
        noise = None if batch.noise is None else batch.noise[None]
        if self.config.description.point:
            noise = torch.zeros_like(loc)[None]
        with pyro.plate("scenes", 1, dim=-2), pyro.plate("objects", len(loc), dim=-1):
            pyro.sample("shape_latent", NoisyNormal(loc[None], scale[None], noise).to_event(1))


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
