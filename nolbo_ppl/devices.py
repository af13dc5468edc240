"""Where tensors live: the names of `--device`, mixed precision by the kind of device, batches on their way to it."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from typing import Any, TypeVar

import torch
from torch import Tensor

from nolbo_ppl.errors import input_error

T = TypeVar("T")
NAMES = "auto, cpu, cuda, cuda:N or mps"
WITHOUT_AUTOCAST = frozenset({"meta"})
"""Kinds of devices that torch has no mixed precision for."""


def device_of(name: str | torch.device = "auto") -> torch.device:
    """The device of a name: `auto` is a CUDA device where there is one, else Apple's (`mps`), else the CPU.

    Under `torchrun`, `auto` and `cuda` are the CUDA device of this process's `LOCAL_RANK`.

    Raises:
        InputError: no such name, or no such device here.

    Example:
        >>> device_of("cpu")
        device(type='cpu')
    """
    if isinstance(name, torch.device):
        return name
    cuda = torch.cuda.device_count() if torch.cuda.is_available() else 0
    apple = torch.backends.mps.is_available()
    if name == "auto":
        name = "cuda" if cuda else "mps" if apple else "cpu"
    kind, colon, number = name.partition(":")
    if kind not in ("cpu", "cuda", "mps") or (colon and not (kind == "cuda" and number.isdecimal())):
        raise input_error("device", got=repr(name), expected=NAMES)
    if kind == "mps" and not apple:
        raise input_error("device", got=name, expected="a device of this machine", do="use --device cpu")
    if kind == "cuda":
        index = int(number) if number else int(os.environ.get("LOCAL_RANK", "0")) % max(cuda, 1)
        if index >= cuda:
            got = f"{name}, of {cuda} CUDA devices"
            raise input_error("device", got=got, expected="a device of this machine", do="use --device cpu")
        return torch.device("cuda", index)
    return torch.device(kind)


def mixed_precision(device: torch.device, enabled: bool) -> AbstractContextManager[Any]:
    """Convolutions and matrix products in bfloat16 on a device, where that is wanted.

    bfloat16 on every kind of device: float16 is as fast on GPUs, but its narrow range would need the loss to be scaled, and the
    voxels' thousands of nats are what overflows it.
    """
    if device.type in WITHOUT_AUTOCAST:
        return nullcontext()
    return torch.autocast(device.type, torch.bfloat16, enabled=enabled)


def placed(value: T, device: torch.device, non_blocking: bool = False) -> T:
    """A copy of a dataclass of tensors with every tensor on a device; what lies there already is shared."""
    changes: dict[str, Any] = {}
    for field in dataclasses.fields(value):  # type: ignore[arg-type]
        one = getattr(value, field.name)
        if isinstance(one, Tensor):
            changes[field.name] = one.to(device, non_blocking=non_blocking)
        elif isinstance(one, tuple) and one and all(isinstance(part, Tensor) for part in one):
            changes[field.name] = tuple(part.to(device, non_blocking=non_blocking) for part in one)
        elif dataclasses.is_dataclass(one) and not isinstance(one, type):
            changes[field.name] = placed(one, device, non_blocking)
    return dataclasses.replace(value, **changes)  # type: ignore[type-var]


def pinned(value: T, device: torch.device) -> T:
    """A copy in page-locked memory, from which a CUDA device copies while it computes; the value itself for other devices."""
    if device.type != "cuda":
        return value
    fields = dataclasses.fields(value)  # type: ignore[arg-type]
    tensors = {field.name: getattr(value, field.name) for field in fields}
    changes = {name: one.pin_memory() for name, one in tensors.items() if isinstance(one, Tensor)}
    return dataclasses.replace(value, **changes)  # type: ignore[type-var]


def each_pinned(batches: Iterator[T], device: torch.device) -> Iterator[T]:
    """Batches in page-locked memory; run on the thread that prepares them."""
    for batch in batches:
        yield pinned(batch, device)


def peak_memory(device: torch.device) -> int | None:
    """Most memory, bytes, that tensors held on a CUDA device since `torch.cuda.reset_peak_memory_stats`; None on others."""
    return torch.cuda.max_memory_allocated(device) if device.type == "cuda" else None


def synchronise(device: torch.device) -> None:
    """Wait until a device has done everything it was given: before a time is taken."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    elif device.type == "mps":
        torch.mps.synchronize()
