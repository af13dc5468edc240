"""Aeroplanes with a long barrel: airliner, business jet, turboprop. Lengths in metres, the nose at -y."""

from __future__ import annotations

from nolbo_ppl.synthetic.shapes.air_parts import add_fin, add_fuselage, add_gear, add_jet, add_propeller, add_wing
from nolbo_ppl.synthetic.shapes.shape_builder import Builder, Draw


def airliner(b: Builder, d: Draw, style: str) -> None:
    """Add an aircraft with a long barrel: jets under the wing, jets at the tail, or propellers on the wing."""
    length = {"airliner": d(28.0, 68.0), "business": d(12.0, 30.0), "turboprop": d(16.0, 32.0)}[style]
    slim = d(0.045, 0.06) if style != "business" else d(0.05, 0.062)
    if style == "turboprop":
        slim = d(0.05, 0.065)
    radius = slim * length
    add_fuselage(b, d, length, radius, nose=d(0.09, 0.15), tail=d(0.22, 0.32), upsweep=d(0.35, 0.7))
    y0, y1 = -0.5 * length, 0.5 * length
    span = length * {"airliner": d(0.4, 0.54), "business": d(0.4, 0.5), "turboprop": d(0.46, 0.56)}[style]
    sweep = d(0.02, 0.1) if style == "turboprop" else d(0.4, 0.7) if style == "airliner" else d(0.3, 0.6)
    chord = span * d(0.26, 0.36)
    root = y0 + length * (d(0.34, 0.42) if style != "turboprop" else d(0.38, 0.44))
    high = style == "turboprop" and d.chance(0.7)
    z_wing = 0.95 * radius if high else -0.6 * radius
    dihedral = d(-0.03, 0.02) if high else d(0.06, 0.13)
    add_wing(b, root, chord, span, sweep, d(0.2, 0.4), z_wing, dihedral, 0.13 * chord)
    if style == "airliner" and d.chance(0.5):
        tip = root + sweep * span
        h = d(0.1, 0.18) * radius * 6
        z = z_wing + dihedral * span
        b.pair("body2", (span - 0.004 * length, span), (tip + 0.05 * chord, tip + 0.25 * chord), (z, z + h))
    fin_c, fin_h = d(0.13, 0.17) * length, d(2.2, 3.2) * radius
    fin_y = y1 - fin_c - d(0.01, 0.04) * length
    tip = add_fin(b, fin_y, fin_c, 0.5 * radius, fin_h, d(0.5, 0.85), d(0.3, 0.5), 0.012 * length)
    t_tail = style == "business" or (style == "turboprop" and d.chance(0.5)) or (style == "airliner" and d.chance(0.12))
    tail_span, tail_c = span * d(0.32, 0.42), fin_c * d(0.55, 0.75)
    if t_tail:
        add_wing(b, tip, tail_c, tail_span, d(0.3, 0.6), 0.5, 0.5 * radius + fin_h, 0.0, 0.011 * length)
    else:
        add_wing(b, fin_y + 0.3 * fin_c, tail_c, tail_span, d(0.4, 0.7), 0.45, 0.35 * radius, 0.1, 0.011 * length)
    if style == "turboprop":
        x = span * d(0.27, 0.36)
        engine = radius * d(0.32, 0.45)
        z = z_wing + dihedral * x - 0.3 * engine
        ye = root + sweep * x - d(0.06, 0.1) * length
        for sign in (-1.0, 1.0):
            b.loft(
                1,
                "body",
                (ye, ye + 0.1 * length, ye + 0.24 * length),
                (sign * x, z),
                (0.6 * engine, engine, 0.4 * engine),
                segments=8,
            )
            add_propeller(b, d, sign * x, ye, z, radius * d(1.0, 1.35), d.integer(4, 6))
    elif style == "business" or (style == "airliner" and t_tail):
        for sign in (-1.0, 1.0):
            add_jet(
                b,
                sign * radius * 1.7,
                fin_y - d(0.08, 0.14) * length,
                0.45 * radius,
                radius * d(0.42, 0.58),
                d(0.13, 0.17) * length,
            )
            b.box(
                "body",
                (min(0, sign * 1.5 * radius), max(0, sign * 1.5 * radius)),
                (fin_y - 0.04 * length, fin_y + 0.03 * length),
                (0.36 * radius, 0.52 * radius),
            )
    else:
        size = radius * d(0.48, 0.68)
        for share in (0.32,) if d.chance(0.75) else (0.27, 0.55):
            x = span * share * d(0.95, 1.05)
            ye = root + sweep * x - d(0.1, 0.16) * span * 0.7
            z = z_wing + dihedral * x - 0.06 * chord - 0.85 * size
            for sign in (-1.0, 1.0):
                add_jet(b, sign * x, ye, z, size, 0.11 * length)
                b.box(
                    "body",
                    (sign * x - 0.12 * size, sign * x + 0.12 * size),
                    (ye + 0.35 * size, ye + 0.1 * length),
                    (z + 0.6 * size, z + 1.4 * size),
                )
    # A row of windows and a livery band along the barrel.
    proud = radius + 0.005 * length
    n = d.integer(5, 9)
    step = 0.52 * length / n
    for i in range(n):
        y = y0 + 0.16 * length + i * step
        b.pair("glass", (0.85 * radius, proud), (y, y + 0.7 * step), (0.12 * radius, 0.36 * radius), decal=True)
    if d.chance(0.6):
        b.loft(
            1,
            "body2",
            (y1 - 0.3 * length, y1 - 0.2 * length),
            (0, 0.02 * radius),
            (proud, proud * 0.96),
            segments=12,
            decal=True,
        )
    if d.chance(0.5):
        add_gear(b, y0 + 0.12 * length, root + 0.75 * chord, 1.2 * radius, -0.9 * radius, d(0.7, 1.0) * radius, 0.28 * radius)
