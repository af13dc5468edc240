"""Materials: how the surface of each part role looks, drawn at random within what is plausible for that role.

Colours by part teach a detector faster than random colours do: glass is dark, tyres are black, lamps at the back are
red. The role names are those of `nolbo_ppl.synthetic.shapes.MATERIAL_ROLES`; a role unknown here is drawn like "body", which
is also how the single part of a CAD mesh without materials is drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.synthetic.renderer.textures import SURFACE_PATTERNS

PATTERNS: tuple[str, ...] = ("none", "noise", "wood", "stripes", *SURFACE_PATTERNS)
"""Solid textures, evaluated in the object's own frame, then those laid out on its faces."""


@dataclass(frozen=True)
class Material:
    """The surface of one part."""

    albedo: tuple[float, float, float]
    """Diffuse reflectance, linear RGB in [0, 1]."""
    specular: float = 0.1
    """Strength of the highlight of a light."""
    shininess: float = 20.0
    """Exponent of that highlight: large is smooth."""
    mirror: float = 0.0
    """Share of the sky seen in the surface at a right angle; it grows towards grazing angles."""
    glow: float = 0.0
    """Light emitted, as a share of the albedo."""
    pattern: str = "none"
    """Solid texture: one of `PATTERNS`."""
    contrast: float = 0.0
    """Depth of the texture: the colour is multiplied by 1 +- contrast."""
    frequency: float = 8.0
    """Periods of the texture along the box diagonal."""


@dataclass(frozen=True)
class MaterialTable:
    """Materials as arrays, indexed by material number: what the shading reads."""

    albedo: Float[np.ndarray, "m 3"]
    specular: Float[np.ndarray, " m"]
    shininess: Float[np.ndarray, " m"]
    mirror: Float[np.ndarray, " m"]
    glow: Float[np.ndarray, " m"]
    pattern: Float[np.ndarray, " m"]
    contrast: Float[np.ndarray, " m"]
    frequency: Float[np.ndarray, " m"]


def material_table(materials: Sequence[Material]) -> MaterialTable:
    """Stack materials into float32 arrays; the pattern becomes its index in `PATTERNS`."""

    def column(name: str) -> np.ndarray:
        return np.array([getattr(material, name) for material in materials], dtype=np.float32)

    unknown = sorted({material.pattern for material in materials} - set(PATTERNS))
    if unknown:
        raise input_error("unknown texture of a material", got=unknown, expected=", ".join(PATTERNS))
    return MaterialTable(
        albedo=column("albedo").reshape(-1, 3),
        specular=column("specular"),
        shininess=column("shininess"),
        mirror=column("mirror"),
        glow=column("glow"),
        pattern=np.array([PATTERNS.index(material.pattern) for material in materials], dtype=np.float32),
        contrast=column("contrast"),
        frequency=column("frequency"),
    )


@lru_cache(maxsize=8192)
def _known_table(materials: tuple[Material, ...]) -> MaterialTable:
    return material_table(materials)


def stacked_table(groups: Sequence[tuple[Material, ...]]) -> MaterialTable:
    """The materials of several meshes in one table; those of each mesh are turned into arrays once."""
    tables = [_known_table(materials) for materials in groups if materials]
    if not tables:
        return material_table([])
    names = [field.name for field in fields(MaterialTable)]
    return MaterialTable(**{name: np.concatenate([getattr(table, name) for table in tables]) for name in names})


def hsv(hue: float, saturation: float, value: float) -> tuple[float, float, float]:
    """Linear RGB (gamma 2.2) of a display colour given by hue, saturation and value, all in [0, 1]."""
    channels = ((n + 6.0 * hue) % 6.0 for n in (5.0, 3.0, 1.0))
    r, g, b = ((value - value * saturation * max(0.0, min(k, 4.0 - k, 1.0))) ** 2.2 for k in channels)
    return r, g, b


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.uniform(low, high))


def _paint(rng: np.random.Generator) -> tuple[float, float, float]:
    """A colour things are painted in: white, grey and black as often as any hue."""
    if rng.random() < 0.4:
        return hsv(rng.random(), _between(rng, 0.0, 0.08), float(rng.choice([0.15, 0.3, 0.5, 0.7, 0.85, 0.95])))
    return hsv(rng.random(), _between(rng, 0.35, 0.95), _between(rng, 0.3, 0.95))


def _grey(rng: np.random.Generator, low: float, high: float) -> tuple[float, float, float]:
    return hsv(rng.random(), _between(rng, 0.0, 0.08), _between(rng, low, high))


def _glossy(rng: np.random.Generator, albedo: tuple[float, float, float]) -> Material:
    return Material(albedo, specular=_between(rng, 0.1, 0.6), shininess=_between(rng, 15, 80), mirror=_between(rng, 0.0, 0.12))


def _matt(rng: np.random.Generator, albedo: tuple[float, float, float], contrast: float = 0.0) -> Material:
    pattern = "noise" if contrast > 0 else "none"
    return Material(albedo, 0.03, 8.0, pattern=pattern, contrast=contrast, frequency=_between(rng, 10, 40))


def _body(rng: np.random.Generator) -> Material:
    return _glossy(rng, _paint(rng))


def _wood(rng: np.random.Generator) -> Material:
    albedo = hsv(_between(rng, 0.04, 0.12), _between(rng, 0.3, 0.75), _between(rng, 0.25, 0.8))
    if rng.random() < 0.2:
        albedo = _grey(rng, 0.15, 0.95)
    return Material(
        albedo,
        _between(rng, 0.02, 0.25),
        20.0,
        pattern="wood",
        contrast=_between(rng, 0.05, 0.35),
        frequency=_between(rng, 6, 20),
    )


def _metal(rng: np.random.Generator, low: float, high: float) -> Material:
    return Material(_grey(rng, low, high), _between(rng, 0.4, 0.9), _between(rng, 20, 60), _between(rng, 0.15, 0.4))


def _glass(rng: np.random.Generator, low: float, high: float) -> Material:
    albedo = hsv(_between(rng, 0.5, 0.65), _between(rng, 0.1, 0.5), _between(rng, low, high))
    return Material(albedo, 0.6, 90.0, mirror=_between(rng, 0.1, 0.35))


def _lamp(rng: np.random.Generator, hue: float, saturation: float) -> Material:
    return Material(hsv(hue, saturation, _between(rng, 0.8, 1.0)), 0.5, 50.0, glow=_between(rng, 0.0, 0.9))


def _bottle(rng: np.random.Generator) -> Material:
    hue = float(rng.choice([0.08, 0.3, 0.33, 0.55, 0.6])) + _between(rng, -0.03, 0.03)
    albedo = hsv(hue % 1.0, _between(rng, 0.2, 0.9), _between(rng, 0.2, 0.8)) if rng.random() < 0.7 else _paint(rng)
    return Material(albedo, _between(rng, 0.4, 0.9), 70.0, mirror=_between(rng, 0.05, 0.25))


def _screen(rng: np.random.Generator) -> Material:
    if rng.random() < 0.35:  # switched on: a glowing picture
        albedo = hsv(rng.random(), _between(rng, 0.1, 0.7), _between(rng, 0.4, 0.9))
        return Material(
            albedo,
            0.3,
            60.0,
            mirror=0.05,
            glow=_between(rng, 0.3, 0.9),
            pattern="noise",
            contrast=_between(rng, 0.2, 0.9),
            frequency=_between(rng, 2, 8),
        )
    return Material(_grey(rng, 0.03, 0.15), 0.5, 80.0, mirror=_between(rng, 0.05, 0.25))


def sample_material(role: str, rng: np.random.Generator) -> Material:
    """Draw the material of one part role; an unknown role is drawn like "body", `colour #rrggbb` has that display colour."""
    r = rng
    if role.startswith("colour #"):  # a face of a CAD file: its own colour, its gloss unknown
        red, green, blue = ((int(role[k : k + 2], 16) / 255) ** 2.2 for k in (8, 10, 12))
        return _glossy(r, (red, green, blue))
    match role:
        case "trim":
            return _glossy(r, _grey(r, 0.05, 0.3))
        case "windscreen":
            return _glass(r, 0.25, 0.55)
        case "glass":
            return _glass(r, 0.05, 0.3)
        case "tyre":
            return _matt(r, _grey(r, 0.04, 0.18))
        case "rim":
            return _metal(r, 0.4, 0.85)
        case "light_front":
            return _lamp(r, 0.14, _between(r, 0.0, 0.2))
        case "light_rear":
            return _lamp(r, _between(r, -0.03, 0.02) % 1.0, 0.9)
        case "grille":
            return _matt(r, _grey(r, 0.03, 0.15))
        case "plate" | "label":
            light = hsv(r.random(), _between(r, 0.0, 0.6 if role == "label" else 0.15), _between(r, 0.75, 1.0))
            return _matt(r, light, contrast=_between(r, 0.0, 0.2))
        case "display":
            amber = hsv(_between(r, 0.08, 0.14), 0.9, 0.9)
            return Material(amber, glow=0.7, pattern="noise", contrast=0.6, frequency=30)
        case "metal":
            return _metal(r, 0.4, 0.85)
        case "dark_metal":
            return _metal(r, 0.1, 0.35)
        case "wood" | "deck":
            return _wood(r)
        case "fabric" | "cushion":
            muted = hsv(r.random(), _between(r, 0.05, 0.7), _between(r, 0.2, 0.85))
            return _matt(r, muted, contrast=_between(r, 0.0, 0.3))
        case "screen":
            return _screen(r)
        case "bottle" | "liquid":
            return _bottle(r)
        case "propeller" | "saddle":
            return _glossy(r, _grey(r, 0.05, 0.4))
        case "sail":
            return _matt(r, _paint(r) if r.random() < 0.25 else _grey(r, 0.75, 1.0), contrast=0.05)
        case "wing":
            return _glossy(r, _grey(r, 0.5, 0.95))
        case _:
            return _body(r)


def sample_materials(roles: Sequence[str], rng: np.random.Generator) -> tuple[Material, ...]:
    """Draw one material for each role, in order."""
    return tuple(sample_material(role, rng) for role in roles)
