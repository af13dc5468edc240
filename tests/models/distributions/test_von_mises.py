from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from nolbo_ppl.models.distributions import VonMisesMixture
from nolbo_ppl.models.distributions.von_mises import default_nodes

LOGITS = torch.tensor([0.3, -0.5, 1.0], dtype=torch.float64)
MEAN = torch.tensor([2.9, -0.4, 1.3], dtype=torch.float64)
KAPPA = torch.tensor([40.0, 2.0, 300.0], dtype=torch.float64)


def mixture(max_concentration: float = 300.0, kappa: torch.Tensor = KAPPA) -> VonMisesMixture:
    return VonMisesMixture.from_mean_concentration(LOGITS, MEAN, kappa, max_concentration)


def test_log_prob_matches_scipy() -> None:
    x = np.linspace(-np.pi, np.pi, 301)
    weights = torch.softmax(LOGITS, -1).numpy()
    expected = np.log(sum(w * stats.vonmises.pdf(x, k, m) for w, k, m in zip(weights, KAPPA.numpy(), MEAN.numpy())))
    torch.testing.assert_close(mixture().log_prob(torch.as_tensor(x)), torch.as_tensor(expected), rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("kappa", [0.0, 1e-12, 0.3, 20.0, 300.0, 1e4])
def test_single_component_against_scipy_and_quadrature(kappa, circle) -> None:
    q = VonMisesMixture.from_mean_concentration(torch.zeros(1), torch.tensor([0.7]), torch.tensor([kappa]), 1e4)
    x = circle(4096)
    log_prob = q.log_prob(x)
    density = log_prob.exp() * (2 * math.pi / len(x))
    assert abs(density.sum().item() - 1) < 1e-11
    moment = torch.stack(((density * x.cos()).sum(), (density * x.sin()).sum()))
    torch.testing.assert_close(q.mean_direction(), moment, rtol=0, atol=1e-13)
    torch.testing.assert_close(q.entropy(), -(density * log_prob).sum(), rtol=0, atol=1e-11)
    if kappa >= 0.3:
        scipy = stats.vonmises(kappa, 0.7)
        torch.testing.assert_close(log_prob, torch.as_tensor(scipy.logpdf(x.numpy())), rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(q.mode.item(), 0.7, rtol=0, atol=1e-9)
        torch.testing.assert_close(q.circular_std.item(), math.sqrt(-2 * math.log(moment.norm())), rtol=1e-8, atol=0)
        # The highest-density region of one mode is the arc |v - mean| < a, known by scipy's distribution function.
        for arc in (0.3, 1.0, 2.0):
            a = arc / math.sqrt(kappa) if kappa > 1 else arc
            value = torch.tensor([0.7 + a, 0.7 - a])
            mass = scipy.cdf(0.7 + a) - scipy.cdf(0.7 - a)
            torch.testing.assert_close(q.hpd_mass(value), torch.full((2,), mass), rtol=0, atol=1e-3)


def test_uniform_mixture_has_finite_values_and_gradients() -> None:
    natural = torch.zeros(2, 2, requires_grad=True)
    logits = torch.zeros(2, requires_grad=True)
    q = VonMisesMixture(logits, natural)
    value = torch.tensor(0.4)
    assert abs(q.log_prob(value).item() + math.log(2 * math.pi)) < 1e-12
    # d log q / d eta at zero is half of (cos v, sin v), for two equal components.
    (grad,) = torch.autograd.grad(q.log_prob(value), natural, retain_graph=True)
    torch.testing.assert_close(grad, 0.5 * torch.tensor([[math.cos(0.4), math.sin(0.4)]]).expand(2, 2))
    (grad,) = torch.autograd.grad(q.mean_direction().sum(), natural)
    torch.testing.assert_close(grad, torch.full((2, 2), 0.25))
    assert bool(torch.isfinite(q.sample((100,))).all()) and bool(torch.isfinite(q.circular_std))


def test_samples_follow_the_density(assert_mean, circle) -> None:
    q = mixture()
    x = q.sample((40_000,))
    assert bool(((x >= -math.pi) & (x < math.pi)).all())
    assert_mean(torch.stack((x.cos(), x.sin()), -1), q.mean_direction())
    assert_mean(-q.log_prob(x), q.entropy())
    grid = circle(20_000)
    cdf = q.log_prob(grid).exp().cumsum(0) * (2 * math.pi / len(grid))
    quantile = np.interp(x.numpy(), grid.numpy(), cdf.numpy())
    assert stats.kstest(quantile, "uniform").pvalue > 1e-4


@pytest.mark.parametrize("order", [1, 2, 3])
def test_highest_density_mass_of_samples_is_uniform(order) -> None:
    x = mixture().sample((5000,))
    mass = mixture().hpd_mass(x, order)
    assert stats.kstest(mass.numpy(), "uniform").pvalue > 1e-4


def test_highest_density_mass_matches_sorted_quadrature(circle) -> None:
    q, x = mixture(), circle(200_000)
    density = q.log_prob(x).exp()
    values = torch.tensor([2.9, 3.1, -0.4, 1.3, 1.45, 0.2, -2.0])
    for order in (1, 2):
        folded = sum(q.log_density(x + 2 * math.pi * j / order).exp() for j in range(order))
        level = sum(q.log_density(values + 2 * math.pi * j / order).exp() for j in range(order))
        expected = torch.stack([density[folded > v].sum() for v in level]) * (2 * math.pi / len(x))
        result = q.hpd_mass(values, order)
        torch.testing.assert_close(result[1:], expected[1:], rtol=0, atol=2e-4)
        torch.testing.assert_close(result[0], expected[0], rtol=0, atol=2e-3)  # at the very top of a component
    assert q.hpd_mass(values, 0).tolist() == [0.0] * len(values)


def test_symmetric_log_prob_sums_the_equivalent_azimuths() -> None:
    q = mixture().expand((5,))
    value = torch.linspace(-3, 3, 5)
    order = torch.tensor([1, 2, 0, 4, 3])
    result = q.log_prob_symmetric(value, order)
    for i, n in enumerate(order.tolist()):
        terms = [q.log_density(value + 2 * math.pi * j / n)[i] for j in range(n)]
        expected = torch.logsumexp(torch.stack(terms), 0) if n else torch.tensor(0.0)
        torch.testing.assert_close(result[i], expected)
    many = q.log_prob_symmetric(value.expand(7, 5), order)
    torch.testing.assert_close(many, result.expand(7, 5))


@pytest.mark.parametrize("order", [2, 4])
def test_symmetric_density_is_normalised_on_the_quotient(order, circle) -> None:
    x = circle(2000) / order
    total = mixture().log_prob_symmetric(x, order).exp().sum() * (2 * math.pi / order / len(x))
    assert abs(total.item() - 1) < 1e-11


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6))
def test_mode_is_the_highest_density(seed) -> None:
    generator = torch.Generator().manual_seed(seed)
    logits = torch.randn(4, generator=generator, dtype=torch.float64)
    spread = 10 ** (3 * torch.rand(1, generator=generator, dtype=torch.float64) - 0.5)
    natural = spread * torch.randn(4, 2, generator=generator, dtype=torch.float64)
    q = VonMisesMixture(logits, natural, max_concentration=300.0)
    grid = torch.arange(50_000, dtype=torch.float64) * (2 * math.pi / 50_000) - math.pi
    best = q.log_prob(grid).max()
    found = q.log_prob(q.mode)
    assert found >= best - 1e-12
    assert found <= best + 300 * (2 * math.pi / 50_000) ** 2


def test_mode_is_batched() -> None:
    q = mixture().expand((3, 2))
    assert q.mode.shape == (3, 2)
    torch.testing.assert_close(q.mode, mixture().mode.expand(3, 2))
    assert abs(mixture().mode.item() - 1.3) < 1e-3


def test_entropy_of_crossing_components_needs_and_has_enough_nodes() -> None:
    """Against a tenfold finer rule, over separations that put the branch points where they hurt most."""
    separation = torch.linspace(0.05, 3.1, 60)
    mean = torch.stack((torch.zeros(60), separation), -1)
    for kappa in (300.0, 30.0):
        concentration = torch.tensor([kappa, kappa])
        q = VonMisesMixture.from_mean_concentration(torch.zeros(60, 2), mean, concentration, kappa)
        nodes = default_nodes(kappa, torch.float64)
        torch.testing.assert_close(q.entropy(), q.entropy(10 * nodes), rtol=0, atol=1e-10)
        coarse = default_nodes(kappa, torch.float32)
        torch.testing.assert_close(q.entropy(coarse), q.entropy(10 * nodes), rtol=0, atol=1e-5)
        assert (q.entropy(nodes // 8) - q.entropy(10 * nodes)).abs().max() > 1e-6


def test_single_precision_agrees_with_double() -> None:
    kappa = torch.tensor([1.0, 300.0, 1e4])
    x = torch.linspace(-3.1, 3.1, 500)
    double = mixture(1e4, kappa)
    single = VonMisesMixture(LOGITS.float(), double.natural.float(), 1e4)
    # One half ulp of the angle itself is 1.2e-7 rad, on a slope of 1e4 per rad 1e-3 nats.
    torch.testing.assert_close(single.log_prob(x.float()).double(), double.log_prob(x.float().double()), rtol=1e-5, atol=3e-3)
    for name in ("circular_std", "mean"):
        torch.testing.assert_close(getattr(single, name).double(), getattr(double, name), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(single.mean_direction().double(), double.mean_direction(), rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(single.entropy().double(), double.entropy(), rtol=5e-5, atol=5e-5)


def test_gradients_below_the_limit() -> None:
    logits = LOGITS.clone().requires_grad_()
    natural = mixture().natural.detach()
    natural = (natural * torch.tensor([1.0, 1.0, 0.3])[:, None]).requires_grad_()
    value = torch.tensor([0.2, 3.0], requires_grad=True)
    check = torch.autograd.gradcheck
    assert check(lambda a, b, v: VonMisesMixture(a, b).log_prob(v), (logits, natural, value))
    assert check(lambda a, b: VonMisesMixture(a, b).log_prob_symmetric(value, 3), (logits, natural))
    assert check(lambda a, b: VonMisesMixture(a, b).mean_direction(), (logits, natural))
    assert check(lambda a, b: VonMisesMixture(a, b).entropy(), (logits, natural))
    assert check(lambda a, b: VonMisesMixture(a, b).circular_std, (logits, natural))


def test_no_limit_unless_one_is_given() -> None:
    """Every kappa is what it was given as, and its gradient the function's own; ends of the scale included."""
    q = VonMisesMixture.from_mean_concentration(torch.zeros(2), torch.zeros(2), torch.tensor([1e4, 1e-3]))
    torch.testing.assert_close(q.concentration, torch.tensor([1e4, 1e-3]))
    natural = torch.tensor([[400.0, 300.0]], requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda x: VonMisesMixture(torch.zeros(1), x).log_prob(torch.tensor(0.7)), natural, eps=1e-3, atol=1e-5
    )


def test_concentration_is_limited_and_can_come_back() -> None:
    natural = torch.tensor([[400.0, 300.0]], requires_grad=True)  # length 500 in the direction (0.8, 0.6)
    q = VonMisesMixture(torch.zeros(1), natural, max_concentration=50.0)
    torch.testing.assert_close(q.concentration, torch.tensor([50.0]))
    mean = math.atan2(0.6, 0.8)
    torch.testing.assert_close(q.component_mean, torch.tensor([mean]))
    unit = torch.tensor([[0.8, 0.6]])
    # A truth far from the mean: descent on -log q must shorten the vector although the limit hides its length.
    (grad,) = torch.autograd.grad(-q.log_prob(torch.tensor(mean + 0.5)), natural, retain_graph=True)
    assert (grad * unit).sum() > 0.05
    # A truth at the mean: descent would lengthen it further, which the limit stops.
    (grad,) = torch.autograd.grad(-q.log_prob(torch.tensor(mean)), natural, retain_graph=True)
    assert (grad * unit).sum().abs() < 1e-12
    # Across the vector the gradient is exact.
    across = torch.tensor([[-0.6, 0.8]])
    (grad,) = torch.autograd.grad(q.log_prob(torch.tensor(mean + 0.1)), natural)
    step = 1e-3
    turned = [
        VonMisesMixture(torch.zeros(1), natural + s * across, 50.0).log_prob(torch.tensor(mean + 0.1)) for s in (step, -step)
    ]
    torch.testing.assert_close((grad * across).sum(), (turned[0] - turned[1]).detach() / (2 * step), rtol=1e-6, atol=1e-9)
