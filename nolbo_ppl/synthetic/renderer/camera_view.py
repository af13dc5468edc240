"""What one image shows, in the camera frame: placed meshes, lights, backdrop, camera."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import TYPE_CHECKING

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore import EmbreeDevice
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float, Int

from nolbo_ppl._moved import renamed
from nolbo_ppl.synthetic.renderer.materials import Material
from nolbo_ppl.synthetic.renderer.textures import PLANE_PATTERNS


@cache
def _device() -> EmbreeDevice:
    """The process's one Embree device: a device for every mesh exhausts memory in the long run."""
    return EmbreeDevice()


@dataclass(frozen=True)
class Mesh:
    """Triangles in their own frame, with a part number a face, ready to be hit by rays."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    part: Int[np.ndarray, " f"]

    @cached_property
    def scene(self) -> EmbreeScene:
        """The Embree scene of this mesh alone."""
        scene = EmbreeScene(_device())
        TriangleMesh(scene, np.ascontiguousarray(self.vertices[self.faces], dtype=np.float32))
        return scene

    @cached_property
    def normals(self) -> Float[np.ndarray, "f 3"]:
        """Unit normal of each face; zero for a degenerate one."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        normal = np.cross(b - a, c - a)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        return normal.astype(np.float32)


@dataclass(frozen=True)
class MeshInstance:
    """A mesh in the camera frame: point = linear @ local + offset."""

    mesh: Mesh
    linear: Float[np.ndarray, "3 3"]
    offset: Float[np.ndarray, " 3"]
    materials: tuple[Material, ...]
    """Material of each part number of the mesh."""
    instance_id: int
    """Number of the labelled object it belongs to, or -1 for clutter."""
    texture_seed: int = 0
    """Which random texture its materials show."""
    casts_shadow: bool = True
    """Whether it hides other things from the lights: a ceiling should not."""

    @cached_property
    def inverse(self) -> Float[np.ndarray, "3 3"]:
        """Takes directions of the camera frame into the mesh's frame."""
        return np.linalg.inv(self.linear)

    @cached_property
    def vertices(self) -> Float[np.ndarray, "v 3"]:
        """Vertices in the camera frame."""
        return self.mesh.vertices @ self.linear.T + self.offset

    @cached_property
    def radius(self) -> float:
        """Radius of the ball about `offset` that holds the mesh, in the camera frame."""
        difference = self.vertices - self.offset
        return float(np.sqrt(np.einsum("vd,vd->v", difference, difference).max()))


@dataclass(frozen=True)
class Light:
    """A light far away."""

    direction: Float[np.ndarray, " 3"]
    """Unit vector towards the light, camera frame."""
    colour: Float[np.ndarray, " 3"]
    """Irradiance on a surface facing it, linear RGB."""
    shadow: bool = True
    """Whether it throws shadows."""


@dataclass(frozen=True)
class Surface:
    """The look of a large plane."""

    colours: Float[np.ndarray, "2 3"]
    """Two albedos, linear RGB; the pattern mixes them."""
    pattern: str = "plain"
    """One of `textures.PLANE_PATTERNS`."""
    frequency: float = 1.0
    """Periods per scene unit."""
    seed: int = 0
    """Which random texture."""

    def arrays(self) -> tuple[np.ndarray, int, float, int]:
        """Colours, number of the pattern, frequency and seed, as the compiled shading takes them."""
        colours = np.ascontiguousarray(self.colours, dtype=np.float32)
        return colours, PLANE_PATTERNS.index(self.pattern), float(self.frequency), int(self.seed)


@dataclass(frozen=True)
class Environment:
    """What is seen where no mesh is."""

    zenith: Float[np.ndarray, " 3"]
    """Colour of the sky overhead, linear RGB."""
    horizon: Float[np.ndarray, " 3"]
    """Colour of the sky at the horizon."""
    ground: Surface
    """The plane the objects stand on."""
    wall: Surface | None = None
    """An upright plane behind everything, or none."""
    wall_distance: float = 10.0
    """Distance of that wall along its normal, scene units."""
    wall_normal: Float[np.ndarray, " 3"] | None = None
    """Horizontal unit vector from the camera to the wall."""
    picture: Float[np.ndarray, "height width 3"] | None = None
    """A photograph or drawn picture that covers sky, wall and ground; linear RGB of the image's own size."""
    clouds: float = 0.0
    """Contrast of clouds in the sky."""
    seed: int = 0
    """Which clouds."""
    R_sky_camera: Float[np.ndarray, "3 3"] | None = None
    """Takes directions of the camera frame into the frame the clouds are fixed in; None: they are fixed in the camera."""
    mesh_haze: float = 0.0
    """Meshes fade into the horizon by `1 - exp(-(mesh_haze * depth)^2)`; 0 for clear air."""


@dataclass(frozen=True)
class View:
    """All that one image shows."""

    height: int
    width: int
    intrinsics: Float[np.ndarray, " 4"]
    up: Float[np.ndarray, " 3"]
    """The world's vertical in the camera frame."""
    north: Float[np.ndarray, " 3"]
    """A horizontal direction in the camera frame, along which the ground's texture runs."""
    camera_height: float
    """Height of the camera above the ground, scene units."""
    placed: tuple[MeshInstance, ...]
    lights: tuple[Light, ...]
    ambient_sky: Float[np.ndarray, " 3"]
    """Light from above where no lamp shines."""
    ambient_ground: Float[np.ndarray, " 3"]
    """Light from below."""
    backdrop: Environment


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
