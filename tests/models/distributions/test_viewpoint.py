from __future__ import annotations

import math

import pytest
import torch
from torch.distributions import kl_divergence

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.rotation import viewpoint_to_matrix
from nolbo_ppl.models.distributions import (
    ViewpointMixture,
    ViewpointNormal,
    ViewpointSinCos,
    WrappedNormal,
    kl_mixture_to_wrapped,
    kl_sincos_to_sincos,
    kl_wrapped_to_mixture,
)

ORDERS = torch.tensor([1, 2, 0, 4])


def guide(batch: int = 4, largest: float = 60.0, seed: int = 0) -> ViewpointMixture:
    generator = torch.Generator().manual_seed(seed)
    rand = lambda *shape: torch.randn(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    natural = largest / 3 * rand(batch, 3, 2)
    return ViewpointMixture(rand(batch, 3), natural, 0.5 * rand(batch, 2), 0.1 + 0.1 * rand(batch, 2).abs())


def story(batch: int = 4, order: torch.Tensor | None = None, scale: float = 0.05, seed: int = 1) -> ViewpointNormal:
    generator = torch.Generator().manual_seed(seed)
    loc = 2 * torch.randn(batch, 3, generator=generator, dtype=torch.float64) * torch.tensor([1.0, 0.2, 0.2])
    return ViewpointNormal(loc, torch.tensor(scale), order=order)


def mean_over_grid(density, value) -> torch.Tensor:
    """Integral of value(viewpoint) * density over a periodic grid of all three angles."""
    n = 48
    angle = torch.arange(n, dtype=torch.float64) * (2 * math.pi / n) - math.pi
    grid = torch.cartesian_prod(angle, angle, angle)
    weight = density(grid) * (2 * math.pi / n) ** 3
    return torch.einsum("n,n...->...", weight, value(grid))


@pytest.mark.parametrize("order", [None, 0, 1, 2, 3])
def test_normal_density_mean_rotation_and_entropy_by_quadrature(order) -> None:
    order = None if order is None else torch.tensor(order)
    p = ViewpointNormal(torch.tensor([0.4, 0.3, -0.2]), torch.tensor([0.5, 0.4, 0.4]), order=order)
    density = lambda v: p.log_prob(v).exp()  # noqa: E731
    torch.testing.assert_close(mean_over_grid(density, lambda v: torch.ones(len(v))), torch.tensor(1.0), atol=1e-9, rtol=0)
    torch.testing.assert_close(mean_over_grid(density, viewpoint_to_matrix), p.mean_rotation(), atol=1e-9, rtol=0)
    torch.testing.assert_close(mean_over_grid(density, lambda v: -p.log_prob(v)), p.entropy(), atol=1e-7, rtol=0)


def test_mixture_density_mean_rotation_and_entropy_by_quadrature() -> None:
    natural = torch.tensor([[3.0, 4.0], [-6.0, 1.0], [0.0, 0.0]])
    q = ViewpointMixture(torch.tensor([0.1, 0.5, -0.3]), natural, torch.tensor([0.3, -0.2]), torch.tensor([0.35, 0.4]))
    density = lambda v: q.log_prob(v).exp()  # noqa: E731
    torch.testing.assert_close(mean_over_grid(density, lambda v: torch.ones(len(v))), torch.tensor(1.0), atol=1e-9, rtol=0)
    torch.testing.assert_close(mean_over_grid(density, viewpoint_to_matrix), q.mean_rotation(), atol=1e-9, rtol=0)
    torch.testing.assert_close(mean_over_grid(density, lambda v: -q.log_prob(v)), q.entropy(), atol=1e-8, rtol=0)


@pytest.mark.parametrize("order", [None, ORDERS])
def test_samples_of_the_story(order, assert_mean) -> None:
    p = story(order=order, scale=0.3)
    v = p.sample((20_000,))
    assert bool(((v >= -math.pi) & (v < math.pi)).all())
    assert_mean(viewpoint_to_matrix(v), p.mean_rotation())
    assert_mean(-p.log_prob(v), p.entropy())


def test_samples_of_the_guide(assert_mean) -> None:
    q = guide()
    v = q.sample((20_000,))
    assert_mean(viewpoint_to_matrix(v), q.mean_rotation())
    assert_mean(-q.log_prob(v), q.entropy())


def test_rsample_gradient_of_the_mean_rotation(assert_mean) -> None:
    count, T = 20_000, torch.randn(3, 3)
    base = story(1, scale=0.3)
    loc = base.loc.expand(count, 3).clone().requires_grad_()
    (viewpoint_to_matrix(ViewpointNormal(loc, 0.3).rsample()) * T).sum().backward()
    closed = base.loc[0].clone().requires_grad_()
    (ViewpointNormal(closed, 0.3).mean_rotation() * T).sum().backward()
    assert_mean(loc.grad, closed.grad)


@pytest.mark.parametrize("order", [None, ORDERS])
def test_inclusive_kl_by_monte_carlo_on_the_quotient(order, assert_mean) -> None:
    p, q = story(order=order), guide()
    v = p.sample((20_000,))
    on_quotient = torch.ones(4, dtype=torch.long) if order is None else order
    log_q = q.log_prob_symmetric(v, on_quotient)
    # On the quotient the n modes of the story coincide: n times the density of their equal mixture, 1 for a free axis.
    log_p = p.log_prob(v) + torch.where(on_quotient == 0, math.log(2 * math.pi), on_quotient.clamp_min(1).log())
    assert_mean(log_p - log_q, kl_divergence(p, q))


def test_inclusive_kl_ignores_which_equivalent_azimuth_is_named() -> None:
    q, order = guide(), torch.tensor([2, 3, 0, 4])
    p = story(order=order)
    turn = torch.tensor([math.pi, 4 * math.pi / 3, 1.0, -math.pi / 2])
    turned = ViewpointNormal(p.loc + torch.nn.functional.pad(turn[:, None], (0, 2)), p.scale, order=order)
    torch.testing.assert_close(kl_divergence(turned, q), kl_divergence(p, q))
    torch.testing.assert_close(kl_divergence(q, turned), kl_divergence(q, p))
    one = ViewpointNormal(q.mode, torch.tensor(0.3))
    torch.testing.assert_close(kl_divergence(turned, one), kl_divergence(p, one))
    torch.testing.assert_close(kl_divergence(one, turned), kl_divergence(one, p))
    assert not torch.allclose(kl_divergence(ViewpointNormal(turned.loc, p.scale), q), kl_divergence(p, q))


@pytest.mark.parametrize("order", [None, torch.tensor([1, 2, 1, 4])])
def test_exclusive_kl_by_monte_carlo(order, assert_mean) -> None:
    # A wide prior: its other modes and wraps are not negligible, nor neglected.
    p = story(order=order, scale=0.3)
    natural = 80 * torch.stack((p.loc[:, :1].cos(), p.loc[:, :1].sin()), -1)
    natural = torch.cat((natural, 0.8 * natural), 1)
    q = ViewpointMixture(torch.zeros(4, 2), natural, p.loc[:, 1:] + 0.1, torch.full((4, 2), 0.2))
    v = q.sample((20_000,))
    assert_mean(q.log_prob(v) - p.log_prob(v), kl_divergence(q, p))


def test_mixture_kl_is_the_sum_over_angles() -> None:
    p, q = story(order=ORDERS), guide()
    rest = kl_divergence(WrappedNormal(p.loc[:, 1:], p.scale[:, 1:]), q.elevation_inplane).sum(-1)
    torch.testing.assert_close(kl_divergence(p, q), kl_wrapped_to_mixture(p.azimuth, q.azimuth, ORDERS) + rest)
    rest = kl_divergence(q.elevation_inplane, WrappedNormal(p.loc[:, 1:], p.scale[:, 1:])).sum(-1)
    torch.testing.assert_close(kl_divergence(q, p), kl_mixture_to_wrapped(q.azimuth, p.azimuth, ORDERS) + rest)


def test_kl_of_two_normals_and_its_symmetry(assert_mean) -> None:
    """Inclusive on the quotient, exclusive against the equal mixture, both exact for narrow densities."""
    p = story(order=torch.tensor([1, 2, 0, 3]), scale=0.06)
    turn = torch.tensor([0.0, math.pi, 1.0, 2 * math.pi / 3])
    loc = p.loc + torch.nn.functional.pad(turn[:, None], (0, 2)) + 0.05
    q = ViewpointNormal(loc, torch.tensor(0.08))
    v = q.sample((20_000,))
    exclusive = kl_divergence(q, p)
    assert_mean((q.log_prob(v) - p.log_prob(v))[:, [0, 1, 3]], exclusive[[0, 1, 3]], extra=1e-6)
    v = p.sample((20_000,))
    count = p.order.clamp_min(1)
    turns = [
        torch.where((j < count)[:, None], torch.nn.functional.pad((2 * math.pi * j / count)[:, None], (0, 2)), math.nan)
        for j in range(3)
    ]
    log_q = [q.angles.log_prob((v + t + math.pi) % (2 * math.pi) - math.pi).sum(-1).nan_to_num(-math.inf) for t in turns]
    folded = torch.logsumexp(torch.stack(log_q), 0)
    inclusive = kl_divergence(p, q)
    log_p = p.log_prob(v) + count.log()
    assert_mean((log_p - folded)[:, [0, 1, 3]], inclusive[[0, 1, 3]], extra=1e-6)
    # A free axis: elevation and in-plane rotation only.
    for result, (a, b) in ((exclusive, (q, p)), (inclusive, (p, q))):
        rest = kl_divergence(WrappedNormal(a.loc[2, 1:], a.scale[2, 1:]), WrappedNormal(b.loc[2, 1:], b.scale[2, 1:])).sum()
        torch.testing.assert_close(result[2], rest)
    plain = kl_divergence(ViewpointNormal(p.loc, p.scale), q)
    torch.testing.assert_close(plain[0], inclusive[0])


def test_sincos_against_monte_carlo(assert_mean) -> None:
    loc = story().loc
    q, p = ViewpointSinCos(loc + 0.1, torch.tensor(0.2)), ViewpointSinCos(loc, torch.tensor(0.25))
    x = q.sample((20_000,))
    assert x.shape == (20_000, 4, 3, 2)
    assert_mean(x, q.mean)
    assert_mean((x - q.mean).square(), q.variance)
    assert_mean(q.log_prob(x) - p.log_prob(x), kl_divergence(q, p))
    assert_mean(-q.log_prob(x), q.entropy())
    torch.testing.assert_close(ViewpointSinCos.viewpoint_of(q.mean), (q.loc + math.pi) % (2 * math.pi) - math.pi)
    torch.testing.assert_close(q.mean_rotation(), ViewpointNormal(q.loc, q.scale).mean_rotation())


def test_sincos_kl_with_symmetry(assert_mean) -> None:
    order = torch.tensor([1, 2, 0, 4])
    loc = story().loc
    turn = torch.tensor([0.0, math.pi, 1.0, math.pi / 2])
    q = ViewpointSinCos(loc + torch.nn.functional.pad(turn[:, None], (0, 2)) + 0.05, torch.tensor(0.1))
    p = ViewpointSinCos(loc, torch.tensor(0.1))
    result = kl_sincos_to_sincos(q, p, order)
    torch.testing.assert_close(result[0], kl_divergence(q, p)[0])
    x = q.sample((20_000,))
    for i, n in ((1, 2), (3, 4)):
        shifted = torch.arange(n)[:, None] * torch.tensor([2 * math.pi / n, 0.0, 0.0]) + loc[i]
        log_p = torch.logsumexp(ViewpointSinCos(shifted, torch.tensor(0.1)).log_prob(x[:, i, None]), -1) - math.log(n)
        assert_mean(q.log_prob(x)[:, i] - log_p, result[i], extra=1e-6)
    moved = ViewpointSinCos(q.loc + torch.tensor([0.7, 0.0, 0.0]), q.scale)
    torch.testing.assert_close(kl_sincos_to_sincos(moved, p, order)[2], result[2])


def test_gradients() -> None:
    q, p = guide(), story(order=ORDERS)
    inputs = [q.logits, q.natural, q.elevation_inplane_loc, q.elevation_inplane_scale]
    inputs = [x.detach().clone().requires_grad_() for x in inputs]
    value = p.sample()
    for f in (
        lambda *x: ViewpointMixture(*x).log_prob(value),
        lambda *x: kl_divergence(p, ViewpointMixture(*x)),
        lambda *x: kl_divergence(ViewpointMixture(*x), p),
        lambda *x: ViewpointMixture(*x).mean_rotation(),
    ):
        assert torch.autograd.gradcheck(f, inputs)
    loc, scale = p.loc.clone().requires_grad_(), torch.full((4, 3), 0.2).requires_grad_()
    for f in (
        lambda m, s: ViewpointNormal(m, s, order=ORDERS).log_prob(value),
        lambda m, s: kl_divergence(ViewpointNormal(m, s), p),
        lambda m, s: kl_divergence(p, ViewpointNormal(m, s)),
        lambda m, s: ViewpointNormal(m, s, order=ORDERS).mean_rotation(),
        lambda m, s: kl_sincos_to_sincos(ViewpointSinCos(m, s), ViewpointSinCos(p.loc, p.scale), ORDERS),
    ):
        assert torch.autograd.gradcheck(f, (loc, scale))


def test_single_precision() -> None:
    q, p = guide(40), story(40, order=ORDERS.repeat(10))
    q32 = ViewpointMixture(*(x.float() for x in (q.logits, q.natural, q.elevation_inplane_loc, q.elevation_inplane_scale)))
    p32 = ViewpointNormal(p.loc.float(), p.scale.float(), order=p.order)
    torch.testing.assert_close(kl_divergence(p32, q32).double(), kl_divergence(p, q), rtol=2e-4, atol=2e-4)
    torch.testing.assert_close(kl_divergence(q32, p32).double(), kl_divergence(q, p), rtol=2e-4, atol=2e-3)
    torch.testing.assert_close(q32.mean_rotation().double(), q.mean_rotation(), rtol=0, atol=1e-5)
    assert kl_divergence(p32, q32).dtype == torch.float32


def test_mode_is_the_peak_of_the_density() -> None:
    q = guide()
    peak = q.log_prob(q.mode)
    assert bool((q.log_prob(q.sample((2000,))) <= peak + 1e-12).all())
    torch.testing.assert_close(story().mode, (story().loc + math.pi) % (2 * math.pi) - math.pi)


def test_orders_are_counts() -> None:
    for order in (torch.tensor(1.0), torch.tensor(True)):
        with pytest.raises(InputError, match="order of symmetry that is no integer"):
            ViewpointNormal(torch.zeros(3), torch.tensor(0.1), order=order)


def test_negative_order_is_refused() -> None:
    with pytest.raises(ValueError, match="symmetry"):
        ViewpointNormal(torch.zeros(3), torch.tensor(0.1), order=torch.tensor(-1), validate_args=True)
