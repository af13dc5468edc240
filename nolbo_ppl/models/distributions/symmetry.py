"""The symmetry group about an object's vertical axis, as a batch of angles: order 1 none, n n-fold, 0 free."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nolbo_ppl.errors import input_error


def check_order(order: Tensor) -> None:
    """Orders are counts. Raises `InputError` for floats and for booleans, whose True would mean "no symmetry"."""
    if order.dtype.is_floating_point or order.dtype.is_complex or order.dtype == torch.bool:
        raise input_error("an order of symmetry that is no integer", got=order.dtype, expected="an int tensor")


def group_angles(
    order: Int[Tensor, "*batch"], dtype: torch.dtype
) -> tuple[Float[Tensor, "*batch elements"], Float[Tensor, "*batch elements"]]:
    """Angles `2 pi j / n` of the group of each order n and the log of their equal weights 1 / n.

    Padded to the largest order present; elements beyond an entry's own order weigh nothing (log weight -inf). Order 0
    gets the identity alone: the continuous group has no list of elements, its callers integrate in closed form.
    """
    count = order.clamp_min(1)
    j = torch.arange(int(count.max()) if count.numel() else 1, device=order.device)
    angles = j.to(dtype) * (2 * math.pi / count.to(dtype))[..., None]
    log_weight = -torch.log(count.to(dtype))[..., None].expand_as(angles)
    return angles, torch.where(j < count[..., None], log_weight, torch.full_like(angles, -math.inf))


def rotation_about_vertical(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation by `angle` rad about z, the object's vertical axis."""
    cosine, sine = torch.cos(angle), torch.sin(angle)
    zero, one = torch.zeros_like(angle), torch.ones_like(angle)
    rows = (cosine, -sine, zero, sine, cosine, zero, zero, zero, one)
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))
