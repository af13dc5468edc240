"""Checkpoints: tensors as safetensors, the rest as JSON inside the same file; written atomically, exact on resume."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from os import PathLike
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from nolbo_ppl.errors import InputError, input_error
from nolbo_ppl.io.files import atomic_path, existing_file, reading


def save_tensors(path: str | PathLike[str], tensors: Mapping[str, Tensor], meta: Mapping[str, Any]) -> None:
    """Write tensors and a JSON-able `meta` into one safetensors file, atomically. Raises `OSError` when it cannot be written."""
    with atomic_path(path) as temporary:
        contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
        try:
            save_file(contiguous, temporary, metadata={"meta": json.dumps(meta)})
        except SafetensorError as error:  # a full disk
            raise OSError(None, str(error), str(path)) from None
        temporary.chmod(0o644)  # safetensors lets nobody but the owner read: weights of a package are for all users


def load_tensors(path: str | PathLike[str]) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what `save_tensors` wrote.

    Raises:
        InputError: the file is missing, damaged or not of this library; names the file.
    """
    path = existing_file(path)
    try:
        with reading(path), safe_open(path, framework="pt") as file:
            meta = json.loads((file.metadata() or {}).get("meta", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a dictionary
    except (SafetensorError, ValueError, TypeError, RuntimeError) as error:
        if isinstance(error, InputError):
            raise
        raise input_error("not a readable safetensors file", got=error, file=path, do="is it truncated?") from None
    if not isinstance(meta, dict):
        raise input_error("metadata of the tensors", got=type(meta).__name__, expected="an object", file=path)
    return tensors, meta


def file_hash(path: str | PathLike[str]) -> str:
    """SHA-256 of a file's content, hexadecimal. Raises `InputError` when it cannot be read."""
    path = existing_file(path)
    with reading(path), path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def optimizer_tensors(optimizer: torch.optim.Optimizer, names: Mapping[int, str]) -> dict[str, Tensor]:
    """State of an optimiser as named tensors: `NAME/KEY` by parameter name.

    Args:
        optimizer: any optimiser whose state holds tensors only (Adam and its kin).
        names: name of each parameter by its `id`.
    """
    found = {}
    for parameter, state in optimizer.state.items():
        for key, value in state.items():
            found[f"{names[id(parameter)]}/{key}"] = torch.as_tensor(value)
    return found


def restore_optimizer(optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor], parameters: Mapping[str, Tensor]) -> None:
    """Put back what `optimizer_tensors` gave, bit for bit.

    Raises:
        InputError: a parameter nobody knows, or values that do not fit it; names it.
    """
    fused = bool(optimizer.param_groups) and any(group.get("fused") for group in optimizer.param_groups)
    for name, tensor in tensors.items():
        parameter, _, key = name.rpartition("/")
        if parameter not in parameters:
            raise input_error("state of the optimiser", got=name, expected="NAME/KEY of a parameter")
        if tensor.numel() not in (1, parameters[parameter].numel()):
            expected = tuple(parameters[parameter].shape)
            raise input_error(f"state {name} of the optimiser", got=tuple(tensor.shape), expected=expected)
        device = tensor.device if key == "step" and not fused else parameters[parameter].device
        optimizer.state[parameters[parameter]][key] = tensor.to(device, copy=True)


def check_tensors(own: Mapping[str, Tensor], tensors: Mapping[str, Tensor], file: str | PathLike[str]) -> None:
    """Compare tensors of a file with those they are to replace: names, shapes, kinds of numbers, and that all are finite.

    Raises:
        InputError: a tensor is missing, unknown, of another shape or kind, or holds NaN or infinity; names it and the file.
    """
    missing, unknown = sorted(set(own) - set(tensors)), sorted(set(tensors) - set(own))
    if missing or unknown:
        raise input_error(
            "weights do not fit the model",
            got=f"missing {missing[:3]}, unknown {unknown[:3]}",
            expected="the tensors of this configuration",
            file=file,
        )
    for name, tensor in tensors.items():
        if tensor.shape != own[name].shape:
            raise input_error(f"weight {name}", got=tuple(tensor.shape), expected=f"shape {tuple(own[name].shape)}", file=file)
        if _kind(tensor) != _kind(own[name]):
            raise input_error(f"weight {name}", got=tensor.dtype, expected=_kind(own[name]), file=file)
        if tensor.is_floating_point() and not tensor.is_meta and not bool(torch.isfinite(tensor.to(own[name].dtype)).all()):
            raise input_error(f"weight {name}", got="NaN or infinity", expected="finite numbers", file=file)


def _kind(tensor: Tensor) -> str:
    """Floating point numbers of 16 bits and more may stand for each other; whole numbers may not stand for them."""
    if tensor.is_floating_point():
        return "floating point numbers" if tensor.element_size() > 1 else str(tensor.dtype)
    return "truth values" if tensor.dtype == torch.bool else "complex numbers" if tensor.is_complex() else "whole numbers"


def load_strictly(module: torch.nn.Module, tensors: Mapping[str, Tensor], file: str | PathLike[str]) -> None:
    """Load a state dictionary whose names, shapes and kinds of numbers must all fit.

    Raises:
        InputError: as `check_tensors`.
    """
    own = module.state_dict()
    check_tensors(own, tensors, file)
    module.load_state_dict({name: tensor.to(own[name].dtype) for name, tensor in tensors.items()})
