"""One mesh of walls, floors, boxes and trees, with a material for every face, in the ground frame."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from nolbo_ppl.synthetic.renderer.camera_view import Mesh
from nolbo_ppl.synthetic.renderer.materials import Material
from nolbo_ppl.synthetic.scenes.distractors import unit_mesh

Vector = Float[np.ndarray, " 3"] | tuple[float, float, float]


def turned(angle: float) -> Float[np.ndarray, "3 3"]:
    """Rotation about the vertical axis, rad."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


class Frame:
    """A place with a heading: its local x runs along the heading, y to the left, z up."""

    def __init__(self, place: Float[np.ndarray, " n"], heading: float, z: float = 0.0) -> None:
        self.origin = np.array([place[0], place[1], z], dtype=np.float64)
        self.R, self.heading = turned(heading), float(heading)

    def __call__(self, x: float, y: float, z: float = 0.0) -> Float[np.ndarray, " 3"]:
        """A local point in the ground frame."""
        return self.origin + self.R @ np.array([x, y, z])


class StaticBuilder:
    """Collects triangles; equal materials share a part."""

    def __init__(self) -> None:
        self._vertices: list[np.ndarray] = []
        self._faces: list[np.ndarray] = []
        self._parts: list[np.ndarray] = []
        self._materials: dict[Material, int] = {}
        self._count = 0

    def add(self, vertices: Float[np.ndarray, "v 3"], faces: np.ndarray, material: Material) -> None:
        """Add triangles of one material."""
        part = self._materials.setdefault(material, len(self._materials))
        self._vertices.append(np.asarray(vertices, dtype=np.float64))
        self._faces.append(np.asarray(faces, dtype=np.int64) + self._count)
        self._parts.append(np.full(len(faces), part, dtype=np.int64))
        self._count += len(vertices)

    def polygon(self, points: Float[np.ndarray, "n 3"], material: Material) -> None:
        """Add a flat convex polygon."""
        n = len(points)
        self.add(np.asarray(points), np.array([(0, k, k + 1) for k in range(1, n - 1)]).reshape(-1, 3), material)

    def quad(self, a: Vector, b: Vector, c: Vector, d: Vector, material: Material) -> None:
        """Add a flat quadrilateral."""
        self.polygon(np.array([a, b, c, d]), material)

    def panel(self, wall: Frame, low: tuple[float, float], high: tuple[float, float], material: Material, y: float = 0.0) -> None:
        """Add an upright rectangle between two corners (x, z) on the plane y of a local frame."""
        (x0, z0), (x1, z1) = low, high
        self.quad(wall(x0, y, z0), wall(x1, y, z0), wall(x1, y, z1), wall(x0, y, z1), material)

    def ribbon(
        self, left: Float[np.ndarray, "n 3"], right: Float[np.ndarray, "n 3"], material: Material, closed: bool = False
    ) -> None:
        """Add the strip between two lines of equally many points."""
        n = len(left)
        i = np.arange(n if closed else n - 1)
        j = (i + 1) % n
        faces = np.concatenate((np.stack((i, n + i, n + j), axis=1), np.stack((i, n + j, j), axis=1)))
        self.add(np.concatenate((left, right)), faces, material)

    def box(self, frame: Frame, low: Vector, high: Vector, material: Material, top: Material | None = None) -> None:
        """Add an upright box between two corners of a local frame; no underside when it stands on the ground."""
        (x0, y0, z0), (x1, y1, z1) = low, high
        ring = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
        corner = np.array([frame(x, y, z) for z in (z0, z1) for x, y in ring])
        sides = [t for k in range(4) for t in ((k, (k + 1) % 4, 4 + (k + 1) % 4), (k, 4 + (k + 1) % 4, 4 + k))]
        if z0 > 1e-3:
            sides += [(0, 2, 1), (0, 3, 2)]
        self.add(corner, np.array(sides), material)
        self.polygon(corner[4:], material if top is None else top)

    def solid(self, kind: str, frame: Frame, centre: Vector, size: Vector, material: Material) -> None:
        """Add a box, ball, cylinder or cone (`clutter.KINDS`) of given size about a local point."""
        vertices, faces = unit_mesh(kind)
        local = vertices * np.asarray(size) + np.asarray(centre)
        self.add(local @ frame.R.T + frame.origin, faces, material)

    def built(self) -> tuple[Mesh, tuple[Material, ...]]:
        """The mesh and the material of each of its parts."""
        mesh = Mesh(np.concatenate(self._vertices), np.concatenate(self._faces), np.concatenate(self._parts))
        return mesh, tuple(self._materials)
