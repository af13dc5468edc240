"""Shape networks: the label-conditioned prior, the 3D-GAN-like decoder, and the 3D encoder of the shape autoencoder."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nolbo_ppl.models.config import ModelConfig
from nolbo_ppl.models.normalisation import SyncBatchNorm3d


class PriorNetwork(nn.Module):
    """mu_psi: label -> mean of its unit-variance Gaussian in the latent space (NOLBO, GMM prior p_psi(z|l))."""

    def __init__(self, labels: int, latent_dim: int, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(labels, width), nn.ELU(), nn.Linear(width, latent_dim))
        # One-hot inputs: start with means about three units apart, so that labels can be told apart from the first step.
        nn.init.normal_(self.layers[0].weight, std=1.0)  # type: ignore[arg-type]
        nn.init.normal_(self.layers[2].weight, std=2.0 / width**0.5)  # type: ignore[arg-type]
        self.register_buffer("one_hot", torch.eye(labels), persistent=False)

    def forward(self) -> Float[Tensor, "labels latent_dim"]:
        """The means of all labels."""
        return self.layers(self.one_hot)


class VoxelDecoder(nn.Module):
    """Latent -> logits of the occupancy of the canonical voxel grid, the generator of 3D-GAN with our input dimension.

    A dense layer fills a 4^3 grid; transposed convolutions of kernel 4 double it until it is 32^3 or 64^3.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        channels = config.decoder_channels
        self.dense = nn.Linear(config.latent_dim, channels[0] * 64)
        layers: list[nn.Module] = [SyncBatchNorm3d(channels[0]), nn.ELU()]
        for inputs, outputs in zip(channels[:-1], channels[1:]):
            layers += [nn.ConvTranspose3d(inputs, outputs, 4, 2, 1, bias=False), SyncBatchNorm3d(outputs), nn.ELU()]
        layers.append(nn.ConvTranspose3d(channels[-1], 1, 4, 2, 1))
        self.layers = nn.Sequential(*layers)
        self.channels = channels[0]

    def forward(self, latent: Float[Tensor, "n d"]) -> Float[Tensor, "n v v v"]:
        """Occupancy logits, axes x, y, z of the canonical frame."""
        return self.layers(self.dense(latent).unflatten(-1, (self.channels, 4, 4, 4))).squeeze(1)


class VoxelEncoder(nn.Module):
    """Voxels -> (mean, log scale) of q(z | true shape), the 3D encoder of the shape autoencoder."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        inputs = 1
        for outputs in config.voxel_encoder_channels:
            layers += [nn.Conv3d(inputs, outputs, 4, 2, 1, bias=False), SyncBatchNorm3d(outputs), nn.ELU()]
            inputs = outputs
        self.layers = nn.Sequential(*layers)
        self.dense = nn.Linear(inputs * 64, 2 * config.latent_dim)

    def forward(self, voxels: Float[Tensor, "n v v v"]) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d"]]:
        """Mean and scale of the latent of each shape; scales stay between exp(-6) and exp(2)."""
        loc, log_scale = self.dense(self.layers(2 * voxels[:, None] - 1).flatten(1)).chunk(2, -1)
        return loc, bounded_exp(log_scale, -6.0, 2.0)


def bounded_exp(raw: Tensor, low: float, high: float) -> Tensor:
    """`exp(raw)` with the exponent kept smoothly inside (low, high), low < 0 < high; it is 1 at raw = 0.

    Unclipped log variances were a trap of the first public code: one far outlier makes the likelihood infinite. A hard
    clip would stop the gradient, a tanh does not.
    """
    middle, half = (low + high) / 2, (high - low) / 2
    return torch.exp(middle + half * torch.tanh(raw / half + math.atanh(-middle / half)))
