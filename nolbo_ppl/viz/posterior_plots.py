"""The picture of one image's posterior: what was found drawn over the image, and a row of distributions an object."""

from __future__ import annotations

from os import PathLike
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8

from nolbo_ppl.errors import input_error
from nolbo_ppl.structures.object_posteriors import ObjectPosteriors
from nolbo_ppl.viz.overlay import draw_box3d, draw_frame, draw_overlay, object_axes, show_part
from nolbo_ppl.viz.panels import draw_azimuth, draw_classes, draw_latent, draw_position, draw_range
from nolbo_ppl.viz.shape_plots import draw_shape, draw_uncertainty
from nolbo_ppl.viz.style import AXIS_COLOURS, INK, MUTED, category_colour, new_figure, plain, save, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import GridSpec

WIDTH = 13.0
"""Width of the picture, inches."""
ROW = 1.85
"""Height of an object's row, inches."""
HEADER = 0.32
"""Height of the line above each row, inches."""
TOP = 5.6
"""Height of the image, inches."""


def draw_observations(
    image: UInt8[np.ndarray, "h w 3"],
    observations: ObjectPosteriors,
    intrinsics: Float[np.ndarray, " 4"],
    *,
    prior_mean: Float[np.ndarray, "labels d"] | None = None,
    objects: int = 6,
    title: str | None = None,
    path: str | PathLike[str] | None = None,
) -> Figure:
    """Draw an image with everything the posterior says about its objects.

    Above, the image with boxes, categories, projected 3D boxes and object axes, beside it where the objects are
    (bearing and distance with 90 % regions). Below, a row for each object: close-up, class posterior, azimuth density,
    position, mean shape seen from the estimated viewpoint, scale of its voxels, shape latent.

    Args:
        image: the image.
        observations: its objects.
        intrinsics: [fx, fy, cx, cy] of the image, px.
        prior_mean: mean latent of each category, drawn behind the latent.
        objects: most objects that get a row, the most certain ones.
        title: line above the picture.
        path: where to write the picture, if anywhere.

    Raises:
        InputError: the image is not a uint8 colour image.
    """
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise input_error("an image to draw on", got=(image.shape, image.dtype), expected="(height, width, 3) uint8")
    intrinsics = np.asarray(intrinsics, dtype=np.float64)
    order = np.argsort(-observations.objectness, kind="stable")[:objects]
    with styled():
        head = 0.45 if title else 0.15
        height = head + TOP + 0.35 + len(order) * (ROW + HEADER)
        figure = new_figure(WIDTH, height)
        if title:
            figure.text(0.02, 1 - 0.22 / height, title, fontsize=11, fontweight="bold", va="center")
        place = figure.add_gridspec(
            1,
            2,
            left=0.02,
            right=0.985,
            top=1 - head / height,
            bottom=1 - (head + TOP - 0.25) / height,
            wspace=0.12,
            width_ratios=_widths(image),
        )
        draw_overlay(figure.add_subplot(place[0]), image, observations, intrinsics)
        _draw_legend(figure, 1 - (head + TOP - 0.1) / height)
        draw_range(figure.add_subplot(place[1]), observations)
        for row, index in enumerate(order):
            top = head + TOP + 0.35 + row * (ROW + HEADER)
            _draw_row(figure, top, height, image, observations, int(index), intrinsics, prior_mean)
        hidden = len(observations) - len(order)
        if hidden > 0:
            figure.text(0.985, 0.004, f"{hidden} more not shown", ha="right", va="bottom", fontsize=7, color=MUTED)
    if path is not None:
        save(figure, path)
    return figure


def _widths(image: UInt8[np.ndarray, "h w 3"]) -> tuple[float, float]:
    """Shares of the image and of the view from above."""
    wide = min(TOP * image.shape[1] / image.shape[0], 0.66 * WIDTH)
    return wide, WIDTH - wide - 0.8


def _draw_legend(figure: Figure, y: float) -> None:
    """What the colours and numbers over the image mean."""
    x = 0.02
    figure.text(x, y, "label: category, its probability · objectness", fontsize=7, color=MUTED, va="center")
    words = ("right", "front", "up", "white: 90 % region of the centre")
    for text, colour, step in zip(words, (*AXIS_COLOURS, MUTED), (0.205, 0.035, 0.037, 0.03)):
        x += step
        figure.text(x, y, text, fontsize=7, color=colour, va="center", fontweight="bold" if colour != MUTED else None)


def _draw_row(
    figure: Figure,
    top: float,
    height: float,
    image: UInt8[np.ndarray, "h w 3"],
    observations: ObjectPosteriors,
    index: int,
    intrinsics: Float[np.ndarray, " 4"],
    prior_mean: Float[np.ndarray, "labels d"] | None,
) -> None:
    """The distributions of one object."""
    colour = category_colour(observations.category[index], observations.categories)
    line = 1 - (top + 0.12) / height
    extents = " × ".join(f"{side:.2f}" for side in observations.size[index])
    name = f"{index + 1}  {observations.category[index]}"
    figure.text(0.02, line, name, fontsize=9.5, fontweight="bold", color=colour, va="center")
    facts = f"objectness {observations.objectness[index]:.3f}     size {extents} m"
    figure.text(0.15, line, facts, fontsize=8, color=INK, va="center")
    grid: GridSpec = figure.add_gridspec(
        1,
        7,
        left=0.02,
        right=0.985,
        top=1 - (top + HEADER + 0.1) / height,
        bottom=1 - (top + HEADER + ROW - 0.35) / height,
        wspace=0.2,
        width_ratios=(1.0, 1.1, 1.2, 1.1, 1.0, 1.0, 1.35),
    )
    _draw_closeup(figure.add_subplot(grid[0]), image, observations, index, intrinsics, colour)
    draw_classes(figure.add_subplot(grid[1]), observations, index)
    draw_azimuth(figure.add_subplot(grid[2]), observations, index, colour)
    draw_position(figure.add_subplot(grid[3]), observations, index, colour)
    if observations.voxel_mean is not None and observations.voxel_variance is not None:
        viewpoint = observations.viewpoint[index]
        mean, variance = observations.voxel_mean[index], observations.voxel_variance[index]
        _titled(draw_shape(figure, grid[4], mean, colour, viewpoint), "shape, mean")
        _titled(draw_uncertainty(figure, grid[5], mean, variance, viewpoint), "voxels, std")
    draw_latent(figure.add_subplot(grid[6]), observations, index, colour, prior_mean)


def _titled(axes: Axes, title: str) -> None:
    axes.text2D(0.5, 1.04, title, transform=axes.transAxes, ha="center", va="bottom", fontsize=8.5, fontweight="bold")  # type: ignore[attr-defined]


def _draw_closeup(
    axes: Axes,
    image: UInt8[np.ndarray, "h w 3"],
    observations: ObjectPosteriors,
    index: int,
    intrinsics: Float[np.ndarray, " 4"],
    colour: str,
) -> None:
    """The object cut out of the image, with its 3D box and axes."""
    x0, y0, x1, y1 = observations.box[index]
    half = 0.62 * max(x1 - x0, y1 - y0, 4.0)
    centre = ((x0 + x1) / 2, (y0 + y1) / 2)
    axes.set_facecolor("#e9ecef")
    show_part(axes, image, (centre[0] - half, centre[0] + half), (centre[1] - half, centre[1] + half))
    draw_box3d(axes, *object_axes(observations, index), observations.size[index], intrinsics, colour)
    draw_frame(axes, *object_axes(observations, index), 0.5 * observations.diagonal[index], intrinsics)
    axes.set_title("close-up")
    plain(axes)
