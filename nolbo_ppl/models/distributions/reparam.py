"""A normal distribution whose sample is made from noise given by the caller."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from pyro.distributions import Normal
from torch import Tensor
from torch.distributions.utils import broadcast_all
from torch.types import _size

from nolbo_ppl.errors import input_error


class NoisyNormal(Normal):
    """`Normal(loc, scale)` whose `rsample()` is `loc + scale * noise` when noise is given.

    Noise drawn by the caller (keyed by step and scene, say) makes a step the same after a resume and however the batch
    is spread over processes. Without noise it is the ordinary normal. KLs are those of `Normal`.

    Args:
        loc: mean.
        scale: standard deviation.
        noise: standard normal numbers for one sample, broadcastable to the batch shape.
    """

    def __init__(
        self,
        loc: Float[Tensor, "*#batch"],
        scale: Float[Tensor, "*#batch"] | float,
        noise: Float[Tensor, "*#batch"] | None = None,
        validate_args: bool | None = None,
    ) -> None:
        if noise is not None:
            loc, scale, noise = broadcast_all(loc, scale, noise)
        self.noise = noise
        super().__init__(loc, scale, validate_args=validate_args)

    def expand(self, batch_shape: Sequence[int], _instance: object = None) -> NoisyNormal:
        """The same distribution with a larger batch shape; the noise is shared by the new dimensions."""
        new = self._get_checked_instance(NoisyNormal, _instance)
        batch_shape = torch.Size(batch_shape)
        new.noise = None if self.noise is None else self.noise.expand(batch_shape)
        return super().expand(batch_shape, _instance=new)

    def rsample(self, sample_shape: _size = ()) -> Float[Tensor, "*shape"]:
        """Reparameterised sample. Raises `InputError` when several are asked for and noise for one was given."""
        if self.noise is None:
            return super().rsample(sample_shape)
        if torch.Size(sample_shape) != torch.Size():
            raise input_error(
                "noise for one sample, but several are asked for",
                got=tuple(sample_shape),
                expected="an empty sample_shape",
                do="give noise=None or put the sample dimensions in loc",
            )
        return self.loc + self.scale * self.noise

    def sample(self, sample_shape: _size = ()) -> Float[Tensor, "*shape"]:
        """Sample without gradient, from the same noise."""
        with torch.no_grad():
            return self.rsample(sample_shape)
