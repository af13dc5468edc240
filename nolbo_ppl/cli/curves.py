"""`nolbo curves`: the curves of training runs as pictures."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from nolbo_ppl.errors import input_error
from nolbo_ppl.viz.training_plots import draw_training

SUFFIXES = (".png", ".svg", ".pdf")
"""Kinds of pictures."""


@dataclass(frozen=True)
class CurvesConfig:
    """Draw metrics.jsonl of training runs, finished or not: the objective and the bound by term, figures of held-out scenes."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of runs, what --out of `nolbo train` named."""
    out: Path | None = None
    """The picture (.png, .svg, .pdf); curves.png in the folder of each run by default."""


def run(arguments: CurvesConfig) -> list[Path]:
    """Draw the runs one by one and return the pictures' paths.

    Raises:
        InputError: no run, one picture for several, a kind of picture nobody knows, a run without metrics, or malformed
            ones; names file and line.
    """
    runs, out = arguments.runs, arguments.out
    if not runs:
        raise input_error("no run to draw", expected="a folder that `nolbo train` wrote, or several")
    if out is not None and len(runs) > 1:
        raise input_error("one picture of several runs", got=f"{len(runs)} runs", do="leave --out out: each gets its own")
    if out is not None and out.suffix not in SUFFIXES:
        raise input_error("kind of picture", got=out.name, expected=f"a name that ends in {', '.join(SUFFIXES)}")
    written = []
    for folder in runs:
        written.append(out or (folder if folder.is_dir() else folder.parent) / "curves.png")
        draw_training(folder, written[-1])
    return written


def main(args: Sequence[str] | None = None) -> None:
    """Command line of `nolbo curves`."""
    for path in run(tyro.cli(CurvesConfig, prog="nolbo curves", args=args)):
        sys.stdout.write(f"{path}\n")


if __name__ == "__main__":
    main()
