"""Objectness: the KLs between the guide's Bernoulli, given by its logit, and the story's p(o | label), in both directions.

`p(o = 1 | object) = 1 - eps`, `p(o = 1 | background) = eps` (NOLBO appendix I). Stable for logits up to 1e3 and beyond:
nothing but `logsigmoid` and `softplus` of the logit is used.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import logsigmoid, softplus

from nolbo_ppl.errors import input_error


def objectness_prior_logit(is_object: Bool[Tensor, "*batch"], eps: float, dtype: torch.dtype) -> Float[Tensor, "*batch"]:
    """Logit of p(o = 1 | label): `log((1 - eps) / eps)` for an object, its negative for background.

    Raises:
        InputError: eps is not between 0 and 1/2.
    """
    if not 0 < eps < 0.5:
        raise input_error("eps of the objectness prior", got=eps, expected="a probability above 0 and below 1/2")
    size = math.log1p(-eps) - math.log(eps)
    return torch.where(is_object, size, -size).to(dtype)


def bernoulli_entropy(logit: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Entropy in nats of a Bernoulli distribution."""
    return softplus(-logit) * torch.sigmoid(logit) + softplus(logit) * torch.sigmoid(-logit)


def objectness_kl_exclusive(
    logit: Float[Tensor, "*batch"], is_object: Bool[Tensor, "*batch"], eps: float
) -> Float[Tensor, "*batch"]:
    """`KL(q(o) || p(o | label))` in nats, the bound's term (NOLBO eq. (ELBO))."""
    prior = objectness_prior_logit(is_object, eps, logit.dtype)
    yes = torch.sigmoid(logit) * (logsigmoid(logit) - logsigmoid(prior))
    no = torch.sigmoid(-logit) * (logsigmoid(-logit) - logsigmoid(-prior))
    return yes + no


def objectness_kl_inclusive(
    logit: Float[Tensor, "*batch"], is_object: Bool[Tensor, "*batch"], eps: float
) -> Float[Tensor, "*batch"]:
    """`KL(p(o | label) || q(o))` in nats, the training default: `objectness_cross_entropy` minus the prior's entropy."""
    prior = objectness_prior_logit(is_object, eps, logit.dtype)
    yes = torch.sigmoid(prior) * (logsigmoid(prior) - logsigmoid(logit))
    no = torch.sigmoid(-prior) * (logsigmoid(-prior) - logsigmoid(-logit))
    return yes + no


def objectness_cross_entropy(
    logit: Float[Tensor, "*batch"], is_object: Bool[Tensor, "*batch"], eps: float
) -> Float[Tensor, "*batch"]:
    """Binary cross-entropy `-E_p[log q(o)]` in nats with targets 1 - eps and eps (label smoothing)."""
    target = torch.sigmoid(objectness_prior_logit(is_object, eps, logit.dtype))
    return target * softplus(-logit) + (1 - target) * softplus(logit)


def log_kappa_objectness(
    logit: Float[Tensor, "*batch"], is_object: Bool[Tensor, "*batch"], eps: float
) -> Float[Tensor, "*batch"]:
    """`log kappa_o = -KL(q(o) || p(o | label))`, NOLBO eq. (kappaforobjectness).

    For an object it is `H(q) + q log(1 - eps) + (1 - q) log eps`: not the probability of an object, which it meets only
    at the ends (method section 2).
    """
    return -objectness_kl_exclusive(logit, is_object, eps)
