"""`nolbo data check`: what a file or folder is taken for, what it holds, and what is wrong with it."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from nolbo_ppl.data import known_formats, picture_formats  # noqa: F401 (register their formats)
from nolbo_ppl.data.converters import archive_formats  # noqa: F401 (registers its formats)
from nolbo_ppl.data.format_registry import FORMATS, FormatReport, check_data
from nolbo_ppl.errors import input_error
from nolbo_ppl.viz.contact_sheet import write_contact_sheet

LONGEST = 12
"""Entries of a table that are printed; `--json` holds all."""


@dataclass(frozen=True)
class DataCheckConfig:
    """What to look at."""

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """The file or folder; or the name of a format, and then the file or folder."""
    out: Path | None = None
    """PNG file for a contact sheet, where there are pictures."""
    json: bool = False
    """Print everything as JSON."""


def run(config: DataCheckConfig) -> FormatReport:
    """Look, and write the contact sheet where one is wanted.

    Raises:
        InputError: nothing there, no such format, or a sheet of what has no pictures.
    """
    if not 1 <= len(config.paths) <= 2:
        raise input_error("nolbo data check", got=f"{len(config.paths)} paths", expected="[NAME] PATH")
    name = None if len(config.paths) == 1 else str(config.paths[0])
    report = check_data(config.paths[-1], name)
    if config.out is not None and (report.pictures is None or not write_contact_sheet(config.out, report.pictures())):
        raise input_error("no pictures for a contact sheet", got=report.what, file=config.paths[-1])
    return report


def _shown(value: Any, name: str = "") -> str:
    if isinstance(value, dict):
        items = [f"{key} {_shown(part, key)}" for key, part in value.items()]
        return ", ".join(items[:LONGEST]) + (f", and {len(items) - LONGEST} more" if len(items) > LONGEST else "")
    if isinstance(value, list):
        pair = len(value) == 2 and all(isinstance(part, int | float) for part in value)
        return (" x " if name == "size" else " to " if pair else " ").join(map(str, value[:LONGEST]))
    return str(value)


def describe(report: FormatReport, indent: str = "") -> str:
    """A few lines for the terminal."""
    lines = [f"{indent}{report.what}" + (f" [{report.format}]" if report.format in FORMATS else "")]
    lines += [f"{indent}  {name.replace('_', ' ')}: {_shown(value, name)}" for name, value in report.facts.items()]
    for name, part in report.parts:
        lines += [f"{indent}  {name}:", describe(part, indent + "    ")]
    if not report.parts:
        lines += [f"{indent}  wrong: {text}" for text in report.problems]
    return "\n".join(lines)


def main(args: Sequence[str] | None = None) -> None:
    """Command line of `nolbo data`; what is wrong ends with status 1."""
    args = list(sys.argv[1:] if args is None else args)
    if args[:1] != ["check"]:
        if args[:1] in (["-h"], ["--help"]):
            sys.stdout.write("usage: nolbo data check [NAME] PATH [--out SHEET.png] [--json]\n\nNAME is one of\n")
            sys.stdout.write("".join(f"  {name:20} {one.what}\n" for name, one in sorted(FORMATS.items())))
            raise SystemExit(0)
        raise input_error("nolbo data", got=" ".join(args[:1]) or "nothing", expected="check")
    config = tyro.cli(DataCheckConfig, prog="nolbo data check", args=args[1:], description=__doc__)
    report = run(config)
    sys.stdout.write((json.dumps(report.as_json(), indent=2) if config.json else describe(report)) + "\n")
    if report.problems:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
