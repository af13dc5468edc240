"""Encoders: darknet19 layer by layer, shapes for any multiple of 32, and what a cell can see."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from nolbo_ppl.models.backbones import Darknet19Encoder, TinyEncoder
from nolbo_ppl.models.guide import Guide
from nolbo_ppl.models.model_config import paper
from nolbo_ppl.models.normalisation import SyncBatchNorm2d
from nolbo_ppl.models.prior import LabelPrior
from nolbo_ppl.models.shape_networks import VoxelDecoder
from tests.factories import tiny_config

YOLO9000_TABLE_6 = [
    32,
    "M",
    64,
    "M",
    128,
    (64,),
    128,
    "M",
    256,
    (128,),
    256,
    "M",
    512,
    (256,),
    512,
    (256,),
    512,
    "M",
    1024,
    (512,),
    1024,
    (512,),
    1024,
]
"""Filters of 3 x 3 convolutions, of 1 x 1 convolutions in brackets, and maxpools."""


def test_darknet19_is_that_of_the_paper() -> None:
    with torch.device("meta"):
        encoder = Darknet19Encoder()
    found: list[object] = []
    inputs = 3
    for layer in encoder.core.modules():
        if isinstance(layer, nn.MaxPool2d):
            assert (layer.kernel_size, layer.stride) == (2, 2)
            found.append("M")
        elif isinstance(layer, nn.Conv2d):
            assert layer.in_channels == inputs
            assert layer.stride == (1, 1)
            assert layer.bias is None
            inputs = layer.out_channels
            found.append(inputs if layer.kernel_size == (3, 3) else (inputs,))
            assert layer.kernel_size in ((1, 1), (3, 3))
    assert found == YOLO9000_TABLE_6
    assert sum(entry != "M" for entry in found) == 18
    neck = [layer for layer in encoder.neck.modules() if isinstance(layer, nn.Conv2d)]
    assert [(c.in_channels, c.out_channels, c.kernel_size) for c in neck] == [(1024, 1024, (3, 3))] * 3
    convolutions = sum(isinstance(layer, nn.Conv2d) for layer in encoder.modules())
    assert sum(isinstance(layer, SyncBatchNorm2d) for layer in encoder.modules()) == convolutions == 21
    assert sum(isinstance(layer, nn.LeakyReLU) and layer.negative_slope == 0.1 for layer in encoder.modules()) == 21


def test_paper_network_size_and_linear_head() -> None:
    """48.4 million parameters in encoder and head; the head is linear, 1 x 1, without bias."""
    with torch.device("meta"):
        config = paper()
        guide = Guide(config, LabelPrior(config))
    count = sum(p.numel() for p in guide.parameters())
    assert count == pytest.approx(48.4e6, rel=0.005)
    assert isinstance(guide.head.outputs, nn.Linear)
    assert guide.head.outputs.bias is None
    assert guide.head.objectness.bias is None
    assert config.predictors == 2
    assert guide.encoder.stride == config.stride == 32


def test_darknet19_takes_any_multiple_of_32() -> None:
    torch.set_default_dtype(torch.float32)
    encoder = Darknet19Encoder().eval()
    with torch.no_grad():
        for height, width in ((32, 32), (64, 32), (96, 64)):
            out, fine = encoder(torch.zeros(1, 3, height, width))
            assert out.shape == (1, 1024, height // 32, width // 32)
            assert fine == ()


def test_paper_decoder_makes_64_cubed() -> None:
    torch.set_default_dtype(torch.float32)
    config = paper()
    assert config.decoder_channels == (512, 256, 128, 64)
    small = tiny_config(voxel_size=64, decoder_channels=(8, 6, 4, 2), voxel_encoder_channels=(4, 4, 4, 8))
    with torch.no_grad():
        assert VoxelDecoder(small).eval()(torch.zeros(2, 4)).shape == (2, 64, 64, 64)
    with torch.device("meta"):
        decoder = VoxelDecoder(config)
    kernels = [layer for layer in decoder.modules() if isinstance(layer, nn.ConvTranspose3d)]
    assert [layer.out_channels for layer in kernels] == [256, 128, 64, 1]
    assert all(layer.kernel_size == (4, 4, 4) and layer.stride == (2, 2, 2) for layer in kernels)
    assert decoder.dense.out_features == 512 * 4**3


@pytest.mark.parametrize("size", [(64, 64), (32, 96), (160, 64)])
def test_tiny_encoder_shapes(size: tuple[int, int]) -> None:
    encoder = TinyEncoder(tiny_config()).eval()
    out, fine = encoder(torch.zeros(2, 3, *size))
    assert out.shape == (2, encoder.channels, size[0] // 16, size[1] // 16)
    for features, channels, stride in zip(fine, encoder.fine_channels, encoder.fine_strides, strict=True):
        assert features.shape == (2, channels, size[0] // stride, size[1] // stride)


def test_a_cell_sees_its_own_surroundings() -> None:
    """The gradient of one cell's features with respect to the image is centred on that cell."""
    encoder = TinyEncoder(tiny_config()).eval()
    image = torch.randn(1, 3, 160, 160, requires_grad=True)
    encoder(image)[0][0, :, 7, 2].sum().backward()
    seen = image.grad.abs().sum((0, 1))
    y, x = (torch.arange(160) + 0.5)[:, None], (torch.arange(160) + 0.5)[None]
    centre = (seen * y).sum() / seen.sum(), (seen * x).sum() / seen.sum()
    assert float(centre[0]) == pytest.approx(7.5 * 16, abs=8)
    assert float(centre[1]) == pytest.approx(2.5 * 16, abs=8)
    assert float(seen[:40].sum()) == 0
