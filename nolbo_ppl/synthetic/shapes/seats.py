"""Chairs and sofas. Lengths in metres, the front at -y: whoever sits looks to -y."""

from __future__ import annotations

import math

from nolbo_ppl.synthetic.shapes.shape_builder import Builder, Draw

Pair = tuple[float, float]


def chair(b: Builder, d: Draw) -> int:
    """Add one chair (dining, armchair, office, lounge, cantilever); returns its symmetry.

    The seat and the front of the back rest are upholstered, the rear of the back is a bare shell or bars.
    """
    style = d.choice(dining=0.42, arm=0.18, office=0.2, lounge=0.1, cantilever=0.1)
    half, seat = d(0.19, 0.26), d(0.42, 0.48)
    front, rear = -d(0.2, 0.26), d(0.18, 0.24)
    thick = d(0.03, 0.06)
    top = seat + d(0.3, 0.62)
    lean = d(0.03, 0.14)
    frame = d.choice(wood=0.6, metal=0.25, dark_metal=0.15)
    if style == "lounge":
        half, seat, front, rear, thick = d(0.28, 0.36), d(0.32, 0.4), -d(0.28, 0.36), d(0.26, 0.34), d(0.08, 0.15)
        top, lean = seat + d(0.35, 0.7), d(0.1, 0.25)
    if style == "office":
        frame = "plastic"
        _pedestal(b, d, seat - thick)
        half, lean = d(0.22, 0.27), d(0.04, 0.1)
    elif style == "cantilever":
        frame = "metal"
        x = half - 0.02
        b.tubes(
            "metal",
            [
                (x, rear, 0.015),
                (x, front + 0.02, 0.015),
                (x, front, 0.06),
                (x, front, seat - 0.05),
                (x, front + 0.04, seat - 0.01),
                (x, rear, seat - 0.01),
                (x, rear + 0.04, seat + 0.06),
                (x, rear + lean + 0.03, top),
            ],
            0.014,
            segments=5,
        )
        b.box("metal", (-x, x), (rear - 0.012, rear + 0.012), (0.004, 0.028))
    else:
        _legs(b, d, half, front, rear, seat - thick, frame, splay=d(0.0, 0.06), square=d.chance(0.5))
    under = "plastic" if style == "office" else frame
    b.box(under, (-half, half), (front, rear), (seat - thick, seat - 0.3 * thick))
    pad = d(0.02, 0.05) if style != "lounge" else d(0.08, 0.14)
    inset = d(0.005, 0.03)
    b.box("cushion", (-half + inset, half - inset), (front + inset, rear - 0.03), (seat - 0.35 * thick, seat + pad))
    _back(b, d, style, half, rear, seat + pad, top, lean, frame)
    if style == "arm" or (style in ("office", "lounge") and d.chance(0.7)):
        _arms(b, d, half, front, rear, seat, frame, solid=style == "lounge" and d.chance(0.5))
    return 1


def _legs(
    b: Builder, d: Draw, half: float, front: float, rear: float, z: float, frame: str, *, splay: float, square: bool
) -> None:
    """Add four legs, square and straight or round and splayed, sometimes with stretchers."""
    t = d(0.016, 0.026)
    for y, out in ((front + t, -splay), (rear - t, splay)):
        for sign in (-1.0, 1.0):
            x = sign * (half - t)
            if square:
                b.box(frame, (x - t, x + t), (y - t, y + t), (0, z))
            else:
                b.tube(frame, [(x + sign * splay, y + out, 0), (x, y, z)], [0.7 * t, 1.1 * t], segments=6)
    if square and d.chance(0.5):
        h = d(0.1, 0.25)
        b.pair(frame, (half - 1.5 * t, half - 0.5 * t), (front + t, rear - t), (h, h + 0.025))
        b.box(frame, (-half + t, half - t), (0.5 * (front + rear) - 0.01, 0.5 * (front + rear) + 0.01), (h, h + 0.025))


def _pedestal(b: Builder, d: Draw, z: float) -> None:
    """Add a gas spring on a star of five feet with castors."""
    reach, hub = d(0.26, 0.34), d(0.08, 0.12)
    b.cylinder(2, "dark_metal", (0, 0, 0.5 * (hub + z)), d(0.025, 0.035), 0.5 * (z - hub), segments=8)
    turn = d(0, 1.2)
    for i in range(5):
        a = turn + 2 * math.pi * i / 5
        tip = (reach * math.cos(a), reach * math.sin(a), 0.06)
        b.tube("plastic", [(0, 0, hub), tip], [0.028, 0.018], segments=4)
        b.ellipsoid("trim", (tip[0], tip[1], 0.03), (0.03, 0.03, 0.03), segments=6)


def _back(b: Builder, d: Draw, style: str, half: float, rear: float, seat: float, top: float, lean: float, frame: str) -> None:
    """Add the back rest, leaning to +y: a padded shell, vertical spindles, ladder slats or a bar."""
    thick = d(0.02, 0.035) if style != "lounge" else d(0.06, 0.12)

    def at(z: float) -> float:
        return rear - 0.02 + lean * (z - seat) / (top - seat)

    def slab(role: str, x: Pair, low: float, high: float, near: float, far: float) -> None:
        profile = [(at(low) + near, low), (at(high) + near, high), (at(high) + far, high), (at(low) + far, low)]
        b.extrude(0, role, profile, x[0], x[1])

    if style == "office":
        low = seat + d(0.04, 0.16)
        slab("plastic", (-0.03, 0.03), seat - 0.08, low + 0.1, 0.015, 0.05)
        kind = "shell"
    else:
        low = seat - 0.04
        weights = {"lounge": {"shell": 1.0}, "cantilever": {"shell": 0.6, "bar": 0.4}}
        kind = d.choice(**weights.get(style, {"shell": 0.34, "spindles": 0.26, "ladder": 0.24, "bar": 0.16}))
    if kind == "shell":
        width = half * d(0.8, 1.02)
        slab("body2", (-width, width), low, top, 0.0, thick)
        slab("cushion", (-width + 0.02, width - 0.02), low + 0.03, top - 0.025, -d(0.015, 0.03), 0.008)
        if style == "office" and d.chance(0.35):
            slab("cushion", (-half * 0.5, half * 0.5), top + 0.05, top + d(0.14, 0.2), -0.02, 0.03)
            slab("plastic", (-0.02, 0.02), top - 0.05, top + 0.1, 0.005, 0.035)
        return
    post = d(0.014, 0.022)
    if style != "cantilever":
        for x in (-half + post, half - post):
            slab(frame, (x - post, x + post), seat - 0.1, top, 0.0, 2 * post)
    rail = d(0.05, 0.12)
    slab(frame, (-half - 0.002, half + 0.002), top - rail, top + 0.004, -0.006, 2 * post + 0.006)
    if kind == "spindles":
        count = d.integer(3, 6)
        for i in range(count):
            x = (half - 2 * post) * (2 * (i + 1) / (count + 1) - 1)
            b.tube(frame, [(x, at(seat) + post, seat - 0.08), (x, at(top) + post, top - 0.03)], d(0.009, 0.016), segments=5)
    elif kind == "ladder":
        count = d.integer(2, 4)
        for i in range(count):
            z = seat + (top - rail - seat) * (i + 0.6) / (count + 0.4)
            slab(frame, (-half + post, half - post), z - 0.02, z + 0.025, 0.004, 2 * post - 0.004)
    else:
        slab("cushion", (-half + 0.03, half - 0.03), top - rail - 0.05, top - 0.01, -0.03, 0.005)


def _arms(b: Builder, d: Draw, half: float, front: float, rear: float, seat: float, frame: str, *, solid: bool) -> None:
    """Add arm rests: bars on posts, or upholstered sides."""
    z = seat + d(0.18, 0.26)
    if solid:
        w = d(0.08, 0.14)
        b.pair("fabric", (half - 0.01, half + w), (front, rear + 0.05), (0.5 * seat, z))
        return
    t = d(0.018, 0.03)
    fore = front + d(0.02, 0.12)
    b.pair(frame, (half, half + 2 * t), (fore, rear + 0.03), (z - 0.025, z))
    b.pair(frame, (half - 0.2 * t, half + 1.8 * t), (fore + 0.01, fore + 0.05), (seat - 0.06, z - 0.01))


def sofa(b: Builder, d: Draw) -> int:
    """Add one sofa (two to four seats, box or rolled arms, chaise, with or without cushions); returns its symmetry."""
    seats = d.integer(1, 4)
    width = seats * d(0.52, 0.72)
    depth, seat, back = d(0.78, 1.05), d(0.38, 0.47), d(0.68, 1.0)
    base, leg = d(0.14, 0.22), d(0.03, 0.14)
    back_t, arm_w = d(0.14, 0.26), d(0.09, 0.28)
    arm_z = seat + d(0.05, 0.26)
    arms = d.choice(box=0.45, rolled=0.3, slope=0.15, none=0.1)
    half, front, rear = 0.5 * width, -0.5 * depth, 0.5 * depth
    outer = half + (0.0 if arms == "none" else arm_w)
    b.box("fabric", (-half, half), (front + 0.03, rear - 0.02), (leg, leg + base))
    lean = d(0.0, 0.12)
    # The back slopes; its rear face is plain and in the second tone.
    profile = [
        (rear - back_t, leg + 0.02),
        (rear - back_t + 0.3 * lean, back - 0.03),
        (rear - 0.25 * back_t + lean, back),
        (rear + lean, back - 0.04),
        (rear, leg + 0.02),
    ]
    b.extrude(0, ("fabric", "fabric", "fabric", "body2", "fabric"), profile, -outer + 0.01, outer - 0.01)
    if arms == "box":
        b.pair("fabric", (half, outer), (front, rear - 0.03), (leg + 0.01, arm_z))
    elif arms == "rolled":
        r = 0.5 * arm_w + 0.03
        b.pair("fabric", (half, outer - 0.02), (front + 0.02, rear - 0.03), (leg + 0.01, arm_z - r))
        for sign in (-1.0, 1.0):
            b.cylinder(
                1,
                "fabric",
                (sign * (half + 0.5 * arm_w), 0.5 * (front + rear) - 0.01, arm_z - r),
                r,
                0.5 * depth - 0.02,
                segments=10,
                caps="body2",
            )
    elif arms == "slope":
        view = [
            (front, leg + 0.01),
            (front + 0.04, arm_z - 0.1),
            (rear - 0.05, min(back - 0.06, arm_z + 0.12)),
            (rear - 0.05, leg + 0.01),
        ]
        b.extrude(0, "fabric", view, half, outer).extrude(0, "fabric", view, -outer, -half)
    chaise = seats >= 2 and d.chance(0.2)
    side = -1.0 if d.chance(0.5) else 1.0
    pitch = width / seats
    gap = d(0.008, 0.02)
    reach = d(0.45, 0.75)
    pillows = d.chance(0.75)
    pillow_h, pillow_t = d(0.28, 0.45), d(0.1, 0.18)
    for i in range(seats):
        x0, x1 = -half + i * pitch + gap, -half + (i + 1) * pitch - gap
        long = chaise and (i == 0 if side < 0 else i == seats - 1)
        fore = front - (reach if long else 0.0)
        b.box("cushion", (x0, x1), (fore, rear - back_t - 0.01), (leg + base, seat))
        if long:
            b.box("fabric", (x0, x1), (fore + 0.03, front + 0.1), (leg, leg + base - 0.004))
        if pillows:
            y = rear - back_t
            b.extrude(
                0,
                "cushion",
                [
                    (y - pillow_t - 0.03, seat - 0.01),
                    (y - 0.55 * pillow_t, min(seat + pillow_h, back + 0.1)),
                    (y + 0.03, min(seat + pillow_h, back + 0.1)),
                    (y + 0.005, seat - 0.01),
                ],
                x0 + 0.01,
                x1 - 0.01,
            )
    if not pillows:
        rows = d.integer(2, 3)
        for i in range(2 * seats):
            for j in range(rows):
                x = -half + width * (i + 0.5) / (2 * seats)
                z = seat + (back - seat - 0.08) * (j + 0.7) / (rows + 0.4)
                b.box(
                    "cushion",
                    (x - 0.1 * pitch, x + 0.1 * pitch),
                    (rear - back_t - 0.035, rear - 0.5 * back_t),
                    (z - 0.06, z + 0.06),
                )
    t = d(0.02, 0.04)
    foot = d.choice(wood=0.6, metal=0.4)
    for y in (front + 0.06, rear - 0.08):
        b.pair(foot, (outer - 0.1 - t, outer - 0.1 + t), (y - t, y + t), (0, leg + 0.03))
    return 1
