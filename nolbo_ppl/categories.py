"""The twelve PASCAL3D+ categories and the symmetry each declares."""

from __future__ import annotations

CATEGORY_SYMMETRY: dict[str, int] = {
    "aeroplane": 1,
    "bicycle": 1,
    "boat": 1,
    "bottle": 0,
    "bus": 1,
    "car": 1,
    "chair": 1,
    "diningtable": 0,
    "motorbike": 1,
    "sofa": 1,
    "train": 1,
    "tvmonitor": 1,
}
"""Symmetry about the vertical axis by category: 1 none, n for n-fold, 0 for a free axis.

A category is declared symmetric when some of its instances are; a single instance may declare its own order (a
rectangular table has 2, a square one 4, a round one 0).
"""

CATEGORIES: tuple[str, ...] = tuple(CATEGORY_SYMMETRY)
"""The category names, in the order of the labels."""
