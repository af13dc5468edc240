"""KL divergences between viewpoint distributions. A symmetry belongs to the story's prior and decides the form:

- **Inclusive**, KL(prior || guide), trains a calibrated guide: both are folded by the group and compared on the
  quotient, where azimuths that look the same are one point.
- **Exclusive**, KL(guide || prior), the paper's: against the equal mixture over the group on the whole circle.
- Order 0: the azimuth of a body of revolution has no meaning and drops out of both.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.distributions import kl_divergence
from torch.distributions.kl import register_kl

from nolbo_ppl.errors import input_error
from nolbo_ppl.models.distributions.sincos_normal import SinCosNormal
from nolbo_ppl.models.distributions.symmetry import group_angles
from nolbo_ppl.models.distributions.viewpoint import ViewpointMixture, ViewpointNormal
from nolbo_ppl.models.distributions.viewpoint_sincos import ViewpointSinCos
from nolbo_ppl.models.distributions.von_mises_kl import kl_mixture_to_wrapped, kl_wrapped_to_mixture
from nolbo_ppl.models.distributions.wrapped_normal import WrappedNormal
from nolbo_ppl.models.distributions.wrapped_normal_kl import wrapped_normal_kl


def _elevation_inplane_kl(loc_q: Tensor, scale_q: Tensor, loc_p: Tensor, scale_p: Tensor) -> Tensor:
    q, p = WrappedNormal(loc_q, scale_q, validate_args=False), WrappedNormal(loc_p, scale_p, validate_args=False)
    return wrapped_normal_kl(q, p).sum(-1)


@register_kl(ViewpointNormal, ViewpointMixture)
def kl_normal_to_mixture(p: ViewpointNormal, q: ViewpointMixture) -> Float[Tensor, "*batch"]:
    """Inclusive KL(p || q) in nats on the quotient by p's symmetry; the azimuth's is `kl_wrapped_to_mixture`."""
    azimuth = kl_wrapped_to_mixture(p.azimuth, q.azimuth, 1 if p.order is None else p.order)
    rest = (q.elevation_inplane_loc, q.elevation_inplane_scale)
    return azimuth + _elevation_inplane_kl(p.loc[..., 1:], p.scale[..., 1:], *rest)


@register_kl(ViewpointMixture, ViewpointNormal)
def kl_mixture_to_normal(q: ViewpointMixture, p: ViewpointNormal) -> Float[Tensor, "*batch"]:
    """Exclusive KL(q || p) in nats, p the equal mixture over its symmetry; the azimuth's is `kl_mixture_to_wrapped`."""
    azimuth = kl_mixture_to_wrapped(q.azimuth, p.azimuth, 1 if p.order is None else p.order)
    rest = (q.elevation_inplane_loc, q.elevation_inplane_scale)
    return azimuth + _elevation_inplane_kl(*rest, p.loc[..., 1:], p.scale[..., 1:])


@register_kl(ViewpointNormal, ViewpointNormal)
def kl_normal_to_normal(a: ViewpointNormal, b: ViewpointNormal) -> Float[Tensor, "*batch"]:
    """KL(a || b) in nats, exact; the symmetry of a makes it inclusive, of b alone exclusive.

    Exclusive pays log n for the mixture's other modes, on which a narrow guide with one mode puts nothing.

    Raises:
        InputError: both have a symmetry, and not the same.
    """
    order = a.order if a.order is not None else b.order
    if order is None:
        return wrapped_normal_kl(a.angles, b.angles).sum(-1)
    if a.order is not None and b.order is not None and not bool((a.order == b.order).all()):
        raise input_error("KL of viewpoints of different symmetries", got=(a.order, b.order), expected="the same order")
    azimuth = wrapped_normal_kl(a.azimuth, b.azimuth, order, quotient=a.order is not None)
    azimuth = torch.where(order == 0, torch.zeros_like(azimuth), azimuth)
    return azimuth + _elevation_inplane_kl(a.loc[..., 1:], a.scale[..., 1:], b.loc[..., 1:], b.scale[..., 1:])


def kl_sincos_to_sincos(
    q: ViewpointSinCos, p: ViewpointSinCos, order: Int[Tensor, "*#batch"] | None = None
) -> Float[Tensor, "*batch"]:
    """Exclusive KL(q || p) in nats of the paper's factorised form, optionally with p's symmetry.

    With n-fold symmetry p is the equal mixture over the group, bounded from above by `-log mean_g exp(-KL(q || p_g))`
    (Jensen, with one set of responsibilities for all z); order 0 drops the azimuth.
    """
    if order is None:
        return kl_divergence(q.angles, p.angles).sum(-1)
    rest = kl_divergence(
        SinCosNormal(q.loc[..., 1:], q.scale[..., 1:], validate_args=False),
        SinCosNormal(p.loc[..., 1:], p.scale[..., 1:], validate_args=False),
    ).sum(-1)
    angles, log_weight = group_angles(order, p.loc.dtype)
    turned = SinCosNormal(p.loc[..., :1] + angles, p.scale[..., :1], validate_args=False)
    azimuth = kl_divergence(SinCosNormal(q.loc[..., :1], q.scale[..., :1], validate_args=False), turned)
    azimuth = -torch.logsumexp(log_weight - azimuth, -1)
    return rest + torch.where(order == 0, torch.zeros_like(azimuth), azimuth)


@register_kl(ViewpointSinCos, ViewpointSinCos)
def _kl_sincos_sincos(q: ViewpointSinCos, p: ViewpointSinCos) -> Tensor:
    return kl_sincos_to_sincos(q, p)
