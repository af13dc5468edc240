"""Examples of an evaluation: objects answered best, at the median and worst, each beside its truth."""

from __future__ import annotations

from os import PathLike
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.errors import input_error
from nolbo_ppl.evaluation.records import ObjectRecords
from nolbo_ppl.geometry.voxels import unpack_voxels
from nolbo_ppl.structures.object_posteriors import ObjectPosteriors
from nolbo_ppl.viz.overlay import draw_frame, show_part
from nolbo_ppl.viz.shape_plots import draw_shape
from nolbo_ppl.viz.style import MUTED, TRUTH, category_colour, new_figure, plain, save, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec

    from nolbo_ppl.evaluation.labelled_scenes import Scenes

COLUMNS = 5
"""Examples of each kind."""
TRUE_AXES = ("white", "white", "white")
"""Colour of the true axes, drawn dashed."""


@runtime_checkable
class RegionModel(Protocol):
    """What examples need of a model (`nolbo_ppl.inference.posterior.predictor.ObservationModel`)."""

    def observe_boxes(self, images: Any, intrinsics: Any, boxes: Any) -> list[ObjectPosteriors]:
        """Posterior of the region responsible for each given box."""


def badness(objects: ObjectRecords) -> Float[np.ndarray, " n"]:
    """How wrong each answer is, from 0 to 3: viewpoint (1 at a half turn), shape (1 - IoU), category (0 or 1).

    What is unlabelled adds nothing.
    """
    turn = np.nan_to_num(objects.rotation_error / np.pi)
    shape = np.nan_to_num(1 - objects.voxel_iou)
    return turn + shape + ((objects.category >= 0) & (objects.likeliest != objects.category))


def choose(objects: ObjectRecords, columns: int = COLUMNS) -> dict[str, Int[np.ndarray, " k"]]:
    """Rows of the best, the median and the worst objects, of as many categories as possible."""
    order = np.argsort(badness(objects), kind="stable")
    middle = order[np.argsort(np.abs(np.arange(len(order)) - (len(order) - 1) / 2), kind="stable")]
    return {
        name: _varied(rows, objects.category, columns)
        for name, rows in (("best", order), ("median", middle), ("worst", order[::-1]))
    }


def _varied(rows: Int[np.ndarray, " n"], category: Int[np.ndarray, " n"], count: int) -> Int[np.ndarray, " k"]:
    """The first rows of different categories, in order; then further ones, until there are enough."""
    chosen: list[int] = []
    seen: set[int] = set()
    for row in rows:
        if len(chosen) < count and int(category[row]) not in seen:
            chosen.append(int(row))
            seen.add(int(category[row]))
    chosen += [int(row) for row in rows if int(row) not in chosen][: count - len(chosen)]
    return np.array(sorted(chosen, key=lambda row: int(np.flatnonzero(rows == row)[0])), dtype=np.int64)


def write_examples(objects: ObjectRecords, scenes: Scenes, model: RegionModel, path: str | PathLike[str]) -> Figure:
    """Draw the best, median and worst objects: close-up with estimated and true axes, estimated and true shape.

    Raises:
        InputError: there is no object.
    """
    if not len(objects):
        raise input_error("examples of nothing", got="0 objects", expected="at least one")
    chosen = choose(objects)
    with styled():
        columns = max(len(rows) for rows in chosen.values())
        figure = new_figure(2.7 * columns + 0.3, 3 * 3.15 + 0.45)
        figure.text(0.012, 0.988, "Estimate in colour, truth in white (axes) and grey (shape).", fontsize=8, va="top")
        outer = figure.add_gridspec(3, columns, left=0.02, right=0.99, top=0.945, bottom=0.01, hspace=0.16, wspace=0.1)
        for i, (name, rows) in enumerate(chosen.items()):
            for j, row in enumerate(rows):
                _draw_example(figure, outer[i, j], objects, int(row), name, scenes, model)
    save(figure, path)
    return figure


def _draw_example(
    figure: Figure, place: SubplotSpec, objects: ObjectRecords, row: int, name: str, scenes: Scenes, model: RegionModel
) -> None:
    """One object: close-up above, shapes below, the figures as its title."""
    truth, slot = scenes[int(objects.scene[row])], int(objects.slot[row])
    answer = model.observe_boxes([truth.image], truth.intrinsics[None], [truth.box[slot : slot + 1]])[0]
    cells = place.subgridspec(2, 2, height_ratios=(1.25, 1), hspace=0.06, wspace=0.02)
    axes = figure.add_subplot(cells[0, :])
    categories = answer.categories
    said = categories[objects.likeliest[row]]
    colour = category_colour(said, categories)
    x0, y0, x1, y1 = truth.box[slot]
    half = 0.62 * max(x1 - x0, y1 - y0, 4.0)
    wide = 1.55 * half
    centre = ((x0 + x1) / 2, (y0 + y1) / 2)
    axes.set_facecolor("#e9ecef")
    show_part(axes, truth.image, (centre[0] - wide, centre[0] + wide), (centre[1] - half, centre[1] + half))
    if np.isfinite(truth.position[slot]).all() and np.isfinite(truth.R_camera_object[slot]).all():
        # At the true place and at a size that fills the box, so that only the directions differ.
        length = 0.7 * half * float(truth.position[slot, 2] / truth.intrinsics[:2].mean())
        draw_frame(axes, answer.R_camera_object[0], truth.position[slot], length, truth.intrinsics)
        draw_frame(
            axes,
            truth.R_camera_object[slot],
            truth.position[slot],
            length,
            truth.intrinsics,
            colours=TRUE_AXES,
            width=1.1,
            dashed=True,
        )
    plain(axes)
    label = int(objects.category[row])
    true = categories[label] if label >= 0 else "unlabelled"
    words = true if said == true else f"{true} as {said}"
    error, iou = np.degrees(objects.rotation_error[row]), objects.voxel_iou[row]
    numbers = [f"{error:.0f}°"] * bool(np.isfinite(error)) + [f"IoU {iou:.2f}"] * bool(np.isfinite(iou))
    axes.set_title(f"{name}: {words}", color=TRUTH if said == true else "#c0392b", pad=12)
    axes.text(0.5, 1.02, ", ".join(numbers), transform=axes.transAxes, ha="center", fontsize=7, color=MUTED)
    if answer.voxel_mean is not None:
        draw_shape(figure, cells[1, 0], answer.voxel_mean[0], colour, answer.viewpoint[0])
    if truth.voxels is not None and truth.voxels[slot].any():
        side = round((8 * truth.voxels.shape[1]) ** (1 / 3))
        grid = unpack_voxels(truth.voxels[slot], side)
        draw_shape(figure, cells[1, 1], grid.astype(np.float64), "#9aa3ab", answer.viewpoint[0])
