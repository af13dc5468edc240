"""Parts of aeroplanes: fuselage, wings, fin, landing gear, propeller, jet. Lengths in metres, the nose at -y."""

from __future__ import annotations

import math

from nolbo_ppl.synthetic.shapes.shape_builder import Builder, Draw


def add_fuselage(b: Builder, d: Draw, length: float, radius: float, nose: float, tail: float, upsweep: float) -> None:
    """Add the body: a blunt nose, a barrel, a tail cone that rises; the second colour covers the rear."""
    y0, y1 = -0.5 * length, 0.5 * length
    n, t = nose * length, tail * length
    flat = d(0.92, 1.12)
    stations = (y0, y0 + 0.12 * n, y0 + 0.45 * n, y0 + n, y1 - t, y1 - 0.5 * t, y1)
    size = (0.12, 0.45, 0.8, 1.0, 1.0, 0.68, 0.14)
    rise = (-0.2, -0.14, -0.06, 0.0, 0.0, 0.35 * upsweep, upsweep)
    b.loft(
        1,
        ("body2" if d.chance(0.3) else "body",) + ("body",) * 5,
        stations,
        [(0.0, r * radius) for r in rise],
        [(s * radius, s * radius * flat) for s in size],
        segments=12,
    )
    # The cockpit: pale glass wrapped over the nose.
    a, c = y0 + 0.42 * n, y0 + 0.95 * n
    b.loft(
        1,
        "windscreen",
        (a, 0.5 * (a + c), c),
        [(0, 0.42 * radius), (0, 0.52 * radius), (0, 0.62 * radius)],
        [(0.66 * radius, 0.3 * radius), (0.76 * radius, 0.44 * radius), (0.7 * radius, 0.3 * radius)],
        segments=10,
    )


def add_wing(
    b: Builder,
    root_y: float,
    chord: float,
    span: float,
    sweep: float,
    taper: float,
    z: float,
    dihedral: float,
    thick: float,
    role: str = "wing",
    root_x: float = 0.0,
) -> None:
    """Add a pair of wings: a swept, tapered plan with dihedral, thinning outwards."""
    tip_y = root_y + sweep * span
    plan = [(root_x, root_y), (root_x + span, tip_y), (root_x + span, tip_y + taper * chord), (root_x, root_y + chord)]
    thin = 0.35 * thick / (root_x + span)
    for sign in (-1.0, 1.0):
        b.extrude(
            2,
            role,
            [(sign * x, y) for x, y in plan],
            (z - 0.5 * thick, sign * (dihedral + thin), 0.0),
            (z + 0.5 * thick, sign * (dihedral - thin), 0.0),
        )


def add_fin(b: Builder, y: float, chord: float, z: float, height: float, sweep: float, taper: float, thick: float) -> float:
    """Add the vertical tail in the second colour; returns the y of its tip."""
    tip = y + sweep * height
    b.side("body2", [(y, z), (tip, z + height), (tip + taper * chord, z + height), (y + chord, z)], 0.5 * thick)
    return tip


def add_gear(b: Builder, y_nose: float, y_main: float, x: float, z: float, drop: float, radius: float) -> None:
    """Add three legs with wheels, hanging `drop` under z."""
    for px, y in ((0.0, y_nose), (x, y_main), (-x, y_main)):
        b.tube("metal", [(px, y, z + 0.3 * drop), (px, y, z - drop + radius)], 0.25 * radius, segments=4)
        b.cylinder(0, "tyre", (px, y, z - drop + radius), radius, 0.4 * radius, segments=10)


def add_propeller(b: Builder, d: Draw, x: float, y: float, z: float, radius: float, blades: int) -> None:
    """Add spinner and blades in front of an engine whose nose is at y."""
    hub = 0.13 * radius
    b.loft(1, "body2", (y - 2.2 * hub, y - hub, y), (x, z), (0.1 * hub, 0.75 * hub, hub * 1.1), segments=8)
    turn = d(0, math.pi)
    for i in range(blades):
        a = turn + 2 * math.pi * i / blades
        u, v = math.cos(a), math.sin(a)
        w = 0.09 * radius
        plan = [
            (x - w * v, z + w * u),
            (x + w * v, z - w * u),
            (x + radius * u + 0.7 * w * v, z + radius * v - 0.7 * w * u),
            (x + radius * u - 0.7 * w * v, z + radius * v + 0.7 * w * u),
        ]
        b.extrude(1, "propeller", plan, y - 1.1 * hub, y - 0.7 * hub)


def add_jet(b: Builder, x: float, y: float, z: float, radius: float, length: float) -> None:
    """Add a nacelle: a pale lip and a dark fan in front, a narrower dark nozzle behind."""
    b.loft(
        1,
        ("metal", "body2", "body2", "dark_metal"),
        (y, y + 0.12 * length, y + 0.4 * length, y + 0.75 * length, y + length),
        (x, z),
        (0.9 * radius, radius, radius, 0.75 * radius, 0.4 * radius),
        segments=10,
        caps=("grille", "dark_metal"),
    )
