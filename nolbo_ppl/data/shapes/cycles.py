"""Bicycles and motorbikes. Lengths in metres, the front wheel at -y."""

from __future__ import annotations

import math

from nolbo_ppl.data.shapes.builder import Builder, Draw


def bicycle(b: Builder, d: Draw) -> int:
    """Add one bicycle (road, mountain, city, step-through, BMX, tandem); returns its symmetry."""
    style = d.choice(road=0.24, mountain=0.24, city=0.2, step=0.12, bmx=0.1, tandem=0.1)
    wheel = d(0.24, 0.27) if style == "bmx" else d(0.3, 0.37)
    tyre = d(0.028, 0.036) if style in ("mountain", "bmx") else d(0.014, 0.022)
    tube = d(0.018, 0.026)
    base = (d(0.9, 0.97) if style == "bmx" else d(0.98, 1.16)) + (d(0.6, 0.75) if style == "tandem" else 0.0)
    axle_f, axle_r = -0.5 * base, 0.5 * base
    seat_z = wheel + (d(0.16, 0.28) if style == "bmx" else d(0.42, 0.66))
    bottom = (0.0, axle_r - d(0.4, 0.45), wheel - d(0.02, 0.07))
    crossing = (0.0, bottom[1] + 0.22 * (seat_z - bottom[2]), bottom[2] + 0.75 * (seat_z - bottom[2]))
    saddle = (0.0, bottom[1] + 0.3 * (seat_z - bottom[2]), seat_z)
    tilt = d(0.25, 0.4)  # the fork leans back: metres backwards per metre up
    offset = d(0.03, 0.06)
    head_low_z = 2 * wheel + d(0.05, 0.14 if style == "mountain" else 0.08)
    head_low = (0.0, axle_f + offset + tilt * (head_low_z - wheel), head_low_z)
    head_h = d(0.1, 0.22)
    head_top = (0.0, head_low[1] + tilt * head_h, head_low_z + head_h)
    stem_h = d(0.02, 0.06) if style == "road" else d(0.06, 0.22)
    stem = (0.0, head_top[1] + tilt * stem_h, head_top[2] + stem_h)
    for y in (axle_f, axle_r):
        b.torus(0, "tyre", (0.0, y, wheel), wheel - tyre, tyre, segments=(18, 5))
        b.torus(0, "rim", (0.0, y, wheel), wheel - 2.4 * tyre, 0.012, segments=(18, 4))
        b.cylinder(0, "metal", (0.0, y, wheel), 0.03, 0.05, segments=6)
        for i in range(4):
            a = math.pi * i / 4 + 0.2
            v, w = (wheel - 2.2 * tyre) * math.cos(a), (wheel - 2.2 * tyre) * math.sin(a)
            b.tube("metal", [(0, y - v, wheel - w), (0, y + v, wheel + w)], 0.003, segments=3, decal=True)
    # Frame: down tube, seat tube, top tube (low on a step-through), stays, fork.
    b.tube("body", [bottom, head_low], tube)
    b.tube("body", [bottom, crossing], tube)
    if style == "step":
        b.tube("body", [(0, head_low[1], head_low[2] - 0.01), (0, 0.5 * (head_low[1] + bottom[1]), bottom[2] + 0.22),
                        (0, bottom[1] + 0.06, bottom[2] + 0.25)], tube)
    else:
        b.tube("body", [crossing, (0, head_top[1], head_top[2] - 0.03)], tube)
    if style == "tandem":
        middle = (0.0, bottom[1] - d(0.6, 0.68), bottom[2])
        rise = (0.0, middle[1] + 0.2 * (seat_z - bottom[2]), crossing[2])
        b.tube("body", [bottom, middle], tube).tube("body", [middle, rise], tube).tube("body", [middle, head_low], tube)
        _saddle(b, d, (0.0, rise[1] + 0.03, seat_z), rise, "sport")
        _crank(b, d, middle)
    b.tube("body", [head_low, head_top], tube * 1.25)
    b.tube("metal", [head_top, stem], 0.018)
    b.tubes("body", [(0.02, bottom[1], bottom[2]), (0.06, axle_r, wheel)], 0.012, segments=4)
    b.tubes("body", [(0.015, crossing[1], crossing[2]), (0.06, axle_r, wheel)], 0.011, segments=4)
    fork = "dark_metal" if style == "mountain" else "body2"
    b.tubes(fork, [(0.05, axle_f, wheel), (0.05, axle_f + 0.01 + 0.8 * offset, wheel + 0.35 * (head_low_z - wheel)),
                   (0.045, head_low[1] - 0.02, head_low_z - 0.02), (0.0, head_low[1], head_low_z)],
            [0.012, 0.016, 0.018, 0.02], segments=5)
    _bars(b, d, style, stem)
    _saddle(b, d, saddle, crossing, "city" if style in ("city", "step") else "sport")
    _crank(b, d, bottom)
    b.cylinder(0, "dark_metal", (-0.045, axle_r, wheel), d(0.04, 0.07), 0.012, segments=8)
    b.tube("dark_metal", [(-0.05, bottom[1], bottom[2] + 0.09), (-0.05, axle_r, wheel + 0.045)], 0.006, segments=3)
    b.tube("dark_metal", [(-0.05, bottom[1], bottom[2] - 0.09), (-0.05, axle_r, wheel - 0.045)], 0.006, segments=3)
    if style in ("city", "step") or d.chance(0.1):
        _city_gear(b, d, axle_f, axle_r, wheel, seat_z, stem)
    b.box("light_rear", (-0.03, 0.03), (saddle[1] + 0.05, saddle[1] + 0.11), (seat_z - 0.16, seat_z - 0.09))
    return 1


def _bars(b: Builder, d: Draw, style: str, stem: tuple[float, float, float]) -> None:
    """Add handlebar and grips: dropped, flat, or swept back."""
    x, y, z = stem
    reach = d(0.05, 0.11)
    b.tube("metal", [stem, (x, y - reach, z + 0.01)], 0.016, segments=5)
    w = d(0.2, 0.23) if style == "road" else d(0.26, 0.39)
    y -= reach
    if style == "road":
        drop = d(0.1, 0.15)
        b.tubes("trim", [(0, y, z), (w, y, z), (w, y - 0.09, z - 0.01), (w, y - 0.1, z - 0.5 * drop),
                         (w, y - 0.02, z - drop), (w, y + 0.05, z - drop)], 0.014, segments=5)
    elif style in ("city", "step"):
        b.tubes("metal", [(0, y, z), (0.7 * w, y - 0.05, z + 0.05), (w, y + 0.16, z + 0.04)], 0.013, segments=5)
        b.tubes("trim", [(0.9 * w, y + 0.08, z + 0.04), (w, y + 0.2, z + 0.04)], 0.02, segments=5)
    else:
        rise = d(0.15, 0.22) if style == "bmx" else d(0.0, 0.05)
        b.tubes("dark_metal", [(0, y, z), (0.35 * w, y, z + rise), (w, y + 0.04, z + rise + 0.01)], 0.013, segments=5)
        b.tubes("trim", [(0.75 * w, y + 0.03, z + rise + 0.007), (w, y + 0.04, z + rise + 0.01)], 0.02, segments=5)
    b.box("light_front", (-0.035, 0.035), (y - 0.09, y - 0.02), (z - 0.07, z), decal=style == "bmx")


def _saddle(b: Builder, d: Draw, at: tuple[float, float, float], post: tuple[float, float, float], kind: str) -> None:
    """Add seat post and saddle: a nose to the front, wide behind."""
    x, y, z = at
    b.tube("metal", [post, (x, y, z - 0.03)], 0.014, segments=5)
    half = d(0.09, 0.12) if kind == "city" else d(0.065, 0.08)
    plan = [(-0.02, y - 0.15), (0.02, y - 0.15), (0.035, y), (half, y + 0.09), (half * 0.8, y + 0.14),
            (-half * 0.8, y + 0.14), (-half, y + 0.09), (-0.035, y)]
    b.extrude(2, "saddle", plan, z - 0.035, z + 0.02)


def _crank(b: Builder, d: Draw, bottom: tuple[float, float, float]) -> None:
    """Add chain ring, cranks and pedals."""
    _, y, z = bottom
    b.cylinder(0, "dark_metal", (-0.05, y, z), d(0.085, 0.105), 0.008, segments=12)
    a, reach = d(-0.6, 0.6), 0.165
    for sign in (-1.0, 1.0):
        v, w = sign * reach * math.cos(a), sign * reach * math.sin(a)
        b.tube("metal", [(sign * 0.03, y, z), (sign * 0.08, y + v, z + w)], 0.012, segments=4)
        b.box("trim", (min(sign * 0.08, sign * 0.17), max(sign * 0.08, sign * 0.17)), (y + v - 0.04, y + v + 0.04),
              (z + w - 0.012, z + w + 0.012))


def _city_gear(
    b: Builder, d: Draw, axle_f: float, axle_r: float, wheel: float, seat_z: float, stem: tuple[float, float, float]
) -> None:
    """Add mudguards, a carrier behind, and sometimes a basket in front."""
    r = wheel + 0.03
    for y, first, last in ((axle_f, 35, 150), (axle_r, -10, 140)):
        angles = [math.radians(first + (last - first) * i / 6) for i in range(7)]
        b.tube("body", [(0, y + r * math.cos(a), wheel + r * math.sin(a)) for a in angles], 0.02, segments=4)
    z = 2 * wheel + 0.07
    b.box("dark_metal", (-0.07, 0.07), (axle_r - 0.18, axle_r + 0.2), (z - 0.012, z + 0.012))
    b.tubes("dark_metal", [(0.07, axle_r + 0.1, z), (0.06, axle_r, wheel)], 0.008, segments=3)
    if d.chance(0.5):
        y, w, h = stem[1] - 0.14, d(0.14, 0.19), d(0.16, 0.24)
        b.extrude(0, "plastic", [(y - 0.13, stem[2] - h), (y - 0.17, stem[2]), (y + 0.1, stem[2]), (y + 0.08, stem[2] - h)],
                  -w, w)
    if d.chance(0.3):
        b.box("cushion", (-0.15, 0.15), (axle_r - 0.15, axle_r + 0.17), (z + 0.012, z + d(0.12, 0.28)))


def motorbike(b: Builder, d: Draw) -> int:
    """Add one motorbike (sport, naked, cruiser, tourer, enduro, scooter); returns its symmetry."""
    style = d.choice(sport=0.2, naked=0.2, cruiser=0.2, tourer=0.12, enduro=0.13, scooter=0.15)
    scooter = style == "scooter"
    r_f = d(0.22, 0.27) if scooter else d(0.33, 0.37) if style == "enduro" else d(0.29, 0.33)
    r_r = r_f if scooter else r_f * d(0.88, 1.0)
    t_f = d(0.05, 0.06) if scooter else d(0.04, 0.055) if style == "enduro" else d(0.055, 0.07)
    t_r = t_f * d(1.05, 1.5)
    base = {"scooter": d(1.2, 1.35), "cruiser": d(1.55, 1.85), "tourer": d(1.5, 1.65)}.get(style, d(1.35, 1.5))
    y_f, y_r = -0.5 * base, 0.5 * base
    for y, r, t in ((y_f, r_f, t_f), (y_r, r_r, t_r)):
        b.torus(0, "tyre", (0, y, r), r - t, t, segments=(18, 6))
        b.cylinder(0, "rim", (0, y, r), r - 1.6 * t, 0.35 * t, segments=12)
        b.cylinder(0, "dark_metal", (0, y, r), 0.06, 0.08, segments=8)
    tilt = {"cruiser": d(0.55, 0.8), "scooter": d(0.4, 0.5)}.get(style, d(0.4, 0.52))
    head_z = {"scooter": d(0.78, 0.9), "enduro": d(0.9, 1.02), "cruiser": d(0.76, 0.86)}.get(style, d(0.8, 0.9))
    head = (0.0, y_f + tilt * (head_z - r_f), head_z)
    b.tubes("metal", [(0.1, y_f, r_f), (0.1, head[1], head_z)], d(0.026, 0.034), segments=6)
    seat_z = {"cruiser": d(0.62, 0.72), "enduro": d(0.86, 0.95), "scooter": d(0.72, 0.8)}.get(style, d(0.74, 0.84))
    if scooter:
        _scooter_body(b, d, head, y_f, y_r, r_r, seat_z)
    else:
        _bike_body(b, d, style, head, y_f, y_r, r_f, r_r, seat_z)
    # Handlebar with grips, mirrors, headlamp.
    w = {"cruiser": d(0.38, 0.46), "sport": d(0.3, 0.34)}.get(style, d(0.34, 0.42))
    rise = {"cruiser": d(0.1, 0.4), "sport": d(-0.03, 0.03)}.get(style, d(0.08, 0.16))
    sweep = d(0.12, 0.25) if style == "cruiser" else d(0.04, 0.1)
    bar_z = head_z + rise
    b.tubes("dark_metal", [(0, head[1] + 0.02, head_z), (0.16, head[1] + 0.03, bar_z), (w, head[1] + 0.03 + sweep, bar_z)],
            0.02, segments=5)
    b.tubes("trim", [(w - 0.13, head[1] + 0.02 + 0.7 * sweep, bar_z), (w + 0.01, head[1] + 0.035 + sweep, bar_z)], 0.028,
            segments=5)
    if style != "enduro":
        b.tubes("dark_metal", [(w - 0.14, head[1] + 0.03, bar_z), (w - 0.08, head[1] - 0.02, bar_z + 0.14)], 0.01, segments=4)
        b.pair("trim", (w - 0.14, w - 0.02), (head[1] - 0.05, head[1]), (bar_z + 0.12, bar_z + 0.2))
    lamp = d(0.08, 0.11)
    lamp_z = head_z - d(0.02, 0.1)
    if style in ("naked", "cruiser", "scooter"):
        b.cylinder(1, ("trim"), (0, head[1] - 0.12, lamp_z), lamp, 0.09, caps=("light_front", "trim"), segments=12)
    for sign in (-1.0, 1.0):
        b.box("display", (min(sign * 0.13, sign * 0.19), max(sign * 0.13, sign * 0.19)), (head[1] - 0.12, head[1] - 0.05),
              (lamp_z - 0.03, lamp_z + 0.02))
    angles = [math.radians(40 + 110 * i / 5) for i in range(6)]
    fender = r_f + (0.12 if style == "enduro" else 0.025)
    b.tube("body", [(0, y_f + fender * math.cos(a), r_f + fender * math.sin(a)) for a in angles], t_f + 0.015, segments=6)
    return 1


def _bike_body(
    b: Builder, d: Draw, style: str, head: tuple[float, float, float], y_f: float, y_r: float, r_f: float, r_r: float,
    seat_z: float,
) -> None:
    """Add engine, frame, tank, seat, tail, exhaust and, by style, fairing, windscreen, cases."""
    y0 = y_f + r_f + d(0.12, 0.2)
    low = d(0.32, 0.4) if style == "enduro" else d(0.17, 0.25)
    y1 = min(y_r - r_r * 0.75, y0 + d(0.45, 0.6))
    b.extrude(0, "dark_metal", [(y0, low + 0.06), (y0 + 0.05, 0.56), (y1, 0.54), (y1, low + 0.08), (y1 - 0.1, low)], -0.16, 0.16)
    if style in ("cruiser", "naked"):
        for lean in (-0.12, 0.16):
            b.loft(2, "metal", (0.42, head[2] - 0.12), [(0, y0 + 0.22 + 0.2 * lean), (0, y0 + 0.22 + lean)], (0.11, 0.1),
                   exponent=5, segments=8)
    b.tube("body", [(0, head[1], head[2] - 0.02), (0, y1, seat_z - 0.12), (0, y_r - 0.05, seat_z - 0.06)], 0.045)
    b.tubes("dark_metal", [(0.11, y1 - 0.05, 0.4), (0.12, y_r, r_r)], 0.032, segments=5)
    b.tubes("metal", [(0.12, y_r - 0.1, seat_z - 0.08), (0.12, y_r - 0.02, r_r + 0.03)], 0.022, segments=5)
    tank = d(0.24, 0.3)
    tank_y = head[1] + 0.06 + tank
    tank_z = max(seat_z, head[2] - 0.12) + d(0.02, 0.08)
    b.ellipsoid("body", (0, tank_y, tank_z), (d(0.13, 0.19), tank, d(0.12, 0.16)), exponent=3)
    seat_y = tank_y + tank * 0.6
    step = d(0.06, 0.14) if style in ("sport", "cruiser") else d(0.0, 0.05)
    long = d(0.62, 0.75) if style in ("tourer", "enduro", "naked") else d(0.45, 0.6)
    end = min(seat_y + long, y_r + 0.28)
    middle = 0.5 * (seat_y + end)
    b.extrude(0, "saddle", [(seat_y, seat_z - 0.06), (seat_y, seat_z + 0.03), (middle - 0.04, seat_z + 0.01),
                            (middle + 0.03, seat_z + step), (end, seat_z + step + 0.02), (end, seat_z - 0.02 + step * 0.4)],
              -d(0.12, 0.17), d(0.12, 0.17))
    tail_z = seat_z + step
    b.extrude(0, "body", [(middle, seat_z - 0.14), (middle, seat_z - 0.02), (end + 0.16, tail_z + 0.05), (end + 0.14, tail_z - 0.06)],
              -0.1, 0.1)
    b.box("light_rear", (-0.09, 0.09), (end + 0.1, end + 0.2), (tail_z - 0.06, tail_z + 0.03))
    b.extrude(0, "trim", [(end - 0.06, tail_z - 0.1), (end + 0.08, tail_z - 0.06), (end + 0.24, r_r + 0.24), (end + 0.17, r_r + 0.22)],
              -0.07, 0.07)
    side = -1.0 if d.chance(0.5) else 1.0
    for s in (side, -side) if d.chance(0.3) else (side,):
        up = d(0.1, 0.35) if style in ("sport", "enduro") else d(-0.04, 0.08)
        b.tube("metal", [(s * 0.1, y0 + 0.02, 0.45), (s * 0.16, y0 + 0.05, low + 0.04), (s * 0.18, y1, low + 0.06),
                         (s * 0.2, y_r + 0.22, low + 0.14 + up)], [0.028, 0.03, 0.045, 0.06])
    if style in ("sport", "tourer"):
        nose = head[1] - d(0.22, 0.32)
        top = head[2] + d(0.04, 0.12)
        width = d(0.2, 0.26) if style == "sport" else d(0.26, 0.34)
        slope = 0.35
        flare = (width + slope * nose * -0.6, slope * 0.6, 0.0)
        b.side(("body", "windscreen", "trim", "trim", "body", "body"),
               [(nose, top - 0.16), (nose + 0.1, top), (head[1] + 0.08, top + d(0.12, 0.26)), (head[1] + 0.14, top - 0.12),
                (head[1] + 0.1, head[2] - 0.34), (nose + 0.14, head[2] - 0.3)], (flare[0] * 0.75, flare[1] * 0.5, 0.0))
        b.pair("light_front", (0.04, 0.15), (nose - 0.025, nose + 0.08), (top - 0.23, top - 0.13))
        b.side("body2" if d.chance(0.5) else "body", [(head[1] - 0.02, head[2] - 0.3), (tank_y, head[2] - 0.26), (y1 + 0.1, low + 0.12),
                                                       (y0 + 0.1, low - 0.02), (y0 - 0.02, low + 0.2)], d(0.19, 0.24))
    elif style == "enduro":
        b.box("body2", (-0.12, 0.12), (head[1] - 0.2, head[1] - 0.12), (head[2] - 0.16, head[2] + 0.14))
        b.box("light_front", (-0.07, 0.07), (head[1] - 0.225, head[1] - 0.15), (head[2] - 0.1, head[2] + 0.02))
    elif style == "cruiser" and d.chance(0.4):
        b.extrude(0, "windscreen", [(head[1] - 0.1, head[2]), (head[1] + 0.0, head[2] + 0.45), (head[1] + 0.03, head[2] + 0.45),
                                    (head[1] - 0.06, head[2])], -0.24, 0.24)
    if style in ("tourer", "cruiser") and d.chance(0.7 if style == "tourer" else 0.4):
        b.pair("trim", (0.16, d(0.32, 0.4)), (y_r - 0.22, y_r + 0.28), (r_r + 0.02, r_r + d(0.3, 0.4)))
    if style == "tourer" and d.chance(0.6):
        b.box("body", (-0.2, 0.2), (end - 0.05, end + 0.3), (tail_z + 0.05, tail_z + d(0.25, 0.4)))


def _scooter_body(
    b: Builder, d: Draw, head: tuple[float, float, float], y_f: float, y_r: float, r_r: float, seat_z: float
) -> None:
    """Add leg shield, foot board, and the fat tail under a bench."""
    half = d(0.19, 0.25)
    foot = d(0.26, 0.34)
    shield_y = y_f + d(0.28, 0.36)
    b.extrude(0, "body", [(shield_y, foot), (head[1] - 0.1, head[2] + 0.08), (head[1] + 0.02, head[2] + 0.06), (shield_y + 0.12, foot)],
              -half, half)
    seat_y = y_r - d(0.5, 0.62)
    b.box("trim", (-half, half), (shield_y, seat_y + 0.1), (foot - 0.08, foot))
    b.loft(1, "body", (seat_y, seat_y + 0.12, y_r + 0.12, y_r + 0.34), [(0, 0.5 * (foot + seat_z)), (0, 0.5 * (foot + seat_z)),
           (0, seat_z - 0.14), (0, seat_z - 0.1)], [(0.13, 0.5 * (seat_z - foot)), (half * 0.95, 0.5 * (seat_z - foot)),
           (half, 0.16), (0.1, 0.08)], exponent=3.5)
    b.extrude(0, "saddle", [(seat_y - 0.04, seat_z - 0.03), (seat_y + 0.03, seat_z + 0.06), (y_r - 0.1, seat_z + 0.04),
                            (y_r + 0.02, seat_z + d(0.08, 0.13)), (y_r + 0.26, seat_z + 0.08), (y_r + 0.26, seat_z - 0.03)], -0.15, 0.15)
    b.box("light_rear", (-0.09, 0.09), (y_r + 0.2, y_r + 0.37), (seat_z - 0.13, seat_z - 0.04))
    b.box("trim", (-0.08, 0.08), (y_r + 0.2, y_r + 0.32), (r_r + 0.02, seat_z - 0.16))
    b.tube("metal", [(-0.15, y_r - 0.25, 0.24), (-0.17, y_r + 0.25, r_r + 0.08)], [0.04, 0.06])
    b.box("dark_metal", (-0.1, 0.1), (seat_y + 0.1, y_r), (0.16, foot + 0.05))
    if d.chance(0.5):
        top = head[2] + d(0.3, 0.5)
        b.extrude(0, "windscreen", [(head[1] - 0.1, head[2] + 0.05), (head[1] + 0.0, top), (head[1] + 0.03, top),
                                    (head[1] - 0.06, head[2] + 0.05)], -half, half)
    if d.chance(0.4):
        b.box("body2", (-0.19, 0.19), (y_r + 0.14, y_r + 0.46), (seat_z + 0.1, seat_z + d(0.32, 0.45)))
