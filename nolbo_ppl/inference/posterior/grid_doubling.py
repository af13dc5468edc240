"""Transposed convolutions of kernel 4, stride 2 and padding 1 as matrix products without what falls off the border.

Such a layer doubles a grid. Of the 64 products of a cell a part lands outside of the doubled grid, on a grid of 4^3 cells a
third of all, which a library's kernel computes or skips badly. Here the grid is cut into windows: of two neighbours along an
axis, which alone fill two cells of the doubled grid, or of a single cell at either end, which fills one. A window is dense:
one matrix product for all windows of a kind, of which there are eight, by the axes along which they lie at an end.
"""

from __future__ import annotations

import math
from itertools import product

import torch
from jaxtyping import Float
from torch import Tensor, nn

SIDE = 4
"""Grids up to this side are doubled here: one core takes 0.36 ms for 4^3 x 128 -> 8^3 x 64 channels (0.55 ms by the library's
kernel), but 0.95 ms for 8^3 x 64 -> 16^3 x 32 (0.85 ms), most of whose cells lie inside."""


class GridDoubling:
    """A transposed convolution for grids whose channels lie together; see the module's docstring.

    Args:
        layer: kernel 4, stride 2, padding 1, with a bias.

    Example:
        >>> layer = nn.ConvTranspose3d(3, 2, 4, 2, 1)
        >>> grid = torch.randn(1, 3, 4, 4, 4)
        >>> doubled = GridDoubling(layer)(grid.movedim(1, -1)).movedim(-1, 1)
        >>> torch.allclose(doubled, layer(grid), atol=1e-5)
        True
    """

    def __init__(self, layer: nn.ConvTranspose3d) -> None:
        assert layer.kernel_size == (4, 4, 4) and layer.stride == (2, 2, 2) and layer.padding == (1, 1, 1)
        assert layer.bias is not None
        self.bias, self.outputs = layer.bias.detach(), layer.out_channels
        self.kernels = {inside: window_kernels(layer.weight.detach(), inside) for inside in product((False, True), repeat=3)}

    def __call__(self, grid: Float[Tensor, "n v v v c"]) -> Float[Tensor, "n w w w d"]:
        """The doubled grid."""
        n, v = grid.shape[:2]
        doubled = grid.new_empty(n, 2 * v, 2 * v, 2 * v, self.outputs)
        for inside, kernel in self.kernels.items():
            seen, filled = windows(grid, inside, 1), windows(doubled, inside, 2)
            values = torch.bmm(seen.reshape(len(kernel), -1, kernel.shape[1]), kernel)
            torch.add(values.view(filled.shape), self.bias, out=filled)
        return doubled


def windows(grid: Float[Tensor, "n v v v c"], inside: tuple[bool, ...], step: int) -> Float[Tensor, "*kinds windows cells c"]:
    """View of a grid as windows of one kind: ends, then grids and their windows in order, then cells of a window, channels.

    Args:
        grid: what is doubled, or the doubled grid.
        inside: for each axis, whether windows are pairs of neighbours, or the cells at its two ends.
        step: cells from one pair to the next: 1 in what is doubled, 2 in the doubled grid, whose first cell is an end.
    """
    for axis, pairs in enumerate(inside, start=1):
        side = grid.shape[axis]
        if pairs:
            grid = grid.narrow(axis, step - 1, side - 2 * (step - 1)).unfold(axis, 2, step)
        else:
            ends = (slice(None),) * axis + (slice(None, None, side - 1),)
            grid = grid[ends][..., None]
    at_end = [axis for axis, pairs in enumerate(inside, start=1) if not pairs]
    between = [axis for axis, pairs in enumerate(inside, start=1) if pairs]
    return grid.permute(*at_end, 0, *between, 5, 6, 7, 4)


def window_kernels(weight: Float[Tensor, "c d 4 4 4"], inside: tuple[bool, ...]) -> Float[Tensor, "ends seen filled"]:
    """Matrices of a transposed convolution from the cells of a window, with their channels, to those that it fills; one an end.

    Cell i of a grid adds to cell o of the doubled one by element o - 2 i + 1 of the kernel.
    """
    for pairs in inside:
        element = torch.tensor([[[2, 3], [0, 1]]]) if pairs else torch.tensor([[[1]], [[2]]])  # end, from, to
        weight = weight.movedim(2, -1)[..., element]
    c, d, *axes = weight.shape
    ends, seen, filled = (math.prod(axes[k::3]) for k in range(3))
    return weight.permute(2, 5, 8, 3, 6, 9, 0, 4, 7, 10, 1).reshape(ends, seen * c, filled * d).contiguous()
