"""Trains: high-speed head, electric unit, diesel locomotive, hood locomotive, steam locomotive, tram.

Lengths in metres, the nose at -y. One vehicle, whose rear is a flat end with a dark gangway.
"""

from __future__ import annotations

from nolbo_ppl.synthetic.shapes.locomotives import hood_locomotive, steam_locomotive
from nolbo_ppl.synthetic.shapes.rail_parts import PROUD, add_bogies, add_rear, add_roof_gear, add_windows
from nolbo_ppl.synthetic.shapes.shape_builder import Builder, Draw


def train(b: Builder, d: Draw) -> int:
    """Add one train head; returns its symmetry."""
    style = d.choice(express=0.24, unit=0.24, diesel=0.16, hood=0.12, steam=0.14, tram=0.1)
    family = {"express": _express, "hood": hood_locomotive, "steam": steam_locomotive}.get(style, _unit)
    family(b, d, style)
    return 1


def _express(b: Builder, d: Draw, style: str) -> None:
    """Add a high-speed head: a long nose that falls in a curve, windscreen high on it."""
    length, half, height = d(17.0, 26.0), d(1.35, 1.6), d(3.5, 4.1)
    y0, y1 = -0.5 * length, 0.5 * length
    nose = d(3.0, 7.5)
    floor = 0.35
    blunt = d(0.16, 0.3)
    shares = (0.0, 0.08, 0.3, 0.62, 1.0)
    tops = (
        floor + blunt * height,
        floor + (blunt + 0.1) * height,
        floor + (0.42 + 0.15 * blunt) * height,
        0.86 * height,
        height,
    )
    widths = (0.35, 0.6, 0.85, 0.97, 1.0)
    stations = [y0 + s * nose for s in shares] + [y1]
    high = list(tops) + [height]
    wide = list(widths) + [1.0]
    b.loft(
        1,
        ("body2", "body2", "body", "body", "body"),
        stations,
        [(0.0, 0.5 * (z + floor)) for z in high],
        [(w * half, 0.5 * (z - floor)) for w, z in zip(wide, high)],
        exponent=4,
        segments=16,
        caps=("body2", "trim"),
    )
    # The windscreen is a lens on the falling roof line.
    a, c = y0 + 0.34 * nose, y0 + 0.74 * nose
    za, zc = _between(stations, high, a), _between(stations, high, c)
    b.loft(
        1,
        "windscreen",
        (a, 0.5 * (a + c), c),
        [(0, za - 0.22), (0, 0.5 * (za + zc) - 0.12), (0, zc - 0.22)],
        [(0.5 * half, 0.25), (0.72 * half, 0.32), (0.66 * half, 0.25)],
        exponent=3,
        segments=10,
    )
    lamp = y0 + 0.14 * nose
    zl = _between(stations, high, lamp)
    for sign in (-1.0, 1.0):
        b.ellipsoid("light_front", (sign * 0.5 * half, lamp, zl - 0.36), (0.2 * half, 0.1 * nose, 0.2), segments=8)
    b.pair("glass", (half - 0.1, half + PROUD), (y0 + 0.78 * nose, y0 + nose), (2.0, 2.7), decal=True)
    z = d(1.7, 1.9)
    if d.chance(0.75):
        add_windows(b, d, half, (y0 + nose + 0.8, y1 - 1.2), (z, z + d(0.7, 0.95)), d.integer(1, 2))
    stripe = d(0.9, 1.3)
    b.pair("body2", (half - 0.1, half + 0.7 * PROUD), (y0 + nose, y1 - 0.3), (stripe, stripe + d(0.15, 0.4)), decal=True)
    add_bogies(b, d, y0 + nose * 0.9 + 1.0, y1 - 2.8, half)
    add_roof_gear(b, d, height, y1 - d(3.0, 8.0), electric=d.chance(0.6))
    add_rear(b, d, y1, half, floor + 0.5, height)


def _between(y: list[float], z: list[float], at: float) -> float:
    for i in range(len(y) - 1):
        if y[i] <= at <= y[i + 1]:
            return z[i] + (z[i + 1] - z[i]) * (at - y[i]) / (y[i + 1] - y[i])
    return z[-1]


def _unit(b: Builder, d: Draw, style: str) -> None:
    """Add a flat- or raked-front vehicle: passenger unit, diesel locomotive (blind louvred sides), tram."""
    length, half, height = {
        "unit": (d(16.0, 24.0), d(1.35, 1.6), d(3.6, 4.2)),
        "diesel": (d(13.0, 21.0), d(1.35, 1.6), d(3.8, 4.4)),
        "tram": (d(10.0, 18.0), d(1.15, 1.35), d(3.1, 3.6)),
    }[style]
    y0, y1 = -0.5 * length, 0.5 * length
    floor = d(0.3, 0.5) if style == "tram" else d(0.8, 1.05)
    rake = d(0.1, 1.6)
    sill, top = floor + d(0.8, 1.3), height - d(0.35, 0.6)
    mid = y0 + rake * (top - sill) / (height - sill)
    profile = [
        (y0 + 0.15, floor),
        (y0, floor + 0.4),
        (y0, sill),
        (mid, top),
        (y0 + rake, height - 0.15),
        (y0 + rake + 0.5, height),
        (y1, height),
        (y1, floor),
    ]
    b.side(("body2", "body2", "windscreen", "body2", "body", "body", "trim", "trim"), profile, half, caps="body")
    b.tubes("body2", [(half - 0.04, y0, sill), (half - 0.04, mid, top)], 0.13, segments=5)
    if style == "diesel" or d.chance(0.4):
        b.tube("body2", [(0, y0, sill), (0, mid, top)], 0.1, segments=5)
    panel = d(0.9, 2.2)
    b.extrude(
        0,
        "body2",
        [
            (y0 + 0.1, floor + 0.1),
            (y0 + 0.1, sill),
            (mid + 0.25, top - 0.05),
            (mid + panel, top - 0.05),
            (mid + panel * d(0.7, 1.3), floor + 0.1),
        ],
        -half - 0.8 * PROUD,
        half + 0.8 * PROUD,
        decal=True,
    )
    b.pair("glass", (half - 0.1, half + 1.5 * PROUD), (mid + 0.35, mid + 1.0), (sill + 0.1, top - 0.15), decal=True)
    lamp = d(0.2, 0.34)
    b.pair("light_front", (half - 0.25 - 2 * lamp, half - 0.2), (y0 - PROUD, y0 + 0.3), (sill - 0.2 - lamp, sill - 0.15))
    if style != "tram":
        b.box("light_front", (-lamp, lamp), (y0 + rake - 2 * PROUD, y0 + rake + 0.3), (height - 0.28, height - 0.05))
        b.box("dark_metal", (-half * 0.85, half * 0.85), (y0 - 0.3, y0 + 0.4), (floor - 0.55, floor + 0.05))
        b.side("trim", [(y0 - 0.4, 0.2), (y0 - 0.1, floor - 0.1), (y0 + 0.4, floor - 0.1), (y0 + 0.2, 0.2)], half * 0.8)
    b.box("display", (-half * 0.6, half * 0.6), (mid - PROUD, mid + 0.5), (top + 0.05, top + 0.28), decal=True)
    if style == "diesel":
        n = d.integer(3, 6)
        for i in range(n):
            y = mid + panel + 0.8 + i * (y1 - 1.5 - mid - panel) / n
            b.pair("grille", (half - 0.1, half + PROUD), (y, y + d(0.9, 1.5)), (sill + 0.3, top), decal=True)
    else:
        z = floor + d(0.8, 1.0)
        add_windows(b, d, half, (mid + panel + 0.9, y1 - 0.7), (z, z + d(0.75, 1.1)), d.integer(1, 3))
    if style == "tram":
        b.pair("trim", (half - 0.3, half + 0.02), (y0 + 0.6, y1 - 0.3), (0.15, floor + 0.05))
    b.box("dark_metal", (-half * 0.8, half * 0.8), (-0.18 * length, 0.16 * length), (0.35, floor + 0.05))
    add_bogies(b, d, y0 + d(2.2, 3.2), y1 - d(2.0, 3.0), half)
    add_roof_gear(b, d, height, d(-0.1, 0.3) * length, electric=style in ("unit", "tram") and d.chance(0.7))
    add_rear(b, d, y1, half, floor, height)
