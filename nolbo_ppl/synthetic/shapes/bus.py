"""Buses: city bus, coach, double-decker, school bus, minibus. Lengths in metres, the front at -y.

A bus is a box, so its front is told by much more than a windscreen: more than half of the front is pale glass over a
display and white lamps, mirrors reach forward, the side glazing steps down to the driver, and the engine
compartment behind is blind, in the second colour, with red lamps and a dark grille.
"""

from __future__ import annotations

from nolbo_ppl.synthetic.shapes.shape_builder import Builder, Draw

PROUD = 0.06
"""How far lights and windows stand off the body (0.005 of a bus's diagonal)."""


def bus(b: Builder, d: Draw) -> int:
    """Add one bus; returns its symmetry."""
    style = d.choice(city=0.34, coach=0.22, double=0.16, school=0.15, mini=0.13)
    if style == "school":
        _school(b, d)
    else:
        _box_bus(b, d, style)
    return 1


def _row(b: Builder, d: Draw, half: float, y: tuple[float, float], z: tuple[float, float], panes: int) -> None:
    """Add a row of side windows on both sides, with pillars between."""
    pitch = (y[1] - y[0]) / panes
    gap = d(0.08, 0.2)
    for i in range(panes):
        y0 = y[0] + i * pitch
        b.pair("glass", (half - 0.1, half + PROUD), (y0 + 0.5 * gap, y0 + pitch - 0.5 * gap), z, decal=True)


def _axles(b: Builder, d: Draw, half: float, ys: tuple[float, ...], radius: float) -> None:
    rim = d(0.5, 0.65)
    for y in ys:
        for sign in (-1.0, 1.0):
            b.wheel(sign * (half + 1.7 * PROUD), y, radius, 0.35, rim=rim)


def _tail(b: Builder, d: Draw, rear: float, half: float, floor: float, height: float, window: bool) -> None:
    """Add the blind back: a small high window, the engine grille, red lamps."""
    b.box("body2", (-half + 0.04, half - 0.04), (rear - 0.3, rear + PROUD), (floor + 0.1, floor + 0.62 * (height - floor)))
    b.box(
        "grille",
        (-half * 0.72, half * 0.72),
        (rear - 0.2, rear + 2 * PROUD),
        (floor + 0.35, floor + d(0.8, 1.1)),
        decal=True,
    )
    red_h = d(0.35, 0.8)
    b.pair("light_rear", (half - 0.34, half - 0.06), (rear - 0.2, rear + 2 * PROUD), (floor + 0.6, floor + 0.6 + red_h))
    b.pair("light_rear", (half - 0.4, half - 0.06), (rear - 0.2, rear + PROUD), (height - 0.22, height - 0.1), decal=True)
    b.box("trim", (-half - 0.01, half + 0.01), (rear - 0.3, rear + 0.1), (floor - 0.04, floor + 0.3))
    if window:
        top = height - 0.3
        b.box("glass", (-half * 0.6, half * 0.6), (rear - 0.2, rear + PROUD), (top - d(0.35, 0.6), top), decal=True)


def _face(b: Builder, d: Draw, front: float, half: float, floor: float, sill: float) -> None:
    """Add the lower front: bumper, white lamps, grille, plate."""
    b.box("trim", (-half - 0.02, half + 0.02), (front - 0.12, front + 0.4), (floor - 0.04, floor + d(0.25, 0.4)))
    lamp_h, lamp_w = d(0.2, 0.34), d(0.35, 0.6)
    top = min(sill - 0.08, floor + 0.42 + lamp_h)
    b.pair("light_front", (half - lamp_w - 0.05, half - 0.05), (front - PROUD, front + 0.2), (top - lamp_h, top))
    if d.chance(0.6):
        w = half - lamp_w - 0.15
        b.box("grille", (-w, w), (front - PROUD, front + 0.2), (top - lamp_h, top - 0.02), decal=True)
    b.box("plate", (-0.3, 0.3), (front - 0.18, front), (floor + 0.08, floor + 0.24), decal=True)


def _box_bus(b: Builder, d: Draw, style: str) -> None:
    """Add a bus that is one box with a raked front."""
    length, width, height, sill, rake = {
        "city": (d(9.0, 12.5), d(2.4, 2.6), d(2.8, 3.2), d(0.95, 1.3), d(0.05, 0.35)),
        "coach": (d(10.0, 13.5), d(2.45, 2.6), d(3.3, 3.9), d(1.2, 1.5), d(0.5, 1.1)),
        "double": (d(9.0, 11.5), d(2.45, 2.6), d(4.1, 4.5), d(0.95, 1.3), d(0.1, 0.4)),
        "mini": (d(5.8, 7.5), d(2.0, 2.3), d(2.5, 2.9), d(1.05, 1.25), d(0.5, 1.0)),
    }[style]
    half, front, rear = 0.5 * width, -0.5 * length, 0.5 * length
    floor, radius = d(0.26, 0.36), d(0.42, 0.52) if style != "mini" else d(0.36, 0.42)
    top = 2.35 if style == "double" else height - (0.55 if style == "coach" else d(0.3, 0.42))
    ratio = (top - sill) / (height - sill)
    y_top = front + rake * ratio
    profile = [
        (front, floor),
        (front, sill),
        (y_top, top),
        (front + rake, height - 0.12),
        (front + rake + 0.3, height),
        (rear - 0.15, height),
        (rear, height - 0.25),
        (rear, floor),
    ]
    b.side(("body", "windscreen", "body", "body", "body", "body", "body", "body"), profile, half, caps="body")
    # Corner pillars frame the windscreen, and the display sits over it.
    b.tubes("body", [(half - 0.03, front - 0.01, sill), (half - 0.03, y_top - 0.01, top)], 0.09, segments=5)
    if style == "double":
        low, high = 2.75, height - 0.35
        at = [front + rake * (z - sill) / (height - sill) for z in (low, high)]
        b.side(
            "windscreen",
            [(at[0] - PROUD, low), (at[1] - PROUD, high), (at[1] + 0.2, high), (at[0] + 0.2, low)],
            half - 0.12,
            decal=True,
        )
        b.box("display", (-half * 0.7, half * 0.7), (at[0] - 1.6 * PROUD, at[0] + 0.3), (2.4, 2.68), decal=True)
    elif style != "coach":
        b.box(
            "display",
            (-half * 0.75, half * 0.75),
            (y_top - PROUD, y_top + 0.4),
            (top + 0.05, height - 0.09),
            decal=True,
        )
    _face(b, d, front, half, floor, sill)
    engine = rear - d(1.0, 1.8) * (0.5 if style == "mini" else 1.0)
    door = front + rake + d(1.2, 1.5)
    belt = sill + d(0.0, 0.25)
    panes = d.integer(4, 7) if style != "mini" else d.integer(2, 4)
    _row(b, d, half, (door + 0.1, engine), (belt, top), panes)
    if style == "double":
        _row(b, d, half, (front + rake + 0.4, engine), (2.8, height - 0.4), panes + 1)
    # The driver's window steps down towards the windscreen; the door is on the other side.
    drive = [(front + rake * 0.4 + 0.25, sill - 0.25), (front + rake + 0.15, top), (door, top), (door, sill - 0.25)]
    b.extrude(0, "glass", drive, half - 0.1, half + PROUD, decal=True)
    door_panel = [(front + 0.2 + rake * 0.3, floor + 0.1), (front + rake + 0.15, top), (door, top), (door, floor + 0.1)]
    b.extrude(0, "glass", door_panel, -half - PROUD, -half + 0.1, decal=True)
    if style in ("city", "double") and d.chance(0.7):
        y = d(-0.05, 0.15) * length
        b.box("trim", (-half - 1.5 * PROUD, -half + 0.1), (y, y + 1.2), (floor + 0.1, top - 0.1), decal=True)
    b.pair("body2", (half - 0.2, half + 0.8 * PROUD), (engine + 0.1, rear - 0.08), (floor + 0.1, height - 0.3), decal=True)
    if d.chance(0.6):
        b.pair("body2", (half - 0.2, half + 0.8 * PROUD), (door, engine), (floor + 0.1, floor + d(0.3, 0.6)), decal=True)
    b.tubes(
        "trim",
        [
            (half - 0.02, front + 0.3 * rake, top - 0.05),
            (half + 0.14, front - 0.35, top - 0.1),
            (half + 0.14, front - 0.38, top - 0.55),
        ],
        [0.04, 0.05, 0.11],
        segments=5,
    )
    if d.chance(0.7):
        y = d(-0.3, 0.2) * length
        b.box("body2", (-half * 0.7, half * 0.7), (y, y + d(1.2, 2.6)), (height - 0.05, height + d(0.15, 0.3)))
    _tail(b, d, rear, half, floor, height, window=style != "coach" or d.chance(0.5))
    axle = rear - d(2.0, 3.2) * (0.6 if style == "mini" else 1.0)
    first = front + (d(2.2, 2.8) if style != "mini" else d(1.1, 1.4))
    extra = (axle + 1.25,) if style == "coach" and d.chance(0.5) else ()
    _axles(b, d, half, (first, axle, *extra), radius)


def _school(b: Builder, d: Draw) -> None:
    """Add a bonneted bus."""
    length, width, height = d(7.5, 11.0), d(2.2, 2.5), d(2.7, 3.1)
    half, front, rear = 0.5 * width, -0.5 * length, 0.5 * length
    floor, radius = d(0.4, 0.55), d(0.42, 0.5)
    hood, cowl = floor + d(0.75, 0.95), front + d(1.2, 1.9)
    sill, top = hood + 0.12, height - d(0.32, 0.4)
    hood_half = half * d(0.68, 0.82)
    b.side(
        "body",
        [
            (front, floor),
            (front, hood - 0.18),
            (front + 0.2, hood - 0.04),
            (cowl + 0.1, hood + 0.04),
            (cowl + 0.1, floor),
        ],
        hood_half,
    )
    cabin = [
        (cowl, floor),
        (cowl, sill),
        (cowl + 0.3, top),
        (cowl + 0.38, height - 0.1),
        (cowl + 0.7, height),
        (rear - 0.1, height),
        (rear, height - 0.2),
        (rear, floor),
    ]
    b.side(("body", "windscreen", "body", "body", "body", "body", "body", "body"), cabin, half, caps="body")
    b.tubes("body", [(half - 0.03, cowl - 0.01, sill), (half - 0.03, cowl + 0.29, top)], 0.08, segments=5)
    b.box("grille", (-hood_half * 0.6, hood_half * 0.6), (front - PROUD, front + 0.1), (floor + 0.25, hood - 0.2))
    b.pair("light_front", (hood_half * 0.64, hood_half * 0.98), (front - PROUD, front + 0.1), (hood - 0.52, hood - 0.2))
    b.box("trim", (-half, half), (front - 0.15, front + 0.2), (floor - 0.05, floor + 0.22))
    b.pair("trim", (half * 0.5, half * 0.98), (front + 0.45, cowl), (floor - 0.04, floor + 0.5))
    b.box("display", (-half * 0.6, half * 0.6), (cowl + 0.2, cowl + 0.5), (top + 0.06, height - 0.02), decal=True)
    blind = rear - d(0.5, 1.2)
    _row(b, d, half, (cowl + 1.2, blind), (sill + 0.1, top), d.integer(5, 9))
    b.pair("glass", (half - 0.1, half + PROUD), (cowl + 0.4, cowl + 1.1), (sill - 0.15, top), decal=True)
    b.pair("trim", (half - 0.1, half + PROUD), (cowl + 1.2, rear - 0.1), (sill - 0.25, sill - 0.12), decal=True)
    b.tubes(
        "trim",
        [
            (half * 0.9, cowl + 0.05, sill + 0.1),
            (half + 0.1, cowl - 0.5, sill + 0.2),
            (half + 0.1, cowl - 0.5, sill + 0.6),
        ],
        [0.04, 0.05, 0.1],
        segments=5,
    )
    _tail(b, d, rear, half, floor, height, window=True)
    _axles(b, d, half, (front + d(0.7, 1.0), rear - d(2.0, 2.8)), radius)
