"""The KL of wrapped normals is the KL: against quadrature of brute-force densities, narrow, diffuse and under symmetry."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.distributions import kl_divergence

from nolbo_ppl.errors import InputError
from nolbo_ppl.models.distributions import (
    ViewpointNormal,
    VonMisesMixture,
    WrappedNormal,
    kl_of_angles,
    wrapped_normal_kl,
)
from nolbo_ppl.models.distributions.wrapped_normal_kl import _expected_log_density, log_density_mean


def log_density(x: Tensor, loc: float, scale: float) -> Tensor:
    """A sum over wraps, as many as a wide scale needs."""
    turns = torch.arange(-2 - int(2 * scale), 3 + int(2 * scale)) * (2 * math.pi)
    return torch.logsumexp(torch.distributions.Normal(loc, scale).log_prob(x[:, None] + turns), -1)


def circle_of(nodes: int) -> Tensor:
    return torch.arange(nodes) * (2 * math.pi / nodes) - math.pi


def by_quadrature(loc_q: float, scale_q: float, loc_p: float, scale_p: float, order: int = 1, nodes: int = 4000) -> float:
    """KL of q to the equal mixture of p over a group of turns, on the whole circle."""
    x = circle_of(nodes)
    log_q = log_density(x, loc_q, scale_q)
    log_p = torch.stack([log_density(x, loc_p + 2 * math.pi * j / order, scale_p) for j in range(order)])
    log_p = torch.logsumexp(log_p, 0) - math.log(order)
    return float((log_q.exp() * (log_q - log_p)).sum() * (2 * math.pi / nodes))


@pytest.mark.parametrize("scale_q", [0.1, 0.5, 1.0, 2.0, 5.0, 31.6])
@pytest.mark.parametrize("scale_p", [0.1, 0.4, 1.0, 1.7, 5.0])
def test_against_quadrature(scale_q: float, scale_p: float) -> None:
    difference = torch.tensor([0.0, 0.7, 2.0, 3.0, math.pi])
    q = WrappedNormal(2.0 + difference, torch.tensor(scale_q).expand(5))
    p = WrappedNormal(torch.tensor(2.0).expand(5), torch.tensor(scale_p).expand(5))
    expected = torch.tensor([by_quadrature(2.0 + float(d), scale_q, 2.0, scale_p) for d in difference])
    torch.testing.assert_close(kl_divergence(q, p), expected, rtol=1e-7, atol=1e-9)
    single = kl_divergence(WrappedNormal(q.loc.float(), q.scale.float()), WrappedNormal(p.loc.float(), p.scale.float()))
    torch.testing.assert_close(single.double(), expected, rtol=2e-5, atol=2e-6)


def test_the_cases_that_a_bound_got_wrong() -> None:
    """Two densities that are uniform to 4e-6; the guide of the smallest concentration against the prior of 0.05 rad."""
    value = float(kl_divergence(WrappedNormal(torch.tensor(0.0), torch.tensor(5.0)), WrappedNormal(torch.tensor(3.0), 5.0)))
    assert abs(value) < 1e-9
    for scale, expected in ((2.0, 0.074), (1.0, 2.32)):
        q, p = (WrappedNormal(torch.tensor(loc), torch.tensor(scale)) for loc in (0.0, 3.0))
        assert float(kl_divergence(q, p)) == pytest.approx(expected, abs=5e-3)
        assert float(kl_of_angles(q.loc, q.scale, p.loc, p.scale)) > 1.9 * expected
    uniform, prior = (WrappedNormal(torch.tensor(1.0), torch.tensor(s)) for s in (1e-3**-0.5, 0.05))
    # of a uniform density: E[d^2] = pi^2 / 3, and next to nothing of the neighbouring modes
    by_hand = math.pi**2 / 6 / 0.05**2 + math.log(0.05 * math.sqrt(2 * math.pi)) - math.log(2 * math.pi)
    assert float(kl_divergence(uniform, prior)) == pytest.approx(by_hand, abs=1e-3)
    assert by_hand == pytest.approx(654, abs=1)


@pytest.mark.parametrize("order", [2, 3, 4])
@pytest.mark.parametrize(("scale_q", "scale_p"), [(0.05, 0.05), (0.4, 0.1), (1.5, 0.1), (0.3, 0.6), (5.0, 2.0)])
def test_under_a_symmetry(order: int, scale_q: float, scale_p: float) -> None:
    q, p = WrappedNormal(torch.tensor(0.9), torch.tensor(scale_q)), WrappedNormal(torch.tensor(0.2), torch.tensor(scale_p))
    exclusive = by_quadrature(0.9, scale_q, 0.2, scale_p, order, 20_000)
    assert float(wrapped_normal_kl(q, p, order, quotient=False)) == pytest.approx(exclusive, rel=1e-7, abs=1e-9)
    # on the quotient: the n-fold angle of both
    inclusive = by_quadrature(0.9 * order, scale_q * order, 0.2 * order, scale_p * order, 1, 20_000)
    assert float(wrapped_normal_kl(q, p, order)) == pytest.approx(inclusive, rel=1e-7, abs=1e-9)


def test_viewpoints_of_a_diffuse_guide_are_exact() -> None:
    """The one-mode guide as it starts and as it ends, against the prior with and without symmetry."""
    scale = torch.tensor([1e-3, 0.1, 5.0, 300.0]).rsqrt()
    q = ViewpointNormal(torch.tensor([[0.5, 0.1, 0.0]]).expand(4, 3), torch.stack((scale, 0 * scale + 0.3, 0 * scale + 1.3), -1))
    p = ViewpointNormal(torch.tensor([2.0, 0.2, -0.1]), 0.05)
    rest = by_quadrature(0.1, 0.3, 0.2, 0.05, nodes=20_000) + by_quadrature(0.0, 1.3, -0.1, 0.05, nodes=20_000)
    expected = torch.tensor([by_quadrature(0.5, float(s), 2.0, 0.05, nodes=20_000) for s in scale]) + rest
    torch.testing.assert_close(kl_divergence(q, p), expected, rtol=1e-6, atol=1e-6)
    folded = ViewpointNormal(p.loc, p.scale, order=torch.tensor(2))
    expected = torch.tensor([by_quadrature(0.5, float(s), 2.0, 0.05, 2, nodes=20_000) for s in scale]) + rest
    torch.testing.assert_close(kl_divergence(q, folded), expected, rtol=1e-6, atol=1e-6)
    with pytest.raises(InputError, match="different symmetries"):
        kl_divergence(ViewpointNormal(p.loc, p.scale, order=torch.tensor(3)), folded)


def test_both_forms_agree_where_both_hold() -> None:
    """The divergence of the normals and the Fourier series, on either side of the switch between them."""
    difference, scale_q, scale_p = torch.tensor([0.0, 0.5, 1.2]), torch.full((3,), 0.15), torch.full((3,), 0.2)
    series = -WrappedNormal(difference, scale_q).entropy() - _expected_log_density(difference, scale_q, scale_p)
    torch.testing.assert_close(series, kl_of_angles(difference, scale_q, torch.zeros(3), scale_p), rtol=0, atol=1e-12)
    # over the circle the log density has the mean a_0
    for scale in (0.3, 1.4, 1.6, 4.0):
        mean = log_density(circle_of(20_000), 0.0, scale).mean()
        torch.testing.assert_close(log_density_mean(torch.tensor(scale)), mean, rtol=1e-7, atol=1e-9)


def test_gradients_across_the_switch() -> None:
    loc, scale = torch.tensor([0.1, 2.9, 1.0, 0.4], requires_grad=True), torch.tensor([0.1, 0.3, 2.0, 0.6], requires_grad=True)
    other = torch.tensor([0.05, 0.3, 1.7, 0.9], requires_grad=True)
    order = torch.tensor([1, 1, 1, 3])
    for quotient in (True, False):
        assert torch.autograd.gradcheck(
            lambda m, s, t, quotient=quotient: wrapped_normal_kl(
                WrappedNormal(m, s), WrappedNormal(torch.zeros(4), t), order, quotient
            ),
            (loc, scale, other),
        )


@pytest.mark.parametrize("kappa", [1e-3, 0.5, 5.0, 60.0, 2000.0])
def test_mixtures_to_mixtures(kappa: float) -> None:
    p = VonMisesMixture.from_mean_concentration(torch.tensor([0.2, -0.4]), torch.tensor([0.3, 2.9]), torch.tensor([kappa, 2.0]))
    q = VonMisesMixture.from_mean_concentration(torch.zeros(2), torch.tensor([-3.0, 0.5]), torch.tensor([0.1, kappa]))
    x = circle_of(60_000)
    log_p, log_q = p.log_prob(x), q.log_prob(x)
    expected = (log_p.exp() * (log_p - log_q)).sum() * (2 * math.pi / len(x))
    torch.testing.assert_close(kl_divergence(p, q), expected, rtol=1e-9, atol=1e-9)
    assert float(kl_divergence(p, p)) == pytest.approx(0, abs=1e-12)
    assert float(p.concentration.max()) == pytest.approx(max(kappa, 2.0), rel=1e-12), "no silent limit"
