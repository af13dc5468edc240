"""Ray casting: a camera at the origin, placed meshes, a ground plane, a backdrop, directional lights with hard shadows.

Everything lives in the camera frame (x right, y down, z forward). Each mesh keeps its own Embree scene in its own frame,
built once: placing it costs nothing, rays are moved into its frame instead. Building a scene costs 2.5 us a triangle in
the wrapper against 0.12 us a ray, so one scene per mesh beats one merged scene per image, and the silhouette of an
object without the others, which its visibility needs, comes for free.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numba
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Bool, Float, Int, UInt8

from nolbo_ppl.data import textures
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
        return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)


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
    """"plain", "noise", "checker", "stripes" or "tiles"."""
    frequency: float = 1.0
    """Periods per scene unit."""
    seed: int = 0
    """Which random texture."""


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
    columns: Float[np.ndarray, " n"], rows: Float[np.ndarray, " n"], intrinsics: Float[np.ndarray, "4"]
) -> Float[np.ndarray, "n 3"]:
    """Rays with z = 1 through the centres of pixels given by whole column and row; float32."""
    fx, fy, cx, cy = intrinsics
    x = (columns + 0.5 - cx) / fx
    y = (rows + 0.5 - cy) / fy
    return np.stack((x, y, np.ones_like(x)), axis=-1).astype(np.float32)


def _first_hits(placed: Placed, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Face (or -1) and depth of the first hit of rays from the camera with z = 1."""
    origin = (-(placed.inverse @ placed.offset)).astype(np.float32)
    local = directions @ placed.inverse.T.astype(np.float32)
    origins = np.empty_like(local)
    origins[:] = origin
    hit = placed.mesh.scene.run(origins, local, output=1)
    return hit["primID"], np.where(hit["primID"] >= 0, hit["tfar"], np.inf)


def _window(placed: Placed, intrinsics: np.ndarray) -> Float[np.ndarray, "4"] | None:
    """Box [x0, y0, x1, y1] of the projected vertices; None when some lie behind the camera."""
    points = placed.vertices
    if points[:, 2].min() <= NEAR:
        return None
    pixels = points[:, :2] / points[:, 2:] * intrinsics[:2] + intrinsics[2:]
    return np.concatenate((pixels.min(axis=0), pixels.max(axis=0)))


def _grid(x0: int, y0: int, x1: int, y1: int, step: int = 1) -> tuple[np.ndarray, np.ndarray]:
    columns, rows = np.meshgrid(np.arange(x0, x1, step), np.arange(y0, y1, step))
    return columns.ravel(), rows.ravel()


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
        window = _window(placed, view.intrinsics)
        window = np.array([0.0, 0.0, width, height]) if window is None else window
        x0, y0 = np.maximum(np.floor(window[:2]), [-width, -height]).astype(int)
        x1, y1 = np.minimum(np.ceil(window[2:]), [2 * width, 2 * height]).astype(int)
        a0, b0, a1, b1 = max(x0, 0), max(y0, 0), min(x1, width), min(y1, height)
        if a1 > a0 and b1 > b0:
            columns, rows = _grid(a0, b0, a1, b1)
            primitive, t = _first_hits(placed, pixel_directions(columns, rows, view.intrinsics))
            silhouette[k] += np.count_nonzero(primitive >= 0)
            box = np.s_[b0:b1, a0:a1]
            primitive, t = primitive.reshape(b1 - b0, a1 - a0), t.reshape(b1 - b0, a1 - a0)
            nearer = t < depth[box]
            depth[box][nearer], index[box][nearer], face[box][nearer] = t[nearer], k, primitive[nearer]
        if placed.owner >= 0 and (x0, y0, x1, y1) != (a0, b0, a1, b1) and x1 > x0 and y1 > y0:
            step = int(np.ceil(np.sqrt((x1 - x0) * (y1 - y0) / 16384)))
            columns, rows = _grid(x0, y0, x1, y1, step)
            beyond = (columns < 0) | (columns >= width) | (rows < 0) | (rows >= height)
            if beyond.any():
                rays = pixel_directions(columns[beyond], rows[beyond], view.intrinsics)
                silhouette[k] += np.count_nonzero(_first_hits(placed, rays)[0] >= 0) * step**2
    owners = np.array([placed.owner for placed in view.placed] + [-1])
    visible = np.bincount(owners[index[index >= 0]] + 1, minlength=owners.max() + 2)
    return Hits(
        depth, index, face, silhouette,
        owner_visible={p.owner: float(visible[p.owner + 1]) for p in view.placed if p.owner >= 0},
        owner_silhouette={p.owner: float(silhouette[k]) for k, p in enumerate(view.placed) if p.owner >= 0},
    )  # fmt: skip


@numba.njit(cache=True)
def _behind_ball(points: np.ndarray, dark: np.ndarray, centre: np.ndarray, radius: float, light: np.ndarray):
    """Numbers of the points, not dark yet, whose ray to the light may meet a ball, and their offsets from its centre."""
    chosen = np.empty(len(points), dtype=np.int64)
    offset = np.empty((len(points), 3), dtype=np.float32)
    count = 0
    for i in range(len(points)):
        if dark[i]:
            continue
        x, y, z = points[i, 0] - centre[0], points[i, 1] - centre[1], points[i, 2] - centre[2]
        along = -(x * light[0] + y * light[1] + z * light[2])
        if along > -radius and x * x + y * y + z * z - along * along < radius * radius:
            chosen[count] = i
            offset[count, 0], offset[count, 1], offset[count, 2] = x, y, z
            count += 1
    return chosen[:count], offset[:count]


def shadowed(
    view: View, points: Float[np.ndarray, "n 3"], light: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, " n"]:
    """Which points (camera frame, already lifted off their surface) a mesh hides from the light in that direction."""
    dark = np.zeros(len(points), dtype=bool)
    points, light = _f32(points, light)
    for placed in view.placed:
        centre, inverse = _f32(placed.offset, placed.inverse)
        near, offset = _behind_ball(points, dark, centre, np.float32(placed.radius), light)
        if len(near):
            rays = np.empty_like(offset)
            rays[:] = inverse @ light
            dark[near] = placed.mesh.scene.run(offset @ inverse.T, rays, query="OCCLUDED") >= 0
    return dark


def _f32(*arrays: np.ndarray) -> list[np.ndarray]:
    """Single precision, which every per-pixel array keeps."""
    return [np.asarray(array, dtype=np.float32) for array in arrays]


def _sky(view: View, directions: np.ndarray) -> np.ndarray:
    """Colour of the sky in unit directions [n, 3]; below the horizon that of the horizon."""
    up, zenith, horizon = _f32(view.up, view.backdrop.zenith, view.backdrop.horizon)
    mix = np.sqrt(np.clip(directions @ up * np.float32(1.6), 0, 1))[:, None]
    return horizon + mix * (zenith - horizon)


def _mirrored(view: View, directions: np.ndarray) -> np.ndarray:
    """What a mirror shows in unit directions [n, 3]: the sky, and the ground's ambient light below the horizon."""
    up, below = _f32(view.up, view.ambient_ground * 0.8)
    return np.where((directions @ up)[:, None] >= 0, _sky(view, directions), below)


def _surface_colour(surface: Surface, points: np.ndarray, footprint: np.ndarray) -> np.ndarray:
    """Albedo of a plane at 2D points (scene units); the pattern fades where a pixel covers more than a period."""
    scaled = (points * surface.frequency).astype(np.float32)
    match surface.pattern:
        case "noise":
            mix = np.clip(1.6 * textures.fractal_noise(scaled, surface.seed, 4) - 0.3, 0, 1)
        case "checker":
            mix = textures.checker(scaled)
        case "stripes":
            mix = textures.stripes(scaled[:, 0], 0.5)
        case "tiles":
            mix = textures.tiles(scaled)
        case _:
            mix = np.full(len(points), 0.5, dtype=np.float32)
    fade = 1 / (1 + (np.float32(2 * surface.frequency) * footprint) ** 2)
    mix = (0.5 + (mix - 0.5) * fade)[:, None]
    (colours,) = _f32(surface.colours)
    return colours[0] + mix * (colours[1] - colours[0])


def _diffuse(view: View, normals: np.ndarray, lit: list[np.ndarray]) -> np.ndarray:
    """Light a matt surface of albedo 1 sends back: hemisphere ambient plus each light's cosine where it shines."""
    up, below, above = _f32(view.up, view.ambient_ground, view.ambient_sky)
    total = below + (0.5 + 0.5 * (normals @ up))[:, None] * (above - below)
    for light, shines in zip(view.lights, lit):
        direction, colour = _f32(light.direction, light.colour)
        total += colour * (np.clip(normals @ direction, 0, None) * shines)[:, None]
    return total


def _lit(view: View, points: np.ndarray, normals: np.ndarray) -> list[np.ndarray]:
    """For each light, one where it reaches the points and zero where it does not."""
    result = []
    lifted = points + normals * (np.float32(2e-3) * points[:, 2:] + np.float32(1e-5))
    for light in view.lights:
        (direction,) = _f32(light.direction)
        shines = normals @ direction > 0
        if light.shadow and shines.any():
            facing = np.flatnonzero(shines)
            shines[facing] = ~shadowed(view, lifted[facing], direction)
        result.append(shines.astype(np.float32))
    return result


def _shade_meshes(view: View, hits: Hits, pixels: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Colour of the pixels (flat numbers) that show a mesh; Blinn-Phong with a mirrored sky."""
    index, face = hits.index.ravel()[pixels], hits.face.ravel()[pixels]
    points = directions * hits.depth.ravel()[pixels, None]
    normals = np.empty_like(points)
    local = np.empty_like(points)
    material = np.empty(len(pixels), dtype=np.int64)
    texture_seed = np.zeros(len(pixels), dtype=np.int64)
    first = np.cumsum([0] + [len(placed.materials) for placed in view.placed])
    for k, placed in enumerate(view.placed):
        own = np.flatnonzero(index == k)
        normals[own] = placed.mesh.normals[face[own]] @ placed.inverse  # gradients transform by the inverse transpose
        local[own] = (points[own] - placed.offset) @ placed.inverse.T
        material[own] = first[k] + placed.mesh.part[face[own]]
        texture_seed[own] = placed.texture_seed
    normals /= np.sqrt(np.maximum(np.einsum("nd,nd->n", normals, normals), 1e-30))[:, None]
    eye = -directions / np.sqrt(np.einsum("nd,nd->n", directions, directions))[:, None]
    facing = np.einsum("nd,nd->n", normals, eye)
    normals *= np.where(facing < 0, -1.0, 1.0)[:, None].astype(np.float32)
    facing = np.abs(facing)
    table = material_table([m for placed in view.placed for m in placed.materials])
    albedo = table.albedo[material]
    albedo = albedo * _pattern(table, material, local, texture_seed)[:, None]
    lit = _lit(view, points, normals)
    colour = albedo * (_diffuse(view, normals, lit) + table.glow[material][:, None])
    for light, shines in zip(view.lights, lit):
        direction, light_colour = _f32(light.direction, light.colour)
        half = eye + direction
        half /= np.sqrt(np.einsum("nd,nd->n", half, half))[:, None]
        highlight = np.clip(np.einsum("nd,nd->n", normals, half), 0, 1) ** table.shininess[material]
        colour += light_colour * (highlight * table.specular[material] * shines)[:, None]
    shiny = np.flatnonzero(table.mirror[material] > 0)
    if len(shiny):
        n, e = normals[shiny], eye[shiny]
        mirrored = 2 * facing[shiny, None] * n - e
        strength = table.mirror[material[shiny]]
        strength = strength + (1 - strength) * 0.6 * (1 - facing[shiny]) ** 5
        colour[shiny] = colour[shiny] * (1 - strength[:, None]) + _mirrored(view, mirrored) * strength[:, None]
    return colour


def _pattern(table, material: np.ndarray, local: np.ndarray, seed: np.ndarray) -> np.ndarray:
    """Factor on the albedo from the material's solid texture."""
    factor = np.ones(len(material), dtype=np.float32)
    kind = table.pattern[material]
    for s in np.unique(seed):
        for number, texture in ((1, textures.value_noise), (2, textures.wood)):
            own = np.flatnonzero((kind == number) & (seed == s))
            if len(own):
                scaled = local[own] * table.frequency[material[own], None]
                factor[own] = 1 + table.contrast[material[own]] * (2 * texture(scaled, int(s)) - 1)
        own = np.flatnonzero((kind == 3) & (seed == s))
        if len(own):
            scaled = local[own, 2] * table.frequency[material[own]]
            factor[own] = 1 + table.contrast[material[own]] * (2 * textures.stripes(scaled) - 1)
    return factor


def _shade_backdrop(view: View, pixels: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Colour of the pixels (flat numbers) that show no mesh: picture, ground with shadows, wall, sky."""
    backdrop = view.backdrop
    (up,) = _f32(view.up)
    drop = -(directions @ up)
    distance = np.where(drop > 1e-4, view.camera_height / np.maximum(drop, 1e-4), np.inf).astype(np.float32)
    if backdrop.picture is not None:
        colour = backdrop.picture.reshape(-1, 3)[pixels].astype(np.float32)
    else:
        colour = np.empty_like(directions)
        sky = np.flatnonzero(drop < 0.06)  # where the haze below is not clear yet
        unit = directions[sky] / np.linalg.norm(directions[sky], axis=1, keepdims=True)
        colour[sky] = _sky(view, unit)
        if backdrop.clouds > 0:
            cloud = textures.fractal_noise(unit * 4.0, backdrop.seed, 3) - 0.5
            colour[sky] *= (1 + np.float32(backdrop.clouds) * cloud)[:, None]
        if backdrop.wall is not None:
            (normal,) = _f32(backdrop.wall_normal)
            towards = directions @ normal
            reach = np.where(towards > 1e-4, backdrop.wall_distance / np.maximum(towards, 1e-4), np.inf)
            own = np.flatnonzero(reach < distance)
            colour[own] = _shade_plane(view, backdrop.wall, directions[own] * reach[own, None], -normal, up, False)
            distance = np.where(reach < distance, np.inf, distance)
    own = np.flatnonzero(np.isfinite(distance))
    points = directions[own] * distance[own, None]
    if backdrop.picture is not None:
        normals = np.broadcast_to(up, points.shape)
        light = _diffuse(view, normals, _lit(view, points, normals))
        full = _diffuse(view, normals[:1], [np.ones(1, dtype=np.float32)] * len(view.lights))
        colour[own] *= light / full
        return colour
    ground = _shade_plane(view, backdrop.ground, points, up, view.north, True)
    haze = np.clip(distance[own] / np.float32(view.camera_height * 60.0), 0, 1)[:, None] ** 2
    far = np.flatnonzero(haze[:, 0] > 0.1)
    ground[far] += haze[far] * (colour[own[far]] - ground[far])
    colour[own] = ground
    return colour


def _shade_plane(
    view: View, surface: Surface, points: np.ndarray, normal: np.ndarray, along: np.ndarray, shadows: bool
) -> np.ndarray:
    """Colour of points on a plane whose texture runs in the direction `along`."""
    along = along - normal * (along @ normal)
    normal, along, across = _f32(normal, along / np.linalg.norm(along), np.cross(normal, along / np.linalg.norm(along)))
    plane = np.stack((points @ along, points @ across), axis=1)
    span = np.sqrt(np.einsum("nd,nd->n", points, points))
    grazing = np.abs(points @ normal) / np.maximum(span, np.float32(1e-12))
    footprint = span / (np.float32(view.intrinsics[0]) * np.maximum(grazing, np.float32(1e-3)))
    normals = np.broadcast_to(normal, points.shape)
    if shadows:
        lit = _lit(view, points, normals)
    else:
        lit = [np.ones(len(points), dtype=np.float32)] * len(view.lights)
    return _surface_colour(surface, plane, footprint) * _diffuse(view, normals, lit)


def shade(view: View, hits: Hits) -> Float[np.ndarray, "height width 3"]:
    """Linear RGB of every pixel."""
    columns, rows = _grid(0, 0, view.width, view.height)
    directions = pixel_directions(columns, rows, view.intrinsics)
    on_mesh = hits.index.ravel() >= 0
    colour = np.empty((len(directions), 3), dtype=np.float32)
    mesh_pixels, other = np.flatnonzero(on_mesh), np.flatnonzero(~on_mesh)
    if len(mesh_pixels):
        colour[mesh_pixels] = _shade_meshes(view, hits, mesh_pixels, directions[mesh_pixels])
    if len(other):
        colour[other] = _shade_backdrop(view, other, directions[other])
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
