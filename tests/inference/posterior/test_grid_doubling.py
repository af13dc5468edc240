"""Transposed convolutions as products of windows, against torch's own."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from nolbo_ppl.inference.posterior.folded_networks import exponential_unit, written_patches
from nolbo_ppl.inference.posterior.grid_doubling import GridDoubling
from nolbo_ppl.models.shape_networks import PatchWriter


@pytest.mark.parametrize("side", [2, 3, 4, 7])
def test_windows_add_up_to_the_transposed_convolution(side: int) -> None:
    g = torch.Generator().manual_seed(side)
    layer = nn.ConvTranspose3d(5, 3, 4, 2, 1).requires_grad_(False)
    grid = torch.randn(2, 5, side, side, side, generator=g)
    torch.testing.assert_close(GridDoubling(layer)(grid.movedim(1, -1)).movedim(-1, 1), layer(grid), atol=1e-12, rtol=1e-12)


@torch.no_grad()
def test_units_and_patches_are_those_of_the_decoder() -> None:
    g = torch.Generator().manual_seed(0)
    x = 3 * torch.randn(2, 3, 3, 3, 4, generator=g)
    x[0, 0, 0, 0] = torch.tensor([-200.0, 200.0, 0.0, -1e-9])
    torch.testing.assert_close(exponential_unit(x.clone()), nn.functional.elu(x), atol=1e-12, rtol=1e-12)
    writer = PatchWriter(4).float()
    written = written_patches(writer.linear, x.float())
    torch.testing.assert_close(written[..., 0], writer(x.float().movedim(-1, 1))[:, 0])
