"""`nolbo report`: the report of a run as one HTML file that opens without a network."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from nolbo_ppl.errors import input_error
from nolbo_ppl.report import write_report


@dataclass(frozen=True)
class ReportConfig:
    """Write report.html of a folder that `nolbo run` or `nolbo slam` wrote; what the folder lacks is left out."""

    run_dir: tyro.conf.Positional[Path]
    """Folder of the run."""
    out: Path | None = None
    """The file; report.html in the folder by default."""
    odometry: Path | None = None
    """Trajectory before the correction, where the folder has no odometry.txt."""
    observations: Path | None = None
    """Observations SLAM was given, where the folder has no observations.jsonl."""
    truth: Path | None = None
    """True trajectory, where the folder has no truth.txt."""
    title: str | None = None
    """Heading; the name of the folder by default."""


def run(arguments: ReportConfig) -> Path:
    """Write the report and return its path.

    Raises:
        InputError: no result in the folder, or a file that is malformed or does not match.
    """
    if arguments.out is not None and arguments.out.suffix.lower() not in (".html", ".htm"):
        raise input_error("the report is a page", got=f"--out {arguments.out}", expected="a name that ends in .html")
    return write_report(
        arguments.run_dir,
        odometry=arguments.odometry,
        observations=arguments.observations,
        truth=arguments.truth,
        out=arguments.out,
        title=arguments.title,
    )


def main(args: Sequence[str] | None = None) -> None:
    """Command line of `nolbo report`."""
    path = run(tyro.cli(ReportConfig, prog="nolbo report", args=args))
    sys.stdout.write(f"{path}\n")


if __name__ == "__main__":
    main()
