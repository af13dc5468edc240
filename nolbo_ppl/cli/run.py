"""`nolbo run`: images in, a corrected trajectory, a map of objects with shapes, figures and a report out."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

from nolbo_ppl.pipeline.mapping_pipeline import run_pipeline
from nolbo_ppl.pipeline.run_config import RunConfig
from nolbo_ppl.pipeline.run_summary import score_table
from nolbo_ppl.renamed_options import current_arguments


def run(config: RunConfig) -> dict[str, Any]:
    """Run what is not there yet; returns the summary.

    Raises:
        NolboError: an input is missing, malformed, or does not fit the others; complete stages stay.
    """
    return run_pipeline(config)


def main(args: Sequence[str] | None = None) -> None:
    """Parse the command line, run, print the figures."""
    import tyro

    config = tyro.cli(
        RunConfig,
        args=current_arguments(RunConfig, args),
        prog="nolbo run",
        description=__doc__,
    )
    summary = run(config)
    remarks = "".join(f"\n{text}" for text in summary.get("remarks", []))
    sys.stdout.write(score_table(summary) + remarks + f"\nwritten to {config.out}\n")


if __name__ == "__main__":
    main()
