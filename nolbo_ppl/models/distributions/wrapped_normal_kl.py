"""The exact KL divergence of wrapped normals, on the circle and under a symmetry, by the Fourier series of a log density.

The wrapped normal is a theta function, and by Jacobi's triple product its log density is a cosine series with known
coefficients (Whittaker & Watson, sections 21.3 and 21.42): with `t = scale^2`,

    log p(v) = a_0(t) + sum_{k >= 1} (-1)^(k + 1) cos(k (v - loc)) / (k sinh(k t / 2)),
    a_0(t) = -log(2 pi) + sum_{n >= 1} log(1 - exp(-n t)).

Under another wrapped normal the expectation of each cosine is `exp(-k^2 scale_q^2 / 2) cos(k (loc_q - loc))`. Nothing is
left to a quadrature, whose nodes a narrow p asks for without end: its log density has a kink at the antipode.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.distributions.kl import register_kl

from nolbo_ppl.models.distributions.wrapped_normal import WrappedNormal, kl_of_angles

_REACH = 9.0
"""Standard deviations of a normal beyond which nothing is: a mass of 2e-19."""


def log_density_mean(scale: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """`a_0`, the mean of a wrapped normal's log density over the circle, nats.

    Below a scale of 1.5 rad by the transformation of Dedekind's eta function (t -> 4 pi^2 / t), so that three factors of
    the product suffice on either side.
    """
    square = scale * scale
    wide = scale > 1.5
    n = torch.arange(1, 18, dtype=scale.dtype, device=scale.device)
    direct = torch.log1p(-torch.exp(-n * square.clamp_min(2.25)[..., None])).sum(-1)
    return torch.where(wide, direct - math.log(2 * math.pi), _tangent_mean(scale) + log_density_excess_mean(scale))


def _tangent_mean(scale: Tensor) -> Tensor:
    """Mean over the circle of `-d^2 / (2 scale^2) - log(scale sqrt(2 pi))`, d the angle to the mean by the shortest way."""
    return -(math.pi**2) / (6 * scale * scale) - torch.log(scale) - 0.5 * math.log(2 * math.pi)


def log_density_excess_mean(scale: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Mean over the circle of what the log density has above its tangent form at the nearest mode, nats."""
    square = scale * scale
    n = torch.arange(1, 4, dtype=scale.dtype, device=scale.device)
    narrow = square.clamp_max(2.25)[..., None]
    by_images = square / 24 + torch.log1p(-torch.exp(-4 * math.pi**2 * n / narrow)).sum(-1)
    if not bool((scale > 1.5).any()):
        return by_images
    many = torch.arange(1, 18, dtype=scale.dtype, device=scale.device)
    direct = torch.log1p(-torch.exp(-many * square.clamp_min(2.25)[..., None])).sum(-1) - math.log(2 * math.pi)
    return torch.where(scale > 1.5, direct - _tangent_mean(scale), by_images)


def inverse_sinh(x: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """`1 / sinh(x)` for x > 0, zero where sinh overflows."""
    return -2 * torch.exp(-x) / torch.expm1(-2 * x)


def log_density_excess_coefficient(k: Tensor, square: Tensor) -> Tensor:
    """`(1 / sinh(y) - 1 / y) / k` with y = k square / 2: coefficient of `(-1)^(k + 1) cos(k d)` of that excess."""
    y = 0.5 * k * square
    small = y < 0.05
    y_small, y_large = torch.where(small, y, 0.0), torch.where(small, 1.0, y)
    y_2 = y_small * y_small
    series = -y_small / 6 * (1 - y_2 * (7 / 60 - y_2 * (31 / 2520)))
    return torch.where(small, series, inverse_sinh(y_large) - 1 / y_large) / k


def _expected_log_density(difference: Tensor, scale_q: Tensor, scale_p: Tensor) -> Tensor:
    """E[log p] in nats under a wrapped normal q whose mean is `difference` away; double precision, one dimension."""
    square_q, square_p = scale_q * scale_q, scale_p * scale_p
    # terms from which on either factor has vanished (1e-17 of the first)
    with torch.no_grad():
        terms = torch.minimum(8.9 / scale_q, 2 + 80 / square_p)
        count = int(terms.max().clamp(4, 2**20)) + 1
    total = log_density_mean(scale_p)
    for start in range(1, count + 1, 512):
        k = torch.arange(start, min(start + 512, count + 1), dtype=torch.float64, device=scale_q.device)
        weight = torch.exp(-0.5 * k * k * square_q[:, None]) * inverse_sinh(0.5 * k * square_p[:, None]) / k
        signed = weight * torch.cos(k * (difference + math.pi)[:, None])
        total = total - signed.sum(-1)
    return total


def wrapped_normal_kl(
    q: WrappedNormal,
    p: WrappedNormal,
    order: Int[Tensor, "*#batch"] | int = 1,
    quotient: bool = True,
) -> Float[Tensor, "*batch"]:
    """KL(q || p) in nats of wrapped normals, exact to 1e-10 (1e-4 of it below double precision).

    Args:
        q: the first argument.
        p: the second, where there is a symmetry the equal mixture over its group.
        order: 1 no symmetry, n n-fold. Order 0, a free axis, counts as 1: callers leave such an angle out.
        quotient: q is folded by the group as well, and the divergence is that of densities on the quotient. Otherwise q
            is what it is, on the whole circle.

    Where q has no mass near the kink of log p, opposite its mean, the divergence of the two normals is the answer, and
    nothing else is computed. Else the Fourier series of the module's docstring, in double precision; the symmetry
    stretches angles and scales n times.

    Example:
        >>> wide = WrappedNormal(torch.tensor(3.0).double(), torch.tensor(5.0).double())
        >>> bool(wrapped_normal_kl(WrappedNormal(wide.loc - 3, wide.scale), wide) < 1e-9)  # two uniform densities
        True
    """
    count = torch.as_tensor(order, device=q.loc.device).clamp_min(1).to(q.loc.dtype)
    loc_q, scale_q, loc_p, scale_p, count = torch.broadcast_tensors(q.loc, q.scale, p.loc, p.scale, count)
    normal = kl_of_angles(loc_q, scale_q, loc_p, scale_p, 2 * math.pi / count)
    if not quotient:
        normal = normal + torch.log(count)
    with torch.no_grad():
        period = 2 * math.pi / count
        distance = (torch.remainder(loc_q - loc_p + period / 2, period) - period / 2).abs()
        # log p is its tangent form to 1e-17 where (half a period - distance) * period > 39 scale^2
        margin = 39 * scale_p * scale_p / period
        overlapping = distance + _REACH * scale_q + margin > period / 2
    if not bool(overlapping.any()):
        return normal
    n = count[overlapping].double()
    own = scale_q[overlapping].double()
    difference = n * (loc_q[overlapping] - loc_p[overlapping]).double()
    entropy = WrappedNormal(difference, n * own if quotient else own, validate_args=False).entropy()
    exact = -entropy - _expected_log_density(difference, n * own, n * scale_p[overlapping].double())
    return normal.masked_scatter(overlapping, exact.to(normal.dtype))


@register_kl(WrappedNormal, WrappedNormal)
def _kl_wrapped_wrapped(q: WrappedNormal, p: WrappedNormal) -> Tensor:
    return wrapped_normal_kl(q, p)
