"""Instances by category: from a generator, or from a seed that the name of the instance remembers."""

from __future__ import annotations

import zlib
from collections.abc import Callable

import numpy as np

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.errors import input_error
from nolbo_ppl.synthetic.shapes import air, bicycle, bus, household, motorbike, rail, road, seats, tables, water
from nolbo_ppl.synthetic.shapes.canonical_shape import Shape, assemble
from nolbo_ppl.synthetic.shapes.shape_builder import Builder, Draw

FAMILIES: dict[str, Callable[[Builder, Draw], int]] = {
    "aeroplane": air.aeroplane,
    "bicycle": bicycle.bicycle,
    "boat": water.boat,
    "bottle": household.bottle,
    "bus": bus.bus,
    "car": road.car,
    "chair": seats.chair,
    "diningtable": tables.diningtable,
    "motorbike": motorbike.motorbike,
    "sofa": seats.sofa,
    "train": rail.train,
    "tvmonitor": household.tvmonitor,
}
"""For each category the function that adds the parts of one instance and returns its symmetry."""

SEEDS = 10**8
"""Seeds of instances drawn without a name lie below this: eight digits, as in the name."""


def make_shape(category: str, rng: np.random.Generator, instance: str | None = None) -> Shape:
    """Draw one instance of a category.

    Args:
        category: one of the twelve PASCAL3D+ names.
        rng: source of every random number.
        instance: its name; without one a seed is drawn and the result is `shape_from_seed` of it, so that the name
            alone makes the shape again.

    Raises:
        InputError: unknown category.
    """
    if category not in FAMILIES:
        raise input_error("unknown category", got=repr(category), expected=", ".join(CATEGORIES))
    if instance is None:
        return shape_from_seed(category, int(rng.integers(SEEDS)))
    builder = Builder()
    symmetry = FAMILIES[category](builder, Draw(rng))
    return assemble(category, instance, builder.solids, builder.decals, symmetry)


def shape_from_seed(category: str, seed: int) -> Shape:
    """Make the instance `f"{category}-{seed:08d}"`: the same seed gives the same shape on every machine.

    Raises:
        InputError: unknown category or negative seed.
    """
    if seed < 0:
        raise input_error("seed of a shape", got=seed, expected="a whole number of at least 0")
    rng = np.random.default_rng([zlib.crc32(category.encode()), seed])
    return make_shape(category, rng, f"{category}-{seed:08d}")
