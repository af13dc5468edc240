"""Image encoders: the whole scene goes in once, the features of every cell come out."""

from __future__ import annotations

from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nolbo_ppl.errors import input_error
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.normalisation import SyncBatchNorm2d

COLOUR_MIDDLE, COLOUR_SCALE = 127.5, 64.0
"""Colours of 0..255 less the one and over the other are what encoders see."""


class ConvUnit(nn.Sequential):
    """Convolution, batch normalisation, leaky ReLU."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int = 1) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False),
            SyncBatchNorm2d(outputs),
            nn.LeakyReLU(0.1, inplace=True),
        )


class ResidualBlock(nn.Module):
    """Two 3 x 3 convolutions beside the identity."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = ConvUnit(channels, channels, 3)
        self.second = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.norm = SyncBatchNorm2d(channels)
        self.activation = nn.LeakyReLU(0.1, inplace=True)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """Add the two convolutions to the input."""
        return self.activation(self.norm(self.second(self.first(x))) + x)


class Encoder(Protocol):
    """What the guide asks of an encoder."""

    stride: int
    channels: int

    def __call__(self, image: Float[Tensor, "b 3 h w"]) -> tuple[Float[Tensor, "b c gh gw"], tuple[Tensor, ...]]:
        """Features of every cell, and finer maps for the RoI refinement (none for darknet19)."""
        ...


class TinyEncoder(nn.Module):
    """A small residual network of stride 16; the finer stride-8 features are folded into the channels of each cell.

    Without the folded features small objects lose their box accuracy.
    """

    stride = 16

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        c2, c4, c8, c16 = config.encoder_channels
        n4, n8, n16 = config.encoder_blocks
        self.stem = nn.Sequential(ConvUnit(3, c2, 3, 2), ConvUnit(c2, c4, 3, 2), *(ResidualBlock(c4) for _ in range(n4)))
        self.middle = nn.Sequential(ConvUnit(c4, c8, 3, 2), *(ResidualBlock(c8) for _ in range(n8)))
        self.deep = nn.Sequential(ConvUnit(c8, c16, 3, 2), *(ResidualBlock(c16) for _ in range(n16)))
        self.fold = nn.PixelUnshuffle(2)
        self.channels = c16 + 4 * c8
        self.fine_channels, self.fine_strides = (c4, c8, c16), (4, 8, 16)

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> tuple[Float[Tensor, "b c gh gw"], tuple[Tensor, ...]]:
        """Features of each 16 x 16 px cell, and the maps of strides 4, 8 and 16."""
        fine = self.stem(image)
        middle = self.middle(fine)
        deep = self.deep(middle)
        return torch.cat((deep, self.fold(middle)), dim=1), (fine, middle, deep)


_DARKNET19: tuple[tuple[tuple[int, int], ...], ...] = (
    ((32, 3),),
    ((64, 3),),
    ((128, 3), (64, 1), (128, 3)),
    ((256, 3), (128, 1), (256, 3)),
    ((512, 3), (256, 1), (512, 3), (256, 1), (512, 3)),
    ((1024, 3), (512, 1), (1024, 3), (512, 1), (1024, 3)),
)
"""(channels, kernel) of the 18 convolutions of darknet19's core (YOLO9000, table 6), by stage between the poolings."""


class Darknet19Encoder(nn.Module):
    """The paper's encoder: darknet19's 18 convolutions, then three 3 x 3 convolutions of 1024 channels; stride 32.

    Args:
        width: factor on all channels.
    """

    stride = 32
    fine_channels: tuple[int, ...] = ()
    fine_strides: tuple[int, ...] = ()

    def __init__(self, width: float = 1.0) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        inputs = 3
        for index, stage in enumerate(_DARKNET19):
            if index:
                layers.append(nn.MaxPool2d(2))
            for full, kernel in stage:
                outputs = narrowed(full, width)
                layers.append(ConvUnit(inputs, outputs, kernel))
                inputs = outputs
        self.channels = inputs
        self.core = nn.Sequential(*layers)
        self.neck = nn.Sequential(*(ConvUnit(inputs, inputs, 3) for _ in range(3)))

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> tuple[Float[Tensor, "b 1024 gh gw"], tuple[Tensor, ...]]:
        """Features of each 32 x 32 px cell; the first pooling follows the first convolution, the last the fifth stage."""
        return self.neck(self.core(image)), ()


def narrowed(channels: int, width: float) -> int:
    """Channels of a layer by a factor, at least four."""
    return max(4, round(channels * width))


def make_encoder(config: ModelConfig) -> TinyEncoder | Darknet19Encoder:
    """The encoder a configuration names."""
    return TinyEncoder(config) if config.encoder == "tiny" else Darknet19Encoder(config.encoder_width)


def check_image(image: Tensor) -> None:
    """Raise `InputError` unless `image` is uint8 [b, 3, h, w] or float in [0, 255] with sides that are multiples of 32."""
    if image.dim() != 4 or image.shape[1] != 3:
        raise input_error("an image batch of the wrong shape", got=tuple(image.shape), expected="(b, 3, height, width)")
    if image.shape[2] % 32 or image.shape[3] % 32 or 0 in image.shape[2:]:
        raise input_error("an image side", got=tuple(image.shape[2:]), expected="positive multiples of 32", do="resize or pad it")


def normalise_image(image: Tensor, dtype: torch.dtype) -> Float[Tensor, "b 3 h w"]:
    """Colours from 0..255 to about unit variance about zero."""
    return (image.to(dtype) - COLOUR_MIDDLE) / COLOUR_SCALE
