"""Collects the primitives of one object, in metres, in a frame with x right, the front to -y and z up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Self

import numpy as np

from nolbo_ppl.synthetic.shapes.primitives import Extrusion, Loft, Primitive
from nolbo_ppl.synthetic.shapes.tubes import Torus, Tube

Pair = tuple[float, float]
Triple = tuple[float, float, float]


class Draw:
    """Draws the parameters of one instance: every number comes from the caller's generator."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def __call__(self, low: float, high: float) -> float:
        """Draw a number between two limits, uniformly."""
        return float(self._rng.uniform(low, high))

    def choice(self, **weights: float) -> str:
        """Draw one of the names, by weight."""
        total = sum(weights.values())
        pick = self._rng.uniform(0, total)
        for name, weight in weights.items():
            pick -= weight
            if pick < 0:
                return name
        return name

    def chance(self, probability: float) -> bool:
        """Draw true with that probability."""
        return bool(self._rng.random() < probability)

    def integer(self, low: int, high: int) -> int:
        """Draw a whole number between two limits, both included."""
        return int(self._rng.integers(low, high + 1))


class Builder:
    """Adds parts by role. Each method returns the builder; `decal=True` draws a part without filling voxels.

    Decals are thin plates that stand off the surface below, so that no two faces of different roles are coplanar.
    """

    def __init__(self) -> None:
        self.solids: list[Primitive] = []
        self.decals: list[Primitive] = []

    def _add(self, primitive: Primitive, decal: bool) -> Self:
        (self.decals if decal else self.solids).append(primitive)
        return self

    def box(self, role: str, x: Pair, y: Pair, z: Pair, *, decal: bool = False) -> Self:
        """Add an axis-aligned box between (low, high) along each axis."""
        corners = [(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])]
        return self.extrude(2, role, corners, z[0], z[1], decal=decal)

    def pair(self, role: str, x: Pair, y: Pair, z: Pair, *, decal: bool = False) -> Self:
        """Add two boxes, the given one and its mirror image at -x."""
        return self.box(role, x, y, z, decal=decal).box(role, (-x[1], -x[0]), y, z, decal=decal)

    def extrude(
        self,
        axis: int,
        role: str | Sequence[str],
        profile: Sequence[Pair] | np.ndarray,
        low: float | Triple,
        high: float | Triple,
        *,
        caps: str | tuple[str, str] | None = None,
        decal: bool = False,
    ) -> Self:
        """Add a polygon extruded along `axis` between two planes (constant or slanting, see `Extrusion`).

        `role` is one role or one per edge; `caps` one or two, by default the first edge's.
        """
        roles = (role,) * len(profile) if isinstance(role, str) else tuple(role)
        caps = roles[0] if caps is None else caps
        return self._add(
            Extrusion(
                axis,
                np.asarray(profile, dtype=np.float64),
                low if isinstance(low, tuple) else (low, 0.0, 0.0),
                high if isinstance(high, tuple) else (high, 0.0, 0.0),
                roles,
                (caps, caps) if isinstance(caps, str) else caps,
            ),
            decal,
        )

    def side(
        self,
        role: str | Sequence[str],
        profile: Sequence[Pair],
        half_width: float | Triple,
        *,
        caps: str | tuple[str, str] | None = None,
        decal: bool = False,
    ) -> Self:
        """Add a side view (y, z) extruded to both sides; `half_width` may be affine in (y, z)."""
        half = half_width if isinstance(half_width, tuple) else (half_width, 0.0, 0.0)
        low = (-half[0], -half[1], -half[2])
        return self.extrude(0, role, profile, low, half, caps=caps, decal=decal)

    def loft(
        self,
        axis: int,
        role: str | Sequence[str],
        stations: Sequence[float],
        centre: Sequence[Pair] | Pair,
        half: Sequence[Pair] | Sequence[float],
        *,
        exponent: float = 2.0,
        section: Sequence[Pair] | None = None,
        segments: int = 12,
        caps: str | tuple[str, str] | None = None,
        decal: bool = False,
    ) -> Self:
        """Add sections along an axis (see `Loft`); one centre serves all stations, one half size both directions."""
        k = len(stations)
        centres = np.broadcast_to(np.asarray(centre, dtype=np.float64), (k, 2)).copy()
        halves = np.asarray(half, dtype=np.float64)
        halves = np.repeat(halves[:, None], 2, axis=1) if halves.ndim == 1 else halves
        halves = np.maximum(halves, 2e-3 * halves.max())  # a point would make faces without area
        roles = (role,) * (k - 1) if isinstance(role, str) else tuple(role)
        caps = (roles[0], roles[-1]) if caps is None else (caps, caps) if isinstance(caps, str) else caps
        polygon = None if section is None else np.asarray(section, dtype=np.float64)
        return self._add(
            Loft(axis, np.asarray(stations, dtype=np.float64), centres, halves, exponent, polygon, segments, roles, caps),
            decal,
        )

    def cylinder(
        self,
        axis: int,
        role: str,
        centre: Triple,
        radius: float,
        half_length: float,
        *,
        caps: str | tuple[str, str] | None = None,
        segments: int = 14,
        decal: bool = False,
    ) -> Self:
        """Add a cylinder along an axis."""
        u = centre[axis]
        plane = tuple(c for i, c in enumerate(centre) if i != axis)
        return self.loft(
            axis,
            role,
            (u - half_length, u + half_length),
            (plane[0], plane[1]),
            (radius, radius),
            caps=caps,
            segments=segments,
            decal=decal,
        )

    def ellipsoid(
        self,
        role: str,
        centre: Triple,
        half: Triple,
        *,
        exponent: float = 2.0,
        segments: int = 10,
        axis: int = 1,
        decal: bool = False,
    ) -> Self:
        """Add an ellipsoid (of seven sections along `axis`); a larger exponent makes its sections boxier."""
        angle = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 7)
        plane = [i for i in range(3) if i != axis]
        halves = [(half[plane[0]] * math.cos(a), half[plane[1]] * math.cos(a)) for a in angle]
        return self.loft(
            axis,
            role,
            [centre[axis] + half[axis] * math.sin(a) for a in angle],
            (centre[plane[0]], centre[plane[1]]),
            halves,
            exponent=exponent,
            segments=segments,
            decal=decal,
        )

    def tube(
        self,
        role: str,
        path: Sequence[Triple],
        radius: float | Sequence[float],
        *,
        segments: int = 6,
        decal: bool = False,
    ) -> Self:
        """Add a round tube along a path."""
        points = np.asarray(path, dtype=np.float64)
        radii = np.broadcast_to(np.asarray(radius, dtype=np.float64), (len(points),)).copy()
        return self._add(Tube(points, radii, role, segments), decal)

    def tubes(self, role: str, path: Sequence[Triple], radius: float | Sequence[float], *, segments: int = 6) -> Self:
        """Add a tube and its mirror image at -x."""
        self.tube(role, path, radius, segments=segments)
        return self.tube(role, [(-x, y, z) for x, y, z in path], radius, segments=segments)

    def torus(self, axis: int, role: str, centre: Triple, ring: float, tube: float, *, segments: Pair = (18, 5)) -> Self:
        """Add a ring: `ring` is the radius to the middle of the tube, `tube` the radius of the tube."""
        return self._add(Torus(axis, centre, ring, tube, role, (int(segments[0]), int(segments[1]))), False)

    def wheel(self, x: float, y: float, radius: float, width: float, *, rim: float = 0.62, segments: int = 14) -> Self:
        """Add a road wheel standing on z = 0 with its outer side at |x|: tyre, and a rim standing proud of it."""
        sign = math.copysign(1.0, x)
        self.cylinder(0, "tyre", (x - sign * 0.5 * width, y, radius), radius, 0.5 * width, segments=segments)
        return self.cylinder(0, "rim", (x - sign * 0.4 * width, y, radius), rim * radius, 0.5 * width, segments=10, decal=True)
