"""Round solid primitives: tubes along a path, and rings (see `primitives` for what each offers)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from nolbo_ppl.synthetic.shapes.primitives import PLANE_AXES, ROUND, Axis, Mesh, from_plane, rings_to_faces, to_world


@dataclass(frozen=True)
class Tube:
    """A round tube along a path, with a radius at each point (straight in between) and flat ends.

    Attributes:
        path: points [k, 3].
        radius: radii [k].
        role: its role.
        segments: corners of a ring of the mesh.
    """

    path: Float[np.ndarray, "k 3"]
    radius: Float[np.ndarray, " k"]
    role: str
    segments: int = 6

    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """The least and the greatest corner of its box (flat ends are given their radius too: never too small)."""
        return np.stack([(self.path - self.radius[:, None]).min(0), (self.path + self.radius[:, None]).max(0)])

    def mesh(self) -> Mesh:
        """Rings carried along the path without twist, and two caps."""
        step = np.diff(self.path, axis=0)
        step /= np.sqrt((step**2).sum(-1, keepdims=True))
        tangent = np.concatenate([step[:1], step[:-1] + step[1:], step[-1:]])
        length = np.sqrt((tangent**2).sum(-1, keepdims=True))
        tangent /= length
        # A mitred joint is wider than the tube by 1 / cos(half the bend): |t_1 + t_2| = 2 cos(half the bend).
        mitre = np.where(np.arange(len(tangent)) % (len(tangent) - 1) == 0, 1.0, 2.0 / np.maximum(length[:, 0], 1.0))
        side = np.eye(3)[np.argmin(np.abs(tangent[0]))]
        angle = np.arange(self.segments) * (2 * math.pi / self.segments)
        rings = []
        for point, t, r in zip(self.path, tangent, self.radius * mitre):
            side = side - (side @ t) * t
            side /= math.sqrt(side @ side)
            up = np.array([t[1] * side[2] - t[2] * side[1], t[2] * side[0] - t[0] * side[2], t[0] * side[1] - t[1] * side[0]])
            rings.append(point + r * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * up))
        k, n = len(self.path), self.segments
        faces = rings_to_faces(k, n, capped=True)
        return np.concatenate(rings), faces, [self.role] * len(faces)

    def inside(self, x: Axis, y: Axis, z: Axis, thin: float) -> Bool[np.ndarray, "i j k"]:
        """Distance to each straight piece; joints are round, ends flat, or round where the tube had to be thickened."""
        thin = ROUND * thin
        result = np.zeros((len(x), len(y), len(z)), dtype=bool)
        last = len(self.path) - 2
        for i in range(last + 1):
            a, b = self.path[i].tolist(), self.path[i + 1].tolist()
            r0, r1 = max(float(self.radius[i]), thin), max(float(self.radius[i + 1]), thin)
            pad = max(r0, r1)
            window = tuple(
                slice(*np.searchsorted(axis, (min(p, q) - pad, max(p, q) + pad))) for axis, p, q in zip((x, y, z), a, b)
            )
            dx, dy, dz = x[window[0]] - a[0], y[window[1]] - a[1], z[window[2]] - a[2]
            ex, ey, ez = b[0] - a[0], b[1] - a[1], b[2] - a[2]
            square = ex * ex + ey * ey + ez * ez
            along = ((dx * (ex / square))[:, None] + dy * (ey / square))[:, :, None] + dz * (ez / square)
            near = np.clip(along, 0.0, 1.0)
            # |d - near e|^2 = |d|^2 - (2 along - near) near |e|^2
            distance = ((dx * dx)[:, None] + dy * dy)[:, :, None] + dz * dz - (2 * along - near) * near * square
            hit = distance <= (r0 + near * (r1 - r0)) ** 2
            if i == 0 and self.radius[0] >= thin:
                hit &= along >= 0.0
            if i == last and self.radius[-1] >= thin:
                hit &= along <= 1.0
            result[window] |= hit
        return result


@dataclass(frozen=True)
class Torus:
    """A ring around an axis: tyres.

    Attributes:
        axis: the axis it turns about.
        centre: its centre [3].
        ring: radius of the circle in its middle.
        tube: radius across it.
        role: its role.
        segments: corners around the axis and around the tube.
    """

    axis: int
    centre: tuple[float, float, float]
    ring: float
    tube: float
    role: str
    segments: tuple[int, int] = (16, 5)

    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """The least and the greatest corner of its box."""
        half = np.full(3, self.ring + self.tube)
        half[self.axis] = self.tube
        return np.array([self.centre - half, self.centre + half])

    def mesh(self) -> Mesh:
        """Rings of the tube around the axis."""
        n, m = self.segments
        around, across = np.meshgrid(np.arange(n) * 2 * math.pi / n, np.arange(m) * 2 * math.pi / m, indexing="ij")
        radius = (self.ring + self.tube * np.cos(across)).ravel()
        v, w = radius * np.cos(around.ravel()), radius * np.sin(around.ravel())
        vertices = to_world(self.axis, self.tube * np.sin(across.ravel()), v, w) + np.array(self.centre)
        faces = rings_to_faces(n, m, capped=False)
        return vertices, faces if self.axis == 1 else faces[:, ::-1], [self.role] * len(faces)

    def inside(self, x: Axis, y: Axis, z: Axis, thin: float) -> Bool[np.ndarray, "i j k"]:
        """(distance from the axis - ring)^2 + height^2 <= tube^2, the first part on the plane alone."""
        grid = [axis - c for axis, c in zip((x, y, z), self.centre)]
        u = grid[self.axis]
        v, w = (grid[i] for i in PLANE_AXES[self.axis])
        plane = (np.sqrt(v[:, None] ** 2 + w[None, :] ** 2) - self.ring) ** 2
        tube = max(self.tube, ROUND * thin)
        return from_plane(self.axis, plane <= (tube * tube - u * u)[:, None, None])
