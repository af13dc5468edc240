"""Expected log likelihood of the observed rotation under a guide's orientation."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nolbo_ppl.geometry.rotation import viewpoint_moments_to_matrix
from nolbo_ppl.models.distributions import (
    SinCosNormal,
    SymmetricMatrixFisher,
    ViewpointMixture,
    ViewpointNormal,
    ViewpointSinCos,
)

Orientation = ViewpointMixture | ViewpointNormal | ViewpointSinCos
"""The forms of q(z^v | I)."""


def angle_components(q: Orientation) -> tuple[Float[Tensor, "*n modes"], Float[Tensor, "*n modes 3 2"]]:
    """Weights of the azimuth's modes, and E[(cos, sin)] of (azimuth, elevation, in-plane) under each of them."""
    if isinstance(q, ViewpointMixture):
        azimuth = q.azimuth.component_directions()
        others = q.elevation_inplane.trigonometric_moments().mean.flip(-1)
        others = others[..., None, :, :].expand(*azimuth.shape[:-1], 2, 2)
        return q.azimuth.weights, torch.cat((azimuth[..., None, :], others), -2)
    angles = q.angles
    sine_cosine = angles.projected_mean() if isinstance(q, ViewpointSinCos) else angles.trigonometric_moments().mean
    return sine_cosine.new_ones(*sine_cosine.shape[:-2], 1), sine_cosine.flip(-1)[..., None, :, :]


def expected_rotation_log_prob(
    q: Orientation,
    R_observed: Float[Tensor, "*n 3 3"],
    concentration: Float[Tensor, ""],
    order: Int[Tensor, "*n"],
) -> Float[Tensor, "*n"]:
    """`E_q[log p(R_observed | R_z)]` in nats: exact without a symmetry, a lower bound with one.

    Without a symmetry the log likelihood is linear in the cosines and sines of the angles, whose moments are known. Under
    one it is convex in R_z. The azimuth is integrated out by quadrature, and Jensen's inequality is used for elevation and
    in-plane rotation alone. Twofold, kappa = 200, an azimuth of kappa 5: within the 0.5 nats of 20 000 samples at scales of
    0.1 and 0.3 rad of those two, 13 nats of 290 too low at 1 rad. With the mean over the azimuth's modes too, one at a time,
    it was 30 nats too low. Where the axis is free the likelihood does not know the azimuth, which is held fixed.
    """
    weights, moments = angle_components(q)
    cosine, sine = moments.unbind(-1)
    free = (order == 0)[..., None, None]
    fixed = cosine.new_tensor([1.0, 0.0, 0.0]).bool() & free
    R_mean = viewpoint_moments_to_matrix(torch.where(fixed, 1.0, cosine), torch.where(fixed, 0.0, sine))
    # the density is symmetric in rotation and mode
    reverse = SymmetricMatrixFisher(R_observed[..., None, :, :], concentration, order[..., None], validate_args=False)
    by_modes = (weights * reverse.expected_log_prob(R_mean)).sum(-1)
    turning = (order > 1).expand(by_modes.shape)
    if not bool(turning.any()):
        return by_modes
    azimuth, mass = azimuth_quadrature(q)
    azimuth, mass = (value.movedim(0, -1)[turning] for value in (azimuth, mass))
    others = moments[..., 0, 1:, :][turning][:, None].expand(-1, azimuth.shape[-1], 2, 2)
    direction = torch.stack((torch.cos(azimuth), torch.sin(azimuth)), -1)
    R_mean = viewpoint_moments_to_matrix(*torch.cat((direction[..., None, :], others), -2).unbind(-1))
    R = R_observed.expand(*by_modes.shape, 3, 3)[turning][:, None]
    reverse = SymmetricMatrixFisher(R, concentration, order.expand(by_modes.shape)[turning][:, None], validate_args=False)
    return by_modes.masked_scatter(turning, (mass * reverse.expected_log_prob(R_mean)).sum(-1))


def azimuth_quadrature(q: Orientation, nodes: int = 1024) -> tuple[Float[Tensor, nodes * n], Float[Tensor, nodes * n]]:
    """Azimuths and their probabilities under q, which sum to one.

    The trapezoidal rule over the circle, for one mode over ten of its scales where that is shorter. The log likelihood of
    an n-fold object has kinks of width `1 / (2 kappa sin(pi / n))` between its modes: with kappa = 200 and 1024 nodes they
    cost less than 1e-3 nats.
    """
    if isinstance(q, ViewpointMixture):
        loc, half = torch.zeros_like(q.azimuth.mean), math.pi * torch.ones_like(q.azimuth.mean)
    else:
        loc, half = q.loc[..., 0], (10 * q.scale[..., 0]).clamp_max(math.pi)
    grid = torch.arange(nodes, dtype=loc.dtype, device=loc.device).reshape((-1,) + (1,) * loc.dim()) * (2 / nodes) - 1
    azimuth = loc + half * grid
    if isinstance(q, ViewpointMixture):
        log_density = q.azimuth.log_density(azimuth)
    elif isinstance(q, ViewpointNormal):
        log_density = q.azimuth.log_prob(azimuth)
    else:
        log_density = SinCosNormal(q.loc[..., 0], q.scale[..., 0], validate_args=False).projected_log_density(azimuth)
    return azimuth, torch.softmax(log_density, 0)
