"""A passage round a furnished floor: bays with tables, sofas, screens and shelves between an outer wall and a spine."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from nolbo_ppl.synthetic.renderer.materials import Material, hsv
from nolbo_ppl.synthetic.worlds import scenery
from nolbo_ppl.synthetic.worlds.camera_path import Loop
from nolbo_ppl.synthetic.worlds.placing import Placer, WorldObject
from nolbo_ppl.synthetic.worlds.world_mesh import Frame, StaticBuilder

BAY = 4.6
"""Distance from the passage's middle to the outer wall, m."""
HEIGHT = 3.0
"""Height of the ceiling, m."""

CEILING = Material(hsv(0.1, 0.03, 0.86), 0.0, pattern="slabs", contrast=0.16, frequency=1.0)
LAMP = Material(hsv(0.13, 0.05, 1.0), glow=0.5)
SKIRTING = Material(hsv(0.08, 0.1, 0.9), 0.1)
SIDEBOARD = 0.55
"""Height of the boxes that screens stand on, m."""


def build_indoor(loop: Loop, placer: Placer, clutter: int, rng: np.random.Generator) -> StaticBuilder:
    """Lay floor and ceiling, raise the walls, furnish the bays; returns what is no object.

    Args:
        loop: the camera's way.
        placer: where objects go, and what room they take.
        clutter: number of small things that are no object.
        rng: source of every random number.
    """
    builder = StaticBuilder()
    floor_plan = _floor(builder, loop, rng)
    _outer_wall(builder, placer, floor_plan, rng)
    groups = _bays(builder, loop, placer, rng)
    groups += _middle(builder, loop, placer, rng)
    for number in rng.permutation(len(groups)):
        if placer.full:
            break
        groups[number]()
    _scatter(loop, placer, rng)
    for _ in range(clutter):
        point, heading = loop.at(rng.uniform(0, loop.length), rng.choice([-1, 1]) * rng.uniform(1.4, BAY - 0.4))
        size = float(np.exp(rng.uniform(np.log(0.25), np.log(0.9))))
        footprint = placer.block(point, float(heading), (size / 2, size / 2), (-1, size))
        if placer.free(footprint):
            placer.taken.append(footprint)
            scenery.litter(builder, point, size, rng)
    return builder


def _wall_material(rng: np.random.Generator) -> Material:
    kind = rng.random()
    colour = hsv(rng.choice([0.09, 0.12, 0.15, 0.35, 0.55, 0.62]), rng.uniform(0.05, 0.35), rng.uniform(0.7, 0.95))
    if kind < 0.55:
        return Material(colour, 0.01, pattern="grain", contrast=0.16, frequency=1.2)
    if kind < 0.8:
        return Material(colour, 0.01, pattern="lattice", contrast=0.18, frequency=3.0)
    return Material(hsv(0.03, 0.4, 0.65), 0.01, pattern="brick", contrast=0.35, frequency=3.0)


def _floor(builder: StaticBuilder, loop: Loop, rng: np.random.Generator) -> np.ndarray:
    """Floor of boards or tiles, rugs, ceiling with lamps; returns the corners of the outer wall, counter-clockwise."""
    outwards = loop.at(np.arange(0, loop.length, 0.25), -loop.inner * BAY)[0]
    middle, directions = loop.points.mean(axis=0), np.linalg.svd(loop.points - loop.points.mean(axis=0))[2]
    if np.linalg.det(directions) < 0:
        directions[1] *= -1
    local = (outwards - middle) @ directions.T
    low, high = local.min(axis=0), local.max(axis=0)
    corners = np.array([(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]) @ directions + middle
    if rng.random() < 0.6:
        wood = hsv(rng.uniform(0.06, 0.1), rng.uniform(0.35, 0.6), rng.uniform(0.5, 0.75))
        material = Material(wood, 0.08, 30.0, pattern="planks", contrast=0.38, frequency=5.5)
    else:
        tile = hsv(rng.choice([0.08, 0.1, 0.6]), rng.uniform(0.03, 0.2), rng.uniform(0.55, 0.8))
        material = Material(tile, 0.08, 30.0, pattern="slabs", contrast=0.36, frequency=2.2)
    builder.polygon(np.column_stack((corners, np.zeros(4))), material)
    builder.polygon(np.column_stack((corners[::-1], np.full(4, HEIGHT))), CEILING)
    for x in np.arange(low[0] + 1.5, high[0], 3.0):
        for y in np.arange(low[1] + 1.5, high[1], 3.0):
            square = np.array([(x - 0.6, y - 0.3), (x + 0.6, y - 0.3), (x + 0.6, y + 0.3), (x - 0.6, y + 0.3)])
            builder.polygon(np.column_stack((square @ directions + middle, np.full(4, HEIGHT - 0.02))), LAMP)
    for number, s in enumerate(np.arange(0, loop.length, 2.2)):
        lateral = 0.0 if number % 2 else rng.uniform(-3, 3)
        point, heading = loop.at(s, lateral)
        frame = Frame(point, float(heading) + rng.normal(0, 0.1), 0.004 + 0.0005 * (number % 8))
        a, b = rng.uniform(0.5, 1.1), rng.uniform(0.35, 0.7)
        pattern, frequency = [("lattice", 4.0), ("grain", 5.0), ("slabs", 6.0), ("stripes", 3.0)][int(rng.integers(4))]
        for scale, z, colour in (
            (1.0, 0.0, Material(hsv(rng.random(), 0.6, rng.uniform(0.2, 0.5)))),
            (
                0.86,
                0.003,
                Material(
                    hsv(rng.random(), rng.uniform(0.2, 0.6), rng.uniform(0.4, 0.8)),
                    0.0,
                    pattern=pattern,
                    contrast=0.5,
                    frequency=frequency,
                ),
            ),
        ):
            corner = [frame(scale * a * x, scale * b * y, z) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            builder.polygon(np.array(corner), colour)
    return corners


def _dress(builder: StaticBuilder, wall: Frame, length: float, rng: np.random.Generator, windows: bool) -> None:
    """Skirting board, pictures, doors, windows on the plane y = 0 of a frame whose room lies towards -y."""
    builder.box(wall, (-length / 2, -0.02, 0), (length / 2, 0, 0.1), SKIRTING)
    x = -length / 2 + 0.5
    while x < length / 2 - 1.0:
        kind = rng.random()
        if kind < 0.18 and x < length / 2 - 1.4:
            door = Material(
                hsv(rng.uniform(0.05, 0.1), 0.4, rng.uniform(0.4, 0.9)), 0.1, pattern="planks", contrast=0.15, frequency=4.0
            )
            builder.box(wall, (x, -0.05, 0), (x + 1.05, 0, 2.15), SKIRTING)
            builder.box(wall, (x + 0.08, -0.07, 0), (x + 0.97, 0, 2.05), door)
            builder.solid("ball", wall, (x + 0.87, -0.12, 1.0), (0.08, 0.08, 0.08), scenery.METAL)
            x += 1.5
        elif kind < 0.35 and windows and x < length / 2 - 1.8:
            pane = Material(hsv(0.57, rng.uniform(0.1, 0.35), 0.95), 0.2, 60.0, glow=0.5)
            builder.box(wall, (x, -0.05, 0.85), (x + 1.5, 0, 2.35), SKIRTING)
            for a in (x + 0.07, x + 0.78):
                builder.panel(wall, (a, 0.92), (a + 0.65, 2.28), pane, -0.06)
            x += 1.9
        elif kind < 0.88:
            width, height = rng.uniform(0.4, 1.1), rng.uniform(0.4, 0.9)
            rim = Material(hsv(rng.uniform(0.05, 0.12), rng.uniform(0, 0.6), rng.uniform(0.1, 0.8)), 0.2)
            scenery.poster(builder, wall, x + width / 2, rng.uniform(1.2, 1.6), width, height, rng, rim=rim)
            x += width + rng.uniform(0.25, 0.7)
        else:
            x += rng.uniform(0.4, 1.0)


def _outer_wall(builder: StaticBuilder, placer: Placer, corners: np.ndarray, rng: np.random.Generator) -> None:
    for k in range(4):
        a, b = corners[k], corners[(k + 1) % 4]
        length, along = float(np.linalg.norm(b - a)), (b - a) / np.linalg.norm(b - a)
        # The room lies to the left of the way from a to b: -y of a frame that runs from b to a.
        wall = Frame(0.5 * (a + b), float(np.arctan2(-along[1], -along[0])))
        builder.panel(wall, (-length / 2, 0), (length / 2, HEIGHT), _wall_material(rng))
        placer.taken.append(placer.block(wall.origin, wall.heading, (length / 2 + 1, 0.1), (-1, HEIGHT)))
        _dress(builder, wall, length, rng, windows=True)


def _partition(builder: StaticBuilder, placer: Placer, wall: Frame, length: float, rng: np.random.Generator) -> bool:
    """A wall with two sides along x of a frame; False where it has no room."""
    footprint = placer.block(wall.origin, wall.heading, (length / 2, 0.12), (-1, HEIGHT))
    if not placer.free(footprint, 1.0):
        return False
    placer.taken.append(footprint)
    builder.box(wall, (-length / 2, -0.08, 0), (length / 2, 0.08, HEIGHT), _wall_material(rng))
    for turn, shift in ((0.0, -0.08), (np.pi, 0.08)):
        side = Frame(wall(0, shift), wall.heading + turn)
        _dress(builder, side, length, rng, windows=False)
    return True


Group = Callable[[], None]
"""Stands a few objects that belong together."""


def _bays(builder: StaticBuilder, loop: Loop, placer: Placer, rng: np.random.Generator) -> list[Group]:
    """Partitions every few metres, and a group of furniture in each bay."""
    groups: list[Group] = []
    s = rng.uniform(0, 1)
    while s < loop.length - 2:
        width = rng.uniform(3.0, 4.6)
        point, heading = loop.at(s, -loop.inner * (BAY - 1.5))
        if rng.random() < 0.45:
            _partition(builder, placer, Frame(point, float(heading) + np.pi / 2), 2.8, rng)
        groups += _bay(builder, loop, placer, s + width / 2, -loop.inner, BAY, rng)
        s += width
    return groups


def _bay(
    builder: StaticBuilder, loop: Loop, placer: Placer, s: float, side: int, depth: float, rng: np.random.Generator
) -> list[Group]:
    """Two or three groups of furniture across a bay on one side (1 left, -1 right)."""

    def around(lateral: float, shift: float) -> Frame:
        point, heading = loop.at(s + shift, side * lateral)
        return Frame(point, float(heading) + side * np.pi / 2)  # x away from the passage

    groups: list[Group] = []
    for lateral, shift in ((2.6, 0.0), (depth - 0.7, rng.uniform(-0.8, 0.8)), (depth - 1.6, 1.6)):
        frame = around(lateral + rng.normal(0, 0.15), shift + rng.normal(0, 0.3))
        kind = rng.random()
        if kind < 0.33:
            groups.append(partial(_dining, placer, frame, rng))
        elif kind < 0.55:
            groups.append(partial(_lounge, builder, placer, frame, rng))
        elif kind < 0.78:
            groups.append(partial(_desk, placer, frame, rng))
        elif kind < 0.9:
            groups.append(partial(_row, placer, frame, rng))
        else:
            groups.append(partial(_cycle, placer, frame, rng))
    return groups


def _on_table(placer: Placer, table: WorldObject, category: str, rng: np.random.Generator, facing: float) -> None:
    """Stand something on a table, within the inner half of its top."""
    shape = table.look.item.shape
    offset = table.T_ground_object[:2, :2] @ (rng.uniform(-0.28, 0.28, 2) * shape.dimensions[:2])
    longest = 0.45 if category == "bottle" else 0.9
    placer.place(category, table.centre[:2] + offset, facing, on=table, longest=longest)


def _dining(placer: Placer, frame: Frame, rng: np.random.Generator) -> None:
    """A table, chairs of one kind about it, bottles on it."""
    table = placer.place("diningtable", frame.origin[:2], frame.heading, longest=2.2)
    if table is None:
        return
    chair = placer.catalogue.pick("chair", 1.35)
    reach = 0.5 * table.look.item.shape.dimensions[:2] + 0.3
    for k in range(int(rng.integers(2, 5))):
        angle = 0.5 * np.pi * k + rng.normal(0, 0.08)
        offset = table.T_ground_object[:2, :2] @ (reach * [np.cos(angle), np.sin(angle)])
        facing = float(np.arctan2(-offset[1], -offset[0]))
        placer.place("chair", table.centre[:2] + offset, facing + rng.normal(0, 0.2), look=chair)
    for _ in range(int(rng.integers(1, 4))):
        _on_table(placer, table, "bottle", rng, rng.uniform(-np.pi, np.pi))


def _lounge(builder: StaticBuilder, placer: Placer, frame: Frame, rng: np.random.Generator) -> None:
    """A sofa, and before it a screen on a low box."""
    turn = float(rng.choice([-1, 1])) * np.pi / 2
    facing = frame.heading + turn
    placer.place("sofa", frame.origin[:2], facing, longest=2.6)
    ahead = np.array([np.cos(facing), np.sin(facing)])
    point = frame.origin[:2] + 2.2 * ahead
    screen = placer.catalogue.pick("tvmonitor", 1.3)
    width, depth = screen.item.shape.dimensions[:2]
    half = (0.5 * width + 0.1, 0.5 * depth + 0.08)
    footprint = placer.block(point, facing + np.pi / 2, half, (-1, SIDEBOARD))
    if placer.full or not placer.free(footprint):
        return
    if placer.place("tvmonitor", point, facing + np.pi, look=screen, floor=SIDEBOARD) is None:
        return
    placer.taken.append(footprint)
    colour = hsv(rng.uniform(0.05, 0.1), 0.45, rng.uniform(0.25, 0.8))
    wood = Material(colour, 0.1, pattern="planks", contrast=0.25, frequency=6.0)
    place = Frame(point, facing + np.pi / 2)
    builder.box(place, (-half[0], -half[1], 0), (half[0], half[1], SIDEBOARD), wood)


def _desk(placer: Placer, frame: Frame, rng: np.random.Generator) -> None:
    """A table with a screen, a chair before it, perhaps a bottle."""
    facing = frame.heading + float(rng.choice([0, 1, 2])) * np.pi / 2
    table = placer.place("diningtable", frame.origin[:2], facing, longest=1.9)
    if table is None:
        return
    placer.place("tvmonitor", table.centre[:2], facing, on=table, longest=0.95)
    ahead = np.array([np.cos(facing), np.sin(facing)])
    reach = 0.5 * table.look.item.shape.dimensions[1] + 0.4
    placer.place("chair", table.centre[:2] + reach * ahead, facing + np.pi + rng.normal(0, 0.4), longest=1.4)
    if rng.random() < 0.6:
        _on_table(placer, table, "bottle", rng, 0.0)


def _row(placer: Placer, frame: Frame, rng: np.random.Generator) -> None:
    """Chairs of one kind side by side."""
    chair = placer.catalogue.pick("chair", 1.4)
    pitch = float(chair.item.shape.dimensions[0]) + 0.12
    for k in range(int(rng.integers(2, 5))):
        placer.place("chair", frame(0, (k - 1.5) * pitch)[:2], frame.heading + np.pi + rng.normal(0, 0.05), look=chair)


def _cycle(placer: Placer, frame: Frame, rng: np.random.Generator) -> None:
    """A bicycle or motorbike on show."""
    category = "bicycle" if rng.random() < 0.65 else "motorbike"
    placer.place(category, frame.origin[:2], frame.heading + rng.uniform(-0.8, 0.8) + np.pi / 2)


def _middle(builder: StaticBuilder, loop: Loop, placer: Placer, rng: np.random.Generator) -> list[Group]:
    """Inside the passage: a spine of walls, and furniture on both its sides."""
    inner = loop.inset(2.4, 0.25)
    groups: list[Group] = []
    centre, directions = loop.points.mean(axis=0), np.linalg.svd(loop.points - loop.points.mean(axis=0))[2]
    if len(inner) > 2:
        reach = ((inner - centre) @ directions[0]).max()
        heading = float(np.arctan2(directions[0, 1], directions[0, 0]))
        if reach > 0.8:
            _partition(builder, placer, Frame(centre, heading), 2 * float(reach), rng)
    s = rng.uniform(0, 1)
    while s < loop.length - 1.5:
        groups += _bay(builder, loop, placer, s, loop.inner, 3.6, rng)
        s += rng.uniform(2.4, 3.4)
    return groups


def _scatter(loop: Loop, placer: Placer, rng: np.random.Generator) -> None:
    """Fill up to the wanted number with things that need little room."""
    for _ in range(8 * max(0, placer.wanted - len(placer.objects))):
        if placer.full:
            return
        point, _ = loop.at(rng.uniform(0, loop.length), rng.choice([-1, 1]) * rng.uniform(1.5, BAY - 0.5))
        category = str(rng.choice(["chair", "sofa", "bicycle", "diningtable", "bottle"], p=[0.45, 0.15, 0.1, 0.15, 0.15]))
        placer.place(category, point, rng.uniform(-np.pi, np.pi), longest=2.2)
