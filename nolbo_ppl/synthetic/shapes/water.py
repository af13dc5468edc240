"""Boats: sailing yacht, motor yacht, speedboat, rowing boat, trawler, cargo ship. Lengths in metres, the bow at -y."""

from __future__ import annotations

from nolbo_ppl.synthetic.shapes.hull import SHARP, add_deck, add_hull
from nolbo_ppl.synthetic.shapes.sailing import rowing_boat, sailing_boat
from nolbo_ppl.synthetic.shapes.shape_builder import Builder, Draw
from nolbo_ppl.synthetic.shapes.working_boats import cargo_ship, trawler


def boat(b: Builder, d: Draw) -> int:
    """Add one boat; returns its symmetry. The bow is pointed and rises, the stern is cut off."""
    style = d.choice(sail=0.26, yacht=0.18, speed=0.18, rowing=0.14, trawler=0.13, cargo=0.11)
    families = {"sail": sailing_boat, "yacht": _yacht, "speed": _speed, "rowing": rowing_boat, "trawler": trawler}
    families.get(style, cargo_ship)(b, d)
    return 1


def _yacht(b: Builder, d: Draw) -> None:
    """Add a motor yacht: raked decks of glass stepping up from the bow, flat behind."""
    length = d(9.0, 32.0)
    beam, depth = length * d(0.22, 0.3), length * d(0.1, 0.14)
    s = add_hull(b, d, length, beam, depth, depth * d(0.3, 0.6), SHARP, d(0.3, 0.7), d(0.8, 0.95))
    add_deck(b, s, 0.015 * length, 0.01 * length)
    y0, y1, z = -0.5 * length + length * d(0.24, 0.34), 0.5 * length - length * d(0.1, 0.25), depth
    half = 0.4 * beam
    for _ in range(d.integer(1, 3)):
        h = length * d(0.055, 0.08)
        rake = h * d(1.2, 2.2)
        profile = [(y0, z - 0.01 * length), (y0 + rake, z + h), (y1 - 0.3 * h, z + h), (y1, z - 0.01 * length)]
        b.side(("windscreen", "body", "body", "body"), profile, half, caps="body")
        low, high = z + 0.35 * h, z + 0.8 * h
        b.side(
            "glass",
            [(y0 + 0.45 * rake, low), (y0 + 0.9 * rake, high), (y1 - 0.8 * h, high), (y1 - 0.6 * h, low)],
            half + 0.005 * length,
            decal=True,
        )
        b.box(
            "body",
            (-half * 1.04, half * 1.04),
            (y0 + 0.8 * rake, y1 + 0.5 * h),
            (z + h - 0.002 * length, z + h + 0.008 * length),
        )
        y0, y1, half, z = (
            y0 + rake * d(1.1, 1.6),
            y1 - length * d(0.06, 0.14),
            half * d(0.8, 0.92),
            z + h + 0.006 * length,
        )
        if y1 - y0 < 0.14 * length:
            break
    mast = length * d(0.04, 0.1)
    b.side(
        "trim",
        [
            (y1 - 0.1 * length, z),
            (y1 - 0.06 * length, z + mast),
            (y1 - 0.03 * length, z + mast),
            (y1 - 0.02 * length, z),
        ],
        0.02 * length,
    )
    b.tubes(
        "metal",
        [
            (0.02 * beam, -0.49 * length, s[0][2] + 0.03 * length),
            (0.3 * beam, -0.38 * length, s[1][2] + 0.03 * length),
            (0.44 * beam, -0.2 * length, s[2][2] + 0.03 * length),
        ],
        0.004 * length,
        segments=3,
    )
    b.box(
        "wood",
        (-0.42 * beam, 0.42 * beam),
        (0.5 * length - 0.03 * length, 0.5 * length + 0.05 * length),
        (0.2 * depth, 0.32 * depth),
    )


def _speed(b: Builder, d: Draw) -> None:
    """Add a speedboat: long fore deck, low windscreen, seats, an outboard engine at the stern."""
    length = d(4.0, 8.0)
    beam, depth = length * d(0.3, 0.4), length * d(0.13, 0.18)
    s = add_hull(b, d, length, beam, depth, depth * d(0.2, 0.45), SHARP, d(0.3, 0.8), d(0.85, 0.97))
    screen = -0.5 * length + length * d(0.36, 0.48)
    add_deck(b, s, 0.02 * length, 0.014 * length, role="body")
    half = 0.4 * beam
    high = length * d(0.06, 0.11)
    b.side(
        "windscreen",
        [
            (screen, depth),
            (screen + 1.1 * high, depth + high),
            (screen + 1.1 * high + 0.02 * length, depth + high),
            (screen + 0.06 * length, depth),
        ],
        half,
    )
    b.pair(
        "windscreen",
        (half - 0.012 * length, half + 0.004 * length),
        (screen + 0.04 * length, screen + 0.2 * length),
        (depth, depth + 0.7 * high),
    )
    end = 0.5 * length - 0.05 * length
    b.box("deck", (-half * 0.9, half * 0.9), (screen + 0.07 * length, end), (depth, depth + 0.03 * length), decal=True)
    rows = d.integer(1, 2)
    for i in range(rows):
        y = screen + (0.16 + 0.19 * i) * length
        for sign in (-1.0, 1.0):
            b.box(
                "cushion",
                (sign * half * 0.5 - 0.3 * half, sign * half * 0.5 + 0.3 * half),
                (y, y + 0.08 * length),
                (depth, depth + 0.055 * length),
            )
            b.box(
                "cushion",
                (sign * half * 0.5 - 0.3 * half, sign * half * 0.5 + 0.3 * half),
                (y + 0.07 * length, y + 0.09 * length),
                (depth, depth + 0.12 * length),
            )
    for x in (0.0,) if d.chance(0.7) else (-0.14 * beam, 0.14 * beam):
        w = 0.035 * length
        b.loft(
            2,
            "trim",
            (depth * 0.9, depth * 1.5, depth * 1.5 + 0.07 * length),
            [(x, 0.54 * length)] * 3,
            [(w, 0.05 * length), (w, 0.06 * length), (0.7 * w, 0.045 * length)],
            exponent=4,
            segments=8,
        )
        b.box("dark_metal", (x - 0.35 * w, x + 0.35 * w), (0.505 * length, 0.55 * length), (-0.3 * depth, depth))
    if d.chance(0.3):
        top = depth + length * d(0.22, 0.3)
        b.tubes(
            "metal",
            [(half, screen + 0.12 * length, depth), (half, screen + 0.18 * length, top)],
            0.007 * length,
            segments=4,
        )
        b.tubes("metal", [(half, end - 0.1 * length, depth), (half, end - 0.14 * length, top)], 0.007 * length, segments=4)
        b.box(
            "fabric",
            (-half * 1.05, half * 1.05),
            (screen + 0.12 * length, end - 0.1 * length),
            (top, top + 0.02 * length),
        )
