"""Motorbikes: sport, naked, cruiser, tourer, enduro, scooter. Lengths in metres, the front wheel at -y."""

from __future__ import annotations

import math

from nolbo_ppl.synthetic.shapes.shape_builder import Builder, Draw


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
    b.tubes(
        "dark_metal",
        [(0, head[1] + 0.02, head_z), (0.16, head[1] + 0.03, bar_z), (w, head[1] + 0.03 + sweep, bar_z)],
        0.02,
        segments=5,
    )
    b.tubes(
        "trim",
        [(w - 0.13, head[1] + 0.02 + 0.7 * sweep, bar_z), (w + 0.01, head[1] + 0.035 + sweep, bar_z)],
        0.028,
        segments=5,
    )
    if style != "enduro":
        b.tubes(
            "dark_metal",
            [(w - 0.14, head[1] + 0.03, bar_z), (w - 0.08, head[1] - 0.02, bar_z + 0.14)],
            0.01,
            segments=4,
        )
        b.pair("trim", (w - 0.14, w - 0.02), (head[1] - 0.05, head[1]), (bar_z + 0.12, bar_z + 0.2))
    lamp = d(0.08, 0.11)
    lamp_z = head_z - d(0.02, 0.1)
    if style in ("naked", "cruiser", "scooter"):
        b.cylinder(1, ("trim"), (0, head[1] - 0.12, lamp_z), lamp, 0.09, caps=("light_front", "trim"), segments=12)
    for sign in (-1.0, 1.0):
        b.box(
            "display",
            (min(sign * 0.13, sign * 0.19), max(sign * 0.13, sign * 0.19)),
            (head[1] - 0.12, head[1] - 0.05),
            (lamp_z - 0.03, lamp_z + 0.02),
        )
    angles = [math.radians(40 + 110 * i / 5) for i in range(6)]
    fender = r_f + (0.12 if style == "enduro" else 0.025)
    b.tube("body", [(0, y_f + fender * math.cos(a), r_f + fender * math.sin(a)) for a in angles], t_f + 0.015, segments=6)
    return 1


def _bike_body(
    b: Builder,
    d: Draw,
    style: str,
    head: tuple[float, float, float],
    y_f: float,
    y_r: float,
    r_f: float,
    r_r: float,
    seat_z: float,
) -> None:
    """Add engine, frame, tank, seat, tail, exhaust and, by style, fairing, windscreen, cases."""
    y0 = y_f + r_f + d(0.12, 0.2)
    low = d(0.32, 0.4) if style == "enduro" else d(0.17, 0.25)
    y1 = min(y_r - r_r * 0.75, y0 + d(0.45, 0.6))
    b.extrude(
        0,
        "dark_metal",
        [(y0, low + 0.06), (y0 + 0.05, 0.56), (y1, 0.54), (y1, low + 0.08), (y1 - 0.1, low)],
        -0.16,
        0.16,
    )
    if style in ("cruiser", "naked"):
        for lean in (-0.12, 0.16):
            b.loft(
                2,
                "metal",
                (0.42, head[2] - 0.12),
                [(0, y0 + 0.22 + 0.2 * lean), (0, y0 + 0.22 + lean)],
                (0.11, 0.1),
                exponent=5,
                segments=8,
            )
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
    b.extrude(
        0,
        "saddle",
        [
            (seat_y, seat_z - 0.06),
            (seat_y, seat_z + 0.03),
            (middle - 0.04, seat_z + 0.01),
            (middle + 0.03, seat_z + step),
            (end, seat_z + step + 0.02),
            (end, seat_z - 0.02 + step * 0.4),
        ],
        -d(0.12, 0.17),
        d(0.12, 0.17),
    )
    tail_z = seat_z + step
    b.extrude(
        0,
        "body",
        [(middle, seat_z - 0.14), (middle, seat_z - 0.02), (end + 0.16, tail_z + 0.05), (end + 0.14, tail_z - 0.06)],
        -0.1,
        0.1,
    )
    b.box("light_rear", (-0.09, 0.09), (end + 0.1, end + 0.2), (tail_z - 0.06, tail_z + 0.03))
    b.extrude(
        0,
        "trim",
        [(end - 0.06, tail_z - 0.1), (end + 0.08, tail_z - 0.06), (end + 0.24, r_r + 0.24), (end + 0.17, r_r + 0.22)],
        -0.07,
        0.07,
    )
    side = -1.0 if d.chance(0.5) else 1.0
    for s in (side, -side) if d.chance(0.3) else (side,):
        up = d(0.1, 0.35) if style in ("sport", "enduro") else d(-0.04, 0.08)
        b.tube(
            "metal",
            [
                (s * 0.1, y0 + 0.02, 0.45),
                (s * 0.16, y0 + 0.05, low + 0.04),
                (s * 0.18, y1, low + 0.06),
                (s * 0.2, y_r + 0.22, low + 0.14 + up),
            ],
            [0.028, 0.03, 0.045, 0.06],
        )
    if style in ("sport", "tourer"):
        nose = head[1] - d(0.22, 0.32)
        top = head[2] + d(0.04, 0.12)
        width = d(0.2, 0.26) if style == "sport" else d(0.26, 0.34)
        slope = 0.35
        flare = (width + slope * nose * -0.6, slope * 0.6, 0.0)
        b.side(
            ("body", "windscreen", "trim", "trim", "body", "body"),
            [
                (nose, top - 0.16),
                (nose + 0.1, top),
                (head[1] + 0.08, top + d(0.12, 0.26)),
                (head[1] + 0.14, top - 0.12),
                (head[1] + 0.1, head[2] - 0.34),
                (nose + 0.14, head[2] - 0.3),
            ],
            (flare[0] * 0.75, flare[1] * 0.5, 0.0),
        )
        b.pair("light_front", (0.04, 0.15), (nose - 0.025, nose + 0.08), (top - 0.23, top - 0.13))
        b.side(
            "body2" if d.chance(0.5) else "body",
            [
                (head[1] - 0.02, head[2] - 0.3),
                (tank_y, head[2] - 0.26),
                (y1 + 0.1, low + 0.12),
                (y0 + 0.1, low - 0.02),
                (y0 - 0.02, low + 0.2),
            ],
            d(0.19, 0.24),
        )
    elif style == "enduro":
        b.box("body2", (-0.12, 0.12), (head[1] - 0.2, head[1] - 0.12), (head[2] - 0.16, head[2] + 0.14))
        b.box("light_front", (-0.07, 0.07), (head[1] - 0.225, head[1] - 0.15), (head[2] - 0.1, head[2] + 0.02))
    elif style == "cruiser" and d.chance(0.4):
        b.extrude(
            0,
            "windscreen",
            [
                (head[1] - 0.1, head[2]),
                (head[1] + 0.0, head[2] + 0.45),
                (head[1] + 0.03, head[2] + 0.45),
                (head[1] - 0.06, head[2]),
            ],
            -0.24,
            0.24,
        )
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
    b.extrude(
        0,
        "body",
        [(shield_y, foot), (head[1] - 0.1, head[2] + 0.08), (head[1] + 0.02, head[2] + 0.06), (shield_y + 0.12, foot)],
        -half,
        half,
    )
    seat_y = y_r - d(0.5, 0.62)
    b.box("trim", (-half, half), (shield_y, seat_y + 0.1), (foot - 0.08, foot))
    b.loft(
        1,
        "body",
        (seat_y, seat_y + 0.12, y_r + 0.12, y_r + 0.34),
        [(0, 0.5 * (foot + seat_z)), (0, 0.5 * (foot + seat_z)), (0, seat_z - 0.14), (0, seat_z - 0.1)],
        [(0.13, 0.5 * (seat_z - foot)), (half * 0.95, 0.5 * (seat_z - foot)), (half, 0.16), (0.1, 0.08)],
        exponent=3.5,
    )
    b.extrude(
        0,
        "saddle",
        [
            (seat_y - 0.04, seat_z - 0.03),
            (seat_y + 0.03, seat_z + 0.06),
            (y_r - 0.1, seat_z + 0.04),
            (y_r + 0.02, seat_z + d(0.08, 0.13)),
            (y_r + 0.26, seat_z + 0.08),
            (y_r + 0.26, seat_z - 0.03),
        ],
        -0.15,
        0.15,
    )
    b.box("light_rear", (-0.09, 0.09), (y_r + 0.2, y_r + 0.37), (seat_z - 0.13, seat_z - 0.04))
    b.box("trim", (-0.08, 0.08), (y_r + 0.2, y_r + 0.32), (r_r + 0.02, seat_z - 0.16))
    b.tube("metal", [(-0.15, y_r - 0.25, 0.24), (-0.17, y_r + 0.25, r_r + 0.08)], [0.04, 0.06])
    b.box("dark_metal", (-0.1, 0.1), (seat_y + 0.1, y_r), (0.16, foot + 0.05))
    if d.chance(0.5):
        top = head[2] + d(0.3, 0.5)
        b.extrude(
            0,
            "windscreen",
            [
                (head[1] - 0.1, head[2] + 0.05),
                (head[1] + 0.0, top),
                (head[1] + 0.03, top),
                (head[1] - 0.06, head[2] + 0.05),
            ],
            -half,
            half,
        )
    if d.chance(0.4):
        b.box("body2", (-0.19, 0.19), (y_r + 0.14, y_r + 0.46), (seat_z + 0.1, seat_z + d(0.32, 0.45)))
