"""Latents of several modes: a detector unsure of the category states where the latent is under each (docs/slam.md).

The density of such a latent given an object is the sum over its modes, and that of the population likewise. What is fused into
an object is one mode of each detection, the one the object's other detections make likeliest: a mean over modes would lie
between categories, where no shape is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.structures.detections import Detections

LARGE_VARIANCE = 1e12
"""Variance that stands for a missing latent: it carries no weight."""
MOST_MEMBERS = 12
"""Detections of an object whose modes are tried as its latent, spread evenly over all."""
CHUNK = 1 << 21
"""Numbers that are looked at together."""


@dataclass(frozen=True)
class LatentMixture:
    """Modes of latents, padded to the same number; all modes of a row have the row's variance."""

    log_weight: Float[np.ndarray, "n L"]
    """Log weights, -inf where there are fewer."""
    mean: Float[np.ndarray, "n L d"]
    """Means."""

    def __len__(self) -> int:
        return len(self.log_weight)

    @classmethod
    def of_one(cls, latent: Float[np.ndarray, "n d"]) -> LatentMixture:
        """One mode each."""
        return cls(np.zeros((len(latent), 1)), latent[:, None])

    @property
    def several(self) -> np.ndarray:
        """Rows of more than one mode."""
        count: np.ndarray = np.isfinite(self.log_weight).sum(axis=1)
        return count > 1

    @property
    def heaviest(self) -> Int[np.ndarray, " n"]:
        """The heaviest mode of each row."""
        number: np.ndarray = np.argmax(self.log_weight, axis=1)
        return number

    def select(self, rows: np.ndarray) -> LatentMixture:
        """Some of the rows."""
        return LatentMixture(self.log_weight[rows], self.mean[rows])

    def padded(self, count: int) -> LatentMixture:
        """With room for `count` modes."""
        n, d, more = len(self), self.mean.shape[2], count - self.mean.shape[1]
        if more <= 0:
            return self
        log_weight = np.concatenate([self.log_weight, np.full((n, more), -np.inf)], axis=1)
        return LatentMixture(log_weight, np.concatenate([self.mean, np.zeros((n, more, d))], axis=1))

    def stacked(self, other: LatentMixture) -> LatentMixture:
        """These rows, then those of another."""
        count = max(self.log_weight.shape[1], other.log_weight.shape[1])
        a, b = self.padded(count), other.padded(count)
        return LatentMixture(np.concatenate([a.log_weight, b.log_weight]), np.concatenate([a.mean, b.mean]))


def observed_latent_modes(table: Detections, latent: Float[np.ndarray, "n d"]) -> LatentMixture | None:
    """Modes of every detection's latent: those it states, else the latent alone; None where no detection states two."""
    stated = ((table.latent_mode_weight > 0).sum(axis=1) > 1) & table.has_latent
    if not stated.any():
        return None
    modes = LatentMixture.of_one(latent).padded(table.latent_mode_weight.shape[1])  # padding copies: there are two modes or more
    weight = table.latent_mode_weight[stated]
    with np.errstate(divide="ignore"):
        modes.log_weight[stated] = np.log(weight / weight.sum(axis=1, keepdims=True))
    modes.mean[stated] = table.latent_mode[stated]
    return modes


def chosen_modes(
    modes: LatentMixture,
    variance: Float[np.ndarray, "n d"],
    group: Int[np.ndarray, " n"],
    weight: Float[np.ndarray, " n"],
) -> Int[np.ndarray, " n"]:
    """The mode each row takes, given the other rows of its object; the heaviest where the object has none to ask.

    An object's latent is sought among the modes of its rows, at the largest `sum_k weight_k log p(row k | latent)`; each row then
    takes its likeliest mode about what that fuses to.

    Args:
        modes: of each row.
        variance: of its modes; LARGE_VARIANCE where the latent is missing.
        group: object of each row, -1 for none.
        weight: of each row in its object.
    """
    chosen = modes.heaviest
    rows = np.flatnonzero((group >= 0) & (variance < LARGE_VARIANCE).all(axis=1) & (weight > 0))
    rows = rows[np.isin(group[rows], np.unique(group[rows][modes.several[rows]]))]
    rows = rows[np.argsort(group[rows], kind="stable")]
    _, starts = np.unique(group[rows], return_index=True)
    for members in np.split(rows, starts[1:]) if len(rows) else []:
        chosen[members] = _of_one_object(modes.select(members), variance[members], weight[members])
    return chosen


def _of_one_object(
    modes: LatentMixture, variance: Float[np.ndarray, "n d"], weight: Float[np.ndarray, " n"]
) -> Int[np.ndarray, " n"]:
    n, count, d = modes.mean.shape
    asked = np.unique(np.linspace(0, n - 1, min(n, MOST_MEMBERS)).astype(int))
    number, mode = np.nonzero(np.isfinite(modes.log_weight[asked]))
    candidate, spread = modes.mean[asked[number], mode], variance[asked[number]]
    score = np.empty(len(candidate))
    step = max(1, CHUNK // (n * count * d))
    for start in range(0, len(candidate), step):
        part = slice(start, start + step)
        joint = _joint(modes, variance[None] + spread[part, None], candidate[part, None])
        score[part] = np.logaddexp.reduce(joint, axis=2) @ weight
    best = int(np.argmax(score))
    mean, own = candidate[best], spread[best]
    for _ in range(2):
        chosen = np.argmax(_joint(modes, variance + own, mean), axis=1)
        precision = weight[:, None] / variance
        own = 1.0 / precision.sum(axis=0)
        mean = own * (precision * modes.mean[np.arange(n), chosen]).sum(axis=0)
    return np.argmax(_joint(modes, variance + own, mean), axis=1)


def _joint(modes: LatentMixture, variance: Float[np.ndarray, "*c n d"], mean: np.ndarray) -> Float[np.ndarray, "*c n L"]:
    """Log weight and density of every mode about a mean (one, or one each [..., 1, d])."""
    square = np.sum((modes.mean - mean[..., None, :]) ** 2 / variance[..., None, :], axis=-1)
    return modes.log_weight - 0.5 * (square + np.sum(np.log(2 * np.pi * variance), axis=-1)[..., None])


def likeliest_mode(
    modes: LatentMixture, row: int, latent: Float[np.ndarray, " d"], variance: Float[np.ndarray, " d"]
) -> Float[np.ndarray, " d"]:
    """Mean of a row's likeliest mode about a latent, both variances added."""
    square = np.sum((modes.mean[row] - latent) ** 2 / variance, axis=-1)
    best: np.ndarray = modes.mean[row, np.argmax(modes.log_weight[row] - 0.5 * square)]
    return best


def resolved_latents(
    latent: Float[np.ndarray, "n d"],
    variance: Float[np.ndarray, "n d"],
    modes: LatentMixture | None,
    group: Int[np.ndarray, " n"],
    weight: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n d"]:
    """Latent of the mode each row takes in its object (`chosen_modes`); the latents themselves where nobody states modes."""
    if modes is None:
        return latent
    chosen = chosen_modes(modes, variance, group, weight)
    return modes.mean[np.arange(len(modes)), chosen]


def nearest_difference(table: Detections, a: Int[np.ndarray, " p"], b: Int[np.ndarray, " p"]) -> Float[np.ndarray, "p d"]:
    """Difference of the latents of detections (b less a), of modes that are stated the nearest two."""
    difference = table.latent[b] - table.latent[a]
    modes = observed_latent_modes(table, table.latent)
    if modes is None:
        return difference
    square = np.sum(difference**2, axis=1)
    for k in range(modes.mean.shape[1]):
        for m in range(modes.mean.shape[1]):
            other = modes.mean[b, m] - modes.mean[a, k]
            stated = np.isfinite(modes.log_weight[a, k]) & np.isfinite(modes.log_weight[b, m])
            nearer = stated & (np.sum(other**2, axis=1) < square)
            difference = np.where(nearer[:, None], other, difference)
            square = np.where(nearer, np.sum(other**2, axis=1), square)
    return difference
