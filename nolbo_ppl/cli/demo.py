"""`nolbo demo`: the whole mission on a small generated drive, with the shipped weights.

A street is rendered, observed image by image, driven by visual odometry that drifts, and corrected by EM with the learnt
latents; a report shows what came out. Seed and settings make the same world again.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from nolbo_ppl.errors import input_error
from nolbo_ppl.pipeline.demo_run import DemoResult, run_demo


@dataclass(frozen=True)
class DemoConfig:
    """What the demonstration does."""

    out: Path = Path("demo")
    """Folder of the drive and of the run; what is complete in it is not made again."""
    seed: int = 0
    """Which world."""
    model: str = "tiny"
    """Observation model: weights in the package, or a folder."""
    device: str = "auto"
    """Where its networks run: `auto`, `cpu`, `cuda`, `cuda:N` or `mps`; worlds are rendered on the CPU."""
    workers: int = 2
    """Processes that render the drive."""

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise input_error("--workers", got=self.workers, expected="at least 1")
        if self.seed < 0:
            raise input_error("--seed", got=self.seed, expected="a whole number of at least 0")


def run(config: DemoConfig) -> DemoResult:
    """Render the drive and run the mission on it.

    Raises:
        NolboError: the folder holds something else, or there is no such model.
    """
    return run_demo(config.out, config.seed, model=config.model, workers=config.workers, device=config.device)


def main(args: Sequence[str] | None = None) -> None:
    """Parse the command line, run, print the table."""
    import tyro

    result = run(tyro.cli(DemoConfig, args=args, prog="nolbo demo", description=__doc__))
    sys.stdout.write(f"{result.table}\n\nthe report: {result.report}\n")


if __name__ == "__main__":
    main()
