"""The Bernoulli of an objectness, whose KL is stable for log odds of any size."""

from __future__ import annotations

import torch
from pyro.distributions import Bernoulli
from torch import Tensor
from torch.distributions import register_kl
from torch.nn.functional import logsigmoid


class Objectness(Bernoulli):
    """`Bernoulli(logits=...)` with a KL made of log sigmoids only.

    Torch's own is infinite once a probability underflows, at log odds of -104 in single precision, which a network reaches.
    """

    def expand(self, batch_shape, _instance=None) -> Objectness:
        """The same distribution with a larger batch shape."""
        return super().expand(batch_shape, _instance=self._get_checked_instance(Objectness, _instance))


@register_kl(Objectness, Objectness)
def _kl_objectness(p: Objectness, q: Objectness) -> Tensor:
    """`KL(p || q)` by enumeration of o in {0, 1}, from the log odds of both."""
    a, b = p.logits, q.logits
    yes = torch.sigmoid(a) * (logsigmoid(a) - logsigmoid(b))
    no = torch.sigmoid(-a) * (logsigmoid(-a) - logsigmoid(-b))
    return yes + no
