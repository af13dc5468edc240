"""Aeroplanes: airliner, business jet with T-tail, high- and low-wing propeller aircraft, turboprop, fighter, biplane.

Lengths in metres, the nose at -y.
"""

from __future__ import annotations

from nolbo_ppl.synthetic.shapes.air_parts import add_fin, add_gear, add_propeller, add_wing
from nolbo_ppl.synthetic.shapes.airliners import airliner
from nolbo_ppl.synthetic.shapes.shape_builder import Builder, Draw


def aeroplane(b: Builder, d: Draw) -> int:
    """Add one aeroplane; returns its symmetry."""
    style = d.choice(airliner=0.34, business=0.16, highwing=0.14, lowwing=0.12, turboprop=0.1, fighter=0.09, biplane=0.05)
    family = {"airliner": airliner, "business": airliner, "turboprop": airliner, "fighter": _fighter}.get(style, _light)
    family(b, d, style)
    return 1


def _light(b: Builder, d: Draw, style: str) -> None:
    """Add a single-engine propeller aircraft: high wing with struts, low wing with canopy, or biplane."""
    length = d(6.5, 9.5)
    y0, y1 = -0.5 * length, 0.5 * length
    radius = length * d(0.06, 0.075)
    cowl = y0 + 0.2 * length
    b.loft(
        1,
        ("body2", "body", "body", "body", "body"),
        (y0 + 0.04 * length, cowl, y0 + 0.34 * length, y0 + 0.5 * length, y0 + 0.7 * length, y1),
        [(0, 0), (0, 0.05 * radius), (0, 0.1 * radius), (0, 0.1 * radius), (0, 0.25 * radius), (0, 0.5 * radius)],
        [
            (0.62 * radius, 0.66 * radius),
            (0.85 * radius, 0.85 * radius),
            (radius, 0.95 * radius),
            (radius, 0.95 * radius),
            (0.6 * radius, 0.6 * radius),
            (0.16 * radius, 0.25 * radius),
        ],
        exponent=3,
        segments=12,
        caps=("grille", "body"),
    )
    add_propeller(b, d, 0, y0 + 0.045 * length, 0, radius * d(1.5, 2.0), d.integer(2, 3))
    span, chord = length * d(0.56, 0.72), length * d(0.17, 0.22)
    root = y0 + length * d(0.27, 0.33)
    thick = 0.12 * chord
    if style == "highwing":
        top = 1.75 * radius
        cabin = [
            (root - 0.06 * length, 0.8 * radius),
            (root + 0.01 * length, top),
            (root + chord, top),
            (root + chord + 0.14 * length, 0.7 * radius),
        ]
        b.side(("windscreen", "body", "glass", "body"), cabin, 0.9 * radius, caps="glass")
        add_wing(b, root, chord, span, 0.0, d(0.7, 1.0), top + 0.4 * thick, d(0.0, 0.04), thick)
        b.tubes(
            "metal",
            [(0.8 * radius, root + 0.3 * chord, -0.6 * radius), (0.55 * span, root + 0.35 * chord, top)],
            0.012 * length,
            segments=4,
        )
    else:
        canopy = (root + 0.05 * length, root + 0.12 * length, root + 0.22 * length, root + 0.34 * length)
        b.loft(
            1,
            ("windscreen", "glass", "glass"),
            canopy,
            (0, 0.9 * radius),
            [
                (0.5 * radius, 0.1 * radius),
                (0.7 * radius, 0.75 * radius),
                (0.68 * radius, 0.75 * radius),
                (0.3 * radius, 0.1 * radius),
            ],
            segments=10,
        )
        add_wing(b, root, chord, span, d(0.0, 0.12), d(0.5, 0.9), -0.65 * radius, d(0.04, 0.1), thick)
        if style == "biplane":
            up = radius * d(2.0, 2.6)
            add_wing(b, root - 0.25 * chord, chord, span * 1.05, 0.0, 0.95, up, 0.02, thick)
            for x in (0.25 * radius * 2, 0.6 * span):
                b.tubes(
                    "wood",
                    [(x, root + 0.3 * chord, -0.5 * radius), (x, root + 0.2 * chord, up)],
                    0.008 * length,
                    segments=4,
                )
    fin_c = 0.13 * length
    fin_y = y1 - fin_c - 0.01 * length
    add_fin(b, fin_y, fin_c, 0.4 * radius, d(1.5, 2.2) * radius, d(0.3, 0.7), d(0.4, 0.7), 0.02 * length)
    add_wing(b, fin_y + 0.01 * length, 0.8 * fin_c, span * d(0.3, 0.38), d(0.05, 0.3), 0.7, 0.5 * radius, 0.0, 0.018 * length)
    drop, wheel = d(0.9, 1.3) * radius, 0.035 * length
    if style == "biplane" or d.chance(0.3):
        add_gear(b, y1 - 0.06 * length, root + 0.05 * chord, 1.1 * radius, -0.6 * radius, drop, wheel)
    else:
        add_gear(b, y0 + 0.14 * length, root + 0.6 * chord, 1.3 * radius, -0.6 * radius, drop, wheel)


def _fighter(b: Builder, d: Draw, style: str) -> None:
    """Add a jet fighter: pointed nose, canopy, delta or swept wing, one or two fins, nozzles behind."""
    length = d(12.0, 20.0)
    y0, y1 = -0.5 * length, 0.5 * length
    radius = length * d(0.05, 0.07)
    b.loft(
        1,
        ("body2", "body", "body", "body", "dark_metal"),
        (y0, y0 + 0.12 * length, y0 + 0.3 * length, y0 + 0.55 * length, y1 - 0.08 * length, y1),
        (0, 0),
        [
            (0.02 * radius, 0.02 * radius),
            (0.5 * radius, 0.5 * radius),
            (0.85 * radius, 0.85 * radius),
            (1.3 * radius, 0.95 * radius),
            (1.1 * radius, 0.85 * radius),
            (0.7 * radius, 0.6 * radius),
        ],
        exponent=2.6,
        segments=12,
        caps=("body2", "grille"),
    )
    b.loft(
        1,
        ("windscreen", "glass", "glass"),
        (y0 + 0.13 * length, y0 + 0.19 * length, y0 + 0.25 * length, y0 + 0.38 * length),
        (0, 0.6 * radius),
        [
            (0.2 * radius, 0.1 * radius),
            (0.45 * radius, 0.75 * radius),
            (0.48 * radius, 0.8 * radius),
            (0.2 * radius, 0.3 * radius),
        ],
        segments=10,
    )
    b.pair("grille", (0.8 * radius, 1.5 * radius), (y0 + 0.31 * length, y0 + 0.34 * length), (-0.6 * radius, 0.5 * radius))
    b.pair(
        "body",
        (0.7 * radius, 1.55 * radius),
        (y0 + 0.335 * length, y1 - 0.12 * length),
        (-0.65 * radius, 0.55 * radius),
    )
    delta = d.chance(0.5)
    root = y0 + length * (d(0.3, 0.4) if delta else d(0.42, 0.5))
    chord = length * (d(0.42, 0.5) if delta else d(0.25, 0.32))
    span = length * (d(0.28, 0.34) if delta else d(0.3, 0.38))
    add_wing(
        b,
        root,
        chord,
        span,
        (chord * d(0.75, 0.92)) / span if delta else d(0.5, 0.9),
        d(0.06, 0.2) if delta else d(0.3, 0.45),
        0.0,
        d(-0.05, 0.03),
        0.022 * length,
    )
    fin_c = d(0.16, 0.2) * length
    fin_y, fin_h = y1 - fin_c - 0.06 * length, d(1.8, 2.6) * radius
    if d.chance(0.5):
        for sign in (-1.0, 1.0):
            lean = sign * 0.2
            x = sign * 1.1 * radius
            b.extrude(
                0,
                "body2",
                [
                    (fin_y, 0.3 * radius),
                    (fin_y + 0.7 * fin_h, fin_h),
                    (fin_y + 0.7 * fin_h + 0.4 * fin_c, fin_h),
                    (fin_y + fin_c, 0.3 * radius),
                ],
                (x - 0.008 * length, 0.0, lean),
                (x + 0.008 * length, 0.0, lean),
            )
    else:
        add_fin(b, fin_y, fin_c, 0.5 * radius, fin_h, d(0.6, 0.9), d(0.3, 0.45), 0.016 * length)
    if not delta or d.chance(0.3):
        add_wing(
            b,
            fin_y + 0.35 * fin_c,
            0.7 * fin_c,
            span * 0.42,
            d(0.5, 0.8),
            0.4,
            0.0,
            0.0,
            0.014 * length,
            root_x=0.8 * radius,
        )
    elif d.chance(0.5):
        add_wing(
            b,
            y0 + 0.24 * length,
            0.1 * length,
            0.13 * length,
            0.6,
            0.3,
            0.3 * radius,
            0.05,
            0.014 * length,
            root_x=0.5 * radius,
        )
