"""Hulls and decks. Lengths in metres, the bow at -y."""

from __future__ import annotations

from nolbo_ppl.synthetic.shapes.shape_builder import Builder, Draw

ROUND = ((-1.0, 1.0), (-0.92, 0.1), (-0.6, -0.7), (0.0, -1.0), (0.6, -0.7), (0.92, 0.1), (1.0, 1.0))
SHARP = ((-1.0, 1.0), (-0.95, 0.0), (0.0, -1.0), (0.95, 0.0), (1.0, 1.0))
BLUNT = ((-1.0, 1.0), (-1.0, -0.6), (-0.7, -1.0), (0.7, -1.0), (1.0, -0.6), (1.0, 1.0))


def add_hull(
    b: Builder,
    d: Draw,
    length: float,
    beam: float,
    depth: float,
    sheer: float,
    section: tuple[tuple[float, float], ...],
    fullness: float,
    transom: float,
    band: bool = True,
) -> list[tuple[float, float, float]]:
    """Add the hull: stations from the bow to the transom; returns (y, half beam, deck height) of each station.

    `fullness` is how soon the plan reaches its beam, `transom` the share of it left at the stern.
    """
    half = 0.5 * beam
    shares = (0.0, 0.08, 0.2, 0.4, 0.7, 1.0)
    plan = (0.03, 0.3 + 0.3 * fullness, 0.62 + 0.3 * fullness, 1.0, 1.0, transom)
    deck = [depth + sheer * (1 - min(s / 0.6, 1.0)) ** 2 for s in shares]
    keel = [(0.55, 0.3, 0.1, 0.0, 0.0, 0.12 * d(0.3, 1.5))[i] * depth for i in range(6)]
    ys = [length * (s - 0.5) for s in shares]
    b.loft(
        1,
        "hull",
        ys,
        [(0.0, 0.5 * (z + k)) for z, k in zip(deck, keel)],
        [(half * w, 0.5 * (z - k)) for w, z, k in zip(plan, deck, keel)],
        section=section,
        caps="hull",
    )
    stations = [(y, half * w, z) for y, w, z in zip(ys, plan, deck)]
    if band:
        high = 0.05 * depth + 0.02
        b.loft(
            1,
            "body2",
            [ys[0] - 0.006 * length, *ys[1:-1], ys[-1] + 0.006 * length],
            [(0.0, z - high - 0.006 * length) for z in deck],
            [(w + 0.008 * length, high) for _, w, _ in stations],
            section=((-1, -1), (1, -1), (1, 1), (-1, 1)),
            decal=True,
        )
    return stations


def add_deck(b: Builder, stations: list[tuple[float, float, float]], inset: float, lift: float, role: str = "deck") -> None:
    """Add the deck as a thin lid that follows the sheer."""
    b.loft(
        1,
        role,
        [y for y, _, _ in stations],
        [(0.0, z + 0.5 * lift) for _, _, z in stations],
        [(max(w - inset, 0.02 * inset), 0.5 * lift) for _, w, _ in stations],
        section=((-1, -1), (1, -1), (1, 1), (-1, 1)),
        decal=True,
    )
