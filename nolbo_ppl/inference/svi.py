"""Stochastic variational inference as `init -> state` and `step(state, batch) -> (state, info)`.

One optimiser step of the weighted bound, with a learning-rate schedule, gradient clipping, and an exponential moving
average of the weights that evaluation and export use. The step goes through the Pyro traces of story and guide
(`SceneElbo`), and through torch's distributed wrapper when there are several processes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import torch
import torch.distributed as distributed
from torch import Tensor, nn

from nolbo_ppl._moved import renamed
from nolbo_ppl.errors import NolboError
from nolbo_ppl.inference.elbo import ElboResult
from nolbo_ppl.inference.muon import MuonAdamW, adamw
from nolbo_ppl.io.tensors import optimizer_tensors, restore_optimizer


@dataclass(frozen=True)
class OptimizerConfig:
    """Optimiser and schedule of one stage."""

    steps: int = 1000
    """Optimiser steps."""
    learning_rate: float = 2.5e-3
    """Rate after the warm-up."""
    start_rate: float = 1e-5
    """Rate the warm-up starts from: it grows linearly to `learning_rate`, which its last step reaches."""
    warmup: int = 100
    """Steps of warm-up."""
    hold: int = 0
    """Steps at `start_rate` before the warm-up."""
    decay: float = 0.5
    """Share of the steps, at the end, over which the rate falls to 2 % along a cosine."""
    weight_decay: float = 0.01
    """Decoupled weight decay of matrices and kernels (none on biases and norms)."""
    clip: float = 50.0
    """Largest gradient norm; larger gradients are scaled down."""
    ema: float = 0.998
    """Decay of the moving average of the weights."""
    optimizer: Literal["muon", "adamw"] = "adamw"
    """AdamW, or Muon on hidden kernels and matrices with AdamW on all else (`nolbo_ppl.inference.muon`)."""
    matrix_lr_scale: float = 4.0
    """Rate of Muon's matrices over `learning_rate`."""


@dataclass
class OptimizerState:
    """Everything a step changes."""

    module: nn.Module
    """The module whose parameters are trained."""
    loss: Callable[..., ElboResult]
    """What is called with a batch: a `SceneLoss`, or a distributed wrapper of one."""
    optimizer: torch.optim.Optimizer
    config: OptimizerConfig
    average: dict[str, Tensor]
    """Moving average of the module's state, by name."""
    step: int = 0


@dataclass
class StepInfo:
    """What a step reports."""

    step: int
    loss: float
    """Weighted loss in nats a scene."""
    gradient_norm: float
    """Before clipping."""
    learning_rate: float
    terms: dict[str, float] = field(default_factory=dict)
    """Weighted terms' own values, nats summed over the batch."""


def learning_rate(config: OptimizerConfig, step: int) -> float:
    """Rate of a step (from 0): held at the start, linear warm-up, plateau, cosine to 2 % at the end."""
    if step < config.hold:
        return config.start_rate
    if step < config.hold + config.warmup:
        return config.start_rate + (config.learning_rate - config.start_rate) * (step - config.hold + 1) / config.warmup
    start = config.steps * (1 - config.decay)
    if config.decay <= 0 or step < start:
        return config.learning_rate
    progress = min(1.0, (step + 1 - start) / (config.steps - start))
    return config.learning_rate * (0.02 + 0.98 * (1 + math.cos(math.pi * progress)) / 2)


def init(module: nn.Module, loss: Callable[..., ElboResult], config: OptimizerConfig) -> OptimizerState:
    """State before the first step: the optimiser over the parameters that require a gradient."""
    average = {name: value.detach().clone() for name, value in module.state_dict().items()}
    return OptimizerState(module, loss, make_optimizer(module, config), config, average)


def make_optimizer(module: nn.Module, config: OptimizerConfig) -> torch.optim.Optimizer:
    """The optimiser a configuration names, over the parameters that require a gradient."""
    if config.optimizer == "muon":
        return MuonAdamW(module, config.learning_rate, config.weight_decay, config.matrix_lr_scale)
    return adamw((p for p in module.parameters() if p.requires_grad), config.learning_rate, config.weight_decay)


def step(state: OptimizerState, *args: Any, **kwargs: Any) -> tuple[OptimizerState, StepInfo]:
    """One optimiser step on a batch; the state is changed in place and returned.

    Raises:
        NolboError: the loss is not finite; the message names the terms that are not, and the weights are left as they were. Or
            the step itself has made weights that are not finite.
    """
    config = state.config
    rate = learning_rate(config, state.step)
    for group in state.optimizer.param_groups:
        group["lr"] = rate
    result = state.loss(*args, **kwargs)
    if not bool(torch.isfinite(result.loss)):
        bad = {name: float(value.detach()) for name, value in result.terms.items() if not bool(torch.isfinite(value))}
        raise NolboError(f"loss of step {state.step} is {float(result.loss.detach())}: terms that are not finite: {bad}")
    state.optimizer.zero_grad(set_to_none=True)
    result.loss.backward()
    parameters = [p for group in state.optimizer.param_groups for p in group["params"]]
    norm = nn.utils.clip_grad_norm_(parameters, config.clip)
    if not bool(torch.isfinite(norm)):
        raise NolboError(f"gradient of step {state.step} is not finite (loss {float(result.loss.detach()):.3f})")
    state.optimizer.step()
    if not bool(torch.isfinite(torch.stack(torch._foreach_norm([p.detach() for p in parameters]))).all()):
        raise NolboError(f"weights after step {state.step} are not finite: is the learning rate of {rate:g} too large?")
    _update_average(state)
    values = torch.stack([value.detach() for value in result.terms.values()]).tolist() if result.terms else []
    terms = dict(zip(result.terms, values))  # one copy from the device, not one a term
    info = StepInfo(state.step, float(result.loss.detach()), float(norm), rate, terms)
    state.step += 1
    return state, info


@torch.no_grad()
def _update_average(state: OptimizerState) -> None:
    """Moving average with a short memory at the start, so that the first weights do not linger."""
    decay = min(state.config.ema, (1 + state.step) / (10 + state.step))
    current = state.module.state_dict()
    floating = [name for name, value in state.average.items() if value.is_floating_point()]
    torch._foreach_lerp_([state.average[n] for n in floating], [current[n] for n in floating], 1 - decay)
    for name, value in state.average.items():
        if not value.is_floating_point():
            value.copy_(current[name])


@torch.no_grad()
def average_over_processes(state: OptimizerState) -> None:
    """Give every process the mean of all: weights, normalisation's statistics, moving average, optimiser's state."""
    moments = [value for of in state.optimizer.state.values() for value in of.values()]
    tensors = [*state.module.state_dict().values(), *state.average.values(), *moments]
    floating = [value for value in tensors if torch.is_tensor(value) and value.is_floating_point()]
    device = next(state.module.parameters()).device  # counts of steps lie on the CPU
    together = torch.cat([value.detach().flatten().to(device) for value in floating])
    distributed.all_reduce(together)
    together /= distributed.get_world_size()
    for value, mean in zip(floating, together.split([value.numel() for value in floating])):
        value.copy_(mean.view_as(value))


def state_tensors(state: OptimizerState) -> dict[str, Tensor]:
    """Copies of all tensors of a state, for a checkpoint: `model/...`, `average/...`, `optimizer/...`."""
    names = {id(p): name for name, p in state.module.named_parameters()}
    return {
        **{f"model/{name}": value.clone() for name, value in state.module.state_dict().items()},
        **{f"average/{name}": value.clone() for name, value in state.average.items()},
        **{f"optimizer/{name}": value.clone() for name, value in optimizer_tensors(state.optimizer, names).items()},
    }


def part_of(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors whose names begin with a prefix, without it."""
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def module_tensors(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The module's own state dictionary among the tensors of `state_tensors`."""
    return part_of(tensors, "model/")


def restore(state: OptimizerState, tensors: dict[str, Tensor], at_step: int) -> OptimizerState:
    """Put a state back to what `state_tensors` saved, bit for bit."""
    state.module.load_state_dict(module_tensors(tensors))
    state.average = {
        name: value.to(state.average[name].device, copy=True) for name, value in part_of(tensors, "average/").items()
    }
    restore_optimizer(state.optimizer, part_of(tensors, "optimizer/"), dict(state.module.named_parameters()))
    state.step = at_step
    return state


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
