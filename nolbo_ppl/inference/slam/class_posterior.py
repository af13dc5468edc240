"""The category of a landmark from all its views, which are looks of one network at one object and err alike.

Most objects are seen rightly but for single slips. Some are prone to be taken for one other category, each at a rate of its
own of which nothing is known: of two categories that share an object's views, the more frequent one need not be right.
The rate of slips and the share of prone objects are measured on the map by marginal likelihood, and averaged over.
Views that state a whole posterior count in its proportions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.special import betaln, logsumexp

ERRORS = np.array([0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3])
"""Rates of single slips tried."""
PRONE = np.array([0.01, 0.03, 0.06, 0.1, 0.15, 0.25, 0.4])
"""Shares of prone objects tried."""
PRIOR_OBJECTS = 1.0
"""Weight of the configured category error, in objects."""


@dataclass(frozen=True)
class ConfusionModel:
    """How categories are confused: settings and their posterior weights. A map of twenty objects does not tell one setting."""

    error: Float[np.ndarray, " g"]
    """Probability of a slip in one view."""
    prone: Float[np.ndarray, " g"]
    """Share of objects that are taken for one other category again and again."""
    weight: Float[np.ndarray, " g"]
    """Posterior probability of each setting."""

    @property
    def expected_prone(self) -> float:
        """Expected share of prone objects: the measured dependence of one object's views."""
        return float(self.weight @ self.prone)


def votes_log_likelihood(votes: Float[np.ndarray, "m c"], error: float, prone: float) -> Float[np.ndarray, "m c"]:
    """Log probability of each object's votes for every true category.

    `(1 - prone) (1 - e)^n_c (e / (C - 1))^(n - n_c)` and, for each other category o, `prone / (C - 1) B(1 + n_c, 1 + n_o)` times
    slips for the rest.
    """
    others = max(votes.shape[1] - 1, 1)
    total = votes.sum(axis=1, keepdims=True)
    slip = np.log(error / others)
    clean = np.log1p(-prone) + votes * np.log1p(-error) + (total - votes) * slip
    right, wrong = votes[:, :, None], votes[:, None, :]
    pair = np.log(prone / others) + betaln(1 + right, 1 + wrong) + (total[:, :, None] - right - wrong) * slip
    diagonal = np.arange(votes.shape[1])
    pair[:, diagonal, diagonal] = -np.inf
    return np.logaddexp(clean, logsumexp(pair, axis=2))


def count_votes(
    category: Int[np.ndarray, " k"],
    stated: Float[np.ndarray, "k c"] | None,
    landmark: Int[np.ndarray, " k"],
    weight: Float[np.ndarray, " k"],
    landmarks: int,
    categories: int,
) -> Float[np.ndarray, "m c"]:
    """Weighted votes of each landmark's views: the named category, or the stated posterior in a row that is not all zero."""
    votes = np.zeros((landmarks, categories))
    whole = np.zeros(len(category), bool) if stated is None else stated.sum(axis=1) > 0
    named = ~whole & (category >= 0)
    np.add.at(votes, (landmark[named], category[named]), weight[named])
    if stated is not None and whole.any():
        share = stated[whole] / stated[whole].sum(axis=1, keepdims=True)
        np.add.at(votes, landmark[whole], weight[whole, None] * share)
    return votes


def fit_confusion(votes: Float[np.ndarray, "m c"], log_frequency: Float[np.ndarray, " c"], error: float) -> ConfusionModel:
    """Posterior over both rates by marginal likelihood; that of slips has a beta prior about the configured error."""
    grid = [(e, prone) for e in ERRORS for prone in PRONE]
    use = votes[votes.sum(axis=1) > 0]
    value = np.array(
        [
            PRIOR_OBJECTS * (error * np.log(e) + (1 - error) * np.log1p(-e))
            + logsumexp(votes_log_likelihood(use, e, prone) + log_frequency, axis=1).sum()
            for e, prone in grid
        ]
    )
    errors, shares = np.array(grid).T
    return ConfusionModel(errors, shares, np.exp(value - logsumexp(value)))


def class_posterior(
    votes: Float[np.ndarray, "m c"], log_frequency: Float[np.ndarray, " c"], model: ConfusionModel
) -> Float[np.ndarray, "m c"]:
    """Posterior over categories of each landmark, averaged over the settings."""
    out = np.zeros_like(votes)
    for error, prone, weight in zip(model.error, model.prone, model.weight):
        if weight > 1e-4:
            log_posterior = votes_log_likelihood(votes, error, prone) + log_frequency
            out += weight * np.exp(log_posterior - logsumexp(log_posterior, axis=1, keepdims=True))
    return out / out.sum(axis=1, keepdims=True)
