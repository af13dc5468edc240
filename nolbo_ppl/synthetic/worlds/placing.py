"""Objects of a world: which shapes there are, and finding room for them beside the path."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Float

from nolbo_ppl.geometry.pose import make_pose
from nolbo_ppl.synthetic.assets.shape_library import ShapeAsset, ShapeLibrary
from nolbo_ppl.synthetic.renderer.materials import Material, sample_materials
from nolbo_ppl.synthetic.scenes.footprint import Footprint
from nolbo_ppl.synthetic.worlds.camera_path import Track
from nolbo_ppl.synthetic.worlds.world_mesh import turned

MAX_ATTEMPTS = 12
"""Shapes looked at to find one small enough."""
GAP = 0.04
"""Room left around every object, m."""


@dataclass(frozen=True)
class Appearance:
    """A shape with its colours: look-alikes share it."""

    item: ShapeAsset
    seed: int
    """Of its materials and textures."""

    @cached_property
    def materials(self) -> tuple[Material, ...]:
        """The material of each part: the same in every frame."""
        return sample_materials(self.item.shape.parts, np.random.default_rng(self.seed))


@dataclass(frozen=True)
class WorldObject:
    """One object of a world."""

    id: str
    look: Appearance
    T_ground_object: Float[np.ndarray, "4 4"]
    """Pose of its box centre in the ground frame; of a moving object, in the first frame."""
    footprint: Footprint
    moving: tuple[float, float, float] | None = None
    """Arc length m in the first frame, metres a frame (negative: against the camera's direction) and lateral offset m
    of a moving object."""

    @property
    def centre(self) -> Float[np.ndarray, " 3"]:
        """Box centre in the ground frame, m."""
        return self.T_ground_object[:3, 3]


class Catalogue:
    """Draws looks: new ones, or copies of those that were drawn before."""

    def __init__(self, pool: ShapeLibrary, copies: float, seed: int, rng: np.random.Generator) -> None:
        self.pool, self.copies, self.seed, self.rng = pool, copies, seed, rng
        self.looks: dict[str, list[Appearance]] = {}
        self.count = 0

    def pick(self, category: str, longest: float = np.inf) -> Appearance:
        """A look of a category with a box diagonal of at most `longest` m (the smallest found, if none is)."""
        known = [look for look in self.looks.get(category, []) if look.item.shape.diagonal <= longest]
        if known and self.rng.random() < self.copies:
            return known[int(self.rng.integers(len(known)))]
        drawn = []
        for _ in range(MAX_ATTEMPTS):
            drawn.append(self.pool.item(category, int(self.rng.integers(self.pool.count(category)))))
            if drawn[-1].shape.diagonal <= longest:
                break
        item = min(drawn, key=lambda thing: thing.shape.diagonal) if drawn[-1].shape.diagonal > longest else drawn[-1]
        look = Appearance(item, int(np.random.default_rng([self.seed, self.count, 77]).integers(2**31)))
        self.count += 1
        self.looks.setdefault(category, []).append(look)
        return look


@dataclass
class Placer:
    """Keeps the things that stand in a world from touching each other and the camera's way."""

    catalogue: Catalogue
    track: Track
    clearance: float
    """Least distance of any object's footprint from the camera's track, m."""
    wanted: int
    objects: list[WorldObject] = field(default_factory=list)
    taken: list[Footprint] = field(default_factory=list)

    @property
    def full(self) -> bool:
        """Whether there are as many objects as wanted."""
        return len(self.objects) >= self.wanted

    def free(self, footprint: Footprint, clearance: float | None = None) -> bool:
        """Whether a footprint meets nothing and stays clear of the camera's track."""
        local = (self.track.points - footprint.centre) @ footprint.axes.T
        outside = np.maximum(np.abs(local) - footprint.half, 0)
        if np.hypot(*outside.T).min() < (self.clearance if clearance is None else clearance):
            return False
        return not any(footprint.meets(other) for other in self.taken)

    @staticmethod
    def block(centre: np.ndarray, heading: float, half: tuple[float, float], z: tuple[float, float]) -> Footprint:
        """Footprint of a box with its long axis along a heading."""
        return Footprint(np.asarray(centre[:2], dtype=np.float64), turned(heading)[:2, :2].T, np.asarray(half), z)

    def place(
        self,
        category: str,
        xy: Float[np.ndarray, " 2"],
        facing: float,
        *,
        longest: float = np.inf,
        look: Appearance | None = None,
        floor: float = 0.0,
        on: WorldObject | None = None,
    ) -> WorldObject | None:
        """Stand an object at a place, its front towards `facing` (heading, rad); None where it has no room.

        Args:
            category: which category.
            xy: centre of its footprint.
            facing: where its front points.
            longest: greatest box diagonal, m.
            look: a look to repeat instead of drawing one.
            floor: height of the ground there, m.
            on: the object it stands on, on top of its box.
        """
        if self.full:
            return None
        look = self.catalogue.pick(category, longest) if look is None else look
        shape = look.item.shape
        yaw = facing + np.pi / 2  # the front faces -y of the object
        half = 0.5 * shape.dimensions
        z0 = floor if on is None else on.centre[2] + 0.5 * float(on.look.item.shape.dimensions[2])
        gap = GAP if on is None else 0.0
        footprint = self.block(np.asarray(xy), yaw, (half[0] + gap, half[1] + gap), (z0 + 1e-6, z0 + 2 * half[2]))
        if not self.free(footprint):
            return None
        pose = make_pose(turned(yaw), np.array([xy[0], xy[1], z0 + half[2]]))
        made = WorldObject(f"O{len(self.objects)}", look, pose, footprint)
        self.objects.append(made)
        self.taken.append(footprint)
        return made
