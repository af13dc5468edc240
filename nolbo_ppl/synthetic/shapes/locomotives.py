"""Hood and steam locomotives. Lengths in metres, the nose at -y."""

from __future__ import annotations

from nolbo_ppl.synthetic.shapes.rail_parts import PROUD, add_bogies
from nolbo_ppl.synthetic.shapes.shape_builder import Builder, Draw


def hood_locomotive(b: Builder, d: Draw, style: str) -> None:
    """Add a hood locomotive: short nose, cab in front, long narrow engine hood behind."""
    length, half, height = d(14.0, 21.0), d(1.4, 1.6), d(4.2, 4.7)
    y0, y1 = -0.5 * length, 0.5 * length
    floor = d(1.2, 1.45)
    b.box("dark_metal", (-half, half), (y0, y1), (floor - 0.35, floor))
    cab = y0 + d(1.4, 2.6)
    deep = d(2.0, 2.8)
    nose_h = floor + d(1.1, 1.7)
    b.side(
        "body2",
        [(y0 + 0.5, floor), (y0 + 0.5, nose_h - 0.2), (y0 + 0.8, nose_h), (cab + 0.1, nose_h), (cab + 0.1, floor)],
        half * d(0.5, 0.75),
    )
    sill = max(nose_h, floor + 1.2) + 0.05
    b.side(
        ("body", "windscreen", "body", "body", "body", "body"),
        [
            (cab, floor),
            (cab, sill),
            (cab + 0.3, height - 0.4),
            (cab + 0.35, height),
            (cab + deep, height),
            (cab + deep, floor),
        ],
        half * 0.97,
    )
    b.pair(
        "glass",
        (half * 0.97 - 0.1, half * 0.97 + PROUD),
        (cab + 0.6, cab + deep - 0.4),
        (sill + 0.1, height - 0.45),
        decal=True,
    )
    b.tube("body", [(0, cab, sill), (0, cab + 0.3, height - 0.4)], 0.12, segments=5)
    hood_top, hood_half = height - d(0.1, 0.6), half * d(0.58, 0.72)
    b.box("body", (-hood_half, hood_half), (cab + deep - 0.05, y1 - 0.7), (floor, hood_top))
    n = d.integer(3, 5)
    for i in range(n):
        y = cab + deep + 0.6 + i * (y1 - 1.6 - cab - deep) / n
        b.pair("grille", (hood_half - 0.1, hood_half + PROUD), (y, y + 1.0), (hood_top - 1.3, hood_top - 0.3), decal=True)
    b.box("body2", (-hood_half - 0.25, hood_half + 0.25), (y1 - 3.2, y1 - 1.6), (hood_top - 0.5, hood_top + 0.15))
    b.cylinder(2, "dark_metal", (0, 0.1 * length, hood_top + 0.15), 0.3, 0.3, segments=8)
    b.tubes(
        "label",
        [(half - 0.05, cab + deep, floor + 1.0), (half - 0.05, y1, floor + 1.0), (half * 0.3, y1, floor + 1.0)],
        0.05,
        segments=4,
    )
    b.pair("light_front", (0.1, 0.42), (y0 + 0.5 - PROUD, y0 + 0.7), (nose_h - 0.55, nose_h - 0.2))
    b.pair("light_front", (0.05, 0.3), (cab + 0.25, cab + 0.6), (height - 0.36, height - 0.1))
    b.side("trim", [(y0 - 0.4, 0.2), (y0, floor - 0.35), (y0 + 0.5, floor - 0.35), (y0 + 0.3, 0.2)], half * 0.85)
    b.pair("light_rear", (hood_half * 0.4, hood_half * 0.9), (y1 - 0.9, y1 - 0.6), (floor + 0.9, floor + 1.4))
    b.box(
        "grille",
        (-hood_half * 0.8, hood_half * 0.8),
        (y1 - 0.9, y1 - 0.7 + PROUD),
        (floor + 1.5, hood_top - 0.2),
        decal=True,
    )
    b.box("dark_metal", (-half * 0.7, half * 0.7), (-0.12 * length, 0.12 * length), (0.4, floor))
    add_bogies(b, d, y0 + d(2.4, 3.0), y1 - d(2.4, 3.0), half)


def steam_locomotive(b: Builder, d: Draw, style: str) -> None:
    """Add a steam locomotive: boiler with chimney and smoke-box door in front, cab and tender behind."""
    boiler_l, cab_l = d(4.5, 9.0), d(1.6, 2.4)
    tender_l = d(3.0, 6.5) if d.chance(0.75) else 0.0
    length = boiler_l + cab_l + tender_l
    y0 = -0.5 * length
    half, wheel = d(1.25, 1.5), d(0.55, 0.95)
    axis = wheel * 2 + d(0.35, 0.7)
    r = d(0.65, 0.95)
    frame = wheel * 1.2
    b.box("dark_metal", (-half * 0.75, half * 0.75), (y0, y0 + length), (frame, frame + 0.3))
    b.box("body2", (-half, half), (y0 - 0.35, y0 + 0.1), (frame - 0.1, frame + 0.45))
    smoke = y0 + d(1.0, 1.8)
    yc = y0 + boiler_l
    b.loft(
        1,
        ("dark_metal", "dark_metal", "body", "body"),
        (y0 + 0.15, y0 + 0.35, smoke, smoke + 0.01, yc + 0.1),
        (0, axis),
        (0.75 * r, r, r, 1.04 * r, 1.1 * r),
        segments=14,
        caps=("metal", "body"),
    )
    for i in range(d.integer(2, 4)):
        y = smoke + (yc - smoke) * (i + 0.5) / 4
        b.cylinder(1, "metal", (0, y, axis), 1.12 * r, 0.06, segments=14, decal=True)
    stack = d(0.5, 1.1)
    b.loft(
        2,
        "dark_metal",
        (axis + 0.8 * r, axis + r + stack, axis + r + stack + 0.15),
        (0, y0 + 0.75),
        (0.22, d(0.2, 0.36), d(0.28, 0.42)),
        segments=10,
        caps=("dark_metal", "grille"),
    )
    for share in (0.35, 0.65):
        b.loft(
            2,
            "metal" if d.chance(0.5) else "body",
            (axis + 0.8 * r, axis + r + 0.25, axis + r + 0.45),
            (0, smoke + (yc - smoke) * share),
            (0.32, 0.3, 0.1),
            segments=10,
        )
    b.cylinder(
        1,
        "light_front",
        (0, y0 + 0.05, axis + (0.0 if d.chance(0.3) else r)),
        0.24,
        0.25,
        segments=10,
        caps=("light_front", "dark_metal"),
    )
    b.pair("light_front", (half * 0.6, half * 0.85), (y0 - 0.5, y0), (frame + 0.45, frame + 0.8))
    top = axis + r + d(0.5, 0.8)
    b.side(
        ("windscreen", "body", "body", "trim"),
        [(yc, axis + 0.2 * r), (yc, top), (yc + cab_l, top), (yc + cab_l, axis + 0.2 * r)],
        half,
        caps="body",
    )
    b.box("body", (-half, half), (yc, yc + cab_l), (frame + 0.1, axis + 0.2 * r))
    b.pair("glass", (half - 0.1, half + PROUD), (yc + 0.35, yc + cab_l - 0.5), (top - 1.0, top - 0.3), decal=True)
    b.loft(
        2,
        "body2",
        (top, top + 0.25),
        (0, yc + 0.5 * cab_l + 0.1),
        [(half * 1.05, 0.62 * cab_l), (half * 0.7, 0.6 * cab_l)],
        exponent=8,
        segments=12,
    )
    n = d.integer(2, 4)
    pitch = min(2.15 * wheel, (boiler_l - 1.6) / max(n - 0.5, 1))
    drive = min(wheel, 0.48 * pitch)
    first = yc - 0.2 - (n - 1) * pitch
    for i in range(n):
        for sign in (-1.0, 1.0):
            b.cylinder(0, "body2", (sign * half * 0.82, first + i * pitch, drive), drive, 0.09, segments=14)
    b.pair("metal", (half * 0.9, half * 0.96), (first - 0.1, first + (n - 1) * pitch + 0.1), (drive - 0.1, drive + 0.08))
    for sign in (-1.0, 1.0):
        b.cylinder(1, "dark_metal", (sign * half * 0.85, y0 + 0.8, frame * 0.75), 0.32, 0.5, segments=8)
    b.side("trim", [(y0 - 0.9, 0.15), (y0 - 0.3, frame), (y0, frame), (y0, 0.15)], (half * 0.9 - 0.15 * y0, 0.15, 0.0))
    small = min(0.5, wheel * 0.6)
    for i in range(d.integer(1, 2)):
        for sign in (-1.0, 1.0):
            b.cylinder(0, "metal", (sign * half * 0.75, y0 + 0.5 + 1.1 * i, small), small, 0.08, segments=10)
    end = yc + cab_l
    if tender_l:
        t0, tank = end + 0.25, axis + d(0.1, 0.7) * r
        b.box("body", (-half, half), (t0, y0 + length), (frame + 0.1, tank))
        b.extrude(
            0,
            "grille",
            [
                (t0 + 0.2, tank - 0.05),
                (t0 + 0.6, tank + 0.45),
                (y0 + length - 1.0, tank + 0.3),
                (y0 + length - 0.4, tank - 0.05),
            ],
            -half * 0.85,
            half * 0.85,
        )
        for i in range(3):
            for sign in (-1.0, 1.0):
                b.cylinder(0, "metal", (sign * half * 0.75, t0 + tender_l * (0.15 + 0.3 * i), 0.48), 0.48, 0.08, segments=10)
    b.box("body2", (-half, half), (y0 + length - 0.1, y0 + length + 0.15), (frame - 0.1, frame + 0.35))
    b.pair("light_rear", (half * 0.6, half * 0.9), (y0 + length, y0 + length + 0.3), (frame + 0.35, frame + 0.8))
