"""Sailing boats and rowing boats. Lengths in metres, the bow at -y."""

from __future__ import annotations

from itertools import pairwise

from nolbo_ppl.synthetic.shapes.hull import ROUND, add_deck, add_hull
from nolbo_ppl.synthetic.shapes.shape_builder import Builder, Draw


def sailing_boat(b: Builder, d: Draw) -> None:
    """Add a sailing boat: mast before the middle, main sail behind it, jib to the bow, fin keel, maybe two masts."""
    length = d(4.5, 14.0)
    beam, depth = length * d(0.24, 0.34), length * d(0.09, 0.13)
    s = add_hull(b, d, length, beam, depth, depth * d(0.1, 0.35), ROUND, d(0.2, 0.6), d(0.5, 0.85))
    add_deck(b, s, 0.02 * length, 0.012 * length)
    bow, stern = -0.5 * length, 0.5 * length
    mast_y, mast_h = bow + length * d(0.34, 0.44), length * d(1.0, 1.35)
    tube = 0.011 * length
    b.tube("metal", [(0, mast_y, 0.3 * depth), (0, mast_y, depth + mast_h)], [1.2 * tube, 0.7 * tube], segments=6)
    boom = length * d(0.34, 0.46)
    z = depth + length * d(0.1, 0.14)
    b.tube("metal", [(0, mast_y, z), (0, mast_y + boom, z)], 0.8 * tube, segments=5)
    t = 0.006 * length
    belly = d(-0.06, 0.06) * length
    roach = mast_y + boom * d(0.5, 0.62)

    def sheet(profile: list[tuple[float, float]]) -> None:
        # The cloth stands out to one side, more the further aft: a slanting pair of planes.
        slope = belly / boom
        b.extrude(0, "sail", profile, (-t - slope * mast_y, slope, 0.0), (t - slope * mast_y, slope, 0.0))

    if d.chance(0.85):
        sheet(
            [
                (mast_y + 1.5 * tube, z + 0.02 * length),
                (mast_y + 1.5 * tube, depth + 0.97 * mast_h),
                (roach, z + 0.5 * mast_h),
                (mast_y + 0.96 * boom, z + 0.02 * length),
            ]
        )
        if d.chance(0.8):
            top = depth + mast_h * d(0.7, 0.95)
            sheet(
                [
                    (bow + 0.03 * length, depth * 1.35),
                    (mast_y - 2 * tube, top),
                    (mast_y - 2 * tube + d(0.0, 0.08) * length, depth + 0.1 * length),
                ]
            )
    else:
        b.tube("sail", [(0, mast_y, z + 3 * tube), (0, mast_y + 0.95 * boom, z + 3 * tube)], 2.4 * tube, segments=6)
    b.tube(
        "dark_metal",
        [(0, bow + 0.02 * length, depth * 1.2), (0, mast_y, depth + 0.97 * mast_h)],
        0.25 * tube,
        segments=3,
    )
    if d.chance(0.7):
        w, h = 0.28 * beam, length * d(0.04, 0.07)
        y0, y1 = mast_y - 0.06 * length, mast_y + length * d(0.16, 0.26)
        b.side(
            ("windscreen", "body", "wood", "body"),
            [(y0, depth), (y0 + 1.5 * h, depth + h), (y1, depth + h), (y1, depth)],
            w,
            caps="body",
        )
        b.side(
            "glass",
            [
                (y0 + 2 * h, depth + 0.4 * h),
                (y0 + 2.3 * h, depth + 0.8 * h),
                (y1 - h, depth + 0.8 * h),
                (y1 - h, depth + 0.4 * h),
            ],
            w + 0.006 * length,
            decal=True,
        )
        b.box(
            "wood",
            (-0.2 * beam, 0.2 * beam),
            (y1 + 0.04 * length, stern - 0.06 * length),
            (depth, depth + 0.02 * length),
            decal=True,
        )
    b.side(
        "trim",
        [
            (stern - 0.03 * length, -0.05 * length),
            (stern - 0.02 * length, 0.9 * depth),
            (stern + 0.03 * length, 0.9 * depth),
            (stern + 0.02 * length, -0.05 * length),
        ],
        0.006 * length,
    )
    if d.chance(0.5):
        keel = length * d(0.07, 0.13)
        b.side(
            "trim",
            [
                (-0.12 * length, 0.1 * depth),
                (-0.04 * length, -keel),
                (0.1 * length, -keel),
                (0.12 * length, 0.1 * depth),
            ],
            0.012 * length,
        )
    if length > 9 and d.chance(0.3):
        y = stern - 0.16 * length
        b.tube("metal", [(0, y, depth), (0, y, depth + 0.6 * mast_h)], tube, segments=5)
        b.extrude(0, "sail", [(y + 2 * tube, z), (y + 2 * tube, depth + 0.55 * mast_h), (y + 0.25 * length, z)], -t, t)


def rowing_boat(b: Builder, d: Draw) -> None:
    """Add an open rowing boat: a hollow of dark boards between gunwales, thwarts, oars, a transom."""
    length = d(2.6, 5.0)
    beam, depth = length * d(0.28, 0.42), length * d(0.11, 0.16)
    s = add_hull(b, d, length, beam, depth, depth * d(0.2, 0.6), ROUND, d(0.3, 0.9), d(0.6, 0.85), band=False)
    add_deck(b, s, 0.035 * length, 0.012 * length, role="deck")
    for (y0, w0, z0), (y1, w1, z1) in pairwise(s):
        b.tubes("wood", [(w0, y0, z0), (w1, y1, z1)], 0.018 * length, segments=5)
    b.box("wood", (-s[-1][1], s[-1][1]), (0.47 * length, 0.505 * length), (0.4 * depth, depth + 0.03 * length))
    for i in range(d.integer(2, 3)):
        y = (-0.16 + 0.23 * i) * length
        b.box(
            "wood",
            (-0.46 * beam, 0.46 * beam),
            (y, y + 0.07 * length),
            (depth + 0.008 * length, depth + 0.035 * length),
        )
    b.extrude(
        2,
        "body2",
        [(0, -0.49 * length), (-0.9 * s[2][1], s[2][0]), (0.9 * s[2][1], s[2][0])],
        depth * 0.9,
        s[1][2] + 0.02 * length,
    )
    if d.chance(0.7):
        reach, lift = beam * d(0.75, 1.1), depth * d(0.6, 1.4)
        b.tubes("wood", [(0.25 * beam, 0.02 * length, depth * 1.5), (reach, 0.1 * length, lift)], 0.009 * length, segments=4)
        b.pair(
            "wood",
            (reach - 0.02 * length, reach + 0.12 * length),
            (0.06 * length, 0.14 * length),
            (lift - 0.012 * length, lift + 0.006 * length),
        )
    if d.chance(0.35):
        b.box("trim", (-0.05 * length, 0.05 * length), (0.5 * length, 0.58 * length), (0.6 * depth, depth * 1.7))
        b.box("dark_metal", (-0.018 * length, 0.018 * length), (0.51 * length, 0.55 * length), (-0.5 * depth, 0.7 * depth))
