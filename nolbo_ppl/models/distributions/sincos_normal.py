"""The paper's orientation latent: independent Gaussians on sin and cos with the moments of a wrapped normal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from jaxtyping import Float
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import Normal, constraints, kl_divergence
from torch.distributions.kl import register_kl
from torch.distributions.utils import broadcast_all
from torch.types import _size

from nolbo_ppl.models.distributions.wrapped_normal import wrapped_normal_moments


def sincos_to_angle(sincos: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
    """Project (sin, cos) to the circle: the angle in rad, from which a true rotation is built (docs/story.md, corrections)."""
    return torch.atan2(sincos[..., 0], sincos[..., 1])


class SinCosNormal(TorchDistribution):
    """Gaussian on (sin v, cos v) with factorised wrapped-normal moments; a sample need not lie on the circle.

    Args:
        loc: the angle v in rad.
        scale: its standard deviation in rad.

    Sine and cosine of one angle are far from independent (correlation -0.997 at 45 degrees and 0.05 rad), so this
    distribution weighs the same angle error five times more at 0 and 90 degrees than at 45: `WrappedNormal` is the
    default, this one is the paper's. NOLBO eq. (meanvarofwrappedgaussian).
    """

    arg_constraints: ClassVar = {"loc": constraints.real, "scale": constraints.positive}
    support = constraints.real_vector
    has_rsample = True

    def __init__(
        self,
        loc: Float[Tensor, "*#batch"] | float,
        scale: Float[Tensor, "*#batch"] | float,
        validate_args: bool | None = None,
    ) -> None:
        self.loc, self.scale = broadcast_all(loc, scale)
        super().__init__(self.loc.shape, torch.Size((2,)), validate_args=validate_args)

    def expand(self, batch_shape: Sequence[int], _instance: object = None) -> SinCosNormal:
        """The same distribution with a larger batch shape."""
        new = self._get_checked_instance(SinCosNormal, _instance)
        batch_shape = torch.Size(batch_shape)
        new.loc, new.scale = self.loc.expand(batch_shape), self.scale.expand(batch_shape)
        super(SinCosNormal, new).__init__(batch_shape, self.event_shape, validate_args=False)
        new._validate_args = self._validate_args
        return new

    @property
    def factors(self) -> Normal:
        """The two independent normals, batch shape (..., 2)."""
        moments = wrapped_normal_moments(self.loc, self.scale)
        return Normal(moments.mean, torch.sqrt(moments.variance), validate_args=False)

    @property
    def mean(self) -> Float[Tensor, "*batch 2"]:
        """E[sin], E[cos]."""
        return wrapped_normal_moments(self.loc, self.scale).mean

    @property
    def variance(self) -> Float[Tensor, "*batch 2"]:
        """Var[sin], Var[cos]."""
        return wrapped_normal_moments(self.loc, self.scale).variance

    def log_prob(self, value: Float[Tensor, "... 2"]) -> Float[Tensor, "*shape"]:
        """Log density in nats on the plane of (sin, cos)."""
        if self._validate_args:
            self._validate_sample(value)
        return self.factors.log_prob(value).sum(-1)

    def rsample(self, sample_shape: _size = ()) -> Float[Tensor, "... 2"]:
        """Reparameterised (sin, cos); project it by `sincos_to_angle` before a rotation is built."""
        return self.factors.rsample(torch.Size(sample_shape))

    def projected_mean(self, nodes: int = 64) -> Float[Tensor, "*batch 2"]:
        """E[sin], E[cos] of a sample projected to the circle by `sincos_to_angle`, the one a rotation is built from.

        It differs from `mean` by the order of the variance: at 45 degrees the errors of sine and cosine, independent
        here, spread the angle half as far as the angle's own. Trapezoidal rule about the mean's direction, over ten scales
        or the whole circle, whichever is shorter.
        """
        half_width = (10 * self.scale).clamp_max(math.pi)
        grid = torch.arange(nodes, dtype=self.loc.dtype, device=self.loc.device) * (2 / nodes) - 1
        angle = self.loc + half_width * grid.reshape((-1,) + (1,) * self.loc.dim())
        weight = torch.softmax(self.projected_log_density(angle), 0)
        return torch.stack(((weight * torch.sin(angle)).sum(0), (weight * torch.cos(angle)).sum(0)), -1)

    def projected_log_density(self, angle: Float[Tensor, "*value"]) -> Float[Tensor, "*shape"]:
        """Log density in nats per rad of the angle of a sample.

        With `w` the cross product of the direction (sin v, cos v)
        and the mean m, `V = Var[cos] sin^2 v + Var[sin] cos^2 v` and `D` the mean's length along v in standard
        deviations, the angle has density `sqrt(|S|) / (2 pi V) (exp(-m' S^-1 m / 2) + sqrt(2 pi) D Phi(D)
        exp(-w^2 / (2 V)))` (projected normal: Mardia & Jupp, section 3.5.6).
        """
        moments = wrapped_normal_moments(self.loc, self.scale)
        (m_s, m_c), (v_s, v_c) = moments.mean.unbind(-1), moments.variance.unbind(-1)
        sine, cosine = torch.sin(angle), torch.cos(angle)
        V = v_c * sine * sine + v_s * cosine * cosine
        D = (m_s * v_c * sine + m_c * v_s * cosine) / torch.sqrt(v_s * v_c * V)
        across = torch.square(sine * m_c - cosine * m_s) / V
        near = torch.exp(-0.5 * (m_s * m_s / v_s + m_c * m_c / v_c))
        density = (near + math.sqrt(2 * math.pi) * D * torch.special.ndtr(D) * torch.exp(-0.5 * across)) / V
        tiny = torch.finfo(density.dtype).tiny  # far out a direction's density underflows, its logarithm must not
        return torch.log(density.clamp_min(tiny)) + 0.5 * torch.log(v_s * v_c) - math.log(2 * math.pi)

    def entropy(self) -> Float[Tensor, "*batch"]:
        """Differential entropy in nats."""
        return self.factors.entropy().sum(-1)


@register_kl(SinCosNormal, SinCosNormal)
def _kl_sincos_sincos(q: SinCosNormal, p: SinCosNormal) -> Tensor:
    return kl_divergence(q.factors, p.factors).sum(-1)
