"""Ray casting: which mesh each pixel shows, hard shadows, and the image as linear light or display values.

Everything lives in the camera frame (x right, y down, z forward). Each mesh keeps an Embree scene in its own frame,
built once: placing it costs nothing, rays are moved into its frame instead. Building a scene costs 2.5 us a triangle in
the wrapper against 0.12 us a ray, so one scene per mesh beats one merged scene per image, and the silhouette of an
object without the others, which its visibility needs, comes for free.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from nolbo_ppl.synthetic.renderer import shading
from nolbo_ppl.synthetic.renderer.camera_view import MeshInstance, View
from nolbo_ppl.synthetic.renderer.materials import stacked_table

NEAR = 1e-3
"""Depth before which a vertex counts as behind the camera, in scene units."""


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
    instance_visible: dict[int, float]
    """Pixels in which each labelled object is in front."""
    instance_silhouette: dict[int, float]
    """Pixels each labelled object covers when it is alone, beyond the border included."""
    windows: tuple[Float[np.ndarray, " 4"] | None, ...]
    """Box px of all that each mesh may cover, None when it is out of sight."""


def pixel_directions(
    x0: int, y0: int, x1: int, y1: int, intrinsics: Float[np.ndarray, " 4"], step: int = 1
) -> Float[np.ndarray, "n 3"]:
    """Rays with z = 1 through the pixel centres of columns x0 to x1 and rows y0 to y1, row by row; float32."""
    fx, fy, cx, cy = intrinsics
    x = (np.arange(x0, x1, step) + 0.5 - cx) / fx
    y = (np.arange(y0, y1, step) + 0.5 - cy) / fy
    rays = np.ones((len(y), len(x), 3), dtype=np.float32)
    rays[..., 0], rays[..., 1] = x, y[:, None]
    return rays.reshape(-1, 3)


def _first_hits(placed: MeshInstance, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Face (or -1) and depth of the first hit of rays from the camera with z = 1."""
    origin = (-(placed.inverse @ placed.offset)).astype(np.float32)
    local = directions @ placed.inverse.T.astype(np.float32)
    if not len(local):  # Embree's wrapper does not take an empty set of rays
        return np.zeros(0, dtype=np.int32), np.zeros(0, dtype=np.float32)
    origins = np.empty_like(local)
    origins[:] = origin
    hit = placed.mesh.scene.run(origins, local, output=1)
    return hit["primID"], np.where(hit["primID"] >= 0, hit["tfar"], np.inf)


def image_window(placed: MeshInstance, intrinsics: Float[np.ndarray, " 4"]) -> Float[np.ndarray, " 4"] | None:
    """Box [x0, y0, x1, y1] px of the projected vertices; None when some lie behind the camera."""
    points = placed.vertices
    if points[:, 2].min() <= NEAR:
        return None
    pixels = points[:, :2] / points[:, 2:] * intrinsics[:2] + intrinsics[2:]
    return np.concatenate((pixels.min(axis=0), pixels.max(axis=0)))


def _trace_window(placed: MeshInstance, view: View) -> Float[np.ndarray, " 4"] | None:
    """Box px of all that a mesh may cover, without bounds where it reaches behind the camera; None when out of sight."""
    window = image_window(placed, view.intrinsics)
    if window is not None:
        return window
    points = placed.vertices
    ahead = points[points[:, 2] > NEAR]
    if not len(ahead):
        return None
    pixels = ahead[:, :2] / ahead[:, 2:] * view.intrinsics[:2] + view.intrinsics[2:]
    # What comes near the camera's plane goes to infinity on its own side: both, where the mesh has vertices on both.
    low = np.where((points[:, :2] < 0).any(axis=0), -np.inf, pixels.min(axis=0))
    high = np.where((points[:, :2] > 0).any(axis=0), np.inf, pixels.max(axis=0))
    return np.concatenate((low, high))


def trace(view: View) -> Hits:
    """Cast one ray through each pixel centre: the mesh in front, and each mesh's own silhouette.

    A silhouette is followed one image size beyond every border, on a coarser grid where it is large.
    """
    height, width = view.height, view.width
    depth = np.full((height, width), np.inf, dtype=np.float32)
    index = np.full((height, width), -1, dtype=np.int32)
    face = np.full((height, width), -1, dtype=np.int32)
    silhouette = np.zeros(len(view.placed))
    windows = tuple(_trace_window(placed, view) for placed in view.placed)
    for k, (placed, window) in enumerate(zip(view.placed, windows)):
        if window is None:
            continue
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
        if placed.instance_id >= 0 and (x0, y0, x1, y1) != (a0, b0, a1, b1) and x1 > x0 and y1 > y0:
            step = int(np.ceil(np.sqrt((x1 - x0) * (y1 - y0) / 16384)))
            rays = pixel_directions(x0, y0, x1, y1, view.intrinsics, step)
            pixels = rays[:, :2] * view.intrinsics[:2] + view.intrinsics[2:]
            beyond = ((pixels < 0) | (pixels > [width, height])).any(axis=1)
            silhouette[k] += np.count_nonzero(_first_hits(placed, rays[beyond])[0] >= 0) * step**2
    instance_ids = np.array([placed.instance_id for placed in view.placed] + [-1])
    visible = np.bincount(instance_ids[index[index >= 0]] + 1, minlength=instance_ids.max() + 2)
    return Hits(
        depth,
        index,
        face,
        silhouette,
        instance_visible={p.instance_id: float(visible[p.instance_id + 1]) for p in view.placed if p.instance_id >= 0},
        instance_silhouette={p.instance_id: float(silhouette[k]) for k, p in enumerate(view.placed) if p.instance_id >= 0},
        windows=windows,
    )


def trace_pixels(
    view: View,
    windows: Sequence[Float[np.ndarray, " 4"] | None],
    rows: Int[np.ndarray, " n"],
    columns: Int[np.ndarray, " n"],
    offsets: Float[np.ndarray, "s 2"],
) -> tuple[Float[np.ndarray, "n s 2"], Int[np.ndarray, "n s"], Int[np.ndarray, "n s"], Float[np.ndarray, "n s"]]:
    """Cast several rays through each of some pixels, which must be sorted by row.

    Args:
        view: what there is to see.
        windows: `Hits.windows`.
        rows: row of each pixel.
        columns: column of each pixel.
        offsets: (x, y) of the rays within a pixel, from 0 to 1.

    Returns:
        Slopes of the rays, and of what each meets the number in `View.placed` (or -1), the face, and the depth.
    """
    n, s = len(rows), len(offsets)
    pixels = np.stack((columns, rows), axis=1)[:, None] + offsets
    rays = np.ones((n, s, 3), dtype=np.float32)
    rays[..., :2] = (pixels - view.intrinsics[2:]) / view.intrinsics[:2]
    index, face = np.full((n, s), -1, dtype=np.int32), np.full((n, s), -1, dtype=np.int32)
    depth = np.full((n, s), np.inf, dtype=np.float32)
    for k, (placed, window) in enumerate(zip(view.placed, windows)):
        if window is None:
            continue
        first, last = np.searchsorted(rows, [np.floor(window[1]), np.ceil(window[3])])
        within = columns[first:last]
        chosen = first + np.flatnonzero((within >= np.floor(window[0])) & (within < np.ceil(window[2])))
        primitive, t = _first_hits(placed, rays[chosen].reshape(-1, 3))
        primitive, t = primitive.reshape(-1, s), t.reshape(-1, s)
        nearer = t < depth[chosen]
        depth[chosen] = np.where(nearer, t, depth[chosen])
        index[chosen] = np.where(nearer, k, index[chosen])
        face[chosen] = np.where(nearer, primitive, face[chosen])
    return rays[..., :2], index, face, depth


def shadowed(view: View, points: Float[np.ndarray, "n 3"], light: Float[np.ndarray, " 3"]) -> Bool[np.ndarray, " n"]:
    """Which points (camera frame, already lifted off their surface) a mesh hides from the light in that direction."""
    dark = np.zeros(len(points), dtype=bool)
    points, light = _f32(points, light)
    for placed in view.placed:
        if not placed.casts_shadow:
            continue
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


def _stack(arrays: list[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
    """Stack in single precision, giving an array of the right kind when there is none."""
    return np.ascontiguousarray(arrays, dtype=np.float32) if arrays else np.zeros(shape, dtype=np.float32)


def shade(view: View, hits: Hits) -> Float[np.ndarray, "height width 3"]:
    """Linear RGB of every pixel."""
    fx, fy, cx, cy = _f32(view.intrinsics)[0]
    x = (np.arange(view.width, dtype=np.float32) + np.float32(0.5) - cx) / fx
    y = (np.arange(view.height, dtype=np.float32) + np.float32(0.5) - cy) / fy
    slopes = np.empty((view.height, view.width, 2), dtype=np.float32)
    slopes[..., 0], slopes[..., 1] = x, y[:, None]
    colour = shade_rays(view, slopes.reshape(-1, 2), hits.index.ravel(), hits.face.ravel(), hits.depth.ravel())
    return colour.reshape(view.height, view.width, 3)


def shade_rays(
    view: View,
    slopes: Float[np.ndarray, "n 2"],
    index: Int[np.ndarray, " n"],
    face: Int[np.ndarray, " n"],
    depth: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n 3"]:
    """Linear RGB of what rays meet: surfaces, then shadows, then light.

    Args:
        view: what there is to see; a background picture needs one ray a pixel, row by row.
        slopes: x / z and y / z of each ray.
        index: number of the mesh each meets, or -1.
        face: face of that mesh.
        depth: distance along the optical axis.
    """
    meshes = [placed.mesh for placed in view.placed]
    counts = [len(mesh.faces) for mesh in meshes]
    materials = [len(placed.materials) for placed in view.placed]
    table = stacked_table([placed.materials for placed in view.placed])
    backdrop = view.backdrop
    up, north = _f32(view.up, view.north)
    wall = backdrop.wall if backdrop.wall is not None else backdrop.ground
    wall_normal = up if backdrop.wall_normal is None else _f32(backdrop.wall_normal)[0]
    points, normals, albedo, kind = shading.surfaces(
        slopes,
        np.float32(view.intrinsics[0]),
        index,
        face,
        depth,
        _stack([placed.inverse for placed in view.placed], (1, 3, 3)),
        _stack([placed.offset for placed in view.placed], (1, 3)),
        np.cumsum([0, *counts]),
        np.concatenate([mesh.normals for mesh in meshes]) if meshes else np.zeros((1, 3), np.float32),
        np.concatenate([mesh.part for mesh in meshes]) if meshes else np.zeros(1, np.int64),
        np.cumsum([0, *materials]),
        np.array([placed.texture_seed for placed in view.placed], dtype=np.int64),
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
    picture = np.zeros((1, 3)) if backdrop.picture is None else backdrop.picture.reshape(-1, 3)
    picture, ambient_sky, ambient_ground = _f32(picture, view.ambient_sky, view.ambient_ground)
    zenith, horizon = _f32(backdrop.zenith, backdrop.horizon)
    (sky,) = _f32(np.eye(3) if backdrop.R_sky_camera is None else backdrop.R_sky_camera)
    return shading.illuminate(
        slopes,
        points,
        normals,
        albedo,
        kind,
        lit,
        _stack([light.direction for light in view.lights], (0, 3)),
        _stack([light.colour for light in view.lights], (0, 3)),
        up,
        ambient_sky,
        ambient_ground,
        zenith,
        horizon,
        table.specular,
        table.shininess,
        table.mirror,
        table.glow,
        np.float32(view.camera_height),
        np.float32(backdrop.clouds),
        backdrop.seed,
        sky,
        np.float32(backdrop.mesh_haze),
        backdrop.picture is not None,
        picture,
    )


GAMMA = np.linspace(0.0, 1.0, 8192, dtype=np.float32) ** np.float32(1 / 2.2)
"""Display value of linear light in [0, 1], tabulated: a power for every channel of every pixel costs 2 ms an image."""


def to_display(
    colour: Float[np.ndarray, "height width 3"],
    exposure: float,
    noise: Float[np.ndarray, "height width 3"] | None = None,
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
