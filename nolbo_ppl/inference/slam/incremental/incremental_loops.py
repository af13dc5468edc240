"""Loop closing of the online system: a window of ended tracks matched to older ones near enough under the coarse drift graph."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.geometry.pose import skew
from nolbo_ppl.inference.slam.clusters import join
from nolbo_ppl.inference.slam.consistent_cliques import find_closing
from nolbo_ppl.inference.slam.detection_features import FeaturePrior, correlated_variance
from nolbo_ppl.inference.slam.em import link_arrays, soft_assignment
from nolbo_ppl.inference.slam.graph import Links, SlamEstimate
from nolbo_ppl.inference.slam.incremental.drift_graph import DriftGraph
from nolbo_ppl.inference.slam.incremental.incremental_graph import OnlineGraph
from nolbo_ppl.inference.slam.loop_candidates import (
    POSITION_GATE,
    PosteriorSamples,
    TrackletFeatures,
    candidate_pairs,
    log_population,
)
from nolbo_ppl.inference.slam.slam_problem import NoiseModel, SlamConfig
from nolbo_ppl.inference.slam.slam_state import link_scale

SURE = 0.9
"""Soft links above this weight are closed online; the rest waits for the end."""
LINK_INTERVAL = 40
"""Keyframes between two solves for closed loops: links found sooner wait. Such a solve costs twenty keyframes."""
POPULATION = 300
"""Tracks the population of latents is taken from."""


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
    """Its variance, as if the views were independent."""
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


class LoopCloser:
    """Tracks that are landmarks, the drift between them, and the links closed so far."""

    def __init__(self, config: SlamConfig, prior: FeaturePrior) -> None:
        self.config, self.prior = config, prior
        self.drift = DriftGraph()
        self.tracks: list[Track] = []
        self.fresh: list[int] = []
        self.links: list[tuple[int, int]] = []
        self.position = np.zeros((0, 3))
        self.waiting: list[tuple[Links, list[tuple[int, int, np.ndarray, float]]]] = []
        self.solved_at = -LINK_INTERVAL

    def add(self, track: Track) -> None:
        """A track that entered the graph as its next landmark."""
        self.fresh.append(len(self.tracks))
        self.tracks.append(track)

    def close(self, frame: int, graph: OnlineGraph, noise: NoiseModel) -> int:
        """Match the newest window of ended tracks once enough of them are new; returns the number of links found."""
        if frame - self.solved_at >= LINK_INTERVAL and self.flush(graph):
            self.solved_at = frame
        ended = [j for j in self.fresh if frame - self.tracks[j].last > 1]
        half = max(self.config.constellation_size // 2, 1)
        if len(ended) < half:
            return 0
        taken = set(ended)
        self.fresh = [j for j in self.fresh if j not in taken]
        window = np.unique([*ended, *range(max(min(ended) - half, 0), min(ended))])
        rng = np.random.default_rng([self.config.seed, frame])
        error = self.drift.samples(self.config.samples, rng)
        self._look_up(graph, window)
        near = np.union1d(window, self._near(window, error, link_scale(noise)))
        poses = np.array([graph.landmark(j) for j in near.tolist()])
        tracks = [self.tracks[j] for j in near.tolist()]
        features = self._features(near, np.isin(near, window))
        samples = track_samples(poses, tracks, noise, error[self.drift.node(middle_frames(tracks))], rng)
        found = find_links(
            np.flatnonzero(np.isin(near, window)),
            SlamEstimate(np.zeros((0, 4, 4)), poses),
            samples,
            features,
            tracks,
            self.prior,
            self.config,
            self._links_among(near),
            floor=link_scale(noise),
            new_rate=noise.new_rate,
        )
        if found:
            self._link(found, near, poses, features, link_scale(noise))
            if frame - self.solved_at >= LINK_INTERVAL and self.flush(graph):
                self.solved_at = frame
        return len(found)

    def flush(self, graph: OnlineGraph) -> bool:
        """Put the links that wait into the graph and solve; whether there were any."""
        if not self.waiting:
            return False
        for links, ties in self.waiting:
            graph.add_links(links)
            for tie in ties:
                self.drift.close(*tie)
        graph.commit()
        self.waiting = []
        self.position = np.zeros((0, 3))  # the map has moved
        return True

    def _look_up(self, graph: OnlineGraph, window: Int[np.ndarray, " w"]) -> None:
        """Positions of landmarks new since the last time, and of the window; all of them after a closing has moved the map."""
        known = len(self.position)
        self.position = np.concatenate([self.position, np.zeros((len(self.tracks) - known, 3))])
        for j in {*range(known, len(self.tracks)), *window.tolist()}:
            self.position[j] = graph.landmark(j)[:3, 3]

    def _near(self, window: Int[np.ndarray, " w"], error: Float[np.ndarray, "n 6 s"], floor: float) -> Int[np.ndarray, " c"]:
        """Landmarks no farther from the window than the drift between their nodes can explain."""
        centre = self.position[window].mean(axis=0)
        reach = np.linalg.norm(self.position[window] - centre, axis=1).max()
        moved = error[:, 3:] - skew(centre) @ error[:, :3]
        here = int(self.drift.node(middle_frames([self.tracks[int(window[-1])]]))[0])
        variance = np.mean(np.sum((moved - moved[here]) ** 2, axis=1), axis=1)
        # As wide as the gate of pairs, and half as much again: this drift is that of the window's centre.
        radius = 1.5 * np.sqrt(POSITION_GATE * (variance + 3 * floor**2)) + reach
        node = self.drift.node(middle_frames(self.tracks))
        return np.flatnonzero(np.linalg.norm(self.position - centre, axis=1) < radius[node])

    def _features(self, near: Int[np.ndarray, " c"], inside: np.ndarray) -> TrackletFeatures:
        """Features of the given landmarks, arranged so that only those inside can be the newer one of a pair.

        How rare a latent is, is measured against tracks of the whole drive.
        """
        others = np.arange(0, len(self.tracks), max(1, len(self.tracks) // POPULATION))
        everyone = np.concatenate([near, np.setdiff1d(others, near)])
        latent = np.array([self.tracks[j].latent for j in everyone.tolist()])
        views = np.array([len(self.tracks[j].rows) for j in everyone.tolist()], dtype=np.float64)
        variance = correlated_variance(
            np.array([self.tracks[j].latent_variance for j in everyone.tolist()]),
            views,
            self.config.latent_correlation or 0.0,
        )
        rarity = log_population(latent, variance, np.flatnonzero(inside))
        tracks, count = [self.tracks[j] for j in near.tolist()], len(near)
        first = np.array([t.first for t in tracks])
        return TrackletFeatures(
            latent=latent[:count],
            latent_variance=variance[:count],
            log_population=rarity[:count],
            category=np.array([t.category for t in tracks]),
            symmetry=np.array([t.symmetry for t in tracks]),
            oriented=np.array([t.oriented for t in tracks]),
            first=np.where(inside, first, -1),
            last=np.array([t.last for t in tracks]),
        )

    def _links_among(self, near: Int[np.ndarray, " c"]) -> Int[np.ndarray, "l 2"]:
        """Links with both ends among the given landmarks, in their numbering."""
        number = {int(j): i for i, j in enumerate(near)}
        inside = [(number[a], number[b]) for a, b in self.links if a in number and b in number]
        return np.array(inside, dtype=np.int64).reshape(-1, 2)

    def _link(
        self,
        found: list[tuple[int, int]],
        near: Int[np.ndarray, " c"],
        poses: Float[np.ndarray, "c 4 4"],
        features: TrackletFeatures,
        scale: float,
    ) -> None:
        pairs = np.array(found, dtype=np.int64)
        links = link_arrays(poses[:, :3, :3], features, pairs[:, 0], pairs[:, 1], np.ones(len(pairs)), scale)
        a, b = near[pairs[:, 0]], near[pairs[:, 1]]
        middle = middle_frames(self.tracks)
        ties = [(int(middle[i]), int(middle[j]), poses[row, :3, 3], 2 * scale) for i, j, row in zip(a, b, pairs[:, 1])]
        self.waiting.append((Links(a, b, links.weight, links.T_a_b, links.scale), ties))
        self.links += list(zip(a.tolist(), b.tolist()))


def middle_frames(tracks: list[Track]) -> Int[np.ndarray, " m"]:
    """Frame in the middle of each track's life."""
    return np.array([(t.first + t.last) // 2 for t in tracks], dtype=np.int64)


def track_samples(
    T_world_landmark: Float[np.ndarray, "m 4 4"],
    tracks: list[Track],
    noise: NoiseModel,
    error: Float[np.ndarray, "m 6 s"],
    rng: np.random.Generator,
) -> PosteriorSamples:
    """Samples of landmarks: the drift of their nodes, and the noise of their own detections."""
    moved = np.cross(error[:, :3], T_world_landmark[:, :3, 3, None], axis=1) + error[:, 3:]
    own, turn = 0.1, 0.1
    if len(noise.position_covariance):
        own = float(np.sqrt(np.median(np.trace(noise.position_covariance, axis1=1, axis2=2)) / 3))
        turn = float(np.median(noise.rotation_scale))
    share = 1.0 / np.sqrt([len(t.rows) for t in tracks])[:, None, None]
    return PosteriorSamples(
        moved + own * share * rng.standard_normal(moved.shape), error[:, :3] + turn * share * rng.standard_normal(moved.shape)
    )


def find_links(
    window: Int[np.ndarray, " w"],
    estimate: SlamEstimate,
    samples: PosteriorSamples,
    features: TrackletFeatures,
    tracks: list[Track],
    prior: FeaturePrior,
    config: SlamConfig,
    links: Int[np.ndarray, "l 2"],
    *,
    floor: float,
    new_rate: float,
) -> list[tuple[int, int]]:
    """Links of the window's tracks: a constellation when one passes, then single ones that are sure."""
    pairs = candidate_pairs(estimate, samples, features, prior, config, inflation=1.0, floor=floor)
    pairs = pairs.select(~np.isin(pairs.a, links[:, 0]))
    outside = pairs.select(~np.isin(pairs.b, window))
    closing = find_closing(outside, estimate, samples, config, inflation=1.0, floor=floor, log_new=float(np.log(5.0 * new_rate)))
    found: list[tuple[int, int]] = []
    least = config.constellation_log_odds
    if closing and closing.log_odds > least and closing.margin > least / 2:
        found += list(zip(closing.a.tolist(), closing.b.tolist()))
    rest = pairs.select(~np.isin(pairs.a, [a for a, _ in found]))
    if len(rest):
        frames = [frozenset(range(t.first, t.last + 1)) for t in tracks]
        closed = Links(links[:, 0], links[:, 1], np.ones(len(links)), np.zeros((0, 4, 4)), np.zeros((0, 2)))
        cluster = join(closed, frames, config.merge_weight)
        a, b, weight, _ = soft_assignment(rest, features, cluster, float(np.log(new_rate)), config)
        found += [(int(i), int(j)) for i, j, w in zip(a, b, weight) if w > SURE]
    return found
