"""Trains: high-speed head, electric unit, diesel locomotive, hood locomotive, steam locomotive, tram.

Lengths in metres, the nose at -y. One vehicle, whose rear is a flat end with a dark gangway.
"""

from __future__ import annotations

from nolbo_ppl.data.shapes.builder import Builder, Draw

PROUD = 0.1
"""How far lights and windows stand off the body (0.004 to 0.006 of the diagonal)."""


def train(b: Builder, d: Draw) -> int:
    """Add one train head; returns its symmetry."""
    style = d.choice(express=0.24, unit=0.24, diesel=0.16, hood=0.12, steam=0.14, tram=0.1)
    {"express": _express, "unit": _unit, "diesel": _unit, "tram": _unit, "hood": _hood, "steam": _steam}[style](b, d, style)
    return 1


def _bogie(b: Builder, y: float, half: float, radius: float, axles: int, pitch: float) -> None:
    """Add a dark frame with wheels."""
    reach = 0.5 * pitch * (axles - 1)
    b.box("dark_metal", (-half, half), (y - reach - radius, y + reach + radius), (0.5 * radius, 1.9 * radius))
    for i in range(axles):
        for sign in (-1.0, 1.0):
            b.cylinder(0, "metal", (sign * half, y - reach + i * pitch, radius), radius, 0.09, segments=10)


def _rear(b: Builder, d: Draw, y: float, half: float, floor: float, height: float) -> None:
    """Add a flat end: dark gangway and frame, red lamps, coupler."""
    b.box("trim", (-half * 0.96, half * 0.96), (y - 0.4, y + PROUD), (floor, height - 0.35))
    b.box("grille", (-half * 0.42, half * 0.42), (y - 0.3, y + d(0.2, 0.4)), (floor + 0.15, floor + 0.75 * (height - floor)))
    b.pair("light_rear", (half * 0.62, half * 0.88), (y - 0.2, y + 2 * PROUD), (floor + 0.35, floor + d(0.7, 1.0)))
    b.box("dark_metal", (-0.15, 0.15), (y - 0.2, y + 0.6), (floor - 0.3, floor - 0.05))


def _windows(b: Builder, d: Draw, half: float, y: tuple[float, float], z: tuple[float, float], doors: int) -> None:
    """Add a band of windows cut by doors in the second colour."""
    panes = d.integer(4, 8)
    pitch = (y[1] - y[0]) / panes
    for i in range(panes):
        y0 = y[0] + i * pitch
        b.pair("glass", (half - 0.1, half + PROUD), (y0 + 0.1 * pitch, y0 + 0.9 * pitch), z, decal=True)
    for i in range(doors):
        y0 = y[0] + (y[1] - y[0]) * (i + 0.5) / doors
        b.pair("body2", (half - 0.1, half + 1.6 * PROUD), (y0 - 0.55, y0 + 0.55), (0.95, z[1] + 0.12), decal=True)


def _express(b: Builder, d: Draw, style: str) -> None:
    """Add a high-speed head: a long nose that falls in a curve, windscreen high on it."""
    length, half, height = d(17.0, 26.0), d(1.35, 1.6), d(3.5, 4.1)
    y0, y1 = -0.5 * length, 0.5 * length
    nose = d(3.0, 7.5)
    floor = 0.35
    blunt = d(0.16, 0.3)
    shares = (0.0, 0.08, 0.3, 0.62, 1.0)
    tops = (floor + blunt * height, floor + (blunt + 0.1) * height, floor + (0.42 + 0.15 * blunt) * height, 0.86 * height, height)
    widths = (0.35, 0.6, 0.85, 0.97, 1.0)
    stations = [y0 + s * nose for s in shares] + [y1]
    high = list(tops) + [height]
    wide = list(widths) + [1.0]
    b.loft(1, ("body2", "body2", "body", "body", "body"), stations, [(0.0, 0.5 * (z + floor)) for z in high],
           [(w * half, 0.5 * (z - floor)) for w, z in zip(wide, high)], exponent=4, segments=16, caps=("body2", "trim"))
    # The windscreen is a lens on the falling roof line.
    a, c = y0 + 0.34 * nose, y0 + 0.74 * nose
    za, zc = _between(stations, high, a), _between(stations, high, c)
    b.loft(1, "windscreen", (a, 0.5 * (a + c), c), [(0, za - 0.22), (0, 0.5 * (za + zc) - 0.12), (0, zc - 0.22)],
           [(0.5 * half, 0.25), (0.72 * half, 0.32), (0.66 * half, 0.25)], exponent=3, segments=10)
    lamp = y0 + 0.14 * nose
    zl = _between(stations, high, lamp)
    for sign in (-1.0, 1.0):
        b.ellipsoid("light_front", (sign * 0.5 * half, lamp, zl - 0.36), (0.2 * half, 0.1 * nose, 0.2), segments=8)
    b.pair("glass", (half - 0.1, half + PROUD), (y0 + 0.78 * nose, y0 + nose), (2.0, 2.7), decal=True)
    z = d(1.7, 1.9)
    if d.chance(0.75):
        _windows(b, d, half, (y0 + nose + 0.8, y1 - 1.2), (z, z + d(0.7, 0.95)), d.integer(1, 2))
    stripe = d(0.9, 1.3)
    b.pair("body2", (half - 0.1, half + 0.7 * PROUD), (y0 + nose, y1 - 0.3), (stripe, stripe + d(0.15, 0.4)), decal=True)
    _bogies(b, d, y0 + nose * 0.9 + 1.0, y1 - 2.8, half)
    _roof_gear(b, d, height, y1 - d(3.0, 8.0), electric=d.chance(0.6))
    _rear(b, d, y1, half, floor + 0.5, height)


def _between(y: list[float], z: list[float], at: float) -> float:
    for i in range(len(y) - 1):
        if y[i] <= at <= y[i + 1]:
            return z[i] + (z[i + 1] - z[i]) * (at - y[i]) / (y[i + 1] - y[i])
    return z[-1]


def _bogies(b: Builder, d: Draw, front: float, rear: float, half: float) -> None:
    radius, axles = d(0.42, 0.52), d.integer(2, 3)
    for y in (front, rear):
        _bogie(b, y, half * 0.85, radius, axles, d(1.5, 1.8) if axles == 3 else d(2.0, 2.6))


def _roof_gear(b: Builder, d: Draw, height: float, y: float, *, electric: bool) -> None:
    """Add a pantograph, or roof boxes."""
    if electric:
        z = height + d(0.7, 1.2)
        b.tubes("dark_metal", [(0.5, y - 0.9, height), (0.4, y + 0.8, 0.55 * height + 0.45 * z), (0.4, y - 0.3, z)], 0.06, segments=4)
        b.box("dark_metal", (-0.9, 0.9), (y - 0.4, y - 0.2), (z, z + 0.1))
    else:
        b.box("grille", (-0.9, 0.9), (y - 1.2, y + 1.2), (height - 0.1, height + d(0.15, 0.35)))


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
    profile = [(y0 + 0.15, floor), (y0, floor + 0.4), (y0, sill), (mid, top), (y0 + rake, height - 0.15), (y0 + rake + 0.5, height),
               (y1, height), (y1, floor)]
    b.side(("body2", "body2", "windscreen", "body2", "body", "body", "trim", "trim"), profile, half, caps="body")
    b.tubes("body2", [(half - 0.04, y0, sill), (half - 0.04, mid, top)], 0.13, segments=5)
    if style == "diesel" or d.chance(0.4):
        b.tube("body2", [(0, y0, sill), (0, mid, top)], 0.1, segments=5)
    panel = d(0.9, 2.2)
    b.extrude(0, "body2", [(y0 + 0.1, floor + 0.1), (y0 + 0.1, sill), (mid + 0.25, top - 0.05), (mid + panel, top - 0.05), (mid + panel * d(0.7, 1.3), floor + 0.1)],
              -half - 0.8 * PROUD, half + 0.8 * PROUD, decal=True)
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
        _windows(b, d, half, (mid + panel + 0.9, y1 - 0.7), (z, z + d(0.75, 1.1)), d.integer(1, 3))
    if style == "tram":
        b.pair("trim", (half - 0.3, half + 0.02), (y0 + 0.6, y1 - 0.3), (0.15, floor + 0.05))
    b.box("dark_metal", (-half * 0.8, half * 0.8), (-0.18 * length, 0.16 * length), (0.35, floor + 0.05))
    _bogies(b, d, y0 + d(2.2, 3.2), y1 - d(2.0, 3.0), half)
    _roof_gear(b, d, height, d(-0.1, 0.3) * length, electric=style in ("unit", "tram") and d.chance(0.7))
    _rear(b, d, y1, half, floor, height)


def _hood(b: Builder, d: Draw, style: str) -> None:
    """Add a hood locomotive: short nose, cab in front, long narrow engine hood behind."""
    length, half, height = d(14.0, 21.0), d(1.4, 1.6), d(4.2, 4.7)
    y0, y1 = -0.5 * length, 0.5 * length
    floor = d(1.2, 1.45)
    b.box("dark_metal", (-half, half), (y0, y1), (floor - 0.35, floor))
    cab = y0 + d(1.4, 2.6)
    deep = d(2.0, 2.8)
    nose_h = floor + d(1.1, 1.7)
    b.side("body2", [(y0 + 0.5, floor), (y0 + 0.5, nose_h - 0.2), (y0 + 0.8, nose_h), (cab + 0.1, nose_h), (cab + 0.1, floor)], half * d(0.5, 0.75))
    sill = max(nose_h, floor + 1.2) + 0.05
    b.side(("body", "windscreen", "body", "body", "body", "body"),
           [(cab, floor), (cab, sill), (cab + 0.3, height - 0.4), (cab + 0.35, height), (cab + deep, height), (cab + deep, floor)], half * 0.97)
    b.pair("glass", (half * 0.97 - 0.1, half * 0.97 + PROUD), (cab + 0.6, cab + deep - 0.4), (sill + 0.1, height - 0.45), decal=True)
    b.tube("body", [(0, cab, sill), (0, cab + 0.3, height - 0.4)], 0.12, segments=5)
    hood_top, hood_half = height - d(0.1, 0.6), half * d(0.58, 0.72)
    b.box("body", (-hood_half, hood_half), (cab + deep - 0.05, y1 - 0.7), (floor, hood_top))
    n = d.integer(3, 5)
    for i in range(n):
        y = cab + deep + 0.6 + i * (y1 - 1.6 - cab - deep) / n
        b.pair("grille", (hood_half - 0.1, hood_half + PROUD), (y, y + 1.0), (hood_top - 1.3, hood_top - 0.3), decal=True)
    b.box("body2", (-hood_half - 0.25, hood_half + 0.25), (y1 - 3.2, y1 - 1.6), (hood_top - 0.5, hood_top + 0.15))
    b.cylinder(2, "dark_metal", (0, 0.1 * length, hood_top + 0.15), 0.3, 0.3, segments=8)
    b.tubes("label", [(half - 0.05, cab + deep, floor + 1.0), (half - 0.05, y1, floor + 1.0), (half * 0.3, y1, floor + 1.0)], 0.05, segments=4)
    b.pair("light_front", (0.1, 0.42), (y0 + 0.5 - PROUD, y0 + 0.7), (nose_h - 0.55, nose_h - 0.2))
    b.pair("light_front", (0.05, 0.3), (cab + 0.25, cab + 0.6), (height - 0.36, height - 0.1))
    b.side("trim", [(y0 - 0.4, 0.2), (y0, floor - 0.35), (y0 + 0.5, floor - 0.35), (y0 + 0.3, 0.2)], half * 0.85)
    b.pair("light_rear", (hood_half * 0.4, hood_half * 0.9), (y1 - 0.9, y1 - 0.6), (floor + 0.9, floor + 1.4))
    b.box("grille", (-hood_half * 0.8, hood_half * 0.8), (y1 - 0.9, y1 - 0.7 + PROUD), (floor + 1.5, hood_top - 0.2), decal=True)
    b.box("dark_metal", (-half * 0.7, half * 0.7), (-0.12 * length, 0.12 * length), (0.4, floor))
    _bogies(b, d, y0 + d(2.4, 3.0), y1 - d(2.4, 3.0), half)


def _steam(b: Builder, d: Draw, style: str) -> None:
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
    b.loft(1, ("dark_metal", "dark_metal", "body", "body"), (y0 + 0.15, y0 + 0.35, smoke, smoke + 0.01, yc + 0.1), (0, axis),
           (0.75 * r, r, r, 1.04 * r, 1.1 * r), segments=14, caps=("metal", "body"))
    for i in range(d.integer(2, 4)):
        y = smoke + (yc - smoke) * (i + 0.5) / 4
        b.cylinder(1, "metal", (0, y, axis), 1.12 * r, 0.06, segments=14, decal=True)
    stack = d(0.5, 1.1)
    b.loft(2, "dark_metal", (axis + 0.8 * r, axis + r + stack, axis + r + stack + 0.15), (0, y0 + 0.75), (0.22, d(0.2, 0.36), d(0.28, 0.42)),
           segments=10, caps=("dark_metal", "grille"))
    for share in (0.35, 0.65):
        b.loft(2, "metal" if d.chance(0.5) else "body", (axis + 0.8 * r, axis + r + 0.25, axis + r + 0.45), (0, smoke + (yc - smoke) * share),
               (0.32, 0.3, 0.1), segments=10)
    b.cylinder(1, "light_front", (0, y0 + 0.05, axis + (0.0 if d.chance(0.3) else r)), 0.24, 0.25, segments=10, caps=("light_front", "dark_metal"))
    b.pair("light_front", (half * 0.6, half * 0.85), (y0 - 0.5, y0), (frame + 0.45, frame + 0.8))
    top = axis + r + d(0.5, 0.8)
    b.side(("windscreen", "body", "body", "trim"), [(yc, axis + 0.2 * r), (yc, top), (yc + cab_l, top), (yc + cab_l, axis + 0.2 * r)], half, caps="body")
    b.box("body", (-half, half), (yc, yc + cab_l), (frame + 0.1, axis + 0.2 * r))
    b.pair("glass", (half - 0.1, half + PROUD), (yc + 0.35, yc + cab_l - 0.5), (top - 1.0, top - 0.3), decal=True)
    b.loft(2, "body2", (top, top + 0.25), (0, yc + 0.5 * cab_l + 0.1), [(half * 1.05, 0.62 * cab_l), (half * 0.7, 0.6 * cab_l)], exponent=8, segments=12)
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
        b.extrude(0, "grille", [(t0 + 0.2, tank - 0.05), (t0 + 0.6, tank + 0.45), (y0 + length - 1.0, tank + 0.3), (y0 + length - 0.4, tank - 0.05)], -half * 0.85, half * 0.85)
        for i in range(3):
            for sign in (-1.0, 1.0):
                b.cylinder(0, "metal", (sign * half * 0.75, t0 + tender_l * (0.15 + 0.3 * i), 0.48), 0.48, 0.08, segments=10)
    b.box("body2", (-half, half), (y0 + length - 0.1, y0 + length + 0.15), (frame - 0.1, frame + 0.35))
    b.pair("light_rear", (half * 0.6, half * 0.9), (y0 + length, y0 + length + 0.3), (frame + 0.35, frame + 0.8))
