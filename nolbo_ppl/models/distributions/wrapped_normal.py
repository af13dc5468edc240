"""The normal distribution wrapped around the circle, its trigonometric moments and its KL in the angle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Float
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints
from torch.distributions.utils import broadcast_all
from torch.types import _size

from nolbo_ppl.geometry.rotation import wrap_angle
from nolbo_ppl.models.distributions.circular import circular

_WIDE = 1.5
"""Scale in rad from which the Fourier series is used: on both sides of it 5 wraps or 6 harmonics reach 1e-17."""


class TrigonometricMoments(NamedTuple):
    """Mean and covariance of (sin, cos) of a random angle."""

    mean: Float[Tensor, "*batch 2"]
    """E[sin], E[cos]."""
    variance: Float[Tensor, "*batch 2"]
    """Var[sin], Var[cos]."""
    covariance: Float[Tensor, "*batch"]
    """Cov[sin, cos]."""


def wrapped_normal_moments(loc: Float[Tensor, "*#batch"], scale: Float[Tensor, "*#batch"]) -> TrigonometricMoments:
    """Moments of (sin, cos) of a wrapped normal angle, accurate near the axes in float32.

    NOLBO eq. (meanvarofwrappedgaussian), whose variances (there called sigma) lose 26 % in float32 at a scale of
    0.03 rad where the true one is scale^4 / 2. With `u = 1 - exp(-scale^2)` nothing cancels (docs/bound.md, corrections).
    """
    square = scale * scale
    u = -torch.expm1(-square)
    sine, cosine = torch.sin(loc), torch.cos(loc)
    trig = torch.stack((sine, cosine), dim=-1)
    across = torch.stack((cosine, sine), dim=-1)
    mean = torch.exp(-square / 2)[..., None] * trig
    u_ = u[..., None]
    variance = u_ * ((1 - u_) * across * across + u_ / 2)
    covariance = -sine * cosine * torch.exp(-square) * u
    return TrigonometricMoments(mean, variance, covariance)


class WrappedNormal(TorchDistribution):
    """`loc + scale * N(0, 1)` modulo 2 pi, a density on the circle [-pi, pi).

    Args:
        loc: mean direction in rad, any real number.
        scale: standard deviation in rad of the angle before wrapping.

    Source: Mardia & Jupp, Directional Statistics, section 3.5.7.
    """

    arg_constraints: ClassVar = {"loc": constraints.real, "scale": constraints.positive}
    support = circular
    has_rsample = True

    def __init__(
        self,
        loc: Float[Tensor, "*#batch"] | float,
        scale: Float[Tensor, "*#batch"] | float,
        validate_args: bool | None = None,
    ) -> None:
        self.loc, self.scale = broadcast_all(loc, scale)
        super().__init__(self.loc.shape, validate_args=validate_args)

    def expand(self, batch_shape: Sequence[int], _instance: object = None) -> WrappedNormal:
        """The same distribution with a larger batch shape."""
        new = self._get_checked_instance(WrappedNormal, _instance)
        batch_shape = torch.Size(batch_shape)
        new.loc, new.scale = self.loc.expand(batch_shape), self.scale.expand(batch_shape)
        super(WrappedNormal, new).__init__(batch_shape, validate_args=False)
        new._validate_args = self._validate_args
        return new

    def log_prob(self, value: Float[Tensor, "*value"]) -> Float[Tensor, "*shape"]:
        """Exact log density in nats per rad: a sum over wraps when narrow, over harmonics when wide."""
        if self._validate_args:
            self._validate_sample(value)
        difference = wrap_angle(value - self.loc)
        return _log_density(difference, self.scale)

    def rsample(self, sample_shape: _size = ()) -> Float[Tensor, "*shape"]:
        """Reparameterised sample in [-pi, pi)."""
        shape = self._extended_shape(sample_shape)
        noise = torch.randn(shape, dtype=self.loc.dtype, device=self.loc.device)
        return wrap_angle(self.loc + self.scale * noise)

    def trigonometric_moments(self) -> TrigonometricMoments:
        """Mean, variance and covariance of (sin, cos) of the angle."""
        return wrapped_normal_moments(self.loc, self.scale)

    @property
    def mean(self) -> Float[Tensor, "*batch"]:
        """The mean direction in rad, in [-pi, pi)."""
        return wrap_angle(self.loc)

    @property
    def mode(self) -> Float[Tensor, "*batch"]:
        """The direction of the highest density in rad."""
        return wrap_angle(self.loc)

    @property
    def variance(self) -> Float[Tensor, "*batch"]:
        """The circular variance `1 - |E[exp(i v)]|`, between 0 and 1 (that of the angle itself is `scale**2`)."""
        return -torch.expm1(-self.scale * self.scale / 2)

    def entropy(self) -> Float[Tensor, "*batch"]:
        """Differential entropy in nats, exact to 1e-12: the normal's unless wraps overlap.

        The trapezoidal rule with 64 nodes over the circle or over nine scales, whichever is shorter: either the
        integrand is periodic or it has vanished at both ends, so the rule converges exponentially.
        """
        normal = 0.5 * math.log(2 * math.pi * math.e) + torch.log(self.scale)
        if bool((self.scale < math.pi / 9).all()):
            return normal
        half_width = (9 * self.scale).clamp_max(math.pi)
        grid = torch.arange(64, dtype=self.scale.dtype, device=self.scale.device) / 32 - 1
        log_density = _log_density(half_width[..., None] * grid, self.scale[..., None])
        return -(log_density.exp() * log_density).sum(-1) * (half_width / 32)


def _log_density(difference: Tensor, scale: Tensor) -> Tensor:
    """Log density at a difference from the mean within [-pi, pi]."""
    difference, scale = torch.broadcast_tensors(difference, scale)
    narrow = scale.clamp_max(_WIDE)
    turns = torch.arange(-2, 3, dtype=scale.dtype, device=scale.device) * (2 * math.pi)
    standard = (difference[..., None] + turns) / narrow[..., None]
    by_wraps = torch.logsumexp(-0.5 * standard * standard, -1) - torch.log(narrow) - 0.5 * math.log(2 * math.pi)
    wide = scale > _WIDE
    if not bool(wide.any()):
        return by_wraps
    harmonic = torch.arange(1, 7, dtype=scale.dtype, device=scale.device)
    square = scale.clamp_min(_WIDE)[..., None] ** 2
    terms = torch.exp(-0.5 * harmonic * harmonic * square) * torch.cos(harmonic * difference[..., None])
    by_harmonics = torch.log1p(2 * terms.sum(-1)) - math.log(2 * math.pi)
    return torch.where(wide, by_harmonics, by_wraps)


def kl_of_angles(
    loc_q: Float[Tensor, "*batch"],
    scale_q: Float[Tensor, "*batch"],
    loc_p: Float[Tensor, "*batch"],
    scale_p: Float[Tensor, "*batch"],
    period: Float[Tensor, "*batch"] | float = 2 * math.pi,
) -> Float[Tensor, "*batch"]:
    """KL in nats of two normals of angles whose means differ by the shortest way round (isotropic angle form).

    An upper bound of the KL of the wrapped distributions, which is `wrapped_normal_kl`: wrapping is a map, and maps only
    lose information (data processing), whichever representative of the mean is taken before wrapping; the shortest way
    gives the smallest of these bounds. It is tight for scales small beside the period, and far off for wide ones: scales
    of 5 rad, 3 rad apart, give 0.18 nats for two densities that are both uniform. Why on the angle: docs/bound.md, "One
    error, one price".
    """
    turned = torch.remainder(loc_q - loc_p + period / 2, period) - period / 2
    ratio = scale_q / scale_p
    shift = turned / scale_p
    return 0.5 * (ratio * ratio + shift * shift - 1) - torch.log(ratio)
