"""Checkpoints: tensors as safetensors, the rest as JSON inside the same file; written atomically, exact on resume."""

from __future__ import annotations

import json
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from nolbo_ppl.errors import input_error
from nolbo_ppl.io.files import atomic_path


def save_tensors(path: str | PathLike[str], tensors: Mapping[str, Tensor], meta: Mapping[str, Any]) -> None:
    """Write tensors and a JSON-able `meta` into one safetensors file, atomically."""
    with atomic_path(path) as temporary:
        contiguous = {name: tensor.detach().contiguous() for name, tensor in tensors.items()}
        save_file(contiguous, temporary, metadata={"meta": json.dumps(meta)})
        temporary.chmod(0o644)  # safetensors lets nobody but the owner read: weights of a package are for all users


def load_tensors(path: str | PathLike[str]) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what `save_tensors` wrote.

    Raises:
        InputError: the file is missing, damaged or not of this library; names the file.
    """
    path = Path(path)
    if not path.is_file():
        raise input_error("no such file", file=path)
    try:
        with safe_open(path, framework="pt") as file:
            meta = json.loads((file.metadata() or {}).get("meta", "{}"))
            return {name: file.get_tensor(name) for name in file.keys()}, meta  # noqa: SIM118 - not a dictionary
    except (SafetensorError, ValueError) as error:
        raise input_error("not a readable safetensors file", got=error, file=path, do="is it truncated?") from None


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
    """Put back what `optimizer_tensors` gave, bit for bit."""
    for name, tensor in tensors.items():
        parameter, key = name.rsplit("/", 1)
        optimizer.state[parameters[parameter]][key] = tensor.clone()


def load_strictly(module: torch.nn.Module, tensors: Mapping[str, Tensor], file: str | PathLike[str]) -> None:
    """Load a state dictionary whose names and shapes must all fit.

    Raises:
        InputError: a tensor is missing, unknown, of another shape, or holds NaN or infinity; names it and the file.
    """
    own = module.state_dict()
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
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise input_error(f"weight {name}", got="NaN or infinity", expected="finite numbers", file=file)
    module.load_state_dict({name: tensor.to(own[name].dtype) for name, tensor in tensors.items()})
