"""Posterior of a shape latent as a mixture over categories: a Gaussian about each likely category's mean, all of one scale.

The guide's latent is the prior mean of the category plus a residual, so that what is not known of the category is not known of
the latent: `q(z | I) = sum_l q(l | I) N(z; mu_psi(l) + residual, diag(scale^2))`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

MOST_LATENT_MODES = 4
"""Modes that are kept, the likeliest."""
MIN_LATENT_WEIGHT = 0.02
"""Categories of less weight are left out."""


@dataclass(frozen=True)
class LatentModes:
    """Mixtures of K Gaussians each over the latents of n objects, heaviest first.

    Example:
        >>> modes = LatentModes(np.array([[0.75, 0.25]]), np.array([[[0.0], [4.0]]]), np.array([[3, 1]]))
        >>> modes.log_density(np.array([[4.0]]), np.array([[1.0]])).round(4)  # log (0.25 + 0.75 e^-8) - log sqrt(2 pi)
        array([-2.3042])
    """

    weight: Float[np.ndarray, "n K"]
    """Weights, summing to one over a row; 0 where there are fewer modes."""
    mean: Float[np.ndarray, "n K d"]
    """Mean of each mode."""
    category: Int[np.ndarray, "n K"]
    """Category of each mode; -1 where none is meant."""

    @classmethod
    def of_one(cls, latent: Float[np.ndarray, "n d"]) -> LatentModes:
        """One mode each."""
        n = len(latent)
        return cls(np.ones((n, 1)), latent[:, None], np.full((n, 1), -1))

    def select(self, rows: Int[np.ndarray, " k"]) -> LatentModes:
        """Some of the rows."""
        return LatentModes(self.weight[rows], self.mean[rows], self.category[rows])

    def log_density(self, z: Float[np.ndarray, "n d"], scale: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        """Log density of each row's mixture at a latent, nats.

        Args:
            z: a latent for each row.
            scale: standard deviations of the row's modes.
        """
        squares = (((z[:, None] - self.mean) / scale[:, None]) ** 2).sum(axis=-1)
        with np.errstate(divide="ignore"):
            joint = np.log(self.weight) - 0.5 * squares
        log_normaliser = np.log(scale).sum(axis=-1) + 0.5 * z.shape[-1] * np.log(2 * np.pi)
        density: np.ndarray = np.logaddexp.reduce(joint, axis=1) - log_normaliser
        return density

    def region_mass(
        self, z: Float[np.ndarray, "n d"], scale: Float[np.ndarray, "n d"], normal: Float[np.ndarray, "s d"]
    ) -> Float[np.ndarray, " n"]:
        """Posterior mass of all points denser than a latent: uniform on [0, 1] where posteriors are calibrated.

        Args:
            z: a latent for each row.
            scale: standard deviations of the row's modes.
            normal: draws of the standard normal distribution, which all rows share; the modes share them by their weights.
        """
        count, out = len(normal), np.empty(len(z))
        level = (np.arange(count) + 0.5) / count
        for i in range(len(z)):
            chosen = np.minimum(np.searchsorted(np.cumsum(self.weight[i]), level), self.weight.shape[1] - 1)
            drawn = self.mean[i, chosen] + scale[i] * normal
            one = LatentModes(*(np.broadcast_to(v[i], (count, *v[i].shape)) for v in (self.weight, self.mean, self.category)))
            at = LatentModes(self.weight[i : i + 1], self.mean[i : i + 1], self.category[i : i + 1])
            there = at.log_density(z[i : i + 1], scale[i : i + 1])
            out[i] = np.mean(one.log_density(drawn, np.broadcast_to(scale[i], drawn.shape)) > there)
        return out


def modes_by_category(
    latent: Float[np.ndarray, "n d"],
    class_log_posterior: Float[np.ndarray, "n labels"],
    prior_mean: Float[np.ndarray, "labels d"],
) -> LatentModes:
    """The mixture from the latent at the likeliest category: every other one moves it by the difference of the prior means.

    The `MOST_LATENT_MODES` likeliest categories of at least `MIN_LATENT_WEIGHT` are kept, their weights sum to one.

    Args:
        latent: mean where the likeliest category puts it.
        class_log_posterior: log q(l | I).
        prior_mean: mu_psi(l).
    """
    count = min(MOST_LATENT_MODES, class_log_posterior.shape[1])
    category = np.argsort(-class_log_posterior, axis=1, kind="stable")[:, :count]
    weight = np.exp(np.take_along_axis(class_log_posterior, category, axis=1))
    weight[:, 1:][weight[:, 1:] < MIN_LATENT_WEIGHT] = 0.0
    mean = latent[:, None] + (prior_mean[category] - prior_mean[category[:, :1]])
    return LatentModes(weight / weight.sum(axis=1, keepdims=True), mean, category)
