"""Batch normalisation whose statistics cover the joint batch of all processes."""

from __future__ import annotations

from typing import Any

import torch
import torch.distributed as distributed
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm


class _SumOverProcesses(torch.autograd.Function):
    """Sum of a tensor over all processes, and of its gradient on the way back."""

    @staticmethod
    def forward(ctx: Any, value: Tensor) -> Tensor:
        total = value.clone()
        distributed.all_reduce(total)
        return total

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> Tensor:
        return _SumOverProcesses.forward(ctx, grad_outputs[0])


def world_size() -> int:
    """Number of processes that train together; 1 when there is no process group."""
    return distributed.get_world_size() if distributed.is_available() and distributed.is_initialized() else 1


class _JointStatistics(_BatchNorm):
    """Batch normalisation by the statistics of the joint batch, on CPUs too.

    `torch.nn.SyncBatchNorm` refuses CPU tensors, and without shared statistics two processes do not train the same
    network as one process with the joint batch. Alone in the world it is torch's own layer, and where `joint` is unset:
    processes that train by themselves between averages of their weights.
    """

    joint = True
    """Whether statistics are those of the joint batch of all processes."""

    def forward(self, input: Tensor) -> Tensor:
        """Normalise by the joint statistics in training, by the running ones in evaluation."""
        if not self.training or not self.joint or world_size() == 1:
            return super().forward(input)
        assert self.running_mean is not None and self.running_var is not None and self.num_batches_tracked is not None
        x = input.float() if input.dtype == torch.bfloat16 else input
        dims = [d for d in range(x.dim()) if d != 1]
        local = x.new_tensor([x.numel() / x.shape[1]])
        sums = _SumOverProcesses.apply(torch.cat((x.sum(dims), x.square().sum(dims), local)))
        count = sums[-1].detach()  # processes may hold different numbers of objects, or none
        if float(count) == 0:
            return input
        mean, square = (sums[:-1] / count).chunk(2)
        variance = (square - mean.square()).clamp_min(0)
        with torch.no_grad():
            momentum = 0.1 if self.momentum is None else self.momentum
            self.num_batches_tracked += 1
            self.running_mean.lerp_(mean, momentum)
            self.running_var.lerp_(variance * (count / (count - 1)), momentum)
        factor = self.weight * torch.rsqrt(variance + self.eps)
        shape = [-1] + [1] * (x.dim() - 2)
        return (x * factor.view(shape) + (self.bias - mean * factor).view(shape)).to(input.dtype)


class SyncBatchNorm2d(_JointStatistics, nn.BatchNorm2d):
    """For images."""


class SyncBatchNorm3d(_JointStatistics, nn.BatchNorm3d):
    """For voxel grids."""


def set_joint(module: nn.Module, joint: bool) -> None:
    """Normalise by the joint batch of all processes, or each process by its own."""
    for layer in module.modules():
        if isinstance(layer, _JointStatistics):
            layer.joint = joint
