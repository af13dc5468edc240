"""Files of tensors: round trips, and files that are damaged or of another model."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from torch import nn

from nolbo_ppl.errors import InputError
from nolbo_ppl.io.tensors import (
    load_strictly,
    load_tensors,
    optimizer_tensors,
    restore_optimizer,
    save_tensors,
)


def test_round_trip(tmp_path: Path) -> None:
    tensors = {"a": torch.randn(3, 4).T, "b": torch.tensor(7), "c": torch.zeros(0, 2), "d": torch.randn(2).bfloat16()}
    meta = {"step": 3, "names": ["x"], "nested": {"rate": 0.1}}
    save_tensors(tmp_path / "deep" / "x.safetensors", tensors, meta)
    found, again = load_tensors(tmp_path / "deep" / "x.safetensors")
    assert again == meta
    assert set(found) == set(tensors)
    for name, value in tensors.items():
        assert torch.equal(found[name], value)
        assert found[name].dtype == value.dtype
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["x.safetensors"], "no temporary file is left"


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "x.safetensors"
    save_tensors(path, {"a": torch.ones(2)}, {})
    with pytest.raises(TypeError):
        save_tensors(path, {"a": torch.zeros(2)}, {"bad": object()})
    assert torch.equal(load_tensors(path)[0]["a"], torch.ones(2))
    assert len(list(tmp_path.iterdir())) == 1


def test_missing_and_damaged_files(tmp_path: Path) -> None:
    path = tmp_path / "x.safetensors"
    with pytest.raises(InputError, match=r"x.safetensors: no such file"):
        load_tensors(path)
    save_tensors(path, {"a": torch.ones(100)}, {})
    whole = path.read_bytes()
    for damaged in (whole[:-50], whole[:20], b"", b"not a tensor file at all", b"\xff" * 64):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"x.safetensors: not a readable safetensors file.*truncated"):
            load_tensors(path)


def test_strict_loading(tmp_path: Path) -> None:
    module = nn.Linear(2, 3)
    good = {name: torch.full_like(value, 2.0) for name, value in module.state_dict().items()}
    load_strictly(module, good, "w.safetensors")
    assert bool((module.weight == 2).all())
    cases = [
        ({"weight": good["weight"]}, r"w.safetensors: weights do not fit.*missing \['bias'\]"),
        ({**good, "extra": torch.ones(1)}, r"unknown \['extra'\]"),
        ({**good, "bias": torch.ones(4)}, r"weight bias: got \(4,\), expected shape \(3,\)"),
        ({**good, "bias": torch.tensor([1.0, math.nan, 0.0])}, "weight bias: got NaN or infinity"),
        ({**good, "bias": torch.tensor([1.0, math.inf, 0.0])}, "weight bias: got NaN or infinity"),
    ]
    for tensors, message in cases:
        with pytest.raises(InputError, match=message):
            load_strictly(module, tensors, "w.safetensors")
    assert bool((module.bias == 2).all()), "a refused file changes nothing"


def test_optimiser_state_round_trip() -> None:
    def fresh() -> tuple[nn.Linear, torch.optim.Optimizer]:
        torch.manual_seed(0)
        module = nn.Linear(2, 2)
        return module, torch.optim.AdamW(module.parameters(), lr=0.1)

    module, optimiser = fresh()
    for _ in range(3):
        optimiser.zero_grad()
        module(torch.ones(2)).square().sum().backward()
        optimiser.step()
    tensors = optimizer_tensors(optimiser, {id(p): name for name, p in module.named_parameters()})
    assert set(tensors) == {f"{p}/{key}" for p in ("weight", "bias") for key in ("step", "exp_avg", "exp_avg_sq")}
    other, again = fresh()
    restore_optimizer(again, tensors, dict(other.named_parameters()))
    for p, q in zip(module.parameters(), other.parameters(), strict=True):
        for key, value in optimiser.state[p].items():
            assert torch.equal(again.state[q][key], value)
