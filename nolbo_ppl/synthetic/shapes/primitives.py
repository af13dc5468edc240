"""Solid primitives: each gives a closed triangle mesh with a role per face and an exact inside test on a grid.

The inside tests take the three coordinate vectors of a box-shaped grid, so that most of the work is done on one or
two axes, and a least half-thickness `thin` in the same unit: a part thinner than that is tested as if it were that
thick, so that tubes and panels survive a coarse voxel grid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.synthetic.shapes.polygon import Points, following, grid_inside, half_thickness, signed_area, triangulate

Axis = Float[np.ndarray, " n"]
Mesh = tuple[np.ndarray, np.ndarray, list[str]]
"""Vertices float64 [v, 3], faces int [f, 3] counter-clockwise seen from outside, and a role per face."""

ROUND = 1.25
"""Round rods are tested this much thicker than plates: 0.75 voxel to each side exceeds sqrt(2) / 2, the greatest
distance of a line from the nearest row of voxel centres, so that none breaks."""

PLANE_AXES = {0: (1, 2), 1: (0, 2), 2: (0, 1)}
"""The two axes (v, w) of the plane across axis u. (u, v, w) is right-handed except for u = 1."""


class Primitive(Protocol):
    """What every primitive offers."""

    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """The least and the greatest corner of its box."""

    def mesh(self) -> Mesh:
        """Its closed surface."""

    def inside(self, x: Axis, y: Axis, z: Axis, thin: float) -> Bool[np.ndarray, "i j k"]:
        """Which points of the grid x by y by z it holds, tested at least `thin` thick to each side."""


def to_world(axis: int, u: np.ndarray, v: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Points [n, 3] from coordinates along `axis` and in the plane across it."""
    points = np.empty((len(u), 3))
    points[:, axis] = u
    points[:, PLANE_AXES[axis][0]] = v
    points[:, PLANE_AXES[axis][1]] = w
    return points


def from_plane(axis: int, grid_uvw: np.ndarray) -> np.ndarray:
    """Reorder an array indexed [u, v, w] to [x, y, z]."""
    return grid_uvw if axis == 0 else grid_uvw.transpose(1, 0, 2) if axis == 1 else grid_uvw.transpose(1, 2, 0)


@lru_cache(maxsize=256)
def rings_to_faces(rings: int, segments: int, capped: bool) -> np.ndarray:
    """Faces [f, 3] between consecutive rings of `segments` vertices each, band by band, outside to the right.

    `capped` closes the ends by two fans; otherwise the last ring is joined to the first.
    """
    ring, corner = np.meshgrid(np.arange(rings - 1 if capped else rings), np.arange(segments), indexing="ij")
    a = ring * segments + corner
    b = ring * segments + (corner + 1) % segments
    above = (ring + 1) % rings * segments
    c, d = above + (corner + 1) % segments, above + corner
    faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2).reshape(-1, 3)
    if capped:
        fan = np.array([(0, i, i + 1) for i in range(1, segments - 1)])
        faces = np.concatenate([faces, fan[:, ::-1], fan + (rings - 1) * segments])
    faces.flags.writeable = False
    return faces


@lru_cache(maxsize=64)
def _prism_sides(n: int) -> np.ndarray:
    """Two triangles [2 n, 3] for each edge of a prism over n corners, the upper corners numbered from n."""
    i = np.arange(n)
    j = (i + 1) % n
    faces = np.stack([np.stack([i, j, j + n], -1), np.stack([i, j + n, i + n], -1)], axis=1).reshape(-1, 3)
    faces.flags.writeable = False
    return faces


@dataclass(frozen=True)
class Extrusion:
    """A polygon in the plane across `axis`, extruded between two planes that may slant.

    The planes are u = low . (1, v, w) and u = high . (1, v, w), so that a box, a wedge, a wing with dihedral and a car
    body narrowing upwards are all exact.

    Attributes:
        axis: the axis of extrusion u (0, 1, 2); the profile lies in the two others, in the order x, y, z.
        profile: corners [n, 2], either orientation, not crossing itself.
        low: coefficients (constant, per v, per w) of the lower plane.
        high: coefficients of the upper plane.
        roles: a role for each edge; edge i runs from corner i to corner i + 1.
        cap_roles: roles of the lower and the upper cap.
    """

    axis: int
    profile: Points
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    roles: tuple[str, ...]
    cap_roles: tuple[str, str]
    _half: float = field(init=False, repr=False)
    _is_box: bool = field(init=False, repr=False)

    def __post_init__(self) -> None:
        profile = np.asarray(self.profile, dtype=np.float64)
        roles = self.roles
        if len(roles) != len(profile):
            raise input_error("one role per edge", got=len(roles), expected=len(profile))
        if signed_area(profile) < 0:
            profile, roles = profile[::-1].copy(), tuple(roles[:-1][::-1]) + (roles[-1],)
        object.__setattr__(self, "profile", profile)
        object.__setattr__(self, "roles", roles)
        object.__setattr__(self, "_half", half_thickness(profile))
        upright = len(profile) == 4 and bool(((profile == profile.min(0)) | (profile == profile.max(0))).all())
        object.__setattr__(self, "_is_box", upright and not any((*self.low[1:], *self.high[1:])))
        if (self._plane(self.low) > self._plane(self.high) + 1e-12).any():
            raise input_error("planes of an extrusion cross inside its profile", got=(self.low, self.high))

    def _plane(self, plane: tuple[float, float, float]) -> np.ndarray:
        return plane[0] + self.profile @ np.array(plane[1:])

    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """The least and the greatest corner of its box."""
        (v0, w0), (v1, w1) = self.profile.min(0), self.profile.max(0)
        u = np.array([self._plane(self.low).min(), self._plane(self.high).max()])
        return to_world(self.axis, u, np.array([v0, v1]), np.array([w0, w1]))

    def mesh(self) -> Mesh:
        """Two caps and a quadrilateral per edge."""
        n = len(self.profile)
        v, w = self.profile.T
        vertices = np.concatenate([to_world(self.axis, self._plane(plane), v, w) for plane in (self.low, self.high)])
        caps = np.array(triangulate(self.profile))
        faces = np.concatenate([caps[:, ::-1], caps + n, _prism_sides(n)])
        names = [self.cap_roles[0]] * len(caps) + [self.cap_roles[1]] * len(caps)
        names += [role for role in self.roles for _ in range(2)]
        return vertices, faces[:, ::-1] if self.axis == 1 else faces, names

    def inside(self, x: Axis, y: Axis, z: Axis, thin: float) -> Bool[np.ndarray, "i j k"]:
        """A polygon test on the plane and two comparisons in space; a box is three intervals."""
        grid = (x, y, z)
        u = grid[self.axis]
        v, w = (grid[i] for i in PLANE_AXES[self.axis])
        if self._is_box:
            low, high = self.bounds()
            extra = np.maximum(thin - 0.5 * (high - low), 0.0)
            within = [(c >= a) & (c <= b) for c, a, b in zip(grid, low - extra, high + extra)]
            return (within[0][:, None] & within[1])[:, :, None] & within[2]
        mask = grid_inside(self.profile, v, w, margin=max(thin - self._half, 0.0))
        low, high = (p[0] + p[1] * v[:, None] + p[2] * w[None, :] for p in (self.low, self.high))
        extra = np.maximum(thin - 0.5 * (high - low), 0.0)
        inside = (u[:, None, None] >= low - extra) & (u[:, None, None] <= high + extra) & mask
        return from_plane(self.axis, inside)


@dataclass(frozen=True)
class Loft:
    """Cross-sections of one form, placed and sized at stations along an axis and joined by straight lines.

    Attributes:
        axis: the axis the stations lie on.
        stations: increasing coordinates [k] along the axis.
        centre: centres [k, 2] of the sections in the plane across the axis (order x, y, z).
        half: half sizes [k, 2], positive.
        exponent: sections are superellipses |a|^p + |b|^p <= 1: 2 an ellipse, 8 nearly a box; unused with `section`.
        section: a convex polygon in [-1, 1]^2 instead of the superellipse.
        segments: corners of the mesh's superellipse.
        roles: a role for each band between stations.
        cap_roles: roles of the first and the last cap.
    """

    axis: int
    stations: Float[np.ndarray, " k"]
    centre: Float[np.ndarray, "k 2"]
    half: Float[np.ndarray, "k 2"]
    exponent: float
    section: Points | None
    segments: int
    roles: tuple[str, ...]
    cap_roles: tuple[str, str]

    def _ring(self) -> Points:
        if self.section is not None:
            return self.section if signed_area(self.section) > 0 else self.section[::-1]
        # Half a step of offset keeps edges flat against the axes, as sides of boxy sections should be.
        angle = (np.arange(self.segments) + 0.5) * (2 * math.pi / self.segments)
        circle = np.stack([np.cos(angle), np.sin(angle)], -1)
        return np.sign(circle) * np.abs(circle) ** (2.0 / self.exponent)

    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """The least and the greatest corner of its box."""
        low, high = (self.centre - self.half).min(0), (self.centre + self.half).max(0)
        u = self.stations[[0, -1]]
        return to_world(self.axis, u, np.array([low[0], high[0]]), np.array([low[1], high[1]]))

    def mesh(self) -> Mesh:
        """Rings joined by quadrilaterals, and two caps."""
        ring = self._ring()
        k, n = len(self.stations), len(ring)
        plane = (self.centre[:, None] + self.half[:, None] * ring).reshape(-1, 2)
        vertices = to_world(self.axis, np.repeat(self.stations, n), plane[:, 0], plane[:, 1])
        faces = rings_to_faces(k, n, capped=True)
        names = [role for role in self.roles for _ in range(2 * n)]
        names += [self.cap_roles[0]] * (n - 2) + [self.cap_roles[1]] * (n - 2)
        return vertices, faces[:, ::-1] if self.axis == 1 else faces, names

    def inside(self, x: Axis, y: Axis, z: Axis, thin: float) -> Bool[np.ndarray, "i j k"]:
        """Sections interpolated along the axis, then a test that is a sum over the two other axes."""
        grid = (x, y, z)
        u = grid[self.axis]
        v, w = (grid[i] for i in PLANE_AXES[self.axis])
        extra = max(thin - 0.5 * float(self.stations[-1] - self.stations[0]), 0.0)
        within = (u >= self.stations[0] - extra) & (u <= self.stations[-1] + extra)
        c0, c1 = (np.interp(u, self.stations, self.centre[:, i]) for i in (0, 1))
        least = thin if self.section is not None else ROUND * thin
        h0, h1 = (np.maximum(np.interp(u, self.stations, self.half[:, i]), least) for i in (0, 1))
        a, b = (v - c0[:, None]) / h0[:, None], (w - c1[:, None]) / h1[:, None]  # [u, v], [u, w]
        if self.section is None:
            a, b = np.abs(a) ** self.exponent, np.abs(b) ** self.exponent
            inside = a[:, :, None] <= (1.0 - b)[:, None, :]
        else:
            ring = self._ring()
            edge = following(ring) - ring
            inside = np.ones((len(u), len(v), len(w)), dtype=bool)
            for (p, q), (dp, dq) in zip(ring, edge):
                inside &= ((a - p) * dq)[:, :, None] <= ((b - q) * dp)[:, None, :]
        return from_plane(self.axis, inside & within[:, None, None])
