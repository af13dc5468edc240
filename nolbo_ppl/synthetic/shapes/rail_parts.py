"""Parts of trains: bogies, the flat rear end, windows, roof gear. Lengths in metres, the nose at -y."""

from __future__ import annotations

from nolbo_ppl.synthetic.shapes.shape_builder import Builder, Draw

PROUD = 0.1
"""How far lights and windows stand off the body (0.004 to 0.006 of the diagonal)."""


def _bogie(b: Builder, y: float, half: float, radius: float, axles: int, pitch: float) -> None:
    """Add a dark frame with wheels."""
    reach = 0.5 * pitch * (axles - 1)
    b.box("dark_metal", (-half, half), (y - reach - radius, y + reach + radius), (0.5 * radius, 1.9 * radius))
    for i in range(axles):
        for sign in (-1.0, 1.0):
            b.cylinder(0, "metal", (sign * half, y - reach + i * pitch, radius), radius, 0.09, segments=10)


def add_bogies(b: Builder, d: Draw, front: float, rear: float, half: float) -> None:
    """Add two bogies of two or three axles."""
    radius, axles = d(0.42, 0.52), d.integer(2, 3)
    for y in (front, rear):
        _bogie(b, y, half * 0.85, radius, axles, d(1.5, 1.8) if axles == 3 else d(2.0, 2.6))


def add_rear(b: Builder, d: Draw, y: float, half: float, floor: float, height: float) -> None:
    """Add a flat end: dark gangway and frame, red lamps, coupler."""
    b.box("trim", (-half * 0.96, half * 0.96), (y - 0.4, y + PROUD), (floor, height - 0.35))
    b.box(
        "grille",
        (-half * 0.42, half * 0.42),
        (y - 0.3, y + d(0.2, 0.4)),
        (floor + 0.15, floor + 0.75 * (height - floor)),
    )
    b.pair("light_rear", (half * 0.62, half * 0.88), (y - 0.2, y + 2 * PROUD), (floor + 0.35, floor + d(0.7, 1.0)))
    b.box("dark_metal", (-0.15, 0.15), (y - 0.2, y + 0.6), (floor - 0.3, floor - 0.05))


def add_windows(b: Builder, d: Draw, half: float, y: tuple[float, float], z: tuple[float, float], doors: int) -> None:
    """Add a band of windows cut by doors in the second colour."""
    panes = d.integer(4, 8)
    pitch = (y[1] - y[0]) / panes
    for i in range(panes):
        y0 = y[0] + i * pitch
        b.pair("glass", (half - 0.1, half + PROUD), (y0 + 0.1 * pitch, y0 + 0.9 * pitch), z, decal=True)
    for i in range(doors):
        y0 = y[0] + (y[1] - y[0]) * (i + 0.5) / doors
        b.pair("body2", (half - 0.1, half + 1.6 * PROUD), (y0 - 0.55, y0 + 0.55), (0.95, z[1] + 0.12), decal=True)


def add_roof_gear(b: Builder, d: Draw, height: float, y: float, *, electric: bool) -> None:
    """Add a pantograph, or roof boxes."""
    if electric:
        z = height + d(0.7, 1.2)
        b.tubes(
            "dark_metal",
            [(0.5, y - 0.9, height), (0.4, y + 0.8, 0.55 * height + 0.45 * z), (0.4, y - 0.3, z)],
            0.06,
            segments=4,
        )
        b.box("dark_metal", (-0.9, 0.9), (y - 0.4, y - 0.2), (z, z + 0.1))
    else:
        b.box("grille", (-0.9, 0.9), (y - 1.2, y + 1.2), (height - 0.1, height + d(0.15, 0.35)))
