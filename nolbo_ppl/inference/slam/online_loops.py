"""Loop closing of the online system: a window of ended tracks matched to all older ones under the coarse drift graph."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.inference.slam.clusters import join
from nolbo_ppl.inference.slam.config import NoiseModel, SlamConfig
from nolbo_ppl.inference.slam.constellation import find_closing
from nolbo_ppl.inference.slam.drift import DriftGraph
from nolbo_ppl.inference.slam.em import soft_assignment
from nolbo_ppl.inference.slam.evidence import PosteriorSamples, TrackletFeatures, candidate_pairs, log_population
from nolbo_ppl.inference.slam.features import FeaturePrior
from nolbo_ppl.inference.slam.graph import Estimate, Links

SURE = 0.9
"""Soft links above this weight are closed online; the rest waits for the end."""


@dataclass
class Track:
    """A track as the online system keeps it."""

    rows: list[int]
    """Its detections."""
    landmark: int
    """Landmark in the graph, -1 while it is too short."""
    latent: Float[np.ndarray, " d"]
    """Fused latent."""
    latent_variance: Float[np.ndarray, " d"]
    """Its variance."""
    category: int
    """Category of the first detection."""
    symmetry: int
    """Its symmetry."""
    oriented: bool
    """Whether it is oriented."""
    first: int
    """First frame."""
    last: int
    """Last frame."""
    R: Float[np.ndarray, "3 3"]
    """Orientation in the odometry's world frame."""


def window_features(tracks: list[Track], window: Int[np.ndarray, " w"]) -> TrackletFeatures:
    """Features of all tracks, arranged so that only tracks of the window can be the newer one of a pair."""
    latent, variance = np.array([t.latent for t in tracks]), np.array([t.latent_variance for t in tracks])
    inside = np.isin(np.arange(len(tracks)), window)
    first = np.array([t.first for t in tracks])
    return TrackletFeatures(
        latent=latent, latent_variance=variance, log_population=log_population(latent, variance, window),
        category=np.array([t.category for t in tracks]), symmetry=np.array([t.symmetry for t in tracks]),
        oriented=np.array([t.oriented for t in tracks]), first=np.where(inside, first, -1),
        last=np.array([t.last for t in tracks]),
    )


def track_samples(
    T_world_landmark: Float[np.ndarray, "m 4 4"], tracks: list[Track], noise: NoiseModel, drift: DriftGraph, count: int,
    rng: np.random.Generator,
) -> PosteriorSamples:
    """Samples of all landmarks: the drift of their node, and the noise of their own detections."""
    middle = np.array([(t.first + t.last) // 2 for t in tracks])
    error = drift.samples(count, rng)[drift.node(middle)]
    moved = np.cross(error[:, :3], T_world_landmark[:, :3, 3, None], axis=1) + error[:, 3:]
    own, turn = 0.1, 0.1
    if len(noise.position_covariance):
        own = float(np.sqrt(np.median(np.trace(noise.position_covariance, axis1=1, axis2=2)) / 3))
        turn = float(np.median(noise.rotation_scale))
    share = 1.0 / np.sqrt([len(t.rows) for t in tracks])[:, None, None]
    return PosteriorSamples(moved + own * share * rng.standard_normal(moved.shape),
                            error[:, :3] + turn * share * rng.standard_normal(moved.shape))


def find_links(
    window: Int[np.ndarray, " w"],
    tracks: list[Track],
    estimate: Estimate,
    samples: PosteriorSamples,
    prior: FeaturePrior,
    config: SlamConfig,
    links: list[tuple[int, int]],
    *,
    floor: float,
    new_rate: float,
) -> tuple[list[tuple[int, int]], TrackletFeatures]:
    """Links of the window's tracks: a constellation when one passes, then single ones that are sure."""
    features = window_features(tracks, window)
    pairs = candidate_pairs(estimate, samples, features, prior, config, inflation=1.0, floor=floor)
    pairs = pairs.select(~np.isin(pairs.a, [a for a, _ in links]))
    outside = pairs.select(~np.isin(pairs.b, window))
    closing = find_closing(outside, estimate, samples, config, inflation=1.0, floor=floor,
                           log_new=float(np.log(5.0 * new_rate)))
    found: list[tuple[int, int]] = []
    least = config.constellation_log_odds
    if closing and closing.log_odds > least and closing.margin > least / 2:
        found += list(zip(closing.a.tolist(), closing.b.tolist()))
    rest = pairs.select(~np.isin(pairs.a, [a for a, _ in found]))
    if len(rest):
        frames = [frozenset(range(t.first, t.last + 1)) for t in tracks]
        known = np.array(links, dtype=np.int64).reshape(-1, 2)
        closed = Links(known[:, 0], known[:, 1], np.ones(len(known)), np.zeros((0, 4, 4)), np.zeros((0, 2)))
        cluster = join(closed, frames, config.merge_weight)
        a, b, weight, _ = soft_assignment(rest, features, cluster, float(np.log(new_rate)), config)
        found += [(int(i), int(j)) for i, j, w in zip(a, b, weight) if w > SURE]
    return found, features
