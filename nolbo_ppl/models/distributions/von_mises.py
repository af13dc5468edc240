"""Mixture of von Mises distributions in natural parameters: the guide's posterior of an azimuth with several modes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import Categorical, VonMises, constraints
from torch.types import _size

from nolbo_ppl.geometry.rotation import wrap_angle
from nolbo_ppl.models.distributions.bessel import bessel_ratio_over_x, log_i0e
from nolbo_ppl.models.distributions.circular import circular
from nolbo_ppl.models.distributions.symmetry import group_angles

MAX_CONCENTRATION = 300.0
"""The guide's limit of a component's concentration: a standard deviation of 3.3 degrees."""


class _LimitNorm(torch.autograd.Function):
    """Scale vectors longer than the limit back to it, with the projected gradient of a minimised loss, for training alone.

    The exact gradient of the clamp has no radial part beyond the limit, so a component that once passed it could never
    soften again; the identity's would let it drift away. Here the radial part passes when descent shortens the vector.
    It is no function's gradient: a sampler that follows gradients (HMC, NUTS) needs a mixture without a limit.
    """

    @staticmethod
    def forward(ctx, vector: Tensor, limit: float) -> Tensor:
        norm = torch.linalg.vector_norm(vector, dim=-1, keepdim=True)
        ctx.save_for_backward(vector, norm)
        ctx.limit = limit
        return torch.where(norm > limit, vector * (limit / norm.clamp_min(limit)), vector)

    @staticmethod
    def backward(ctx, *grad_outputs: Tensor) -> tuple[Tensor, None]:
        (grad,) = grad_outputs
        vector, norm = ctx.saved_tensors
        unit = vector / norm.clamp_min(ctx.limit)
        radial = (grad * unit).sum(-1, keepdim=True)
        limited = (ctx.limit / norm.clamp_min(ctx.limit)) * (grad - radial * unit) + radial.clamp_min(0) * unit
        return torch.where(norm > ctx.limit, limited, grad), None


def default_nodes(max_concentration: float, dtype: torch.dtype) -> int:
    """Nodes of the periodic trapezoidal rule that integrate a mixture's entropy to 1e-10 nats (1e-6 below float64).

    `log q` of two components has branch points next to the real axis where they cross, at a distance of about
    `pi / sqrt(8 kappa x)` where the density is `exp(-x)`; the error `exp(-x - nodes pi / sqrt(8 kappa x))` at its
    worst x gives the count. Tested against a tenfold finer rule.
    """
    accuracy = 24.0 if dtype == torch.float64 else 14.0
    per_root = 2 * (accuracy / 3) ** 1.5 * math.sqrt(8) / math.pi
    return 8 * math.ceil(max(8.0, per_root * math.sqrt(max_concentration) / 8))


class VonMisesMixture(TorchDistribution):
    """Mixture of K von Mises distributions on [-pi, pi).

    Args:
        logits: unnormalised log weights of the components.
        natural: natural parameters `kappa (cos mu, sin mu)` of each; no angle has to be regressed, and a component
            passes through uniform (zero) when it changes sides.
        max_concentration: None takes every kappa as it is, with exact gradients. A number limits larger ones to it, which
            keeps a network's densities from collapsing; beyond it the gradient in `natural` is the projected one of a
            descent, not the function's (see `_LimitNorm`).

    `q(v) = sum_k w_k exp(natural_k . (cos v, sin v)) / (2 pi I0(kappa_k))`. Mardia & Jupp, sections 3.5.4 and 5.5.
    """

    arg_constraints: ClassVar = {
        "logits": constraints.independent(constraints.real, 1),
        "natural": constraints.independent(constraints.real, 2),
    }
    support = circular
    has_rsample = False

    def __init__(
        self,
        logits: Float[Tensor, "*#batch K"],
        natural: Float[Tensor, "*#batch K 2"],
        max_concentration: float | None = None,
        validate_args: bool | None = None,
    ) -> None:
        shape = torch.broadcast_shapes(logits.shape, natural.shape[:-1])
        self.logits = logits.expand(shape)
        self.natural = natural.expand(*shape, 2)
        self.max_concentration = None if max_concentration is None else float(max_concentration)
        self._derive()
        super().__init__(shape[:-1], validate_args=validate_args)

    def _derive(self) -> None:
        """Log weights, means as unit vectors, concentrations and log coefficients of the components."""
        limited = self.natural if self.max_concentration is None else _LimitNorm.apply(self.natural, self.max_concentration)
        # The floor keeps the direction of a uniform component, 0 / 0, and its gradient finite.
        floor = 1e-30 if limited.dtype == torch.float64 else 1e-20
        self.concentration = torch.sqrt((limited * limited).sum(-1) + floor)
        self._unit = limited / self.concentration[..., None]
        self._limited = limited
        self.log_weights = torch.log_softmax(self.logits, -1)
        self._log_peak = self.log_weights - math.log(2 * math.pi) - log_i0e(self.concentration)

    @classmethod
    def from_mean_concentration(
        cls,
        logits: Float[Tensor, "*#batch K"],
        mean: Float[Tensor, "*#batch K"],
        concentration: Float[Tensor, "*#batch K"],
        max_concentration: float | None = None,
    ) -> VonMisesMixture:
        """The mixture with components of the given mean directions (rad) and concentrations."""
        natural = concentration[..., None] * torch.stack((torch.cos(mean), torch.sin(mean)), -1)
        return cls(logits, natural, max_concentration)

    def expand(self, batch_shape: Sequence[int], _instance: object = None) -> VonMisesMixture:
        """The same distribution with a larger batch shape."""
        new = self._get_checked_instance(VonMisesMixture, _instance)
        batch_shape = torch.Size(batch_shape)
        for name in ("logits", "concentration", "log_weights", "_log_peak"):
            setattr(new, name, getattr(self, name).expand(*batch_shape, -1))
        for name in ("natural", "_unit", "_limited"):
            setattr(new, name, getattr(self, name).expand(*batch_shape, -1, -1))
        new.max_concentration = self.max_concentration
        super(VonMisesMixture, new).__init__(batch_shape, validate_args=False)
        new._validate_args = self._validate_args
        return new

    @property
    def largest_concentration(self) -> float:
        """The limit of kappa, or the largest there is: what quadrature has to resolve."""
        if self.max_concentration is not None:
            return self.max_concentration
        return float(self.concentration.detach().max()) if self.concentration.numel() else 0.0

    @property
    def weights(self) -> Float[Tensor, "*batch K"]:
        """Weights of the components."""
        return self.log_weights.exp()

    @property
    def component_mean(self) -> Float[Tensor, "*batch K"]:
        """Mean directions of the components in rad."""
        return torch.atan2(self._unit[..., 1], self._unit[..., 0])

    def log_prob(self, value: Float[Tensor, "*value"]) -> Float[Tensor, "*shape"]:
        """Log density in nats per rad."""
        if self._validate_args:
            self._validate_sample(value)
        return self.log_density(value)

    def log_density(self, value: Float[Tensor, "*value"]) -> Float[Tensor, "*shape"]:
        """`log_prob` of any real angle, periodic and not validated."""
        return _log_density(value, self._log_peak, self.concentration, self._unit)

    def folded(self, order: Int[Tensor, "*#batch"]) -> tuple[Tensor, Tensor, Tensor]:
        """Coefficients of `sum_g q(v + g)` over the symmetry group: the mixture of all turned components.

        Each of shape (..., K * elements): log peaks (-inf beyond an entry's own order), concentrations, unit vectors.
        """
        angles, log_weight = group_angles(order, self.natural.dtype)
        present = torch.where(torch.isinf(log_weight), log_weight, torch.zeros_like(log_weight))
        cosine, sine = torch.cos(angles)[..., None], torch.sin(angles)[..., None]
        x, y = self._unit[..., None, :, 0], self._unit[..., None, :, 1]
        unit = torch.stack((cosine * x + sine * y, cosine * y - sine * x), -1)
        log_peak = self._log_peak[..., None, :] + present[..., None]
        concentration = self.concentration[..., None, :].expand(log_peak.shape)
        return log_peak.flatten(-2), concentration.flatten(-2), unit.expand(*log_peak.shape, 2).flatten(-3, -2)

    def log_prob_symmetric(self, value: Float[Tensor, "*value"], order: Int[Tensor, "*#batch"] | int) -> Float[Tensor, "*shape"]:
        """Log density of the azimuth of an object with a symmetry: `log sum_j q(v + 2 pi j / order)`.

        This is the density on the quotient of the circle by the group, an arc of 2 pi / order. Order 0, free about the
        axis: the quotient is a point, its log density zero.
        """
        order = torch.as_tensor(order, device=self.natural.device)
        log_density = _log_density(value, *self.folded(order))
        return torch.where(order == 0, torch.zeros_like(log_density), log_density)

    def sample(self, sample_shape: _size = ()) -> Float[Tensor, "*shape"]:
        """Exact sample: a component, then Best & Fisher's rejection sampler."""
        with torch.no_grad():
            component = Categorical(logits=self.log_weights, validate_args=False).sample(torch.Size(sample_shape))
            index = component[..., None]
            shape = component.shape + self.log_weights.shape[-1:]
            mean = self.component_mean.expand(shape).gather(-1, index).squeeze(-1)
            # Below 1e-6 the sampler divides by a vanishing concentration; the density is uniform to 1e-6 there.
            concentration = self.concentration.expand(shape).gather(-1, index).squeeze(-1).clamp_min(1e-6)
            return wrap_angle(VonMises(mean, concentration, validate_args=False).sample())

    def component_directions(self) -> Float[Tensor, "*batch K 2"]:
        """`E[(cos v, sin v)] = A(kappa_k) (cos mu_k, sin mu_k)` of each component, with `A = I1 / I0`."""
        return bessel_ratio_over_x(self.concentration)[..., None] * self._limited

    def mean_direction(self) -> Float[Tensor, "*batch 2"]:
        """`E[(cos v, sin v)]`: the components' mean under their weights."""
        return (self.weights[..., None] * self.component_directions()).sum(-2)

    @property
    def mean(self) -> Float[Tensor, "*batch"]:
        """The mean direction in rad."""
        x, y = self.mean_direction().unbind(-1)
        return torch.atan2(y, x)

    @property
    def variance(self) -> Float[Tensor, "*batch"]:
        """The circular variance `1 - |E[exp(i v)]|`, between 0 and 1."""
        return 1 - torch.linalg.vector_norm(self.mean_direction(), dim=-1)

    @property
    def circular_std(self) -> Float[Tensor, "*batch"]:
        """Circular standard deviation `sqrt(-2 log |E[exp(i v)]|)` in rad (Mardia & Jupp eq. 2.3.14).

        In float64 inside, for the resultant of a narrow density is close to one.
        """
        limited = self._limited.double()
        concentration = torch.linalg.vector_norm(limited, dim=-1)
        moment = ((self.weights.double() * bessel_ratio_over_x(concentration))[..., None] * limited).sum(-2)
        # The floor, 8.6 rad, stands for the infinite deviation of a uniform density.
        length = torch.linalg.vector_norm(moment, dim=-1).clamp(1e-16, 1.0)
        return torch.sqrt(-2 * torch.log(length)).to(self.natural.dtype)

    @property
    def mode(self) -> Float[Tensor, "*batch"]:
        """The angle in rad of the highest density (`find_mode` with its default grid)."""
        return self.find_mode()

    def find_mode(self, grid: int = 360, steps: int = 8) -> Float[Tensor, "*batch"]:
        """The angle in rad of the highest density: best of a grid and of the component means, refined by Newton steps.

        Not differentiated. A step is limited to the grid's spacing and undone where it lowers the density.
        """
        with torch.no_grad():
            nodes = _circle(grid, self.natural).reshape((-1,) + (1,) * len(self.batch_shape))
            mean = self.component_mean
            means = mean.permute(mean.dim() - 1, *range(mean.dim() - 1))  # exported graphs know no negative dimensions
            candidates = torch.cat((nodes.expand(-1, *self.batch_shape), means))
            density = self.log_density(candidates)
            best, index = density.max(0)
            value = candidates.gather(0, index[None])[0]
            spacing = 2 * math.pi / grid
            for _ in range(steps):
                slope, curvature = self._derivatives(value)
                step = torch.where(curvature < 0, -slope / curvature.clamp_max(-1e-12), spacing * slope.sign())
                proposed = value + step.clamp(-spacing, spacing)
                reached = self.log_density(proposed)
                value, best = torch.where(reached > best, proposed, value), torch.maximum(reached, best)
            return wrap_angle(value)

    def _derivatives(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """First and second derivative of the log density in the angle."""
        cosine, sine = torch.cos(value)[..., None], torch.sin(value)[..., None]
        x, y = self._limited[..., 0], self._limited[..., 1]
        along, across = x * cosine + y * sine, y * cosine - x * sine
        responsibility = torch.softmax(self._log_peak + along - self.concentration, -1)
        slope = (responsibility * across).sum(-1)
        return slope, (responsibility * (across * across - along)).sum(-1) - slope * slope

    def entropy(self, nodes: int | None = None) -> Float[Tensor, "*batch"]:
        """Differential entropy in nats by the periodic trapezoidal rule (node count: `default_nodes`)."""
        nodes = nodes or default_nodes(self.largest_concentration, self.natural.dtype)
        log_density = self.log_density(_circle(nodes, self.natural).reshape((-1,) + (1,) * len(self.batch_shape)))
        return -(log_density.exp() * log_density).sum(0) * (2 * math.pi / nodes)

    def hpd_mass(
        self, value: Float[Tensor, "*value"], order: Int[Tensor, "*#batch"] | int = 1, nodes: int | None = None
    ) -> Float[Tensor, "*shape"]:
        """Probability of all angles with a density above that at `value`, folded by the symmetry group.

        `value` is inside the highest-density region of probability c exactly where this is at most c, so over truths
        drawn from the density it is uniform: the test of calibration. Order 0 gives zero. Not differentiated; the
        level set is cut linearly between `64 sqrt(largest concentration)` nodes: wrong by at most 2e-3 at the very top of a
        narrow mode, by 2e-4 elsewhere.
        """
        nodes = nodes or 64 * math.ceil(math.sqrt(max(self.largest_concentration, 1.0)))
        with torch.no_grad():
            order = torch.as_tensor(order, device=self.natural.device)
            coefficients = self.folded(order)
            level = _log_density(value, *coefficients)
            grid = _circle(nodes, self.natural).reshape((-1,) + (1,) * level.dim())
            log_density = _log_density(grid, *coefficients)
            excess = log_density - level
            above, size = excess.clamp_min(0), excess.abs()
            density = torch.maximum(log_density, level).exp()
            total = size + size.roll(-1, 0)
            share = (above + above.roll(-1, 0)) / torch.where(total > 0, total, torch.ones_like(total))
            mass = (share * (density + density.roll(-1, 0))).sum(0) * (math.pi / nodes)
            mass = mass / order.clamp_min(1).to(mass.dtype)  # the folded density covers the circle order times
            return torch.where(order == 0, torch.zeros_like(mass), mass.clamp(0, 1))


def _circle(nodes: int, like: Tensor) -> Tensor:
    """Equidistant angles of the whole circle, from -pi."""
    return torch.arange(nodes, dtype=like.dtype, device=like.device) * (2 * math.pi / nodes) - math.pi


def _log_density(value: Tensor, log_peak: Tensor, concentration: Tensor, unit: Tensor) -> Tensor:
    """`logsumexp_k(log_peak_k + kappa_k (cos(v - mu_k) - 1))`, the cosine by the chord, which cancels nothing."""
    chord_x = torch.cos(value)[..., None] - unit[..., 0]
    chord_y = torch.sin(value)[..., None] - unit[..., 1]
    return torch.logsumexp(log_peak - 0.5 * concentration * (chord_x * chord_x + chord_y * chord_y), -1)
