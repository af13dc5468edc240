"""Evidence that two tracklets are one object: position gap under the graph's own relative covariance, latent, orientation.

The covariance between any two tracklets comes from posterior samples of the linearised graph. It holds the drift
between two passes of a place; the sensor's covariance alone closes no loop after drift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from nolbo_ppl.inference.slam.detection_features import LARGE_VARIANCE, FeaturePrior, latent_log_density
from nolbo_ppl.inference.slam.gaussian import squared_distance
from nolbo_ppl.inference.slam.graph import LandmarkEqualities, SlamEstimate
from nolbo_ppl.inference.slam.linearisation import Linearisation
from nolbo_ppl.inference.slam.orientation import orientation_log_density
from nolbo_ppl.inference.slam.slam_problem import SlamConfig

LINK_SHARE = 0.9
"""Most of a gap's information that is taken off for its own link: the rest is the sampled covariance's error."""
CHUNK_PAIRS = 1 << 21
"""Pairs of tracklets that are looked at together."""
MAX_CANDIDATES = 256
"""Older tracklets that are candidates for one: on many laps the number of all pairs grows with their square."""
POPULATION = 30
"""Tracklets about a place, and of the whole map, whose orientations those of a pair are compared with."""
POSITION_GATE = 25.0
"""Squared Mahalanobis distance beyond which two tracklets are no candidates."""


@dataclass(frozen=True)
class TrackletFeatures:
    """What is known of each tracklet besides its position."""

    latent: Float[np.ndarray, "m d"]
    """Posterior mean of the latent."""
    latent_variance: Float[np.ndarray, "m d"]
    """Its variance between views (`variance_of_shape` gives the whole); LARGE_VARIANCE where none was observed."""
    log_population: Float[np.ndarray, " m"]
    """Log density of its latent in the population of the others."""
    category: Int[np.ndarray, " m"]
    """Most frequent category, -1 for none."""
    symmetry: Int[np.ndarray, " m"]
    """Symmetry order."""
    oriented: Bool[np.ndarray, " m"]
    """Whether its orientation was observed."""
    first: Int[np.ndarray, " m"]
    """First frame."""
    last: Int[np.ndarray, " m"]
    """Last frame."""


@dataclass(frozen=True)
class PosteriorSamples:
    """World-frame samples of the tracklets about the estimate."""

    position: Float[np.ndarray, "m 3 s"]
    """Deviations of positions, m."""
    rotation: Float[np.ndarray, "m 3 s"]
    """Deviations of orientations as rotation vectors, rad."""


@dataclass(frozen=True)
class Pairs:
    """Candidate pairs of a newer and an older tracklet."""

    a: Int[np.ndarray, " p"]
    """Newer tracklet."""
    b: Int[np.ndarray, " p"]
    """Older tracklet."""
    log_position: Float[np.ndarray, " p"]
    """Log density of the position gap, m^-3."""
    log_feature: Float[np.ndarray, " p"]
    """Log ratio of latent, category and orientation against the population."""

    def select(self, rows: np.ndarray) -> Pairs:
        """Some of the pairs."""
        return Pairs(self.a[rows], self.b[rows], self.log_position[rows], self.log_feature[rows])

    def __len__(self) -> int:
        return len(self.a)


def log_population(
    latent: Float[np.ndarray, "m d"], variance: Float[np.ndarray, "m d"], rows: Int[np.ndarray, " r"] | None = None
) -> Float[np.ndarray, " m"]:
    """Log density of each latent in the kernel mixture `1/(M-1) sum_c N(.; c, own + c's variance)` of all others.

    With `rows` only theirs are computed; the rest is 0.
    """
    m, d = latent.shape
    out = np.zeros(m)
    members = np.flatnonzero(variance[:, 0] < LARGE_VARIANCE) if d else np.zeros(0, int)
    if len(members) < 2:
        return out
    for i in members if rows is None else np.intersect1d(members, rows):
        others = members[members != i]
        density = latent_log_density(latent[i], latent[others], variance[i] + variance[others])
        out[i] = np.logaddexp.reduce(density) - np.log(len(members) - 1)
    return out


def posterior_samples(
    linearisation: Linearisation, estimate: SlamEstimate, count: int, rng: np.random.Generator
) -> PosteriorSamples:
    """Samples of all tracklets in the world frame."""
    _, delta = linearisation.samples(count, rng)
    R = estimate.T_world_landmark[:, :3, :3]
    return PosteriorSamples(np.einsum("mij,mjs->mis", R, delta[:, 3:]), np.einsum("mij,mjs->mis", R, delta[:, :3]))


def gap_covariance(samples: PosteriorSamples, a: Int[np.ndarray, " p"], b: Int[np.ndarray, " p"]) -> Float[np.ndarray, "p 3 3"]:
    """Covariance of the position of a less that of b, m^2."""
    out = np.empty((len(a), 3, 3))
    count = samples.position.shape[2]
    for start in range(0, len(a), 20000):
        part = slice(start, start + 20000)
        deviation = samples.position[a[part]] - samples.position[b[part]]
        out[part] = deviation @ np.swapaxes(deviation, 1, 2) / count
    return out


def without_own_landmark_equalities(
    gap: Float[np.ndarray, "p 3"],
    covariance: Float[np.ndarray, "p 3 3"],
    information: Float[np.ndarray, " p"],
) -> tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, "p 3 3"]]:
    """Gaps and their covariances in the graph without the pairs' own links, which pull each gap to zero.

    A link of information i makes `C^-1 = C0^-1 + i I` and `C^-1 g = C0^-1 g0`: judged under a graph that holds it, a false link
    speaks for itself (2 nats of 30 false ones). Information that a link alone holds cannot be taken off by difference: it
    is kept to `LINK_SHARE` of the whole.

    Args:
        gap: under the graph with links.
        covariance: of the gaps under the same graph.
        information: of each pair's own link in the graph, its kernel counted, m^-2; 0 where there is none.
    """
    linked = np.flatnonzero(information > 0)
    if not len(linked):
        return gap, covariance
    gap, covariance = gap.copy(), covariance.copy()
    value, vector = np.linalg.eigh(covariance[linked])
    share = np.minimum(information[linked, None] * value, LINK_SHARE)
    free = value / (1 - share)  # 1 / (1 / v - i)
    along = np.einsum("pji,pj->pi", vector, gap[linked]) / (1 - share)
    gap[linked] = np.einsum("pij,pj->pi", vector, along)
    covariance[linked] = np.einsum("pij,pj,pkj->pik", vector, free, vector)
    return gap, covariance


def link_information(
    links: LandmarkEqualities, estimate: SlamEstimate, width: float | None, a: Int[np.ndarray, " p"], b: Int[np.ndarray, " p"]
) -> Float[np.ndarray, " p"]:
    """Information that the link of each pair holds on its gap in the graph, m^-2; 0 where it has none."""
    if not len(links) or not len(a):
        return np.zeros(len(a))
    position = estimate.T_world_landmark[:, :3, 3]
    information = links.weight / links.scale[:, 1] ** 2
    if width is not None:  # the Cauchy kernel's weight at the estimate, of the position alone
        square = information * np.sum((position[links.a] - position[links.b]) ** 2, axis=1)
        information = information / (1 + square / width**2)
    number = len(position)
    key, total = np.unique(links.a * number + links.b, return_inverse=True)
    summed = np.bincount(total, weights=information)
    place = np.minimum(np.searchsorted(key, a * number + b), len(key) - 1)
    return np.where(key[place] == a * number + b, summed[place], 0.0)


def candidate_pairs(
    estimate: SlamEstimate,
    samples: PosteriorSamples,
    features: TrackletFeatures,
    prior: FeaturePrior,
    config: SlamConfig,
    *,
    inflation: float,
    floor: float,
    links: LandmarkEqualities | None = None,
) -> Pairs:
    """All pairs (newer, older) that are never seen together and whose gap is inside the gate, with their evidence.

    Args:
        inflation: factor on the sampled covariances (annealing).
        floor: standard deviation added to each coordinate of the gap, m (what one object's position varies by).
        links: links of the graph the samples are of; each pair is judged without its own.
    """
    position = estimate.T_world_landmark[:, :3, 3]
    m, _, count = samples.position.shape
    empty = np.zeros(0, dtype=np.int64)
    if m < 2:
        return Pairs(empty, empty, np.zeros(0), np.zeros(0))
    flat = samples.position.reshape(m, -1)
    norm = np.sum(flat**2, axis=1)
    square = np.sum(position**2, axis=1)
    chunk = int(np.clip(CHUNK_PAIRS // m, 1, 512))
    found = []
    for start in range(0, m, chunk):
        rows = np.arange(start, min(start + chunk, m))
        trace = (norm[rows, None] + norm[None] - 2 * flat[rows] @ flat.T) / count
        distance = square[rows, None] + square[None] - 2 * position[rows] @ position.T
        near = distance <= POSITION_GATE * (np.maximum(trace, 0) * inflation + 3 * floor**2)
        near &= features.last[None] < features.first[rows, None]
        i, j = np.nonzero(near)
        pairs = _with_evidence(rows[i], j, estimate, samples, features, prior, config, inflation, floor, links)
        found.append(_best_of_each(pairs))
    return Pairs(*(np.concatenate([getattr(p, name) for p in found]) for name in ("a", "b", "log_position", "log_feature")))


def _with_evidence(
    a: Int[np.ndarray, " p"],
    b: Int[np.ndarray, " p"],
    estimate: SlamEstimate,
    samples: PosteriorSamples,
    features: TrackletFeatures,
    prior: FeaturePrior,
    config: SlamConfig,
    inflation: float,
    floor: float,
    links: LandmarkEqualities | None,
) -> Pairs:
    """Those of some pairs whose category and position allow it, with their evidence."""
    position = estimate.T_world_landmark[:, :3, 3]
    compatible = prior.category_log_ratio(features.category[a], features.category[b]) > -20
    a, b = a[compatible], b[compatible]
    gap, covariance = position[a] - position[b], gap_covariance(samples, a, b)
    if links is not None:
        own = link_information(links, estimate, config.robust_width, a, b)
        gap, covariance = without_own_landmark_equalities(gap, covariance, own)
    covariance = inflation * covariance + floor**2 * np.eye(3)
    square, log_det = squared_distance(gap, covariance)
    inside = square < POSITION_GATE
    a, b = a[inside], b[inside]
    log_position = -0.5 * (square + log_det)[inside]
    return Pairs(a, b, log_position, feature_log_ratio(estimate, samples, features, prior, config, a, b))


def _best_of_each(pairs: Pairs) -> Pairs:
    """At most `MAX_CANDIDATES` older tracklets for each newer one, the best by evidence."""
    if not len(pairs) or np.bincount(pairs.a).max() <= MAX_CANDIDATES:
        return pairs
    order = np.lexsort((-(pairs.log_position + pairs.log_feature), pairs.a))
    a = pairs.a[order]
    rank = np.arange(len(a)) - np.searchsorted(a, a, "left")
    return pairs.select(np.sort(order[rank < MAX_CANDIDATES]))


def feature_log_ratio(
    estimate: SlamEstimate,
    samples: PosteriorSamples,
    features: TrackletFeatures,
    prior: FeaturePrior,
    config: SlamConfig,
    a: Int[np.ndarray, " p"],
    b: Int[np.ndarray, " p"],
) -> Float[np.ndarray, " p"]:
    """Log ratio of a's latent, category and orientation given that it is b to those of any object, nats."""
    ratio = prior.category_log_ratio(features.category[b], features.category[a])
    if features.latent.shape[1]:
        va, vb = features.latent_variance[a], features.latent_variance[b]
        known = (va[:, 0] < LARGE_VARIANCE) & (vb[:, 0] < LARGE_VARIANCE)
        latent = latent_log_density(features.latent[a], features.latent[b], va + vb) - features.log_population[a]
        ratio = np.where(known, latent + np.minimum(ratio, 0.0), ratio)
    both = np.flatnonzero(features.oriented[a] & features.oriented[b])
    if len(both):
        ratio[both] += _orientation_log_ratio(estimate, samples, features, config, a[both], b[both])
    return ratio


def _orientation_log_ratio(
    estimate: SlamEstimate,
    samples: PosteriorSamples,
    features: TrackletFeatures,
    config: SlamConfig,
    a: np.ndarray,
    b: np.ndarray,
) -> np.ndarray:
    R = estimate.T_world_landmark[:, :3, :3]
    scale = np.empty(len(a))
    for start in range(0, len(a), 20000):
        part = slice(start, start + 20000)
        deviation = samples.rotation[a[part]] - samples.rotation[b[part]]
        scale[part] = np.sqrt(np.mean(deviation**2, axis=(1, 2)) + 0.02**2)
    log_density = orientation_log_density(R[b], R[a], scale, features.symmetry[a], config)
    # The population of orientations: the tracklets about, for what stands beside a road stands along it, and as many of all,
    # seen with the same uncertainty as the pair's.
    oriented = np.flatnonzero(features.oriented)
    rows, inverse = np.unique(a, return_inverse=True)
    others = _neighbours_and_others(estimate.T_world_landmark[:, :3, 3], rows, oriented)
    typical = np.zeros(len(rows))
    np.maximum.at(typical, inverse, scale)
    count = others.shape[1]
    grid_a = np.repeat(rows, count)
    population = orientation_log_density(
        R[others.ravel()], R[grid_a], np.repeat(typical, count), features.symmetry[grid_a], config
    ).reshape(len(rows), count)
    population = np.where(others == rows[:, None], -np.inf, population)
    log_population = np.logaddexp.reduce(population, axis=1) - np.log(max(count, 1))
    from_uniform = orientation_log_density(R[a], R[a], np.full(len(a), 1e3), features.symmetry[a], config)
    return log_density - np.maximum(log_population[inverse], from_uniform)


def _neighbours_and_others(
    position: Float[np.ndarray, "m 3"], rows: Int[np.ndarray, " r"], among: Int[np.ndarray, " o"]
) -> Int[np.ndarray, "r c"]:
    """Some tracklets for each of some rows: the nearest ones, and as many evenly spread over all."""
    spread = among[:: max(1, len(among) // POPULATION)]
    _, nearest = KDTree(position[among]).query(position[rows], k=np.arange(1, min(POPULATION, len(among)) + 1))
    return np.concatenate([among[nearest], np.tile(spread, (len(rows), 1))], axis=1)
