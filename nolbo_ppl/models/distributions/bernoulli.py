"""Objectness: a Bernoulli by its log odds, and the KLs between q(o | I) and p(o | label) in both directions.

`p(o = 1 | object) = 1 - eps`, `p(o = 1 | background) = eps` (NOLBO appendix I). Stable for log odds of 1e3 and beyond:
nothing but `logsigmoid` and `softplus` is used.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from pyro.distributions import Bernoulli
from torch import Tensor
from torch.distributions import kl_divergence
from torch.distributions.kl import register_kl
from torch.nn.functional import logsigmoid, softplus

from nolbo_ppl.errors import input_error


class Objectness(Bernoulli):
    """`Bernoulli(logits=...)` with a KL made of log sigmoids only.

    Torch's own is infinite once a probability underflows, at log odds of -104 in single precision, which a network
    reaches.
    """

    def expand(self, batch_shape: Sequence[int], _instance: object = None) -> Objectness:
        """The same distribution with a larger batch shape."""
        return super().expand(batch_shape, _instance=self._get_checked_instance(Objectness, _instance))


@register_kl(Objectness, Objectness)
def _kl_objectness(p: Objectness, q: Objectness) -> Tensor:
    """`KL(p || q)` by enumeration of o in {0, 1}, from the log odds of both."""
    a, b = p.logits, q.logits
    yes = torch.sigmoid(a) * (logsigmoid(a) - logsigmoid(b))
    no = torch.sigmoid(-a) * (logsigmoid(-a) - logsigmoid(-b))
    return yes + no


def objectness_prior(is_object: Bool[Tensor, "*batch"], eps: float, dtype: torch.dtype | None = None) -> Objectness:
    """p(o | label): log odds `log((1 - eps) / eps)` for an object, their negative for background.

    Raises:
        InputError: eps is not between 0 and 1/2.
    """
    if not 0 < eps < 0.5:
        raise input_error("eps of the objectness prior", got=eps, expected="a probability above 0 and below 1/2")
    logit = torch.full(is_object.shape, math.log1p(-eps) - math.log(eps), dtype=dtype, device=is_object.device)
    return Objectness(logits=torch.where(is_object, logit, -logit), validate_args=False)


def bernoulli_entropy(logit: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Entropy in nats of a Bernoulli distribution given by its log odds."""
    return softplus(-logit) * torch.sigmoid(logit) + softplus(logit) * torch.sigmoid(-logit)


def objectness_kl_exclusive(
    logit: Float[Tensor, "*batch"], is_object: Bool[Tensor, "*batch"], eps: float
) -> Float[Tensor, "*batch"]:
    """`KL(q(o) || p(o | label))` in nats, the bound's term (NOLBO eq. (ELBO)); `logit` are the log odds of q."""
    return kl_divergence(Objectness(logits=logit), objectness_prior(is_object, eps, logit.dtype))


def objectness_kl_inclusive(
    logit: Float[Tensor, "*batch"], is_object: Bool[Tensor, "*batch"], eps: float
) -> Float[Tensor, "*batch"]:
    """`KL(p(o | label) || q(o))` in nats, the training default: the cross-entropy below minus the prior's entropy."""
    return kl_divergence(objectness_prior(is_object, eps, logit.dtype), Objectness(logits=logit))


def objectness_cross_entropy(
    logit: Float[Tensor, "*batch"], is_object: Bool[Tensor, "*batch"], eps: float
) -> Float[Tensor, "*batch"]:
    """Binary cross-entropy `-E_p[log q(o)]` in nats with targets 1 - eps and eps (label smoothing)."""
    prior = objectness_prior(is_object, eps, logit.dtype).logits
    return torch.sigmoid(prior) * softplus(-logit) + torch.sigmoid(-prior) * softplus(logit)


def log_kappa_objectness(
    logit: Float[Tensor, "*batch"], is_object: Bool[Tensor, "*batch"], eps: float
) -> Float[Tensor, "*batch"]:
    """`log kappa_o = -KL(q(o) || p(o | label))`, NOLBO eq. (kappaforobjectness).

    For an object it is `H(q) + q log(1 - eps) + (1 - q) log eps`: not the probability of an object, which it meets only
    at the ends (docs/story.md, corrections).
    """
    return -objectness_kl_exclusive(logit, is_object, eps)
