from __future__ import annotations

import math

import pytest
import torch
from torch.distributions import kl_divergence

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.rotation import symmetry_rotations
from nolbo_ppl.models.distributions import MatrixFisher, SymmetricMatrixFisher, ViewpointNormal
from nolbo_ppl.models.distributions.symmetry import group_angles

ORDERS = torch.tensor([1, 2, 3, 4, 0])


def test_group_angles_are_padded() -> None:
    angles, log_weight = group_angles(torch.tensor([1, 4, 0, 2]), torch.float64)
    assert angles.shape == (4, 4)
    torch.testing.assert_close(log_weight.exp().sum(-1), torch.ones(4))
    torch.testing.assert_close(angles[1], torch.arange(4) * (math.pi / 2))
    assert torch.isinf(log_weight[3]).tolist() == [False, False, True, True]


def test_normalised_with_its_mean_over_so3(so3_grid, random_rotations) -> None:
    R, weight = so3_grid
    mode = random_rotations(1)[0]
    p = SymmetricMatrixFisher(mode, torch.tensor(3.0), ORDERS)
    density = weight[:, None] * p.log_prob(R[:, None]).exp()
    torch.testing.assert_close(density.sum(0), torch.ones(5), rtol=0, atol=1e-9)
    torch.testing.assert_close(torch.einsum("no,nij->oij", density, R), p.mean, rtol=0, atol=1e-9)


def test_log_prob_is_the_mixture_over_the_group(random_rotations) -> None:
    mode, R = random_rotations(6), random_rotations(6, seed=2)
    for kappa in (0.7, 50.0):
        for order in (1, 2, 5):
            parts = [MatrixFisher(mode, kappa).log_prob(R @ g) for g in symmetry_rotations(order)]
            expected = torch.logsumexp(torch.stack(parts), 0) - math.log(order)
            torch.testing.assert_close(SymmetricMatrixFisher(mode, kappa, order).log_prob(R), expected)


@pytest.mark.parametrize("kappa", [0.0, 0.7, 50.0, 3000.0])
def test_free_axis_is_the_limit_of_many_elements(kappa, random_rotations) -> None:
    mode = random_rotations(20)
    near = MatrixFisher(mode, max(kappa, 1.0)).sample() @ symmetry_rotations(7)[3]
    for R in (random_rotations(20, seed=2), near):
        many = SymmetricMatrixFisher(mode, kappa, 2000).log_prob(R)
        torch.testing.assert_close(SymmetricMatrixFisher(mode, kappa, 0).log_prob(R), many, rtol=1e-9, atol=1e-9)
        bound_many = SymmetricMatrixFisher(R, kappa, 2000).expected_log_prob(0.8 * mode)
        bound_free = SymmetricMatrixFisher(R, kappa, 0).expected_log_prob(0.8 * mode)
        torch.testing.assert_close(bound_free, bound_many, rtol=1e-9, atol=1e-9)


def test_a_turn_of_the_object_changes_nothing(random_rotations) -> None:
    mode, R = random_rotations(5), random_rotations(5, seed=4)
    p = SymmetricMatrixFisher(mode, 20.0, ORDERS)
    turn = torch.stack([symmetry_rotations(n)[-1] if n else symmetry_rotations(11)[4] for n in ORDERS.tolist()])
    torch.testing.assert_close(p.log_prob(R @ turn), p.log_prob(R))
    torch.testing.assert_close(SymmetricMatrixFisher(mode @ turn, 20.0, ORDERS).log_prob(R), p.log_prob(R))
    # The same turn from the left is one of the camera, not of the object.
    assert not torch.allclose(p.log_prob(turn @ R)[1:], p.log_prob(R)[1:])
    # Rotation and mode change places.
    torch.testing.assert_close(SymmetricMatrixFisher(R, 20.0, ORDERS).log_prob(mode), p.log_prob(R))


def test_expected_log_prob_bounds_the_expectation_and_is_exact_without_symmetry(random_rotations, assert_mean) -> None:
    observed = random_rotations(5, seed=6)
    kappa = torch.tensor(15.0)
    for spread in (3.0, 100.0):
        q = MatrixFisher(random_rotations(5, seed=7), torch.tensor(spread))
        R = q.sample((10_000,))
        each = SymmetricMatrixFisher(R, kappa, ORDERS).log_prob(observed)
        bound = SymmetricMatrixFisher(observed, kappa, ORDERS).expected_log_prob(q.mean)
        assert_mean(each[:, 0], bound[0])
        assert bool((bound <= each.mean(0) + 5 * each.std(0) / 100).all())
        torch.testing.assert_close(bound[0], MatrixFisher(observed[0], kappa).expected_log_prob(q.mean[0]))


def test_expected_log_prob_is_tight_for_a_certain_orientation(random_rotations) -> None:
    observed, R = random_rotations(5), random_rotations(5, seed=1)
    bound = SymmetricMatrixFisher(observed, 30.0, ORDERS).expected_log_prob(R)
    torch.testing.assert_close(bound, SymmetricMatrixFisher(R, 30.0, ORDERS).log_prob(observed))


def test_expected_log_prob_is_differentiable_where_nothing_is_known_about_the_azimuth() -> None:
    mean = ViewpointNormal(torch.zeros(1, 3), torch.tensor(0.1), order=torch.tensor([0])).mean_rotation().requires_grad_()
    bound = SymmetricMatrixFisher(torch.eye(3), 10.0, ORDERS).expected_log_prob(mean)
    (grad,) = torch.autograd.grad(bound.sum(), mean)
    assert bool(torch.isfinite(bound).all()) and bool(torch.isfinite(grad).all())


def test_samples(random_rotations, assert_mean, so3_grid) -> None:
    mode = random_rotations(1)[0]
    p = SymmetricMatrixFisher(mode, torch.tensor(3.0), ORDERS)
    R = p.sample((20_000,))
    assert_mean(R, p.mean)
    grid, weight = so3_grid
    log_prob = p.log_prob(grid[:, None])
    entropy = -(weight[:, None] * log_prob.exp() * log_prob).sum(0)
    assert_mean(-p.log_prob(R), entropy)
    torch.testing.assert_close(p.entropy(), entropy, rtol=0, atol=1e-8)


@pytest.mark.parametrize("kappa", [0.0, 0.7, 15.0, 200.0, 5e4])
def test_entropy_by_quadrature(kappa, assert_mean) -> None:
    """That of the matrix Fisher without a symmetry, samples with one; log n less where the modes are apart."""
    p = SymmetricMatrixFisher(torch.eye(3), torch.tensor(kappa), ORDERS)
    entropy = p.entropy()
    torch.testing.assert_close(entropy[0], MatrixFisher(torch.eye(3), kappa).entropy(), rtol=0, atol=1e-8)
    assert_mean(-p.log_prob(p.sample((4000,))), entropy, extra=1e-9)
    if kappa >= 200:
        torch.testing.assert_close(entropy[1:4] - entropy[0], torch.tensor([2.0, 3.0, 4.0]).log(), rtol=0, atol=1e-6)


def test_divergences_without_a_form_say_so() -> None:
    one, many = MatrixFisher(torch.eye(3), 3.0), SymmetricMatrixFisher(torch.eye(3), 3.0, 2)
    for p, q in ((one, many), (many, one), (many, many)):
        with pytest.raises(NotImplementedError, match="expected_log_prob"):
            kl_divergence(p, q)


def test_gradients(random_rotations) -> None:
    R, mode = random_rotations(5), random_rotations(5, seed=1).requires_grad_()
    kappa = torch.tensor([0.5, 2.0, 20.0, 200.0, 40.0], requires_grad=True)
    make = lambda m, k: SymmetricMatrixFisher(m, k, ORDERS, validate_args=False)  # noqa: E731
    assert torch.autograd.gradcheck(lambda m, k: make(R, k).expected_log_prob(0.8 * m), (mode, kappa))
    # Along the rotations, where the free axis' closed form holds: a tangent step in place of free matrix entries.
    step = torch.zeros(5, 3, requires_grad=True)

    def turned(v: torch.Tensor, k: torch.Tensor) -> torch.Tensor:
        zero = torch.zeros_like(v[:, 0])
        cross = torch.stack((zero, -v[:, 2], v[:, 1], v[:, 2], zero, -v[:, 0], -v[:, 1], v[:, 0], zero), -1)
        return make(mode.detach() @ torch.matrix_exp(cross.view(5, 3, 3)), k).log_prob(R)

    assert torch.autograd.gradcheck(turned, (step, kappa))


def test_single_precision(random_rotations) -> None:
    mode = random_rotations(5)
    R = SymmetricMatrixFisher(mode, 200.0, ORDERS).sample((50,))
    double = SymmetricMatrixFisher(mode, 200.0, ORDERS).log_prob(R)
    single = SymmetricMatrixFisher(mode.float(), 200.0, ORDERS).log_prob(R.float())
    torch.testing.assert_close(single.double(), double, rtol=1e-4, atol=1e-3)


def test_orders_are_checked() -> None:
    with pytest.raises(InputError, match="order of symmetry"):
        SymmetricMatrixFisher(torch.eye(3), 1.0, torch.tensor(1.0))
    with pytest.raises(InputError, match=r"order of symmetry that is no integer: got torch\.bool"):
        SymmetricMatrixFisher(torch.eye(3), 1.0, torch.tensor(True))
    with pytest.raises(ValueError, match="order"):
        SymmetricMatrixFisher(torch.eye(3), 1.0, torch.tensor(-1), validate_args=True)
