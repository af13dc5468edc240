"""What objects of each category measure: log-normal priors on the diagonal of their boxes."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

MIN_SCALE = 0.05
"""No category is known more sharply than this (of the log diagonal)."""


class CategorySizes(nn.Module):
    """Mean and precision of the log diagonal, m, of each category; precision 0 where nothing is known.

    Args:
        labels: number of categories.

    Example:
        >>> sizes = CategorySizes(2)
        >>> sizes.learn(0, torch.log(torch.tensor([4.0, 4.4, 5.0])))
        >>> round(float(sizes.get_buffer("log_mean")[0].exp()), 2), float(sizes.get_buffer("precision")[1])
        (4.45, 0.0)
    """

    def __init__(self, labels: int) -> None:
        super().__init__()
        self.register_buffer("log_mean", torch.zeros(labels))
        self.register_buffer("precision", torch.zeros(labels))

    def forward(self, label: Int[Tensor, " n"]) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Mean and precision of the log diagonal of each label."""
        return self.get_buffer("log_mean")[label], self.get_buffer("precision")[label]

    @torch.no_grad()
    def learn(self, label: int, log_diagonal: Float[Tensor, " n"]) -> None:
        """Take mean and spread of one category's log diagonals; of at least two."""
        scale = float(log_diagonal.double().std().clamp_min(MIN_SCALE))
        self.get_buffer("log_mean")[label] = float(log_diagonal.double().mean())
        self.get_buffer("precision")[label] = scale**-2
