"""What the map states beside the truth: reliability of its probabilities, coverage of its regions, as the summary has them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from nolbo_ppl.io.run_folder import RunFolder
from nolbo_ppl.report.svg import Axes, element, escape, number, picture
from nolbo_ppl.report.wording import say, table

PROBABILITIES = {
    "background": "Detection is no object",
    "existence": "Landmark is an object",
    "category": "Likeliest category is right",
    "association": "Detection is of the landmark",
}
"""Kinds of probabilities and what each says."""
REGIONS = {
    "pose": "Camera pose",
    "landmark_position": "Landmark position",
    "landmark_orientation": "Landmark orientation",
    "landmark_latent": "Landmark latent",
}
"""Kinds of regions."""
SIDE = 250.0
"""Side of a reliability diagram, px."""
MOST_CASES = 1e5
"""Cases of a bin at which its dot is largest."""


def _part(run: RunFolder, name: str) -> dict[str, dict[str, Any]]:
    """One part of the summary's `calibration`, without what is not as it should be: a file may have come from anywhere."""
    value = run.slam_summary.get("calibration")
    found = value.get(name) if isinstance(value, dict) else None
    return {k: v for k, v in found.items() if isinstance(v, dict)} if isinstance(found, dict) else {}


def _bins(record: dict[str, Any]) -> list[tuple[float, float, float]]:
    rows = record.get("bins")
    out = []
    for row in rows if isinstance(rows, list) else []:
        if isinstance(row, list) and len(row) == 3 and all(isinstance(x, (int, float)) and math.isfinite(x) for x in row):
            out.append((float(row[0]), float(row[1]), float(row[2])))
    return out


def reliability_diagram(name: str, bins: list[tuple[float, float, float]]) -> str:
    """Stated probability across, share that happened up; the diagonal is what a true probability gives."""
    axes = Axes((0.0, 1.0), (0.0, 1.0), SIDE, SIDE, left=46.0, bottom=40.0)
    marks = [
        element(
            "circle",
            cx=number(float(axes.px(stated))),
            cy=number(float(axes.py(happened))),
            r=number(3.0 + 5.0 * min(math.log10(max(count, 1.0)) / math.log10(MOST_CASES), 1.0)),
            class_="step",
            data_tip=f"stated {say(stated)}\nhappened {say(happened)}\n{count:.0f} cases",
        )
        for stated, happened, count in bins
    ]
    diagonal = axes.line(np.array([[0.0, 0.0], [1.0, 1.0]]), class_="line odometry faint")
    shown = picture(axes, [axes.frame("stated", "happened"), diagonal, *marks], f"Reliability: {name}")
    return element("figure", shown + element("figcaption", escape(name)))


def calibration(run: RunFolder) -> str:
    """Tables and diagrams; empty where no truth was given when the map was made."""
    probabilities, regions = _part(run, "probabilities"), _part(run, "regions")
    out = ""
    if regions:
        levels = list(dict.fromkeys(k for r in regions.values() if isinstance(r.get("coverage"), dict) for k in r["coverage"]))
        rows = []
        for name, record in regions.items():
            coverage = record.get("coverage")
            coverage = coverage if isinstance(coverage, dict) else {}
            cells = [escape(REGIONS.get(name, name)), escape(say(record.get("count"))), escape(say(record.get("nees"), 3))]
            rows.append([*cells, *(escape(say(coverage.get(level), 3)) for level in levels)])
        head = ["", "cases", "NEES / dof", *(escape(f"in {level} %") for level in levels)]
        note = "Where covariances hold, NEES is 1 on average and a region holds as many truths as its level says."
        out += element("h3", "Regions") + table(head, rows) + element("p", note, class_="note")
    if probabilities:
        rows = []
        for name, record in probabilities.items():
            keys = ("count", "stated", "happened", "log_score", "brier", "calibration_error", "calibration_error_if_perfect")
            rows.append([escape(PROBABILITIES.get(name, name)), *(escape(say(record.get(key), 3)) for key in keys)])
        head = ["", "cases", "stated", "happened", "log score", "Brier", "calibration error", "if perfect"]
        note = "A calibration error is above zero by noise alone; the last column is that of a perfect forecaster of these cases."
        out += element("h3", "Probabilities") + table(head, rows) + element("p", note, class_="note")
        diagrams = "".join(
            reliability_diagram(PROBABILITIES.get(name, name), _bins(record))
            for name, record in probabilities.items()
            if _bins(record)
        )
        out += element("div", diagrams, class_="blocks")
    return out
