"""Association weights as a picture: landmarks down, observations across in the order of time."""

from __future__ import annotations

import json

import numpy as np
from jaxtyping import Float

from nolbo_ppl.io.run_folder import RunFolder
from nolbo_ppl.report.report_plots import colour_of
from nolbo_ppl.report.shape_thumbnails import data_uri
from nolbo_ppl.report.svg import element, escape
from nolbo_ppl.structures.association_table import AssociationTable
from nolbo_ppl.viz.style import MUTED

MOST_COLUMNS = 1000
"""More observations than this share columns; the largest weight of those that share one is shown."""
MOST_ROWS = 900
"""More landmarks than this share rows."""


def weight_grid(found: AssociationTable, landmarks: int) -> Float[np.ndarray, "m k"]:
    """Weights as a dense grid: a row for each landmark, then new objects, then background; neighbours share columns where there
    are too many.
    """
    columns = min(len(found), MOST_COLUMNS)
    column = np.arange(len(found)) * columns // max(len(found), 1)
    grid = np.zeros((landmarks + 2, columns))
    np.maximum.at(grid, (found.landmark, column[found.row]), found.weight)
    np.maximum.at(grid[landmarks], column, found.new)
    np.maximum.at(grid[landmarks + 1], column, found.background)
    return np.clip(grid, 0, 1)


def landmark_order(run: RunFolder, found: AssociationTable) -> list[int]:
    """Landmarks by the first observation that is theirs: time runs down as it runs across."""
    first = np.full(len(run.landmarks), len(found))
    strong = found.weight > 0.1
    np.minimum.at(first, found.landmark[strong], found.row[strong])
    return np.argsort(first, kind="stable").tolist()


def heat_map(run: RunFolder) -> str:
    """The picture with its labels; what a cell is, the page's script reads from `data-rows` and `data-columns`.

    The weight is the opacity of a cell, so that the picture suits light and dark pages alike.
    """
    found = run.associations_in_time
    assert found is not None
    order = landmark_order(run, found)[:MOST_ROWS]
    grid = weight_grid(found, len(run.landmarks))
    tail = [len(run.landmarks), len(run.landmarks) + 1]
    colours = [colour_of(run, run.landmarks[j]) for j in order] + ["#d9a514", MUTED]
    names = [run.landmarks[j].name for j in order] + ["new object", "background"]
    pixels = np.zeros((len(names), grid.shape[1], 4), dtype=np.uint8)
    pixels[..., :3] = np.array([[int(c[k : k + 2], 16) for k in (1, 3, 5)] for c in colours])[:, None]
    pixels[..., 3] = np.round(255 * np.sqrt(grid[order + tail]))  # the root lets small weights be seen
    step = len(found) / max(grid.shape[1], 1)
    first = np.floor(np.arange(grid.shape[1]) * step).astype(int)
    frames = None if found.frame is None else found.frame[first].tolist()
    height = int(np.clip(len(names) * 9, 180, 620))
    image = element(
        "img",
        src=data_uri(pixels),
        alt="Association weights",
        style=f"height:{height}px",
        class_="heat",
        data_rows=json.dumps(names),
        data_columns=json.dumps({"first": first.tolist(), "frame": frames}),
    )
    body = image.replace("/>", ">") + _frame_ticks(found, grid.shape[1])
    side = element("div", escape(f"{len(order)} landmarks, by first detection; then new, background"), class_="heat-side")
    return element("div", side + element("div", body, class_="heat-body"), class_="heat-map", tabindex=0)


def _frame_ticks(found: AssociationTable, columns: int) -> str:
    """Labels under the picture: frames, or numbers of observations when frames are not known."""
    ticks, count = [], len(found)
    for share in np.linspace(0, 1, 9):
        k = min(int(share * count), count - 1)
        label = f"{k}" if found.frame is None else f"{found.frame[k]}"
        ticks.append(element("span", label, style=f"left:{100 * share:.1f}%"))
    title = "observation, in order of the file" if found.frame is None else "observations in order of time (labels: frame)"
    return element("div", "".join(ticks), class_="heat-ticks") + element("div", title, class_="heat-title")
