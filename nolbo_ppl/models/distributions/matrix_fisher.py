"""Isotropic matrix Fisher distribution on SO(3), with its normaliser, moments, entropy, KL and an exact sampler.

Densities are with respect to the normalised Haar measure (the uniform distribution has density one). Against the
invariant volume in which a small rotation vector counts as d^3 v, add `-LOG_HAAR_VOLUME` to a log density.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints
from torch.distributions.kl import register_kl
from torch.types import _size

from nolbo_ppl.models.distributions.bessel import bessel_gap, bessel_ratio_over_x, gap_excess, log_i0e

LOG_HAAR_VOLUME = math.log(8 * math.pi**2)
"""Log of the volume of SO(3) measured in rotation vectors at the identity, rad^3."""


class _Rotation(constraints.Constraint):
    """Rotation matrices, orthogonal to 1e-3 (labels are float32 or rounded decimals)."""

    event_dim = 2

    def check(self, value: Tensor) -> Tensor:
        """Whether each matrix is orthogonal with a positive determinant."""
        identity = torch.eye(3, dtype=value.dtype, device=value.device)
        orthogonal = ((value.mT @ value - identity).abs() < 1e-3).all(-1).all(-1)
        handed = (torch.linalg.cross(value[..., 0], value[..., 1], dim=-1) * value[..., 2]).sum(-1) > 0
        return orthogonal & handed


rotation_constraint = _Rotation()


def log_normalizer_excess(concentration: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """`log c(kappa) - 3 kappa`, so that `log p(R) = -kappa |R - R_mode|_F^2 / 2 - excess`, for any kappa >= 0.

    `c(kappa) = (1 / pi) int_0^pi exp(kappa (1 + 2 cos w)) (1 - cos w) dw = exp(kappa) (I0(2 kappa) - I1(2 kappa))`,
    since the angle of a uniform rotation has density (1 - cos w) / pi. Mardia & Jupp, section 13.2.3.
    """
    return log_i0e(2 * concentration) + torch.log(bessel_gap(2 * concentration))


def log_normalizer(concentration: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """`log c(kappa)` of `p(R) = exp(kappa tr(R_mode' R)) / c(kappa)`."""
    return 3 * concentration + log_normalizer_excess(concentration)


def mean_misfit(concentration: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """`E[3 - tr(R_mode' R)]`, between 3 (kappa = 0) and `3 / (2 kappa)`; minus the derivative of the excess."""
    x = 2 * concentration
    double = x.double()
    wide = (4 - 2 * bessel_ratio_over_x(double) / bessel_gap(double)).to(x.dtype)
    away = x.clamp_min(1.0)
    excess = gap_excess(away)
    narrow = 2 * (1 + 2 * away * excess / (1 + excess)) / away
    return torch.where(x > 30, narrow, wide)


def mean_resultant(concentration: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """`rho` of `E[R] = rho R_mode`: a third of `(log c)'(kappa) = A / (kappa (1 - A)) - 1`, A = I1 / I0 (2 kappa)."""
    return 1 - mean_misfit(concentration) / 3


def scale_to_concentration(scale: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Concentration whose rotation vectors have standard deviation `scale` rad per axis, `1 / (2 scale^2)`.

    `tr(R) = 1 + 2 cos w = 3 - w^2 + O(w^4)`: exact as the scale goes to zero, wider by the share scale^2 / 3 before.
    """
    return 0.5 / (scale * scale)


def concentration_to_scale(concentration: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Standard deviation in rad per axis of the rotation vector, `1 / sqrt(2 kappa)` (see `scale_to_concentration`)."""
    return torch.rsqrt(2 * concentration)


class MatrixFisher(TorchDistribution):
    """`p(R) = exp(kappa tr(R_mode' R)) / c(kappa)` on SO(3), density against the normalised Haar measure.

    Args:
        R_mode: the mode, a rotation.
        concentration: kappa >= 0; 0 is uniform, `1 / (2 scale^2)` a standard deviation of `scale` rad per axis.

    NOLBO's p(R^f | R^z), there without its normaliser (eq. shapeDecoder; docs/story.md, corrections). Mardia & Jupp, section
    13.2.3.
    """

    arg_constraints: ClassVar = {"R_mode": rotation_constraint, "concentration": constraints.nonnegative}
    support = rotation_constraint
    has_rsample = True

    def __init__(
        self,
        R_mode: Float[Tensor, "*#batch 3 3"],
        concentration: Float[Tensor, "*#batch"] | float,
        validate_args: bool | None = None,
    ) -> None:
        concentration = torch.as_tensor(concentration, dtype=R_mode.dtype, device=R_mode.device)
        batch_shape = torch.broadcast_shapes(R_mode.shape[:-2], concentration.shape)
        self.R_mode = R_mode.expand(*batch_shape, 3, 3)
        self.concentration = concentration.expand(batch_shape)
        super().__init__(batch_shape, torch.Size((3, 3)), validate_args=validate_args)

    def expand(self, batch_shape: Sequence[int], _instance: object = None) -> MatrixFisher:
        """The same distribution with a larger batch shape."""
        new = self._get_checked_instance(MatrixFisher, _instance)
        batch_shape = torch.Size(batch_shape)
        new.R_mode = self.R_mode.expand(*batch_shape, 3, 3)
        new.concentration = self.concentration.expand(batch_shape)
        super(MatrixFisher, new).__init__(batch_shape, self.event_shape, validate_args=False)
        new._validate_args = self._validate_args
        return new

    def log_prob(self, value: Float[Tensor, "... 3 3"]) -> Float[Tensor, "*shape"]:
        """Log density in nats; the trace by the Frobenius distance, which cancels nothing near the mode."""
        if self._validate_args:
            self._validate_sample(value)
        misfit = 0.5 * (value - self.R_mode).square().sum((-2, -1))
        return -self.concentration * misfit - log_normalizer_excess(self.concentration)

    def expected_log_prob(self, mean_rotation: Float[Tensor, "... 3 3"]) -> Float[Tensor, "*shape"]:
        """`E_q[log p(R_mode | R_z)]` for an observed rotation R_mode and a random mode R_z with mean `mean_rotation`.

        The density is symmetric in the rotation and its mode and its log linear in the mode, so the mean is all the
        expectation needs: `kappa (tr(E[R_z]' R_mode) - 3) - excess`, exact. Nats.
        """
        misfit = 3 - (mean_rotation * self.R_mode).sum((-2, -1))
        return -self.concentration * misfit - log_normalizer_excess(self.concentration)

    def rsample(self, sample_shape: _size = ()) -> Float[Tensor, "... 3 3"]:
        """Exact sample, reparameterised through the mode and, by implicit differentiation, the concentration."""
        shape = self._extended_shape(sample_shape)[:-2]
        concentration = self.concentration.expand(shape)
        angle, axis = _sample_angle_axis(concentration.detach())
        if concentration.requires_grad:
            sensitivity = _angle_sensitivity(angle, concentration.detach().double())
            angle = angle + (concentration - concentration.detach()).double() * sensitivity
        turn = _rodrigues(angle, axis).to(self.R_mode.dtype)
        return self.R_mode @ turn

    @property
    def mean(self) -> Float[Tensor, "*batch 3 3"]:
        """E[R] = rho(kappa) R_mode, no rotation itself."""
        return mean_resultant(self.concentration)[..., None, None] * self.R_mode

    @property
    def mode(self) -> Float[Tensor, "*batch 3 3"]:
        """The rotation of the highest density."""
        return self.R_mode

    def entropy(self) -> Float[Tensor, "*batch"]:
        """Entropy in nats relative to the uniform distribution (at most zero)."""
        return self.concentration * mean_misfit(self.concentration) + log_normalizer_excess(self.concentration)


def _sample_angle_axis(concentration: Tensor) -> tuple[Tensor, Tensor]:
    """Angle in [0, pi] and uniform axis of a rotation about the mode, in float64.

    The quaternion has the Bingham density `exp(-4 kappa |vector part|^2)` on the 3-sphere; rejection from the angular
    central Gaussian envelope of Kent, Ganeiber & Mardia (2018), with its optimal b; at least 45 % are accepted.
    """
    shape = concentration.shape
    rate = 4 * concentration.double().reshape(-1)
    linear = 2 * rate - 4
    root = torch.sqrt(linear * linear + 8 * rate)
    # The positive root of b^2 + (2 rate - 4) b - 2 rate = 0, i.e. of 1 / b + 3 / (b + 2 rate) = 1.
    b = torch.where(linear > 0, 4 * rate / (linear + root), (root - linear) / 2)
    log_bound = 0.5 * (4 - b) - 2 * torch.log(4 / b)
    quaternion = rate.new_empty(rate.numel(), 4)
    open_ = torch.arange(rate.numel(), device=rate.device)
    while open_.numel():
        r = rate[open_]
        inverse_spread = 1 + 2 * r / b[open_]
        proposal = torch.randn(open_.numel(), 4, dtype=torch.float64, device=rate.device)
        proposal[:, 1:] /= torch.sqrt(inverse_spread)[:, None]
        proposal /= torch.linalg.vector_norm(proposal, dim=-1, keepdim=True)
        vector = proposal[:, 1:].square().sum(-1)
        form = proposal[:, 0] ** 2 + inverse_spread * vector
        log_accept = -r * vector + 2 * torch.log(form) + log_bound[open_]
        accepted = torch.log(torch.rand_like(r)) < log_accept
        quaternion[open_[accepted]] = proposal[accepted]
        open_ = open_[~accepted]
    vector = quaternion[:, 1:]
    length = torch.linalg.vector_norm(vector, dim=-1)
    angle = 2 * torch.atan2(length, quaternion[:, 0].abs())
    axis = vector / length[:, None].clamp_min(1e-300)
    return angle.reshape(shape), axis.reshape(*shape, 3)


def _angle_sensitivity(angle: Tensor, concentration: Tensor) -> Tensor:
    """`d angle / d kappa` at a fixed quantile: `-(dF / d kappa) / f` by Gauss-Legendre on [0, angle].

    With f(w) proportional to exp(2 kappa cos w) (1 - cos w): `dF / d kappa = int_0^w f(t) (2 cos t - E[2 cos]) dt`.
    """
    nodes, weights = (torch.as_tensor(x, device=angle.device) for x in np.polynomial.legendre.leggauss(40))
    t = angle[..., None] * (nodes + 1) / 2
    # 2 (cos t - cos w) and 1 - cos by half angles, so that nothing cancels for concentrated distributions.
    versine_t, versine_w = 2 * torch.sin(t / 2) ** 2, 2 * torch.sin(angle / 2) ** 2
    ratio = torch.exp(-2 * concentration[..., None] * (versine_t - versine_w[..., None]))
    ratio = ratio * versine_t / versine_w[..., None].clamp_min(1e-300)
    deviation = mean_misfit(concentration)[..., None] - 2 * versine_t
    return -(ratio * deviation * weights).sum(-1) * angle / 2


def _rodrigues(angle: Tensor, axis: Tensor) -> Tensor:
    """Rotation by an angle about a unit axis."""
    x, y, z = axis.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).unflatten(-1, (3, 3))
    sine, versine = torch.sin(angle), 2 * torch.sin(angle / 2) ** 2
    identity = torch.eye(3, dtype=angle.dtype, device=angle.device)
    return identity + sine[..., None, None] * cross + versine[..., None, None] * (cross @ cross)


@register_kl(MatrixFisher, MatrixFisher)
def _kl_fisher_fisher(p: MatrixFisher, q: MatrixFisher) -> Tensor:
    """Closed form: E_p of both log densities needs E_p[R] only."""
    misfit = mean_misfit(p.concentration)
    between = 0.5 * (p.R_mode - q.R_mode).square().sum((-2, -1)) * (1 - misfit / 3)
    change = log_normalizer_excess(q.concentration) - log_normalizer_excess(p.concentration)
    return change + (q.concentration - p.concentration) * misfit + q.concentration * between
