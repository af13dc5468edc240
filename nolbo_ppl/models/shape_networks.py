"""Shape networks: the label-conditioned prior, the 3D-GAN-like decoder, and the 3D encoder of the shape autoencoder."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nolbo_ppl.devices import mixed_precision
from nolbo_ppl.models.model_config import ModelConfig
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


class StandardPrior(nn.Module):
    """Means of a prior that knows no labels: zero, N(0, I) for all."""

    def __init__(self, labels: int, latent_dim: int) -> None:
        super().__init__()
        self.mean: Tensor
        self.register_buffer("mean", torch.zeros(labels, latent_dim), persistent=False)

    def forward(self) -> Float[Tensor, "labels latent_dim"]:
        """The means of all labels."""
        return self.mean


class VoxelDecoder(nn.Module):
    """Latent -> logits of the occupancy of the canonical voxel grid, the generator of 3D-GAN with our input dimension.

    A dense layer fills a 4^3 grid; transposed convolutions of kernel 4 double it until it is 32^3 or 64^3.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        channels = config.decoder_channels
        self.dense = nn.Linear(config.latent_dim, channels[0] * 64)
        layers: list[nn.Module] = [SyncBatchNorm3d(channels[0]), nn.ELU()]
        for inputs, outputs in pairwise(channels):
            layers += [nn.ConvTranspose3d(inputs, outputs, 4, 2, 1, bias=False), SyncBatchNorm3d(outputs), nn.ELU()]
        last = PatchWriter(channels[-1]) if config.voxel_patches else nn.ConvTranspose3d(channels[-1], 1, 4, 2, 1)
        layers.append(last)
        self.layers = nn.Sequential(*layers)
        self.channels = channels[0]
        self.half_precision = False

    def forward(self, latent: Float[Tensor, "n d"]) -> Float[Tensor, "n v v v"]:
        """Occupancy logits, axes x, y, z of the canonical frame."""
        with mixed_precision(latent.device, self.half_precision):
            logits = self.layers(self.dense(latent).unflatten(-1, (self.channels, 4, 4, 4)))
        return logits.squeeze(1).to(latent.dtype)


class PatchWriter(nn.Module):
    """Transposed convolution of kernel 2 and stride 2 to one channel, as one matrix product."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.linear = nn.Linear(channels, 8)

    def forward(self, x: Float[Tensor, "n c v v v"]) -> Float[Tensor, "n 1 w w w"]:
        """Eight voxels from each cell of the grid."""
        cells = self.linear(x.movedim(1, -1)).unflatten(-1, (2, 2, 2))  # n x y z a b c
        return cells.permute(0, 1, 4, 2, 5, 3, 6).flatten(5, 6).flatten(3, 4).flatten(1, 2)[:, None]


class PatchReader(nn.Module):
    """4^3 patches of one channel through two dense layers: a grid of a quarter of the side."""

    def __init__(self, hidden: int, outputs: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(64, 2 * hidden), nn.ELU(), nn.Linear(2 * hidden, outputs))

    def forward(self, x: Float[Tensor, "n 1 w w w"]) -> Float[Tensor, "n c v v v"]:
        """Features of each patch."""
        v = x.shape[-1] // 4
        patches = x[:, 0].unflatten(3, (v, 4)).unflatten(2, (v, 4)).unflatten(1, (v, 4))  # n x a y b z c
        return self.layers(patches.permute(0, 1, 3, 5, 2, 4, 6).flatten(4)).movedim(-1, 1)


class VoxelEncoder(nn.Module):
    """Voxels -> (mean, log scale) of q(z | true shape), the 3D encoder of the shape autoencoder."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        channels = config.voxel_encoder_channels
        layers: list[nn.Module] = []
        inputs = 1
        if config.voxel_patches:
            inputs = channels[1]
            layers += [PatchReader(channels[0], inputs), nn.ELU()]
            channels = channels[2:]
        for outputs in channels:
            layers += [nn.Conv3d(inputs, outputs, 4, 2, 1, bias=False), SyncBatchNorm3d(outputs), nn.ELU()]
            inputs = outputs
        self.layers = nn.Sequential(*layers)
        self.dense = nn.Linear(inputs * 64, 2 * config.latent_dim)
        self.half_precision = False

    def forward(self, voxels: Float[Tensor, "n v v v"]) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d"]]:
        """Mean and scale of the latent of each shape; scales stay between exp(-6) and exp(2)."""
        with mixed_precision(voxels.device, self.half_precision):
            features = self.layers(2 * voxels[:, None] - 1).flatten(1)
        loc, log_scale = self.dense(features.to(voxels.dtype)).chunk(2, -1)
        return loc, bounded_exp(log_scale, -6.0, 2.0)


def bounded_exp(raw: Tensor, low: float, high: float) -> Tensor:
    """`exp(raw)` with the exponent kept smoothly inside (low, high), low < 0 < high; it is 1 at raw = 0.

    Unclipped log variances were a trap of the first public code: one far outlier makes the likelihood infinite. A hard
    clip would stop the gradient, a tanh does not.
    """
    middle, half = (low + high) / 2, (high - low) / 2
    return torch.exp(middle + half * torch.tanh(raw / half + math.atanh(-middle / half)))
