"""The discriminator of the 3D-VAE-GAN and its two losses (Wu et al. 2016, section 3.2)."""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn.functional import logsigmoid

from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.shape_networks import VoxelDecoder, VoxelEncoder


class Discriminator(nn.Module):
    """Voxels -> log odds that they are a true shape: the 3D encoder with one output."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.network = VoxelEncoder(dataclasses.replace(config, method="nolbo", instances=(), instance_category=(), latent_dim=1))

    def forward(self, voxels: Float[Tensor, "n v v v"]) -> Float[Tensor, " n"]:
        """Log odds of each grid of occupancy probabilities."""
        return self.network(voxels)[0][:, 0]


CONFIDENT = 0.8
"""A discriminator that is right about this share of a batch does not learn from it (Wu et al. 2016, section 3.1)."""


def adversarial_terms(
    discriminator: Discriminator,
    decoder: VoxelDecoder,
    voxels: Float[Tensor, "n v v v"],
    latent: Float[Tensor, "n d"],
) -> dict[str, Tensor]:
    """Terms to be maximised, nats summed over the shapes.

    `discriminator`: `log D(x) + log(1 - D(G(z)))`, whose gradient reaches D alone, and none where D is right about more than
    `CONFIDENT` of the batch. `generator`: `log D(G(z))`, whose gradient reaches G alone (the form that does not saturate, for
    the paper's `log(1 - D(G(z)))` has no gradient while D is sure).

    Args:
        discriminator: D.
        decoder: G, in logits.
        voxels: true shapes x.
        latent: samples z of the prior N(0, I), as many.
    """
    fake = torch.sigmoid(decoder(latent))
    # True and made shapes go through in one batch: batch normalisation would tell them apart by their batch.
    both = discriminator(torch.cat((voxels, fake.detach())))
    real, made = both.split((len(voxels), len(fake)))
    right = torch.cat((real > 0, made < 0)).to(both.dtype).mean()
    learns = (right <= CONFIDENT).to(both.dtype)
    own = (logsigmoid(real) + logsigmoid(-made)).sum()
    still = {name: value.detach().clone() for name, value in discriminator.state_dict(keep_vars=True).items()}
    judged = functional_call(discriminator, still, (torch.cat((voxels, fake)),))[len(voxels) :]
    return {"discriminator": learns * own + (1 - learns) * own.detach(), "generator": logsigmoid(judged).sum()}
