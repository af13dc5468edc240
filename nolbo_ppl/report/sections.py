"""Sections of the report; each is empty when the folder has nothing for it."""

from __future__ import annotations

import shlex

import numpy as np

from nolbo_ppl.io.run_folder import RunFolder
from nolbo_ppl.report.calibration_section import calibration
from nolbo_ppl.report.em_section import em_slider, iteration_table
from nolbo_ppl.report.gallery import gallery
from nolbo_ppl.report.loop_section import find_loops, is_right, loop_gap, loop_scores
from nolbo_ppl.report.report_plots import (
    LINES,
    loop_plot,
    map_axes,
    map_plot,
    outside,
    time_plot,
    trajectory_errors,
    trajectory_plot,
    ways,
)
from nolbo_ppl.report.svg import element, escape
from nolbo_ppl.report.weight_heatmap import heat_map
from nolbo_ppl.report.wording import say, score_tables, settings_table
from nolbo_ppl.viz.style import MUTED, category_colour

OPTIONS = ("images", "intrinsics", "odometry", "wheel", "truth", "truth_objects", "depth", "right", "model", "out")
"""Options of a run that name its inputs and outputs."""
SETTINGS = (
    ("Versions", "versions", True),
    ("Time by stage, s", "seconds", True),
    ("Noise", "noise", False),
    ("Configuration", "configuration", False),
)
"""What is told of how a run was made: title, key in its files, whether it is unfolded."""


def figure(drawing: str, caption: str, legend: str = "", **attributes: object) -> str:
    """A drawing with its legend above and its caption below; the caption is text."""
    return element("figure", legend + drawing + element("figcaption", escape(caption)), class_="plot", **attributes)


def legend_of(entries: list[tuple[str, str, str]]) -> str:
    """Buttons that show and hide layers: (layer, name, colour or empty for the style sheet's own)."""
    buttons = ""
    for layer, name, colour in entries:
        look = {"class_": "swatch", "style": f"background:{colour}"} if colour else {"class_": f"swatch {layer}"}
        swatch = element("span", "", **look)
        buttons += element("button", swatch + escape(name), type="button", data_toggle=layer, aria_pressed="true")
    return element("div", buttons, class_="legend")


def _ways_legend(run: RunFolder, names: tuple[str, ...]) -> list[tuple[str, str, str]]:
    shown = dict(LINES)
    return [(name, shown[name], "") for name in names if name in ways(run)]


def trajectory(run: RunFolder) -> str:
    """Before, after and truth."""
    caption = "Trajectories from above. Circle: start, square: end."
    if run.truth is not None:
        caption += " The truth is moved rigidly onto the estimate."
    return figure(trajectory_plot(run), caption, legend_of(_ways_legend(run, ("odometry", "estimate", "truth"))))


def errors(run: RunFolder) -> str:
    """Errors over time with truth; without it, how far the correction moved each camera."""
    found = trajectory_errors(run)
    legend = legend_of(_ways_legend(run, ("odometry", "estimate")))
    if found:
        position = time_plot(run, {name: pair[0] for name, pair in found.items()}, "Position error", "m")
        rotation = time_plot(run, {name: pair[1] for name, pair in found.items()}, "Rotation error", "°", height=220.0)
        caption = "Error of each keyframe; each trajectory is moved rigidly onto the truth (SE(3), least squares of positions)."
        return figure(position + rotation, caption, legend)
    if run.odometry is None:
        return ""
    moved = np.linalg.norm(run.estimate[:, :3, 3] - run.odometry[:, :3, 3], axis=1)
    caption = "How far the correction moved each camera. No truth was given, so errors are not known."
    return figure(time_plot(run, {"estimate": moved}, "Correction", "m"), caption)


def world_map(run: RunFolder) -> str:
    """The map."""
    if not run.landmarks:
        return ""
    entries = _ways_legend(run, ("estimate", "truth"))
    entries += [(f"category-{k}", name, category_colour(name, run.categories)) for k, name in enumerate(run.categories)]
    if any(x.category is None for x in run.landmarks):
        entries.append(("category--1", "no category", MUTED))
    caption = (
        "Landmarks in the colours of their categories, with the ellipses that hold their positions with probability 0.95; "
        "hollow: existence below one half; dashed: too uncertain to fill."
    )
    left_out = outside(run, map_axes(run))
    if left_out:
        caption += f" {left_out} of {len(run.landmarks)} landmarks lie far outside the picture."
    return figure(map_plot(run), caption, legend_of(entries))


def loop_closures(run: RunFolder) -> str:
    """Links of loops and how many of them are right."""
    if run.associations_in_time is None or not run.landmarks:
        return ""
    if run.associations_in_time.frame is None:
        missing = "The frames of the detections are not in this folder: give --observations to see the loops."
        return element("p", missing, class_="note")
    gap = loop_gap(run)
    loops = find_loops(run.associations_in_time, gap)
    if not loops:
        return element("p", f"No landmark was seen again after more than {gap} keyframes.", class_="note")
    scores, said = loop_scores(run), ""
    if scores is not None:
        said = f" Pairs of detections: precision {say(scores['precision'])}, recall {say(scores['recall'])}."
    seen = len({loop.landmark for loop in loops})
    caption = (
        f"{len(loops)} returns to {seen} of {len(run.landmarks)} landmarks after more than {gap} keyframes: a line from the "
        f"last place it was seen from, over the landmark, to the place it is seen from again.{said}"
    )
    kinds = {is_right(run, loop) for loop in loops}
    entries = [(name, name, "") for kind, name in ((True, "right"), (False, "wrong")) if kind in kinds]
    return figure(loop_plot(run, loops), caption, legend_of(_ways_legend(run, ("estimate",)) + entries))


def association(run: RunFolder) -> str:
    """The heat map."""
    if run.associations_in_time is None or not len(run.associations_in_time):
        return ""
    caption = (
        "Marginal probability that a detection is of a landmark (opacity; colour: category). "
        "A row that resumes far to the right is a loop."
    )
    return figure(heat_map(run), caption)


def landmarks(run: RunFolder) -> str:
    """The gallery."""
    if not run.landmarks:
        return ""
    explained = (
        "Uncertainty is the standard deviation of occupancy at the surface, from 0 (dark) to 0.5 (yellow); "
        "shapes are seen from the front right."
    )
    key = element("p", explained, class_="note")
    return (key if run.voxel_names else "") + gallery(run)


def iterations(run: RunFolder) -> str:
    """EM under a slider, and its table."""
    body = ""
    if run.iterations is not None and len(run.iterations):
        caption = "Trajectory and landmarks (before the merge: tracklets) after each iteration, from above; thin: odometry."
        body = figure(em_slider(run), caption, data_figure="em")
    rows = iteration_table(run)
    if not rows:
        return body
    return body + element("details", element("summary", "Table of iterations") + rows, open=None if body else "open")


def figures(run: RunFolder) -> str:
    """Every number of the summaries."""
    parts = ""
    for source, values in (("", run.summary), ("SLAM: " if run.summary else "", run.slam_summary)):
        for title, rows in score_tables(values):
            parts += element("div", element("h3", escape(source + title)) + rows, class_="block")
    return element("div", parts, class_="blocks") if parts else ""


def command_of(run: RunFolder) -> str:
    """The command as the run states it, else its inputs and outputs as options; empty when nothing is known."""
    command, options = run.record.get("command"), run.record.get("configuration")
    if command:
        return command if isinstance(command, str) else shlex.join(map(str, command))
    if not isinstance(options, dict):
        return ""
    words = [
        word for name in OPTIONS if isinstance(options.get(name), str) for word in (f"--{name.replace('_', '-')}", options[name])
    ]
    return shlex.join(["nolbo", "run", *words, *(["--online"] if options.get("online") is True else [])])


def how(run: RunFolder) -> str:
    """Command, configuration, versions, stages."""
    parts, command = "", command_of(run)
    if command:
        parts += element("pre", element("code", escape(command)))
    if isinstance(run.record.get("complete"), list):
        parts += element("p", escape("Complete stages: " + ", ".join(map(str, run.record["complete"])) + "."))
    sources = (("run", run.record), ("SLAM", run.slam_summary))
    for title, key, opened in SETTINGS:
        for name, values in sources:
            if isinstance(values.get(key), dict) and values[key]:
                shown = element("summary", escape(f"{title} ({name})")) + settings_table(values[key])
                parts += element("details", shown, open="open" if opened else None)
    return parts


SECTIONS = (
    ("trajectory", "Trajectory", trajectory),
    ("errors", "Error over time", errors),
    ("map", "Map", world_map),
    ("loops", "Loop closures", loop_closures),
    ("association", "Association", association),
    ("landmarks", "Landmarks", landmarks),
    ("calibration", "Stated and true", calibration),
    ("em", "EM, iteration by iteration", iterations),
    ("figures", "Figures", figures),
    ("how", "How it was run", how),
)
"""Anchor, title and maker of each section, in order."""
