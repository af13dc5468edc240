"""Voxel shapes in 3D: the surface of a mean, and the same surface coloured by the uncertainty of its voxels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.geometry.voxels import voxels_to_mesh

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec

MIN_ELEVATION = 12.0
"""Shapes are shown from at least this height in degrees, so that a level view still has depth."""
LIGHT = np.array([-0.45, 0.55, 0.7])
"""Direction of the light in the view: right, up, towards the viewer."""


MOST_FACES = 40_000
"""A surface of more triangles is drawn at half the resolution: a shape that is all noise would take minutes."""


def surface(occupancy: Float[np.ndarray, "n n n"]) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """The 0.5-surface of an occupancy grid, of blocks of voxels where that of single ones is too ragged to draw."""
    vertices, faces = voxels_to_mesh(occupancy)
    n = len(occupancy)
    if len(faces) > MOST_FACES and n % 2 == 0:
        return surface(np.asarray(occupancy).reshape(n // 2, 2, n // 2, 2, n // 2, 2).mean((1, 3, 5)))
    return vertices, faces


def shape_axes(figure: Figure, place: SubplotSpec, viewpoint: Float[np.ndarray, " 3"]) -> Any:
    """3D axes without frame that look at the canonical box from the estimated viewpoint."""
    from mpl_toolkits.mplot3d import Axes3D

    axes: Any = Axes3D(figure, rect=tuple(place.get_position(figure).bounds), auto_add_to_figure=False)
    figure.add_axes(axes)
    azimuth, elevation, in_plane = np.degrees(viewpoint)
    # Azimuth zero looks from -y, which matplotlib counts as -90 degrees.
    axes.view_init(elev=max(elevation, MIN_ELEVATION), azim=azimuth - 90, roll=-in_plane)
    axes.set_proj_type("persp", focal_length=1.6)
    axes.set(xlim=(-0.4, 0.4), ylim=(-0.4, 0.4), zlim=(-0.4, 0.4))
    axes.set_box_aspect((1, 1, 1), zoom=1.42)
    axes.set_axis_off()
    return axes


def draw_mesh(
    axes: Any, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], colour: Any, ambient: float = 0.5
) -> None:
    """Draw a mesh with flat shading.

    Args:
        axes: 3D axes made by `shape_axes`.
        vertices: corners in the canonical box.
        faces: triangles.
        colour: one colour, or an array [f, 3] of one a face.
        ambient: brightness of faces turned away from the light, as a share.
    """
    from matplotlib.colors import to_rgb
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    if not len(faces):
        axes.text2D(0.5, 0.5, "empty", transform=axes.transAxes, ha="center", va="center", color="#8a929b")
        return
    triangles = vertices[faces]
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    brightness = ambient + (1 - ambient) * np.clip(normal @ _light(axes), 0, 1)
    base = np.broadcast_to(np.asarray(to_rgb(colour) if isinstance(colour, str) else colour), (len(faces), 3))
    shaded = np.clip(base * brightness[:, None], 0, 1)
    axes.add_collection3d(Poly3DCollection(triangles, facecolors=shaded, edgecolors=shaded, linewidths=0.2))


def _light(axes: Any) -> Float[np.ndarray, " 3"]:
    """Direction towards the light in the canonical frame, fixed to the view."""
    azimuth, elevation = np.radians([axes.azim, axes.elev])
    towards = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    up = np.cross(towards, right)
    light = LIGHT[0] * right + LIGHT[1] * up + LIGHT[2] * towards
    return light / np.linalg.norm(light)


def face_values(
    field: Float[np.ndarray, "n n n"], vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, " f"]:
    """A voxel field at the centre of each face, interpolated linearly."""
    from scipy.ndimage import map_coordinates

    index = (vertices[faces].mean(1) + 0.5) * field.shape[0] - 0.5
    return map_coordinates(np.asarray(field, dtype=np.float64), index.T, order=1, mode="nearest")


def draw_shape(
    figure: Figure,
    place: SubplotSpec,
    occupancy: Float[np.ndarray, "n n n"],
    colour: Any,
    viewpoint: Float[np.ndarray, " 3"],
) -> Any:
    """Draw the 0.5-surface of an occupancy grid from a viewpoint."""
    axes = shape_axes(figure, place, viewpoint)
    draw_mesh(axes, *surface(occupancy), colour)
    return axes


def draw_uncertainty(
    figure: Figure,
    place: SubplotSpec,
    occupancy: Float[np.ndarray, "n n n"],
    variance: Float[np.ndarray, "n n n"],
    viewpoint: Float[np.ndarray, " 3"],
) -> Any:
    """Draw the same surface coloured by the standard deviation of occupancy there, from 0 to a fair coin's 0.5."""
    from matplotlib import colormaps

    colours = colormaps["viridis"]
    axes = shape_axes(figure, place, viewpoint)
    vertices, faces = surface(occupancy)
    scale = np.sqrt(np.maximum(face_values(variance, vertices, faces), 0)) if len(faces) else np.zeros(0)
    draw_mesh(axes, vertices, faces, colours(np.clip(scale / 0.5, 0, 1))[:, :3], ambient=0.75)
    x0, y0, width, height = place.get_position(figure).bounds
    bar = figure.add_axes((x0 + 0.2 * width, y0 - 0.02 * height, 0.6 * width, 0.045 * height))
    bar.imshow(np.linspace(0, 1, 64)[None], aspect="auto", cmap=colours, extent=(0, 0.5, 0, 1))
    bar.set(yticks=[], xticks=[0, 0.25, 0.5])
    bar.tick_params(labelsize=5.5, length=1.5, pad=1)
    for spine in bar.spines.values():
        spine.set_visible(False)
    return axes
