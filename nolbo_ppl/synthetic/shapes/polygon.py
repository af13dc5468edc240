"""Plane polygons: orientation, thickness, triangulation, and which points of a grid they hold."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float

from nolbo_ppl.errors import input_error

Points = Float[np.ndarray, "n 2"]


def following(polygon: Points) -> Points:
    """The corner after each corner (five times faster than `numpy.roll` on polygons this small)."""
    return np.concatenate([polygon[1:], polygon[:1]])


def signed_area(polygon: Points) -> float:
    """Area in square units, positive when the corners run counter-clockwise (shoelace formula)."""
    after = following(polygon)
    return 0.5 * float(polygon[:, 0] @ after[:, 1] - polygon[:, 1] @ after[:, 0])


def half_thickness(polygon: Points) -> float:
    """Half the short side of the rectangle with the polygon's area and perimeter: how thin a strip it is.

    Right for strips in any direction, where the bounding box is not.
    """
    area = abs(signed_area(polygon))
    half_perimeter = 0.5 * float(np.hypot(*(following(polygon) - polygon).T).sum())
    return 0.25 * (half_perimeter - math.sqrt(max(half_perimeter**2 - 4 * area, 0.0)))


def is_convex(polygon: Points) -> bool:
    """Whether a counter-clockwise polygon turns left (or goes straight on) at every corner."""
    edge = following(polygon) - polygon
    after = following(edge)
    turn = edge[:, 0] * after[:, 1] - edge[:, 1] * after[:, 0]
    return bool((turn >= -1e-12).all())


def triangulate(polygon: Points) -> list[tuple[int, int, int]]:
    """Triangles (corner indices, counter-clockwise) of a simple counter-clockwise polygon, by ear clipping.

    Raises:
        InputError: no corner can be cut off: the polygon is clockwise or crosses itself.
    """
    n = len(polygon)
    if is_convex(polygon):
        return [(0, i, i + 1) for i in range(1, n - 1)]
    points: list[tuple[float, float]] = [(float(x), float(y)) for x, y in polygon]

    def turn(a: int, b: int, c: int) -> float:
        (ax, ay), (bx, by), (cx, cy) = points[a], points[b], points[c]
        return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)

    left = list(range(n))
    triangles: list[tuple[int, int, int]] = []
    while len(left) > 3:
        for k in range(len(left)):
            a, b, c = left[k - 1], left[k], left[(k + 1) % len(left)]
            if turn(a, b, c) <= 1e-14:
                continue
            if all(turn(a, b, p) < 0 or turn(b, c, p) < 0 or turn(c, a, p) < 0 for p in left if p not in (a, b, c)):
                triangles.append((a, b, c))
                del left[k]
                break
        else:
            # Corners in a straight line leave no ear: drop one of them, it bounds no area.
            flat = [k for k in range(len(left)) if abs(turn(left[k - 1], left[k], left[(k + 1) % len(left)])) <= 1e-14]
            if not flat:
                raise input_error(
                    "polygon that cannot be triangulated", got=polygon.tolist(), expected="simple, counter-clockwise"
                )
            del left[flat[0]]
    triangles.append((left[0], left[1], left[2]))
    return triangles


def grid_inside(
    polygon: Points, x: Float[np.ndarray, " i"], y: Float[np.ndarray, " j"], margin: float = 0.0
) -> Bool[np.ndarray, "i j"]:
    """Which points of the grid `x` by `y` lie in the polygon (even-odd rule) or within `margin` of its edges."""
    a = polygon
    b = following(polygon)
    edge = b - a
    slope = edge[:, 0] / np.where(edge[:, 1] == 0, 1.0, edge[:, 1])
    above_a, above_b = a[:, 1, None] > y, b[:, 1, None] > y  # [n, j]
    crossing = a[:, 0, None] + slope[:, None] * (y - a[:, 1, None])
    crossing = np.where(above_a != above_b, crossing, -np.inf)
    inside = np.logical_xor.reduce(x[None, :, None] < crossing[:, None, :], axis=0)
    if margin > 0:
        dx, dy = x[None, :, None] - a[:, 0, None, None], y[None, None, :] - a[:, 1, None, None]
        ex, ey = edge[:, 0, None, None], edge[:, 1, None, None]
        along = np.clip((dx * ex + dy * ey) / np.maximum(ex * ex + ey * ey, 1e-300), 0, 1)
        distance = (dx - along * ex) ** 2 + (dy - along * ey) ** 2
        inside |= (distance <= margin**2).any(axis=0)
    return inside
