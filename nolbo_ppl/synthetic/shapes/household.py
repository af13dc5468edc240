"""Bottles, and televisions with monitors. Lengths in metres, the screen to -y."""

from __future__ import annotations

import numpy as np

from nolbo_ppl.synthetic.shapes.shape_builder import Builder, Draw


def bottle(b: Builder, d: Draw) -> int:
    """Add one bottle (wine, beer, water, spirits, sauce, jug); returns its symmetry: 0, or 4 for a square section."""
    style = d.choice(bordeaux=0.18, burgundy=0.12, beer=0.16, water=0.2, flask=0.12, sauce=0.12, jug=0.1)
    height, radius, shoulder, neck, neck_h = {
        "bordeaux": (d(0.26, 0.36), d(0.03, 0.048), d(0.06, 0.16), d(0.012, 0.018), d(0.16, 0.32)),
        "burgundy": (d(0.26, 0.34), d(0.036, 0.056), d(0.24, 0.4), d(0.012, 0.018), d(0.1, 0.22)),
        "beer": (d(0.17, 0.3), d(0.026, 0.042), d(0.1, 0.28), d(0.01, 0.016), d(0.1, 0.28)),
        "water": (d(0.18, 0.38), d(0.026, 0.058), d(0.08, 0.26), d(0.011, 0.02), d(0.03, 0.1)),
        "flask": (d(0.14, 0.32), d(0.032, 0.065), d(0.02, 0.12), d(0.012, 0.022), d(0.05, 0.24)),
        "sauce": (d(0.14, 0.28), d(0.02, 0.04), d(0.08, 0.26), d(0.009, 0.015), d(0.05, 0.22)),
        "jug": (d(0.18, 0.34), d(0.05, 0.1), d(0.1, 0.32), d(0.016, 0.034), d(0.03, 0.14)),
    }[style]
    cap = d(0.03, 0.1) * height
    body = height - cap
    z_neck = body - neck_h * height
    z_shoulder = z_neck - shoulder * height
    square = style == "flask" and d.chance(0.6)
    # One exponent serves the whole loft: the neck of a square bottle is square too.
    exponent = d(5, 9) if square else 2.0
    waist = d(0.76, 0.97) if d.chance(0.5) else 1.0
    foot = d(0.72, 0.98) if d.chance(0.35) else 1.0
    curve = d(0.6, 0.95)
    fill = d(0.55, 1.0) * z_shoulder
    wall = "bottle" if style != "jug" or d.chance(0.5) else "plastic"
    below = "liquid" if wall == "bottle" and d.chance(0.5) else wall
    fill_share = 1.0 + (waist - 1.0) * (z_shoulder - fill) / (0.5 * z_shoulder)
    z_curve = z_shoulder + 0.45 * (z_neck - z_shoulder)
    stations = (0.0, 0.02 * height, 0.5 * z_shoulder, fill, z_shoulder, z_curve, z_neck, body)
    shares = (0.9 * foot, foot, waist, fill_share, 1.0)
    on_curve = neck + curve * (radius - neck)
    radii = (*(share * radius for share in shares), on_curve, neck if square else 1.1 * neck, neck)
    roles = (below,) * 3 + (wall,) * 4
    b.loft(2, roles, stations, (0, 0), radii, exponent=exponent, segments=16, caps=(wall, wall))
    b.cylinder(2, "cap", (0, 0, body + 0.5 * cap - 0.003), neck * d(1.15, 1.5), 0.5 * cap + 0.003, segments=16)
    if style in ("bordeaux", "burgundy", "beer"):
        low = body - d(0.4, 0.9) * neck_h * height
        b.cylinder(2, "cap", (0, 0, 0.5 * (low + body)), neck * 1.1 + 0.002, 0.5 * (body - low), segments=16)
    if d.chance(0.8):
        low, high = d(0.12, 0.3) * z_shoulder, d(0.6, 0.95) * z_shoulder
        ends = (low, min(max(0.5 * z_shoulder, low + 1e-3), high - 1e-3), high)
        proud = [float(np.interp(z, stations, radii)) + 0.006 * height for z in ends]
        b.loft(2, "label", ends, (0, 0), proud, exponent=exponent, segments=16)
    return 4 if square else 0


def tvmonitor(b: Builder, d: Draw) -> int:
    """Add one television or monitor (flat TV, CRT, monitor on a foot, all-in-one); returns its symmetry.

    The front is a dark screen in a bezel; the back is a pale or bulged housing with vents and sockets.
    """
    style = d.choice(flat=0.34, crt=0.24, monitor=0.28, allinone=0.14)
    if style == "crt":
        _crt(b, d)
        return 1
    w = {"flat": d(0.35, 0.75), "monitor": d(0.2, 0.36), "allinone": d(0.22, 0.33)}[style]
    ratio = d(1.2, 1.35) if style == "monitor" and d.chance(0.35) else d(1.5, 1.85)
    h = w / ratio
    thick = d(0.02, 0.045) if style != "flat" else d(0.03, 0.06)
    foot_h = d(0.04, 0.09) if style == "flat" else d(0.08, 0.2)
    chin = d(0.06, 0.11) if style == "allinone" else d(0.0, 0.02)
    z0, z1 = foot_h, foot_h + 2 * h + chin
    bezel = d(0.008, 0.02) if style == "flat" else d(0.01, 0.028)
    case = "trim" if style != "allinone" else "metal"
    back = "body2" if d.chance(0.3) else "plastic"
    b.box(case, (-w, w), (-0.5 * thick, 0.1 * thick), (z0, z1))
    b.box(back, (-0.985 * w, 0.985 * w), (0.0, 0.5 * thick), (z0 + 0.015 * w, z1 - 0.015 * w))
    proud = 0.005 * 2.2 * w
    b.box("screen", (-w + bezel, w - bezel), (-0.5 * thick - proud, 0), (z0 + bezel + chin, z1 - bezel), decal=True)
    # Behind: a housing that tapers away, with vents and a field of sockets.
    deep = d(0.03, 0.07) if style == "flat" else d(0.03, 0.08)
    a, c = d(0.45, 0.8), d(0.3, 0.7)
    mid = z0 + d(0.35, 0.5) * (z1 - z0)
    b.loft(
        1,
        "trim" if d.chance(0.4) else back,
        (0.4 * thick, 0.5 * thick + deep),
        [(0, mid), (0, mid)],
        [(w * (a + 0.12), h * (c + 0.12)), (w * a, h * c)],
        section=((-1, -1), (1, -1), (1, 1), (-1, 1)),
    )
    y = 0.5 * thick + deep
    for i in range(4):
        z = mid + h * c * (0.1 + 0.2 * i)
        b.box("grille", (-w * a * 0.75, w * a * 0.75), (y - 0.01, y + proud), (z, z + 0.11 * h * c), decal=True)
    b.box("label", (-w * a * 0.5, w * a * 0.1), (y - 0.01, y + proud), (mid - 0.6 * h * c, mid - 0.25 * h * c), decal=True)
    b.box(
        "light_front",
        (w * 0.82, w * 0.87),
        (-0.5 * thick - proud, 0),
        (z0 + 0.3 * bezel + 0.2 * chin, z0 + 0.7 * bezel + 0.4 * chin),
        decal=True,
    )
    reach = d(0.1, 0.16) if style == "flat" else d(0.08, 0.13)
    if style == "flat" and d.chance(0.5):
        x = w * d(0.5, 0.85)
        for sign in (-1.0, 1.0):
            b.tube(
                "metal",
                [(sign * x, -reach, 0.006), (sign * x, 0, foot_h + 0.02), (sign * x, reach, 0.006)],
                0.01,
                segments=4,
            )
        return 1
    stem = d(0.025, 0.07)
    y_stem = 0.5 * thick + 0.3 * deep
    b.box(
        "metal" if case == "metal" else "plastic",
        (-stem, stem),
        (y_stem - 0.012, y_stem + 0.025),
        (0.008, z0 + 0.4 * h),
    )
    if d.chance(0.5):
        b.box("metal" if case == "metal" else "trim", (-w * d(0.35, 0.6), w * 0.45), (-reach, reach * 0.8), (0, 0.014))
    else:
        b.loft(2, "trim", (0, 0.016), (0, 0), [(w * 0.5, reach), (w * 0.48, reach * 0.95)], segments=16)
    return 1


def _crt(b: Builder, d: Draw) -> None:
    """Add a set with a picture tube: a deep funnel of a housing behind the screen."""
    w = d(0.17, 0.4)
    h = w * d(0.72, 0.86)
    deep, front = w * d(0.9, 1.35), d(0.06, 0.12)
    case = d.choice(trim=0.45, plastic=0.35, wood=0.2)
    y0 = -0.5 * deep
    z = h
    chin = d(0.08, 0.3) * h
    b.box(case, (-w, w), (y0, y0 + front), (0, 2 * h))
    proud = 0.012 * w + 0.004
    side = d(0.06, 0.3) * w if d.chance(0.3) else 0.06 * w
    b.box("screen", (-w + 0.07 * w, w - side), (y0 - 2 * proud, y0 + 0.02), (chin + 0.04 * h, 1.93 * h), decal=True)
    for i in range(d.integer(2, 5)):
        x = w * (0.75 - 0.18 * i)
        b.box(
            "grille",
            (x - 0.05 * w, x + 0.05 * w),
            (y0 - proud, y0 + 0.02),
            (0.3 * chin, 0.3 * chin + 0.08 * h),
            decal=True,
        )
    shrink, drop = d(0.45, 0.65), d(0.0, 0.12) * h
    yb, ye = y0 + front, y0 + deep
    ym = yb + d(0.35, 0.6) * (ye - yb)
    b.loft(
        1,
        "plastic" if case != "plastic" else "body2",
        (yb - 0.01, ym, ye),
        [(0, z), (0, z - drop), (0, z - 1.5 * drop)],
        [(0.96 * w, 0.95 * h), (0.82 * w, 0.78 * h), (shrink * w, shrink * h)],
        exponent=7,
        segments=12,
    )
    zc = z - 1.5 * drop
    for i in range(4):
        zz = zc + shrink * h * (-0.5 + 0.32 * i)
        b.box(
            "grille",
            (-0.7 * shrink * w, 0.7 * shrink * w),
            (ye - 0.02, ye + proud),
            (zz, zz + 0.12 * shrink * h),
            decal=True,
        )
    b.pair("trim", (0.5 * w, 0.9 * w), (y0 + 0.01, ye - 0.1 * deep), (-0.006, 0.1 * h))
    if d.chance(0.25):
        b.tubes("metal", [(0.02, ym, 1.7 * h), (w * d(0.4, 0.9), ym, 2 * h + d(0.2, 0.4))], 0.006, segments=4)
