"""Fishing boats, tugs and cargo ships. Lengths in metres, the bow at -y."""

from __future__ import annotations

import math

from nolbo_ppl.synthetic.shapes.hull import BLUNT, ROUND, add_deck, add_hull
from nolbo_ppl.synthetic.shapes.shape_builder import Builder, Draw


def trawler(b: Builder, d: Draw) -> None:
    """Add a fishing boat or tug: wheelhouse forward, mast, funnel and a working deck with a gallows behind."""
    length = d(7.0, 26.0)
    beam, depth = length * d(0.28, 0.36), length * d(0.15, 0.2)
    s = add_hull(b, d, length, beam, depth, depth * d(0.4, 0.8), ROUND, d(0.5, 1.0), d(0.7, 0.9))
    add_deck(b, s, 0.02 * length, 0.012 * length)
    y0 = -0.5 * length + length * d(0.2, 0.32)
    deep, half = length * d(0.2, 0.3), 0.32 * beam
    h = length * d(0.14, 0.2)
    roof = depth + h
    sill = depth + 0.5 * h
    b.side(
        ("body", "windscreen", "body", "body", "body"),
        [
            (y0, depth - 0.02 * length),
            (y0, sill),
            (y0 - 0.02 * length, roof),
            (y0 + deep, roof),
            (y0 + deep, depth - 0.02 * length),
        ],
        half,
    )
    b.side(
        "glass",
        [
            (y0 + 0.02 * length, sill),
            (y0 + 0.02 * length, roof - 0.12 * h),
            (y0 + 0.6 * deep, roof - 0.12 * h),
            (y0 + 0.6 * deep, sill),
        ],
        half + 0.006 * length,
        decal=True,
    )
    b.box("body2", (-half * 1.1, half * 1.1), (y0 - 0.04 * length, y0 + deep * 1.05), (roof, roof + 0.015 * length))
    mast = length * d(0.16, 0.3)
    b.tube("metal", [(0, y0 + 0.6 * deep, roof), (0, y0 + 0.6 * deep, roof + mast)], 0.009 * length, segments=5)
    b.box(
        "light_front",
        (-0.1 * half, 0.1 * half),
        (y0 - 0.03 * length, y0 + 0.03 * length),
        (roof + 0.02 * length, roof + 0.05 * length),
    )
    if d.chance(0.6):
        b.cylinder(
            2,
            "body2",
            (0, y0 + deep + 0.07 * length, depth + 0.45 * h),
            0.045 * length,
            0.5 * h,
            segments=10,
            caps="grille",
        )
    if d.chance(0.7):
        y, top = 0.5 * length - 0.06 * length, depth + length * d(0.14, 0.24)
        b.tubes("metal", [(0.36 * beam, y, depth), (0.3 * beam, y, top)], 0.011 * length, segments=5)
        b.tube("metal", [(-0.31 * beam, y, top), (0.31 * beam, y, top)], 0.011 * length, segments=5)
    if d.chance(0.6):
        b.cylinder(0, "dark_metal", (0, 0.22 * length, depth + 0.05 * length), 0.05 * length, 0.2 * beam, segments=10)
    for i in range(3):
        y = (-0.1 + 0.2 * i) * length
        if d.chance(0.6):
            for sign in (-1.0, 1.0):
                b.torus(
                    0,
                    "tyre",
                    (sign * (0.5 * beam + 0.005 * length), y, 0.62 * depth),
                    0.03 * length,
                    0.012 * length,
                    segments=(10, 4),
                )


def cargo_ship(b: Builder, d: Draw) -> None:
    """Add a cargo ship: a long low hull, containers or hatches, the bridge and funnel at the stern."""
    length = d(60.0, 220.0)
    beam, depth = length * d(0.13, 0.18), length * d(0.07, 0.1)
    s = add_hull(b, d, length, beam, depth, depth * d(0.25, 0.5), BLUNT, d(0.7, 1.0), d(0.8, 0.95))
    add_deck(b, s, 0.005 * length, 0.008 * length)
    bridge = 0.5 * length - length * d(0.16, 0.22)
    deep, h, half = length * d(0.06, 0.09), length * d(0.12, 0.18), 0.42 * beam
    b.side(
        ("body", "windscreen", "body", "body", "body", "body"),
        [
            (bridge, depth - 0.01 * length),
            (bridge, depth + 0.78 * h),
            (bridge, depth + 0.92 * h),
            (bridge, depth + h),
            (bridge + deep, depth + h),
            (bridge + deep, depth - 0.01 * length),
        ],
        half,
    )
    b.box(
        "body",
        (-0.52 * beam, 0.52 * beam),
        (bridge + 0.005 * length, bridge + 0.4 * deep),
        (depth + 0.74 * h, depth + 0.8 * h),
    )
    b.box("body2", (-0.22 * beam, 0.22 * beam), (bridge + 1.15 * deep, bridge + 1.8 * deep), (depth, depth + 0.9 * h))
    b.tube(
        "metal",
        [(0, bridge + 0.5 * deep, depth + h), (0, bridge + 0.5 * deep, depth + h * 1.3)],
        0.005 * length,
        segments=4,
    )
    fore = -0.5 * length + 0.14 * length
    b.tube(
        "metal",
        [(0, fore - 0.04 * length, depth), (0, fore - 0.04 * length, depth + 0.5 * h)],
        0.005 * length,
        segments=4,
    )
    bays = d.integer(4, 8)
    pitch = (bridge - 0.02 * length - fore) / bays
    stacked = d.chance(0.65)
    for i in range(bays):
        y = fore + i * pitch
        tall = length * (0.022 * d.integer(1, 4) if stacked else 0.015)
        w = 0.45 * beam * (0.75 if i == 0 else 1.0)
        role = d.choice(body2=1.0, label=0.7, fabric=0.7) if stacked else "trim"
        b.box(role, (-w, w), (y, y + 0.86 * pitch), (depth, depth + tall))
        if not stacked and i % 2 == 1 and d.chance(0.7):
            b.tube(
                "metal",
                [(0, y - 0.07 * pitch, depth), (0, y - 0.07 * pitch, depth + 0.55 * h)],
                0.007 * length,
                segments=5,
            )
            lean = math.copysign(0.5, d(-1, 1)) * pitch
            b.tube(
                "metal",
                [(0, y - 0.07 * pitch, depth + 0.15 * h), (0, y + lean, depth + 0.5 * h)],
                0.004 * length,
                segments=4,
            )
