"""The support of angles: a circle, which has no ends for a sampler to bounce off."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.distributions import biject_to, constraints, transform_to
from torch.distributions.transforms import Transform

from nolbo_ppl.geometry.rotation import wrap_angle


class _Circular(constraints.Constraint):
    """Angles in rad, named by their representative in [-pi, pi); the two ends are one point."""

    def check(self, value: Tensor) -> Tensor:
        """Whether each value is such a representative."""
        return (value >= -math.pi) & (value <= math.pi)


circular: constraints.Constraint = _Circular()


class WrapTransform(Transform):
    """The covering of the circle by the line, `x -> x` modulo 2 pi: it preserves volume and is not one to one.

    What moves on the line (NUTS, an autoguide's normal) passes +-pi as any other angle, its density is periodic there, and
    its image on the circle has the right distribution. Of an interval's bijection both ends would be infinitely far away:
    a chain on one side of pi never saw the other.
    """

    domain = constraints.real
    codomain = circular
    bijective = False
    sign = 1

    def __eq__(self, other: object) -> bool:
        return isinstance(other, WrapTransform)

    def __hash__(self) -> int:
        return hash(WrapTransform)

    def _call(self, x: Tensor) -> Tensor:
        return wrap_angle(x)

    def _inverse(self, y: Tensor) -> Tensor:
        return y

    def log_abs_det_jacobian(self, x: Tensor, y: Tensor) -> Tensor:
        """Zero: angles stay as long as they are."""
        return torch.zeros_like(x)


@biject_to.register(_Circular)
@transform_to.register(_Circular)
def _wrap(_: Any) -> Transform:
    return WrapTransform()
