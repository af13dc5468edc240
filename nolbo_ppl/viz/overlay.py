"""What is drawn over an image: boxes, labels that do not overlap, 3D boxes, object axes, position ellipses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, UInt8

from nolbo_ppl.structures.object_posteriors import ObjectPosteriors
from nolbo_ppl.viz.style import AXIS_COLOURS, category_colour, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.text import Text

REGION_90 = np.sqrt(4.605170185988091)
"""Radius, in standard deviations, of the 90 % region of a Gaussian in the plane: sqrt(-2 log 0.1)."""
MIN_DEPTH = 1e-3
"""Points nearer than this to the camera's plane, as a share of the object's distance, are not drawn."""

_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_EDGES = [(i, j) for i in range(8) for j in range(i) if np.abs(_CORNERS[i] - _CORNERS[j]).sum() == 1]
_FRONT = [0, 1, 5, 4]


def project(points: Float[np.ndarray, "n 3"], intrinsics: Float[np.ndarray, " 4"]) -> Float[np.ndarray, "n 2"] | None:
    """Pixels of points in the camera frame; None when one of them is not before the camera."""
    if (points[:, 2] <= MIN_DEPTH * np.linalg.norm(points, axis=1)).any():
        return None
    return points[:, :2] / points[:, 2:] * intrinsics[:2] + intrinsics[2:]


def object_axes(observations: ObjectPosteriors, index: int) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]]:
    """R_camera_object and position of one object."""
    return observations.R_camera_object[index], observations.position[index]


def draw_box3d(
    axes: Axes,
    R_camera_object: Float[np.ndarray, "3 3"],
    position: Float[np.ndarray, " 3"],
    size: Float[np.ndarray, " 3"],
    intrinsics: Float[np.ndarray, " 4"],
    colour: str,
) -> None:
    """The object's 3D box as lines, its front face filled faintly; nothing when a corner is behind the camera."""
    pixels = project((_CORNERS * size) @ R_camera_object.T + position, intrinsics)
    if pixels is None:
        return
    for i, j in _EDGES:
        axes.plot(*pixels[[i, j]].T, color=colour, linewidth=0.8, alpha=0.8, zorder=3)
    axes.fill(*pixels[_FRONT].T, color=colour, alpha=0.22, linewidth=0, zorder=2.5)


def draw_frame(
    axes: Axes,
    R_camera_object: Float[np.ndarray, "3 3"],
    position: Float[np.ndarray, " 3"],
    length: float,
    intrinsics: Float[np.ndarray, " 4"],
    *,
    colours: tuple[str, str, str] = AXIS_COLOURS,
    width: float = 1.6,
    dashed: bool = False,
) -> None:
    """The object's axes right (x), front (-y) and up (z) as lines of that length in m; the front one is an arrow."""
    ends = position + length * (R_camera_object * np.array([1.0, -1.0, 1.0])).T
    pixels = project(np.concatenate((position[None], ends)), intrinsics)
    if pixels is None:
        return
    for k in (0, 2, 1):
        style = "-|>,head_length=0.45,head_width=0.2" if k == 1 else "-"
        line = axes.annotate(
            "",
            xy=pixels[k + 1],
            xytext=pixels[0],
            zorder=5,
            annotation_clip=False,
            arrowprops={
                "arrowstyle": style,
                "color": colours[k],
                "linewidth": width * (1.25 if k == 1 else 1.0),
                "shrinkA": 0,
                "shrinkB": 0,
                "linestyle": (0, (2.5, 1.5)) if dashed else "-",
            },
        )
        assert line.arrow_patch is not None
        line.arrow_patch.set_clip_path(axes.patch)


def pixel_ellipse(
    position: Float[np.ndarray, " 3"],
    covariance: Float[np.ndarray, "3 3"],
    intrinsics: Float[np.ndarray, " 4"],
    nodes: int = 48,
) -> Float[np.ndarray, "nodes 2"] | None:
    """Outline in px of the 90 % region of a position's projection, to first order; None behind the camera."""
    x, y, z = position
    if z <= 0:
        return None
    jacobian = np.array([[1 / z, 0, -x / z**2], [0, 1 / z, -y / z**2]]) * intrinsics[:2, None]
    centre = position[:2] / z * intrinsics[:2] + intrinsics[2:]
    return centre + _outline(jacobian @ covariance @ jacobian.T, nodes)


def _outline(covariance: Float[np.ndarray, "2 2"], nodes: int) -> Float[np.ndarray, "nodes 2"]:
    """Points of the 90 % ellipse of a covariance about the origin."""
    variance, direction = np.linalg.eigh(covariance)
    angle = np.linspace(0, 2 * np.pi, nodes)
    circle = np.stack((np.cos(angle), np.sin(angle)), axis=1)
    return REGION_90 * (circle * np.sqrt(np.maximum(variance, 0))) @ direction.T


def bearing_range_ellipse(
    position: Float[np.ndarray, " 3"], covariance: Float[np.ndarray, "3 3"], nodes: int = 64
) -> Float[np.ndarray, "nodes 2"]:
    """Outline of the 90 % region of (bearing in rad, log distance), to first order."""
    x, _, z = position
    squared = float(position @ position)
    jacobian = np.array([[z, 0.0, -x], [0.0, 0.0, 0.0]]) / (x * x + z * z)
    jacobian[1] = position / squared
    return np.array([np.arctan2(x, z), 0.5 * np.log(squared)]) + _outline(jacobian @ covariance @ jacobian.T, nodes)


def show_part(axes: Axes, image: UInt8[np.ndarray, "h w 3"], x: tuple[float, float], y: tuple[float, float]) -> None:
    """Show the part of an image between two columns and two rows (px), nothing beyond its borders."""
    height, width = image.shape[:2]
    x0, x1 = max(int(np.floor(x[0])), 0), min(int(np.ceil(x[1])), width)
    y0, y1 = max(int(np.floor(y[0])), 0), min(int(np.ceil(y[1])), height)
    if x0 < x1 and y0 < y1:
        axes.imshow(image[y0:y1, x0:x1], extent=(x0, x1, y1, y0), interpolation="lanczos")
    axes.set(xlim=x, ylim=(y[1], y[0]), aspect="equal")


def draw_overlay(
    axes: Axes, image: UInt8[np.ndarray, "h w 3"], observations: ObjectPosteriors, intrinsics: Float[np.ndarray, " 4"]
) -> None:
    """Image with boxes, projected 3D boxes, axes, position ellipses and labels."""
    from matplotlib.patches import Rectangle

    show_part(axes, image, (0, image.shape[1]), (0, image.shape[0]))
    plain(axes)
    for i, category in enumerate(observations.category):
        colour = category_colour(category, observations.categories)
        x0, y0, x1, y1 = observations.box[i]
        axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor=colour, linewidth=1.8, zorder=4))
        R_camera_object, position = object_axes(observations, i)
        draw_box3d(axes, R_camera_object, position, observations.size[i], intrinsics, colour)
        draw_frame(axes, R_camera_object, position, 0.4 * observations.diagonal[i], intrinsics)
        outline = pixel_ellipse(position, observations.position_covariance[i], intrinsics)
        if outline is not None:
            axes.plot(*outline.T, color="white", linewidth=1.0, zorder=4.5)
    if not len(observations):
        axes.text(
            0.5,
            0.5,
            "no object found",
            transform=axes.transAxes,
            ha="center",
            va="center",
            fontsize=12,
            color="white",
            bbox={"boxstyle": "round,pad=0.4", "facecolor": "black", "alpha": 0.55, "linewidth": 0},
        )
    place_labels(axes, observations)


def place_labels(axes: Axes, observations: ObjectPosteriors) -> list[Text]:
    """Write number, category, its probability and objectness at each box, where no other label is.

    A label goes above its box, below it, or inside, whichever comes first that is inside the image and free; when none
    is, downwards from the box until it is free.
    """
    figure = axes.figure
    renderer = figure.canvas.get_renderer()  # type: ignore[attr-defined]
    axes.apply_aspect()
    inside = axes.get_window_extent(renderer)
    taken: list[Any] = []
    texts = []
    for i, category in enumerate(observations.category):
        colour = category_colour(category, observations.categories)
        label = observations.categories.index(category)
        text = axes.text(
            0,
            0,
            f"{i + 1} {category} {observations.class_posterior[i, label]:.2f} · {observations.objectness[i]:.2f}",
            fontsize=7,
            color="white",
            zorder=10,
            va="bottom",
            ha="left",
            bbox={"boxstyle": "square,pad=0.22", "facecolor": colour, "alpha": 0.92, "linewidth": 0},
        )
        texts.append(text)
        patch = text.get_bbox_patch()
        assert patch is not None
        for x, y in _positions(axes, observations.box[i], text.get_window_extent(renderer), inside):
            text.set_position((x, y))
            text.update_bbox_position_size(renderer)
            extent = patch.get_window_extent(renderer)
            within = extent.x0 >= inside.x0 - 1 and extent.x1 <= inside.x1 + 1
            within = within and extent.y0 >= inside.y0 - 1 and extent.y1 <= inside.y1 + 1
            if within and not any(extent.overlaps(other) for other in taken):
                break
        taken.append(patch.get_window_extent(renderer))
    return texts


def _positions(axes: Axes, box: Float[np.ndarray, " 4"], extent: Any, inside: Any) -> list[tuple[float, float]]:
    """Places for a label's lower left corner in data coordinates, best first."""
    pixels = axes.transData.transform([(box[0], box[1]), (box[2], box[3])])
    (left, top), (right, bottom) = pixels
    wide, high, gap = extent.width + 8, extent.height + 8, 4.0
    places = []
    for y in (top + gap, bottom - high, top - high, bottom + gap):
        for x in (left, right - wide, (left + right - wide) / 2):
            places.append((x, y))
    places += [(x, top - k * high) for k in range(2, 40) for x in (left, right - wide)]
    places += [(inside.x0 + 4, inside.y1 - k * high) for k in range(1, 40)]
    low, high_limit = inside.x0 + 4, inside.x1 - wide
    data = axes.transData.inverted().transform([(min(max(x, low), high_limit), y) for x, y in places])
    return [(float(x), float(y)) for x, y in data]
