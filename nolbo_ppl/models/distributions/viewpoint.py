"""Distributions of a viewpoint (azimuth, elevation, in-plane rotation): the story's prior and the guides."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints
from torch.distributions.utils import broadcast_all
from torch.types import _size

from nolbo_ppl.geometry.rotation import viewpoint_moments_to_matrix, wrap_angle
from nolbo_ppl.models.distributions.circular import circular
from nolbo_ppl.models.distributions.symmetry import check_order
from nolbo_ppl.models.distributions.von_mises import VonMisesMixture
from nolbo_ppl.models.distributions.wrapped_normal import WrappedNormal

_EVENT = torch.Size((3,))
_support = constraints.independent(circular, 1)


class ViewpointNormal(TorchDistribution):
    """Three independent wrapped normals: the story's prior p(z^v | v), and the paper's guide with one mode.

    Args:
        loc: viewpoint (azimuth, elevation, in-plane) in rad.
        scale: standard deviations in rad, 0.05 for the prior.
        order: the object's symmetry about its vertical axis, None as order 1. Order n: the equal mixture over the
            azimuths `loc + 2 pi j / n`. Order 0: the azimuth is uniform.

    NOLBO appendix I; docs/story.md.
    """

    arg_constraints: ClassVar = {
        "loc": constraints.independent(constraints.real, 1),
        "scale": constraints.independent(constraints.positive, 1),
    }
    support = _support
    has_rsample = True

    def __init__(
        self,
        loc: Float[Tensor, "*#batch 3"],
        scale: Float[Tensor, "*#batch 3"] | Float[Tensor, ""] | float,
        order: Int[Tensor, "*#batch"] | None = None,
        validate_args: bool | None = None,
    ) -> None:
        self.loc, self.scale = broadcast_all(loc, scale)
        batch_shape = self.loc.shape[:-1]
        if order is not None:
            check_order(order)
            batch_shape = torch.broadcast_shapes(batch_shape, order.shape)
            self.loc, self.scale = self.loc.expand(*batch_shape, 3), self.scale.expand(*batch_shape, 3)
            order = order.expand(batch_shape)
        self.order = order
        super().__init__(batch_shape, _EVENT, validate_args=validate_args)
        if self._validate_args and order is not None and not bool((order >= 0).all()):
            raise ValueError(f"Expected orders of symmetry of at least 0 (0 = free axis), got {order}")

    def expand(self, batch_shape: Sequence[int], _instance: object = None) -> ViewpointNormal:
        """The same distribution with a larger batch shape."""
        new = self._get_checked_instance(ViewpointNormal, _instance)
        batch_shape = torch.Size(batch_shape)
        new.loc, new.scale = self.loc.expand(*batch_shape, 3), self.scale.expand(*batch_shape, 3)
        new.order = None if self.order is None else self.order.expand(batch_shape)
        super(ViewpointNormal, new).__init__(batch_shape, _EVENT, validate_args=False)
        new._validate_args = self._validate_args
        return new

    @property
    def angles(self) -> WrappedNormal:
        """The three wrapped normals, batch shape (..., 3), without the symmetry."""
        return WrappedNormal(self.loc, self.scale, validate_args=False)

    @property
    def azimuth(self) -> WrappedNormal:
        """The azimuth's wrapped normal, without the symmetry."""
        return WrappedNormal(self.loc[..., 0], self.scale[..., 0], validate_args=False)

    def log_prob(self, value: Float[Tensor, "... 3"]) -> Float[Tensor, "*shape"]:
        """Log density in nats per rad^3."""
        if self._validate_args:
            self._validate_sample(value)
        if self.order is None:
            return self.angles.log_prob(value).sum(-1)
        # The equal mixture over the group is the wrapped normal of period 2 pi / n: that of n times the angle.
        count = self.order.clamp_min(1).to(self.loc.dtype)
        stretch = torch.stack((count, torch.ones_like(count), torch.ones_like(count)), -1)
        folded = WrappedNormal(self.loc * stretch, self.scale * stretch, validate_args=False)
        log_prob = folded.log_prob(value * stretch)
        uniform = torch.full_like(log_prob[..., 0], -math.log(2 * math.pi))
        azimuth = torch.where(self.order == 0, uniform, log_prob[..., 0])
        return azimuth + log_prob[..., 1:].sum(-1)

    def rsample(self, sample_shape: _size = ()) -> Float[Tensor, "... 3"]:
        """Reparameterised sample; the element of the symmetry group is drawn uniformly and carries no gradient."""
        shape = self._extended_shape(sample_shape)
        noise = torch.randn(shape, dtype=self.loc.dtype, device=self.loc.device)
        value = self.loc + self.scale * noise
        if self.order is not None:
            turns = torch.rand(shape[:-1], dtype=self.loc.dtype, device=self.loc.device)
            count = self.order.clamp_min(1)
            turns = torch.where(self.order == 0, turns, torch.floor(turns * count) / count)
            value = value + torch.nn.functional.pad(2 * math.pi * turns[..., None], (0, 2))
        return wrap_angle(value)

    @property
    def mean(self) -> Float[Tensor, "*batch 3"]:
        """The mean directions in rad, without the symmetry."""
        return wrap_angle(self.loc)

    @property
    def mode(self) -> Float[Tensor, "*batch 3"]:
        """The viewpoint of the highest density in rad (one of them under a symmetry)."""
        return wrap_angle(self.loc)

    def mean_rotation(self) -> Float[Tensor, "*batch 3 3"]:
        """E[R_camera_object], allocentric: exact, for the rotation is linear in each angle's cosine and sine."""
        moments = self.angles.trigonometric_moments().mean
        if self.order is not None:
            # Averaged over a group of two or more elements the direction in azimuth vanishes.
            unturned = (self.order == 1).to(moments.dtype)[..., None]
            moments = torch.cat((moments[..., :1, :] * unturned[..., None], moments[..., 1:, :]), -2)
        return viewpoint_moments_to_matrix(moments[..., 1], moments[..., 0])

    def entropy(self) -> Float[Tensor, "*batch"]:
        """Differential entropy in nats."""
        by_angle = self.angles.entropy()
        if self.order is None:
            return by_angle.sum(-1)
        count = self.order.clamp_min(1).to(self.loc.dtype)
        azimuth = WrappedNormal(self.loc[..., 0], self.scale[..., 0] * count, validate_args=False).entropy()
        azimuth = torch.where(self.order == 0, torch.full_like(azimuth, math.log(2 * math.pi)), azimuth)
        return azimuth + by_angle[..., 1:].sum(-1)


class ViewpointMixture(TorchDistribution):
    """A von Mises mixture of the azimuth times wrapped normals of elevation and in-plane rotation: the default guide.

    Args:
        logits: unnormalised log weights of the K azimuth modes.
        natural: their natural parameters `kappa (cos, sin)`.
        elevation_inplane_loc: mean elevation and in-plane rotation in rad.
        elevation_inplane_scale: their standard deviations in rad.
        max_concentration: limit of kappa, None for none, see `VonMisesMixture`.

    Why: docs/bound.md (the inclusive objective).
    """

    arg_constraints: ClassVar = {
        "logits": constraints.independent(constraints.real, 1),
        "natural": constraints.independent(constraints.real, 2),
        "elevation_inplane_loc": constraints.independent(constraints.real, 1),
        "elevation_inplane_scale": constraints.independent(constraints.positive, 1),
    }
    support = _support
    has_rsample = False

    def __init__(
        self,
        logits: Float[Tensor, "*#batch K"],
        natural: Float[Tensor, "*#batch K 2"],
        elevation_inplane_loc: Float[Tensor, "*#batch 2"],
        elevation_inplane_scale: Float[Tensor, "*#batch 2"],
        max_concentration: float | None = None,
        validate_args: bool | None = None,
    ) -> None:
        loc, scale = broadcast_all(elevation_inplane_loc, elevation_inplane_scale)
        azimuth = VonMisesMixture(logits, natural, max_concentration, validate_args=False)
        batch_shape = torch.broadcast_shapes(azimuth.batch_shape, loc.shape[:-1])
        self.azimuth = azimuth.expand(batch_shape)
        self.elevation_inplane_loc = loc.expand(*batch_shape, 2)
        self.elevation_inplane_scale = scale.expand(*batch_shape, 2)
        super().__init__(batch_shape, _EVENT, validate_args=validate_args)

    def expand(self, batch_shape: Sequence[int], _instance: object = None) -> ViewpointMixture:
        """The same distribution with a larger batch shape."""
        new = self._get_checked_instance(ViewpointMixture, _instance)
        batch_shape = torch.Size(batch_shape)
        new.azimuth = self.azimuth.expand(batch_shape)
        new.elevation_inplane_loc = self.elevation_inplane_loc.expand(*batch_shape, 2)
        new.elevation_inplane_scale = self.elevation_inplane_scale.expand(*batch_shape, 2)
        super(ViewpointMixture, new).__init__(batch_shape, _EVENT, validate_args=False)
        new._validate_args = self._validate_args
        return new

    @property
    def logits(self) -> Float[Tensor, "*batch K"]:
        """Unnormalised log weights of the azimuth modes."""
        return self.azimuth.logits

    @property
    def natural(self) -> Float[Tensor, "*batch K 2"]:
        """Natural parameters of the azimuth modes as given, before the limit on kappa."""
        return self.azimuth.natural

    @property
    def elevation_inplane(self) -> WrappedNormal:
        """The wrapped normals of elevation and in-plane rotation, batch shape (..., 2)."""
        return WrappedNormal(self.elevation_inplane_loc, self.elevation_inplane_scale, validate_args=False)

    def log_prob(self, value: Float[Tensor, "... 3"]) -> Float[Tensor, "*shape"]:
        """Log density in nats per rad^3."""
        if self._validate_args:
            self._validate_sample(value)
        return self.azimuth.log_density(value[..., 0]) + self.elevation_inplane.log_prob(value[..., 1:]).sum(-1)

    def log_prob_symmetric(self, value: Float[Tensor, "... 3"], order: Int[Tensor, "*#batch"] | int) -> Float[Tensor, "*shape"]:
        """Log density on the quotient by a symmetry about the vertical axis: azimuths that look the same are added."""
        azimuth = self.azimuth.log_prob_symmetric(value[..., 0], order)
        return azimuth + self.elevation_inplane.log_prob(value[..., 1:]).sum(-1)

    def sample(self, sample_shape: _size = ()) -> Float[Tensor, "... 3"]:
        """Exact sample in [-pi, pi)."""
        with torch.no_grad():
            azimuth = self.azimuth.sample(sample_shape)
            return torch.cat((azimuth[..., None], self.elevation_inplane.sample(sample_shape)), -1)

    @property
    def mean(self) -> Float[Tensor, "*batch 3"]:
        """The mean directions in rad."""
        return torch.cat((self.azimuth.mean[..., None], wrap_angle(self.elevation_inplane_loc)), -1)

    @property
    def mode(self) -> Float[Tensor, "*batch 3"]:
        """The viewpoint of the highest density in rad: the point estimate. Not differentiated in azimuth."""
        return torch.cat((self.azimuth.mode[..., None], wrap_angle(self.elevation_inplane_loc)), -1)

    def mean_rotation(self) -> Float[Tensor, "*batch 3 3"]:
        """E[R_camera_object], allocentric: exact, for the rotation is linear in each angle's cosine and sine."""
        moments = self.elevation_inplane.trigonometric_moments().mean
        cosine_sine = torch.cat((self.azimuth.mean_direction()[..., None, :], moments.flip(-1)), -2)
        return viewpoint_moments_to_matrix(cosine_sine[..., 0], cosine_sine[..., 1])

    def entropy(self) -> Float[Tensor, "*batch"]:
        """Differential entropy in nats (azimuth by quadrature)."""
        return self.azimuth.entropy() + self.elevation_inplane.entropy().sum(-1)
