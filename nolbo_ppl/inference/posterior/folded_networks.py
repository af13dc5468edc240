"""The networks as queries run them: batch normalisations folded into kernels, layouts and precision of the fastest kernels.

Trained networks stay as they are; what stands here is made of their weights once. Kernels run in bfloat16 where the
processor multiplies matrices of it (AMX: the decoder takes a fifth of its time), except the detector's, whose boxes lose
average precision by it; everywhere else in single precision, with results equal to rounding.
"""

from __future__ import annotations

import copy

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nolbo_ppl.models.backbones import ConvUnit, ResidualBlock
from nolbo_ppl.models.guide import Guide
from nolbo_ppl.models.hybrid_guide import HybridGuide
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.shape_networks import VoxelDecoder
from nolbo_ppl.models.yolox import ScaledConv, YoloxNano

Conv = nn.Conv2d | nn.ConvTranspose3d


def kernel_type() -> torch.dtype:
    """bfloat16 on processors with units for matrices of it, else float32 (whose bfloat16 kernels are emulated and slower)."""
    known = getattr(torch.cpu, "_is_amx_tile_supported", None)
    return torch.bfloat16 if known is not None and known() else torch.float32


def folded(kernel: Conv, norm: nn.modules.batchnorm._BatchNorm) -> Conv:
    """One convolution in place of a convolution and the batch normalisation after it, as evaluation runs them."""
    assert norm.running_var is not None and norm.running_mean is not None
    factor = norm.weight * torch.rsqrt(norm.running_var + norm.eps)
    one = copy.deepcopy(kernel)
    axis = 1 if isinstance(kernel, nn.ConvTranspose3d) else 0
    shape = [1] * kernel.weight.dim()
    shape[axis] = -1
    bias = norm.running_mean.new_zeros(()) if kernel.bias is None else kernel.bias
    one.weight = nn.Parameter(kernel.weight * factor.view(shape), requires_grad=False)
    one.bias = nn.Parameter(norm.bias + (bias - norm.running_mean) * factor, requires_grad=False)
    return one


class FoldedEncoder(nn.Module):
    """An image encoder for queries; see the module's docstring. Features come back in single precision."""

    def __init__(self, encoder: nn.Module, dtype: torch.dtype) -> None:
        super().__init__()
        self.stride, self.channels = encoder.stride, encoder.channels
        self.fine_channels, self.fine_strides = encoder.fine_channels, encoder.fine_strides
        self.dtype = dtype
        network = copy.deepcopy(encoder)
        for module in network.modules():
            if isinstance(module, ConvUnit):
                module[0], module[1] = folded(module[0], module[1]), nn.Identity()  # type: ignore[arg-type]
            elif isinstance(module, ResidualBlock):
                module.second = folded(module.second, module.norm)  # type: ignore[assignment]
                module.norm = nn.Identity()  # type: ignore[assignment]
        self.network = network.to(dtype=dtype, memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> tuple[Float[Tensor, "b c gh gw"], tuple[Tensor, ...]]:
        """Features of every cell, and the finer maps."""
        maps, fine = self.network(image.to(self.dtype))
        return maps.to(image.dtype), tuple(one.to(image.dtype) for one in fine)


class FoldedDecoder:
    """The decoder of voxels for queries; see the module's docstring."""

    def __init__(self, decoder: VoxelDecoder, dtype: torch.dtype) -> None:
        self.dtype, self.channels = dtype, decoder.channels
        layers = list(decoder.layers)
        first = layers[0]
        factor = first.weight * torch.rsqrt(first.running_var + first.eps)  # type: ignore[arg-type, operator]
        shift = first.bias - first.running_mean * factor  # type: ignore[operator]
        weight = decoder.dense.weight.view(self.channels, 64, -1) * factor[:, None, None]  # type: ignore[index]
        bias = decoder.dense.bias.view(self.channels, 64) * factor[:, None] + shift[:, None]  # type: ignore[index]
        self.weight = weight.transpose(0, 1).flatten(0, 1).contiguous().to(dtype)  # the channels of a cell lie together
        self.bias = bias.t().flatten().contiguous().to(dtype)
        self.layers: list[nn.Module] = []
        for k, layer in enumerate(layers[1:], start=1):
            if isinstance(layer, nn.ConvTranspose3d):
                following = layers[k + 1] if k + 1 < len(layers) else None
                normed = isinstance(following, nn.BatchNorm3d)
                one = folded(layer, following) if normed else copy.deepcopy(layer)  # type: ignore[arg-type]
                self.layers.append(one.to(dtype=dtype))
            elif not isinstance(layer, nn.BatchNorm3d):
                self.layers.append(copy.deepcopy(layer).to(dtype=dtype))

    def __call__(self, latent: Float[Tensor, "n d"]) -> Float[Tensor, "n v v v"]:
        """Occupancy logits, as `VoxelDecoder` gives them."""
        x = nn.functional.linear(latent.to(self.dtype), self.weight, self.bias)
        x = x.view(-1, 4, 4, 4, self.channels).permute(0, 4, 1, 2, 3)
        for layer in self.layers:
            x = nn.functional.elu(x, inplace=True) if isinstance(layer, nn.ELU) else layer(x)
        return x.squeeze(1).to(latent.dtype)


class PlainConv(nn.Module):
    """A detector's convolution whose kernel and gain are multiplied once."""

    def __init__(self, unit: ScaledConv) -> None:
        super().__init__()
        weight = unit.weight.detach() * unit.gain.detach()[:, None, None, None]
        self.dense = unit.weight.shape[2] == 1
        weight = weight.flatten(1).contiguous() if self.dense else weight.contiguous(memory_format=torch.channels_last)
        self.weight = nn.Parameter(weight, requires_grad=False)
        self.bias = nn.Parameter(unit.bias.detach().clone(), requires_grad=False)
        self.stride, self.padding, self.groups = unit.stride, unit.padding, unit.groups

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d h2 w2"]:
        """The convolution."""
        if self.dense:
            return nn.functional.linear(x.permute(0, 2, 3, 1), self.weight, self.bias).permute(0, 3, 1, 2)
        return nn.functional.conv2d(x, self.weight, self.bias, self.stride, self.padding, 1, self.groups)


def folded_detector(detector: YoloxNano) -> YoloxNano:
    """A detector for queries, in single precision: kernels and gains multiplied."""
    fast = copy.deepcopy(detector)
    for parent in list(fast.modules()):
        for name, child in list(parent.named_children()):
            if isinstance(child, ScaledConv):
                setattr(parent, name, PlainConv(child))
    return fast


def folded_guide(guide: Guide, dtype: torch.dtype) -> Guide:
    """A guide for queries: its own head and fusion, with encoder and detector folded."""
    fast = copy.copy(guide)
    fast._modules = dict(guide._modules)
    fast._modules["encoder"] = FoldedEncoder(guide.encoder, dtype)
    if guide.shape_look is not None:
        look = copy.copy(guide.shape_look)
        look._modules = {**guide.shape_look._modules, "encoder": FoldedEncoder(guide.shape_look.encoder, dtype)}
        fast._modules["shape_look"] = look
    if isinstance(guide, HybridGuide):
        fast._modules["detector"] = folded_detector(guide.detector)
    return fast


class FoldedNetworks:
    """Guide and decoder of a model in evaluation mode for queries, made anew when weights of the model have changed.

    Models in double precision or outside of the CPU are run as they are.

    Example:
        >>> from nolbo_ppl.models.model_config import nano
        >>> model = Nolbo.from_seed(nano(), 0).eval().requires_grad_(False)
        >>> networks = FoldedNetworks(model)
        >>> latent = torch.zeros(1, model.config.latent_dim)
        >>> bool((networks.decoder(latent) - model.story.decoder(latent)).abs().max() < 0.1)
        True
    """

    def __init__(self, model: Nolbo) -> None:
        self.model = model
        self._state: tuple[int, ...] | None = None
        self._guide, self._decoder = model.guide, model.story.decoder

    def __getstate__(self) -> dict[str, object]:
        return {"model": self.model}

    def __setstate__(self, state: dict[str, Nolbo]) -> None:
        self.__init__(state["model"])  # type: ignore[misc]

    @property
    def guide(self) -> Guide:
        """The guide."""
        self._follow()
        return self._guide

    @property
    def decoder(self) -> VoxelDecoder | FoldedDecoder:
        """The decoder of voxels."""
        self._follow()
        return self._decoder

    def _follow(self) -> None:
        """Make the networks, if any weight was written or replaced since they were made."""
        networks = (self.model.guide, self.model.story.decoder)
        parts = [tensor for network in networks for tensor in (*network.parameters(), *network.buffers())]
        if any(one.device.type != "cpu" for one in parts):
            self._state, self._guide, self._decoder = None, self.model.guide, self.model.story.decoder
            return
        state = tuple(hash((one.data_ptr(), 0 if one.is_inference() else one._version)) for one in parts)
        if state == self._state:
            return
        self._state = state
        plain = any(one.is_floating_point() and one.dtype != torch.float32 for one in parts)
        if plain or self.model.training:
            self._guide, self._decoder = self.model.guide, self.model.story.decoder
            return
        with torch.no_grad(), torch.inference_mode(False):
            self._guide = folded_guide(self.model.guide, kernel_type())
            self._decoder = FoldedDecoder(self.model.story.decoder, kernel_type())  # type: ignore[assignment]
