"""The twelve PASCAL3D+ categories and the symmetry each declares, and forty for the paper's own programme."""

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

OBJECTNET3D_MORE: tuple[str, ...] = (
    *("backpack", "bed", "bench", "bookshelf", "cabinet", "computer", "cup", "desk_lamp", "dishwasher", "door", "filing_cabinet"),
    *("fire_extinguisher", "guitar", "keyboard", "laptop", "mailbox", "microwave", "piano", "printer", "refrigerator", "stove"),
    *("suitcase", "toilet", "trash_bin", "tub"),
)
"""Categories of ObjectNet3D beyond those of PASCAL3D+ that stand still in rooms and streets."""

PIX3D_ONLY: tuple[str, ...] = ("desk", "tool", "wardrobe")
"""Categories of Pix3D that neither PASCAL3D+ nor ObjectNet3D has."""

PAPER_CATEGORIES: tuple[str, ...] = (*CATEGORIES, *OBJECTNET3D_MORE, *PIX3D_ONLY)
"""Forty categories for the paper's programme.

The paper takes forty of the hundred classes of PASCAL3D+, ObjectNet3D and Pix3D and names thirteen of them: the twelve of its
viewpoint table, and bench. The others are our choice. 37 exist in ObjectNet3D with photographs, viewpoints and aligned CAD
models; `PIX3D_ONLY` do not: they are learnt from Pix3D alone.
"""
