from __future__ import annotations

import math

import mpmath
import pytest
import torch
from torch.distributions import Bernoulli, kl_divergence
from torch.nn.functional import binary_cross_entropy_with_logits

from nolbo_ppl.errors import InputError
from nolbo_ppl.models.distributions import (
    Objectness,
    bernoulli_entropy,
    log_kappa_objectness,
    objectness_cross_entropy,
    objectness_kl_exclusive,
    objectness_kl_inclusive,
    objectness_prior,
)

LOGITS = torch.tensor([-1000.0, -104.5, -40.0, -3.0, -1e-3, 0.0, 0.7, 9.0, 60.0, 1000.0], dtype=torch.float64)


def precise_kl(a: float, b: float) -> float:
    """KL between Bernoullis of two log odds with 500 digits."""
    with mpmath.workdps(500):
        p, q = (1 / (1 + mpmath.exp(-mpmath.mpf(x))) for x in (a, b))
        return float(p * mpmath.log(p / q) + (1 - p) * mpmath.log((1 - p) / (1 - q)))


@pytest.mark.parametrize("is_object", [True, False])
@pytest.mark.parametrize("eps", [1e-6, 1e-3, 0.2])
def test_kls_match_high_precision(is_object, eps) -> None:
    label = torch.full(LOGITS.shape, is_object)
    prior = math.log1p(-eps) - math.log(eps)
    prior = prior if is_object else -prior
    for function, order in ((objectness_kl_exclusive, 1), (objectness_kl_inclusive, -1)):
        expected = torch.tensor([precise_kl(*(a, prior)[::order]) for a in LOGITS.tolist()])
        torch.testing.assert_close(function(LOGITS, label, eps), expected, rtol=1e-11, atol=1e-14)
        single = function(LOGITS.float(), label, eps)
        torch.testing.assert_close(single.double(), expected, rtol=1e-5, atol=1e-6)


def test_kl_of_two_guides_matches_torch_where_torch_is_finite() -> None:
    a, b = LOGITS[2:-2].repeat(6), LOGITS[2:-2].repeat_interleave(6)
    expected = kl_divergence(Bernoulli(logits=a), Bernoulli(logits=b))
    torch.testing.assert_close(kl_divergence(Objectness(logits=a), Objectness(logits=b)), expected, rtol=1e-6, atol=1e-9)
    assert Objectness(logits=a).expand((2, 36)).batch_shape == (2, 36)


def test_inclusive_kl_is_binary_cross_entropy_up_to_a_constant() -> None:
    label, eps = torch.arange(10) % 2 == 0, 0.03
    entropy = -(eps * math.log(eps) + (1 - eps) * math.log1p(-eps))
    target = torch.where(label, 1 - eps, eps).double()
    bce = binary_cross_entropy_with_logits(LOGITS, target, reduction="none")
    torch.testing.assert_close(objectness_cross_entropy(LOGITS, label, eps), bce)
    torch.testing.assert_close(objectness_kl_inclusive(LOGITS, label, eps), bce - entropy, rtol=1e-12, atol=1e-12)


def test_kappa_is_the_entropy_times_a_geometric_mean() -> None:
    """kappa_o = e^H(q) (1 - eps)^q eps^(1 - q) (docs/story.md), in the range where that formula is safe."""
    logit, eps = torch.linspace(-6, 6, 25), 0.01
    q = torch.sigmoid(logit)
    entropy = -(q * q.log() + (1 - q) * (1 - q).log())
    torch.testing.assert_close(bernoulli_entropy(logit), entropy)
    for label, (yes, no) in ((True, (1 - eps, eps)), (False, (eps, 1 - eps))):
        kappa = log_kappa_objectness(logit, torch.full((25,), label), eps).exp()
        torch.testing.assert_close(kappa, entropy.exp() * yes**q * no ** (1 - q))
    # Not "the probability of objectness" between the ends.
    assert (kappa - (1 - q)).abs().max() > 0.1


def test_gradients_are_finite_everywhere_and_right() -> None:
    label = torch.arange(10) % 3 == 0
    for function in (objectness_kl_exclusive, objectness_kl_inclusive, objectness_cross_entropy):
        for dtype in (torch.float64, torch.float32):
            logit = LOGITS.to(dtype).requires_grad_()
            (grad,) = torch.autograd.grad(function(logit, label, 1e-3).sum(), logit)
            assert bool(torch.isfinite(grad).all())
        inner = torch.linspace(-8, 8, 10, requires_grad=True)
        assert torch.autograd.gradcheck(lambda x, f=function: f(x, label, 1e-3), inner)


def test_prior_and_its_limits() -> None:
    prior = objectness_prior(torch.tensor([True, False]), 0.01, torch.float64)
    torch.testing.assert_close(prior.probs, torch.tensor([0.99, 0.01]))
    for eps in (0.0, 0.5, -1.0, 2.0):
        with pytest.raises(InputError, match="eps of the objectness prior"):
            objectness_prior(torch.tensor([True]), eps)
