"""Houses, trees, hedges, fences, lamp posts, pictures: what stands around and is no object of any category."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nolbo_ppl.synthetic.renderer.materials import Material, hsv, sample_material
from nolbo_ppl.synthetic.scenes.distractors import sample_distractors, unit_mesh
from nolbo_ppl.synthetic.worlds.world_mesh import Frame, StaticBuilder

GLASS = (
    Material(hsv(0.58, 0.35, 0.30), 0.6, 80.0, mirror=0.35),
    Material(hsv(0.58, 0.25, 0.22), 0.6, 80.0, mirror=0.25),
    Material(hsv(0.10, 0.20, 0.55), 0.4, 80.0, mirror=0.15, glow=0.15),
)
FRAME = Material(hsv(0.1, 0.05, 0.9), 0.1)
CONCRETE = Material(hsv(0.1, 0.06, 0.68), 0.03, pattern="grain", contrast=0.18, frequency=2.0)
KERB = Material(hsv(0.1, 0.04, 0.72), 0.03, pattern="slabs", contrast=0.25, frequency=1.0)
METAL = Material(hsv(0.6, 0.05, 0.35), 0.4, 30.0)
BARK = Material(hsv(0.07, 0.45, 0.35), 0.02, pattern="grain", contrast=0.5, frequency=6.0)
MARK = Material(hsv(0.1, 0.02, 0.9), 0.05, pattern="grain", contrast=0.18, frequency=4.0)


def facade_material(rng: np.random.Generator) -> Material:
    """Brick, plaster, boards or stone."""
    kind = rng.random()
    if kind < 0.4:
        hue, value = rng.uniform(0.01, 0.09), rng.uniform(0.45, 0.75)
        return Material(hsv(hue, rng.uniform(0.3, 0.6), value), 0.02, pattern="brick", contrast=0.45, frequency=2.2)
    if kind < 0.75:
        colour = hsv(rng.choice([0.08, 0.11, 0.14, 0.3, 0.55, 0.97]), rng.uniform(0.08, 0.4), rng.uniform(0.7, 0.92))
        return Material(colour, 0.02, pattern="grain", contrast=0.16, frequency=0.9)
    if kind < 0.9:
        colour = hsv(rng.random(), rng.uniform(0.05, 0.45), rng.uniform(0.45, 0.9))
        return Material(colour, 0.03, pattern="siding", contrast=0.22, frequency=5.0)
    return Material(hsv(0.09, rng.uniform(0.05, 0.2), 0.7), 0.02, pattern="slabs", contrast=0.3, frequency=1.6)


def _window(builder: StaticBuilder, wall: Frame, x: float, z: float, size: tuple[float, float], glass: Material) -> None:
    """A window on the plane y = 0 of a frame whose outside is -y: sill and frame, glass, a bar."""
    (width, height), rim = size, 0.08
    x0, x1, z0, z1 = x - width / 2, x + width / 2, z, z + height
    builder.panel(wall, (x0 - rim, z0 - rim), (x1 + rim, z1 + rim), FRAME, -0.03)
    for a, b in ((x0, x - 0.03), (x + 0.03, x1)):
        builder.panel(wall, (a, z0), (b, z1), glass, -0.045)
    builder.box(wall, (x0 - 0.15, -0.2, z0 - 0.16), (x1 + 0.15, 0.0, z0 - 0.08), CONCRETE)


def _storey(builder: StaticBuilder, wall: Frame, width: float, z: float, rng: np.random.Generator, look: dict) -> None:
    count = max(1, int((width - 0.6) / look["pitch"]))
    for k in range(count):
        x = -width / 2 + (k + 0.5) * width / count
        glass = GLASS[int(rng.choice(3, p=[0.5, 0.4, 0.1]))]
        _window(builder, wall, x, z + 0.95, look["window"], glass)
        if rng.random() < 0.15:
            box = Material(hsv(rng.random(), 0.8, 0.7), pattern="leaves", contrast=0.6, frequency=7.0)
            builder.box(wall, (x - 0.5, -0.35, z + 0.75), (x + 0.5, -0.05, z + 1.05), box)


def _ground_floor(builder: StaticBuilder, wall: Frame, width: float, rng: np.random.Generator, shop: bool, look: dict) -> None:
    door = Material(hsv(rng.random(), 0.6, rng.uniform(0.25, 0.6)), 0.2, 40.0, pattern="planks", contrast=0.2, frequency=5.0)
    x = rng.uniform(-0.3, 0.3) * width
    builder.panel(wall, (x - 0.65, 0), (x + 0.65, 2.35), FRAME, -0.03)
    builder.panel(wall, (x - 0.5, 0), (x + 0.5, 2.2), door, -0.05)
    builder.box(wall, (x - 0.8, -0.5, 0), (x + 0.8, 0, 0.14), CONCRETE)
    for low, high in ((-width / 2 + 0.4, x - 0.95), (x + 0.95, width / 2 - 0.4)):
        if high - low < 1.0:
            continue
        if not shop:
            for k in range(count := max(1, int((high - low) / look["pitch"]))):
                glass = GLASS[int(rng.integers(2))]
                _window(builder, wall, low + (k + 0.5) * (high - low) / count, 0.95, look["window"], glass)
            continue
        _window(builder, wall, 0.5 * (low + high), 0.5, (high - low - 0.2, 1.9), GLASS[1])
        goods = rng.integers(2, 5)
        for k in range(goods):  # posters behind the pane
            middle = low + (k + 0.5) * (high - low) / goods
            half, bottom = rng.uniform(0.15, 0.4), rng.uniform(0.6, 1.2)
            poster(builder, wall, middle, bottom, 2 * half, rng.uniform(0.5, 1.0), rng, -0.06)
    if shop:
        stripes = [Material(hsv(rng.random(), 0.7, 0.75)), Material(hsv(0.1, 0.05, 0.9))]
        n = int(width / 0.6)
        for k in range(n):
            a, b = -width / 2 + k * width / n, -width / 2 + (k + 1) * width / n
            builder.quad(wall(a, -0.02, 2.95), wall(b, -0.02, 2.95), wall(b, -1.1, 2.55), wall(a, -1.1, 2.55), stripes[k % 2])
        sign = Material(hsv(rng.random(), 0.7, 0.5), 0.2)
        builder.box(wall, (-width / 2 + 0.3, -0.12, 3.05), (width / 2 - 0.3, 0, 3.6), sign)
        letters = Material(hsv(rng.random(), 0.3, 0.95))
        x = -0.35 * width
        while x < 0.33 * width:
            w = rng.uniform(0.12, 0.3)
            z1 = 3.45 - rng.choice([0.0, 0.12])
            builder.panel(wall, (x, 3.2), (x + w, z1), letters, -0.13)
            x += w + rng.choice([0.08, 0.08, 0.35])


def house(
    builder: StaticBuilder, front: Frame, width: float, depth: float, storeys: int, rng: np.random.Generator, shop: bool
) -> None:
    """A house whose front is the line y = 0 of a frame, its inside towards +y."""
    material = facade_material(rng)
    height = 3.2 * storeys + (0.6 if shop else 0.2)
    look = {"pitch": rng.uniform(1.9, 2.8), "window": (rng.uniform(0.9, 1.3), rng.uniform(1.2, 1.6))}
    roof = Material(
        hsv(rng.choice([0.02, 0.05, 0.6]), rng.uniform(0.1, 0.6), rng.uniform(0.3, 0.55)),
        pattern="brick",
        contrast=0.3,
        frequency=2.0,
    )
    builder.box(front, (-width / 2, 0, 0), (width / 2, depth, height), material, roof)
    builder.box(front, (-width / 2 - 0.05, -0.06, 0), (width / 2 + 0.05, 0, 0.45), CONCRETE)
    side_left = Frame(front(-width / 2, depth / 2), front.heading - np.pi / 2, front.origin[2])
    side_right = Frame(front(width / 2, depth / 2), front.heading + np.pi / 2, front.origin[2])
    rear = Frame(front(0, depth), front.heading + np.pi, front.origin[2])
    _ground_floor(builder, front, width, rng, shop, look)
    for level in range(1, storeys):
        _storey(builder, front, width, 3.2 * level + (0.6 if shop else 0.2), rng, look)
    for wall, length in ((side_left, depth), (side_right, depth), (rear, width)):
        for level in range(storeys):
            _storey(builder, wall, length - 1.0, 3.2 * level + 0.2, rng, look)
    if rng.random() < 0.6:
        ridge, over = rng.uniform(1.5, 3.0), 0.35
        eaves = [front(x, y, height) for x in (-width / 2 - over, width / 2 + over) for y in (-over, depth + over)]
        top = [front(x, depth / 2, height + ridge) for x in (-width / 2 - over, width / 2 + over)]
        builder.quad(eaves[0], eaves[2], top[1], top[0], roof)
        builder.quad(eaves[1], top[0], top[1], eaves[3], roof)
        for a, b, c in ((0, 1, 0), (2, 3, 1)):
            builder.polygon(np.array([eaves[a], eaves[b], top[c]]), material)
    else:
        builder.box(front, (-width / 2 - 0.15, -0.15, height), (width / 2 + 0.15, depth + 0.15, height + 0.35), CONCRETE)


def poster(
    builder: StaticBuilder,
    wall: Frame,
    x: float,
    z: float,
    width: float,
    height: float,
    rng: np.random.Generator,
    y: float = -0.03,
    rim: Material | None = None,
) -> None:
    """A picture on the plane y of a wall: a rim, a ground, a few coloured rectangles and triangles."""

    def at(u: float, v: float, lift: float) -> np.ndarray:
        return wall(x + (u - 0.5) * width, y - lift, z + v * height)

    def patch(u0: float, v0: float, u1: float, v1: float, lift: float, material: Material) -> None:
        builder.quad(at(u0, v0, lift), at(u1, v0, lift), at(u1, v1, lift), at(u0, v1, lift), material)

    patch(-0.06, -0.06, 1.06, 1.06, 0.0, rim if rim is not None else FRAME)
    base = hsv(rng.random(), rng.uniform(0.1, 0.7), rng.uniform(0.3, 0.95))
    patch(0, 0, 1, 1, 0.006, Material(base, pattern="grain", contrast=0.5, frequency=3.0 / min(width, height)))
    for k in range(int(rng.integers(2, 6))):
        u, v = np.sort(rng.random(2)), np.sort(rng.random(2))
        colour = Material(hsv(rng.random(), rng.uniform(0.2, 0.9), rng.uniform(0.15, 0.95)))
        lift = 0.012 + 0.004 * k
        if rng.random() < 0.6:
            patch(u[0], v[0], u[1], v[1], lift, colour)
        else:
            corners = np.array([at(a, b, lift) for a, b in rng.random((3, 2))])
            builder.polygon(corners, colour)


def tree(builder: StaticBuilder, place: np.ndarray, height: float, rng: np.random.Generator) -> None:
    """A trunk with a crown of a few balls, or a conifer."""
    frame = Frame(place, rng.uniform(-np.pi, np.pi))
    green = Material(
        hsv(rng.uniform(0.2, 0.36), rng.uniform(0.4, 0.7), rng.uniform(0.3, 0.6)),
        0.02,
        pattern="leaves",
        contrast=0.75,
        frequency=2.0,
    )
    if rng.random() < 0.2:
        builder.solid("cylinder", frame, (0, 0, 0.1 * height), (0.3, 0.3, 0.2 * height), BARK)
        for k in range(3):
            wide = height * (0.5 - 0.12 * k)
            builder.solid("cone", frame, (0, 0, height * (0.35 + 0.23 * k)), (wide, wide, 0.45 * height), green)
        return
    builder.solid("cylinder", frame, (0, 0, 0.25 * height), (0.07 * height, 0.07 * height, 0.5 * height), BARK)
    for _ in range(int(rng.integers(3, 6))):
        offset = rng.normal(0, 0.11, 3) * height + [0, 0, 0.68 * height]
        size = height * rng.uniform(0.32, 0.5, 3)
        builder.solid("ball", frame, offset, size, green)


def hedge(builder: StaticBuilder, frame: Frame, length: float, height: float, rng: np.random.Generator) -> None:
    """A clipped hedge along x."""
    colour = hsv(rng.uniform(0.22, 0.36), 0.6, rng.uniform(0.3, 0.5))
    green = Material(colour, 0.02, pattern="leaves", contrast=0.7, frequency=3.0)
    builder.box(frame, (-length / 2, -0.35, 0), (length / 2, 0.35, height), green)


def fence(builder: StaticBuilder, frame: Frame, length: float, rng: np.random.Generator) -> None:
    """Boards on posts along x, or a wall."""
    if rng.random() < 0.5:
        builder.box(frame, (-length / 2, -0.1, 0), (length / 2, 0.1, rng.uniform(1.6, 2.4)), facade_material(rng), CONCRETE)
        return
    wood = Material(hsv(rng.uniform(0.05, 0.1), 0.4, rng.uniform(0.3, 0.75)), pattern="grain", contrast=0.4, frequency=4.0)
    height, x = rng.uniform(1.0, 1.9), -length / 2
    while x < length / 2 - 0.05:
        builder.box(frame, (x, -0.02, 0.08), (x + 0.2, 0.02, height - rng.uniform(0, 0.06)), wood)
        x += 0.26
    for z in (0.3, 0.8 * height):
        builder.box(frame, (-length / 2, 0.02, z), (length / 2, 0.08, z + 0.1), wood)


def lamp_post(builder: StaticBuilder, place: np.ndarray, heading: float) -> None:
    """A street lamp whose arm points along the heading."""
    frame = Frame(place, heading)
    builder.solid("cylinder", frame, (0, 0, 0.4), (0.26, 0.26, 0.8), METAL)
    builder.solid("cylinder", frame, (0, 0, 2.6), (0.13, 0.13, 5.2), METAL)
    builder.box(frame, (0, -0.05, 5.1), (1.4, 0.05, 5.2), METAL)
    builder.box(frame, (1.0, -0.15, 5.0), (1.7, 0.15, 5.12), Material(hsv(0.12, 0.1, 0.95), glow=0.5))


def sign_post(builder: StaticBuilder, place: np.ndarray, heading: float, rng: np.random.Generator) -> None:
    """A traffic sign that faces against the heading."""
    frame = Frame(place, heading)
    height = rng.uniform(2.0, 2.5)
    builder.solid("cylinder", frame, (0, 0, height / 2), (0.08, 0.08, height), METAL)
    sides = int(rng.choice([3, 4, 8, 16]))
    angle = np.pi / 2 + 2 * np.pi * (np.arange(sides) + (0.5 if sides in (4, 8) else 0)) / sides
    hue = float(rng.choice([0.0, 0.0, 0.6, 0.14]))
    for radius, lift, material in (
        (0.40, 0.05, Material(hsv(hue, 0.85, 0.75))),
        (0.30, 0.06, Material(hsv(0.1, 0.02, 0.95))),
        (0.13, 0.07, Material(hsv(hue if rng.random() < 0.5 else 0, 0.85 * (rng.random() < 0.5), 0.2))),
    ):
        builder.polygon(np.array([frame(-lift, radius * np.cos(a), height + radius * np.sin(a)) for a in angle]), material)


def litter(builder: StaticBuilder, place: np.ndarray, size: float, rng: np.random.Generator, z: float = 0.0) -> None:
    """A random piece of clutter of a given box diagonal standing on the ground."""
    parts, box = sample_distractors(rng)
    frame = Frame(place, rng.uniform(-np.pi, np.pi))
    roles = rng.choice(["body", "wood", "metal", "fabric", "trim"], size=len(parts), p=[0.45, 0.2, 0.1, 0.2, 0.05])
    for part, role in zip(parts, roles):
        vertices, faces = unit_mesh(part.kind)
        local = (vertices @ part.linear.T + part.offset - [0, 0, box[0, 2]]) * size + [0, 0, z]
        builder.add(local @ frame.R.T + frame.origin, faces, _in_metres(sample_material(str(role), rng), size))


def _in_metres(material: Material, size: float) -> Material:
    """The material with its texture's frequency a metre instead of a diagonal."""
    return replace(material, frequency=material.frequency / max(size, 0.2))
