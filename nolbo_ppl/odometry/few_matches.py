"""Motion from few or crowded matches: other motions that fit as well, and how far it moves with the matches drawn anew.

The covariance at the best motion knows nothing of other motions that explain the matches (a small part of the image looks
affine: translation aside and turning, relief and its reverse are hard to tell apart) nor of wrong matches among few right ones
that pull it. Both are looked for where matches are few or the direction is poorly known, and what is found is added.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nolbo_ppl.geometry.pose import inverse, make_pose, se3_log
from nolbo_ppl.odometry.epipolar import TwoView, depths, mirrored, refine
from nolbo_ppl.odometry.odometry_config import OdometryConfig
from nolbo_ppl.odometry.planar_scene import angle_between
from nolbo_ppl.odometry.pure_rotation import rotation_only

FEW = 60
"""Motions that fewer matches obey are looked at closely."""
UNSURE = 0.15
"""So are those whose direction has a larger standard deviation, rad."""
DRAWS = 12
"""How often the matches are drawn anew, with replacement (Efron 1979)."""
DECIDED = 10.0
"""Surprise, nats, by which another motion must exceed the best one to be forgotten."""
MIN_DOUBT = 0.06
"""Least probability left to any other motion that fits: with it the truth is within Mahalanobis^2 of 17 whichever it is."""
TURN_SCALE, MOST_HELD = 0.3, 6.0
"""How far the direction turns from step to step, rad, and the most that is held against a motion that turns more, nats."""
SAME = 0.03
"""Motions nearer to each other, in rad and lengths of the step, are one."""
DIRECTIONS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [-1, 0, 1], [0, 1, 1], [0, -1, 1]], dtype=np.float64)
"""Directions of translation that are tried, up to their signs."""


def needs_a_closer_look(view: TwoView) -> bool:
    """Whether a motion rests on few matches or knows its direction badly."""
    return bool(view.inliers.sum() < FEW or np.linalg.eigvalsh(view.covariance[3:, 3:])[-1] > UNSURE**2)


def facing(view: TwoView, first: Float[np.ndarray, "m 3"], second: Float[np.ndarray, "m 3"]) -> TwoView:
    """The motion with the sign of its translation that puts more points before both cameras."""
    rho = depths(view.R, view.direction, first, second)
    behind = (rho.min(axis=1) < 0) & view.inliers
    if behind.sum() <= 0.5 * view.inliers.sum():
        return view
    direction = -view.direction
    return TwoView(view.R, direction, mirrored(view.covariance, direction), view.inliers, view.scale, view.cost)


def other_motions(
    view: TwoView,
    first: Float[np.ndarray, "m 3"],
    second: Float[np.ndarray, "m 3"],
    intrinsics: Float[np.ndarray, " 4"],
    config: OdometryConfig,
) -> list[tuple[TwoView, float]]:
    """Motions that starts in all directions lead to, with what the matches hold against each, nats; the least first."""
    R, _, _ = rotation_only(first, second, intrinsics, config.threshold)
    found = [view]
    for axis in DIRECTIONS:
        start = axis / np.linalg.norm(axis)
        other = facing(refine(R, start, first, second, intrinsics, config.threshold), first, second)
        if other.inliers.sum() >= 0.6 * view.inliers.sum():
            found.append(other)
    # Costs are in units of the threshold; the noise is what the best motion leaves.
    least = min(found, key=lambda other: other.cost)
    factor = 0.5 * len(first) * (config.threshold / max(least.scale, 0.1 * config.threshold)) ** 2
    return sorted(((other, factor * (other.cost - least.cost)) for other in found), key=lambda pair: pair[1])


def drawn_anew(
    motions: Sequence[TwoView],
    first: Float[np.ndarray, "m 3"],
    second: Float[np.ndarray, "m 3"],
    intrinsics: Float[np.ndarray, " 4"],
    config: OdometryConfig,
) -> list[TwoView]:
    """The best motion of each draw of the matches, from each of the given ones. Deterministic by the seed."""
    rng, best = np.random.default_rng(config.seed), []
    for _ in range(DRAWS):
        rows = rng.integers(0, len(first), len(first))
        a, b = first[rows], second[rows]
        tries = [refine(motion.R, motion.direction, a, b, intrinsics, config.threshold, iterations=5) for motion in motions]
        best.append(facing(min(tries, key=lambda motion: motion.cost), a, b))
    return best


def between(a: TwoView, b: TwoView, length: float) -> Float[np.ndarray, " 6"]:
    """What lies between two motions of one length, in the later camera."""
    T = make_pose(a.R, length * a.direction)
    return se3_log((inverse(T) @ make_pose(b.R, length * b.direction))[None])[0]


def at_least(covariance: Float[np.ndarray, "6 6"], spread: Float[np.ndarray, "6 6"]) -> Float[np.ndarray, "6 6"]:
    """A covariance that is nowhere less than either of two, of which the first is regular.

    >>> at_least(np.eye(6), np.diag([4.0, 0, 0, 0, 0, 0])).diagonal().round(6).tolist()
    [4.0, 1.0, 1.0, 1.0, 1.0, 1.0]
    """
    factor = np.linalg.cholesky(covariance)
    inner = np.linalg.solve(factor, np.linalg.solve(factor, spread).T)
    values, vectors = np.linalg.eigh(0.5 * (inner + inner.T))
    root = factor @ vectors
    return (root * np.maximum(values, 1.0)) @ root.T


@dataclass(frozen=True)
class CloserLook:
    """What few matches allow."""

    view: TwoView
    """The motion to take."""
    rivals: tuple[tuple[TwoView, float], ...]
    """Other motions that fit, each with its probability against that one."""
    draws: tuple[TwoView, ...]
    """The motion with the matches drawn anew."""

    def covariance(self, local: Float[np.ndarray, "6 6"], length: float) -> Float[np.ndarray, "6 6"]:
        """Covariance of a step of this length, m and rad, from that at the motion itself."""
        gaps = np.array([between(self.view, draw, length) for draw in self.draws])
        # The spread of few draws in six dimensions is too small along some of them.
        total = at_least(local, gaps.T @ gaps / (len(gaps) - 6))
        for motion, probability in self.rivals:
            gap = between(self.view, motion, length)
            total = total + probability * np.outer(gap, gap)
        return total


def closer_look(
    view: TwoView,
    first: Float[np.ndarray, "m 3"],
    second: Float[np.ndarray, "m 3"],
    intrinsics: Float[np.ndarray, " 4"],
    config: OdometryConfig,
    prefer: Float[np.ndarray, " 3"] | None = None,
) -> CloserLook:
    """What few matches allow besides a motion that was found.

    Args:
        view: the motion.
        first: rays of the earlier view.
        second: of the later view.
        intrinsics: fx, fy, cx, cy, px.
        config: settings.
        prefer: direction of the step before, which decides where the matches do not.
    """
    motions = other_motions(view, first, second, intrinsics, config)
    if prefer is not None:
        angles = [angle_between(motion.direction, prefer) for motion, _ in motions]
        held = [surprise + min(0.5 * (a / TURN_SCALE) ** 2, MOST_HELD) for a, (_, surprise) in zip(angles, motions)]
        order = np.argsort(held, kind="stable")
        motions = [(motions[k][0], held[k] - held[order[0]]) for k in order]
    best = motions[0][0]
    rivals: list[tuple[TwoView, float]] = []
    for motion, surprise in motions[1:]:
        known = [best, *(other for other, _ in rivals)]
        if surprise < DECIDED and min(float(np.linalg.norm(between(other, motion, 1.0))) for other in known) > SAME:
            rivals.append((motion, max(MIN_DOUBT, 1.0 / (1.0 + float(np.exp(surprise))))))
    starts = [best, *(motion for motion, _ in rivals[:2])]
    return CloserLook(best, tuple(rivals), tuple(drawn_anew(starts, first, second, intrinsics, config)))
