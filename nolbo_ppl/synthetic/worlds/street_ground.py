"""The ground of a loop of streets: road, kerbs, pavement, the green inside, markings and repairs.

Lateral offsets along the loop are counted from the camera's lane, positive to the outside of the loop.
"""

from __future__ import annotations

import numpy as np

from nolbo_ppl.synthetic.renderer.materials import Material, hsv
from nolbo_ppl.synthetic.worlds import scenery
from nolbo_ppl.synthetic.worlds.camera_path import Loop
from nolbo_ppl.synthetic.worlds.world_mesh import Frame, StaticBuilder

PAVEMENT = 0.12
"""Height of the pavement above the road, m."""
LANE = 3.6
"""Distance from the camera's lane to the opposite one, which lies to its left, m."""
NEAR_KERB, FAR_KERB = 6.4, 7.8
"""Distance of the kerb to the right and to the left, parking lanes included, m."""
WALK = 4.2
"""Width of the pavement, m."""

ASPHALT = Material(hsv(0.6, 0.05, 0.44), 0.02, pattern="grain", contrast=0.42, frequency=1.3)
PAVING = Material(hsv(0.09, 0.08, 0.66), 0.02, pattern="slabs", contrast=0.38, frequency=1.4)
GRASS = Material(hsv(0.25, 0.5, 0.45), 0.0, pattern="grain", contrast=0.5, frequency=1.6)
FOREST = Material(hsv(0.28, 0.45, 0.4), 0.0, pattern="leaves", contrast=0.6, frequency=0.35)


class Street:
    """The loop with its sides: outside and inside."""

    def __init__(self, loop: Loop) -> None:
        self.loop = loop
        self.kerb = {1: NEAR_KERB if loop.inner == 1 else FAR_KERB, -1: FAR_KERB if loop.inner == 1 else NEAR_KERB}

    def at(self, s: float, outwards: float) -> tuple[np.ndarray, float]:
        """Point at an offset to the outside (negative: inside), and the heading of travel."""
        point, heading = self.loop.at(s, -self.loop.inner * outwards)
        return point, float(heading)

    def line(self, s: np.ndarray, outwards: float, z: float) -> np.ndarray:
        """Points of a line along the loop."""
        xy, _ = self.loop.at(s, np.full(len(s), -self.loop.inner * outwards))
        return np.column_stack((xy, np.full(len(s), z)))

    def frame(self, s: float, outwards: float, z: float = 0.0, away: bool = True) -> Frame:
        """A frame whose y axis points away from the road (or towards it) and whose x axis runs along it."""
        side = 1 if outwards >= 0 else -1
        point, heading = self.at(s, outwards)
        left = side * self.loop.inner == -1  # whether that side lies to the left of the direction of travel
        return Frame(point, heading if left == away else heading + np.pi, z)


def lay_ground(builder: StaticBuilder, street: Street, rng: np.random.Generator) -> None:
    """Lay road, kerbs, pavement and green, and raise the hills around."""
    loop = street.loop
    middle = loop.points.mean(axis=0)
    far = 400.0
    corners = [(middle[0] + far * x, middle[1] + far * y, -0.03) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    builder.polygon(np.array(corners), GRASS)
    s = np.linspace(0, loop.length, max(24, int(loop.length / 1.5)), endpoint=False)
    outer, inner = street.kerb[1], -street.kerb[-1]
    builder.ribbon(street.line(s, outer, 0.0), street.line(s, inner, 0.0), ASPHALT, closed=True)
    for kerb, side in ((outer, 1), (inner, -1)):
        low, high = street.line(s, kerb, 0.0), street.line(s, kerb, PAVEMENT)
        builder.ribbon(low, high, scenery.KERB, closed=True)
        builder.ribbon(high, street.line(s, kerb + 0.3 * side, PAVEMENT), scenery.KERB, closed=True)
    builder.ribbon(street.line(s, outer + 0.3, PAVEMENT), street.line(s, outer + WALK, PAVEMENT), PAVING, closed=True)
    island = loop.inset(-inner + 0.25)
    if len(island) > 2:
        builder.polygon(np.column_stack((island, np.full(len(island), PAVEMENT - 0.004))), PAVING)
        lawn = loop.inset(-inner + WALK)
        if len(lawn) > 2:
            builder.polygon(np.column_stack((lawn, np.full(len(lawn), PAVEMENT + 0.01))), GRASS)
    angle = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    radius = 80 + np.linalg.norm(loop.points - middle, axis=1).max() + rng.uniform(-6, 6, 90)
    ring = middle + radius[:, None] * np.stack((np.cos(angle), np.sin(angle)), axis=1)
    height = 11 + 4 * np.sin(3 * angle + rng.uniform(0, 6)) + rng.uniform(-2.5, 2.5, 90)
    builder.ribbon(np.column_stack((ring, np.full(90, -1.0))), np.column_stack((ring, height)), FOREST, closed=True)


def paint_markings(builder: StaticBuilder, street: Street, rng: np.random.Generator) -> None:
    """Paint lane dashes, bays, crossings; repairs, cracks, manholes, leaves: what gives a road its corners."""
    loop = street.loop
    left = -loop.inner  # the opposite lane lies inside where the inside is to the left
    for s in np.arange(0, loop.length - 4, 6.0):
        along = np.linspace(s, s + 2.6, 4)
        middle = left * LANE / 2
        builder.ribbon(street.line(along, middle - 0.07, 0.006), street.line(along, middle + 0.07, 0.006), scenery.MARK)
        for offset in (street.kerb[1] - 2.4, 2.4 - street.kerb[-1]):
            frame = street.frame(s, offset, 0.006)
            builder.quad(frame(-0.05, 0), frame(0.05, 0), frame(0.05, 2.3), frame(-0.05, 2.3), scenery.MARK)
            builder.quad(frame(-0.5, -0.05), frame(0.5, -0.05), frame(0.5, 0.05), frame(-0.5, 0.05), scenery.MARK)
    for s in rng.uniform(0, loop.length, max(4, int(loop.length / 25))):
        if abs(street.at(s + 5, 0.0)[1] - street.at(s - 2, 0.0)[1]) > 0.05:
            continue  # not in a bend
        for lateral in np.arange(-street.kerb[-1] + 0.5, street.kerb[1] - 0.7, 1.0):
            frame = Frame(street.at(s, lateral)[0], street.at(s, lateral)[1], 0.007)
            builder.quad(frame(0, -0.25), frame(3, -0.25), frame(3, 0.25), frame(0, 0.25), scenery.MARK)
    greys = [
        Material(hsv(rng.choice([0.1, 0.6]), 0.06, v), 0.02, pattern="grain", contrast=0.35, frequency=f)
        for v, f in zip((0.30, 0.36, 0.52, 0.58, 0.26), (3.0, 2.0, 4.0, 3.0, 6.0))
    ]
    bright = [Material(hsv(rng.random(), s, v)) for s, v in ((0.1, 0.95), (0.8, 0.7), (0.7, 0.5), (0.1, 0.15), (0.5, 0.4))]
    for kind, count, z in ((0, 0.35, 0.002), (1, 0.3, 0.004), (2, 1.6, 0.012)):
        for _ in range(int(count * loop.length)):
            lateral = rng.uniform(-street.kerb[-1] + 0.3, street.kerb[1] - 0.3)
            point, heading = street.at(rng.uniform(0, loop.length), lateral)
            frame = Frame(point, heading + rng.choice([0.0, rng.uniform(-0.6, 0.6)]), z + rng.uniform(0, 0.0015))
            if kind == 2:  # leaves, paper
                frame = Frame(point, rng.uniform(-3, 3), z)
            size = ((0.3, 1.3), (0.03, 1.6), (0.03, 0.1))[kind]
            a = np.exp(rng.uniform(*np.log(size)))
            b = 0.03 if kind == 1 else a * rng.uniform(0.4, 1.6)
            a = a if kind != 1 else rng.uniform(0.4, 1.8)
            corner = np.array([(-a, -b), (a, -b), (a, b), (-a, b)]) * rng.uniform(0.75, 1.1, (4, 2))
            material = bright[int(rng.integers(5))] if kind == 2 else greys[int(rng.integers(5))]
            builder.polygon(np.array([frame(x, y) for x, y in corner]), material)
    iron = Material(hsv(0.08, 0.15, 0.25), 0.1, pattern="lattice", contrast=0.5, frequency=12.0)
    for s in np.arange(4, loop.length, 11.0):
        point, _ = street.at(s + rng.uniform(-3, 3), rng.uniform(-3.5, 2.5))
        angle = np.linspace(0, 2 * np.pi, 14, endpoint=False)
        for radius, z, material in ((0.42, 0.0045, scenery.CONCRETE), (0.34, 0.0085, iron)):
            ring = point + radius * np.stack((np.cos(angle), np.sin(angle)), axis=1)
            builder.polygon(np.column_stack((ring, np.full(14, z))), material)
