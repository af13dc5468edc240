"""Modified Bessel functions of order 0 and 1 in the forms directional statistics needs, stable from 0 to 1e5.

Above `_LARGE` the ratio `I1(x) / I0(x) = sum a_n x^-n` is used; its coefficients follow from the Riccati equation
`A' = 1 - A^2 - A / x` of the ratio (Mardia & Jupp, Directional Statistics, appendix 1). Every function is built from
that one series, so that values and derivatives stay accurate where the difference of two Bessel functions cancels.
"""

from __future__ import annotations

import math
from fractions import Fraction

import torch
from jaxtyping import Float
from torch import Tensor

_LARGE = 30.0
_TERMS = 17
"""With 16 powers of 1/x the series is exact to 1e-16 at x = 30, where the direct form still holds 14 digits."""
_TERMS_SINGLE = 5
"""What single precision needs of them."""


def _ratio_coefficients(count: int) -> list[float]:
    a = [Fraction(1)]
    for m in range(1, count):
        cross = sum((a[i] * a[m - i] for i in range(1, m)), Fraction(0))
        a.append(((m - 2) * a[m - 1] - cross) / 2)
    return [float(x) for x in a]


_RATIO = _ratio_coefficients(_TERMS)
_GAP_EXCESS = [-2 * a for a in _RATIO[2:]]
"""Coefficients of `2 x (1 - A(x)) - 1 = sum_{n >= 1} c_n x^-n`, first c_1 = 1/4."""
_LOG_I0E = [a / (1 - n) for n, a in enumerate(_RATIO) if n >= 2]
"""Coefficients of `log(I0(x) e^-x) + log(2 pi x) / 2 = sum_{n >= 1} c_n x^-n`, first c_1 = 1/8."""


def _series(coefficients: list[float], inverse: Tensor) -> Tensor:
    """`sum_{n >= 1} c_n inverse^(n - 1)` by Horner's rule (the leading power is left to the caller)."""
    if inverse.dtype != torch.float64:
        coefficients = coefficients[:_TERMS_SINGLE]
    result = torch.full_like(inverse, coefficients[-1])
    for c in reversed(coefficients[:-1]):
        result = c + inverse * result
    return result


def _branches(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Which entries are large, the entries safe for the direct form, and 1/x safe for the series."""
    large = x > _LARGE
    return large, torch.where(large, torch.ones_like(x), x), 1 / torch.where(large, x, torch.full_like(x, _LARGE))


def log_i0e(x: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """`log(I0(x)) - x` for x >= 0."""
    if torch.jit.is_tracing():
        return _log_i0e_of_graphs(x)
    large, small, inverse = _branches(x)
    series = 0.5 * torch.log(inverse / (2 * math.pi)) + inverse * _series(_LOG_I0E, inverse)
    return torch.where(large, series, torch.log(torch.special.i0(small)) - small)


_NEAR = (1.0, 3.5156229, 3.0899424, 1.2067492, 0.2659732, 0.0360768, 0.0045813)
_FAR = (0.39894228, 0.01328592, 0.00225319, -0.00157565, 0.00916281, -0.02057706, 0.02635537, -0.01647633, 0.00392377)
"""Polynomials of I0 in (x / 3.75)^2 and of sqrt(x) e^-x I0 in 3.75 / x (Abramowitz & Stegun 9.8.1, 9.8.2; errors below 2e-7)."""


def _log_i0e_of_graphs(x: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """`log(I0(x)) - x` to single precision, of operations that exported graphs have: ONNX knows no Bessel function."""
    near = x < 3.75
    t = torch.where(near, x / 3.75, torch.ones_like(x)).square()
    inverse = 3.75 / torch.where(near, torch.full_like(x, 3.75), x)
    low = _NEAR[-1] + torch.zeros_like(x)
    for c in reversed(_NEAR[:-1]):
        low = c + t * low
    high = _FAR[-1] + torch.zeros_like(x)
    for c in reversed(_FAR[:-1]):
        high = c + inverse * high
    return torch.where(near, torch.log(low) - x, torch.log(high) + 0.5 * torch.log(inverse / 3.75))


def _direct_gap(x: Tensor) -> Tensor:
    """`1 - I1 / I0` in double precision, of which the difference leaves all that single precision holds."""
    double = x.double()
    return (1 - torch.special.i1e(double) / torch.special.i0e(double)).to(x.dtype)


def gap_excess(x: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """`2 x (1 - I1(x) / I0(x)) - 1` for x >= 0: what the mean resultant falls short of its Gaussian limit."""
    large, small, inverse = _branches(x)
    return torch.where(large, inverse * _series(_GAP_EXCESS, inverse), 2 * small * _direct_gap(small) - 1)


def bessel_gap(x: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """`1 - I1(x) / I0(x)` for x >= 0, with full relative accuracy where the ratio is close to one."""
    large, small, inverse = _branches(x)
    series = 0.5 * inverse * (1 + inverse * _series(_GAP_EXCESS, inverse))
    return torch.where(large, series, _direct_gap(small))


def bessel_ratio(x: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """`A(x) = I1(x) / I0(x)`, the mean resultant length of a von Mises distribution of concentration x >= 0."""
    large, small, inverse = _branches(x)
    series = 1 - 0.5 * inverse * (1 + inverse * _series(_GAP_EXCESS, inverse))
    return torch.where(large, series, torch.special.i1e(small) / torch.special.i0e(small))


def bessel_ratio_over_x(x: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """`I1(x) / (x I0(x))` for x >= 0, with its limit 1/2 at zero."""
    tiny = x < 1e-2
    away = torch.where(tiny, torch.ones_like(x), x)
    square = x * x
    series = 0.5 - square * (1 / 16 - square * (1 / 96 - square * (11 / 6144)))
    return torch.where(tiny, series, bessel_ratio(away) / away)
