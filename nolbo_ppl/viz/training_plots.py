"""Curves of a training run from its `metrics.jsonl`: terms of the objective, the bound by term, held-out figures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nolbo_ppl.errors import input_error
from nolbo_ppl.io.files import read_jsonl
from nolbo_ppl.viz.style import INK, grid, new_figure, save, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FIGURES = ("box50", "category", "acc_pi6", "azimuth_in_90")
"""Held-out shares that are drawn together."""
_COLOURS = (
    "#4e79a7",
    "#f28e2b",
    "#59a14f",
    "#e15759",
    "#b07aa1",
    "#76b7b2",
    "#9c755f",
    "#d4a514",
    "#6b4c9a",
    "#79706e",
)


def read_metrics(path: str | PathLike[str]) -> list[dict[str, Any]]:
    """Rows of a run's metrics, with `total_step` counted over its stages in the order in which they appear.

    Args:
        path: the file, or the folder of the run.

    Raises:
        InputError: the file is missing, malformed or empty, or a row lacks `stage` or `step`; names file and line.
    """
    path = Path(path)
    path = path / "metrics.jsonl" if path.is_dir() else path
    rows, before, last, stage = [], 0, 0, None
    for line, row in read_jsonl(path):
        if not isinstance(row.get("stage"), str) or not isinstance(row.get("step"), int):
            raise input_error("a row of metrics", got=row, expected='"stage" and "step"', file=path, line=line)
        if row["stage"] != stage:
            stage, before = row["stage"], before + last
            last = 0
        last = max(last, row["step"])
        rows.append({**row, "total_step": before + row["step"]})
    if not rows:
        raise input_error("no metrics", expected="at least one row", file=path)
    return rows


def draw_training(path: str | PathLike[str], out: str | PathLike[str] | None = None) -> Figure:
    """Draw a run: each stage's weighted terms, the held-out bound by term, and held-out figures, over steps.

    Args:
        path: `metrics.jsonl`, or the folder of the run.
        out: where to write the picture, if anywhere.

    Raises:
        InputError: as `read_metrics`.
    """
    rows = read_metrics(path)
    stages = list(dict.fromkeys(row["stage"] for row in rows))
    panels: list[tuple[str, str, list[dict[str, Any]]]] = [
        (f"{stage}: terms of the loss, nats", "terms/", [row for row in rows if row["stage"] == stage]) for stage in stages
    ]
    held_out = [row for row in rows if "loss" not in row]
    if held_out:
        panels.append(("held out: bound by term, nats a scene", "bound/", held_out))
        panels.append(("held out: inclusive terms, nats a scene", "inclusive/", held_out))
    count = len(panels) + bool(held_out)
    columns = min(3, count)
    lines = -(-count // columns)
    with styled():
        figure = new_figure(5.2 * columns, 3.5 * lines + 0.1)
        axes = list(np.atleast_1d(figure.subplots(lines, columns)).ravel())
        for place, (title, prefix, chosen) in zip(axes, panels):
            _draw_terms(place, title, prefix, chosen)
        if held_out:
            _draw_figures(axes[len(panels)], held_out)
        for place in axes[count:]:
            place.set_axis_off()
        figure.tight_layout(pad=1.0, w_pad=2.0)
    if out is not None:
        save(figure, out)
    return figure


def _series(rows: Iterable[dict[str, Any]], key: str) -> tuple[list[int], list[float]]:
    points = [(row["total_step"], float(row[key])) for row in rows if isinstance(row.get(key), int | float)]
    return [x for x, _ in points], [y for _, y in points]


def _names(rows: Sequence[dict[str, Any]], prefix: str) -> list[str]:
    """Terms with that prefix in the order in which they first appear."""
    return list(dict.fromkeys(key for row in rows for key in row if key.startswith(prefix)))


def _draw_terms(axes: Axes, title: str, prefix: str, rows: Sequence[dict[str, Any]]) -> None:
    """A line for each term, and their sum in black; linear near zero, logarithmic beyond one nat."""
    total: dict[int, float] = {}
    for k, key in enumerate(_names(rows, prefix)):
        x, y = _series(rows, key)
        axes.plot(x, y, color=_COLOURS[k % len(_COLOURS)], linewidth=1.2, label=key.removeprefix(prefix))
        for step, value in zip(x, y):
            total[step] = total.get(step, 0.0) + value
    if total:
        axes.plot(list(total), list(total.values()), color=INK, linewidth=1.8, label="sum")
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.02), fontsize=6.5)
    axes.set_yscale("symlog", linthresh=1.0)
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set(xlabel="step", title=title)
    grid(axes)


def _draw_figures(axes: Axes, rows: Sequence[dict[str, Any]]) -> None:
    """Held-out shares over steps, and the median viewpoint error on its own scale."""
    for k, key in enumerate(FIGURES):
        x, y = _series(rows, key)
        if x:
            axes.plot(x, y, color=_COLOURS[k], linewidth=1.5, marker="o", markersize=2.5, label=key)
    axes.axhline(0.9, color="#c5cbd1", linewidth=0.8, linestyle=(0, (4, 3)))
    x, y = _series(rows, "med_err_deg")
    if x:
        right = axes.twinx()
        right.plot(x, y, color=INK, linewidth=1.2, linestyle=(0, (2, 1.5)))
        right.set(ylabel="median viewpoint error, degrees (dotted)", ylim=(0, None))
        right.spines["right"].set_visible(True)
    axes.set(ylim=(0, 1.02), xlabel="step", title="held out: figures")
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.14), ncols=len(FIGURES), fontsize=6.5, columnspacing=1.0)
    grid(axes)
