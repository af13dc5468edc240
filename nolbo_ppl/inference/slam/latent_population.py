"""Where the latents of objects lie: a mixture of Gaussians of one width, a component a category, as the prior of the story.

The evidence of two latents that agree is their density given one object over that in the population. One Gaussian about all
categories is too wide a population: what makes two objects of one category alike would pass for one object seen twice, with
tens of nats in sixteen dimensions, where the category is worth the log of its share.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.cluster.vq import kmeans2

from nolbo_ppl.inference.slam.latent_mixture import LatentMixture

LEAST_VARIANCE = 1e-12
"""Of a coordinate over objects."""
ROUNDS = 20
"""Rounds of expectation and maximisation: names that are wrong are outvoted by the latents."""
CLUSTERS = (1, 2, 4, 8)
"""Numbers of components that are tried where nobody names categories."""
LEAST_OF_CLUSTER = 20
"""Latents for each of them."""
MOST_ROWS = 5000
"""Latents it is fitted to, spread evenly over all."""


@dataclass(frozen=True)
class LatentPopulation:
    """A mixture of Gaussians with one diagonal covariance.

    >>> population = LatentPopulation.of_one(np.zeros(2), np.ones(2))
    >>> round(float(population.log_density(np.zeros((1, 2)), np.ones((1, 2)))[0]), 3)
    -2.531
    """

    log_weight: Float[np.ndarray, " k"]
    """Log shares of the components."""
    mean: Float[np.ndarray, "k d"]
    """Their means."""
    variance: Float[np.ndarray, " d"]
    """Variance over the objects of a component, without what views of one object differ by."""

    @classmethod
    def of_one(cls, mean: Float[np.ndarray, " d"], variance: Float[np.ndarray, " d"]) -> LatentPopulation:
        """One Gaussian."""
        return cls(np.zeros(1), mean[None], variance)

    def log_density(self, latent: Float[np.ndarray, "n d"], variance: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        """Log density of latents of any object, seen with these variances, nats."""
        value = np.full(len(latent), -np.inf)
        total = self.variance + variance
        for weight, mean in zip(self.log_weight, self.mean):
            value = np.logaddexp(value, weight - 0.5 * np.sum((latent - mean) ** 2 / total, axis=-1))
        out: Float[np.ndarray, " n"] = value - 0.5 * np.sum(np.log(2 * np.pi * total), axis=-1)
        return out

    def log_density_of_modes(self, modes: LatentMixture, variance: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        """The same of latents of several modes."""
        value = np.full(len(modes), -np.inf)
        for k in range(modes.mean.shape[1]):
            value = np.logaddexp(value, modes.log_weight[:, k] + self.log_density(modes.mean[:, k], variance))
        return value

    def log_ratio(
        self,
        a: Float[np.ndarray, "p d"],
        variance_a: Float[np.ndarray, "p d"],
        b: Float[np.ndarray, "p d"],
        variance_b: Float[np.ndarray, "p d"],
    ) -> Float[np.ndarray, " p"]:
        """`log p(a, b | one object) - log p(a) - log p(b)` of pairs of latents, nats, the object's own latent integrated out.

        Of one object the two lie `variance_a + variance_b` about each other and their mean as any object does.
        """
        return self.log_ratio_of_modes(LatentMixture.of_one(a), variance_a, LatentMixture.of_one(b), variance_b)

    def log_ratio_of_modes(
        self,
        a: LatentMixture,
        variance_a: Float[np.ndarray, "p d"],
        b: LatentMixture,
        variance_b: Float[np.ndarray, "p d"],
    ) -> Float[np.ndarray, " p"]:
        """The same of latents of several modes; where their mean lies is asked of the likeliest pair of modes alone."""
        both, mean, best = variance_a + variance_b, np.empty_like(variance_a), np.full(len(a), -np.inf)
        share_a, value = variance_b / both, np.full(len(a), -np.inf)
        for k in range(a.mean.shape[1]):
            for m in range(b.mean.shape[1]):
                x, y = a.mean[:, k], b.mean[:, m]
                pair = a.log_weight[:, k] + b.log_weight[:, m] - 0.5 * np.sum((x - y) ** 2 / both, axis=-1)
                value = np.logaddexp(value, pair)
                better = pair > best
                best = np.where(better, pair, best)
                mean = np.where(better[:, None], share_a * x + (1 - share_a) * y, mean)
        value = value - 0.5 * np.sum(np.log(2 * np.pi * both), axis=-1)
        at_mean = self.log_density(mean, variance_a * share_a)
        return value + at_mean - self.log_density_of_modes(a, variance_a) - self.log_density_of_modes(b, variance_b)


def fit_population(
    latent: Float[np.ndarray, "n d"], between_views: Float[np.ndarray, "n d"], name: Int[np.ndarray, " n"]
) -> LatentPopulation:
    """Fit the mixture by expectation and maximisation, begun with what detections are named.

    Where none is named, clusters take the place of categories, as many of `CLUSTERS` as Schwarz's criterion asks for.

    Args:
        latent: of detections, at least one.
        between_views: their variances between views, which are no part of the population's.
        name: number of their category, -1 for none.
    """
    some = np.unique(np.linspace(0, len(latent) - 1, min(len(latent), MOST_ROWS)).astype(int))
    latent, between_views, name = latent[some], between_views[some], name[some]
    if (name >= 0).any():
        found, _ = _fitted(latent, name)
    else:
        starts = [_clusters(latent, k) for k in CLUSTERS if k == 1 or k * LEAST_OF_CLUSTER <= len(latent)]
        fits = [_fitted(latent, start) for start in starts]
        found = max(fits, key=lambda fit: fit[1] - 0.5 * fit[0].mean.size * np.log(len(latent)))[0]
    variance = np.maximum(found.variance - between_views.mean(axis=0), LEAST_VARIANCE)
    return LatentPopulation(found.log_weight, found.mean, variance)


def _clusters(latent: Float[np.ndarray, "n d"], count: int) -> Int[np.ndarray, " n"]:
    """Nearest of some means, chosen far apart: the same for the same latents."""
    if count == 1 or len(np.unique(latent, axis=0)) <= count:
        return np.zeros(len(latent), dtype=np.int64)
    scale = np.maximum(latent.std(axis=0), np.sqrt(LEAST_VARIANCE))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a mean that nothing is nearest to: it is dropped
        return np.asarray(kmeans2(latent / scale, count, minit="++", seed=0)[1], dtype=np.int64)


def _fitted(latent: Float[np.ndarray, "n d"], name: Int[np.ndarray, " n"]) -> tuple[LatentPopulation, float]:
    """The mixture with the whole variance of a component, and its log likelihood."""
    share = (np.unique(name)[None] == name[:, None]).astype(np.float64)
    rounds = ROUNDS if share.shape[1] > 1 else 1
    while True:
        count = share.sum(axis=0)
        mean = (share.T @ latent) / count[:, None]
        square = sum(share[:, k] @ (latent - mean[k]) ** 2 for k in range(len(count))) / len(latent)
        found = LatentPopulation(np.log(count / count.sum()), mean, np.maximum(square, LEAST_VARIANCE))
        joint = found.log_weight - 0.5 * np.stack([np.sum((latent - m) ** 2 / found.variance, axis=1) for m in mean], axis=1)
        whole = np.logaddexp.reduce(joint, axis=1, keepdims=True)
        rounds -= 1
        if rounds <= 0:
            return found, float(whole.sum() - 0.5 * len(latent) * np.sum(np.log(2 * np.pi * found.variance)))
        share = np.exp(joint - whole)
        share = share[:, share.sum(axis=0) > 0.5]
        share /= np.maximum(share.sum(axis=1, keepdims=True), 1e-300)
