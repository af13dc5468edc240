"""The shape latent's prior, a mixture of unit Gaussians over labels: density, KLs and the bound by enumeration."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor


def component_log_prob(value: Float[Tensor, "*batch d"], component_loc: Float[Tensor, "C d"]) -> Float[Tensor, "*batch C"]:
    """`log N(value; mu_c, I)` in nats for every component, NOLBO appendix I.

    The squared distance is one matrix product about the mean of the components, wrong by 1e-7 of their squared spread.
    """
    centre = component_loc.detach().mean(0)
    value, component_loc = value - centre, component_loc - centre
    square = value.square().sum(-1, keepdim=True) - 2 * value @ component_loc.mT + component_loc.square().sum(-1)
    return -0.5 * (square.clamp_min(0) + component_loc.shape[-1] * math.log(2 * math.pi))


def gaussian_mixture_log_prob(
    value: Float[Tensor, "*batch d"], component_loc: Float[Tensor, "C d"], log_weights: Float[Tensor, "*#batch C"]
) -> Float[Tensor, "*batch"]:
    """`log sum_c p(c) N(value; mu_c, I)` in nats; log weights are normalised by the caller."""
    return torch.logsumexp(log_weights + component_log_prob(value, component_loc), -1)


def kl_to_each_component(
    q_loc: Float[Tensor, "*batch d"], q_scale: Float[Tensor, "*batch d"], component_loc: Float[Tensor, "C d"]
) -> Float[Tensor, "*batch C"]:
    """`KL(N(q_loc, diag(q_scale^2)) || N(mu_c, I))` in nats for every component, exact (NOLBO eq. KLexpandforlabel)."""
    excess = (q_scale.square() - 1 - 2 * torch.log(q_scale)).sum(-1, keepdim=True)
    distance = -2 * component_log_prob(q_loc, component_loc) - component_loc.shape[-1] * math.log(2 * math.pi)
    return 0.5 * (excess + distance)


def enumerated_kl(kl: Float[Tensor, "*batch C"], log_weights: Float[Tensor, "*#batch C"]) -> Float[Tensor, "*batch"]:
    """`-log sum_c p(c) exp(-KL_c)` in nats: the KL of latent and label together when the label is unobserved.

    It is `min over q(c) of KL(q(c) || p(c)) + E_q(c)[KL_c]`, reached at `q(c) = p(c) exp(-KL_c) / Z`, the
    `label_posterior`, and bounds the KL of q to the mixture from above (Hershey & Olsen 2007): the evidence bound stays
    one.
    """
    return -torch.logsumexp(log_weights - kl, -1)


def label_posterior(kl: Float[Tensor, "*batch C"], log_weights: Float[Tensor, "*#batch C"]) -> Float[Tensor, "*batch C"]:
    """`log q(c)` of the optimal label posterior of `enumerated_kl`, normalised."""
    return torch.log_softmax(log_weights - kl, -1)
