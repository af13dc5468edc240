"""Batch normalisation over the joint batch of two processes."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import nn

from nolbo_ppl.models.normalisation import SyncBatchNorm2d, SyncBatchNorm3d
from tests.factories import run_in_two_processes
from tests.gloo_worker import normalisation


def test_two_processes_are_one_with_the_joint_batch(tmp_path: Path) -> None:
    """Unequal shares (2 and 3 images): outputs, gradients of inputs and parameters, running statistics."""
    first, second = run_in_two_processes("normalisation", tmp_path)
    joint = normalisation(None)
    for name in ("first", "second", "gradient", "evaluated"):
        both = torch.cat((first[name], second[name]))
        torch.testing.assert_close(both, joint[name].detach(), atol=1e-10, rtol=0, msg=name)
    for name in ("weight", "bias", "mean", "var", "steps"):
        torch.testing.assert_close(first[name], joint[name].detach(), atol=1e-10, rtol=0, msg=name)
        assert torch.equal(first[name], second[name])


def test_alone_it_is_torchs_own_layer() -> None:
    for ours, torchs, shape in (
        (SyncBatchNorm2d(3), nn.BatchNorm2d(3), (4, 3, 5, 5)),
        (SyncBatchNorm3d(2), nn.BatchNorm3d(2), (4, 2, 3, 3, 3)),
    ):
        x = torch.randn(shape)
        torch.testing.assert_close(ours(x), torchs(x))
        torch.testing.assert_close(ours.running_var, torchs.running_var)
        ours.eval(), torchs.eval()
        torch.testing.assert_close(ours(x), torchs(x))
