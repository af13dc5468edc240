"""Plots of the report: the way from above, errors over time, the map, loops."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from nolbo_ppl.geometry.pose import relative, rotation_angle
from nolbo_ppl.io.run_folder import RunFolder
from nolbo_ppl.metrics.trajectory import align
from nolbo_ppl.report.loop_section import FoundLoop, is_right
from nolbo_ppl.report.svg import CHI2_95, Axes, element, equal_axes, group, number, picture, zoomable
from nolbo_ppl.report.wording import say
from nolbo_ppl.structures.landmark import Landmark
from nolbo_ppl.viz.style import MUTED, category_colour

MOST_STRIPS = 400
"""Places along an error plot that tell their values."""
LINES = (("odometry", "Odometry"), ("truth", "Truth"), ("estimate", "Estimate"))
"""Trajectories in the order they are drawn."""


def above(run: RunFolder, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """Points seen from above."""
    return np.asarray(points)[:, list(run.plane)]


def axis_label(run: RunFolder, which: int) -> str:
    """Name, meaning and unit of one axis of the view from above."""
    axis = run.plane[which]
    first = np.abs(run.estimate[0, :3, :3] - np.eye(3)).max() < 1e-3  # the world is the first camera's frame
    meaning = f" ({('right', 'down', 'forward')[axis]} of the first camera)" if first else ""
    return f"world {'xyz'[axis]}{meaning}, m"


def ways(run: RunFolder) -> dict[str, Float[np.ndarray, "n 4 4"]]:
    """The trajectories at hand, by name."""
    return {name: T for name, _ in LINES if (T := getattr(run, name)) is not None}


def near(way: Float[np.ndarray, "n 2"], points: Float[np.ndarray, "m 2"]) -> Bool[np.ndarray, " m"]:
    """Points within half the way's extent (at least 10 m) of its box: one far outlier must not shrink the whole picture."""
    low, high = np.nanmin(way, axis=0), np.nanmax(way, axis=0)  # a truth may have gaps
    reach = max(0.5 * float((high - low).max()), 10.0)
    return ((points >= low - reach) & (points <= high + reach)).all(axis=1)


def map_axes(run: RunFolder, landmarks: bool = True) -> Axes:
    """Axes around all trajectories and, if wanted, the landmarks near them."""
    way = np.concatenate([above(run, T[:, :3, 3]) for T in ways(run).values()])
    if not landmarks or not run.landmarks:
        return equal_axes(way)
    places = above(run, np.array([x.position for x in run.landmarks]))
    return equal_axes(np.concatenate([way, places[near(way, places)]]))


def outside(run: RunFolder, axes: Axes) -> int:
    """How many landmarks lie outside the picture."""
    return int((~axes.holds(above(run, np.array([x.position for x in run.landmarks]).reshape(-1, 3)))).sum())


def is_wide(axes: Axes, covariance: Float[np.ndarray, "2 2"]) -> bool:
    """Whether an ellipse is so large that it would cover the picture: its longer half axis is a quarter of the width."""
    return float(np.sqrt(CHI2_95 * max(np.linalg.eigvalsh(covariance)[-1], 0))) > 0.25 * (axes.x[1] - axes.x[0])


def _ends(axes: Axes, xy: Float[np.ndarray, "n 2"]) -> str:
    """Marks of the first and the last place."""
    u, v = axes.px(xy[[0, -1], 0]), axes.py(xy[[0, -1], 1])
    start = element("circle", cx=number(u[0]), cy=number(v[0]), r=5, class_="start", data_tip="Start")
    side = 4.5
    end = element(
        "rect", x=number(u[1] - side), y=number(v[1] - side), width=2 * side, height=2 * side, class_="end", data_tip="End"
    )
    return start + end


def path_lines(run: RunFolder, axes: Axes, names: Sequence[str]) -> str:
    """Some trajectories as layers."""
    found = ways(run)
    return "".join(
        group([axes.line(above(run, found[name][:, :3, 3]), class_=f"line {name}")], data_layer=name)
        for name in names
        if name in found
    )


def trajectory_plot(run: RunFolder) -> str:
    """Before, after and truth from above."""
    axes = map_axes(run, landmarks=False)
    xy = above(run, run.estimate[:, :3, 3])
    parts = [path_lines(run, axes, [name for name, _ in LINES]), _ends(axes, xy)]
    return zoomable(axes, (axis_label(run, 0), axis_label(run, 1)), parts, "Trajectories from above")


def landmark_tip(landmark: Landmark) -> str:
    """What a landmark says when it is pointed at."""
    lines = [landmark.name + (f" – {landmark.category}" if landmark.category else "")]
    if landmark.category in landmark.class_posterior:
        lines[0] += f" ({landmark.class_posterior[str(landmark.category)]:.2f})"
    if np.isfinite(landmark.existence):
        lines.append(f"existence {landmark.existence:.3f}")
    if np.isfinite(landmark.detections):
        lines.append(f"{landmark.detections:.1f} detections")
    if landmark.frames is not None:
        lines.append(f"frames {landmark.frames[0]} to {landmark.frames[1]}")
    if np.isfinite(landmark.spread):
        lines.append(f"position ± {say(landmark.spread)} m along its worst axis")
    return "\n".join(lines)


def colour_of(run: RunFolder, landmark: Landmark) -> str:
    """Colour of a landmark's category."""
    return MUTED if landmark.category is None else category_colour(landmark.category, run.categories)


def landmark_marks(run: RunFolder, axes: Axes, ellipses: bool = True) -> str:
    """Every landmark: its 95 % ellipse and its place, in the colour of its category."""
    index, parts = list(run.plane), []
    radius = 4 if len(run.landmarks) <= 60 else 2.8 if len(run.landmarks) <= 300 else 2
    for k, landmark in enumerate(run.landmarks):
        colour, xy = colour_of(run, landmark), landmark.position[index]
        mark = ""
        if ellipses and np.isfinite(landmark.position_covariance).all():
            covariance = landmark.position_covariance[np.ix_(index, index)]
            kind = "ellipse wide" if is_wide(axes, covariance) else "ellipse"
            mark = axes.ellipse(xy, covariance, class_=kind, style=f"stroke:{colour};fill:{colour}")
        weak = not landmark.likely
        mark += element(
            "circle",
            cx=number(float(axes.px(xy[0]))),
            cy=number(float(axes.py(xy[1]))),
            r=radius,
            class_="dot weak" if weak else "dot",
            style=f"fill:{colour};stroke:{colour}",
        )
        parts.append(
            group([mark], data_tip=landmark_tip(landmark), data_card=k, data_layer=f"category-{category_number(run, landmark)}")
        )
    return "".join(parts)


def category_number(run: RunFolder, landmark: Landmark) -> int:
    """Number of its category among those of the map, -1 for none: class names must not hold the user's text."""
    return -1 if landmark.category is None else run.categories.index(landmark.category)


def map_plot(run: RunFolder) -> str:
    """The map from above."""
    axes = map_axes(run)
    parts = [path_lines(run, axes, ("truth", "estimate")), landmark_marks(run, axes)]
    return zoomable(axes, (axis_label(run, 0), axis_label(run, 1)), parts, "Map from above")


def loop_plot(run: RunFolder, loops: Sequence[FoundLoop]) -> str:
    """The corrected way with a line from each landmark to the two places it was seen from."""
    axes = map_axes(run)
    way = above(run, run.estimate[:, :3, 3])
    places = above(run, np.array([x.position for x in run.landmarks]))
    parts = []
    for loop in loops:
        landmark = run.landmarks[loop.landmark]
        tip = f"{landmark.name}: seen in frame {loop.before}, again in frame {loop.after}"
        right = is_right(run, loop)
        kind = "" if right is None else "right" if right else "wrong"
        corner = np.stack([way[loop.before], places[loop.landmark], way[loop.after]])
        style = f"stroke:{colour_of(run, landmark)}" if right is None else None
        tip += f"\n{kind}" if kind else ""
        parts.append(group([axes.line(corner, class_=f"loop {kind}", style=style, data_tip=tip)], data_layer=kind or "loops"))
    drawn = [path_lines(run, axes, ("estimate",)), *parts, landmark_marks(run, axes, ellipses=False)]
    return zoomable(axes, (axis_label(run, 0), axis_label(run, 1)), drawn, "Loop closures")


def clock(run: RunFolder) -> tuple[Float[np.ndarray, " n"], str]:
    """Horizontal axis of plots over time: seconds since the start, or the keyframe's number."""
    if run.times is None or not np.ptp(run.times) > 0:
        return np.arange(len(run), dtype=np.float64), "keyframe"
    return run.times - run.times[0], "time since the start, s"


def trajectory_errors(run: RunFolder) -> dict[str, tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]]:
    """Position error in m and rotation error in degrees of every keyframe, each trajectory moved rigidly onto the truth."""
    out = {}
    for name in ("odometry", "estimate"):
        T = getattr(run, name)
        if T is not None and run.truth_given is not None:
            place = np.linalg.norm((align(T, run.truth_given) - run.truth_given)[:, :3, 3], axis=1)
            turned = relative(run.truth_given, align(T, run.truth_given, "pose"))  # positions of a line do not tell its roll
            out[name] = place, np.degrees(rotation_angle(turned[:, :3, :3]))
    return out


def time_plot(run: RunFolder, series: dict[str, Float[np.ndarray, " n"]], label: str, unit: str, height: float = 260.0) -> str:
    """Values over time; strips across tell them."""
    t, axis = clock(run)
    top = max((float(np.nanmax(values)) for values in series.values()), default=1.0) or 1.0
    axes = Axes((float(t[0]), float(t[-1]) if t[-1] > t[0] else float(t[0]) + 1.0), (0.0, 1.06 * top), 980.0, height)
    lines = [
        group([axes.line(np.column_stack([t, values]), class_=f"line {name}")], data_layer=name)
        for name, values in series.items()
    ]
    rows = np.unique(np.linspace(0, len(t) - 1, min(len(t), MOST_STRIPS)).round().astype(int))
    edges = np.concatenate([[axes.left], (axes.px(t[rows[1:]]) + axes.px(t[rows[:-1]])) / 2, [axes.width - axes.right]])
    strips = []
    for k, row in enumerate(rows):
        tip = "\n".join(
            [
                f"keyframe {row}" + (f", {t[row]:.1f} s" if axis != "keyframe" else ""),
                *(f"{name} {say(float(values[row]))} {unit}" for name, values in series.items()),
            ]
        )
        strips.append(
            element(
                "rect",
                x=number(edges[k]),
                y=axes.top,
                width=number(max(edges[k + 1] - edges[k], 0.1)),
                height=number(axes.height - axes.top - axes.bottom),
                class_="strip",
                data_tip=tip,
            )
        )
    return picture(axes, [axes.frame(axis, f"{label}, {unit}"), *lines, group(strips)], f"{label} over time")
