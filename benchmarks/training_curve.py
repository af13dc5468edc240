"""Held-out figures over the compute of training: what a CPU-second of `nolbo train` buys.

    python benchmarks/training_curve.py --runs runs/a runs/b --out docs/images/training.png

Runs are those that were trained one from the other, in order; each goes on where the one before stopped. Reads their
`metrics.jsonl`, whose rows have the seconds of the stages, and the figures at the end of a run that came to it;
writes a picture and, beside it, the same numbers as JSON.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from nolbo_ppl.errors import input_error
from nolbo_ppl.io.files import read_json, write_json
from nolbo_ppl.viz.style import grid, new_figure, save, styled
from nolbo_ppl.viz.training_plots import FIGURES, read_metrics


@dataclass(frozen=True)
class Arguments:
    """What to draw."""

    runs: tuple[Path, ...]
    """Folders of runs, in the order in which they were trained."""
    out: Path
    """The picture; the numbers are written beside it with the suffix .json."""
    stop: tuple[int, ...] = ()
    """Step of its last stage at which each run was left, where not at its end (0: at its end)."""


def curve(runs: tuple[Path, ...], stop: tuple[int, ...] = ()) -> list[dict[str, Any]]:
    """Rows of `seconds` (of all stages so far, of this run and those before), `run`, `step` and the held-out figures.

    Raises:
        InputError: a run has no metrics, or `stop` has another length.
    """
    if stop and len(stop) != len(runs):
        raise input_error("steps at which runs were left", got=stop, expected=f"{len(runs)} of them")
    rows, before = [], 0.0
    for number, folder in enumerate(runs):
        last = stop[number] if stop else 0
        total, stage, reached = before, None, 0.0
        metrics = read_metrics(folder)
        for row in metrics:
            if row["stage"] != stage:
                stage, total, reached = row["stage"], total + reached, 0.0
            if last and stage == "scenes" and row["step"] > last:
                break
            if "seconds" in row:
                reached = float(row["seconds"])
            elif all(name in row for name in FIGURES[:3]):
                figures = {name: row[name] for name in (*FIGURES, "med_err_deg") if name in row}
                rows.append({"seconds": round(total + reached, 1), "run": folder.name, "step": row["step"], **figures})
        before = total + reached
        final = folder / "model" / "config.json"
        if not last and final.is_file():
            known = read_json(final).get("held_out", {})
            figures = {name: known[name] for name in (*FIGURES, "med_err_deg") if name in known}
            if figures:
                end = {"seconds": round(before, 1), "run": folder.name, "step": metrics[-1]["step"]}
                rows.append({**end, **figures})
    return rows


def main() -> None:
    """Draw the curve."""
    arguments = tyro.cli(Arguments, description=__doc__)
    rows = curve(arguments.runs, arguments.stop)
    if not rows:
        raise input_error("held-out figures", got="none", file=arguments.runs[0], do="train with --evaluate-every")
    write_json(arguments.out.with_suffix(".json"), rows)
    with styled():
        figure = new_figure(7.0, 3.6)
        axes = figure.subplots()
        for name in FIGURES:
            points = [(row["seconds"], row[name]) for row in rows if name in row]
            axes.plot([x for x, _ in points], [y for _, y in points], marker="o", markersize=3, label=name)
        starts = {row["run"]: row["seconds"] for row in reversed(rows)}
        for name, seconds in starts.items():
            axes.annotate(name, (seconds, 0.03), fontsize=7, color="#79706e")
        axes.set(xlabel="CPU-seconds of training", ylabel="held-out scenes", ylim=(0, 1.02))
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 0.2), fontsize=8)
        grid(axes)
        figure.tight_layout()
    save(figure, arguments.out)
    for row in rows:
        print(row)


if __name__ == "__main__":
    main()
