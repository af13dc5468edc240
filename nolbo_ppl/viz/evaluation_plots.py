"""Plots of an evaluation: precision and recall, reliability and coverage, confusion, viewpoint errors."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from nolbo_ppl.evaluation.records import DetectionRecords, ObjectRecords
from nolbo_ppl.evaluation.retrieval import SCORES, RetrievalRecords
from nolbo_ppl.evaluation.scores import confusion, judged
from nolbo_ppl.metrics.calibration import Reliability, reliability, top_label
from nolbo_ppl.metrics.detection import Matches, average_precision, precision_recall
from nolbo_ppl.metrics.intervals import wilson_interval
from nolbo_ppl.metrics.viewpoint_error import ACCURATE
from nolbo_ppl.viz.style import INK, MUTED, category_colour, grid, new_figure, save, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

REGIONS = {
    "azimuth": ("azimuth_mass", "#4e79a7"),
    "elevation, in-plane": ("tilt_mass", "#76b7b2"),
    "position": ("position_mass", "#e15759"),
    "shape latent": ("latent_mass", "#b07aa1"),
}
"""Posterior regions whose coverage is drawn: the field of the records, the colour."""


def write_plots(
    objects: ObjectRecords,
    detections: DetectionRecords,
    categories: Sequence[str],
    symmetry: Sequence[int],
    out: str | PathLike[str],
    retrieval: RetrievalRecords | None = None,
) -> list[Path]:
    """Write every plot as a PNG into a folder and return their paths."""
    figures = {
        "precision_recall.png": draw_precision_recall(detections, categories),
        "reliability.png": draw_reliability(objects, detections),
        "confusion.png": draw_confusion(objects, categories),
        "viewpoint.png": draw_viewpoint(objects, categories, symmetry),
    }
    if retrieval is not None:
        figures["retrieval.png"] = draw_retrieval(retrieval, categories)
    paths = []
    for name, figure in figures.items():
        paths.append(Path(out) / name)
        save(figure, paths[-1])
    return paths


def draw_precision_recall(detections: DetectionRecords, categories: Sequence[str]) -> Figure:
    """Precision against recall: every detection by objectness, and each category by its own score."""
    with styled():
        figure = new_figure(10.5, 4.6)
        left, right = figure.subplots(1, 2)
        _curve(left, detections.all, "any category", INK, 2.0)
        for name, matches in zip(categories, detections.by_category):
            _curve(right, matches, name, category_colour(name, tuple(categories)), 1.3)
        for axes, title in ((left, "detection, IoU 0.5"), (right, "detection and category, IoU 0.5")):
            axes.set(xlim=(0, 1.01), ylim=(0, 1.02), xlabel="recall", ylabel="precision", title=title)
            grid(axes)
        left.legend(loc="lower left")
        right.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), title="average precision")
        figure.subplots_adjust(left=0.06, right=0.85, bottom=0.11, top=0.92, wspace=0.2)
    return figure


def _curve(axes: Axes, matches: Matches, name: str, colour: str, width: float) -> None:
    if not matches.truths.sum():
        return
    pr = precision_recall(matches)
    if not len(pr.recall):
        return
    # The envelope: the largest precision at that or any higher recall, whose area is the average precision.
    envelope = np.maximum.accumulate(pr.precision[::-1])[::-1]
    label = f"{name}  {average_precision(matches)[0]:.3f}"
    recall = np.concatenate(([0.0], pr.recall, pr.recall[-1:]))
    height = np.concatenate((envelope[:1], envelope, [0.0]))
    axes.step(recall, height, where="pre", color=colour, linewidth=width, label=label)


def draw_reliability(objects: ObjectRecords, detections: DetectionRecords) -> Figure:
    """Stated probability against frequency for objectness and class, and the coverage of posterior regions."""
    kept = judged(detections.all)
    labelled = objects.category >= 0
    confidence, right = top_label(objects.class_posterior[labelled], objects.category[labelled])
    with styled():
        figure = new_figure(12.0, 4.3)
        axes = figure.subplots(1, 3)
        _diagram(axes[0], reliability(detections.all.score[kept], detections.all.correct[kept]), "objectness")
        _diagram(axes[1], reliability(confidence, right), "category (top label)")
        _coverage(axes[2], objects)
        figure.subplots_adjust(left=0.05, right=0.985, bottom=0.13, top=0.91, wspace=0.22)
    return figure


def _diagram(axes: Axes, diagram: Reliability, title: str) -> None:
    """Frequency by stated probability with Wilson intervals; bars show the share of cases in each bin."""
    used = diagram.count > 0
    width = diagram.edges[1] - diagram.edges[0]
    middle = (diagram.edges[:-1] + diagram.edges[1:])[used] / 2
    axes.plot([0, 1], [0, 1], color=MUTED, linewidth=0.9, linestyle=(0, (4, 3)), zorder=1)
    share = diagram.count[used] / max(diagram.count.sum(), 1)
    axes.bar(middle, share, width * 0.92, color="#dbe3ec", zorder=0.5, label="share of all")
    frequency, count = diagram.frequency[used], diagram.count[used]
    limits = np.array([wilson_interval(float(f * n), int(n)) for f, n in zip(frequency, count)]).reshape(-1, 2)
    axes.errorbar(
        diagram.confidence[used],
        frequency,
        np.abs(limits.T - frequency),
        fmt="o",
        color="#2f6fde",
        markersize=4.5,
        elinewidth=1.0,
        capsize=2,
        zorder=3,
        label="frequency, 95 %",
    )
    error = np.nansum(np.abs(diagram.frequency - diagram.confidence) * diagram.count) / max(diagram.count.sum(), 1)
    axes.set(xlim=(0, 1), ylim=(0, 1.03), xlabel="stated probability", ylabel="frequency")
    axes.set_title(f"{title}: ECE {error:.3f}")
    axes.legend(loc="upper left")
    grid(axes)


def _coverage(axes: Axes, objects: ObjectRecords) -> None:
    """Share of truths inside each posterior region against the region's probability."""
    level = np.linspace(0, 1, 101)
    axes.plot([0, 1], [0, 1], color=MUTED, linewidth=0.9, linestyle=(0, (4, 3)))
    axes.axvline(0.9, color=MUTED, linewidth=0.7)
    for name, (field, colour) in REGIONS.items():
        mass: Float[np.ndarray, " n"] = getattr(objects, field)
        mass = np.sort(mass[np.isfinite(mass)])
        if len(mass):
            inside = np.searchsorted(mass, level, side="right") / len(mass)
            at_90 = np.searchsorted(mass, 0.9, side="right") / len(mass)
            axes.plot(level, inside, color=colour, linewidth=1.6, label=f"{name}  {at_90:.2f} in 90 %")
    axes.set(xlim=(0, 1), ylim=(0, 1.03), xlabel="probability of the region", ylabel="truths inside", title="coverage")
    axes.legend(loc="lower right")
    grid(axes)


def draw_confusion(objects: ObjectRecords, categories: Sequence[str]) -> Figure:
    """Confusion of the maximum-likelihood category: shares of each true category, counts written in the cells."""
    counts = confusion(objects, len(categories))
    share = counts / np.maximum(counts.sum(1, keepdims=True), 1)
    with styled():
        figure = new_figure(1.6 + 0.5 * len(categories), 1.3 + 0.46 * len(categories))
        axes = figure.subplots()
        axes.imshow(share, cmap="Blues", vmin=0, vmax=1)
        for i, j in zip(*np.nonzero(counts)):
            colour = "white" if share[i, j] > 0.55 else INK
            axes.text(j, i, str(counts[i, j]), ha="center", va="center", fontsize=7, color=colour)
        ticks = np.arange(len(categories))
        axes.set_xticks(ticks, categories, rotation=45, ha="right")
        axes.set_yticks(ticks, categories)
        accuracy = np.trace(counts) / max(counts.sum(), 1)
        axes.set(xlabel="maximum likelihood", ylabel="true", title=f"category at the true boxes: {accuracy:.3f} right")
        axes.tick_params(length=0)
        figure.subplots_adjust(left=0.16, right=0.98, bottom=0.17, top=0.94)
    return figure


def draw_viewpoint(objects: ObjectRecords, categories: Sequence[str], symmetry: Sequence[int]) -> Figure:
    """Errors of the viewpoint: cumulative, signed azimuth (front taken for back shows at 180), and by category."""
    plain = np.isin(objects.category, np.flatnonzero(np.asarray(symmetry) == 1))
    error = np.degrees(objects.rotation_error)
    with styled():
        figure = new_figure(13.5, 4.3)
        axes = figure.subplots(1, 3, width_ratios=(1, 1, 1.25))
        _cumulative(axes[0], error[plain & np.isfinite(error)])
        azimuth = np.degrees(objects.azimuth_error)
        azimuth = azimuth[plain & np.isfinite(azimuth)]
        axes[1].hist(azimuth, bins=np.arange(-180, 181, 6), color="#4e79a7")
        axes[1].set(xlim=(-180, 180), xticks=np.arange(-180, 181, 60), xlabel="azimuth error, degrees")
        axes[1].set(yscale="symlog", ylabel="objects", title="signed azimuth error")
        axes[1].yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        grid(axes[1], "y")
        _by_category(axes[2], objects, error, categories, symmetry)
        figure.subplots_adjust(left=0.045, right=0.985, bottom=0.19, top=0.91, wspace=0.2)
    return figure


def _cumulative(axes: Axes, error: Float[np.ndarray, " n"]) -> None:
    """Share of viewpoints within an error."""
    limit = np.degrees(ACCURATE)
    if len(error):
        share = np.arange(1, len(error) + 1) / len(error)
        axes.step(np.sort(error), share, where="post", color="#2f6fde", linewidth=1.8)
        within = float((error < limit).mean())
        axes.plot([limit, limit], [0, within], color=MUTED, linewidth=0.9)
        words = f"{within:.3f} within 30°\nmedian {np.median(error):.1f}°"
        axes.text(limit * 1.08, 0.06, words, fontsize=8, va="bottom")
    axes.set(xscale="log", xlim=(0.8, 180), ylim=(0, 1.02), xlabel="geodesic error, degrees", ylabel="share of objects")
    axes.set_xticks([1, 3, 10, 30, 90, 180], ["1", "3", "10", "30", "90", "180"])
    axes.set_xticks([], minor=True)
    axes.set_title("viewpoint, categories without symmetry")
    grid(axes)


def _by_category(
    axes: Axes,
    objects: ObjectRecords,
    error: Float[np.ndarray, " n"],
    categories: Sequence[str],
    symmetry: Sequence[int],
) -> None:
    """Boxes of the errors of each category: median, middle half, 5 to 95 %."""
    for k, name in enumerate(categories):
        own = error[(objects.category == k) & np.isfinite(error)]
        if len(own):
            box = axes.boxplot(
                np.maximum(own, 0.3),
                positions=[k],
                widths=0.6,
                whis=(5, 95),
                showfliers=False,
                patch_artist=True,
                medianprops={"color": INK, "linewidth": 1.4},
            )
            box["boxes"][0].set(facecolor=category_colour(name, tuple(categories)), alpha=0.65, linewidth=0.7)
    names = [name if order == 1 else f"{name} *" for name, order in zip(categories, symmetry)]
    axes.set_xticks(np.arange(len(categories)), names, rotation=40, ha="right")
    axes.axhline(np.degrees(ACCURATE), color=MUTED, linewidth=0.9)
    axes.set(yscale="log", ylim=(0.3, 200), ylabel="geodesic error, degrees")
    axes.set_yticks([1, 3, 10, 30, 90, 180], ["1", "3", "10", "30", "90", "180"])
    axes.set_yticks([], minor=True)
    axes.set_title("by category (* up to the declared symmetry)")
    grid(axes, "y")


def draw_retrieval(records: RetrievalRecords, categories: Sequence[str]) -> Figure:
    """Recall against the number of places looked at, by score; recall at the first place by category."""
    with styled():
        figure = new_figure(11.0, 4.2)
        left, right = figure.subplots(1, 2, width_ratios=(1, 1.4))
        places = np.arange(1, int(records.gallery.max()) + 1)
        for name, colour in zip(SCORES, ("#2f6fde", "#76b7b2", "#e15759")):
            recall = (records.rank[name].reshape(-1)[:, None] <= places).mean(0)
            left.step(places, recall, where="post", color=colour, linewidth=1.6, label=f"{name}  {recall[0]:.3f}")
        chance = (places / records.gallery[:, None]).clip(max=1).mean(0)
        left.plot(places, chance, color=MUTED, linewidth=0.9, linestyle=(0, (4, 3)), label=f"chance  {chance[0]:.3f}")
        left.set(xscale="log", ylim=(0, 1.02), xlabel="first places looked at", ylabel="recall", title="same instance found")
        left.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        left.legend(loc="upper left", title="at the first place")
        grid(left)
        known = [label for label in range(len(categories)) if (records.category == label).any()]
        for place, label in enumerate(known):
            rows = records.category == label
            first = (records.rank["evidence"][rows] == 1).mean(1)
            low, high = wilson_interval(float(first.sum()), len(first))
            colour = category_colour(categories[label], tuple(categories))
            right.bar(place, first.mean(), 0.7, color=colour, alpha=0.75)
            right.errorbar(
                place, first.mean(), [[first.mean() - low], [high - first.mean()]], color=INK, elinewidth=1.0, capsize=2
            )
            right.plot([place - 0.4, place + 0.4], [float((1 / records.gallery[rows]).mean())] * 2, color=MUTED, linewidth=0.9)
        right.set_xticks(range(len(known)), [categories[label] for label in known], rotation=40, ha="right")
        right.set(ylim=(0, 1.02), ylabel="recall at the first place", title="by category (evidence ratio; line: chance)")
        grid(right, "y")
        figure.subplots_adjust(left=0.06, right=0.985, bottom=0.19, top=0.91, wspace=0.16)
    return figure
