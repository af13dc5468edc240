"""What a drive looks like: the world, the path, the camera, and what stands beside the path."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from nolbo_ppl.errors import input_error

WorldName = Literal["street", "indoor"]
WORLDS: tuple[str, ...] = ("street", "indoor")
PRESETS: tuple[str, ...] = ("default", "demo")
MIN_LOOP = {"street": 70.0, "indoor": 22.0}
"""Shortest loop that leaves room for anything beside it, m."""
MOST_FRAMES = 20_000
"""Frames a drive may have: the length of the loop grows with them."""


@dataclass(frozen=True)
class SequenceConfig:
    """A drive depends on these fields alone."""

    world: WorldName = "street"
    """`street`: a loop of streets with houses and yards; `indoor`: a passage round a furnished floor."""
    seed: int = 0
    """Which world, which shapes, which light."""
    frames: int = 300
    """Number of images."""
    laps: float = 1.25
    """How often the loop is driven round; what lies beyond 1 is seen again from the same direction."""
    opposite: float = 0.0
    """Laps driven afterwards in the opposite direction, after a turn on the spot (street: a U-turn)."""
    step: float = 0.8
    """Distance between frames, m, about; less in tight turns. With frames and laps it gives the length of the loop."""
    size: tuple[int, int] = (384, 192)
    """Width and height of the images, px."""
    focal: float = 0.52
    """Focal length over image width."""
    camera_height: float = 1.65
    """Height of the camera above the ground, m."""
    tilt: float = 8.0
    """Downward tilt of the camera, degrees."""
    objects: int = 220
    """Number of objects wanted; fewer stand where there is no room."""
    look_alikes: float = 0.4
    """Share of objects that are copies (shape and colours) of another one."""
    clutter: int = 120
    """Number of things that are no object: bins, cones, boxes, small heaps."""
    moving: int = 0
    """Objects that drive in the opposite lane (street without an opposite leg)."""
    supersample: int = 2
    """Rays along each side of a pixel that differs from its neighbours; 1 is faster and leaves jagged edges."""
    noise: float = 0.006
    """Scale of the sensor noise, over full range."""
    least_visibility: float = 0.1
    """Objects of which less is seen in a frame are not among its labels."""
    least_box: float = 6.0
    """Objects whose box has a shorter side below this many px in a frame are not among its labels."""

    def __post_init__(self) -> None:
        if self.world not in WORLDS:
            raise input_error("unknown world", got=repr(self.world), expected=", ".join(WORLDS))
        least = {"seed": 0, "frames": 2, "objects": 0, "clutter": 0, "moving": 0, "supersample": 1, "noise": 0}
        for name, bound in least.items():
            if getattr(self, name) < bound:
                raise input_error(f"{name} of the drive", got=getattr(self, name), expected=f"at least {bound}")
        if self.frames > MOST_FRAMES:
            raise input_error("frames of the drive", got=self.frames, expected=f"at most {MOST_FRAMES}")
        if not 0.05 <= self.laps <= 20 or not 0 <= self.opposite <= 20:
            raise input_error(
                "laps of the drive", got=f"laps {self.laps}, opposite {self.opposite}", expected="0.05 to 20, 0 to 20"
            )
        if not 0.02 <= self.step <= 5:
            raise input_error("step of the drive", got=self.step, expected="0.02 to 5 m between frames")
        if len(self.size) != 2 or min(self.size) < 32 or max(self.size) > 4096:
            raise input_error("size of the images", got=self.size, expected="width and height of 32 to 4096 px")
        if not 0.2 <= self.focal <= 5:
            raise input_error("focal length over width", got=self.focal, expected="0.2 to 5")
        if not 0 <= self.look_alikes < 1:
            raise input_error("share of look-alikes", got=self.look_alikes, expected="0 to below 1")
        if not 0.3 <= self.camera_height <= 2.5 or not -20 <= self.tilt <= 45:
            raise input_error(
                "camera of the drive",
                got=f"height {self.camera_height} m, tilt {self.tilt} degrees",
                expected="height of 0.3 to 2.5 m, tilt of -20 to 45 degrees",
            )
        if self.perimeter < MIN_LOOP[self.world]:
            raise input_error(
                "loop of the drive",
                got=f"{self.perimeter:.1f} m (step x frames / laps)",
                expected=f"at least {MIN_LOOP[self.world]:g} m",
                do="use more frames, a longer step or fewer laps",
            )
        if self.moving and (self.world != "street" or self.opposite > 0):
            raise input_error(
                "moving objects",
                got=f"{self.moving} in world {self.world!r} with opposite {self.opposite}",
                expected="world street without an opposite leg: they drive in the opposite lane",
                do="use moving 0",
            )

    @property
    def perimeter(self) -> float:
        """Length of the loop, m."""
        return self.step * (self.frames - 1) / (self.laps + self.opposite)


def sequence_preset(preset: str, world: WorldName, seed: int = 0) -> SequenceConfig:
    """The usual drive of a world; `demo` is a short one whose loop closes just so.

    Raises:
        InputError: unknown preset or world.
    """
    if preset not in PRESETS:
        raise input_error("unknown preset of a drive", got=repr(preset), expected=", ".join(PRESETS))
    config = SequenceConfig(world=world, seed=seed)  # raises for an unknown world
    if world == "indoor":
        config = replace(config, step=0.25, objects=160, clutter=60, camera_height=1.5, tilt=10.0)
    if preset == "demo":
        config = replace(config, frames=120, laps=1.2, objects=60, clutter=40, step=0.3 if world == "indoor" else 0.8)
    return config
