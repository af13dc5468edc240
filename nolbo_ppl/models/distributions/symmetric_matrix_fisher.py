"""Matrix Fisher distribution of a symmetric object: the mixture over the group about its vertical axis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints
from torch.distributions.kl import register_kl
from torch.types import _size

from nolbo_ppl.models.distributions.bessel import log_i0e
from nolbo_ppl.models.distributions.matrix_fisher import (
    MatrixFisher,
    log_normalizer_excess,
    mean_resultant,
    rotation_constraint,
)
from nolbo_ppl.models.distributions.symmetry import check_order, group_angles, rotation_about_vertical


class SymmetricMatrixFisher(TorchDistribution):
    """Equal mixture over the turns g of an object about its own vertical axis: `p(R) = mean_g MF(R g; R_mode, kappa)`.

    `R` and `R Rz(2 pi j / n)` look the same and have the same density. Density against the normalised Haar measure.

    Args:
        R_mode: one of the equivalent modes, a rotation.
        concentration: kappa >= 0 of each element.
        order: 1 no symmetry, n n-fold, 0 free about the axis (the mean over the whole circle, in closed form).

    Derived in docs/story.md (symmetry).
    """

    arg_constraints: ClassVar = {
        "R_mode": rotation_constraint,
        "concentration": constraints.nonnegative,
        "order": constraints.nonnegative_integer,
    }
    support = rotation_constraint
    has_rsample = True

    def __init__(
        self,
        R_mode: Float[Tensor, "*#batch 3 3"],
        concentration: Float[Tensor, "*#batch"] | float,
        order: Int[Tensor, "*#batch"] | int,
        validate_args: bool | None = None,
    ) -> None:
        concentration = torch.as_tensor(concentration, dtype=R_mode.dtype, device=R_mode.device)
        order = torch.as_tensor(order, device=R_mode.device)
        check_order(order)
        batch_shape = torch.broadcast_shapes(R_mode.shape[:-2], concentration.shape, order.shape)
        self.R_mode = R_mode.expand(*batch_shape, 3, 3)
        self.concentration = concentration.expand(batch_shape)
        self.order = order.expand(batch_shape)
        super().__init__(batch_shape, torch.Size((3, 3)), validate_args=validate_args)

    def expand(self, batch_shape: Sequence[int], _instance: object = None) -> SymmetricMatrixFisher:
        """The same distribution with a larger batch shape."""
        new = self._get_checked_instance(SymmetricMatrixFisher, _instance)
        batch_shape = torch.Size(batch_shape)
        new.R_mode = self.R_mode.expand(*batch_shape, 3, 3)
        new.concentration = self.concentration.expand(batch_shape)
        new.order = self.order.expand(batch_shape)
        super(SymmetricMatrixFisher, new).__init__(batch_shape, self.event_shape, validate_args=False)
        new._validate_args = self._validate_args
        return new

    def log_prob(self, value: Float[Tensor, "... 3 3"]) -> Float[Tensor, "*shape"]:
        """Log density in nats.

        Order n: logsumexp over the group. Order 0: with `M = R_mode' R`, `tr(M Rz(w)) = M_22 + b cos(w - w_0)`, whose
        exponential integrates to `I0(kappa b)`; for two rotations `b = 1 + M_22`, and `1 - M_22` is half the squared
        distance of the two vertical axes.
        """
        if self._validate_args:
            self._validate_sample(value)
        angles, log_weight = group_angles(self.order, self.R_mode.dtype)
        turned = value[..., None, :, :] @ rotation_about_vertical(angles)
        misfit = 0.5 * (turned - self.R_mode[..., None, :, :]).square().sum((-2, -1))
        finite = torch.logsumexp(log_weight - self.concentration[..., None] * misfit, -1)
        between_axes = (value[..., :, 2] - self.R_mode[..., :, 2]).square().sum(-1)
        around = (2 - 0.5 * between_axes).clamp_min(0)
        free = log_i0e(self.concentration * around) - self.concentration * between_axes
        return torch.where(self.order == 0, free, finite) - log_normalizer_excess(self.concentration)

    def expected_log_prob(self, mean_rotation: Float[Tensor, "... 3 3"]) -> Float[Tensor, "*shape"]:
        """Lower bound of `E_q[log p(R_mode | R_z)]`, R_mode observed, R_z random with mean `mean_rotation`. Nats.

        The density is symmetric in the rotation and its mode. Order 1: exact, the log density is linear in R_z. Order
        n: `logsumexp_g E[kappa tr(R_z' R g)] - log n - log c`; log-sum-exp is convex, so by Jensen it is no more than
        the expectation (the responsibilities of the group elements are fixed instead of following R_z), and the
        evidence bound stays one. Order 0 likewise: `log I0(kappa b) + kappa M_22` of the mean M is convex in M.
        """
        M = mean_rotation.mT @ self.R_mode
        along, cosine, sine = M[..., 2, 2], M[..., 0, 0] + M[..., 1, 1], M[..., 0, 1] - M[..., 1, 0]
        kappa = self.concentration
        angles, log_weight = group_angles(self.order, self.R_mode.dtype)
        trace = along[..., None] + cosine[..., None] * torch.cos(angles) + sine[..., None] * torch.sin(angles)
        finite = torch.logsumexp(log_weight + kappa[..., None] * (trace - 3), -1)
        around = torch.linalg.vector_norm(torch.stack((cosine, sine), -1), dim=-1)
        free = log_i0e(kappa * around) + kappa * (along + around - 3)
        return torch.where(self.order == 0, free, finite) - log_normalizer_excess(kappa)

    def rsample(self, sample_shape: _size = ()) -> Float[Tensor, "... 3 3"]:
        """Exact sample, reparameterised through mode and concentration; the turn is uniform over the group."""
        one = MatrixFisher(self.R_mode, self.concentration, validate_args=False).rsample(sample_shape)
        turn = torch.rand(one.shape[:-2], dtype=one.dtype, device=one.device)
        count = self.order.clamp_min(1)
        turn = torch.where(self.order == 0, turn, torch.floor(turn * count) / count)
        return one @ rotation_about_vertical(2 * math.pi * turn)

    @property
    def mean(self) -> Float[Tensor, "*batch 3 3"]:
        """E[R]: `rho R_mode`, of which a symmetry leaves the column of the vertical axis alone."""
        mean = mean_resultant(self.concentration)[..., None, None] * self.R_mode
        vertical = torch.tensor([0.0, 0.0, 1.0], dtype=mean.dtype, device=mean.device)
        return torch.where((self.order == 1)[..., None, None], mean, mean * vertical)

    @property
    def mode(self) -> Float[Tensor, "*batch 3 3"]:
        """One of the equivalent rotations of the highest density."""
        return self.R_mode

    def entropy(self, nodes: int = 64) -> Float[Tensor, "*batch"]:
        """Entropy in nats relative to the uniform distribution, by quadrature (1e-8 in double precision).

        In z-y-z Euler angles about the mode the density depends on the cosine c between the vertical axes and on one turn
        w about them, `tr(M Rz(a)) = c + (1 + c) cos(w + a)`, of which the Haar measure is uniform: `dc / 2 dw / (2 pi)`.
        Gauss-Legendre in c, where the density is; the trapezoidal rule in w over one period of the group.
        """
        kappa = self.concentration[..., None, None].double()
        x, weight = (torch.as_tensor(v, device=kappa.device)[:, None] for v in np.polynomial.legendre.leggauss(nodes))
        depth = (20 / kappa.clamp_min(10.0)).clamp_max(2.0)  # 1 - c: the marginal falls as exp(-2 kappa (1 - c))
        versine = depth * (1 - x) / 2
        count = self.order.clamp_min(1)[..., None, None].double()
        # the modes' width about the axis, where the plane of the turns is not all covered
        half = torch.minimum(math.pi / count, 9.5 * torch.rsqrt(kappa.clamp_min(1e-3) * (2 - depth).clamp_min(0.1)))
        w = half * (torch.arange(2 * nodes, dtype=torch.float64, device=kappa.device) / nodes - 1)
        angles, log_weight = (v[..., None, None, :] for v in group_angles(self.order, torch.float64))
        turn = torch.sin((w[..., None] + angles) / 2)
        misfit = 2 * versine[..., None] + 2 * (2 - versine[..., None]) * turn * turn
        finite = torch.logsumexp(log_weight - kappa[..., None] * misfit, -1)
        free = log_i0e(kappa * (2 - versine)) - 2 * kappa * versine
        alone = (self.order == 0)[..., None, None]
        log_density = torch.where(alone, free, finite) - log_normalizer_excess(kappa)
        share = torch.where(alone, 1 / (2 * nodes), half * count / math.pi / (2 * nodes))
        mass = log_density.exp() * (depth / 4) * weight * share
        return -(mass * log_density).sum((-2, -1)).to(self.concentration.dtype)


def _no_kl(p: MatrixFisher | SymmetricMatrixFisher, q: MatrixFisher | SymmetricMatrixFisher) -> Tensor:
    """Where a symmetry is in play the divergence has neither a closed form nor a cheap quadrature: said, not guessed."""
    raise NotImplementedError(
        f"KL({type(p).__name__} || {type(q).__name__}) has no closed form under a symmetry: "
        "use SymmetricMatrixFisher.expected_log_prob, a lower bound of E_p[log q], and the entropy of p"
    )


for _p, _q in (
    (MatrixFisher, SymmetricMatrixFisher),
    (SymmetricMatrixFisher, MatrixFisher),
    (SymmetricMatrixFisher, SymmetricMatrixFisher),
):
    register_kl(_p, _q)(_no_kl)
