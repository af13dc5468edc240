from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from scipy import integrate
from torch.distributions import kl_divergence

from nolbo_ppl.models.distributions import (
    VonMisesMixture,
    WrappedNormal,
    kl_mixture_to_wrapped,
    kl_wrapped_to_mixture,
)


def random_mixture(batch: int, seed: int, largest: float = 300.0, dtype: torch.dtype = torch.float64) -> VonMisesMixture:
    generator = torch.Generator().manual_seed(seed)
    logits = torch.randn(batch, 4, generator=generator, dtype=torch.float64)
    mean = 2 * math.pi * torch.rand(batch, 4, generator=generator, dtype=torch.float64)
    kappa = largest * torch.rand(batch, 4, generator=generator, dtype=torch.float64) ** 3
    kappa[0] = largest  # every component as narrow as the limit allows
    q = VonMisesMixture.from_mean_concentration(logits, mean, kappa)
    return VonMisesMixture(q.logits.to(dtype), q.natural.to(dtype))


def dense_inclusive(p: WrappedNormal, q: VonMisesMixture, order: int, nodes: int = 30_000) -> torch.Tensor:
    """KL of the folded densities by a fine rule over one period of the quotient."""
    result = []
    for i in range(len(p.loc)):
        # Around the mean: the density of p is below 1e-30 outside.
        half = min(math.pi / order, 12 * p.scale[i].item())
        x = p.loc[i] + half * (2 * torch.arange(nodes, dtype=torch.float64) / nodes - 1)
        turns = [2 * math.pi * j / order for j in range(order)]
        log_p = torch.logsumexp(torch.stack([_wrapped(p, i, x + t) for t in turns]), 0)
        log_q = torch.logsumexp(torch.stack([_component(q, i, x + t) for t in turns]), 0)
        result.append((log_p.exp() * (log_p - log_q)).sum() * (2 * half / nodes))
    return torch.stack(result)


def _wrapped(p: WrappedNormal, i: int, x: torch.Tensor) -> torch.Tensor:
    turns = torch.arange(-3, 4) * (2 * math.pi)
    return torch.logsumexp(torch.distributions.Normal(p.loc[i], p.scale[i]).log_prob(x[:, None] + turns), -1)


def _component(q: VonMisesMixture, i: int, x: torch.Tensor) -> torch.Tensor:
    kappa, mean = q.concentration[i], q.component_mean[i]
    log_i0 = torch.log(torch.special.i0e(kappa)) + kappa
    terms = q.log_weights[i] + kappa * torch.cos(x[:, None] - mean) - math.log(2 * math.pi) - log_i0
    return torch.logsumexp(terms, -1)


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("scale", [0.02, 0.05, 0.4])
def test_inclusive_kl_matches_dense_quadrature(order, scale) -> None:
    q = random_mixture(6, 1)
    p = WrappedNormal(torch.linspace(-3, 3, 6), torch.full((6,), scale))
    result = kl_wrapped_to_mixture(p, q, torch.full((6,), order))
    torch.testing.assert_close(result, dense_inclusive(p, q, order), rtol=1e-10, atol=1e-10)


def test_inclusive_kl_at_the_crossing_of_two_narrow_components() -> None:
    """The worst case: the mean of p on the kink between two components of kappa 300, at many separations."""
    half = torch.linspace(0.05, 3.0, 25) / 2
    q = VonMisesMixture.from_mean_concentration(torch.zeros(25, 2), torch.stack((-half, half), -1), torch.tensor([300.0, 300.0]))
    p = WrappedNormal(torch.zeros(25), torch.full((25,), 0.05))
    exact = dense_inclusive(p, q, 1, 50_000)
    torch.testing.assert_close(kl_divergence(p, q), exact, rtol=1e-10, atol=1e-10)
    single = VonMisesMixture(q.logits.float(), q.natural.float())
    result = kl_divergence(WrappedNormal(p.loc.float(), p.scale.float()), single).double()
    torch.testing.assert_close(result, exact, rtol=1e-3, atol=1e-3)


def test_inclusive_kl_in_single_precision() -> None:
    q = random_mixture(50, 3)
    p = WrappedNormal(torch.linspace(-3, 3, 50), torch.full((50,), 0.05))
    single = kl_divergence(WrappedNormal(p.loc.float(), p.scale.float()), random_mixture(50, 3, dtype=torch.float32))
    torch.testing.assert_close(single.double(), kl_divergence(p, q), rtol=2e-4, atol=2e-4)


def test_inclusive_kl_against_monte_carlo_and_mixed_orders(assert_mean) -> None:
    q = random_mixture(4, 5, largest=30.0)
    order = torch.tensor([1, 0, 2, 4])
    p = WrappedNormal(torch.tensor([0.3, 1.0, -2.0, 3.0]), torch.tensor(0.05).expand(4))
    result = kl_wrapped_to_mixture(p, q, order)
    assert result[1] == 0
    x = p.sample((20_000,))
    log_p = torch.distributions.Normal(0.0, 0.05).log_prob((x - p.loc + math.pi) % (2 * math.pi) - math.pi)
    expected = log_p - q.log_prob_symmetric(x, order)
    assert_mean(expected[:, order > 0], result[order > 0])


def scipy_exclusive(q: VonMisesMixture, p: WrappedNormal, i: int, order: int) -> float:
    """Adaptive integration, broken at every kink of the wrapped square and at the components."""
    loc, scale = p.loc[i].item(), p.scale[i].item()
    kappa, mean = q.concentration[i].numpy(), q.component_mean[i].numpy()
    weight = q.weights[i].numpy()
    peak = weight * np.exp(-kappa) / (2 * np.pi * np.i0(kappa) * np.exp(-kappa))
    period = 2 * np.pi / order

    def integrand(d: float) -> float:
        density = float((peak * np.exp(kappa * (np.cos(d + loc - mean)))).sum())
        turned = (d + period / 2) % period - period / 2
        modes = np.exp(-0.5 * ((turned + period * np.arange(-4, 5)) ** 2 - turned**2) / scale**2).sum()
        log_p = math.log(modes) - 0.5 * (turned / scale) ** 2 - math.log(scale * math.sqrt(2 * math.pi)) - math.log(order)
        return density * (math.log(density) - log_p) if density > 0 else 0.0

    kinks = [period * (k + 0.5) for k in range(-order, order)]
    modes = [(m - loc + math.pi) % (2 * math.pi) - math.pi for m in mean]
    points = sorted({-math.pi, math.pi, *(x for x in kinks + modes if -math.pi < x < math.pi)})
    return sum(integrate.quad(integrand, a, b, epsabs=1e-11, epsrel=1e-12, limit=400)[0] for a, b in itertools.pairwise(points))


@pytest.mark.parametrize("order", [1, 2, 3])
def test_exclusive_kl_matches_adaptive_integration(order) -> None:
    q = random_mixture(4, 7)
    p = WrappedNormal(torch.linspace(-3, 2, 4), torch.tensor([0.05, 0.2, 0.5, 1.2]))
    result = kl_mixture_to_wrapped(q, p, torch.full((4,), order))
    expected = torch.tensor([scipy_exclusive(q, p, i, order) for i in range(4)])
    torch.testing.assert_close(result, expected, rtol=1e-10, atol=1e-8)


def test_exclusive_kl_of_mixed_orders_is_exact(circle) -> None:
    q = random_mixture(5, 9, largest=60.0)
    p = WrappedNormal(torch.linspace(-3, 3, 5), torch.tensor([0.1, 0.4, 0.1, 0.6, 3.0]))
    order = torch.tensor([1, 2, 0, 4, 1])
    result = kl_mixture_to_wrapped(q, p, order)
    assert result[2] == 0
    x = circle(4000)[:, None]
    for i, n in enumerate(order.tolist()):
        if n == 0:
            continue
        one = kl_mixture_to_wrapped(q, p, n)[i]
        torch.testing.assert_close(result[i], one)
        turns = [2 * math.pi * j / n for j in range(n)]
        log_p = torch.logsumexp(torch.stack([p.log_prob((x + t + math.pi) % (2 * math.pi) - math.pi) for t in turns]), 0)
        log_q = q.log_prob(x)
        exact = ((log_q.exp() * (log_q - log_p + math.log(n))).sum(0) * (2 * math.pi / len(x)))[i]
        torch.testing.assert_close(one, exact, rtol=1e-8, atol=1e-8)


def test_exclusive_kl_in_single_precision() -> None:
    q = random_mixture(50, 11)
    p = WrappedNormal(torch.linspace(-3, 3, 50), torch.full((50,), 0.05))
    single = kl_divergence(random_mixture(50, 11, dtype=torch.float32), WrappedNormal(p.loc.float(), p.scale.float()))
    torch.testing.assert_close(single.double(), kl_divergence(q, p), rtol=1e-4, atol=1e-3)


def test_gradients() -> None:
    start = random_mixture(3, 13, largest=50.0)
    order = torch.tensor([1, 2, 0])
    inputs = [
        start.logits.clone(),
        start.natural.clone(),
        torch.tensor([0.1, 2.0, 3.0]),
        torch.tensor([0.05, 0.1, 0.2]),
    ]
    inputs = [x.requires_grad_() for x in inputs]
    for function in (
        lambda a, b, m, s: kl_wrapped_to_mixture(WrappedNormal(m, s), VonMisesMixture(a, b), order),
        lambda a, b, m, s: kl_mixture_to_wrapped(VonMisesMixture(a, b), WrappedNormal(m, s), order),
    ):
        # The node set follows the scale, so its derivative is checked to the accuracy of the rule, not of the machine.
        assert torch.autograd.gradcheck(function, inputs, atol=1e-5, rtol=1e-4)


def test_inclusive_optimum_is_calibrated() -> None:
    """docs/bound.md: the best scale of the guide for errors e is sqrt(scale^2 + e^2), not the prior's."""
    error = torch.tensor([-0.3, -0.1, 0.2, 0.2])
    spread = (error.square().mean() + 0.05**2).sqrt()
    kappa = torch.linspace(5.0, 60.0, 1101)
    q = VonMisesMixture.from_mean_concentration(torch.zeros(1101, 1), torch.zeros(1101, 1), kappa[:, None])
    p = WrappedNormal(error[:, None], torch.tensor(0.05))
    best = kappa[kl_wrapped_to_mixture(p, q).mean(0).argmin()]
    assert abs(best.rsqrt().item() / spread.item() - 1) < 0.03
