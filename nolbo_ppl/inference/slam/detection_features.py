"""What an object looks like, as evidence: latents and categories against the population they are drawn from.

A match of latents is worth only as much as it is rare: its likelihood is divided by the density of the population,
which is estimated from the objects themselves: their own spread, each detection's error added once. Twenty identical cars
then give no evidence at all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.inference.slam.latent_mixture import LARGE_VARIANCE as LARGE_VARIANCE
from nolbo_ppl.inference.slam.latent_mixture import LatentMixture
from nolbo_ppl.inference.slam.latent_population import LatentPopulation, fit_population
from nolbo_ppl.inference.slam.slam_problem import NoiseModel, SlamConfig
from nolbo_ppl.io.observations import Detections


@dataclass(frozen=True)
class FeaturePrior:
    """Population of latents and categories."""

    mean: Float[np.ndarray, " d"]
    """Mean latent of all."""
    population: LatentPopulation
    """Where the latents of objects lie."""
    categories: tuple[str, ...]
    """Category names in use."""
    log_frequency: Float[np.ndarray, " c"]
    """Log share of each category."""
    category_error: float
    """Probability that a category is wrong."""
    objectness_prior: float = 0.5
    """Share of true detections that objectness, a posterior, was calibrated on."""

    def category_log_ratio(self, a: Int[np.ndarray, " p"], b: Int[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """`log p(b | a, same object) - log p(b)`; 0 where either is missing (-1)."""
        if not self.categories:
            return np.zeros(len(a))
        frequency = np.exp(self.log_frequency)[np.maximum(b, 0)]
        error = 2 * self.category_error  # either of the two may be wrong
        ratio = np.where(a == b, np.log((1 - error) / frequency + error), np.log(error))
        return np.where((a < 0) | (b < 0), 0.0, ratio)

    def log_likelihood_ratio(
        self,
        latent_a: np.ndarray,
        variance_a: np.ndarray,
        category_a: np.ndarray,
        latent_b: np.ndarray,
        variance_b: np.ndarray,
        category_b: np.ndarray,
        modes_a: LatentMixture | None = None,
        modes_b: LatentMixture | None = None,
    ) -> Float[np.ndarray, " p"]:
        """Log ratio of a's features given b to those of any object, nats.

        With latents at hand an equal category adds nothing (it is read off the same latent), a different one counts; where modes
        are stated it does not: their weights say how sure the category is.
        """
        category = self.category_log_ratio(category_b, category_a)
        if not latent_a.shape[1]:
            return category
        known = (variance_a[:, 0] < LARGE_VARIANCE) & (variance_b[:, 0] < LARGE_VARIANCE)
        if modes_a is not None or modes_b is not None:
            a, b = modes_a or LatentMixture.of_one(latent_a), modes_b or LatentMixture.of_one(latent_b)
            category = np.where(known & (a.several | b.several), 0.0, category)
            latent = self.population.log_ratio_of_modes(a, variance_a, b, variance_b)
            return np.where(known, latent + np.minimum(category, 0.0), category)
        latent = self.population.log_ratio(latent_a, variance_a, latent_b, variance_b)
        return np.where(known, latent + np.minimum(category, 0.0), category)


def latent_log_density(x: np.ndarray, mean: np.ndarray, variance: np.ndarray) -> Float[np.ndarray, " ..."]:
    """Log density of a diagonal Gaussian, summed over the last axis."""
    return -0.5 * np.sum((x - mean) ** 2 / variance + np.log(2 * np.pi * variance), axis=-1)


def fit_prior(table: Detections, config: SlamConfig, noise: NoiseModel | None = None) -> FeaturePrior:
    """The population of latents, shares of all categories, and the share of true detections that objectness refers to.

    Args:
        table: the detections.
        config: `objectness_prior`, `category_error` and `latent_correlation`.
        noise: scales of these rows; None: those the table states. Their variance is no part of the population's: counted
            twice, identical objects would give evidence (0.77 nats a match in 8 dimensions, 12 in 128).
    """
    known = table.has_latent
    d = table.latent_dim
    mean = table.latent[known].mean(axis=0) if known.any() else np.zeros(d)
    scale = np.nan_to_num((table.latent_scale if noise is None else noise.latent_scale)[known])
    named = [c for c in table.category if c is not None]
    categories, counts = np.unique(named, return_counts=True) if named else (np.zeros(0, str), np.zeros(0))
    shares = (counts + 1.0) / (counts.sum() + len(counts)) if len(counts) else counts
    share = config.objectness_prior
    if share is None:  # a calibrated objectness is right on average
        share = float(np.mean(np.clip(table.objectness, *config.objectness_limits))) if len(table) else 0.5
    population = LatentPopulation.of_one(mean, np.ones(d))
    if known.any():
        lookup = {str(name): k for k, name in enumerate(categories)}
        label = np.array([-1 if name is None else lookup[str(name)] for name in table.category])[known]
        between_views = (1.0 - (config.latent_correlation or 0.0)) * scale**2
        population = fit_population(table.latent[known], between_views, label)
    return FeaturePrior(mean, population, tuple(str(c) for c in categories), np.log(shares), config.category_error, share)


def category_index(table: Detections, prior: FeaturePrior) -> Int[np.ndarray, " n"]:
    """Index of each detection's category, -1 where it has none or one the prior does not know."""
    lookup = {name: i for i, name in enumerate(prior.categories)}
    return np.array([lookup.get(c, -1) if c is not None else -1 for c in table.category], dtype=np.int64).reshape(len(table))


def detection_features(
    table: Detections, noise: NoiseModel, prior: FeaturePrior, correlation: float = 0.0
) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, "n d"], Int[np.ndarray, " n"]]:
    """Latent, its variance between views (very large where missing) and category index of every detection.

    Of a latent's error the share `correlation` of the variance is one error for all views of an object. Two views of it do not
    differ by that, and two objects differ by it as by their shapes: an association has `(1 - r) s^2` to go by.
    """
    known = table.has_latent[:, None]
    latent = np.where(known, np.nan_to_num(table.latent), prior.mean)
    variance = np.where(known, (1.0 - correlation) * np.nan_to_num(noise.latent_scale) ** 2, LARGE_VARIANCE)
    return latent, variance, category_index(table, prior)


def fuse_latent(
    mean_a: np.ndarray, variance_a: np.ndarray, mean_b: np.ndarray, variance_b: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Precision-weighted mean of two latents and its variance."""
    variance = 1.0 / (1.0 / variance_a + 1.0 / variance_b)
    return variance * (mean_a / variance_a + mean_b / variance_b), variance


def correlated_variance(
    variance: Float[np.ndarray, "g d"], count: Float[np.ndarray, " g"], correlation: float
) -> Float[np.ndarray, "g d"]:
    """Variance of a mean of n parts with correlation r: `(1 + r (n - 1))` times that of independent parts (docs/slam.md, the
    latent update); missing ones stay."""
    factor = 1.0 + correlation * np.maximum(count - 1.0, 0.0)
    return np.where(variance < LARGE_VARIANCE, variance * factor[:, None], variance)


def variance_of_shape(between_views: Float[np.ndarray, "m d"], correlation: float) -> Float[np.ndarray, "m d"]:
    """Variance of an object's latent about the truth, from that about what its views have in common; missing ones stay.

    Args:
        between_views: as landmarks hold it for associations: `1 - r` of the whole, whatever the number of views (views of one
            track see one side, so that as much of what is left is taken to be alike in them as of the whole).
        correlation: r.
    """
    return np.where(between_views < LARGE_VARIANCE, between_views / (1.0 - correlation), between_views)


def weighted_latents(
    latent: Float[np.ndarray, "n d"],
    variance: Float[np.ndarray, "n d"],
    group: Int[np.ndarray, " n"],
    weight: Float[np.ndarray, " n"],
    groups: int,
) -> tuple[Float[np.ndarray, "g d"], Float[np.ndarray, "g d"]]:
    """Latent update: `mu_j = sum w_kj mu_k / s_k^2 / sum w_kj / s_k^2` and its variance (NOLBO eq. optimal_mu, corrected:
    positive, normalised, precision-weighted). Rows of group -1 are left out; groups without a latent get LARGE_VARIANCE.
    """
    d = latent.shape[1]
    precision, total = np.zeros((groups, d)), np.zeros((groups, d))
    rows = (group >= 0) & (variance < LARGE_VARIANCE).all(axis=1) if d else np.zeros(len(group), bool)
    w = weight[rows, None] / variance[rows]
    np.add.at(precision, group[rows], w)
    np.add.at(total, group[rows], w * latent[rows])
    known = precision > 1.0 / LARGE_VARIANCE
    mean = np.where(known, total / np.where(known, precision, 1.0), 0.0)
    return mean, np.where(known, 1.0 / np.where(known, precision, 1.0), LARGE_VARIANCE)
