"""Top of the report: the figures that matter, and what the run warned of."""

from __future__ import annotations

from typing import Any

from nolbo_ppl.io.run_folder import RunFolder
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error, path_length
from nolbo_ppl.report.loop_section import loop_scores
from nolbo_ppl.report.svg import element, escape
from nolbo_ppl.report.wording import say


def ate(run: RunFolder) -> dict[str, float]:
    """ATE before and after in m: as the summaries state them, else from the trajectories with a truth given since."""
    out = {}
    for name, key in (("odometry", "before"), ("estimate", "after")):
        stated = None if "truth.txt" in run.elsewhere else _find(run.summary, key, "ate") or _find(run.slam_summary, key, "ate")
        T = getattr(run, name)
        if stated is not None:
            out[key] = stated
        elif T is not None and run.truth_given is not None:
            out[key] = absolute_trajectory_error(T, run.truth_given).rmse
    oracle = _find(run.summary, "oracle", "ate")
    if oracle is not None:
        out["oracle"] = oracle
    return out


def _find(summary: dict[str, Any], *path: str) -> float | None:
    """A number in nested objects, None when it is not there; `trajectory` may hold what the top may."""
    for start in (summary, summary.get("trajectory")):
        value: Any = start
        for key in path:
            value = value.get(key) if isinstance(value, dict) else None
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            return float(value)
    return None


def headline(run: RunFolder) -> str:
    """The figures that matter, large."""
    tiles: list[tuple[str, str, str]] = []
    found = ate(run)
    if "after" in found:
        before = f"from {say(found['before'], 3)} m by odometry" if "before" in found else "absolute trajectory error"
        tiles.append(("ATE", f"{say(found['after'], 3)} m", before))
        if found.get("before"):
            ratio = found["after"] / found["before"]
            tiles.append(("ATE after / before", f"{ratio:.2f}", "below 1 is better than odometry"))
    if "oracle" in found and found["oracle"] > 0 and "after" in found:
        best = f"true associations give {say(found['oracle'], 3)} m"
        tiles.append(("ATE / oracle", f"{found['after'] / found['oracle']:.2f}", best))
    scores = loop_scores(run)
    if scores is not None:
        tiles.append(("Loop precision", say(scores["precision"], 3), f"of {say(scores['found'], 3)} pairs of detections"))
        tiles.append(("Loop recall", say(scores["recall"], 3), f"of {say(scores['true'], 3)} true pairs"))
    sure = sum(x.likely for x in run.landmarks)
    truth = _find(run.summary, "map", "objects_detected")
    kinds = f"{len(run.categories)} categor{'y' if len(run.categories) == 1 else 'ies'}"
    note = kinds if truth is None else f"{truth:.0f} objects seen often enough"
    tiles.append(("Landmarks", str(sure), note))
    length = path_length(run.estimate)
    tiles.append(("Keyframes", str(len(run)), f"{say(length, 3)} m of way"))
    if run.associations_in_time is not None:
        tiles.append(
            ("Detections", str(len(run.associations_in_time)), f"{len(run.associations_in_time) / len(run):.1f} a keyframe")
        )
    rate = _find(run.summary, "images_per_second")
    if rate is not None:
        tiles.append(("Throughput", f"{say(rate, 3)} / s", "images observed"))
    return element("div", "".join(map(tile, tiles)), class_="tiles")


def tile(parts: tuple[str, str, str]) -> str:
    """Name, value and a word on it."""
    spans = (element("span", escape(part), class_=kind) for part, kind in zip(parts, ("name", "value", "note")))
    return element("div", "".join(spans), class_="tile")


def warnings(run: RunFolder) -> str:
    """What the run warned of."""
    found = [text for summary in (run.summary, run.slam_summary) for text in summary.get("warnings") or []]
    rows = "".join(element("li", escape(text)) for text in dict.fromkeys(map(str, found)))
    return element("ul", rows, class_="warnings") if rows else ""
