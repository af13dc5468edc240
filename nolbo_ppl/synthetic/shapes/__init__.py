"""Parametric shapes of the twelve categories: continuous families of instances made of analytic primitives."""

from __future__ import annotations

from nolbo_ppl.synthetic.shapes.canonical_shape import MATERIAL_ROLES, AnalyticSolid, Shape, Solid
from nolbo_ppl.synthetic.shapes.families import make_shape, shape_from_seed

__all__ = ["MATERIAL_ROLES", "AnalyticSolid", "Shape", "Solid", "make_shape", "shape_from_seed"]
