"""The paper's orientation latent of a whole viewpoint: factorised Gaussians on the sine and cosine of each angle."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from jaxtyping import Float
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints
from torch.distributions.utils import broadcast_all
from torch.types import _size

from nolbo_ppl.geometry.rotation import viewpoint_moments_to_matrix
from nolbo_ppl.models.distributions.sincos_normal import SinCosNormal, sincos_to_angle


class ViewpointSinCos(TorchDistribution):
    """The paper's orientation latent: factorised Gaussians on (sin, cos) of each angle, event shape (3, 2).

    Args:
        loc: viewpoint (azimuth, elevation, in-plane) in rad.
        scale: standard deviations in rad.

    NOLBO appendix I, eq. (meanvarofwrappedgaussian).
    """

    arg_constraints: ClassVar = {
        "loc": constraints.independent(constraints.real, 1),
        "scale": constraints.independent(constraints.positive, 1),
    }
    support = constraints.independent(constraints.real, 2)
    has_rsample = True

    def __init__(
        self,
        loc: Float[Tensor, "*#batch 3"],
        scale: Float[Tensor, "*#batch 3"] | Float[Tensor, ""] | float,
        validate_args: bool | None = None,
    ) -> None:
        self.loc, self.scale = broadcast_all(loc, scale)
        super().__init__(self.loc.shape[:-1], torch.Size((3, 2)), validate_args=validate_args)

    def expand(self, batch_shape: Sequence[int], _instance: object = None) -> ViewpointSinCos:
        """The same distribution with a larger batch shape."""
        new = self._get_checked_instance(ViewpointSinCos, _instance)
        batch_shape = torch.Size(batch_shape)
        new.loc, new.scale = self.loc.expand(*batch_shape, 3), self.scale.expand(*batch_shape, 3)
        super(ViewpointSinCos, new).__init__(batch_shape, self.event_shape, validate_args=False)
        new._validate_args = self._validate_args
        return new

    @property
    def angles(self) -> SinCosNormal:
        """The three sine and cosine pairs, batch shape (..., 3)."""
        return SinCosNormal(self.loc, self.scale, validate_args=False)

    def log_prob(self, value: Float[Tensor, "... 3 2"]) -> Float[Tensor, "*shape"]:
        """Log density in nats."""
        if self._validate_args:
            self._validate_sample(value)
        return self.angles.log_prob(value).sum(-1)

    def rsample(self, sample_shape: _size = ()) -> Float[Tensor, "... 3 2"]:
        """Reparameterised (sin, cos) of each angle; `viewpoint_of` projects it before a rotation is built."""
        return self.angles.rsample(sample_shape)

    @staticmethod
    def viewpoint_of(value: Float[Tensor, "*batch 3 2"]) -> Float[Tensor, "*batch 3"]:
        """The viewpoint in rad of a sample, each pair projected to the circle."""
        return sincos_to_angle(value)

    @property
    def mean(self) -> Float[Tensor, "*batch 3 2"]:
        """E[sin], E[cos] of each angle."""
        return self.angles.mean

    @property
    def variance(self) -> Float[Tensor, "*batch 3 2"]:
        """Var[sin], Var[cos] of each angle."""
        return self.angles.variance

    def mean_rotation(self) -> Float[Tensor, "*batch 3 3"]:
        """E[R_camera_object], allocentric, of the matrix built from unprojected sines and cosines (linear: exact)."""
        moments = self.mean
        return viewpoint_moments_to_matrix(moments[..., 1], moments[..., 0])

    def entropy(self) -> Float[Tensor, "*batch"]:
        """Differential entropy in nats."""
        return self.angles.entropy().sum(-1)
