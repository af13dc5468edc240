"""What a posterior of shape latents says about voxels and extents: mean and variance over samples through the decoder."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nolbo_ppl._moved import renamed
from nolbo_ppl.errors import input_error

Decoder = Callable[[Float[Tensor, "n d"]], Float[Tensor, "n v v v"]]
"""Log odds of the occupancy of each voxel, for shape latents."""
AT_ONCE = 64
"""Shapes decoded at once: all samples of all objects would not fit the cache."""


class DecodedShape(NamedTuple):
    """Shapes of n objects."""

    mean: Float[np.ndarray, "n v v v"] | None
    """Posterior mean occupancy of the canonical grid; None when shapes were not decoded."""
    variance: Float[np.ndarray, "n v v v"] | None
    """Its variance over the shape latent."""
    size: Float[np.ndarray, "n 3"]
    """Extents along the object's own axes, m."""


def decode_latents(decoder: Decoder, latent: Float[Tensor, "n d"]) -> Float[np.ndarray, "n v v v"]:
    """Occupancy probability of each voxel for given latents, of which there must be some."""
    return torch.cat([torch.sigmoid(decoder(part)) for part in latent.split(AT_ONCE)]).cpu().numpy()


def sampled_shapes(
    decoder: Decoder,
    voxel_size: int,
    loc: Float[Tensor, "n d"],
    scale: Float[Tensor, "n d"],
    diagonal: Float[np.ndarray, " n"],
    samples: int,
    seed: int,
) -> DecodedShape:
    """Mean and variance of the voxels over `N(loc, scale^2)`, and extents of the shape at `loc`.

    Args:
        decoder: see `Decoder`.
        voxel_size: side v of its grid.
        loc: mean of the latents.
        scale: their scale.
        diagonal: of the objects' boxes, m.
        samples: of the latent; the same ones for all objects, so that an answer is the same in any company.
        seed: of the samples.

    Raises:
        InputError: fewer than two samples.
    """
    if samples < 2:
        raise input_error("samples of the shape latent", got=samples, expected="at least 2, for a variance")
    n, d = loc.shape
    noise = np.random.default_rng(seed).standard_normal((samples, 1, d))
    latents = torch.cat((loc[None], loc + scale * torch.as_tensor(noise, dtype=loc.dtype)))
    grid = (n,) + (voxel_size,) * 3
    mean, variance, size = np.empty(grid, np.float32), np.empty(grid, np.float32), np.empty((n, 3))
    step = max(1, AT_ONCE // (samples + 1))
    for first in range(0, n, step):
        part = slice(first, first + step)
        chunk = latents[:, part]
        decoded = torch.sigmoid(decoder(chunk.flatten(0, 1))).unflatten(0, chunk.shape[:2])
        middle = decoded[1:].mean(0)
        squares = (decoded[1:] - middle).square_().sum(0)  # torch.var_mean takes 20 times as long here
        mean[part], variance[part] = middle.cpu().numpy(), (squares / (samples - 1)).cpu().numpy()
        size[part] = extents(decoded[0].cpu().numpy()) * diagonal[part][:, None]
    return DecodedShape(mean, variance, size)


def extents(occupancy: Float[np.ndarray, "n v v v"]) -> Float[np.ndarray, "n 3"]:
    """Extents along x, y, z of occupied voxels in units of the grid's side, scaled to a diagonal of one."""
    n = occupancy.shape[1]
    result = np.empty((len(occupancy), 3))
    for i, grid in enumerate(occupancy > 0.5):
        for axis in range(3):
            used = np.flatnonzero(grid.any(axis=tuple({0, 1, 2} - {axis})))
            result[i, axis] = (used[-1] - used[0] + 1) / n if len(used) else 3**-0.5
    return result / np.linalg.norm(result, axis=1, keepdims=True)


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
