"""Expected log likelihood of the observed rotation under a guide's orientation, in closed form."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nolbo_ppl.geometry.rotation import viewpoint_moments_to_matrix
from nolbo_ppl.models.distributions import SymmetricMatrixFisher, ViewpointMixture, ViewpointNormal, ViewpointSinCos

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
    """`E_q[log p(R_observed | R_z)]` in nats: exact without a symmetry, a close lower bound with one.

    Under a symmetry the log likelihood is convex in R_z, and Jensen's inequality gives a bound from its mean. One mode
    at a time, for the mean over modes that look the same would be no rotation at all (two modes half a turn apart: 400
    nats too low at kappa = 200); where the axis is free the likelihood does not know the azimuth, which is held fixed.
    """
    weights, moments = angle_components(q)
    cosine, sine = moments.unbind(-1)
    free = (order == 0)[..., None, None]
    fixed = cosine.new_tensor([1.0, 0.0, 0.0]).bool() & free
    R_mean = viewpoint_moments_to_matrix(torch.where(fixed, 1.0, cosine), torch.where(fixed, 0.0, sine))
    # the density is symmetric in rotation and mode
    reverse = SymmetricMatrixFisher(R_observed[..., None, :, :], concentration, order[..., None], validate_args=False)
    return (weights * reverse.expected_log_prob(R_mean)).sum(-1)
