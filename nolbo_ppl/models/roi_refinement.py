"""The RoI refinement head of the guide: what an object's own box holds, sampled at a fixed size, refines its posterior.

A cell's features describe an object at whatever size it has in the image. Sampled on a fixed grid over the object's box,
near and far objects look alike, and far fewer images teach category, viewpoint and shape. The image still goes through
the encoder once: the grid is read from the encoder's own finer maps.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from nolbo_ppl._moved import renamed
from nolbo_ppl.models.layers import OutputLinear
from nolbo_ppl.models.model_config import ModelConfig

MARGIN = 1.2
"""The grid covers the box enlarged by this factor, so that its surroundings are seen too."""
MIN_SIDE = 8.0
"""Least side of the enlarged box, px."""


def roi_grid(box: Float[Tensor, "n 4"], side: int) -> Float[Tensor, "n side side 2"]:
    """Points (x, y), px, of a regular grid over each enlarged box, row by row: the centres of `side` x `side` parts."""
    centre = (box[:, :2] + box[:, 2:]) / 2
    extent = ((box[:, 2:] - box[:, :2]) * MARGIN).clamp_min(MIN_SIDE)
    step = (torch.arange(side, dtype=box.dtype, device=box.device) + 0.5) / side - 0.5
    y, x = torch.meshgrid(step, step, indexing="ij")
    return centre[:, None, None] + torch.stack((x, y), -1) * extent[:, None, None]


def sample_map(
    features: Float[Tensor, "b c h w"], row: Int[Tensor, " n"], points: Float[Tensor, "n p 2"], stride: int
) -> Float[Tensor, "n p c"]:
    """Bilinear samples of a feature map at image points (px); points outside take the border's values.

    Args:
        features: the maps of a batch of images.
        row: the image of each set of points.
        points: (x, y), px of the image.
        stride: pixels of a map's cell; its value belongs to the middle of the cell.
    """
    training = torch.is_grad_enabled() or torch.jit.is_tracing()
    if not training and points.device.type == "cpu" and len(row) and features.dtype == points.dtype:
        return _sample_map_of_query(features, row, points, stride)
    _, c, h, w = features.shape
    place = points / stride - 0.5
    x, y = place[..., 0].clamp(0, w - 1), place[..., 1].clamp(0, h - 1)
    x0, y0 = x.floor().clamp(max=max(w - 2, 0)), y.floor().clamp(max=max(h - 2, 0))
    fx, fy = (x - x0)[..., None], (y - y0)[..., None]
    left, top = x0.long(), y0.long()
    right, bottom = (left + 1).clamp(max=w - 1), (top + 1).clamp(max=h - 1)
    table = features.permute(0, 2, 3, 1).reshape(-1, c)
    first = row[:, None] * (h * w)

    def at(across: Tensor, down: Tensor) -> Tensor:
        return table[(first + down * w + across).flatten()].unflatten(0, across.shape)

    upper = torch.lerp(at(left, top), at(right, top), fx.to(table.dtype))
    lower = torch.lerp(at(left, bottom), at(right, bottom), fx.to(table.dtype))
    return torch.lerp(upper, lower, fy.to(table.dtype))


def _sample_map_of_query(
    features: Float[Tensor, "b c h w"], row: Int[Tensor, " n"], points: Float[Tensor, "n p 2"], stride: int
) -> Float[Tensor, "n p c"]:
    """`sample_map` by torch's own kernel: in a tenth of the time on a CPU, equal to the rounding of coordinates.

    Training keeps to `sample_map`, whose gradient needs no copy of a map for each of its objects.
    """
    grid = points / (points.new_tensor(features.shape[:1:-1]) * (stride / 2)) - 1
    sample = partial(nn.functional.grid_sample, mode="bilinear", padding_mode="border", align_corners=False)
    if len(features) == 1:  # all points at once
        return sample(features, grid[None])[0].permute(1, 2, 0)
    if len(features) == len(row):  # crops, each with its own object
        return sample(features[row], grid[:, None])[:, :, 0].transpose(1, 2)
    seen = points.new_empty(*points.shape[:2], features.shape[1])
    for image in row.unique().tolist():
        own = row == image
        seen[own] = sample(features[image : image + 1], grid[own][None])[0].permute(1, 2, 0)
    return seen


class RoiRefinementBlock(nn.Module):
    """Two 3 x 3 convolutions beside the identity, which they are at the start of training."""

    def __init__(self, width: int) -> None:
        super().__init__()
        last = nn.GroupNorm(4, width)
        nn.init.zeros_(last.weight)
        self.branch = nn.Sequential(
            nn.Conv2d(width, width, 3, padding=1, bias=False),
            nn.GroupNorm(4, width),
            nn.GELU(),
            nn.Conv2d(width, width, 3, padding=1, bias=False),
            last,
        )

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        """Add the two convolutions to the input."""
        return x + self.branch(x)


class RoiRefinement(nn.Module):
    """Features sampled over a box -> what is added to the cell's raw outputs; little at the start of training.

    Args:
        channels: channels of each of the encoder's maps, finest first.
        strides: their strides, px.
        outputs: numbers to add.
        config: sizes; `glimpse_maps` of the maps are sampled, and with `glimpse_detail` the finest one twice as densely
            too, for details that the grid steps over.
    """

    def __init__(self, channels: Sequence[int], strides: Sequence[int], outputs: int, config: ModelConfig) -> None:
        super().__init__()
        self.side, self.strides = config.glimpse, tuple(strides[: config.glimpse_maps])
        width, hidden = config.glimpse_width, config.head_width
        self.look = nn.Sequential(
            nn.Conv2d(sum(channels[: config.glimpse_maps]), width, 3, padding=1, bias=False),
            nn.GroupNorm(4, width),
            nn.GELU(),
            *(RoiRefinementBlock(width) for _ in range(config.glimpse_blocks)),
            nn.Conv2d(width, width, 3, 2, 1, bias=False),
            nn.GroupNorm(4, width),
            nn.GELU(),
        )
        self.detail = nn.Conv2d(channels[0], width, 4, 2, 1, bias=False) if config.glimpse_detail else None
        last = OutputLinear(hidden, outputs)
        nn.init.normal_(last.weight, std=0.02)
        nn.init.zeros_(last.bias)
        self.judge = nn.Sequential(
            nn.Linear(width * (-(-self.side // 2)) ** 2 + 4, hidden), nn.LayerNorm(hidden), nn.GELU(), last
        )

    def forward(
        self,
        maps: Sequence[Float[Tensor, "b c h w"]],
        row: Int[Tensor, " n"],
        box: Float[Tensor, "n 4"],
        place: Float[Tensor, "n 4"],
    ) -> Float[Tensor, "n outputs"]:
        """What the object in each box adds.

        Args:
            maps: the encoder's finer maps.
            row: the image of each box.
            box: [x0, y0, x1, y1], px.
            place: the box in latent units, for the size that the grid takes away.
        """
        first = self.look[0](self._patch(maps, row, box, self.side, self.strides))
        if self.detail is not None:
            first = first + self.detail(self._patch(maps, row, box, 2 * self.side, self.strides[:1]))
        look = self.look[1:](first)
        return self.judge(torch.cat((look.flatten(1), place.to(look.dtype)), -1))

    @staticmethod
    def _patch(
        maps: Sequence[Tensor], row: Int[Tensor, " n"], box: Float[Tensor, "n 4"], side: int, strides: Sequence[int]
    ) -> Float[Tensor, "n c side side"]:
        """Samples of the maps of the given strides on a grid over each box."""
        points = roi_grid(box, side).flatten(1, 2)
        seen = [sample_map(m, row, points, stride) for m, stride in zip(maps, strides)]
        patch = torch.cat(seen, -1).unflatten(1, (side, side)).permute(0, 3, 1, 2)
        return patch.contiguous(memory_format=torch.channels_last)


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
