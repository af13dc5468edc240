"""The networks as queries run them: batch normalisations folded into kernels, layouts and precision of the fastest kernels.

Trained networks stay as they are; what stands here is made of their weights once. Kernels run in bfloat16 where the
processor multiplies matrices of it (AMX: the decoder takes a fifth of its time), except the detector's, whose boxes lose
average precision by it; everywhere else in single precision, with results equal to rounding.
"""

from __future__ import annotations

import copy
import operator
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nolbo_ppl.inference.posterior.grid_doubling import SIDE, GridDoubling
from nolbo_ppl.models.backbones import ConvUnit, ResidualBlock
from nolbo_ppl.models.guide import Guide
from nolbo_ppl.models.hybrid_guide import HybridGuide
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.shape_networks import PatchWriter, VoxelDecoder
from nolbo_ppl.models.yolox import ScaledConv, Unit, YoloxNano

Conv = nn.Conv2d | nn.ConvTranspose3d
AT_ONCE = 18
"""Shapes decoded at once, so that what lies between layers stays in the cache."""
CACHED = 1 << 16
"""Numbers that go through a few steps one after the other before the next ones do: they fit a core's own cache."""

KEPT_MEMORY = 31 << 20
"""Bytes of a block that is asked for once and freed, for what it does to glibc's allocator: arrays up to this size are kept for
the next query in place of given back to the system, whose fresh pages cost a query up to 6 ms."""


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
    """The decoder of voxels for queries; see the module's docstring. In single precision the channels of a cell lie together."""

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
        single, side = dtype == torch.float32, 4
        form = torch.channels_last_3d if single else torch.contiguous_format
        self.layers: list[Callable[[Tensor], Tensor]] = []
        for k, layer in enumerate(layers[1:], start=1):
            if isinstance(layer, nn.ConvTranspose3d):
                following = layers[k + 1] if k + 1 < len(layers) else None
                normed = isinstance(following, nn.BatchNorm3d)
                one = folded(layer, following) if normed else copy.deepcopy(layer)  # type: ignore[arg-type]
                if single and side <= SIDE:
                    self.layers.append(GridDoubling(one))  # type: ignore[arg-type]
                else:
                    self.layers.append(_with_channels_last(one.to(dtype=dtype, memory_format=form)))  # type: ignore[call-overload]
                side *= 2
            elif isinstance(layer, PatchWriter):
                self.layers.append(partial(written_patches, copy.deepcopy(layer.linear).to(dtype=dtype)))
            elif isinstance(layer, nn.ELU):
                self.layers.append(exponential_unit if single else partial(nn.functional.elu, inplace=True))

    def __call__(self, latent: Float[Tensor, "n d"]) -> Float[Tensor, "n v v v"]:
        """Occupancy logits, as `VoxelDecoder` gives them."""
        parts = [self._decoded(part) for part in latent.split(AT_ONCE)]
        return parts[0] if len(parts) == 1 else torch.cat(parts)

    def _decoded(self, latent: Float[Tensor, "n d"]) -> Float[Tensor, "n v v v"]:
        x = nn.functional.linear(latent.to(self.dtype), self.weight, self.bias).view(-1, 4, 4, 4, self.channels)
        for layer in self.layers:
            x = layer(x)
        return x.squeeze(-1).to(latent.dtype)


def _with_channels_last(layer: nn.Module) -> Callable[[Float[Tensor, "n v v v c"]], Float[Tensor, "n w w w d"]]:
    return lambda x: layer(x.movedim(-1, 1)).movedim(1, -1)


def exponential_unit(x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """ELU in place: max(x, exp(min(x, 0)) - 1), sooner than by torch's own, which keeps more digits about zero."""
    for part in x.flatten().split(CACHED):
        torch.maximum(part, part.clamp_max(0).exp_().sub_(1), out=part)
    return x


def written_patches(linear: nn.Linear, x: Float[Tensor, "n v v v c"]) -> Float[Tensor, "n w w w 1"]:
    """What `PatchWriter` makes of a grid; the two voxels that stay neighbours are moved as one number."""
    n, v = x.shape[:2]
    cells = linear(x)
    pairs = cells.view(torch.int64 if cells.element_size() == 4 else torch.int32).view(n, v, v, v, 2, 2)  # n x y z a b
    return pairs.permute(0, 1, 4, 2, 5, 3).contiguous().view(cells.dtype).view(n, 2 * v, 2 * v, 2 * v, 1)


class PlainConv(nn.Module):
    """A detector's convolution whose kernel and gain are multiplied once, and the SiLU after it, if there is one."""

    def __init__(self, unit: ScaledConv, silu: bool = False) -> None:
        super().__init__()
        weight = unit.weight.detach() * unit.gain.detach()[:, None, None, None]
        self.dense, self.silu = unit.weight.shape[2] == 1, silu
        weight = weight.flatten(1).contiguous() if self.dense else weight.contiguous(memory_format=torch.channels_last)
        self.weight = nn.Parameter(weight, requires_grad=False)
        self.bias = nn.Parameter(unit.bias.detach().clone(), requires_grad=False)
        self.stride, self.padding, self.groups = unit.stride, unit.padding, unit.groups

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d h2 w2"]:
        """The convolution."""
        if self.dense:
            x = nn.functional.linear(x.permute(0, 2, 3, 1), self.weight, self.bias).permute(0, 3, 1, 2)
        else:
            x = nn.functional.conv2d(x, self.weight, self.bias, self.stride, self.padding, 1, self.groups)
        return nn.functional.silu(x, inplace=True) if self.silu else x


def folded_detector(detector: YoloxNano) -> YoloxNano:
    """A detector for queries, in single precision: kernels and gains multiplied, its first two steps in one."""
    fast = copy.deepcopy(detector)
    for parent in list(fast.modules()):
        for name, child in list(parent.named_children()):
            if isinstance(child, Unit):
                setattr(parent, name, PlainConv(child[0], silu=True))  # type: ignore[arg-type]
            elif isinstance(child, ScaledConv):
                setattr(parent, name, PlainConv(child))
    # A 3 x 3 kernel over 2 x 2 blocks is one of 6 x 6 over pixels, two at a step; `Focus` goes through blocks column by column.
    stem: PlainConv = fast.stem  # type: ignore[assignment]
    kernel = stem.weight.unflatten(1, (2, 2, 3)).permute(0, 3, 4, 2, 5, 1).flatten(4, 5).flatten(2, 3)  # d c y x of d x y c y x
    stem.weight = nn.Parameter(kernel.contiguous(memory_format=torch.channels_last), requires_grad=False)
    stem.stride, stem.padding, fast.focus = 2, 2, nn.Identity()
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
        scene = copy.copy(guide.scene)
        scene._modules = {**guide.scene._modules, "encoder": FoldedEncoder(guide.scene.encoder, dtype)}
        fast._modules["scene"] = scene
    return fast


class NetworksOfQueries(NamedTuple):
    """What a query runs."""

    guide: Guide
    decoder: VoxelDecoder | FoldedDecoder


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
        self._tensors: list[Tensor] = []
        self._places: list[tuple[int, int]] = []
        self._training = model.training
        self._guide, self._decoder = model.guide, model.story.decoder

    def __getstate__(self) -> dict[str, object]:
        return {"model": self.model}

    def __setstate__(self, state: dict[str, Nolbo]) -> None:
        self.__init__(state["model"])  # type: ignore[misc]

    def current(self) -> NetworksOfQueries:
        """Both networks with the weights that the model has now."""
        self._follow()
        return NetworksOfQueries(self._guide, self._decoder)

    @property
    def guide(self) -> Guide:
        """The guide."""
        return self.current().guide

    @property
    def decoder(self) -> VoxelDecoder | FoldedDecoder:
        """The decoder of voxels."""
        return self.current().decoder

    def _follow(self) -> None:
        """Make the networks, if any weight was written, replaced or moved since they were made."""
        own, decoder = self.model.guide, self.model.story.decoder
        tensors = tensors_of(own, decoder)
        places = [(one.data_ptr(), 0 if one.is_inference() else one._version) for one in tensors]
        known = len(tensors) == len(self._tensors) and all(map(operator.is_, tensors, self._tensors))
        if known and places == self._places and self.model.training == self._training:
            return
        self._tensors, self._places, self._training = tensors, places, self.model.training
        plain = any(one.device.type != "cpu" or (one.is_floating_point() and one.dtype != torch.float32) for one in tensors)
        if plain or self.model.training:
            self._guide, self._decoder = own, decoder
            return
        torch.empty(KEPT_MEMORY, dtype=torch.uint8, device="cpu")  # freed at once
        with torch.no_grad(), torch.inference_mode(False):
            self._guide = folded_guide(own, kernel_type())
            self._decoder = FoldedDecoder(decoder, kernel_type())  # type: ignore[assignment]


def tensors_of(*networks: nn.Module) -> list[Tensor]:
    """All parameters and buffers. With the names and sets that torch makes on the way, a query of photographs took 2 ms."""
    found: list[Tensor] = []
    modules: list[nn.Module | None] = [*networks]
    while modules:
        module = modules.pop()
        if module is not None:
            found += [one for one in (*module._parameters.values(), *module._buffers.values()) if one is not None]
            modules += module._modules.values()
    return found
