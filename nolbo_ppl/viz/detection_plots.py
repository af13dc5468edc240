"""What a model finds in whole images, beside what is there: the scenes answered best, at the median and worst."""

from __future__ import annotations

from os import PathLike
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.metrics.detection import Matches
from nolbo_ppl.structures.annotations import Annotations
from nolbo_ppl.structures.object_posteriors import ObjectPosteriors
from nolbo_ppl.viz.overlay import show_part
from nolbo_ppl.viz.style import MUTED, category_colour, new_figure, plain, save, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from nolbo_ppl.evaluation.labelled_scenes import Scenes

SHOWN = 0.3
"""Least objectness of a detection that is drawn and counted."""
AREA = 26.0
"""Square inches of the picture of a scene's row."""


@runtime_checkable
class DetectionModel(Protocol):
    """What the pictures need of a model (`nolbo_ppl.inference.posterior.predictor.ObservationModel`)."""

    def observe(self, images: Any, intrinsics: Any, *, threshold: float, decode: bool) -> list[ObjectPosteriors]:
        """Posterior of every object of each image."""


def mistakes(found: Matches, threshold: float = SHOWN) -> Int[np.ndarray, " scenes"]:
    """Objects missed and things found that are none, of each scene, by the detections of at least that objectness."""
    scenes, sure = len(found.truths), found.score >= threshold
    right = np.bincount(found.scene[sure & found.correct], minlength=scenes)
    wrong = np.bincount(found.scene[sure & ~found.correct & ~found.ignored], minlength=scenes)
    return found.truths - right + wrong


def choose_scenes(found: Matches, each: int) -> dict[str, list[int]]:
    """The best, the median and the worst scenes that hold something to find, those with more to find first among equals."""
    held = np.flatnonzero(found.truths > 0)
    order = held[np.lexsort((-found.truths[held], mistakes(found)[held]))]
    each = max(1, min(each, len(order) // 3))
    start = max(0, (len(order) - each) // 2)
    chosen = {"best": order[:each], "median": order[start : start + each], "worst": order[::-1][:each]}
    return {name: [int(row) for row in rows] for name, rows in chosen.items()}


def write_detections(found: Matches, scenes: Scenes, model: DetectionModel, path: str | PathLike[str]) -> Figure | None:
    """Draw scenes with the detections of some objectness, the true boxes dashed, regions that are not judged hatched.

    Returns:
        The figure; None, and no file, when no scene holds anything to find.
    """
    if not found.truths.sum():
        return None
    height, width = scenes[int(np.flatnonzero(found.truths)[0])].image.shape[:2]
    each = 4 if width < 1.5 * height else 1
    chosen = choose_scenes(found, each)
    columns = max(len(rows) for rows in chosen.values())
    side = (AREA / columns * height / width) ** 0.5
    with styled():
        figure = new_figure(columns * side * width / height + 0.3, 3 * (side + 0.3) + 0.2)
        axes = figure.subplots(3, columns, squeeze=False)
        words = f"Found with an objectness of at least {SHOWN} in colour, true boxes dashed, not judged hatched."
        figure.text(0.012, 0.995, words, fontsize=8, va="top")
        for row, (name, rows) in zip(axes, chosen.items()):
            for place in row:
                plain(place)
            for place, index in zip(row, rows):
                scene = scenes[index]
                answer = model.observe([scene.image], scene.intrinsics[None], threshold=SHOWN, decode=False)[0]
                _draw(place, scene, answer)
                wrong = int(mistakes(found)[index])
                place.set_title(f"{name}: {int(found.truths[index])} to find, {wrong} mistakes", fontsize=7.5)
        figure.subplots_adjust(left=0.01, right=0.99, bottom=0.01, top=0.94, wspace=0.04, hspace=0.14)
    save(figure, path)
    return figure


def _draw(axes: Axes, scene: Annotations, answer: ObjectPosteriors) -> None:
    """One scene."""
    height, width = scene.image.shape[:2]
    show_part(axes, scene.image, (0, width), (0, height))
    for box in scene.ignore:
        _rectangle(axes, box, edgecolor=MUTED, linewidth=0.6, hatch="////", zorder=3)
    for box in scene.box:
        _rectangle(axes, box, edgecolor="white", linewidth=1.1, linestyle=(0, (2.5, 1.5)), zorder=5)
    for i, box in enumerate(answer.box):
        label = int(answer.class_posterior[i].argmax())
        colour = category_colour(answer.categories[label], answer.categories)
        _rectangle(axes, box, edgecolor=colour, linewidth=1.6, zorder=4)
        axes.text(
            np.clip(box[0], 0, width),
            np.clip(box[1], 0, height),
            f"{answer.categories[label]} {answer.objectness[i]:.2f}",
            fontsize=5.5,
            color="white",
            va="bottom",
            zorder=6,
            clip_on=True,
            bbox={"boxstyle": "square,pad=0.15", "facecolor": colour, "alpha": 0.9, "linewidth": 0},
        )


def _rectangle(axes: Axes, box: Float[np.ndarray, " 4"], **style: Any) -> None:
    from matplotlib.patches import Rectangle

    axes.add_patch(Rectangle((box[0], box[1]), box[2] - box[0], box[3] - box[1], fill=False, clip_on=True, **style))
