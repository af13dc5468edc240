"""Aeroplanes: airliner, business jet with T-tail, high- and low-wing propeller aircraft, turboprop, fighter, biplane.

Lengths in metres, the nose at -y.
"""

from __future__ import annotations

import math

from nolbo_ppl.data.shapes.builder import Builder, Draw


def aeroplane(b: Builder, d: Draw) -> int:
    """Add one aeroplane; returns its symmetry."""
    style = d.choice(airliner=0.34, business=0.16, highwing=0.14, lowwing=0.12, turboprop=0.1, fighter=0.09, biplane=0.05)
    {"airliner": _airliner, "business": _airliner, "turboprop": _airliner, "fighter": _fighter}.get(style, _light)(b, d, style)
    return 1


def _fuselage(b: Builder, d: Draw, length: float, radius: float, nose: float, tail: float, upsweep: float) -> None:
    """Add the body: a blunt nose, a barrel, a tail cone that rises; the second colour covers the rear."""
    y0, y1 = -0.5 * length, 0.5 * length
    n, t = nose * length, tail * length
    flat = d(0.92, 1.12)
    stations = (y0, y0 + 0.12 * n, y0 + 0.45 * n, y0 + n, y1 - t, y1 - 0.5 * t, y1)
    size = (0.12, 0.45, 0.8, 1.0, 1.0, 0.68, 0.14)
    rise = (-0.2, -0.14, -0.06, 0.0, 0.0, 0.35 * upsweep, upsweep)
    b.loft(1, ("body2" if d.chance(0.3) else "body",) + ("body",) * 5, stations, [(0.0, r * radius) for r in rise],
           [(s * radius, s * radius * flat) for s in size], segments=12)
    # The cockpit: pale glass wrapped over the nose.
    a, c = y0 + 0.42 * n, y0 + 0.95 * n
    b.loft(1, "windscreen", (a, 0.5 * (a + c), c), [(0, 0.42 * radius), (0, 0.52 * radius), (0, 0.62 * radius)],
           [(0.66 * radius, 0.3 * radius), (0.76 * radius, 0.44 * radius), (0.7 * radius, 0.3 * radius)], segments=10)


def _wing(
    b: Builder, root_y: float, chord: float, span: float, sweep: float, taper: float, z: float, dihedral: float,
    thick: float, role: str = "wing", root_x: float = 0.0,
) -> None:
    """Add a pair of wings: a swept, tapered plan with dihedral, thinning outwards."""
    tip_y = root_y + sweep * span
    plan = [(root_x, root_y), (root_x + span, tip_y), (root_x + span, tip_y + taper * chord), (root_x, root_y + chord)]
    thin = 0.35 * thick / (root_x + span)
    for sign in (-1.0, 1.0):
        b.extrude(2, role, [(sign * x, y) for x, y in plan],
                  (z - 0.5 * thick, sign * (dihedral + thin), 0.0), (z + 0.5 * thick, sign * (dihedral - thin), 0.0))


def _fin(b: Builder, y: float, chord: float, z: float, height: float, sweep: float, taper: float, thick: float) -> float:
    """Add the vertical tail in the second colour; returns the y of its tip."""
    tip = y + sweep * height
    b.side("body2", [(y, z), (tip, z + height), (tip + taper * chord, z + height), (y + chord, z)], 0.5 * thick)
    return tip


def _gear(b: Builder, y_nose: float, y_main: float, x: float, z: float, drop: float, radius: float) -> None:
    """Add three legs with wheels, hanging `drop` under z."""
    for px, y in ((0.0, y_nose), (x, y_main), (-x, y_main)):
        b.tube("metal", [(px, y, z + 0.3 * drop), (px, y, z - drop + radius)], 0.25 * radius, segments=4)
        b.cylinder(0, "tyre", (px, y, z - drop + radius), radius, 0.4 * radius, segments=10)


def _propeller(b: Builder, d: Draw, x: float, y: float, z: float, radius: float, blades: int) -> None:
    """Add spinner and blades in front of an engine whose nose is at y."""
    hub = 0.13 * radius
    b.loft(1, "body2", (y - 2.2 * hub, y - hub, y), (x, z), (0.1 * hub, 0.75 * hub, hub * 1.1), segments=8)
    turn = d(0, math.pi)
    for i in range(blades):
        a = turn + 2 * math.pi * i / blades
        u, v = math.cos(a), math.sin(a)
        w = 0.09 * radius
        plan = [(x - w * v, z + w * u), (x + w * v, z - w * u), (x + radius * u + 0.7 * w * v, z + radius * v - 0.7 * w * u),
                (x + radius * u - 0.7 * w * v, z + radius * v + 0.7 * w * u)]
        b.extrude(1, "propeller", plan, y - 1.1 * hub, y - 0.7 * hub)


def _jet(b: Builder, x: float, y: float, z: float, radius: float, length: float) -> None:
    """Add a nacelle: a pale lip and a dark fan in front, a narrower dark nozzle behind."""
    b.loft(1, ("metal", "body2", "body2", "dark_metal"), (y, y + 0.12 * length, y + 0.4 * length, y + 0.75 * length, y + length),
           (x, z), (0.9 * radius, radius, radius, 0.75 * radius, 0.4 * radius), segments=10, caps=("grille", "dark_metal"))


def _airliner(b: Builder, d: Draw, style: str) -> None:
    """Add an aircraft with a long barrel: jets under the wing, jets at the tail, or propellers on the wing."""
    length = {"airliner": d(28.0, 68.0), "business": d(12.0, 30.0), "turboprop": d(16.0, 32.0)}[style]
    slim = d(0.045, 0.06) if style != "business" else d(0.05, 0.062)
    if style == "turboprop":
        slim = d(0.05, 0.065)
    radius = slim * length
    _fuselage(b, d, length, radius, nose=d(0.09, 0.15), tail=d(0.22, 0.32), upsweep=d(0.35, 0.7))
    y0, y1 = -0.5 * length, 0.5 * length
    span = length * {"airliner": d(0.4, 0.54), "business": d(0.4, 0.5), "turboprop": d(0.46, 0.56)}[style]
    sweep = d(0.02, 0.1) if style == "turboprop" else d(0.4, 0.7) if style == "airliner" else d(0.3, 0.6)
    chord = span * d(0.26, 0.36)
    root = y0 + length * (d(0.34, 0.42) if style != "turboprop" else d(0.38, 0.44))
    high = style == "turboprop" and d.chance(0.7)
    z_wing = 0.95 * radius if high else -0.6 * radius
    dihedral = d(-0.03, 0.02) if high else d(0.06, 0.13)
    _wing(b, root, chord, span, sweep, d(0.2, 0.4), z_wing, dihedral, 0.13 * chord)
    if style == "airliner" and d.chance(0.5):
        tip = root + sweep * span
        h = d(0.1, 0.18) * radius * 6
        z = z_wing + dihedral * span
        b.pair("body2", (span - 0.004 * length, span), (tip + 0.05 * chord, tip + 0.25 * chord), (z, z + h))
    fin_c, fin_h = d(0.13, 0.17) * length, d(2.2, 3.2) * radius
    fin_y = y1 - fin_c - d(0.01, 0.04) * length
    tip = _fin(b, fin_y, fin_c, 0.5 * radius, fin_h, d(0.5, 0.85), d(0.3, 0.5), 0.012 * length)
    t_tail = style == "business" or (style == "turboprop" and d.chance(0.5)) or (style == "airliner" and d.chance(0.12))
    tail_span, tail_c = span * d(0.32, 0.42), fin_c * d(0.55, 0.75)
    if t_tail:
        _wing(b, tip, tail_c, tail_span, d(0.3, 0.6), 0.5, 0.5 * radius + fin_h, 0.0, 0.011 * length)
    else:
        _wing(b, fin_y + 0.3 * fin_c, tail_c, tail_span, d(0.4, 0.7), 0.45, 0.35 * radius, 0.1, 0.011 * length)
    if style == "turboprop":
        x = span * d(0.27, 0.36)
        engine = radius * d(0.32, 0.45)
        z = z_wing + dihedral * x - 0.3 * engine
        ye = root + sweep * x - d(0.06, 0.1) * length
        for sign in (-1.0, 1.0):
            b.loft(1, "body", (ye, ye + 0.1 * length, ye + 0.24 * length), (sign * x, z), (0.6 * engine, engine, 0.4 * engine), segments=8)
            _propeller(b, d, sign * x, ye, z, radius * d(1.0, 1.35), d.integer(4, 6))
    elif style == "business" or (style == "airliner" and t_tail):
        for sign in (-1.0, 1.0):
            _jet(b, sign * radius * 1.7, fin_y - d(0.08, 0.14) * length, 0.45 * radius, radius * d(0.42, 0.58), d(0.13, 0.17) * length)
            b.box("body", (min(0, sign * 1.5 * radius), max(0, sign * 1.5 * radius)), (fin_y - 0.04 * length, fin_y + 0.03 * length),
                  (0.36 * radius, 0.52 * radius))
    else:
        size = radius * d(0.48, 0.68)
        for share in (0.32,) if d.chance(0.75) else (0.27, 0.55):
            x = span * share * d(0.95, 1.05)
            ye = root + sweep * x - d(0.1, 0.16) * span * 0.7
            z = z_wing + dihedral * x - 0.06 * chord - 0.85 * size
            for sign in (-1.0, 1.0):
                _jet(b, sign * x, ye, z, size, 0.11 * length)
                b.box("body", (sign * x - 0.12 * size, sign * x + 0.12 * size), (ye + 0.35 * size, ye + 0.1 * length), (z + 0.6 * size, z + 1.4 * size))
    # A row of windows and a livery band along the barrel.
    proud = radius + 0.005 * length
    n = d.integer(5, 9)
    step = 0.52 * length / n
    for i in range(n):
        y = y0 + 0.16 * length + i * step
        b.pair("glass", (0.85 * radius, proud), (y, y + 0.7 * step), (0.12 * radius, 0.36 * radius), decal=True)
    if d.chance(0.6):
        b.loft(1, "body2", (y1 - 0.3 * length, y1 - 0.2 * length), (0, 0.02 * radius), (proud, proud * 0.96), segments=12, decal=True)
    if d.chance(0.5):
        _gear(b, y0 + 0.12 * length, root + 0.75 * chord, 1.2 * radius, -0.9 * radius, d(0.7, 1.0) * radius, 0.28 * radius)


def _light(b: Builder, d: Draw, style: str) -> None:
    """Add a single-engine propeller aircraft: high wing with struts, low wing with canopy, or biplane."""
    length = d(6.5, 9.5)
    y0, y1 = -0.5 * length, 0.5 * length
    radius = length * d(0.06, 0.075)
    cowl = y0 + 0.2 * length
    b.loft(1, ("body2", "body", "body", "body", "body"), (y0 + 0.04 * length, cowl, y0 + 0.34 * length, y0 + 0.5 * length, y0 + 0.7 * length, y1),
           [(0, 0), (0, 0.05 * radius), (0, 0.1 * radius), (0, 0.1 * radius), (0, 0.25 * radius), (0, 0.5 * radius)],
           [(0.62 * radius, 0.66 * radius), (0.85 * radius, 0.85 * radius), (radius, 0.95 * radius), (radius, 0.95 * radius),
            (0.6 * radius, 0.6 * radius), (0.16 * radius, 0.25 * radius)], exponent=3, segments=12, caps=("grille", "body"))
    _propeller(b, d, 0, y0 + 0.045 * length, 0, radius * d(1.5, 2.0), d.integer(2, 3))
    span, chord = length * d(0.56, 0.72), length * d(0.17, 0.22)
    root = y0 + length * d(0.27, 0.33)
    thick = 0.12 * chord
    if style == "highwing":
        top = 1.75 * radius
        cabin = [(root - 0.06 * length, 0.8 * radius), (root + 0.01 * length, top), (root + chord, top), (root + chord + 0.14 * length, 0.7 * radius)]
        b.side(("windscreen", "body", "glass", "body"), cabin, 0.9 * radius, caps="glass")
        _wing(b, root, chord, span, 0.0, d(0.7, 1.0), top + 0.4 * thick, d(0.0, 0.04), thick)
        b.tubes("metal", [(0.8 * radius, root + 0.3 * chord, -0.6 * radius), (0.55 * span, root + 0.35 * chord, top)], 0.012 * length, segments=4)
    else:
        canopy = (root + 0.05 * length, root + 0.12 * length, root + 0.22 * length, root + 0.34 * length)
        b.loft(1, ("windscreen", "glass", "glass"), canopy, (0, 0.9 * radius), [(0.5 * radius, 0.1 * radius), (0.7 * radius, 0.75 * radius),
               (0.68 * radius, 0.75 * radius), (0.3 * radius, 0.1 * radius)], segments=10)
        _wing(b, root, chord, span, d(0.0, 0.12), d(0.5, 0.9), -0.65 * radius, d(0.04, 0.1), thick)
        if style == "biplane":
            up = radius * d(2.0, 2.6)
            _wing(b, root - 0.25 * chord, chord, span * 1.05, 0.0, 0.95, up, 0.02, thick)
            for x in (0.25 * radius * 2, 0.6 * span):
                b.tubes("wood", [(x, root + 0.3 * chord, -0.5 * radius), (x, root + 0.2 * chord, up)], 0.008 * length, segments=4)
    fin_c = 0.13 * length
    fin_y = y1 - fin_c - 0.01 * length
    _fin(b, fin_y, fin_c, 0.4 * radius, d(1.5, 2.2) * radius, d(0.3, 0.7), d(0.4, 0.7), 0.02 * length)
    _wing(b, fin_y + 0.01 * length, 0.8 * fin_c, span * d(0.3, 0.38), d(0.05, 0.3), 0.7, 0.5 * radius, 0.0, 0.018 * length)
    drop, wheel = d(0.9, 1.3) * radius, 0.035 * length
    if style == "biplane" or d.chance(0.3):
        _gear(b, y1 - 0.06 * length, root + 0.05 * chord, 1.1 * radius, -0.6 * radius, drop, wheel)
    else:
        _gear(b, y0 + 0.14 * length, root + 0.6 * chord, 1.3 * radius, -0.6 * radius, drop, wheel)


def _fighter(b: Builder, d: Draw, style: str) -> None:
    """Add a jet fighter: pointed nose, canopy, delta or swept wing, one or two fins, nozzles behind."""
    length = d(12.0, 20.0)
    y0, y1 = -0.5 * length, 0.5 * length
    radius = length * d(0.05, 0.07)
    b.loft(1, ("body2", "body", "body", "body", "dark_metal"),
           (y0, y0 + 0.12 * length, y0 + 0.3 * length, y0 + 0.55 * length, y1 - 0.08 * length, y1), (0, 0),
           [(0.02 * radius, 0.02 * radius), (0.5 * radius, 0.5 * radius), (0.85 * radius, 0.85 * radius), (1.3 * radius, 0.95 * radius),
            (1.1 * radius, 0.85 * radius), (0.7 * radius, 0.6 * radius)], exponent=2.6, segments=12, caps=("body2", "grille"))
    b.loft(1, ("windscreen", "glass", "glass"), (y0 + 0.13 * length, y0 + 0.19 * length, y0 + 0.25 * length, y0 + 0.38 * length), (0, 0.6 * radius),
           [(0.2 * radius, 0.1 * radius), (0.45 * radius, 0.75 * radius), (0.48 * radius, 0.8 * radius), (0.2 * radius, 0.3 * radius)], segments=10)
    b.pair("grille", (0.8 * radius, 1.5 * radius), (y0 + 0.31 * length, y0 + 0.34 * length), (-0.6 * radius, 0.5 * radius))
    b.pair("body", (0.7 * radius, 1.55 * radius), (y0 + 0.335 * length, y1 - 0.12 * length), (-0.65 * radius, 0.55 * radius))
    delta = d.chance(0.5)
    root = y0 + length * (d(0.3, 0.4) if delta else d(0.42, 0.5))
    chord = length * (d(0.42, 0.5) if delta else d(0.25, 0.32))
    span = length * (d(0.28, 0.34) if delta else d(0.3, 0.38))
    _wing(b, root, chord, span, (chord * d(0.75, 0.92)) / span if delta else d(0.5, 0.9), d(0.06, 0.2) if delta else d(0.3, 0.45),
          0.0, d(-0.05, 0.03), 0.022 * length)
    fin_c = d(0.16, 0.2) * length
    fin_y, fin_h = y1 - fin_c - 0.06 * length, d(1.8, 2.6) * radius
    if d.chance(0.5):
        for sign in (-1.0, 1.0):
            lean = sign * 0.2
            x = sign * 1.1 * radius
            b.extrude(0, "body2", [(fin_y, 0.3 * radius), (fin_y + 0.7 * fin_h, fin_h), (fin_y + 0.7 * fin_h + 0.4 * fin_c, fin_h), (fin_y + fin_c, 0.3 * radius)],
                      (x - 0.008 * length, 0.0, lean), (x + 0.008 * length, 0.0, lean))
    else:
        _fin(b, fin_y, fin_c, 0.5 * radius, fin_h, d(0.6, 0.9), d(0.3, 0.45), 0.016 * length)
    if not delta or d.chance(0.3):
        _wing(b, fin_y + 0.35 * fin_c, 0.7 * fin_c, span * 0.42, d(0.5, 0.8), 0.4, 0.0, 0.0, 0.014 * length, root_x=0.8 * radius)
    elif d.chance(0.5):
        _wing(b, y0 + 0.24 * length, 0.1 * length, 0.13 * length, 0.6, 0.3, 0.3 * radius, 0.05, 0.014 * length, root_x=0.5 * radius)
