"""Layers that optimisers must tell apart."""

from __future__ import annotations

from torch import nn


class OutputLinear(nn.Linear):
    """A dense layer whose outputs are parameters of distributions, not features of a hidden layer."""
