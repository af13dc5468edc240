"""Upright boxes that things occupy, and whether two of them overlap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Footprint:
    """An upright box that something occupies, in the world frame."""

    centre: Float[np.ndarray, " 2"]
    axes: Float[np.ndarray, "2 2"]
    """Rows: its horizontal axes."""
    half: Float[np.ndarray, " 2"]
    z: tuple[float, float]

    def meets(self, other: Footprint) -> bool:
        """Whether two boxes overlap: no separating axis among theirs."""
        if self.z[0] >= other.z[1] or other.z[0] >= self.z[1]:
            return False
        gap = other.centre - self.centre
        for axis in (*self.axes, *other.axes):
            reach = np.abs(self.axes @ axis) @ self.half + np.abs(other.axes @ axis) @ other.half
            if abs(gap @ axis) >= reach:
                return False
        return True
