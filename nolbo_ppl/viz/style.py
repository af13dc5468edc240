"""Look of all pictures: colours of categories, fonts, figures without pyplot, atomic saving."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from typing import TYPE_CHECKING, Any

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.io.files import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 150
"""Resolution of written pictures."""
INK = "#22262b"
"""Text and frames."""
MUTED = "#8a929b"
"""Secondary text and grid lines."""
TRUTH = "#111111"
"""What is true, beside coloured estimates."""
AXIS_COLOURS = ("#d1495b", "#2e9e5b", "#2f6fde")
"""Object axes: right (x), front (-y), up (z)."""

_PALETTE = (
    "#4e79a7",
    "#f28e2b",
    "#59a14f",
    "#76b7b2",
    "#e15759",
    "#b07aa1",
    "#9c755f",
    "#d4a514",
    "#d37295",
    "#499894",
    "#6b4c9a",
    "#79706e",
)

_RC: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8.0,
    "axes.titlesize": 8.5,
    "axes.titleweight": "bold",
    "axes.titlepad": 5.0,
    "axes.labelsize": 7.5,
    "axes.labelcolor": INK,
    "axes.edgecolor": MUTED,
    "text.color": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.titlecolor": INK,
    "grid.color": "#d9dde1",
    "grid.linewidth": 0.6,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "xtick.minor.size": 1.5,
    "ytick.minor.size": 1.5,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "lines.solid_capstyle": "round",
}


@contextmanager
def styled() -> Iterator[None]:
    """Draw with the library's style; matplotlib's own settings come back afterwards."""
    import matplotlib

    with matplotlib.rc_context(_RC):  # type: ignore[arg-type]
        yield


def category_colour(category: str, categories: tuple[str, ...] | list[str] = CATEGORIES) -> str:
    """Colour of a category: the twelve known ones always have the same, others by their place in the list."""
    names = CATEGORIES if category in CATEGORIES else tuple(categories)
    return _PALETTE[names.index(category) % len(_PALETTE)] if category in names else MUTED


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of that size in inches with an Agg canvas, unknown to pyplot."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=DPI)
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, path: str | PathLike[str]) -> None:
    """Write a figure as a picture, atomically; the format is that of the suffix."""
    with styled(), atomic_path(path) as temporary:
        png: dict[str, Any] = {"pil_kwargs": {"compress_level": 4}} if temporary.suffix == ".png" else {}
        figure.savefig(temporary, dpi=DPI, **png)


def grid(axes: Axes, axis: str = "both") -> None:
    """Faint grid lines."""
    axes.grid(True, axis=axis)  # type: ignore[arg-type]


def plain(axes: Axes) -> None:
    """No frame and no ticks."""
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
