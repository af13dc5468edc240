"""Bicycles: road, mountain, city, step-through, BMX, tandem. Lengths in metres, the front wheel at -y."""

from __future__ import annotations

import math

from nolbo_ppl.synthetic.shapes.shape_builder import Builder, Draw


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
        b.tube(
            "body",
            [
                (0, head_low[1], head_low[2] - 0.01),
                (0, 0.5 * (head_low[1] + bottom[1]), bottom[2] + 0.22),
                (0, bottom[1] + 0.06, bottom[2] + 0.25),
            ],
            tube,
        )
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
    b.tubes(
        fork,
        [
            (0.05, axle_f, wheel),
            (0.05, axle_f + 0.01 + 0.8 * offset, wheel + 0.35 * (head_low_z - wheel)),
            (0.045, head_low[1] - 0.02, head_low_z - 0.02),
            (0.0, head_low[1], head_low_z),
        ],
        [0.012, 0.016, 0.018, 0.02],
        segments=5,
    )
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
        b.tubes(
            "trim",
            [
                (0, y, z),
                (w, y, z),
                (w, y - 0.09, z - 0.01),
                (w, y - 0.1, z - 0.5 * drop),
                (w, y - 0.02, z - drop),
                (w, y + 0.05, z - drop),
            ],
            0.014,
            segments=5,
        )
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
    plan = [
        (-0.02, y - 0.15),
        (0.02, y - 0.15),
        (0.035, y),
        (half, y + 0.09),
        (half * 0.8, y + 0.14),
        (-half * 0.8, y + 0.14),
        (-half, y + 0.09),
        (-0.035, y),
    ]
    b.extrude(2, "saddle", plan, z - 0.035, z + 0.02)


def _crank(b: Builder, d: Draw, bottom: tuple[float, float, float]) -> None:
    """Add chain ring, cranks and pedals."""
    _, y, z = bottom
    b.cylinder(0, "dark_metal", (-0.05, y, z), d(0.085, 0.105), 0.008, segments=12)
    a, reach = d(-0.6, 0.6), 0.165
    for sign in (-1.0, 1.0):
        v, w = sign * reach * math.cos(a), sign * reach * math.sin(a)
        b.tube("metal", [(sign * 0.03, y, z), (sign * 0.08, y + v, z + w)], 0.012, segments=4)
        b.box(
            "trim",
            (min(sign * 0.08, sign * 0.17), max(sign * 0.08, sign * 0.17)),
            (y + v - 0.04, y + v + 0.04),
            (z + w - 0.012, z + w + 0.012),
        )


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
        b.extrude(
            0,
            "plastic",
            [(y - 0.13, stem[2] - h), (y - 0.17, stem[2]), (y + 0.1, stem[2]), (y + 0.08, stem[2] - h)],
            -w,
            w,
        )
    if d.chance(0.3):
        b.box("cushion", (-0.15, 0.15), (axle_r - 0.15, axle_r + 0.17), (z + 0.012, z + d(0.12, 0.28)))
