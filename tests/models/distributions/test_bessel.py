from __future__ import annotations

import mpmath
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nolbo_ppl.models.distributions.bessel import (
    bessel_gap,
    bessel_ratio,
    bessel_ratio_over_x,
    gap_excess,
    log_i0e,
)

mpmath.mp.dps = 50


def _ratio(x: mpmath.mpf) -> mpmath.mpf:
    return mpmath.besseli(1, x) / mpmath.besseli(0, x)


REFERENCE = {
    log_i0e: lambda x: mpmath.log(mpmath.besseli(0, x)) - x,
    bessel_gap: lambda x: 1 - _ratio(x),
    bessel_ratio: _ratio,
    bessel_ratio_over_x: lambda x: _ratio(x) / x if x else mpmath.mpf(1) / 2,
    gap_excess: lambda x: 2 * x * (1 - _ratio(x)) - 1,
}
"""High-precision values of every function."""


@pytest.mark.parametrize("function", REFERENCE, ids=lambda f: f.__name__)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 2e-13), (torch.float32, 2e-6)])
@settings(max_examples=40, deadline=None, derandomize=True)
@given(x=st.one_of(st.floats(0, 60, allow_subnormal=False), st.floats(60, 1e5), st.sampled_from([0.0, 0.01, 30.0])))
def test_values_match_high_precision(function, dtype, tolerance, x) -> None:
    x = torch.tensor(x, dtype=dtype)
    expected = REFERENCE[function](mpmath.mpf(x.item()))
    # Relative to the value; the excess is a difference of numbers of size x below the switch.
    scale = 30.0 if function is gap_excess else abs(float(expected))
    floor = 2 * torch.finfo(dtype).eps if function is log_i0e else 0.0
    assert abs(float(function(x)) - float(expected)) <= tolerance * scale + floor


@pytest.mark.parametrize("function", REFERENCE, ids=lambda f: f.__name__)
@pytest.mark.parametrize("x", [0.3, 5.0, 29.9, 30.1, 300.0, 1e5])
def test_derivatives_match_high_precision(function, x) -> None:
    t = torch.tensor(x, requires_grad=True)
    (slope,) = torch.autograd.grad(function(t), t)
    expected = float(mpmath.diff(REFERENCE[function], mpmath.mpf(x)))
    torch.testing.assert_close(slope.item(), expected, rtol=2e-11, atol=1e-13)


def test_derivatives_at_zero() -> None:
    t = torch.zeros((), requires_grad=True)
    for function, expected in ((log_i0e, -1.0), (bessel_gap, -0.5), (bessel_ratio_over_x, 0.0)):
        (slope,) = torch.autograd.grad(function(t), t)
        assert slope.item() == expected


def test_gradcheck_on_both_sides_of_the_switch() -> None:
    x = torch.tensor([0.0, 0.005, 0.5, 20.0, 31.0, 400.0], requires_grad=True)
    inner = x.detach()[1:].requires_grad_()
    for function in REFERENCE:
        assert torch.autograd.gradcheck(function, inner)
        assert torch.isfinite(torch.autograd.grad(function(x).sum(), x)[0]).all()
