"""YOLOX-nano (Ge et al., 2021) as a torch module: a detector of the 80 COCO categories whose predictions the guide starts from.

The architecture is the published one (CSPDarknet with depthwise convolutions, a PAN neck, a decoupled head a level),
written for the weights of its public ONNX file, whose batch normalisations are folded into the convolutions
(`nolbo_ppl.training.detector_file`). Folded kernels differ 1000-fold in scale, on which any optimiser with one rate
breaks: each is kept in units of its output channel's root mean square, with that as a gain beside it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nolbo_ppl.errors import input_error

CLASSES = 80
"""Categories of COCO, in its own order."""
STRIDES = (8, 16, 32)
"""Pixels of a cell of each level of predictions."""
WIDTH = 64
"""Channels of the head's features."""


class ScaledConv(nn.Module):
    """Convolution with a bias whose kernels have unit root mean square, times a gain an output channel."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 1, stride: int = 1, groups: int = 1) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(outputs, inputs // groups, kernel, kernel))
        nn.init.normal_(self.weight)
        fan = inputs // groups * kernel**2
        self.gain = nn.Parameter(torch.full((outputs,), fan**-0.5))
        self.bias = nn.Parameter(torch.zeros(outputs))
        self.stride, self.padding, self.groups = stride, kernel // 2, groups

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d h2 w2"]:
        """The convolution; one of a single pixel is a matrix product, which torch's small kernels are slower than."""
        weight = self.weight * self.gain[:, None, None, None]
        if self.weight.shape[2] == 1:
            return nn.functional.linear(x.permute(0, 2, 3, 1), weight.flatten(1), self.bias).permute(0, 3, 1, 2)
        return nn.functional.conv2d(x, weight, self.bias, self.stride, self.padding, 1, self.groups)

    @torch.no_grad()
    def set_kernel(self, kernel: Float[Tensor, "d c k k"], bias: Float[Tensor, " d"]) -> None:
        """Take a plain kernel and its bias. Raises `InputError` where they have another shape."""
        if kernel.shape != self.weight.shape or bias.shape != self.bias.shape:
            raise input_error("kernel of a detector", got=tuple(kernel.shape), expected=tuple(self.weight.shape))
        gain = kernel.square().mean((1, 2, 3)).sqrt().clamp_min(1e-12)
        self.weight.copy_(kernel / gain[:, None, None, None])
        self.gain.copy_(gain)
        self.bias.copy_(bias)


class Unit(nn.Sequential):
    """Convolution and SiLU."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 1, stride: int = 1, groups: int = 1) -> None:
        super().__init__(ScaledConv(inputs, outputs, kernel, stride, groups), nn.SiLU(inplace=True))


class Focus(nn.Module):
    """The four pixels of each 2 x 2 block beside each other, as channels."""

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 12 h2 w2"]:
        """Half the height and width, four times the channels: each column of a block from top to bottom."""
        return torch.cat([image[..., y::2, x::2] for x in (0, 1) for y in (0, 1)], 1)


class Depthwise(nn.Sequential):
    """3 x 3 convolution of each channel by itself, then a mix of the channels."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__(Unit(inputs, inputs, 3, stride, inputs), Unit(inputs, outputs))


class Bottleneck(nn.Module):
    """Channels mixed, then a depthwise convolution; the input is added in the backbone, not in the neck."""

    def __init__(self, channels: int, add: bool) -> None:
        super().__init__()
        self.mix, self.convolve, self.add = Unit(channels, channels), Depthwise(channels, channels), add

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """The bottleneck."""
        out = self.convolve(self.mix(x))
        return out + x if self.add else out


class PartialStage(nn.Module):
    """Cross-stage partial block: half the channels go through bottlenecks, half pass by, both are mixed."""

    def __init__(self, inputs: int, outputs: int, blocks: int, add: bool) -> None:
        super().__init__()
        half = outputs // 2
        self.first, self.second = Unit(inputs, half), Unit(inputs, half)
        self.blocks = nn.Sequential(*(Bottleneck(half, add) for _ in range(blocks)))
        self.last = Unit(2 * half, outputs)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d h w"]:
        """The block."""
        return self.last(torch.cat((self.blocks(self.first(x)), self.second(x)), 1))


class PyramidPooling(nn.Module):
    """Maxima over windows of 5, 9 and 13 cells beside the features themselves."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first, self.last = Unit(channels, channels // 2), Unit(2 * channels, channels)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """The pooling; wider windows are narrow ones applied again, which is the same maximum."""
        parts = [self.first(x)]
        for _ in range(3):
            parts.append(nn.functional.max_pool2d(parts[-1], 5, 1, 2))
        return self.last(torch.cat(parts, 1))


class LevelHead(nn.Module):
    """Decoupled head of one level: classes by one branch, box and objectness by the other."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.stem = Unit(channels, WIDTH)
        self.class_branch = nn.Sequential(Depthwise(WIDTH, WIDTH), Depthwise(WIDTH, WIDTH))
        self.classes = ScaledConv(WIDTH, CLASSES)
        self.box_branch = nn.Sequential(Depthwise(WIDTH, WIDTH), Depthwise(WIDTH, WIDTH))
        self.box, self.objectness = ScaledConv(WIDTH, 4), ScaledConv(WIDTH, 1)

    def forward(self, x: Float[Tensor, "b c h w"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Box, objectness and class logits, and the features of both branches, each [b, c, h, w]."""
        stem = self.stem(x)
        of_class, of_box = self.class_branch(stem), self.box_branch(stem)
        return self.box(of_box), self.objectness(of_box), self.classes(of_class), torch.cat((of_class, of_box), 1)


@dataclass
class Predictions:
    """Every prediction of the detector, n of them an image: levels of strides 8, 16 and 32, each row by row."""

    box: Float[Tensor, "b n 4"]
    """[x0, y0, x1, y1], px."""
    objectness: Float[Tensor, "b n"]
    """Log odds that it is an object of any category."""
    classes: Float[Tensor, "b n 80"]
    """Log odds of each category, given that it is an object."""
    features: Float[Tensor, "b n 128"]
    """Features of both branches of the head."""


class YoloxNano(nn.Module):
    """Images -> predictions.

    Example:
        >>> import torch
        >>> YoloxNano()(torch.zeros(1, 3, 64, 96)).box.shape
        torch.Size([1, 126, 4])
    """

    def __init__(self) -> None:
        super().__init__()
        self.focus: nn.Module = Focus()
        self.stem = Unit(12, 16, 3)
        self.stage4 = nn.Sequential(Depthwise(16, 32, 2), PartialStage(32, 32, 1, True))
        self.stage8 = nn.Sequential(Depthwise(32, 64, 2), PartialStage(64, 64, 3, True))
        self.stage16 = nn.Sequential(Depthwise(64, 128, 2), PartialStage(128, 128, 3, True))
        self.stage32 = nn.Sequential(Depthwise(128, 256, 2), PyramidPooling(256), PartialStage(256, 256, 1, False))
        self.lateral32, self.merge16 = Unit(256, 128), PartialStage(256, 128, 1, False)
        self.lateral16, self.merge8 = Unit(128, 64), PartialStage(128, 64, 1, False)
        self.down8, self.out16 = Depthwise(64, 64, 2), PartialStage(128, 128, 1, False)
        self.down16, self.out32 = Depthwise(128, 128, 2), PartialStage(256, 256, 1, False)
        self.heads = nn.ModuleList(LevelHead(channels) for channels in (64, 128, 256))

    def maps(self, image: Float[Tensor, "b 3 h w"]) -> tuple[Tensor, Tensor, Tensor]:
        """Maps of strides 8, 16 and 32 of the neck; see `forward`."""
        c8 = self.stage8(self.stage4(self.stem(self.focus(image))))
        c16 = self.stage16(c8)
        deep = self.lateral32(self.stage32(c16))
        middle = self.lateral16(self.merge16(torch.cat((_doubled(deep), c16), 1)))
        p8 = self.merge8(torch.cat((_doubled(middle), c8), 1))
        p16 = self.out16(torch.cat((self.down8(p8), middle), 1))
        p32 = self.out32(torch.cat((self.down16(p16), deep), 1))
        return p8, p16, p32

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Predictions:
        """Predictions for RGB images 0..255 whose sides are multiples of 32."""
        boxes, objectness, classes, features = [], [], [], []
        for level, stride, head in zip(self.maps(image), STRIDES, self.heads):
            box, obj, cls, feature = (part.flatten(2).transpose(1, 2) for part in head(level))
            height, width = level.shape[2:]
            down, across = (torch.arange(side, device=image.device) for side in (height, width))
            y, x = torch.meshgrid(down, across, indexing="ij")
            corner = torch.stack((x, y), -1).flatten(0, 1).to(image.dtype)
            box = box.to(image.dtype)
            centre = (box[..., :2] + corner) * stride
            half = box[..., 2:].clamp(max=8).exp() * (stride / 2)
            boxes.append(torch.cat((centre - half, centre + half), -1))
            objectness.append(obj.squeeze(-1))
            classes.append(cls)
            features.append(feature)
        joined = [torch.cat(part, 1).to(image.dtype) for part in (objectness, classes, features)]
        return Predictions(torch.cat(boxes, 1), *joined)


def _doubled(x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h2 w2"]:
    return nn.functional.interpolate(x, scale_factor=2.0, mode="nearest")
