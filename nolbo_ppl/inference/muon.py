"""Muon for kernels and matrices, AdamW for everything else, as one optimiser.

Muon (K. Jordan et al., 2024) turns the momentum of each hidden matrix into its nearest semi-orthogonal matrix, so that
all directions learn at one pace; `torch.optim.Muon` takes matrices only, so kernels are handed to it as matrices of one
row per output channel. Its steps have the root mean square of AdamW's (Liu et al., 2025), so that both share a rate.
Layers of the guide whose outputs are parameters of distributions (`OutputLinear`) and kernels over the image's own colours
keep AdamW.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import nn

from nolbo_ppl.models.layers import OutputLinear

COLOURS = 3
"""Kernels over at most this many channels read the image itself."""
FUSED = ("cpu", "cuda", "mps", "xpu")
"""Kinds of devices that have a step of AdamW in one kernel."""


def hidden_matrices(module: nn.Module) -> dict[str, nn.Parameter]:
    """The trainable kernels and matrices of hidden layers, by name: those that Muon takes."""
    outputs = {id(layer.weight) for layer in module.modules() if isinstance(layer, OutputLinear)}
    return {
        name: parameter
        for name, parameter in module.named_parameters()
        if parameter.requires_grad and parameter.dim() > 1 and parameter.shape[1] > COLOURS and id(parameter) not in outputs
    }


def adamw(parameters: Iterable[nn.Parameter], lr: float, weight_decay: float) -> torch.optim.AdamW:
    """AdamW whose weight decay spares vectors: biases and norms."""
    known = list(parameters)
    groups: list[dict[str, Any]] = [
        {"params": [p for p in known if p.dim() > 1], "weight_decay": weight_decay},
        {"params": [p for p in known if p.dim() <= 1], "weight_decay": 0.0},
    ]
    fused = all(parameter.device.type in FUSED for parameter in known)
    return torch.optim.AdamW([group for group in groups if group["params"]], lr=lr, betas=(0.9, 0.99), fused=fused)


class MuonAdamW(torch.optim.Optimizer):
    """Muon on the hidden matrices of a module, AdamW on its other trainable parameters.

    Groups, as `torch.optim` has them: Muon's matrices, AdamW's other matrices, vectors (no weight decay).

    Args:
        module: what is trained; parameters that require no gradient are left out.
        lr: rate of both.
        weight_decay: decoupled, of matrices and kernels.
        matrix_lr_scale: rate of Muon's matrices over that of the others.
    """

    def __init__(self, module: nn.Module, lr: float, weight_decay: float, matrix_lr_scale: float = 1.0) -> None:
        hidden = list(hidden_matrices(module).values())
        taken = {id(p) for p in hidden}
        others = [p for p in module.parameters() if p.requires_grad and id(p) not in taken]
        rest = [adamw(others, lr, weight_decay)] if others else []
        groups: list[dict[str, Any]] = [{"params": hidden, "weight_decay": weight_decay}] if hidden else []
        for part in rest:
            groups += [{name: group[name] for name in ("params", "weight_decay")} for group in part.param_groups]
        super().__init__(groups, {"lr": lr})
        self.matrix_lr_scale = matrix_lr_scale
        self._hidden = hidden
        self._flat = [nn.Parameter(p.detach().flatten(1).clone()) for p in hidden]
        self._parts: list[torch.optim.Optimizer] = []
        if hidden:
            self._parts.append(torch.optim.Muon(self._flat, lr=lr, weight_decay=weight_decay, adjust_lr_fn="match_rms_adamw"))
            for p, flat in zip(hidden, self._flat):
                self.state[p] = self._parts[0].state[flat]
        for part in rest:
            self._parts.append(part)
            for p in others:
                self.state[p] = part.state[p]

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """One step of both, at the rates of the groups."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        rate = self.param_groups[0]["lr"]
        for p, flat in zip(self._hidden, self._flat):
            flat.copy_(p.flatten(1))
            flat.grad = None if p.grad is None else p.grad.flatten(1)
        for part in self._parts:
            muon = isinstance(part, torch.optim.Muon)
            for group in part.param_groups:
                group["lr"] = rate * self.matrix_lr_scale if muon else rate
            part.step()
        for p, flat in zip(self._hidden, self._flat):
            p.copy_(flat.view_as(p))
        return loss
