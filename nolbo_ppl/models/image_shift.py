"""How unlike an image is to those that were learnt from: distance of its mean features from theirs."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

AXES = 16
"""Principal axes of the features along which the spread of learnt images is known one by one."""
RESIDUAL_WEIGHT = 10.0
"""Weight of what lies off these axes, in axes: there the features of noise, drawings and leaves differ most."""
MIN_SPREAD = 1e-3
"""Least spread of a feature."""
ODDS_PER_SHIFT = 6.0
"""Log odds of objectness that an image loses for each unit of shift beyond 1."""
SCALE_PER_SHIFT = 1.0
"""Relative growth of every scale for each unit of shift beyond 1."""


class ImageShift(nn.Module):
    """Shift score of images: 0 for one in the middle of the held-out ones of its kind, 1 for one farther off than 97 of 100.

    The distance is Mahalanobis' along the principal axes, with what is left of the features as one more term (in its own spread),
    on a logarithmic scale. An image is as shifted as it is from the nearest kind: photographs, or generated scenes. Until
    `learn` is called every score is 0.

    Args:
        features: numbers that describe an image.
        kinds: kinds of images.
        axes: principal axes of each.

    Example:
        >>> g = torch.Generator().manual_seed(0)
        >>> shift = ImageShift(20, kinds=1, axes=4)
        >>> shift.learn(0, torch.randn(400, 20, generator=g), torch.randn(400, 20, generator=g))
        >>> near, far = shift(torch.stack((torch.zeros(20), torch.full((20,), 3.0)))).tolist()
        >>> near < 1 < far
        True
    """

    def __init__(self, features: int, kinds: int = 2, axes: int = AXES) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(kinds, features))
        self.register_buffer("spread", torch.ones(kinds, features))
        self.register_buffer("axes", torch.zeros(kinds, axes, features))
        self.register_buffer("precision", torch.ones(kinds, axes))
        self.register_buffer("residual_precision", torch.ones(kinds))
        self.register_buffer("middle", torch.zeros(kinds))
        self.register_buffer("inverse_span", torch.zeros(kinds))

    def _log_distance(self, context: Float[Tensor, "b c"], kind: int) -> Float[Tensor, " b"]:
        parts = (getattr(self, name)[kind] for name in ("mean", "spread", "axes", "precision", "residual_precision"))
        mean, spread, axes, precision, residual_precision = parts
        z = (context - mean) / spread
        along = z @ axes.T
        off = (z - along @ axes).square().sum(-1) * residual_precision
        squared = (along.square() * precision).sum(-1) + RESIDUAL_WEIGHT * off
        return torch.log(squared.clamp_min(1e-12) / (len(axes) + RESIDUAL_WEIGHT))

    def forward(self, context: Float[Tensor, "b c"]) -> Float[Tensor, " b"]:
        """Score of each image."""
        middle, inverse = self.get_buffer("middle"), self.get_buffer("inverse_span")
        learnt = torch.nonzero(inverse > 0).flatten().tolist()
        if not learnt:
            return context.new_zeros(len(context))
        scores = [(self._log_distance(context, kind) - middle[kind]) * inverse[kind] for kind in learnt]
        return torch.stack(scores).amin(0)

    @torch.no_grad()
    def learn(self, kind: int, images: Float[Tensor, "n c"], held_out: Float[Tensor, "m c"]) -> None:
        """Take the statistics of a kind of images: axes and spread from `images`, the scale of the score from `held_out`.

        With few images there are fewer axes.
        """
        own, buffers = images.double(), dict(self.named_buffers())
        mean, spread = own.mean(0), own.std(0).clamp_min(MIN_SPREAD)
        z = (own - mean) / spread
        _, singular, directions = torch.linalg.svd(z, full_matrices=False)
        axes = min(buffers["axes"].shape[1], max(len(own) // 8, 1), len(singular))
        variance = singular.square() / len(own)
        for name in ("axes", "precision"):
            buffers[name][kind].zero_()
        buffers["mean"][kind], buffers["spread"][kind] = mean.to(images.dtype), spread.to(images.dtype)
        buffers["axes"][kind, :axes] = directions[:axes].to(images.dtype)
        buffers["precision"][kind, :axes] = (1 / variance[:axes].clamp_min(1e-6)).to(images.dtype)
        buffers["residual_precision"][kind] = 1 / float(variance[axes:].sum().clamp_min(1e-6))
        distance = self._log_distance(held_out.to(images.dtype), kind).double()
        middle, far = distance.median(), torch.quantile(distance, 0.97)
        buffers["middle"][kind], buffers["inverse_span"][kind] = float(middle), 1 / max(float(far - middle), 0.1)


def excess(shift: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """How far beyond what was learnt: the score above 1; 0 for scores that are not known."""
    return torch.nan_to_num(shift - 1, nan=0.0).clamp(0, math.inf)
