"""Closed loops with rounded corners, and the poses of a camera that drives along them.

The ground frame has x and y level and z up, in metres; headings are counter-clockwise from x. A lateral offset is
positive to the left of the direction of travel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

SPACING = 0.05
"""Distance between the samples of a loop, m."""


@dataclass(frozen=True)
class Loop:
    """A closed curve, sampled evenly."""

    points: Float[np.ndarray, "n 2"]
    headings: Float[np.ndarray, " n"]
    """Direction of travel, rad, continuous: the last is a whole turn from the first."""
    length: float
    """Length of the curve, m."""

    @property
    def inner(self) -> int:
        """Which side the inside lies on: 1 left, -1 right."""
        return 1 if self.headings[-1] > self.headings[0] else -1

    def at(
        self, s: float | Float[np.ndarray, " m"], lateral: float | Float[np.ndarray, " m"] = 0.0
    ) -> tuple[Float[np.ndarray, "... 2"], Float[np.ndarray, " ..."]]:
        """Point and heading at arc length `s` (any number of laps), moved sideways by `lateral`."""
        s, lateral = np.asarray(s, dtype=np.float64), np.asarray(lateral, dtype=np.float64)
        position = np.mod(s, self.length) / self.length * len(self.points)
        grid = np.arange(len(self.points) + 1)
        turn = 2 * np.pi * self.inner
        heading = np.interp(position, grid, np.append(self.headings, self.headings[0] + turn))
        heading = heading + turn * np.floor(s / self.length)
        closed = np.concatenate((self.points, self.points[:1]))
        point = np.stack([np.interp(position, grid, closed[:, axis]) for axis in (0, 1)], axis=-1)
        normal = np.stack((-np.sin(heading), np.cos(heading)), axis=-1)
        return point + normal * lateral[..., None], heading

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.points)

    def distance(self, points: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, " ..."]:
        """Distance of points from the curve, m."""
        return self._tree.query(points)[0]

    def inset(self, offset: float, spacing: float = 1.0) -> Float[np.ndarray, "m 2"]:
        """The curve moved inwards by `offset`: corners of a polygon, empty where nothing is left inside."""
        s = np.arange(0, self.length, spacing)
        points, _ = self.at(s, self.inner * offset)
        return points[self.distance(points) >= offset - 0.02]


def rounded_polygon(corners: Float[np.ndarray, "c 2"], radius: float) -> Loop:
    """A convex polygon with corners rounded to a radius, m; starts in the middle of its first side."""
    back = np.roll(corners, 1, axis=0) - corners
    ahead = np.roll(corners, -1, axis=0) - corners
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    turn = np.arctan2(ahead[:, 1] * -back[:, 0] - ahead[:, 0] * -back[:, 1], np.sum(-back * ahead, axis=1))
    cut = radius * np.tan(np.abs(turn) / 2)
    middle = 0.5 * (corners[0] + corners[1])
    points, headings = [middle], [float(np.arctan2(ahead[0, 1], ahead[0, 0]))]
    count = len(corners)
    for number in range(1, count + 1):
        k = number % count
        heading = headings[-1]
        entry = corners[k] + back[k] * cut[k]
        steps = max(2, int(np.ceil(radius * abs(turn[k]) / SPACING)))
        side = np.sign(turn[k])
        centre = entry + side * radius * np.array([-np.sin(heading), np.cos(heading)])
        for angle in heading + turn[k] * np.linspace(0, 1, steps):
            points.append(centre + side * radius * np.array([np.sin(angle), -np.cos(angle)]))
            headings.append(float(angle))
    table = np.array([*points, middle])
    direction = np.array([*headings, headings[-1]])
    distance = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(table, axis=0), axis=1)))
    length = float(distance[-1])
    n = int(np.ceil(length / SPACING))
    s = np.arange(n) * (length / n)
    sampled = np.stack([np.interp(s, distance, table[:, axis]) for axis in (0, 1)], axis=1)
    return Loop(sampled, np.interp(s, distance, direction), length)


def random_loop(perimeter: float, radius: float, rng: np.random.Generator, aspect: tuple[float, float], jitter: float) -> Loop:
    """A four-sided loop of about the given length, driven round either way.

    Args:
        perimeter: length of the loop, m.
        radius: of the rounded corners, m; less where the loop is small.
        rng: source of every random number.
        aspect: least and greatest ratio of its sides.
        jitter: how far its corners move, as a share of the shorter side.
    """
    ratio = rng.uniform(*aspect)
    square = np.array([[-ratio, -1.0], [ratio, -1.0], [ratio, 1.0], [-ratio, 1.0]])
    corners = square + rng.uniform(-jitter, jitter, (4, 2))
    turn = rng.uniform(-np.pi, np.pi)
    corners = corners @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    if rng.random() < 0.5:
        corners = corners[::-1]
    scale = perimeter / np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).sum()
    for _ in range(8):
        fitting = min(radius, 0.7 * scale)
        loop = rounded_polygon(corners * scale, fitting)
        scale *= perimeter / loop.length
    return rounded_polygon(corners * scale, min(radius, 0.7 * scale))


@dataclass(frozen=True)
class Track:
    """Where the camera drives: a dense curve, not closed."""

    points: Float[np.ndarray, "n 2"]
    headings: Float[np.ndarray, " n"]


def drive_track(loop: Loop, laps: float, opposite: float, lane: float) -> Track:
    """The loop driven `laps` times; then, where `opposite` is positive, a half turn to the left and a way back.

    Args:
        loop: the closed curve.
        laps: how often it is driven round.
        opposite: laps driven back.
        lane: distance to the left of the lane of the way back, m; 0 turns on the spot.
    """
    end = laps * loop.length
    s = np.linspace(0, end, max(2, int(end / SPACING)))
    points, headings = loop.at(s)
    if opposite == 0:
        return Track(points, headings)
    angle = np.linspace(0, np.pi, 64)[1:-1]
    tip, heading = points[-1], headings[-1]
    centre = tip + 0.5 * lane * np.array([-np.sin(heading), np.cos(heading)])
    arc = heading - np.pi / 2 + angle
    around = centre + 0.5 * lane * np.stack((np.cos(arc), np.sin(arc)), axis=1)
    back = np.linspace(end, end - opposite * loop.length, max(2, int(opposite * loop.length / SPACING)))
    returning, reverse = loop.at(back, lane)
    return Track(np.concatenate((points, around, returning)), np.concatenate((headings, heading + angle, reverse + np.pi)))


def _wave(distance: np.ndarray, wavelengths: tuple[float, ...], rng: np.random.Generator) -> np.ndarray:
    """A smooth wobble of scale 1 along the way."""
    phase = rng.uniform(0, 2 * np.pi, len(wavelengths))
    total = sum(np.sin(2 * np.pi * distance / w + p) for w, p in zip(wavelengths, phase))
    return np.asarray(total) / np.sqrt(0.5 * len(wavelengths))


@dataclass(frozen=True)
class Wobble:
    """How much a camera departs from its track; scales."""

    sideways: float
    """m."""
    up: float
    """m."""
    heading: float
    """Degrees."""
    tilt: float
    """Degrees."""
    roll: float
    """Degrees."""
    wavelength: float
    """Of the slowest wave, m."""


def camera_poses(
    track: Track,
    frames: int,
    step: float,
    height: float,
    tilt: float,
    wobble: Wobble,
    rng: np.random.Generator,
    most_turn: float = 7.0,
) -> Float[np.ndarray, "frames 4 4"]:
    """`T_ground_camera` of each frame: evenly spaced, closer where the track turns by more than `most_turn` a step.

    Args:
        track: where to drive.
        frames: number of poses.
        step: distance between frames that `most_turn` belongs to, m.
        height: of the camera, m.
        tilt: downwards, degrees.
        wobble: departures from the track.
        rng: source of every random number.
        most_turn: degrees between frames.
    """
    moved = np.linalg.norm(np.diff(track.points, axis=0), axis=1)
    turned = np.abs(np.diff(track.headings))
    effort = np.append(0.0, np.cumsum(np.maximum(moved / step, turned / np.radians(most_turn))))
    distance = np.append(0.0, np.cumsum(moved))
    at = np.linspace(0, effort[-1], frames)
    xy = np.stack([np.interp(at, effort, track.points[:, axis]) for axis in (0, 1)], axis=1)
    heading, s = np.interp(at, effort, track.headings), np.interp(at, effort, distance)
    slow, middle, quick = wobble.wavelength, 0.62 * wobble.wavelength, 0.29 * wobble.wavelength
    xy += np.stack((-np.sin(heading), np.cos(heading)), axis=1) * (wobble.sideways * _wave(s, (slow, middle), rng))[:, None]
    z = height + wobble.up * _wave(s, (middle, quick), rng)
    heading = heading + np.radians(wobble.heading) * _wave(s, (slow, middle), rng)
    tilts = np.radians(tilt + wobble.tilt * _wave(s, (middle, quick), rng))
    rolls = np.radians(wobble.roll * _wave(s, (middle, quick), rng))
    return np.stack([camera_pose(*row) for row in zip(xy[:, 0], xy[:, 1], z, heading, tilts, rolls)])


def camera_pose(x: float, y: float, z: float, heading: float, tilt: float, roll: float) -> Float[np.ndarray, "4 4"]:
    """`T_ground_camera`: level, then tilted down, then rolled; angles in rad."""
    ch, sh, ct, st, cr, sr = (f(a) for a in (heading, tilt, roll) for f in (np.cos, np.sin))
    level = np.array([[sh, 0, ch], [-ch, 0, sh], [0, -1, 0]])
    tilted = np.array([[1, 0, 0], [0, ct, st], [0, -st, ct]])
    rolled = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3] = level @ tilted @ rolled
    pose[:3, 3] = x, y, z
    return pose
