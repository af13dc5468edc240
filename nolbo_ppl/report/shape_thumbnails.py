"""Small pictures of decoded shapes, drawn by numpy alone: hundreds of landmarks in seconds."""

from __future__ import annotations

import base64
import io

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image

from nolbo_ppl.geometry.voxels import voxels_to_mesh
from nolbo_ppl.viz.shape_plots import face_values, surface

Rgba = UInt8[np.ndarray, "n n 4"]
AZIMUTH, ELEVATION = np.radians(38.0), np.radians(24.0)
"""Where shapes are seen from: in front, a little from the right and above."""
EXTENT = 0.42
"""Half the side of what is shown, in units of the box's diagonal."""
DENSITY = 1.6
"""Points a px along the sides of a triangle: fewer leave gaps."""


def data_uri(pixels: UInt8[np.ndarray, "h w c"], colours: int | None = None) -> str:
    """A PNG as a data URI; `colours` reduces it to a palette, a third of the bytes."""
    image = Image.fromarray(np.ascontiguousarray(pixels))
    if colours is not None:
        image = image.quantize(colours, method=Image.Quantize.FASTOCTREE)
    buffer = io.BytesIO()
    image.save(buffer, format="PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def photo_uri(image: Image.Image, longest: int) -> str:
    """A photograph as a JPEG data URI, no side longer than `longest` px."""
    image = image.convert("RGB")
    image.thumbnail((longest, longest), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    image.save(buffer, format="JPEG", quality=82)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def shape_surface(mean: Float[np.ndarray, "n n n"]) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """The 0.5-surface in canonical coordinates; of a shape nowhere that probable, the surface at half its maximum."""
    vertices, faces = surface(mean)
    top = float(mean.max(initial=0.0))
    return (vertices, faces) if len(faces) or top < 1e-3 else voxels_to_mesh(mean, top / 2)


def view_axes(azimuth: float, elevation: float) -> Float[np.ndarray, "3 3"]:
    """Rows right, up, towards the viewer, in the canonical frame; azimuth 0 looks at the front, which faces -y."""
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    return np.array([[ca, sa, 0.0], [-se * sa, se * ca, ce], [ce * sa, -ce * ca, se]])


def rasterise(triangles: Float[np.ndarray, "f 3 3"], size: int) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """Which triangle each covered pixel shows: points spread over all triangles, the nearest of a pixel stays.

    Args:
        triangles: corners as right, up, towards the viewer.
        size: side of the picture, px.

    Returns:
        Covered pixels (row * size + column) and the triangle seen in each.
    """
    side = np.linalg.norm(np.ptp(triangles[..., :2], axis=1), axis=1).max(initial=0.0) / (2 * EXTENT) * size
    count = int(np.clip(np.ceil(DENSITY * side), 2, 64)) + 1
    i, j = np.meshgrid(np.arange(count), np.arange(count), indexing="ij")
    inside = i + j < count
    weights = np.stack([i[inside], j[inside], (count - 1 - i - j)[inside]], axis=1) / (count - 1)
    points = np.einsum("sk,fkc->fsc", weights, triangles).reshape(-1, 3)
    face = np.repeat(np.arange(len(triangles)), len(weights))
    column = np.floor((points[:, 0] / EXTENT + 1) / 2 * size).astype(np.int64)
    row = np.floor((1 - points[:, 1] / EXTENT) / 2 * size).astype(np.int64)
    kept = (column >= 0) & (column < size) & (row >= 0) & (row < size)
    pixel, depth, face = (row * size + column)[kept], points[kept, 2], face[kept]
    order = np.lexsort((depth, pixel))
    last = np.append(np.flatnonzero(np.diff(pixel[order])), len(order) - 1) if len(order) else order
    return pixel[order][last], face[order][last]


def render_shape(
    mean: Float[np.ndarray, "n n n"],
    variance: Float[np.ndarray, "n n n"],
    colour: str,
    size: int = 224,
    azimuth: float = AZIMUTH,
    elevation: float = ELEVATION,
) -> tuple[Rgba, Rgba]:
    """The surface in a colour, and coloured by the standard deviation of occupancy there (0 to a fair coin's 0.5)."""
    from matplotlib import colormaps

    vertices, faces = shape_surface(mean)
    shape, doubt = np.zeros((size * size, 4), dtype=np.uint8), np.zeros((size * size, 4), dtype=np.uint8)
    if len(faces):
        axes = view_axes(azimuth, elevation)
        seen = (vertices @ axes.T)[faces]
        normal = np.cross(seen[:, 1] - seen[:, 0], seen[:, 2] - seen[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        light = np.array([-0.45, 0.55, 0.7]) / np.linalg.norm([-0.45, 0.55, 0.7])
        shade = 0.42 + 0.58 * np.clip(normal @ light, 0, 1)
        pixel, face = rasterise(seen, size)
        base = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)])
        scale = np.sqrt(np.maximum(face_values(variance, vertices, faces), 0))
        doubts = 255 * colormaps["viridis"](np.clip(scale / 0.5, 0, 1))[:, :3] * (0.6 + 0.4 * shade[:, None])
        shape[pixel] = np.column_stack([np.clip(base * shade[face, None], 0, 255), np.full(len(face), 255)])
        doubt[pixel] = np.column_stack([doubts[face], np.full(len(face), 255)])
    return shape.reshape(size, size, 4), doubt.reshape(size, size, 4)
