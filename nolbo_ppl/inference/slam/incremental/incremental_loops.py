"""Which landmarks of the running map are one: tracks that begin are put to landmarks met again, ended ones close loops.

On known ground a new track is compared with the landmarks that the drift allows to be there; where the association is sure
the landmark is used again and nothing new enters the graph. After drift a window of ended tracks is matched to older
landmarks (a constellation first, then single ones that are sure), and what is found to be one becomes one landmark.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.geometry.pose import skew
from nolbo_ppl.inference.slam.consistent_cliques import find_loop_closure
from nolbo_ppl.inference.slam.em import link_arrays, soft_assignment
from nolbo_ppl.inference.slam.graph import UNINFORMATIVE_ROTATION_SIGMA, SlamEstimate
from nolbo_ppl.inference.slam.incremental.drift_graph import DriftGraph
from nolbo_ppl.inference.slam.incremental.incremental_graph import IncrementalGraph
from nolbo_ppl.inference.slam.incremental.running_map import RunningLandmark, RunningMap, landmark_features
from nolbo_ppl.inference.slam.loop_candidates import (
    POSITION_GATE,
    Pairs,
    PosteriorSamples,
    TrackletFeatures,
    candidate_pairs,
)
from nolbo_ppl.inference.slam.slam_problem import NoiseModel, SlamConfig
from nolbo_ppl.inference.slam.slam_state import link_scale, object_log_density

SURE_WEIGHT = 0.9
"""Associations above this weight are made online; the rest waits for more detections, or for the end."""
SOLVE_INTERVAL = 10
"""Keyframes between two solves for closed loops: what is found sooner waits."""
SHARP = 5.0
"""A single pair is believed where the drift between the two is below this many scales of a detected position; after more
drift a constellation must agree. Without this bound one pair in 300 objects and 25 m of drift was wrong, and bent the map."""
LONGEST_WAIT = 50
"""Keyframes an ended track waits for others to be matched together with."""


@dataclass(frozen=True)
class Merge:
    """Two landmarks found to be one."""

    a: int
    """The newer one, which goes."""
    b: int
    """The older one."""
    T_a_b: Float[np.ndarray, "4 4"]
    """Turn between their axes, `L_b = L_a T_a_b`."""
    agree: bool
    """Whether their orientations do."""


class LoopCloser:
    """The running map, the drift between its parts, and what is about to be merged."""

    def __init__(self, config: SlamConfig, running: RunningMap) -> None:
        self.config, self.map = config, running
        self.drift = DriftGraph()
        self.fresh: list[int] = []
        self.waiting: list[Merge] = []
        self.solved_at = -SOLVE_INTERVAL

    # -- landmarks met again ------------------------------------------------------------------------------------------

    def meet(
        self,
        drafts: list[RunningLandmark],
        poses: list[Float[np.ndarray, "4 4"]],
        frame: int,
        taken: set[int],
        graph: IncrementalGraph,
        noise: NoiseModel,
    ) -> tuple[list[tuple[int, float]], list[float]]:
        """Compare tracks that begin with the landmarks that may be there.

        Args:
            drafts: what the tracks gathered so far.
            poses: their poses in the world frame of the graph.
            frame: the keyframe.
            taken: landmarks that belong to other live tracks.

        Returns:
            The likeliest landmark of each track (-1: none) with its probability, and the probability of each being new.
        """
        count = len(drafts)
        if not len(self.map) or not count:
            return [(-1, 0.0)] * count, [1.0] * count
        rng = np.random.default_rng([self.config.seed, frame, 1])
        error = self.drift.samples(self.config.samples, rng)
        here = self.drift.samples_here(self.config.samples, rng)
        floor = link_scale(noise)
        near: set[int] = set()
        for T in poses:
            near.update(self._reachable(T[:3, 3], here, error, floor))
        old = [j for j in sorted(near - taken) if self.map.landmarks[j].last < frame]
        if not old:
            return [(-1, 0.0)] * count, [1.0] * count
        landmarks = [self.map.landmarks[j] for j in old]
        T_all = np.array([graph.landmark(j) for j in old] + poses)
        for j, T in zip(old, T_all):
            self._place(j, T[:3, 3])
        everyone = landmarks + drafts
        fresh = np.arange(len(old), len(everyone))
        features = landmark_features(everyone, fresh, self.map.population(), self.config.latent_correlation or 0.0)
        errors = np.concatenate([error[self.drift.rows(np.array([j.place for j in landmarks]))], np.tile(here, (count, 1, 1))])
        samples = landmark_samples(T_all, everyone, noise, errors, rng)
        pairs = compare(T_all, samples, features, everyone, fresh, self.map, self.config, floor)
        pairs = sharp(pairs.select(pairs.b < len(old)), samples, floor)
        best, new = [(-1, 0.0)] * count, [1.0] * count
        if not len(pairs):
            return best, new
        # All begin in one frame, so they are different objects.
        times = np.where(np.arange(len(everyone)) < len(old), frame + 1, frame)
        features = replace(features, first=times, last=times)
        a, b, weight, _ = soft_assignment(
            pairs, features, np.arange(len(everyone)), object_log_density(noise), replace(self.config, equality_minimum=1e-6)
        )
        for i, j, w in zip(a.tolist(), b.tolist(), weight.tolist()):
            k = i - len(old)
            new[k] -= w
            if w > best[k][1]:
                best[k] = (old[j], w)
        return best, new

    def met(self, landmark: int, position: Float[np.ndarray, " 3"], noise: NoiseModel) -> None:
        """The camera is where this landmark is."""
        self.drift.meet(self.map.landmarks[landmark].place, position, 2 * link_scale(noise))

    def _place(self, number: int, position: Float[np.ndarray, " 3"]) -> None:
        self.map.position[np.searchsorted(self.map.numbers, number)] = position

    def _reachable(
        self, centre: Float[np.ndarray, " 3"], here: Float[np.ndarray, "6 s"], error: Float[np.ndarray, "n 6 s"], floor: float
    ) -> list[int]:
        """Landmarks no farther from a point than the drift between them and the camera can explain."""
        moved = error[:, 3:] - skew(centre) @ error[:, :3]
        own = here[3:] - skew(centre) @ here[:3]
        variance = np.mean(np.sum((moved - own) ** 2, axis=1), axis=1)
        radius = np.sqrt(POSITION_GATE * (variance + 3 * (2 * floor) ** 2))
        place = np.array([self.map.landmarks[j].place for j in self.map.numbers.tolist()])
        return self.map.near(centre, radius[self.drift.rows(place)])

    # -- loops --------------------------------------------------------------------------------------------------------

    def add(self, landmark: RunningLandmark, position: Float[np.ndarray, " 3"]) -> None:
        """A landmark new to the map."""
        self.map.add(landmark, position)
        self.fresh.append(landmark.number)

    def close(self, frame: int, graph: IncrementalGraph, noise: NoiseModel, live: set[int]) -> int:
        """Match the newest window of landmarks whose tracks have ended to older ones; returns the number of pairs found."""
        if self.waiting and frame - self.solved_at >= SOLVE_INTERVAL:
            self.flush(frame, graph)
        self.fresh = [j for j in self.fresh if j in self.map.landmarks]
        ended = [j for j in self.fresh if j not in live and frame - self.map.landmarks[j].last > 1]
        half = max(self.config.clique_window // 2, 1)
        if not ended or (len(ended) < half and frame - min(self.map.landmarks[j].last for j in ended) < LONGEST_WAIT):
            return 0
        taken = set(ended)
        self.fresh = [j for j in self.fresh if j not in taken]
        going = {merge.a for merge in self.waiting}
        first = int(np.searchsorted(self.map.numbers, min(ended)))
        since = min(self.map.landmarks[j].first for j in ended) - LONGEST_WAIT
        before = [j for j in self.map.numbers[max(first - half, 0) : first].tolist() if self.map.landmarks[j].first >= since]
        window = sorted({*taken, *before} - going)[-4 * half :]
        rng = np.random.default_rng([self.config.seed, frame, 0])
        error = self.drift.samples(self.config.samples, rng)
        for j in window:
            self._place(j, graph.landmark(j)[:3, 3])
        floor = link_scale(noise)
        near = sorted({*window, *self._near(window, error, floor)} - going)
        landmarks = [self.map.landmarks[j] for j in near]
        T = np.array([graph.landmark(j) for j in near])
        fresh = np.flatnonzero(np.isin(near, window))
        features = landmark_features(landmarks, fresh, self.map.population(), self.config.latent_correlation or 0.0)
        places = self.drift.rows(np.array([j.place for j in landmarks]))
        samples = landmark_samples(T, landmarks, noise, error[places], rng)
        pairs = compare(T, samples, features, landmarks, fresh, self.map, self.config, floor)
        found = find_merges(pairs, fresh, T, samples, features, self.config, floor=floor, log_new=object_log_density(noise))
        if found:
            self._note(found, near, T, features, floor)
            if frame - self.solved_at >= SOLVE_INTERVAL:
                self.flush(frame, graph)
        return len(found)

    def forget(self, landmarks: set[int]) -> None:
        """Landmarks that are no longer in the graph."""
        self.map.forget(landmarks)
        self.fresh = [j for j in self.fresh if j not in landmarks]
        self.waiting = [m for m in self.waiting if not {self.map.standing(m.a), self.map.standing(m.b)} & landmarks]

    def _near(self, window: list[int], error: Float[np.ndarray, "n 6 s"], floor: float) -> list[int]:
        """Landmarks no farther from the window than the drift between their places can explain."""
        rows = np.searchsorted(self.map.numbers, window)
        centre = self.map.position[rows].mean(axis=0)
        reach = np.linalg.norm(self.map.position[rows] - centre, axis=1).max()
        moved = error[:, 3:] - skew(centre) @ error[:, :3]
        place = self.drift.rows(np.array([self.map.landmarks[j].place for j in self.map.numbers.tolist()]))
        variance = np.mean(np.sum((moved - moved[place[rows[-1]]]) ** 2, axis=1), axis=1)
        # As wide as the gate of pairs, and half as much again: this drift is that of the window's centre.
        radius = 1.5 * np.sqrt(POSITION_GATE * (variance + 3 * floor**2)) + reach
        return self.map.near(centre, radius[place])

    def _note(
        self,
        found: list[tuple[int, int]],
        near: list[int],
        T: Float[np.ndarray, "c 4 4"],
        features: TrackletFeatures,
        floor: float,
    ) -> None:
        pairs = np.array(found, dtype=np.int64)
        links = link_arrays(T[:, :3, :3], features, pairs[:, 0], pairs[:, 1], np.ones(len(pairs)), floor)
        for k, (i, j) in enumerate(found):
            both = features.oriented[i] and features.oriented[j] and features.symmetry[i] != 0 and features.symmetry[j] != 0
            agree = not both or links.scale[k, 0] < UNINFORMATIVE_ROTATION_SIGMA
            self.waiting.append(Merge(near[i], near[j], links.T_a_b[k], bool(agree)))
            a, b = self.map.landmarks[near[i]], self.map.landmarks[near[j]]
            self.drift.close(a.place, b.place, T[j, :3, 3], 2 * floor)

    def flush(self, frame: int, graph: IncrementalGraph) -> bool:
        """Merge what waits and solve; whether anything was merged."""
        oldest = None
        for merge in self.waiting:
            a, b = self.map.standing(merge.a), self.map.standing(merge.b)
            if a == b or a != merge.a or self.map.landmarks[a].together_with(self.map.landmarks[b]):
                continue
            graph.merge(a, b, merge.T_a_b, agree=merge.agree)
            self.map.merge(a, b)
            oldest = a if oldest is None else min(oldest, a)
        self.waiting = []
        if oldest is None:
            return False
        self.solved_at = frame
        graph.settle()
        for k, j in enumerate(self.map.numbers.tolist()):
            self.map.position[k] = graph.landmark(j)[:3, 3]
        # The map has moved: what found no partner before may find one now.
        since = frame - 2 * LONGEST_WAIT
        again = [
            j
            for j in self.map.numbers.tolist()
            if j >= oldest - self.config.clique_window and self.map.landmarks[j].first >= since
        ]
        self.fresh = sorted({*self.fresh, *again})
        return True


def compare(
    T_world_landmark: Float[np.ndarray, "m 4 4"],
    samples: PosteriorSamples,
    features: TrackletFeatures,
    landmarks: list[RunningLandmark],
    fresh: Int[np.ndarray, " f"],
    running: RunningMap,
    config: SlamConfig,
    floor: float,
) -> Pairs:
    """Candidate pairs of a fresh landmark and one before it in the list, never seen together."""
    order = np.arange(len(landmarks))
    spans = replace(features, first=np.where(np.isin(order, fresh), order, -1), last=order)
    estimate = SlamEstimate(np.zeros((0, 4, 4)), T_world_landmark)
    pairs = candidate_pairs(estimate, samples, spans, running.prior, config, inflation=1.0, floor=floor)
    apart = [not landmarks[a].together_with(landmarks[b]) for a, b in zip(pairs.a.tolist(), pairs.b.tolist())]
    return pairs.select(np.array(apart, dtype=bool))


def sharp(pairs: Pairs, samples: PosteriorSamples, floor: float) -> Pairs:
    """Pairs whose drift is small enough for one of them to be believed alone."""
    gap = samples.position[pairs.a] - samples.position[pairs.b]
    return pairs.select(np.mean(gap**2, axis=(1, 2)) < (SHARP * 2 * floor) ** 2 if len(pairs) else np.zeros(0, bool))


def landmark_samples(
    T_world_landmark: Float[np.ndarray, "m 4 4"],
    landmarks: list[RunningLandmark],
    noise: NoiseModel,
    error: Float[np.ndarray, "m 6 s"],
    rng: np.random.Generator,
) -> PosteriorSamples:
    """Samples of landmarks: the drift of their places, and the noise of their own detections."""
    moved = np.cross(error[:, :3], T_world_landmark[:, :3, 3, None], axis=1) + error[:, 3:]
    own, turn = 0.1, 0.1
    if len(noise.position_covariance):
        own = float(np.sqrt(np.median(np.trace(noise.position_covariance, axis1=1, axis2=2)) / 3))
        turn = float(np.median(noise.rotation_scale))
    share = 1.0 / np.sqrt([max(j.views, 1) for j in landmarks])[:, None, None]
    return PosteriorSamples(
        moved + own * share * rng.standard_normal(moved.shape), error[:, :3] + turn * share * rng.standard_normal(moved.shape)
    )


def find_merges(
    pairs: Pairs,
    fresh: Int[np.ndarray, " f"],
    T_world_landmark: Float[np.ndarray, "m 4 4"],
    samples: PosteriorSamples,
    features: TrackletFeatures,
    config: SlamConfig,
    *,
    floor: float,
    log_new: float,
) -> list[tuple[int, int]]:
    """Fresh landmarks that are older ones: a constellation when one passes, then single ones that are sure."""
    estimate = SlamEstimate(np.zeros((0, 4, 4)), T_world_landmark)
    outside = pairs.select(~np.isin(pairs.b, fresh))
    closing = find_loop_closure(outside, estimate, samples, config, inflation=1.0, floor=floor, log_new=log_new)
    found: list[tuple[int, int]] = []
    least = config.clique_log_odds
    if closing and closing.log_odds > least and closing.margin > least / 2:
        found += list(zip(closing.a.tolist(), closing.b.tolist()))
    used = [i for pair in found for i in pair]
    rest = sharp(pairs.select(~np.isin(pairs.a, used) & ~np.isin(pairs.b, used)), samples, floor)
    if len(rest):
        a, b, weight, _ = soft_assignment(rest, features, np.arange(len(features.first)), log_new, config)
        for k in np.argsort(-weight, kind="stable"):
            if weight[k] > SURE_WEIGHT and int(a[k]) not in used and int(b[k]) not in used:
                found.append((int(a[k]), int(b[k])))
                used += found[-1]
    return found
