"""Dining tables: rectangular, square, round, oval; on legs, a trestle or a round foot. Lengths in metres."""

from __future__ import annotations

from nolbo_ppl.synthetic.shapes.shape_builder import Builder, Draw


def diningtable(b: Builder, d: Draw) -> int:
    """Add one table; returns its symmetry: 0 round on a round foot, 4 square or round on four legs, else 2."""
    top = d.choice(rectangle=0.44, square=0.16, round=0.28, oval=0.12)
    height, thick = d(0.62, 0.95), d(0.02, 0.09)
    role = d.choice(wood=0.75, glass=0.12, plastic=0.13)
    frame = d.choice(wood=0.6, metal=0.2, dark_metal=0.2) if role != "glass" else "metal"
    long = d(0.6, 1.2) if top == "rectangle" else d(0.5, 0.9) if top == "oval" else d(0.38, 0.75)
    deep = {"rectangle": d(0.36, 0.55), "oval": d(0.35, 0.5)}.get(top, long)
    long = max(long, deep * 1.25) if top in ("rectangle", "oval") else long
    z0 = height - thick
    if top in ("rectangle", "square"):
        b.box(role, (-long, long), (-deep, deep), (z0, height))
    else:
        b.loft(2, role, (z0, height), (0, 0), [(long, deep), (long, deep)], segments=24)
    if top == "round" and d.chance(0.65):
        _round_foot(b, d, long, z0, frame)
        return 0
    # A foot with more symmetry than the top leaves the top's; a four-legged round table has the legs' four turns.
    order = 4 if top in ("square", "round") else 2
    inset = d(0.03, 0.3 if order == 4 else 0.22)
    x, y = (long, deep) if top in ("rectangle", "square") else (long * 0.68, deep * 0.68)
    inset_y = inset if order == 4 else d(0.02, 0.1)
    kind = d.choice(legs=0.45, taper=0.22, column=0.18, trestle=0.15 if order == 2 else 0.0)
    t = d(0.02, 0.06)
    px, py = x - inset * x - t, y - inset_y * y - t
    if kind == "trestle":
        b.pair(frame, (px - t, px + t), (-0.25 * y - t, 0.25 * y + t), (0.03, z0))
        b.pair(frame, (px - 1.6 * t, px + 1.6 * t), (-py, py), (0, 0.07))
        b.box(frame, (-px, px), (-t, t), (0.25 * height, 0.25 * height + 0.1))
        return order
    if kind == "column":
        stem, foot = d(0.1, 0.3), d(0.35, 0.8)
        b.box(frame, (-stem * px, stem * px), (-stem * py, stem * py), (0.02, z0))
        b.box(frame, (-foot * px, foot * px), (-foot * py, foot * py), (0, d(0.03, 0.1)))
        return order
    splay = d(-0.04, 0.1)
    for sx in (-1.0, 1.0):
        for sy in (-1.0, 1.0):
            if kind == "legs":
                b.box(frame, (sx * px - t, sx * px + t), (sy * py - t, sy * py + t), (0, z0))
            else:
                b.loft(
                    2,
                    frame,
                    (0, z0),
                    [(sx * (px + splay), sy * (py + splay)), (sx * px, sy * py)],
                    [0.5 * t, 1.2 * t],
                    section=((-1, -1), (1, -1), (1, 1), (-1, 1)),
                )
    if d.chance(0.6):
        h = d(0.05, 0.2)
        b.pair(frame, (px - 0.4 * t, px + 0.4 * t), (-py, py), (z0 - h, z0))
        for sy in (-1.0, 1.0):
            b.box(frame, (-px, px), (sy * py - 0.4 * t, sy * py + 0.4 * t), (z0 - h, z0))
    if d.chance(0.25):
        z = d(0.1, 0.45) * height
        b.box(role, (-px, px), (-py, py), (z, z + 0.025))
    return order


def _round_foot(b: Builder, d: Draw, radius: float, z: float, frame: str) -> None:
    """Add a turned column on a round plate."""
    stem, foot = d(0.035, 0.1), radius * d(0.4, 0.75)
    bulge, plate = d(1.0, 2.0), d(0.015, 0.05)
    stations = (0.0, plate, plate + 0.05, 0.35 * z, 0.6 * z, z)
    radii = (foot, foot * 0.95, min(2 * stem, foot * 0.9), stem * bulge, stem, stem * d(1.0, 2.5))
    b.loft(2, frame, stations, (0, 0), radii, segments=16)
