"""EM iteration by iteration: the way and the landmarks at each, under a slider."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from nolbo_ppl.io.run_folder import RunFolder
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error
from nolbo_ppl.report.report_plots import above, axis_label, near, path_lines
from nolbo_ppl.report.svg import Axes, element, equal_axes, escape, number, picture, text, zoomable
from nolbo_ppl.report.wording import say, table

MOST_POSES = 600
"""Poses of each iteration that the page holds."""
NAMES = {
    "iteration": "Iteration",
    "phase": "Phase",
    "log_evidence": "Log evidence, nats",
    "closings": "Loops closed",
    "links": "Links",
    "strong_links": "Links above one half",
    "change": "Cameras moved, m (RMS)",
}
"""Columns of the table of iterations."""


def json_script(value: Any, **attributes: str) -> str:
    """Data for the page's script; no text in it can end the element."""
    shown = json.dumps(value, allow_nan=False).replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
    return element("script", shown, type="application/json", **attributes)


def steps(run: RunFolder) -> list[dict[str, Any]]:
    """What the summary says of each iteration."""
    found = run.slam_summary.get("iterations")
    return [row for row in found if isinstance(row, dict)] if isinstance(found, list) else []


def iteration_errors(run: RunFolder) -> list[float] | None:
    """ATE after each iteration, m; None without truth."""
    if run.iterations is None or run.truth_given is None:
        return None
    return [absolute_trajectory_error(T, run.truth_given).rmse for T in run.iterations.T_world_camera]


def em_slider(run: RunFolder) -> str:
    """The slider, its picture, and the data behind it; places are in px of the picture already."""
    iterations = run.iterations
    assert iterations is not None
    every = [above(run, T[:, :3, 3]) for T in iterations.T_world_camera]
    spots = [above(run, points) for points in iterations.landmarks]
    fixed = [] if run.truth is None else [above(run, run.truth[:, :3, 3])]
    driven = np.concatenate([*every, *fixed])
    axes = equal_axes(np.concatenate([driven, *(points[near(driven, points)] for points in spots)]))
    rows = np.unique(np.linspace(0, len(run) - 1, min(len(run), MOST_POSES)).round().astype(int))
    errors, described = iteration_errors(run), steps(run)
    data = []
    for i, (way, points) in enumerate(zip(every, spots)):
        said = [f"iteration {i} of {len(described) or len(iterations) - 1}" if i else "odometry, before the first iteration"]
        if i == len(iterations) - 1 and i > len(described) > 0:
            said = ["result: landmarks merged, detections associated anew, a last solve"]
        if 0 < i <= len(described):
            said += [
                f"{name}: {say(described[i - 1][key])}"
                for key, name in (("phase", "phase"), ("links", "links"))
                if key in described[i - 1]
            ]
        if errors is not None:
            said.append(f"ATE {say(errors[i])} m")
        if len(points):
            said.append(f"{len(points)} landmarks")
        dots = " ".join(f"M{number(u)} {number(v)}h0" for u, v in zip(axes.px(points[:, 0]), axes.py(points[:, 1])))
        data.append({"way": axes.points(way[rows]), "dots": dots, "say": " · ".join(said)})
    moving = element("path", d=data[-1]["dots"], class_="dots", data_em="dots")
    moving += element("polyline", points=data[-1]["way"], class_="line estimate", data_em="way")
    first = axes.line(every[0], class_="line odometry faint")
    parts = [first, path_lines(run, axes, ("truth",)), moving]
    plot = zoomable(axes, (axis_label(run, 0), axis_label(run, 1)), parts, "Trajectory and landmarks at an iteration of EM")
    last = len(iterations) - 1
    controls = element("button", "Play", type="button", data_em="play")
    controls += element("input", type="range", min=0, max=last, value=last, step=1, aria_label="Iteration", data_em="slider")
    controls += element("output", escape(data[-1]["say"]), data_em="say")
    chart = "" if errors is None or len(errors) < 2 else error_steps(errors)
    return element("div", controls, class_="controls") + plot + chart + json_script(data, data_em="data")


def error_steps(errors: list[float]) -> str:
    """ATE by iteration, with a mark the slider moves."""
    axes = Axes((-0.3, len(errors) - 0.7), (0.0, 1.12 * max(errors) or 1.0), 980.0, 190.0)
    xy = np.column_stack([np.arange(len(errors)), errors])
    marks = "".join(
        element(
            "circle",
            cx=number(float(axes.px(i))),
            cy=number(float(axes.py(e))),
            r=4,
            class_="step",
            data_step=i,
            data_tip=f"iteration {i}\nATE {say(e)} m",
        )
        for i, e in enumerate(errors)
    )
    x0, x1, y0, y1 = axes.left, axes.width - axes.right, axes.height - axes.bottom, axes.top
    ground = element("line", x1=number(x0), x2=number(x1), y1=number(y0), y2=number(y0), class_="ground")
    numbers = "".join(
        text(float(axes.px(i)), y0 + 16, i, text_anchor="middle") for i in range(0, len(errors), max(1, len(errors) // 25))
    )
    labels = text(
        (x0 + x1) / 2, axes.height - 8, "iteration of EM (0: odometry, last: result)", text_anchor="middle", class_="label"
    )
    labels += text(
        14, (y0 + y1) / 2, "ATE, m", text_anchor="middle", class_="label", transform=f"rotate(-90 14 {number((y0 + y1) / 2)})"
    )
    labels += text(x0 - 7, y0 + 3.5, "0", text_anchor="end") + text(
        x0 - 7, float(axes.py(max(errors))) + 3.5, say(max(errors)), text_anchor="end"
    )
    return picture(
        axes,
        [element("g", ground + numbers + labels, class_="frame"), axes.line(xy, class_="line estimate"), marks],
        "Error by iteration",
    )


def iteration_table(run: RunFolder) -> str:
    """What the summary says of each iteration, as a table."""
    rows = steps(run)
    keys = [key for key in NAMES if any(key in row for row in rows)]
    cells = [[escape(say(row.get(key))) for key in keys] for row in rows]
    return table([NAMES[key] for key in keys], cells) if rows and keys else ""
