"""Boats: sailing yacht, motor yacht, speedboat, rowing boat, trawler, cargo ship. Lengths in metres, the bow at -y."""

from __future__ import annotations

import math

from nolbo_ppl.data.shapes.builder import Builder, Draw

ROUND = ((-1.0, 1.0), (-0.92, 0.1), (-0.6, -0.7), (0.0, -1.0), (0.6, -0.7), (0.92, 0.1), (1.0, 1.0))
SHARP = ((-1.0, 1.0), (-0.95, 0.0), (0.0, -1.0), (0.95, 0.0), (1.0, 1.0))
BLUNT = ((-1.0, 1.0), (-1.0, -0.6), (-0.7, -1.0), (0.7, -1.0), (1.0, -0.6), (1.0, 1.0))


def boat(b: Builder, d: Draw) -> int:
    """Add one boat; returns its symmetry. The bow is pointed and rises, the stern is cut off."""
    style = d.choice(sail=0.26, yacht=0.18, speed=0.18, rowing=0.14, trawler=0.13, cargo=0.11)
    {"sail": _sail, "yacht": _yacht, "speed": _speed, "rowing": _rowing, "trawler": _trawler, "cargo": _cargo}[style](b, d)
    return 1


def _hull(
    b: Builder, d: Draw, length: float, beam: float, depth: float, sheer: float, section: tuple[tuple[float, float], ...],
    fullness: float, transom: float, band: bool = True,
) -> list[tuple[float, float, float]]:
    """Add the hull: stations from the bow to the transom; returns (y, half beam, deck height) of each station.

    `fullness` is how soon the plan reaches its beam, `transom` the share of it left at the stern.
    """
    half = 0.5 * beam
    shares = (0.0, 0.08, 0.2, 0.4, 0.7, 1.0)
    plan = (0.03, 0.3 + 0.3 * fullness, 0.62 + 0.3 * fullness, 1.0, 1.0, transom)
    deck = [depth + sheer * (1 - min(s / 0.6, 1.0)) ** 2 for s in shares]
    keel = [(0.55, 0.3, 0.1, 0.0, 0.0, 0.12 * d(0.3, 1.5))[i] * depth for i in range(6)]
    ys = [length * (s - 0.5) for s in shares]
    b.loft(1, "hull", ys, [(0.0, 0.5 * (z + k)) for z, k in zip(deck, keel)],
           [(half * w, 0.5 * (z - k)) for w, z, k in zip(plan, deck, keel)], section=section, caps="hull")
    stations = [(y, half * w, z) for y, w, z in zip(ys, plan, deck)]
    if band:
        high = 0.05 * depth + 0.02
        b.loft(1, "body2", [ys[0] - 0.006 * length, *ys[1:-1], ys[-1] + 0.006 * length], [(0.0, z - high - 0.006 * length) for z in deck], [(w + 0.008 * length, high) for _, w, _ in stations],
               section=((-1, -1), (1, -1), (1, 1), (-1, 1)), decal=True)
    return stations


def _deck(b: Builder, stations: list[tuple[float, float, float]], inset: float, lift: float, role: str = "deck") -> None:
    """Add the deck as a thin lid that follows the sheer."""
    b.loft(1, role, [y for y, _, _ in stations], [(0.0, z + 0.5 * lift) for _, _, z in stations],
           [(max(w - inset, 0.02 * inset), 0.5 * lift) for _, w, _ in stations],
           section=((-1, -1), (1, -1), (1, 1), (-1, 1)), decal=True)


def _sail(b: Builder, d: Draw) -> None:
    """Add a sailing boat: mast before the middle, main sail behind it, jib to the bow, fin keel, sometimes two masts."""
    length = d(4.5, 14.0)
    beam, depth = length * d(0.24, 0.34), length * d(0.09, 0.13)
    s = _hull(b, d, length, beam, depth, depth * d(0.1, 0.35), ROUND, d(0.2, 0.6), d(0.5, 0.85))
    _deck(b, s, 0.02 * length, 0.012 * length)
    bow, stern = -0.5 * length, 0.5 * length
    mast_y, mast_h = bow + length * d(0.34, 0.44), length * d(1.0, 1.35)
    tube = 0.011 * length
    b.tube("metal", [(0, mast_y, 0.3 * depth), (0, mast_y, depth + mast_h)], [1.2 * tube, 0.7 * tube], segments=6)
    boom = length * d(0.34, 0.46)
    z = depth + length * d(0.1, 0.14)
    b.tube("metal", [(0, mast_y, z), (0, mast_y + boom, z)], 0.8 * tube, segments=5)
    t = 0.006 * length
    belly = d(-0.06, 0.06) * length
    roach = mast_y + boom * d(0.5, 0.62)

    def sheet(profile: list[tuple[float, float]]) -> None:
        # The cloth stands out to one side, more the further aft: a slanting pair of planes.
        slope = belly / boom
        b.extrude(0, "sail", profile, (-t - slope * mast_y, slope, 0.0), (t - slope * mast_y, slope, 0.0))

    if d.chance(0.85):
        sheet([(mast_y + 1.5 * tube, z + 0.02 * length), (mast_y + 1.5 * tube, depth + 0.97 * mast_h),
               (roach, z + 0.5 * mast_h), (mast_y + 0.96 * boom, z + 0.02 * length)])
        if d.chance(0.8):
            top = depth + mast_h * d(0.7, 0.95)
            sheet([(bow + 0.03 * length, depth * 1.35), (mast_y - 2 * tube, top), (mast_y - 2 * tube + d(0.0, 0.08) * length, depth + 0.1 * length)])
    else:
        b.tube("sail", [(0, mast_y, z + 3 * tube), (0, mast_y + 0.95 * boom, z + 3 * tube)], 2.4 * tube, segments=6)
    b.tube("dark_metal", [(0, bow + 0.02 * length, depth * 1.2), (0, mast_y, depth + 0.97 * mast_h)], 0.25 * tube, segments=3)
    if d.chance(0.7):
        w, h = 0.28 * beam, length * d(0.04, 0.07)
        y0, y1 = mast_y - 0.06 * length, mast_y + length * d(0.16, 0.26)
        b.side(("windscreen", "body", "wood", "body"), [(y0, depth), (y0 + 1.5 * h, depth + h), (y1, depth + h), (y1, depth)], w, caps="body")
        b.side("glass", [(y0 + 2 * h, depth + 0.4 * h), (y0 + 2.3 * h, depth + 0.8 * h), (y1 - h, depth + 0.8 * h), (y1 - h, depth + 0.4 * h)],
               w + 0.006 * length, decal=True)
        b.box("wood", (-0.2 * beam, 0.2 * beam), (y1 + 0.04 * length, stern - 0.06 * length), (depth, depth + 0.02 * length), decal=True)
    b.side("trim", [(stern - 0.03 * length, -0.05 * length), (stern - 0.02 * length, 0.9 * depth), (stern + 0.03 * length, 0.9 * depth),
                    (stern + 0.02 * length, -0.05 * length)], 0.006 * length)
    if d.chance(0.5):
        keel = length * d(0.07, 0.13)
        b.side("trim", [(-0.12 * length, 0.1 * depth), (-0.04 * length, -keel), (0.1 * length, -keel), (0.12 * length, 0.1 * depth)], 0.012 * length)
    if length > 9 and d.chance(0.3):
        y = stern - 0.16 * length
        b.tube("metal", [(0, y, depth), (0, y, depth + 0.6 * mast_h)], tube, segments=5)
        b.extrude(0, "sail", [(y + 2 * tube, z), (y + 2 * tube, depth + 0.55 * mast_h), (y + 0.25 * length, z)], -t, t)


def _yacht(b: Builder, d: Draw) -> None:
    """Add a motor yacht: raked decks of glass stepping up from the bow, flat behind."""
    length = d(9.0, 32.0)
    beam, depth = length * d(0.22, 0.3), length * d(0.1, 0.14)
    s = _hull(b, d, length, beam, depth, depth * d(0.3, 0.6), SHARP, d(0.3, 0.7), d(0.8, 0.95))
    _deck(b, s, 0.015 * length, 0.01 * length)
    y0, y1, z = -0.5 * length + length * d(0.24, 0.34), 0.5 * length - length * d(0.1, 0.25), depth
    half = 0.4 * beam
    for level in range(d.integer(1, 3)):
        h = length * d(0.055, 0.08)
        rake = h * d(1.2, 2.2)
        profile = [(y0, z - 0.01 * length), (y0 + rake, z + h), (y1 - 0.3 * h, z + h), (y1, z - 0.01 * length)]
        b.side(("windscreen", "body", "body", "body"), profile, half, caps="body")
        low, high = z + 0.35 * h, z + 0.8 * h
        b.side("glass", [(y0 + 0.45 * rake, low), (y0 + 0.9 * rake, high), (y1 - 0.8 * h, high), (y1 - 0.6 * h, low)], half + 0.005 * length, decal=True)
        b.box("body", (-half * 1.04, half * 1.04), (y0 + 0.8 * rake, y1 + 0.5 * h), (z + h - 0.002 * length, z + h + 0.008 * length))
        y0, y1, half, z = y0 + rake * d(1.1, 1.6), y1 - length * d(0.06, 0.14), half * d(0.8, 0.92), z + h + 0.006 * length
        if y1 - y0 < 0.14 * length:
            break
    mast = length * d(0.04, 0.1)
    b.side("trim", [(y1 - 0.1 * length, z), (y1 - 0.06 * length, z + mast), (y1 - 0.03 * length, z + mast), (y1 - 0.02 * length, z)], 0.02 * length)
    b.tubes("metal", [(0.02 * beam, -0.49 * length, s[0][2] + 0.03 * length), (0.3 * beam, -0.38 * length, s[1][2] + 0.03 * length),
                      (0.44 * beam, -0.2 * length, s[2][2] + 0.03 * length)], 0.004 * length, segments=3)
    b.box("wood", (-0.42 * beam, 0.42 * beam), (0.5 * length - 0.03 * length, 0.5 * length + 0.05 * length), (0.2 * depth, 0.32 * depth))


def _speed(b: Builder, d: Draw) -> None:
    """Add a speedboat: long fore deck, low windscreen, seats, an outboard engine at the stern."""
    length = d(4.0, 8.0)
    beam, depth = length * d(0.3, 0.4), length * d(0.13, 0.18)
    s = _hull(b, d, length, beam, depth, depth * d(0.2, 0.45), SHARP, d(0.3, 0.8), d(0.85, 0.97))
    screen = -0.5 * length + length * d(0.36, 0.48)
    _deck(b, s, 0.02 * length, 0.014 * length, role="body")
    half = 0.4 * beam
    high = length * d(0.06, 0.11)
    b.side("windscreen", [(screen, depth), (screen + 1.1 * high, depth + high), (screen + 1.1 * high + 0.02 * length, depth + high),
                          (screen + 0.06 * length, depth)], half)
    b.pair("windscreen", (half - 0.012 * length, half + 0.004 * length), (screen + 0.04 * length, screen + 0.2 * length), (depth, depth + 0.7 * high))
    end = 0.5 * length - 0.05 * length
    b.box("deck", (-half * 0.9, half * 0.9), (screen + 0.07 * length, end), (depth, depth + 0.03 * length), decal=True)
    rows = d.integer(1, 2)
    for i in range(rows):
        y = screen + (0.16 + 0.19 * i) * length
        for sign in (-1.0, 1.0):
            b.box("cushion", (sign * half * 0.5 - 0.3 * half, sign * half * 0.5 + 0.3 * half), (y, y + 0.08 * length), (depth, depth + 0.055 * length))
            b.box("cushion", (sign * half * 0.5 - 0.3 * half, sign * half * 0.5 + 0.3 * half), (y + 0.07 * length, y + 0.09 * length), (depth, depth + 0.12 * length))
    for x in (0.0,) if d.chance(0.7) else (-0.14 * beam, 0.14 * beam):
        w = 0.035 * length
        b.loft(2, "trim", (depth * 0.9, depth * 1.5, depth * 1.5 + 0.07 * length), [(x, 0.54 * length)] * 3, [(w, 0.05 * length), (w, 0.06 * length), (0.7 * w, 0.045 * length)],
               exponent=4, segments=8)
        b.box("dark_metal", (x - 0.35 * w, x + 0.35 * w), (0.505 * length, 0.55 * length), (-0.3 * depth, depth))
    if d.chance(0.3):
        top = depth + length * d(0.22, 0.3)
        b.tubes("metal", [(half, screen + 0.12 * length, depth), (half, screen + 0.18 * length, top)], 0.007 * length, segments=4)
        b.tubes("metal", [(half, end - 0.1 * length, depth), (half, end - 0.14 * length, top)], 0.007 * length, segments=4)
        b.box("fabric", (-half * 1.05, half * 1.05), (screen + 0.12 * length, end - 0.1 * length), (top, top + 0.02 * length))


def _rowing(b: Builder, d: Draw) -> None:
    """Add an open rowing boat: a hollow of dark boards between gunwales, thwarts, oars, a transom."""
    length = d(2.6, 5.0)
    beam, depth = length * d(0.28, 0.42), length * d(0.11, 0.16)
    s = _hull(b, d, length, beam, depth, depth * d(0.2, 0.6), ROUND, d(0.3, 0.9), d(0.6, 0.85), band=False)
    _deck(b, s, 0.035 * length, 0.012 * length, role="deck")
    for (y0, w0, z0), (y1, w1, z1) in zip(s[:-1], s[1:]):
        b.tubes("wood", [(w0, y0, z0), (w1, y1, z1)], 0.018 * length, segments=5)
    b.box("wood", (-s[-1][1], s[-1][1]), (0.47 * length, 0.505 * length), (0.4 * depth, depth + 0.03 * length))
    for i in range(d.integer(2, 3)):
        y = (-0.16 + 0.23 * i) * length
        b.box("wood", (-0.46 * beam, 0.46 * beam), (y, y + 0.07 * length), (depth + 0.008 * length, depth + 0.035 * length))
    b.extrude(2, "body2", [(0, -0.49 * length), (-0.9 * s[2][1], s[2][0]), (0.9 * s[2][1], s[2][0])], depth * 0.9, s[1][2] + 0.02 * length)
    if d.chance(0.7):
        reach, lift = beam * d(0.75, 1.1), depth * d(0.6, 1.4)
        b.tubes("wood", [(0.25 * beam, 0.02 * length, depth * 1.5), (reach, 0.1 * length, lift)], 0.009 * length, segments=4)
        b.pair("wood", (reach - 0.02 * length, reach + 0.12 * length), (0.06 * length, 0.14 * length), (lift - 0.012 * length, lift + 0.006 * length))
    if d.chance(0.35):
        b.box("trim", (-0.05 * length, 0.05 * length), (0.5 * length, 0.58 * length), (0.6 * depth, depth * 1.7))
        b.box("dark_metal", (-0.018 * length, 0.018 * length), (0.51 * length, 0.55 * length), (-0.5 * depth, 0.7 * depth))


def _trawler(b: Builder, d: Draw) -> None:
    """Add a fishing boat or tug: wheelhouse forward, mast, funnel and a working deck with a gallows behind."""
    length = d(7.0, 26.0)
    beam, depth = length * d(0.28, 0.36), length * d(0.15, 0.2)
    s = _hull(b, d, length, beam, depth, depth * d(0.4, 0.8), ROUND, d(0.5, 1.0), d(0.7, 0.9))
    _deck(b, s, 0.02 * length, 0.012 * length)
    y0 = -0.5 * length + length * d(0.2, 0.32)
    deep, half = length * d(0.2, 0.3), 0.32 * beam
    h = length * d(0.14, 0.2)
    roof = depth + h
    sill = depth + 0.5 * h
    b.side(("body", "windscreen", "body", "body", "body"), [(y0, depth - 0.02 * length), (y0, sill), (y0 - 0.02 * length, roof), (y0 + deep, roof),
                                                            (y0 + deep, depth - 0.02 * length)], half)
    b.side("glass", [(y0 + 0.02 * length, sill), (y0 + 0.02 * length, roof - 0.12 * h), (y0 + 0.6 * deep, roof - 0.12 * h), (y0 + 0.6 * deep, sill)],
           half + 0.006 * length, decal=True)
    b.box("body2", (-half * 1.1, half * 1.1), (y0 - 0.04 * length, y0 + deep * 1.05), (roof, roof + 0.015 * length))
    mast = length * d(0.16, 0.3)
    b.tube("metal", [(0, y0 + 0.6 * deep, roof), (0, y0 + 0.6 * deep, roof + mast)], 0.009 * length, segments=5)
    b.box("light_front", (-0.1 * half, 0.1 * half), (y0 - 0.03 * length, y0 + 0.03 * length), (roof + 0.02 * length, roof + 0.05 * length))
    if d.chance(0.6):
        b.cylinder(2, "body2", (0, y0 + deep + 0.07 * length, depth + 0.45 * h), 0.045 * length, 0.5 * h, segments=10, caps="grille")
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
                b.torus(0, "tyre", (sign * (0.5 * beam + 0.005 * length), y, 0.62 * depth), 0.03 * length, 0.012 * length, segments=(10, 4))


def _cargo(b: Builder, d: Draw) -> None:
    """Add a cargo ship: a long low hull, containers or hatches, the bridge and funnel at the stern."""
    length = d(60.0, 220.0)
    beam, depth = length * d(0.13, 0.18), length * d(0.07, 0.1)
    s = _hull(b, d, length, beam, depth, depth * d(0.25, 0.5), BLUNT, d(0.7, 1.0), d(0.8, 0.95))
    _deck(b, s, 0.005 * length, 0.008 * length)
    bridge = 0.5 * length - length * d(0.16, 0.22)
    deep, h, half = length * d(0.06, 0.09), length * d(0.12, 0.18), 0.42 * beam
    b.side(("body", "windscreen", "body", "body", "body", "body"),
           [(bridge, depth - 0.01 * length), (bridge, depth + 0.78 * h), (bridge, depth + 0.92 * h), (bridge, depth + h), (bridge + deep, depth + h),
            (bridge + deep, depth - 0.01 * length)], half)
    b.box("body", (-0.52 * beam, 0.52 * beam), (bridge + 0.005 * length, bridge + 0.4 * deep), (depth + 0.74 * h, depth + 0.8 * h))
    b.box("body2", (-0.22 * beam, 0.22 * beam), (bridge + 1.15 * deep, bridge + 1.8 * deep), (depth, depth + 0.9 * h))
    b.tube("metal", [(0, bridge + 0.5 * deep, depth + h), (0, bridge + 0.5 * deep, depth + h * 1.3)], 0.005 * length, segments=4)
    fore = -0.5 * length + 0.14 * length
    b.tube("metal", [(0, fore - 0.04 * length, depth), (0, fore - 0.04 * length, depth + 0.5 * h)], 0.005 * length, segments=4)
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
            b.tube("metal", [(0, y - 0.07 * pitch, depth), (0, y - 0.07 * pitch, depth + 0.55 * h)], 0.007 * length, segments=5)
            lean = math.copysign(0.5, d(-1, 1)) * pitch
            b.tube("metal", [(0, y - 0.07 * pitch, depth + 0.15 * h), (0, y + lean, depth + 0.5 * h)], 0.004 * length, segments=4)
