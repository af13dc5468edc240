"""Short-term tracks: detections of one object in neighbouring frames, put together in the odometry frame.

Each frame is one association problem with exact marginals: a detection belongs to a live track, founds a new one, or is
background. Odometry drifts little over the life of a track, so tracks are reliable; they are what later is associated
over loops, each with the evidence of all its detections.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from nolbo_ppl.geometry.pose import transform
from nolbo_ppl.inference.slam.detection_features import FeaturePrior, fuse_latent
from nolbo_ppl.inference.slam.frame_marginals import frame_marginals
from nolbo_ppl.inference.slam.gaussian import squared_distance
from nolbo_ppl.inference.slam.latent_mixture import LARGE_VARIANCE, LatentMixture
from nolbo_ppl.inference.slam.measurements import Measurements, resolve
from nolbo_ppl.inference.slam.near_pairs import near_pairs
from nolbo_ppl.inference.slam.orientation import UNIFORM_LOG_DENSITY, OrientationModes, mixture_log_density
from nolbo_ppl.inference.slam.slam_problem import NoiseModel, SlamConfig, SlamProblem
from nolbo_ppl.progress import progress_bar

GATE = 30.0
"""Squared Mahalanobis distance beyond which a detection cannot belong to a track (3 degrees of freedom: p = 1e-6)."""
MIN_NEW = -5.0
"""Log odds of a new object against clutter below which a detection founds no track."""


@dataclass(frozen=True)
class Tracklets:
    """Short-term tracks and the detections they are made of."""

    of_observation: Int[np.ndarray, " k"]
    """Track of each detection, -1 for none."""
    weight: Float[np.ndarray, " k"]
    """Marginal probability of that assignment within its frame."""
    first: Int[np.ndarray, " m"]
    """Frame of the first detection."""
    last: Int[np.ndarray, " m"]
    """Frame of the last one."""
    count: Int[np.ndarray, " m"]
    """Number of detections."""
    moving: Bool[np.ndarray, " m"]
    """Tracks of objects that move."""

    def __len__(self) -> int:
        return len(self.first)


class Tracker:
    """The live tracks, advanced frame by frame; what the batch front end and the online one share."""

    def __init__(
        self, config: SlamConfig, dimension: int, prior: FeaturePrior, birth_intensity: float, clutter_intensity: float
    ) -> None:
        self.config, self.prior = config, prior
        self.birth_intensity, self.clutter_intensity = birth_intensity, clutter_intensity
        self.index = np.zeros(0, dtype=np.int64)
        self.mean = np.zeros((0, 3))
        self.covariance = np.zeros((0, 3, 3))
        self.last = np.zeros(0, dtype=np.int64)
        self.modes = OrientationModes(np.zeros((0, 1)), np.zeros((0, 1, 3, 3)), np.zeros((0, 1)))
        self.oriented = np.zeros(0, dtype=bool)
        self.latent = np.zeros((0, dimension))
        self.latent_variance = np.zeros((0, dimension))
        self.latent_modes: LatentMixture | None = None
        self.category = np.zeros(0, dtype=np.int64)
        self.total = 0

    def predict(
        self, T_world_camera: Float[np.ndarray, "4 4"], frame: int, rotation_step: float, translation_step: float
    ) -> None:
        """Drop tracks not seen for long; widen the others by the drift of one step at their distance."""
        live = frame - self.last <= self.config.track_gap
        if not live.all():
            self._keep(live)
        distance = self.mean - T_world_camera[:3, 3]
        variance = translation_step**2 + rotation_step**2 * np.sum(distance**2, axis=1)
        self.covariance += variance[:, None, None] * np.eye(3)

    def _keep(self, rows: np.ndarray) -> None:
        for name in ("index", "mean", "covariance", "last", "oriented", "latent", "latent_variance", "category"):
            setattr(self, name, getattr(self, name)[rows])
        self.modes = self.modes.select(rows)
        if self.latent_modes is not None:
            self.latent_modes = self.latent_modes.select(rows)

    def associate(self, measurements: Measurements, frame: int) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Assign one frame's detections (in the world frame) to tracks and found new ones; track and marginal, -1: background."""
        seen, n = measurements, len(measurements)
        count = max(seen.modes.log_weight.shape[1], self.modes.log_weight.shape[1])
        modes, self.modes = seen.modes.padded(count), self.modes.padded(count)
        latents = self._room_for(seen)
        log_new = seen.log_object + np.log(self.birth_intensity)
        log_clutter = seen.log_clutter + np.log(self.clutter_intensity)
        k, j, value = self._log_odds(seen, modes, latents)
        found_pairs = frame_marginals(
            np.zeros(n, dtype=np.int64), k, j, value, np.logaddexp(log_new, log_clutter), associator=self.config.associator
        )
        assigned, weight = np.full(n, -1, dtype=np.int64), found_pairs.null.copy()
        for p in np.flatnonzero(found_pairs.weight > 0.5):
            i, track = int(k[p]), int(j[p])
            self._update(track, seen.position[i], seen.covariance[i], frame)
            self._update_latent(track, seen.latent[i], seen.latent_variance[i], latents, i)
            if seen.oriented[i]:
                self._orient(track, modes.select(np.array([i])), seen.symmetry[[i]])
            assigned[i], weight[i] = self.index[track], found_pairs.weight[p]
        # Hopeless ones found no track: the more there are, the more chance pairs.
        rows = np.flatnonzero((assigned < 0) & (found_pairs.null > 0.5) & (log_new - log_clutter > MIN_NEW))
        if len(rows):
            assigned[rows] = self._found(seen, modes, rows, frame)
        return assigned, weight

    def _room_for(self, seen: Measurements) -> LatentMixture | None:
        """Modes of the detections' latents, padded as those of the tracks; None where neither has any."""
        if self.latent_modes is None and seen.latent_modes is None:
            return None
        own, latents = self.latent_modes or LatentMixture.of_one(self.latent), seen.latent_modes
        latents = latents or LatentMixture.of_one(seen.latent)
        count = max(own.log_weight.shape[1], latents.log_weight.shape[1])
        self.latent_modes = own.padded(count)
        return latents.padded(count)

    def _log_odds(
        self, seen: Measurements, modes: OrientationModes, latents: LatentMixture | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pairs of detections and tracks inside the gate and their log odds: density over that of any object, per m^3."""
        seen_reach, track_reach = (GATE * np.trace(S, axis1=1, axis2=2) for S in (seen.covariance, self.covariance))
        k, j = near_pairs(seen.position, seen_reach, self.mean, track_reach)
        square, log_det = squared_distance(seen.position[k] - self.mean[j], seen.covariance[k] + self.covariance[j])
        inside = square < GATE
        k, j = k[inside], j[inside]
        value = seen.log_object[k] - 0.5 * (square + log_det)[inside]
        both = np.flatnonzero(seen.oriented[k] & self.oriented[j])
        if len(both):
            value[both] += self._orientation(j[both], modes.select(k[both]), seen.symmetry[k[both]])
        value += self.prior.log_likelihood_ratio(
            seen.latent[k],
            seen.latent_variance[k],
            seen.category[k],
            self.latent[j],
            self.latent_variance[j],
            self.category[j],
            None if latents is None else latents.select(k),
            None if self.latent_modes is None else self.latent_modes.select(j),
        )
        return k, j, value

    def _found(self, seen: Measurements, modes: OrientationModes, rows: np.ndarray, frame: int) -> Int[np.ndarray, " r"]:
        """New tracks at these detections; their numbers."""
        new = np.arange(self.total, self.total + len(rows))
        self.total += len(rows)
        self.index = np.concatenate([self.index, new])
        self.mean = np.concatenate([self.mean, seen.position[rows]])
        self.covariance = np.concatenate([self.covariance, seen.covariance[rows]])
        self.last = np.concatenate([self.last, np.full(len(rows), frame)])
        self.oriented = np.concatenate([self.oriented, seen.oriented[rows]])
        self.modes = OrientationModes(
            *(np.concatenate([getattr(self.modes, name), getattr(modes, name)[rows]]) for name in ("log_weight", "R", "scale"))
        )
        if self.latent_modes is not None:
            more = (seen.latent_modes or LatentMixture.of_one(seen.latent)).select(rows)
            self.latent_modes = self.latent_modes.stacked(more)
        self.latent = np.concatenate([self.latent, seen.latent[rows]])
        self.latent_variance = np.concatenate([self.latent_variance, seen.latent_variance[rows]])
        self.category = np.concatenate([self.category, seen.category[rows]])
        return new

    def _update(self, j: int, position: np.ndarray, covariance: np.ndarray, frame: int) -> None:
        gain = np.linalg.solve(self.covariance[j] + covariance, self.covariance[j]).T
        self.mean[j] += gain @ (position - self.mean[j])
        self.covariance[j] = self.covariance[j] - gain @ self.covariance[j]
        self.covariance[j] = 0.5 * (self.covariance[j] + self.covariance[j].T)
        self.last[j] = frame

    def _update_latent(self, j: int, latent: np.ndarray, variance: np.ndarray, modes: LatentMixture | None, i: int) -> None:
        """Each mode of the track takes the detection's likeliest one and is weighed by how likely it made the detection."""
        own, tracks = self.latent_variance[j].copy(), self.latent_modes
        self.latent[j], self.latent_variance[j] = fuse_latent(self.latent[j], own, latent, variance)
        if modes is None or tracks is None or not (variance < LARGE_VARIANCE).all():
            return
        seen = modes.select(np.array([i]))
        if not (own < LARGE_VARIANCE).all():  # the first latent founds the track's modes
            tracks.log_weight[j], tracks.mean[j] = seen.log_weight[0], seen.mean[0]
            return
        error = seen.mean - tracks.mean[j][:, None]
        joint = tracks.log_weight[j][:, None] + seen.log_weight - 0.5 * np.sum(error**2 / (own + variance), axis=-1)
        likeliest = seen.mean[0, np.argmax(joint, axis=1)]
        tracks.mean[j] = fuse_latent(tracks.mean[j], own, likeliest, variance)[0]
        weight = np.logaddexp.reduce(joint, axis=1)
        tracks.log_weight[j] = weight - np.logaddexp.reduce(weight)
        self.latent[j] = tracks.mean[j, np.argmax(weight)]

    def _by_mode(self, tracks: np.ndarray, modes: OrientationModes, symmetry: np.ndarray) -> np.ndarray:
        """Log density [n, K] of observed orientations given each mode of a track's, both widths added."""
        n, count = modes.log_weight.shape
        own = self.modes.select(tracks)
        seen = modes.select(np.repeat(np.arange(n), count))
        wide = OrientationModes(seen.log_weight, seen.R, np.hypot(seen.scale, own.scale.reshape(-1, 1)))
        return mixture_log_density(own.R.reshape(-1, 3, 3), wide, np.repeat(symmetry, count), self.config).reshape(n, count)

    def _orientation(self, tracks: np.ndarray, modes: OrientationModes, symmetry: np.ndarray) -> np.ndarray:
        """Log ratio of observed orientations given tracks to any orientation."""
        joint = self.modes.log_weight[tracks] + self._by_mode(tracks, modes, symmetry)
        return np.logaddexp.reduce(joint, axis=1) - UNIFORM_LOG_DENSITY

    def _orient(self, j: int, modes: OrientationModes, symmetry: np.ndarray) -> None:
        """The first orientation founds the track's modes, later ones weigh them."""
        if not self.oriented[j]:
            self.oriented[j] = True
            self.modes.log_weight[j], self.modes.R[j], self.modes.scale[j] = modes.log_weight[0], modes.R[0], modes.scale[0]
        elif self.modes.log_weight.shape[1] > 1:
            joint = self.modes.log_weight[j] + self._by_mode(np.array([j]), modes, symmetry)[0]
            self.modes.log_weight[j] = joint - np.logaddexp.reduce(joint)


def build_tracklets(problem: SlamProblem, noise: NoiseModel, config: SlamConfig, prior: FeaturePrior) -> Tracklets:
    """Run the tracker over all frames and mark what moves."""
    table = problem.observations
    n = len(table)
    assigned, weight = np.full(n, -1, dtype=np.int64), np.zeros(n)
    if n:
        seen = resolve(table, noise, config, prior).in_world(problem.odometry[table.frame])
        order = np.argsort(table.frame, kind="stable")
        frames, starts = np.unique(table.frame[order], return_index=True)
        groups = dict(zip(frames.tolist(), np.split(order, starts[1:])))
        tracker = Tracker(config, table.latent_dim, prior, noise.birth_intensity, noise.clutter_intensity)
        for t in progress_bar(range(int(frames[0]), int(frames[-1]) + 1), "tracking", "frame", leave=False):
            if t:
                tracker.predict(problem.odometry[t], t, noise.rotation_step[t - 1], noise.translation_step[t - 1])
            rows = groups.get(t)
            if rows is None:
                continue
            assigned[rows], weight[rows] = tracker.associate(seen.select(rows), t)
    return summarise_tracks(problem, noise, config, assigned, weight)


def summarise_tracks(
    problem: SlamProblem,
    noise: NoiseModel,
    config: SlamConfig,
    assigned: Int[np.ndarray, " k"],
    weight: Float[np.ndarray, " k"],
) -> Tracklets:
    """First and last frame, length, and a motion test of every track; short tracks are dissolved, numbers are repacked."""
    table = problem.observations
    total = int(assigned.max(initial=-1)) + 1
    count = np.bincount(assigned[assigned >= 0], minlength=total)
    keep = count >= config.track_minimum
    number = np.where(keep, np.cumsum(keep) - 1, -1)
    assigned = np.where(assigned >= 0, number[np.maximum(assigned, 0)] if total else -1, -1)
    m = int(keep.sum())
    first, last = np.full(m, len(problem)), np.full(m, -1)
    used = assigned >= 0
    np.minimum.at(first, assigned[used], table.frame[used])
    np.maximum.at(last, assigned[used], table.frame[used])
    moving = moving_tracks(problem, noise, config, assigned, m)
    if moving.all() and problem.odometry_covariance is None and config.odometry_rotation_scale is None:
        # Everything moves against an odometry of guessed scales: it is the odometry that moves.
        moving = np.zeros(m, dtype=bool)
    return Tracklets(assigned, np.where(used, weight, 0.0), first, last, count[keep] if total else np.zeros(0, int), moving)


def moving_tracks(
    problem: SlamProblem, noise: NoiseModel, config: SlamConfig, assigned: Int[np.ndarray, " k"], tracks: int
) -> Bool[np.ndarray, " m"]:
    """Tracks whose positions are explained much better by a constant velocity than by rest.

    The evidence is the fall of the weighted sum of squares when each coordinate is given a slope in time, less half a
    log of the sample size for each of the three slopes (BIC). Residuals are in the odometry frame; its drift over the
    track is part of the variance.
    """
    table = problem.observations
    rows = np.flatnonzero(assigned >= 0)
    if not len(rows) or not len(noise.rotation_step):
        return np.zeros(tracks, dtype=bool)
    world = transform(problem.odometry[table.frame[rows]], table.position[rows])
    a, t = assigned[rows], table.frame[rows].astype(np.float64)
    distance = np.linalg.norm(table.position[rows], axis=1)
    variance = np.trace(noise.position_covariance[rows], axis1=1, axis2=2) / 3

    def per_track(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(a, weights=v, minlength=tracks) for v in np.atleast_2d(values.T)], axis=-1)

    w = 1.0 / variance
    total = per_track(w)
    centre = per_track(w[:, None] * np.column_stack([t, world])) / np.maximum(total, 1e-300)
    dt, dx = t - centre[a, 0], world - centre[a, 1:]
    spread = per_track(w * dt**2)
    slope = per_track(w[:, None] * dt[:, None] * dx) / np.maximum(spread, 1e-300)
    # Drift of the odometry over the track passes for motion of the object: its slope variance is added.
    step = float(np.median(noise.translation_step)) ** 2 + (float(np.median(noise.rotation_step)) * distance) ** 2
    drift = per_track(step) / np.maximum(per_track(np.ones(len(a))), 1)
    duration = np.maximum(per_track(dt**2) / np.maximum(per_track(np.ones(len(a))), 1), 1e-12)
    slope_variance = 1.0 / np.maximum(spread, 1e-300) + drift / np.sqrt(12 * duration)
    gain = 0.5 * np.sum(slope**2, axis=1) / slope_variance[:, 0]
    n = np.bincount(a, minlength=tracks)
    return (n >= 3) & (gain - 1.5 * np.log(np.maximum(n, 1)) > config.motion_log_odds)
