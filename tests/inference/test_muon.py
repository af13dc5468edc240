"""Muon on hidden matrices beside AdamW: who takes what, the step's direction by singular vectors, AdamW's part as torch's own."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from nolbo_ppl.inference.muon import MuonAdamW, hidden_matrices
from nolbo_ppl.models.layers import OutputLinear
from tests.factories import tiny_model


class Small(nn.Module):
    """One layer of each kind."""

    def __init__(self) -> None:
        super().__init__()
        self.colours = nn.Conv2d(3, 8, 3)
        self.kernel = nn.Conv2d(8, 6, 3)
        self.dense = nn.Linear(12, 5)
        self.norm = nn.LayerNorm(5)
        self.last = OutputLinear(5, 7)
        self.frozen = nn.Linear(5, 5).requires_grad_(False)


def filled(seed: int = 0) -> Small:
    """With gradients drawn at random."""
    torch.manual_seed(seed)
    module = Small()
    for parameter in module.parameters():
        parameter.grad = torch.randn_like(parameter)
    return module


def test_hidden_kernels_and_matrices_go_to_muon() -> None:
    assert set(hidden_matrices(Small())) == {"kernel.weight", "dense.weight"}
    groups = MuonAdamW(Small(), 0.1, 0.5).param_groups
    assert [group["weight_decay"] for group in groups] == [0.5, 0.5, 0.0]
    names = set(hidden_matrices(tiny_model().guide))
    assert any(name.startswith("encoder.deep") for name in names)
    assert not any("objectness" in name or name.endswith("judge.3.weight") for name in names)
    assert "encoder.stem.0.0.weight" not in names


def test_the_first_step_of_a_matrix_is_its_gradients_nearest_orthogonal_matrix() -> None:
    """By an exact singular value decomposition; Muon's iteration leaves singular values between about 0.7 and 1.2."""
    module = filled()
    before = {name: p.detach().clone() for name, p in module.named_parameters()}
    MuonAdamW(module, 0.01, 0.0).step()
    for name in ("kernel.weight", "dense.weight"):
        parameter = module.get_parameter(name)
        step = (before[name] - parameter.detach()).flatten(1).double() / 0.01
        rows, columns = step.shape
        u, _, v = torch.linalg.svd(parameter.grad.flatten(1).double(), full_matrices=False)
        unit = step / (0.2 * math.sqrt(max(rows, columns)))
        inner = torch.diagonal(u.T @ unit @ v.T)
        assert float(inner.min()) > 0.5 and float(inner.max()) < 1.4
        rest = unit - u @ torch.diag(inner) @ v
        assert float(rest.square().sum().sqrt()) < 0.1 * min(rows, columns) ** 0.5


def test_the_rest_takes_the_steps_of_torchs_adamw() -> None:
    module, alone = filled(), filled()
    ours = MuonAdamW(module, 0.01, 0.3)
    vectors = [p for p in alone.parameters() if p.dim() <= 1 and p.requires_grad]
    theirs = torch.optim.AdamW(
        [{"params": [alone.colours.weight, alone.last.weight], "weight_decay": 0.3}, {"params": vectors, "weight_decay": 0.0}],
        lr=0.01,
        betas=(0.9, 0.99),
    )
    for step in range(3):
        for optimizer in (ours, theirs):
            optimizer.step()
        for a, b in zip(module.parameters(), alone.parameters()):
            a.grad = b.grad = torch.randn(a.shape, generator=torch.Generator().manual_seed(step))
    for name in ("colours.weight", "colours.bias", "last.weight", "last.bias", "norm.weight", "kernel.bias"):
        torch.testing.assert_close(module.get_parameter(name), alone.get_parameter(name), rtol=1e-5, atol=1e-7)
    assert not torch.equal(module.kernel.weight, alone.kernel.weight)
    torch.testing.assert_close(module.frozen.weight, alone.frozen.weight, rtol=0, atol=0)


def test_rate_decay_and_pace() -> None:
    """Matrices without a gradient direction only decay; the pace multiplies Muon's rate alone; a closure is called once."""
    module = filled()
    for name in ("kernel.weight", "last.weight"):
        module.get_parameter(name).grad.zero_()
    kernel, last = module.kernel.weight.detach().clone(), module.last.weight.detach().clone()
    optimizer = MuonAdamW(module, 1.0, 0.5, matrix_lr_scale=4.0)
    for group in optimizer.param_groups:
        group["lr"] = 0.01
    calls: list[int] = []
    assert optimizer.step(lambda: float(calls.append(1) or 2.5)) == 2.5
    assert calls == [1]
    torch.testing.assert_close(module.kernel.weight.detach(), kernel * (1 - 0.04 * 0.5))
    torch.testing.assert_close(module.last.weight.detach(), last * (1 - 0.01 * 0.5))


@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
def test_weights_move_in_place_in_any_layout(layout: torch.memory_format) -> None:
    """Kernels are seen as matrices of the same storage, whatever the layout of their memory or of their gradient."""
    module, reference = filled(), filled()
    module.kernel.to(memory_format=layout)
    module.kernel.weight.grad = module.kernel.weight.grad.contiguous(memory_format=torch.channels_last)
    for m in (module, reference):
        MuonAdamW(m, 0.02, 0.1).step()
    torch.testing.assert_close(module.kernel.weight, reference.kernel.weight, rtol=1e-5, atol=1e-7)
    assert not torch.equal(reference.kernel.weight, filled().kernel.weight)
