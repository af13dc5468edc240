from __future__ import annotations

import math

import mpmath
import pytest
import torch
from scipy import integrate, stats
from torch.distributions import kl_divergence

from nolbo_ppl.geometry.rotation import geodesic_angle
from nolbo_ppl.models.distributions import (
    LOG_HAAR_VOLUME,
    MatrixFisher,
    concentration_to_scale,
    log_normalizer,
    mean_resultant,
    scale_to_concentration,
)
from nolbo_ppl.models.distributions.matrix_fisher import log_normalizer_excess, mean_misfit


def angle_integral(kappa: float, weight=lambda w: 1.0) -> float:
    """(1 / pi) int exp(2 kappa (cos w - 1)) weight(w) (1 - cos w) dw by adaptive integration."""
    width = min(math.pi, 10 / math.sqrt(max(kappa, 1e-3)))
    pieces = [(0, width), (width, math.pi)]
    f = lambda w: math.exp(2 * kappa * (math.cos(w) - 1)) * weight(w) * (1 - math.cos(w)) / math.pi  # noqa: E731
    return sum(integrate.quad(f, a, b, epsabs=0, epsrel=1e-12)[0] for a, b in pieces if b > a)


@pytest.mark.parametrize("kappa", [0.0, 0.3, 2.0, 6.0])
def test_normaliser_by_integration_over_so3(kappa, so3_grid, random_rotations) -> None:
    R, weight = so3_grid
    mode = random_rotations(1)[0]
    integral = (weight * torch.exp(kappa * (mode.T @ R).diagonal(dim1=-2, dim2=-1).sum(-1))).sum()
    torch.testing.assert_close(integral.log(), log_normalizer(torch.tensor(kappa)), rtol=1e-10, atol=1e-10)
    p = MatrixFisher(mode, torch.tensor(kappa))
    density = weight * p.log_prob(R).exp()
    torch.testing.assert_close(density.sum(), torch.tensor(1.0), rtol=0, atol=1e-9)
    torch.testing.assert_close((density[:, None, None] * R).sum(0), p.mean, rtol=0, atol=1e-9)
    torch.testing.assert_close(-(density * p.log_prob(R)).sum(), p.entropy(), rtol=0, atol=1e-8)


@pytest.mark.parametrize("kappa", [0.1, 5.0, 14.9, 15.1, 200.0, 1e4, 1e5])
def test_normaliser_and_resultant_by_the_angle_integral(kappa) -> None:
    total = angle_integral(kappa)
    misfit = angle_integral(kappa, lambda w: 2 * (1 - math.cos(w))) / total
    k = torch.tensor(kappa)
    torch.testing.assert_close(log_normalizer_excess(k).item(), math.log(total), rtol=1e-10, atol=1e-11)
    torch.testing.assert_close(mean_misfit(k).item(), misfit, rtol=1e-9, atol=0)
    torch.testing.assert_close(mean_resultant(k).item(), 1 - misfit / 3, rtol=1e-11, atol=0)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_normaliser_against_high_precision_from_0_to_1e5(dtype) -> None:
    mpmath.mp.dps = 40
    for kappa in [0.0, 1e-8, 1e-3, 0.7, 14.0, 16.0, 300.0, 1e5]:
        k = torch.tensor(kappa, dtype=dtype, requires_grad=True)
        x = 2 * mpmath.mpf(k.item())
        exact = mpmath.log(mpmath.besseli(0, x) - mpmath.besseli(1, x)) - x
        tolerance = 1e-12 if dtype == torch.float64 else 2e-6
        assert abs(log_normalizer_excess(k).item() - float(exact)) <= tolerance * max(1.0, abs(float(exact)))
        ratio = mpmath.besseli(1, x) / mpmath.besseli(0, x)
        misfit = 4 - 2 * ratio / (x * (1 - ratio)) if x else mpmath.mpf(3)
        assert abs(mean_misfit(k).item() / float(misfit) - 1) <= (2e-11 if dtype == torch.float64 else 2e-6)
        (slope,) = torch.autograd.grad(log_normalizer_excess(k), k)
        assert abs(-slope.item() / float(misfit) - 1) <= (2e-11 if dtype == torch.float64 else 2e-6)


def test_single_precision_log_prob_near_and_far_from_the_mode(random_rotations) -> None:
    mode = random_rotations(200)
    for kappa in (0.5, 200.0, 1e4):
        R = MatrixFisher(mode, kappa).sample()
        for value in (R, random_rotations(200, seed=1)):
            double = MatrixFisher(mode, kappa).log_prob(value)
            single = MatrixFisher(mode.float(), kappa).log_prob(value.float()).double()
            # The matrices' own rounding, 6e-8, on a slope of kappa times the distance.
            tolerance = 1e-4 + 4e-6 * kappa * (value - mode).norm(dim=(-2, -1)).max().item()
            torch.testing.assert_close(single, double, rtol=1e-5, atol=tolerance)


@pytest.mark.parametrize("kappa", [0.0, 0.2, 0.5, 3.0, 200.0, 1e5])
def test_samples(kappa, assert_mean, random_rotations) -> None:
    mode = random_rotations(1)[0]
    p = MatrixFisher(mode, torch.tensor(kappa))
    R = p.sample((20_000,))
    torch.testing.assert_close(R.mT @ R, torch.eye(3).expand_as(R), rtol=0, atol=1e-12)
    assert bool((torch.linalg.det(R) > 0).all())
    assert_mean(R, p.mean)
    assert_mean(-p.log_prob(R), p.entropy(), extra=1e-12)
    angle = geodesic_angle(R, mode.expand_as(R))
    grid = torch.linspace(0, min(math.pi, 12 / math.sqrt(2 * max(kappa, 1e-9))), 20_001)
    density = torch.exp(2 * kappa * (grid.cos() - 1)) * (1 - grid.cos())
    cdf = torch.cumulative_trapezoid(density, grid)
    index = torch.searchsorted(grid, angle).clamp(1, 20_000) - 1
    assert stats.kstest((cdf / cdf[-1])[index].numpy(), "uniform").pvalue > 1e-4


@pytest.mark.parametrize("kappa", [0.4, 5.0, 300.0])
def test_rsample_gradients(kappa, assert_mean, random_rotations) -> None:
    """The derivatives of E[tr(T' R)] in concentration and mode against those of the closed form rho tr(T' R_mode)."""
    count, mode, T = 20_000, random_rotations(1)[0], random_rotations(1, seed=3)[0]
    k = torch.full((count,), kappa, requires_grad=True)
    M = mode.expand(count, 3, 3).clone().requires_grad_()
    (MatrixFisher(M, k, validate_args=False).rsample() * T).sum().backward()
    closed = torch.tensor(kappa, requires_grad=True)
    (slope,) = torch.autograd.grad(mean_resultant(closed) * (mode * T).sum(), closed)
    assert_mean(k.grad, slope)
    assert_mean(M.grad, mean_resultant(torch.tensor(kappa)) * T)


def test_kl_by_integration_over_so3_and_monte_carlo(so3_grid, random_rotations, assert_mean) -> None:
    grid, weight = so3_grid
    modes = random_rotations(2)
    p, q = MatrixFisher(modes[0], torch.tensor(3.0)), MatrixFisher(modes[1], torch.tensor(1.2))
    log_p, log_q = p.log_prob(grid), q.log_prob(grid)
    torch.testing.assert_close(kl_divergence(p, q), (weight * log_p.exp() * (log_p - log_q)).sum(), rtol=1e-9, atol=1e-9)
    near = MatrixFisher(modes[0], torch.tensor(400.0))
    far = MatrixFisher(MatrixFisher(modes[0], torch.tensor(300.0)).sample(), torch.tensor(250.0))
    R = near.sample((20_000,))
    assert_mean(near.log_prob(R) - far.log_prob(R), kl_divergence(near, far))
    assert kl_divergence(near, near).item() == 0
    uniform = MatrixFisher(modes[0], torch.tensor(0.0))
    torch.testing.assert_close(kl_divergence(near, uniform), -near.entropy())


def test_gradients(random_rotations) -> None:
    R, mode = random_rotations(3), random_rotations(3, seed=1).requires_grad_()
    kappa = torch.tensor([0.5, 20.0, 800.0], requires_grad=True)
    check = torch.autograd.gradcheck
    make = lambda m, k: MatrixFisher(m, k, validate_args=False)  # noqa: E731
    assert check(lambda m, k: make(m, k).log_prob(R), (mode, kappa))
    assert check(lambda m, k: make(m, k).entropy(), (mode, kappa))
    assert check(lambda m, k: make(m, k).mean, (mode, kappa))
    assert check(lambda m, k: kl_divergence(make(m, k), MatrixFisher(R, 30.0)), (mode, kappa))
    assert check(lambda m: make(R, kappa).expected_log_prob(m), (0.7 * mode,))


def test_expected_log_prob_is_linear_in_the_mean(random_rotations) -> None:
    modes = random_rotations(50)
    observed, kappa = random_rotations(1, seed=5)[0], torch.tensor(30.0)
    each = MatrixFisher(modes, kappa).log_prob(observed)
    expected = MatrixFisher(observed, kappa).expected_log_prob(modes.mean(0))
    torch.testing.assert_close(expected, each.mean())


def test_concentration_is_the_inverse_variance_of_the_rotation_vector() -> None:
    for scale in (0.01, 0.05, 0.4):
        kappa = scale_to_concentration(torch.tensor(scale))
        torch.testing.assert_close(concentration_to_scale(kappa), torch.tensor(scale))
        square = angle_integral(kappa.item(), lambda w: w * w) / angle_integral(kappa.item())
        # Three axes of variance scale^2 each, up to curvature.
        assert abs(math.sqrt(square / 3) / scale - 1 - scale**2 / 3) < scale**4 + 1e-9


def test_haar_volume_turns_the_peak_into_that_of_a_gaussian() -> None:
    scale = 0.01
    p = MatrixFisher(torch.eye(3), scale_to_concentration(torch.tensor(scale)))
    peak = p.log_prob(torch.eye(3)) - LOG_HAAR_VOLUME
    assert abs(peak.item() + 1.5 * math.log(2 * math.pi * scale**2)) < 1e-3


def test_no_rotation_is_refused() -> None:
    with pytest.raises(ValueError, match="R_mode"):
        MatrixFisher(torch.diag(torch.tensor([1.0, 1.0, -1.0])), 1.0, validate_args=True)
    with pytest.raises(ValueError, match="concentration"):
        MatrixFisher(torch.eye(3), -1.0, validate_args=True)
    with pytest.raises(ValueError, match="support"):
        MatrixFisher(torch.eye(3), 1.0, validate_args=True).log_prob(2 * torch.eye(3))
