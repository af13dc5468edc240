"""Ray casting: a camera at the origin, placed meshes, a ground plane, a backdrop, directional lights with hard shadows.

Everything lives in the camera frame (x right, y down, z forward). Each mesh keeps its own Embree scene in its own frame,
built once: placing it costs nothing, rays are moved into its frame instead. Building a scene costs 2.5 us a triangle in
the wrapper against 0.12 us a ray, so one scene per mesh beats one merged scene per image, and the silhouette of an
object without the others, which its visibility needs, comes for free.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Bool, Float, Int, UInt8

from nolbo_ppl.data import shading, textures
from nolbo_ppl.data.materials import Material, material_table

NEAR = 1e-3
"""Depth before which a vertex counts as behind the camera, in scene units."""


@dataclass(frozen=True)
class Mesh:
    """Triangles in their own frame, with a part number a face, ready to be hit by rays."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    part: Int[np.ndarray, " f"]

    @cached_property
    def scene(self) -> EmbreeScene:
        """The Embree scene of this mesh alone."""
        scene = EmbreeScene()
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
class Placed:
    """A mesh in the camera frame: point = linear @ local + offset."""

    mesh: Mesh
    linear: Float[np.ndarray, "3 3"]
    offset: Float[np.ndarray, "3"]
    materials: tuple[Material, ...]
    """Material of each part number of the mesh."""
    owner: int
    """Number of the labelled object it belongs to, or -1 for clutter."""
    texture_seed: int = 0
    """Which random texture its materials show."""

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

    direction: Float[np.ndarray, "3"]
    """Unit vector towards the light, camera frame."""
    colour: Float[np.ndarray, "3"]
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
        return colours, textures.PLANE_PATTERNS.index(self.pattern), float(self.frequency), int(self.seed)


@dataclass(frozen=True)
class Backdrop:
    """What is seen where no mesh is."""

    zenith: Float[np.ndarray, "3"]
    """Colour of the sky overhead, linear RGB."""
    horizon: Float[np.ndarray, "3"]
    """Colour of the sky at the horizon."""
    ground: Surface
    """The plane the objects stand on."""
    wall: Surface | None = None
    """An upright plane behind everything, or none."""
    wall_distance: float = 10.0
    """Distance of that wall along its normal, scene units."""
    wall_normal: Float[np.ndarray, "3"] | None = None
    """Horizontal unit vector from the camera to the wall."""
    picture: Float[np.ndarray, "height width 3"] | None = None
    """A photograph or drawn picture that covers sky, wall and ground; linear RGB of the image's own size."""
    clouds: float = 0.0
    """Contrast of clouds in the sky."""
    seed: int = 0
    """Which clouds."""


@dataclass(frozen=True)
class View:
    """All that one image shows."""

    height: int
    width: int
    intrinsics: Float[np.ndarray, "4"]
    up: Float[np.ndarray, "3"]
    """The world's vertical in the camera frame."""
    north: Float[np.ndarray, "3"]
    """A horizontal direction in the camera frame, along which the ground's texture runs."""
    camera_height: float
    """Height of the camera above the ground, scene units."""
    placed: tuple[Placed, ...]
    lights: tuple[Light, ...]
    ambient_sky: Float[np.ndarray, "3"]
    """Light from above where no lamp shines."""
    ambient_ground: Float[np.ndarray, "3"]
    """Light from below."""
    backdrop: Backdrop


@dataclass(frozen=True)
class Hits:
    """What each pixel's ray meets."""

    depth: Float[np.ndarray, "height width"]
    """Distance along the optical axis, infinite where no mesh is."""
    index: Int[np.ndarray, "height width"]
    """Number in `View.placed` of the mesh in front, or -1."""
    face: Int[np.ndarray, "height width"]
    """Face of that mesh."""
    silhouette: Float[np.ndarray, " placed"]
    """Pixels each mesh covers when it is alone, those beyond the border of the image included."""
    owner_visible: dict[int, float]
    """Pixels in which each labelled object is in front."""
    owner_silhouette: dict[int, float]
    """Pixels each labelled object covers when it is alone, beyond the border included."""


def pixel_directions(
    x0: int, y0: int, x1: int, y1: int, intrinsics: Float[np.ndarray, "4"], step: int = 1
) -> Float[np.ndarray, "n 3"]:
    """Rays with z = 1 through the pixel centres of columns x0 to x1 and rows y0 to y1, row by row; float32."""
    fx, fy, cx, cy = intrinsics
    x = (np.arange(x0, x1, step) + 0.5 - cx) / fx
    y = (np.arange(y0, y1, step) + 0.5 - cy) / fy
    rays = np.ones((len(y), len(x), 3), dtype=np.float32)
    rays[..., 0], rays[..., 1] = x, y[:, None]
    return rays.reshape(-1, 3)


def _first_hits(placed: Placed, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Face (or -1) and depth of the first hit of rays from the camera with z = 1."""
    origin = (-(placed.inverse @ placed.offset)).astype(np.float32)
    local = directions @ placed.inverse.T.astype(np.float32)
    if not len(local):  # Embree's wrapper does not take an empty set of rays
        return np.zeros(0, dtype=np.int32), np.zeros(0, dtype=np.float32)
    origins = np.empty_like(local)
    origins[:] = origin
    hit = placed.mesh.scene.run(origins, local, output=1)
    return hit["primID"], np.where(hit["primID"] >= 0, hit["tfar"], np.inf)


def image_window(placed: Placed, intrinsics: Float[np.ndarray, "4"]) -> Float[np.ndarray, "4"] | None:
    """Box [x0, y0, x1, y1] px of the projected vertices; None when some lie behind the camera."""
    points = placed.vertices
    if points[:, 2].min() <= NEAR:
        return None
    pixels = points[:, :2] / points[:, 2:] * intrinsics[:2] + intrinsics[2:]
    return np.concatenate((pixels.min(axis=0), pixels.max(axis=0)))


def trace(view: View) -> Hits:
    """Cast one ray through each pixel centre: the mesh in front, and each mesh's own silhouette.

    A silhouette is followed one image size beyond every border, on a coarser grid where it is large.
    """
    height, width = view.height, view.width
    depth = np.full((height, width), np.inf, dtype=np.float32)
    index = np.full((height, width), -1, dtype=np.int32)
    face = np.full((height, width), -1, dtype=np.int32)
    silhouette = np.zeros(len(view.placed))
    for k, placed in enumerate(view.placed):
        window = image_window(placed, view.intrinsics)
        window = np.array([0.0, 0.0, width, height]) if window is None else window
        x0, y0 = np.maximum(np.floor(window[:2]), [-width, -height]).astype(int)
        x1, y1 = np.minimum(np.ceil(window[2:]), [2 * width, 2 * height]).astype(int)
        a0, b0, a1, b1 = max(x0, 0), max(y0, 0), min(x1, width), min(y1, height)
        if a1 > a0 and b1 > b0:
            primitive, t = _first_hits(placed, pixel_directions(a0, b0, a1, b1, view.intrinsics))
            silhouette[k] += np.count_nonzero(primitive >= 0)
            box = np.s_[b0:b1, a0:a1]
            primitive, t = primitive.reshape(b1 - b0, a1 - a0), t.reshape(b1 - b0, a1 - a0)
            nearer = t < depth[box]
            depth[box][nearer], index[box][nearer], face[box][nearer] = t[nearer], k, primitive[nearer]
        if placed.owner >= 0 and (x0, y0, x1, y1) != (a0, b0, a1, b1) and x1 > x0 and y1 > y0:
            step = int(np.ceil(np.sqrt((x1 - x0) * (y1 - y0) / 16384)))
            rays = pixel_directions(x0, y0, x1, y1, view.intrinsics, step)
            pixels = rays[:, :2] * view.intrinsics[:2] + view.intrinsics[2:]
            beyond = ((pixels < 0) | (pixels > [width, height])).any(axis=1)
            silhouette[k] += np.count_nonzero(_first_hits(placed, rays[beyond])[0] >= 0) * step**2
    owners = np.array([placed.owner for placed in view.placed] + [-1])
    visible = np.bincount(owners[index[index >= 0]] + 1, minlength=owners.max() + 2)
    return Hits(
        depth, index, face, silhouette,
        owner_visible={p.owner: float(visible[p.owner + 1]) for p in view.placed if p.owner >= 0},
        owner_silhouette={p.owner: float(silhouette[k]) for k, p in enumerate(view.placed) if p.owner >= 0},
    )  # fmt: skip


def shadowed(
    view: View, points: Float[np.ndarray, "n 3"], light: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, " n"]:
    """Which points (camera frame, already lifted off their surface) a mesh hides from the light in that direction."""
    dark = np.zeros(len(points), dtype=bool)
    points, light = _f32(points, light)
    for placed in view.placed:
        centre, inverse = _f32(placed.offset, placed.inverse)
        near, offset = shading.behind_ball(points, dark, centre, np.float32(placed.radius), light)
        if len(near):
            rays = np.empty_like(offset)
            rays[:] = inverse @ light
            dark[near] = placed.mesh.scene.run(offset @ inverse.T, rays, query="OCCLUDED") >= 0
    return dark


def _f32(*arrays: np.ndarray) -> list[np.ndarray]:
    """Single precision, which every per-pixel array keeps."""
    return [np.ascontiguousarray(array, dtype=np.float32) for array in arrays]


def _stack(arrays: list[np.ndarray], shape: tuple[int, ...], dtype: type = np.float32) -> np.ndarray:
    """Stack or concatenate, giving an array of the right kind when there is none."""
    return np.ascontiguousarray(arrays, dtype=dtype) if arrays else np.zeros(shape, dtype=dtype)


def shade(view: View, hits: Hits) -> Float[np.ndarray, "height width 3"]:
    """Linear RGB of every pixel: surfaces, then shadows, then light."""
    meshes = [placed.mesh for placed in view.placed]
    counts = [len(mesh.faces) for mesh in meshes]
    materials = [len(placed.materials) for placed in view.placed]
    table = material_table([m for placed in view.placed for m in placed.materials])
    backdrop = view.backdrop
    up, north = _f32(view.up, view.north)
    wall = backdrop.wall if backdrop.wall is not None else backdrop.ground
    wall_normal = up if backdrop.wall_normal is None else _f32(backdrop.wall_normal)[0]
    points, normals, albedo, kind = shading.surfaces(
        view.width,
        _f32(view.intrinsics)[0],
        hits.index.ravel(),
        hits.face.ravel(),
        hits.depth.ravel(),
        _stack([placed.inverse for placed in view.placed], (1, 3, 3)),
        _stack([placed.offset for placed in view.placed], (1, 3)),
        np.cumsum([0, *counts]),
        np.concatenate([mesh.normals for mesh in meshes]) if meshes else np.zeros((1, 3), np.float32),
        np.concatenate([mesh.part for mesh in meshes]) if meshes else np.zeros(1, np.int64),
        np.cumsum([0, *materials]),
        _stack([placed.texture_seed for placed in view.placed], (1,), np.int64),
        table.albedo,
        table.pattern,
        table.contrast,
        table.frequency,
        up,
        np.float32(view.camera_height),
        north,
        backdrop.ground.arrays(),
        backdrop.wall is not None and backdrop.picture is None,
        wall_normal,
        np.float32(backdrop.wall_distance),
        wall.arrays(),
    )
    lit = np.ones((len(view.lights), len(points)), dtype=np.bool_)
    for number, light in enumerate(view.lights):
        (direction,) = _f32(light.direction)
        facing, lifted = shading.facing_points(points, normals, kind, direction)
        if light.shadow and len(facing):
            lit[number, facing] = ~shadowed(view, lifted, direction)
    has_picture = backdrop.picture is not None
    picture = _f32(backdrop.picture.reshape(-1, 3))[0] if has_picture else np.zeros((1, 3), np.float32)
    colour = shading.illuminate(
        view.width,
        _f32(view.intrinsics)[0],
        points,
        normals,
        albedo,
        kind,
        lit,
        _stack([light.direction for light in view.lights], (0, 3)),
        _stack([light.colour for light in view.lights], (0, 3)),
        up,
        *_f32(view.ambient_sky, view.ambient_ground, backdrop.zenith, backdrop.horizon),
        table.specular,
        table.shininess,
        table.mirror,
        table.glow,
        np.float32(view.camera_height),
        np.float32(backdrop.clouds),
        backdrop.seed,
        has_picture,
        picture,
    )
    return colour.reshape(view.height, view.width, 3)


GAMMA = np.linspace(0.0, 1.0, 8192, dtype=np.float32) ** np.float32(1 / 2.2)
"""Display value of linear light in [0, 1], tabulated: a power for every channel of every pixel costs 2 ms an image."""


def to_display(
    colour: Float[np.ndarray, "height width 3"], exposure: float, noise: Float[np.ndarray, "height width 3"] | None = None
) -> UInt8[np.ndarray, "height width 3"]:
    """Eight-bit display values of linear light: exposure, clipping, gamma 2.2, noise (over full range), rounding."""
    scaled = np.clip(colour * np.float32(exposure * (len(GAMMA) - 1)), 0, len(GAMMA) - 1)
    display = GAMMA[(scaled + np.float32(0.5)).astype(np.int32)]
    if noise is not None:
        display = np.clip(display + noise, 0, 1)
    return (display * np.float32(255) + np.float32(0.5)).astype(np.uint8)


def average_down(colour: Float[np.ndarray, "height width 3"], factor: int) -> Float[np.ndarray, "h w 3"]:
    """Average squares of `factor` by `factor` pixels."""
    height, width, channels = colour.shape
    blocks = colour.reshape(height // factor, factor, width // factor, factor, channels)
    return blocks.mean(axis=(1, 3))
