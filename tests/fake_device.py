"""A device that every machine has and that refuses what a GPU refuses: tensors of two devices in one operation.

`Held` tensors say that they lie on `meta`, torch's device without memory, and hold their numbers on the CPU: every operation
computes, none may mix them with a tensor of the CPU (numbers, tensors without dimensions, may go along as on CUDA). Within
`fake_device()` a tensor that the library makes without saying where is refused too, whatever is done with it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map

import nolbo_ppl

PACKAGE = str(Path(nolbo_ppl.__file__).parent)
FAKE = torch.device("meta")
aten = torch.ops.aten
MOVES = {aten._to_copy.default, aten.copy_.default}
FACTORIES = {
    getattr(torch, name)
    for name in (
        "zeros",
        "ones",
        "empty",
        "full",
        "arange",
        "linspace",
        "eye",
        "rand",
        "randn",
        "randint",
        "randperm",
        "tensor",
        "as_tensor",
    )
}


class ImplicitDevice(AssertionError):
    """A tensor made on the default device, or one of the CPU among those of the device."""


class Held(torch.Tensor):
    """A tensor of the fake device."""

    __torch_function__ = torch._C._disabled_torch_function_impl
    numbers: torch.Tensor

    @staticmethod
    def __new__(cls, real: torch.Tensor) -> Held:
        made = torch.Tensor._make_wrapper_subclass(
            cls, real.size(), strides=real.stride(), storage_offset=real.storage_offset(), dtype=real.dtype, device=FAKE
        )
        made.numbers = real
        return made

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _compute(func, args, kwargs or {})


def _plain() -> AbstractContextManager[Any]:
    """Out of inference mode, whose tensors have no versions, which wrappers need."""
    return torch.inference_mode(False) if torch.is_inference_mode_enabled() else nullcontext()


def _compute(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    leaves = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
    held = [leaf for leaf in leaves if isinstance(leaf, Held)]
    strangers = [leaf for leaf in leaves if not isinstance(leaf, Held) and leaf.dim() > 0]
    if held and strangers and func not in MOVES:
        raise ImplicitDevice(f"{func} of tensors on {FAKE} and on the CPU, {tuple(strangers[0].shape)}")
    device = kwargs.get("device")
    inside = bool(held) if device is None else torch.device(device) == FAKE
    if func is aten.copy_.default:
        inside = isinstance(args[0], Held)
    real_args, real_kwargs = tree_map(lambda v: v.numbers if isinstance(v, Held) else v, (args, kwargs))
    if device is not None:
        real_kwargs = {**real_kwargs, "device": torch.device("cpu")}
    with _plain():
        result = func(*real_args, **real_kwargs)
    if func is aten.copy_.default:
        return args[0]
    if not inside:
        return result
    with _plain():
        wrapped = tree_map(lambda v: Held(v) if isinstance(v, torch.Tensor) else v, result)
        return return_and_correct_aliasing(func, args, kwargs, wrapped) if held else wrapped


class _Dispatch(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _compute(func, args, kwargs or {})


class _Functions(TorchFunctionMode):
    """Refuses factories of the library that do not say where; makes constants on the fake device as others make them."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func is torch.Tensor.tolist and isinstance(args[0], Held):
            return args[0].numbers.tolist()
        named = kwargs.get("device")
        if func in FACTORIES and named is None and not (args and isinstance(args[0], torch.Tensor | np.ndarray)):
            frame = sys._getframe(1)
            if frame.f_code.co_filename.startswith(PACKAGE):
                place = f"{frame.f_code.co_filename.removeprefix(PACKAGE)}:{frame.f_lineno}"
                raise ImplicitDevice(f"{func.__name__} without a device in {place}")
        constant = func in (torch.tensor, torch.as_tensor) and named is not None and torch.device(named) == FAKE
        if func is torch.Tensor.new_tensor and isinstance(args[0], Held):
            kwargs.setdefault("dtype", args[0].dtype)
            func, args, constant = torch.tensor, args[1:], True
        if constant and not (func is torch.as_tensor and isinstance(args[0], Held)):
            kwargs["device"] = "cpu"
            return Held(func(*args, **kwargs))
        return func(*args, **kwargs)


@contextmanager
def fake_device() -> Iterator[torch.device]:
    """The device, and the refusals for as long as the block lasts."""
    with _Functions(), _Dispatch():
        yield FAKE
