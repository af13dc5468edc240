"""A loop of streets: parked cars, pavements with bicycles and cafés, houses and yards behind, a green inside."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from nolbo_ppl.synthetic.renderer.materials import Material, hsv
from nolbo_ppl.synthetic.worlds import scenery
from nolbo_ppl.synthetic.worlds.camera_path import Loop
from nolbo_ppl.synthetic.worlds.placing import Placer
from nolbo_ppl.synthetic.worlds.street_ground import GRASS, PAVEMENT, WALK, Street, lay_ground, paint_markings
from nolbo_ppl.synthetic.worlds.world_mesh import Frame, StaticBuilder, turned

YARD = 15.0
"""Depth of the yards behind the pavement, m."""
SIZES = {"aeroplane": 14.0, "boat": 9.0, "train": 21.0, "bus": 13.5}
"""Greatest box diagonals, m."""

GRAVEL = Material(hsv(0.1, 0.18, 0.62), 0.0, pattern="grain", contrast=0.45, frequency=2.5)
YARD_CONCRETE = Material(hsv(0.1, 0.05, 0.6), 0.02, pattern="slabs", contrast=0.25, frequency=0.4)

Group = Callable[[], None]
"""Stands a few objects that belong together."""


def build_street(loop: Loop, placer: Placer, clutter: int, rng: np.random.Generator) -> StaticBuilder:
    """Lay the roads, build the houses, stand the objects; returns what is no object.

    Args:
        loop: the camera's way.
        placer: where objects go, and what room they take.
        clutter: number of small things that are no object.
        rng: source of every random number.
    """
    builder, street = StaticBuilder(), Street(loop)
    lay_ground(builder, street, rng)
    paint_markings(builder, street, rng)
    far = [*_lots(builder, street, placer, rng), *_island(builder, street, placer, rng)]
    near = [*_parked(street, placer, rng), *_pavement(street, placer, rng)]
    # What stands beside the road is twice as likely to come early: a world of few objects shows them well.
    order = [*rng.uniform(0, 1, len(near)), *rng.uniform(0, 2, len(far))]
    for number in np.argsort(order):
        if placer.full:
            break
        (near + far)[number]()
    _scatter(street, placer, rng)
    _furniture(builder, street, placer, clutter, rng)
    return builder


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
                if kind < 0.42:
                    look = placer.catalogue.pick("bicycle") if rng.random() < 0.3 else None
                    turn = rng.choice([0, np.pi]) + rng.normal(0, 0.1)
                    for k in range(int(rng.integers(1, 3))):
                        point, heading = street.at(s + 0.9 * k, lateral + side * 0.4)
                        placer.place("bicycle", point, heading + np.pi / 2 + turn, look=look, floor=PAVEMENT)
                elif kind < 0.64:
                    point, heading = street.at(s, lateral)
                    placer.place("motorbike", point, heading + rng.uniform(-3.1, 3.1), floor=PAVEMENT)
                elif kind < 0.86:
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
    kinds, weights = ("house", "cars", "bus", "boat", "aeroplane", "train", "garden"), (0.42, 0.1, 0.14, 0.12, 0.07, 0.07, 0.08)
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
    builder: StaticBuilder,
    street: Street,
    placer: Placer,
    s: float,
    width: float,
    room: float,
    kind: str,
    rng: np.random.Generator,
) -> list[Group]:
    """An open lot: its ground, what closes it at the back, and the objects that stand in it."""
    facade = street.kerb[1] + WALK
    ground = {"garden": GRASS, "boat": GRAVEL, "train": GRAVEL}.get(kind, YARD_CONCRETE)
    along = np.linspace(s + 0.02, s + width - 0.02, max(3, int(width / 2)))
    builder.ribbon(street.line(along, facade, PAVEMENT), street.line(along, facade + YARD, PAVEMENT), ground)
    frame = street.frame(s + width / 2, facade, PAVEMENT)
    end = Frame(frame(0, YARD), frame.heading, PAVEMENT)
    closing = rng.random()
    if closing < 0.4:
        scenery.hedge(builder, end, room * 1.2, rng.uniform(1.6, 2.8), rng)
    elif closing < 0.75:
        scenery.fence(builder, end, room * 1.2, rng)
    else:
        scenery.house(builder, end, room, 8.0, int(rng.integers(1, 4)), rng, False)
    for _ in range(int(rng.integers(2, 5))):
        behind = YARD + rng.uniform(1, 8) + (9 if closing >= 0.75 else 0)
        scenery.tree(builder, frame(rng.uniform(-0.5, 0.5) * room, behind), rng.uniform(5, 9), rng)
    half = max(0.5, room / 2 - 1.5)
    groups: list[Group] = []

    def stand(category: str, x: float, y: float, facing: float, longest: float = np.inf) -> Group:
        def group() -> None:
            placer.place(
                category,
                frame(x, y)[:2],
                frame.heading + facing + rng.normal(0, 0.05),
                floor=PAVEMENT,
                longest=SIZES.get(category, longest),
            )

        return group

    if kind == "cars":
        for y in (3.2, 10.5):
            groups += [stand("car", x, y, rng.choice([-1, 1]) * np.pi / 2, 6.0) for x in np.arange(-half, half, 2.9)]
    elif kind == "bus":
        groups += [stand("bus", x, 8.0, rng.choice([-1, -1, 1]) * np.pi / 2) for x in np.arange(-half + 1, half, 4.4)]
    elif kind == "boat":
        groups += [
            stand("boat", x, 5.5 + 1.5 * rng.random(), rng.uniform(-0.4, 0.4) - np.pi / 2)
            for x in np.arange(-half + 1, half, 4.6)
        ]
    elif kind == "aeroplane":
        groups.append(stand("aeroplane", 0.0, 7.5, rng.choice([-1, 1]) * rng.uniform(0.3, 2.8)))
        groups += [stand("motorbike", x, 1.5, rng.uniform(-3, 3)) for x in (-half, half)]
    elif kind == "train":
        builder.box(frame, (-room / 2, 9.0, 0), (room / 2, 12.4, 0.02), GRAVEL)
        groups.append(stand("train", 0.0, 10.5, rng.choice([0.0, np.pi])))
        groups += [stand("bicycle", x, 2.0, np.pi / 2) for x in np.arange(-half, half, 4.0)]
    else:
        for _ in range(6):
            category = str(rng.choice(["chair", "chair", "sofa", "diningtable", "bicycle"]))
            groups.append(stand(category, rng.uniform(-half, half), rng.uniform(1, 7), rng.uniform(-3, 3), 2.4))
        scenery.tree(builder, frame(rng.uniform(-half, half), 10.0), rng.uniform(5, 8), rng)
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
                scenery.tree(builder, point, rng.uniform(4.5, 8), rng)
            else:
                length = rng.uniform(2, 6)
                scenery.hedge(builder, Frame(point, rng.uniform(-3, 3), PAVEMENT), min(length, 1.6), 1.1, rng)
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
                scenery.lamp_post(builder, point, to_road)
            elif kind < 0.65:
                scenery.sign_post(builder, point, heading + (0 if rng.random() < 0.5 else np.pi), rng)
            else:
                scenery.tree(builder, point, rng.uniform(4, 6.5), rng)
    for _ in range(clutter):
        side = int(rng.choice([1, -1]))
        lateral = side * (street.kerb[side] + rng.uniform(0.6, WALK + 3))
        size = float(np.exp(rng.uniform(np.log(0.4), np.log(1.5))))
        point, heading = street.at(rng.uniform(0, street.loop.length), lateral)
        footprint = placer.block(point, heading, (size / 2, size / 2), (-1, size))
        if placer.free(footprint):
            placer.taken.append(footprint)
            scenery.litter(builder, point, size, rng, PAVEMENT)
