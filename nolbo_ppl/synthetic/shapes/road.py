"""Cars: sedan, hatchback, estate and sport utility, pickup, van. Lengths in metres, the front at -y."""

from __future__ import annotations

from nolbo_ppl.synthetic.shapes.shape_builder import Builder, Draw

PROUD = 0.028
"""How far lights and windows stand off the body (0.006 of a car's diagonal)."""


def car(b: Builder, d: Draw) -> int:
    """Add one car; returns its symmetry."""
    style = d.choice(sedan=0.28, coupe=0.1, hatchback=0.2, estate=0.08, suv=0.16, pickup=0.09, van=0.09)
    if style == "van":
        _van(b, d)
    else:
        _saloon(b, d, style)
    return 1


def _lamps(b: Builder, d: Draw, front: float, rear: float, half: float, z: float, rear_z: float, ground: float) -> None:
    """Add white headlamps, grille and plate in front; red lamps and plate behind."""
    lamp_w, lamp_h = d(0.2, 0.42), d(0.11, 0.2)
    top = z - 0.03
    b.pair("light_front", (half - lamp_w - 0.03, half - 0.03), (front - PROUD, front + 0.1), (top - lamp_h, top))
    grille_h = d(0.14, max(0.16, 0.45 * (z - ground)))
    grille_w = min(half - lamp_w - 0.08, d(0.3, 0.6))
    b.box("grille", (-grille_w, grille_w), (front - PROUD, front + 0.1), (top - grille_h, top - 0.01))
    b.box("trim", (-half - 0.02, half + 0.02), (front - 0.07, front + 0.25), (ground - 0.03, ground + d(0.12, 0.25)))
    b.box("plate", (-0.26, 0.26), (front - 0.105, front), (ground + 0.05, ground + 0.16), decal=True)
    tall = d.chance(0.4)
    red_w, red_h = (d(0.12, 0.2), d(0.3, 0.5)) if tall else (d(0.28, 0.5), d(0.13, 0.2))
    top = rear_z - 0.04
    b.pair("light_rear", (half - red_w - 0.01, half - 0.01), (rear - 0.1, rear + PROUD), (top - red_h, top))
    b.box("trim", (-half - 0.02, half + 0.02), (rear - 0.25, rear + 0.06), (ground - 0.03, ground + d(0.12, 0.3)))
    b.box("plate", (-0.26, 0.26), (rear - 0.05, rear + PROUD), (top - 0.26, top - 0.14), decal=True)


def _wheels(b: Builder, d: Draw, front: float, rear: float, half: float, radius: float) -> None:
    """Add four wheels that stand a little out of the body, under dark arches."""
    width, rim = d(0.2, 0.28), d(0.55, 0.75)
    for y in (front, rear):
        for sign in (-1.0, 1.0):
            b.wheel(sign * (half + 0.06), y, radius, width, rim=rim)


def _mirrors(b: Builder, y: float, z: float, half: float) -> None:
    b.pair("body", (half - 0.02, half + 0.16), (y, y + 0.1), (z, z + 0.14))


def _saloon(b: Builder, d: Draw, style: str) -> None:
    """Add a car of a bonnet, a glazed cabin and, by style, a boot, a tailgate or a bed."""
    length, width, height, ground, radius = {
        "sedan": (d(4.2, 5.2), d(1.7, 1.95), d(1.36, 1.52), d(0.2, 0.28), d(0.29, 0.36)),
        "coupe": (d(3.9, 4.8), d(1.75, 2.0), d(1.12, 1.34), d(0.15, 0.24), d(0.3, 0.37)),
        "hatchback": (d(3.3, 4.3), d(1.6, 1.82), d(1.42, 1.6), d(0.2, 0.28), d(0.27, 0.34)),
        "estate": (d(4.3, 5.0), d(1.7, 1.9), d(1.4, 1.55), d(0.2, 0.28), d(0.29, 0.35)),
        "suv": (d(4.0, 5.1), d(1.8, 2.05), d(1.6, 1.98), d(0.28, 0.45), d(0.34, 0.44)),
        "pickup": (d(4.8, 5.9), d(1.8, 2.05), d(1.65, 1.95), d(0.35, 0.5), d(0.36, 0.45)),
    }[style]
    half, front, rear = 0.5 * width, -0.5 * length, 0.5 * length
    belt = ground + (height - ground) * d(0.5, 0.6)
    nose = ground + (belt - ground) * d(0.62, 0.9)
    bonnet = (
        length
        * {
            "sedan": d(0.24, 0.3),
            "coupe": d(0.28, 0.4),
            "hatchback": d(0.16, 0.25),
            "estate": d(0.22, 0.28),
            "suv": d(0.2, 0.28),
            "pickup": d(0.22, 0.28),
        }[style]
    )
    cowl = front + bonnet
    rake = (height - belt) * (d(0.45, 0.8) if style == "suv" else d(0.9, 1.6))
    if style in ("sedan", "coupe"):
        foot = rear - length * (d(0.12, 0.2) if style == "sedan" else d(0.05, 0.12))
        back_rake = (height - belt) * d(1.0, 1.8)
    elif style == "pickup":
        foot, back_rake = front + length * d(0.5, 0.66), (height - belt) * d(0.05, 0.3)
    else:
        foot, back_rake = rear - d(0.02, 0.08), (height - belt) * d(0.15, 0.75)
    boot = belt - d(0.0, 0.08) if style in ("sedan", "coupe") else belt
    bed = style == "pickup"
    deck = ground + 0.45 * (belt - ground) if bed else boot
    lower = [
        (front, ground),
        (front, nose),
        (front + 0.25 * bonnet, nose + 0.5 * (belt - nose)),
        (cowl, belt),
        (foot, belt),
        (foot + 0.01, deck),
        (rear, deck),
        (rear, ground),
    ]
    b.side("body", lower, (half + 0.04 * belt, 0.0, -0.04))
    if bed:
        wall = d(0.07, 0.1)
        b.pair("body", (half - wall, half), (foot - 0.1, rear - 0.01), (deck - 0.05, belt))
        b.box("body", (-half + 0.01, half - 0.01), (rear - wall, rear), (deck - 0.05, belt - 0.01))
        b.box("trim", (-half + wall, half - wall), (foot, rear - wall), (deck - 0.05, deck + 0.03))
        if d.chance(0.3):
            b.box("trim", (-half + 0.01, half - 0.01), (foot, rear - 0.02), (belt - 0.04, belt + 0.05))
    roof_half, belt_half = half * d(0.72, 0.82), half * 0.93
    slope = (roof_half - belt_half) / (height - belt)
    glass = (belt_half - slope * belt, 0.0, slope)
    top_front, top_rear = cowl + rake, foot - back_rake
    crown = 0.5 * (top_front + top_rear)
    cabin = [
        (cowl, belt - 0.02),
        (top_front, height - 0.04),
        (crown, height),
        (top_rear, height - 0.05),
        (foot - 0.005, belt - 0.02),
    ]
    roof = "body2" if d.chance(0.15) else "body"
    b.side(("windscreen", roof, roof, "glass", "body"), cabin, glass, caps="glass")
    bar = 0.045

    def on_glass(y: float, z: float) -> tuple[float, float, float]:
        return (glass[0] + glass[2] * z, y, z)

    b.tubes(
        "body",
        [
            on_glass(cowl, belt),
            on_glass(top_front, height - 0.04),
            on_glass(crown, height - 0.01),
            on_glass(top_rear, height - 0.05),
            on_glass(foot, belt),
        ],
        bar,
        segments=5,
    )
    doors = 1 if style in ("coupe", "pickup") else 2
    for i in range(doors):
        y = cowl + rake * 0.7 + (foot - back_rake * 0.6 - cowl - rake * 0.7) * (i + 1) / (doors + 1)
        b.tubes("body", [on_glass(y, belt), on_glass(y + 0.05, height - 0.03)], bar, segments=5)
    _lamps(b, d, front, rear, half - 0.02, nose, belt if bed or style in ("hatchback", "estate", "suv") else boot, ground)
    overhang = length * d(0.15, 0.19)
    _wheels(b, d, front + overhang, rear - length * d(0.16, 0.22), half, radius)
    _mirrors(b, cowl + 0.35 * rake, belt + 0.02, half)
    if style in ("suv", "estate") and d.chance(0.6):
        b.tubes(
            "trim",
            [(roof_half * 0.9, top_front + 0.1, height + 0.05), (roof_half * 0.9, top_rear - 0.1, height + 0.04)],
            0.03,
            segments=4,
        )
    if style == "suv" and d.chance(0.35):
        b.cylinder(1, "tyre", (d(-0.2, 0.2), rear + 0.1, 0.5 * (ground + belt) + 0.1), radius * 0.95, 0.12, caps="trim")
    if style == "coupe" and d.chance(0.5):
        z = boot + d(0.12, 0.25)
        b.box("body", (-half * 0.85, half * 0.85), (rear - 0.3, rear - 0.02), (z, z + 0.05))
        b.pair("trim", (half * 0.5, half * 0.56), (rear - 0.22, rear - 0.1), (boot - 0.05, z + 0.01))


def _van(b: Builder, d: Draw) -> None:
    """Add a van: one box with a short bonnet; cargo (blind sides) or passenger (windows all along)."""
    length, width, height = d(4.4, 6.3), d(1.85, 2.1), d(1.85, 2.7)
    half, front, rear = 0.5 * width, -0.5 * length, 0.5 * length
    ground, radius = d(0.25, 0.35), d(0.3, 0.37)
    nose = ground + d(0.55, 0.75)
    cowl_y, cowl_z = front + d(0.5, 1.1), nose + d(0.15, 0.35)
    top_y = cowl_y + d(0.45, 1.0)
    taper = 0.05
    body = (half + taper * ground, 0.0, -taper)
    profile = [
        (front, ground),
        (front, nose),
        (cowl_y, cowl_z),
        (top_y, height - 0.06),
        (top_y + 0.4, height),
        (rear - 0.05, height),
        (rear, cowl_z),
        (rear, ground),
    ]
    b.side(("body", "body", "windscreen", "body", "body", "body", "body", "body"), profile, body, caps="body")
    proud = (body[0] + PROUD, 0.0, -taper)
    low, high = cowl_z + 0.05, min(cowl_z + d(0.55, 0.8), height - 0.15)
    slant = (top_y - cowl_y) * (high - cowl_z) / (height - cowl_z)
    door = top_y + d(0.5, 0.9)
    b.side("glass", [(cowl_y + 0.25, low), (cowl_y + slant + 0.2, high), (door, high), (door, low)], proud, decal=True)
    if d.chance(0.5):
        panes = d.integer(1, 3)
        span = (rear - 0.25 - door - 0.12) / panes
        for i in range(panes):
            y0 = door + 0.12 + i * span
            b.side("glass", [(y0, low), (y0, high), (y0 + span - 0.1, high), (y0 + span - 0.1, low)], proud, decal=True)
    else:
        b.side(
            "body2",
            [(door + 0.2, low - 0.35), (door + 0.2, low - 0.15), (rear - 0.1, low - 0.15), (rear - 0.1, low - 0.35)],
            proud,
            decal=True,
        )
    b.pair("glass", (0.05, half * 0.72), (rear - 0.2, rear + PROUD), (low + 0.1, high - 0.05), decal=True)
    b.box("trim", (-0.02, 0.02), (rear - 0.2, rear + PROUD), (ground + 0.1, height - 0.1), decal=True)
    _lamps(b, d, front, rear, half - 0.04, nose, cowl_z - 0.02, ground)
    _wheels(b, d, front + d(0.75, 1.0), rear - d(0.8, 1.2), half, radius)
    _mirrors(b, cowl_y + 0.3, low + 0.05, half - 0.02)
