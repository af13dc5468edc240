"""Words and numbers of the report: names of figures, rounding, units, tables."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from nolbo_ppl.report.svg import element, escape

UNITS = {
    "ate": "ATE, m",
    "ate_rmse": "ATE, m",
    "rpe_translation": "RPE translation, m",
    "rpe_rotation": "RPE rotation, rad",
    "path_length": "path length, m",
    "seconds": "time by stage, s",
    "position_error": "position error by range, m",
    "p90": "90th percentile",
    "median_share": "median, share of the range",
    "p90_share": "90th percentile, share of the range",
    "coverage90": "truths inside 90 % regions",
    "iou": "voxel IoU by number of views",
    "median_position_error": "median position error, m",
    "median_rotation_error_deg": "median rotation error, °",
    "share_of_em": "share of EM in the time",
    "gap_frames": "gap, keyframes",
}
"""Figures whose name alone would not say what they are."""
TITLES = {
    "map": "Map against the truth",
    "loops": "Loop pairs",
    "shape": "Shapes",
    "observation_scores": "Observations against the truth",
}
"""Parts of a summary whose name alone would not say what they are."""
SETTINGS = ("configuration", "calibration", "versions", "iterations", "warnings", "noise", "fingerprints", "complete")
"""Parts of a summary that are not figures."""


def say(value: Any, digits: int = 4) -> str:
    """A value as people write it: with so many digits, a dash where there is none."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        if value and not 1e-3 <= abs(value) < 1e5:
            return f"{value:.3g}"
        return f"{value:.{digits}g}" if abs(value) < 1000 else f"{value:.0f}"
    if isinstance(value, Mapping):
        return ", ".join(f"{k}: {say(v)}" for k, v in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(say(v) for v in value)
    return str(value)


def title_of(key: str) -> str:
    """Name of a figure from its key."""
    return UNITS.get(key, key.replace("_", " "))


def flatten(values: Mapping[str, Any], skip: Iterable[str] = (), path: tuple[str, ...] = ()) -> list[tuple[tuple[str, ...], Any]]:
    """Leaves of nested objects with their paths; lists count as leaves."""
    out: list[tuple[tuple[str, ...], Any]] = []
    for key, value in values.items():
        if key in skip:
            continue
        if isinstance(value, Mapping):
            out += flatten(value, skip, (*path, str(key)))
        else:
            out.append(((*path, str(key)), value))
    return out


def settings_table(values: Mapping[str, Any]) -> str:
    """Nested settings as a table of two columns; keys as they are spelt."""
    rows = [(".".join(path), say(value)) for path, value in flatten(values)]
    return table(("", ""), [(escape(k), escape(v)) for k, v in rows], "settings") if rows else ""


def table(head: Sequence[str], rows: Iterable[Sequence[str]], class_: str = "") -> str:
    """A table; cells are markup."""
    top = "".join(element("th", cell, scope="col") for cell in head)
    cells = (element("th", row[0], scope="row") + "".join(element("td", cell) for cell in row[1:]) for row in rows)
    body = "".join(element("tr", cell) for cell in cells)
    header = element("thead", element("tr", top)) if any(head) else ""
    return element("div", element("table", header + element("tbody", body), class_=class_ or None), class_="scroll")


def score_tables(values: Mapping[str, Any], title: str = "Counts") -> list[tuple[str, str]]:
    """Figures of a summary: a titled table for each nested object, the plain ones first.

    Objects whose members are objects become one table with the members as columns, and so do the errors before and after.
    """
    plain = {k: v for k, v in values.items() if not isinstance(v, (Mapping, list)) and k not in SETTINGS}
    out = []
    if plain:
        out.append((title, table(("", ""), [(escape(title_of(k)), escape(say(v))) for k, v in plain.items()])))
    errors = {k: values[k] for k in ("before", "after", "oracle") if isinstance(values.get(k), Mapping)}
    if errors:
        out.append(("Trajectory", _columns(errors)))
    for key, value in values.items():
        if key in SETTINGS or key in errors or not isinstance(value, Mapping) or not value:
            continue
        name = TITLES.get(key, title_of(key)[:1].upper() + title_of(key)[1:])
        if len(value) > 1 and all(isinstance(member, Mapping) for member in value.values()):
            out.append((name, _columns(value)))
        else:
            out += score_tables(value, name)
    return out


def _columns(members: Mapping[str, Mapping[str, Any]]) -> str:
    """Objects side by side: a column each, a row for every key."""
    leaves = {name: {", ".join(map(title_of, path)): leaf for path, leaf in flatten(value)} for name, value in members.items()}
    keys = list(dict.fromkeys(key for found in leaves.values() for key in found))
    rows = [[escape(key), *(escape(say(found[key])) if key in found else "–" for found in leaves.values())] for key in keys]
    return table(("", *(escape(title_of(name)) for name in leaves)), rows)
