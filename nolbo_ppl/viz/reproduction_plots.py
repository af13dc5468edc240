"""Pictures of a reproduction: curves of precision and recall, and maps of latent spaces."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.viz.style import category_colour, grid, new_figure, plain, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMNS = 4
"""Maps side by side."""


def draw_reconstruction_curves(curves: Mapping[str, tuple[Float[np.ndarray, " t"], Float[np.ndarray, " t"]]]) -> Figure:
    """Precision against recall of 3D reconstruction, a curve a network.

    Args:
        curves: recall and precision by the network's name.
    """
    with styled():
        figure = new_figure(4.2, 3.4)
        axes = figure.add_subplot()
        for name, (recall, precision) in curves.items():
            axes.plot(recall, precision, label=name, linewidth=1.2)
        axes.set(xlabel="recall", ylabel="precision", xlim=(0, 1), ylim=(0, 1.02), title="3D reconstruction at true boxes")
        grid(axes)
        axes.legend(fontsize=6.5, frameon=False)
        figure.tight_layout()
    return figure


def draw_latent_maps(
    maps: Mapping[str, tuple[Float[np.ndarray, "n 2"], Int[np.ndarray, " n"]]], categories: Sequence[str]
) -> Figure:
    """Plane maps of latent spaces, a panel a network, points in the colours of their categories.

    Args:
        maps: points and labels by the network's name.
        categories: names of the labels.
    """
    rows = math.ceil(len(maps) / COLUMNS)
    shown = sorted({int(label) for _, labels in maps.values() for label in labels})
    with styled():
        figure = new_figure(2.3 * COLUMNS, 2.3 * rows + 0.5)
        for number, (name, (points, label)) in enumerate(maps.items()):
            axes = figure.add_subplot(rows, COLUMNS, number + 1)
            for one in shown:
                of = label == one
                colour = category_colour(categories[one], list(categories))
                axes.scatter(points[of, 0], points[of, 1], s=3, color=colour, linewidths=0, label=categories[one])
            axes.set_title(name)
            plain(axes)
        handles, names = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, names, loc="lower center", ncol=min(len(names), 6), fontsize=6.5, frameon=False, markerscale=2.5)
        figure.tight_layout(rect=(0, 0.5 / (2.3 * rows + 0.5), 1, 1))
    return figure
