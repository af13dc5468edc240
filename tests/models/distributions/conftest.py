"""What the tests of the distributions share: Monte Carlo comparisons and grids on the circle and on SO(3)."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(20)


@pytest.fixture(scope="session")
def assert_mean() -> Callable[..., None]:
    """Compare the mean over the first dimension with a value, within five standard errors."""

    def check(samples: Tensor, expected: Tensor, extra: float = 0.0) -> None:
        error = (samples.mean(0) - expected).abs()
        bound = 5 * samples.std(0) / math.sqrt(len(samples)) + extra
        assert bool((error <= bound).all()), f"off by {(error / bound).max() * 5:.1f} standard errors"

    return check


@pytest.fixture(scope="session")
def so3_grid() -> tuple[Tensor, Tensor]:
    """Rotations and weights (sum 1, Haar): z-y-z Euler angles, exact for polynomials of degree below 36 in R."""
    turns, tilts = 36, 24
    alpha = torch.arange(turns, dtype=torch.float64) * (2 * math.pi / turns)
    nodes, weights = (torch.as_tensor(x) for x in np.polynomial.legendre.leggauss(tilts))
    a, b, c = torch.meshgrid(alpha, torch.arccos(nodes), alpha, indexing="ij")
    w = weights[None, :, None].expand_as(a).flatten() / (2 * turns * turns)

    def about(axis: int, angle: Tensor) -> Tensor:
        vector = torch.zeros(3, dtype=torch.float64)
        vector[axis] = 1
        cross = torch.linalg.cross(vector.expand(3, 3), torch.eye(3, dtype=torch.float64), dim=-1).T
        return torch.matrix_exp(angle.flatten()[:, None, None] * cross)

    return about(2, a) @ about(1, b) @ about(2, c), w


@pytest.fixture(scope="session")
def random_rotations() -> Callable[[int], Tensor]:
    """Uniform rotations from QR decompositions, by a seed of their own."""

    def make(count: int, seed: int = 0) -> Tensor:
        generator = torch.Generator().manual_seed(seed)
        q, r = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))
        q = q * torch.diagonal(r, dim1=-2, dim2=-1).sign()[:, None, :]
        return q * torch.linalg.det(q)[:, None, None]

    return make


@pytest.fixture(scope="session")
def circle() -> Callable[[int], Tensor]:
    """Equidistant angles of [-pi, pi) for the periodic trapezoidal rule."""

    def make(nodes: int) -> Tensor:
        return torch.arange(nodes, dtype=torch.float64) * (2 * math.pi / nodes) - math.pi

    return make
