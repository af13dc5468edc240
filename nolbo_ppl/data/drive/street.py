"""A loop of streets: road with parked cars, pavements with bicycles and cafés, houses and yards behind.

Lateral offsets along the loop are counted from the camera's lane, positive to the outside of the loop.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from nolbo_ppl.data.drive import scenery
from nolbo_ppl.data.drive.builder import Frame, StaticBuilder, turned
from nolbo_ppl.data.drive.path import Loop
from nolbo_ppl.data.drive.placing import Placer
from nolbo_ppl.data.materials import Material, hsv

PAVEMENT = 0.12
"""Height of the pavement above the road, m."""
LANE = 3.6
"""Distance from the camera's lane to the opposite one, which lies to its left, m."""
NEAR_KERB, FAR_KERB = 6.4, 7.8
"""Distance of the kerb to the right and to the left, parking lanes included, m."""
WALK = 4.2
"""Width of the pavement, m."""
YARD = 15.0
"""Depth of the yards behind the pavement, m."""
SIZES = {"aeroplane": 14.0, "boat": 9.0, "train": 21.0, "bus": 13.5}
"""Greatest box diagonals, m."""

ASPHALT = Material(hsv(0.6, 0.05, 0.44), 0.02, pattern="grain", contrast=0.42, frequency=1.3)
PAVING = Material(hsv(0.09, 0.08, 0.66), 0.02, pattern="slabs", contrast=0.38, frequency=1.4)
GRASS = Material(hsv(0.25, 0.5, 0.45), 0.0, pattern="grain", contrast=0.5, frequency=1.6)
GRAVEL = Material(hsv(0.1, 0.18, 0.62), 0.0, pattern="grain", contrast=0.45, frequency=2.5)
YARD_CONCRETE = Material(hsv(0.1, 0.05, 0.6), 0.02, pattern="slabs", contrast=0.25, frequency=0.4)
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
        return Frame(*point, heading if left == away else heading + np.pi, z)


def build_street(loop: Loop, placer: Placer, clutter: int, rng: np.random.Generator) -> StaticBuilder:
    """Lay the roads, build the houses, stand the objects; returns what is no object.

    Args:
        loop: the camera's way.
        placer: where objects go, and what room they take.
        clutter: number of small things that are no object.
        rng: source of every random number.
    """
    builder, street = StaticBuilder(), Street(loop)
    _ground(builder, street, rng)
    _markings(builder, street, rng)
    groups = [*_lots(builder, street, placer, rng), *_parked(street, placer, rng), *_pavement(street, placer, rng)]
    groups += _island(builder, street, placer, rng)
    for number in rng.permutation(len(groups)):
        if placer.full:
            break
        groups[number]()
    _scatter(street, placer, rng)
    _furniture(builder, street, placer, clutter, rng)
    return builder


def _ground(builder: StaticBuilder, street: Street, rng: np.random.Generator) -> None:
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
    builder.ribbon(
        street.line(s, outer + 0.3, PAVEMENT), street.line(s, outer + WALK, PAVEMENT), PAVING, closed=True
    )
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


def _markings(builder: StaticBuilder, street: Street, rng: np.random.Generator) -> None:
    """Lane dashes, bays, crossings; repairs, cracks, manholes, leaves: what gives a road its corners."""
    loop = street.loop
    left = -loop.inner  # the opposite lane lies inside where the inside is to the left
    for s in np.arange(0, loop.length - 4, 6.0):
        along = np.linspace(s, s + 2.6, 4)
        middle = left * LANE / 2
        builder.ribbon(
            street.line(along, middle - 0.07, 0.006), street.line(along, middle + 0.07, 0.006), scenery.MARK
        )
        for offset in (street.kerb[1] - 2.4, 2.4 - street.kerb[-1]):
            frame = street.frame(s, offset, 0.006)
            builder.quad(frame(-0.05, 0), frame(0.05, 0), frame(0.05, 2.3), frame(-0.05, 2.3), scenery.MARK)
            builder.quad(frame(-0.5, -0.05), frame(0.5, -0.05), frame(0.5, 0.05), frame(-0.5, 0.05), scenery.MARK)
    for s in rng.uniform(0, loop.length, max(2, int(loop.length / 45))):
        for lateral in np.arange(-street.kerb[-1] + 0.5, street.kerb[1] - 0.7, 1.0):
            frame = Frame(*street.at(s, lateral)[0], street.at(s, lateral)[1], 0.007)
            builder.quad(frame(0, -0.25), frame(3, -0.25), frame(3, 0.25), frame(0, 0.25), scenery.MARK)
    greys = [Material(hsv(rng.choice([0.1, 0.6]), 0.06, v), 0.02, pattern="grain", contrast=0.35, frequency=f)
             for v, f in zip((0.30, 0.36, 0.52, 0.58, 0.26), (3.0, 2.0, 4.0, 3.0, 6.0))]  # fmt: skip
    bright = [Material(hsv(rng.random(), s, v)) for s, v in ((0.1, 0.95), (0.8, 0.7), (0.7, 0.5), (0.1, 0.15), (0.5, 0.4))]
    for kind, count, z in ((0, 0.35, 0.002), (1, 0.3, 0.004), (2, 1.6, 0.012)):
        for _ in range(int(count * loop.length)):
            lateral = rng.uniform(-street.kerb[-1] + 0.3, street.kerb[1] - 0.3)
            point, heading = street.at(rng.uniform(0, loop.length), lateral)
            frame = Frame(*point, heading + rng.choice([0.0, rng.uniform(-0.6, 0.6)]), z + rng.uniform(0, 0.0015))
            if kind == 2:  # leaves, paper
                frame = Frame(*point, rng.uniform(-3, 3), z)
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


Group = Callable[[], None]
"""Stands a few objects that belong together."""


def _parked(street: Street, placer: Placer, rng: np.random.Generator) -> list[Group]:
    """Cars, and now and then a row of motorbikes or a bus, along both kerbs."""
    groups: list[Group] = []
    for side in (1, -1):
        lateral = side * (street.kerb[side] - 1.2)
        right = side == street.loop.inner
        s, end = rng.uniform(0, 3), street.loop.length - 3
        while s < end:
            kind = rng.random()
            length = 6.0 if kind < 0.82 else 4.0

            def park(s: float = s, lateral: float = lateral, kind: float = kind, right: bool = right) -> None:
                if kind < 0.82:
                    point, heading = street.at(s + rng.uniform(-0.3, 0.3), lateral + rng.normal(0, 0.07))
                    placer.place("car", point, heading + (0 if right else np.pi) + rng.normal(0, 0.03), longest=6.0)
                    return
                look = placer.catalogue.pick("motorbike") if rng.random() < 0.4 else None
                for k in range(int(rng.integers(2, 4))):
                    point, heading = street.at(s - 1.2 + 1.3 * k, lateral)
                    across = heading + (np.pi / 2 if rng.random() < 0.8 else -np.pi / 2)
                    placer.place("motorbike", point, across + rng.normal(0, 0.15), look=look)

            groups.append(park)
            s += length * rng.choice([1.0, 1.0, 1.0, 1.6])
    return groups


def _pavement(street: Street, placer: Placer, rng: np.random.Generator) -> list[Group]:
    """Bicycles at racks, motorbikes, seats and sofas put out on the pavement."""
    groups: list[Group] = []
    for side in (1, -1):
        for s in np.arange(rng.uniform(0, 4), street.loop.length, 5.0):

            def stand(s: float = s + rng.uniform(-1, 1), side: int = side) -> None:
                kind = rng.random()
                lateral = side * (street.kerb[side] + rng.uniform(0.9, 1.6))
                if kind < 0.55:
                    look = placer.catalogue.pick("bicycle") if rng.random() < 0.3 else None
                    turn = rng.choice([0, np.pi]) + rng.normal(0, 0.1)
                    for k in range(int(rng.integers(1, 4))):
                        point, heading = street.at(s + 0.9 * k, lateral + side * 0.4)
                        placer.place("bicycle", point, heading + np.pi / 2 + turn, look=look, floor=PAVEMENT)
                elif kind < 0.75:
                    point, heading = street.at(s, lateral)
                    placer.place("motorbike", point, heading + rng.uniform(-3.1, 3.1), floor=PAVEMENT)
                elif kind < 0.9:
                    _cafe_table(street, placer, s, side * (street.kerb[side] + rng.uniform(1.8, 2.6)), rng)
                else:
                    frame = street.frame(s, side * (street.kerb[side] + 2.6))
                    placer.place("sofa", frame.origin[:2], frame.heading - np.pi / 2, longest=2.4, floor=PAVEMENT)

            groups.append(stand)
    return groups


def _cafe_table(street: Street, placer: Placer, s: float, lateral: float, rng: np.random.Generator) -> None:
    """A table with chairs of one kind about it."""
    point, heading = street.at(s, lateral)
    table = placer.place("diningtable", point, heading, longest=1.8, floor=PAVEMENT)
    if table is None:
        return
    chair = placer.catalogue.pick("chair", 1.35)
    reach = 0.5 * table.look.item.shape.dimensions[:2] + 0.45
    for k in range(int(rng.integers(2, 5))):
        angle = 0.5 * np.pi * k + rng.normal(0, 0.1)
        offset = turned(heading + np.pi / 2)[:2, :2] @ (reach * [np.cos(angle), np.sin(angle)])
        facing = float(np.arctan2(-offset[1], -offset[0]))
        placer.place("chair", point + offset, facing + rng.normal(0, 0.25), look=chair, floor=PAVEMENT)


def _lots(builder: StaticBuilder, street: Street, placer: Placer, rng: np.random.Generator) -> list[Group]:
    """Houses and yards along the outside."""
    groups: list[Group] = []
    loop, facade = street.loop, street.kerb[1] + WALK
    kinds, weights = ("house", "cars", "bus", "boat", "aeroplane", "train", "garden"), (0.5, 0.13, 0.1, 0.1, 0.05, 0.05, 0.07)
    s = 0.0
    while s < loop.length - 6:
        kind = str(rng.choice(kinds, p=weights))
        width = rng.uniform(8, 13) if kind == "house" else rng.uniform(14, 22)
        width = min(width, loop.length - s)
        kind = kind if width >= 10 else "house"
        # Along the outside of a bend a lot is wider than its share of the camera's way.
        front, back = street.at(s, facade)[0], street.at(s + width, facade)[0]
        room = float(np.linalg.norm(back - front))
        frame = street.frame(s + width / 2, facade + 0.2, PAVEMENT)
        if kind == "house":
            depth, storeys = rng.uniform(7, 9.5), int(rng.choice([2, 3, 4], p=[0.45, 0.4, 0.15]))
            wide = room - (0.1 if rng.random() < 0.6 else rng.uniform(1.0, 2.5))
            footprint = placer.block(frame(0, depth / 2 + 0.15), frame.heading, (wide / 2, depth / 2), (-1, 30))
            if placer.free(footprint):
                scenery.house(builder, frame, wide, depth, storeys, rng, rng.random() < 0.45)
                placer.taken.append(footprint)
        else:
            groups += _yard(builder, street, placer, s, width, room, kind, rng)
        s += width
    return groups


def _yard(
    builder: StaticBuilder, street: Street, placer: Placer, s: float, width: float, room: float, kind: str,
    rng: np.random.Generator,
) -> list[Group]:  # fmt: skip
    """An open lot: its ground, what closes it at the back, and the objects that stand in it."""
    facade = street.kerb[1] + WALK
    ground = {"garden": GRASS, "boat": GRAVEL, "train": GRAVEL}.get(kind, YARD_CONCRETE)
    along = np.linspace(s + 0.02, s + width - 0.02, max(3, int(width / 2)))
    builder.ribbon(street.line(along, facade, PAVEMENT), street.line(along, facade + YARD, PAVEMENT), ground)
    frame = street.frame(s + width / 2, facade, PAVEMENT)
    end = Frame(*frame(0, YARD)[:2], frame.heading, PAVEMENT)
    closing = rng.random()
    if closing < 0.4:
        scenery.hedge(builder, end, room * 1.2, rng.uniform(1.6, 2.8), rng)
    elif closing < 0.75:
        scenery.fence(builder, end, room * 1.2, rng)
    else:
        scenery.house(builder, end, room, 8.0, int(rng.integers(1, 4)), rng, False)
    for _ in range(int(rng.integers(2, 5))):
        x, y, _ = frame(rng.uniform(-0.5, 0.5) * room, YARD + rng.uniform(1, 8) + (9 if closing >= 0.75 else 0))
        scenery.tree(builder, x, y, rng.uniform(5, 9), rng)
    half = max(0.5, room / 2 - 1.5)
    groups: list[Group] = []

    def stand(category: str, x: float, y: float, facing: float, longest: float = np.inf) -> Group:
        def group() -> None:
            placer.place(
                category, frame(x, y)[:2], frame.heading + facing + rng.normal(0, 0.05), floor=PAVEMENT,
                longest=SIZES.get(category, longest),
            )  # fmt: skip

        return group

    if kind == "cars":
        for y in (3.2, 10.5):
            groups += [stand("car", x, y, rng.choice([-1, 1]) * np.pi / 2, 6.0) for x in np.arange(-half, half, 2.9)]
    elif kind == "bus":
        groups += [stand("bus", x, 8.0, rng.choice([-1, -1, 1]) * np.pi / 2) for x in np.arange(-half + 1, half, 4.4)]
    elif kind == "boat":
        groups += [stand("boat", x, 5.5 + 1.5 * rng.random(), rng.uniform(-0.4, 0.4) - np.pi / 2)
                   for x in np.arange(-half + 1, half, 4.6)]  # fmt: skip
    elif kind == "aeroplane":
        groups.append(stand("aeroplane", 0.0, 7.5, rng.choice([-1, 1]) * rng.uniform(0.3, 2.8)))
        groups += [stand("motorbike", x, 1.5, rng.uniform(-3, 3)) for x in (-half, half)]
    elif kind == "train":
        builder.box(frame, (-room / 2, 9.0, 0), (room / 2, 12.4, 0.02), GRAVEL)
        groups.append(stand("train", 0.0, 10.5, rng.choice([0.0, np.pi])))
        groups += [stand("bicycle", x, 2.0, np.pi / 2) for x in np.arange(-half, half, 1.2)]
    else:
        for _ in range(6):
            category = str(rng.choice(["chair", "chair", "sofa", "diningtable", "bicycle"]))
            groups.append(stand(category, rng.uniform(-half, half), rng.uniform(1, 7), rng.uniform(-3, 3), 2.4))
        scenery.tree(builder, *frame(rng.uniform(-half, half), 10.0)[:2], rng.uniform(5, 8), rng)
    return groups


def _island(builder: StaticBuilder, street: Street, placer: Placer, rng: np.random.Generator) -> list[Group]:
    """Inside the loop: houses back to back where there is room, else a green with trees and things standing about."""
    loop, kerb = street.loop, street.kerb[-1]
    lawn = loop.inset(kerb + WALK)
    groups: list[Group] = []
    if len(lawn) < 3:
        return groups
    s = 0.0
    while s < loop.length:
        width, depth = rng.uniform(8, 12), rng.uniform(6, 8)
        frame = street.frame(s + width / 2, -(kerb + WALK + 0.3), PAVEMENT)
        footprint = placer.block(frame(0, depth / 2 + 0.1), frame.heading, (width / 2, depth / 2), (-1, 30))
        corners = np.array([frame(x, y)[:2] for x in (-width / 2, 0, width / 2) for y in (0.0, depth)])
        if rng.random() < 0.75 and (loop.distance(corners) > kerb + WALK - 0.5).all() and placer.free(footprint):
            scenery.house(builder, frame, width, depth, int(rng.choice([1, 2, 3])), rng, rng.random() < 0.45)
            placer.taken.append(footprint)
            s += width + rng.choice([0.2, 0.2, 6.0])
        else:
            s += 2.0
    low, high = lawn.min(axis=0), lawn.max(axis=0)
    for number in range(int(0.12 * len(lawn) * max(1.0, np.sqrt(len(lawn) / 60)))):
        point = rng.uniform(low, high)
        if loop.distance(point) < kerb + WALK + 1 or not _inside(loop, point):
            continue
        footprint = placer.block(point, 0.0, (0.8, 0.8), (-1, 8))
        if placer.free(footprint):
            placer.taken.append(footprint)
            if number % 3:
                scenery.tree(builder, *point, rng.uniform(4.5, 8), rng)
            else:
                length = rng.uniform(2, 6)
                scenery.hedge(builder, Frame(*point, rng.uniform(-3, 3), PAVEMENT), min(length, 1.6), 1.1, rng)
    for _ in range(len(lawn)):
        point = rng.uniform(low, high)
        if loop.distance(point) < kerb + 2.5 or not _inside(loop, point):
            continue

        def stand(point: np.ndarray = point) -> None:
            names = ["chair", "sofa", "diningtable", "bicycle", "motorbike", "boat", "car"]
            category = str(rng.choice(names, p=[0.2, 0.12, 0.1, 0.2, 0.13, 0.1, 0.15]))
            placer.place(category, point, rng.uniform(-np.pi, np.pi), longest=6.0, floor=PAVEMENT)

        groups.append(stand)
    return groups


def _inside(loop: Loop, point: np.ndarray) -> bool:
    """Whether a point lies inside a convex loop."""
    nearest = int(np.argmin(np.linalg.norm(loop.points - point, axis=1)))
    normal = np.array([-np.sin(loop.headings[nearest]), np.cos(loop.headings[nearest])]) * loop.inner
    return float((point - loop.points[nearest]) @ normal) > 0


def _scatter(street: Street, placer: Placer, rng: np.random.Generator) -> None:
    """Fill up to the wanted number with things that need little room."""
    for _ in range(6 * max(0, placer.wanted - len(placer.objects))):
        if placer.full:
            return
        side = int(rng.choice([1, -1]))
        s, lateral = rng.uniform(0, street.loop.length), side * (street.kerb[side] + rng.uniform(0.9, WALK - 0.8))
        category = str(rng.choice(["bicycle", "motorbike", "chair", "sofa", "diningtable"], p=[0.35, 0.25, 0.2, 0.1, 0.1]))
        point, _ = street.at(s, lateral)
        placer.place(category, point, rng.uniform(-np.pi, np.pi), longest=2.8, floor=PAVEMENT)


def _furniture(builder: StaticBuilder, street: Street, placer: Placer, clutter: int, rng: np.random.Generator) -> None:
    """Lamps, signs and trees along the kerbs, and small things that are no object."""
    for side in (1, -1):
        for s in np.arange(rng.uniform(0, 8), street.loop.length - 2, 9.0):
            lateral = side * (street.kerb[side] + 0.6)
            point, heading = street.at(s, lateral)
            footprint = placer.block(point, heading, (0.3, 0.3), (-1, 5))
            if not placer.free(footprint):
                continue
            placer.taken.append(footprint)
            kind = rng.random()
            if kind < 0.35:
                to_road = street.frame(s, lateral, away=False).heading + np.pi / 2
                scenery.lamp_post(builder, *point, to_road)
            elif kind < 0.65:
                scenery.sign_post(builder, *point, heading + (0 if rng.random() < 0.5 else np.pi), rng)
            else:
                scenery.tree(builder, *point, rng.uniform(4, 6.5), rng)
    for _ in range(clutter):
        side = int(rng.choice([1, -1]))
        lateral = side * (street.kerb[side] + rng.uniform(0.6, WALK + 3))
        size = float(np.exp(rng.uniform(np.log(0.4), np.log(1.5))))
        point, heading = street.at(rng.uniform(0, street.loop.length), lateral)
        footprint = placer.block(point, heading, (size / 2, size / 2), (-1, size))
        if placer.free(footprint):
            placer.taken.append(footprint)
            scenery.litter(builder, *point, size, rng, PAVEMENT)
