"""The whole mission on unseen worlds: drives are rendered, run, and their summaries put into one table.

    python benchmarks/mission.py --out build/mission [--worlds street indoor] [--seeds 0 1 2] [--model tiny]

Drives and runs stay in the folder; what is complete there is not made again. Writes `figures.json`, prints the table.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from nolbo_ppl.io.files import write_json
from nolbo_ppl.pipeline.mapping_pipeline import run_pipeline
from nolbo_ppl.pipeline.run_config import RunConfig
from nolbo_ppl.synthetic.worlds import sequence_preset, write_sequence_folder

UNSEEN = 91_000
"""Worlds are numbered from here: neither training nor the demonstration uses them."""
FIGURES = (
    ("before", "ate"),
    ("after", "ate"),
    ("oracle", "ate"),
    ("after_over_before",),
    ("after_over_oracle",),
    ("loops", "precision"),
    ("loops", "recall"),
    ("map", "landmarks"),
    ("map", "objects_detected"),
    ("map", "objects_mapped"),
    ("map", "duplicates"),
    ("map", "spurious"),
    ("map", "median_position_error"),
    ("observation_scores", "recall"),
    ("observation_scores", "precision"),
    ("observation_scores", "category_accuracy"),
    ("observation_scores", "position_error", "all", "median"),
    ("observation_scores", "position_error", "all", "p90"),
    ("observation_scores", "coverage90", "position"),
    ("observation_scores", "coverage90", "orientation"),
    ("observation_scores", "coverage90", "latent"),
    ("shape", "iou", "1"),
    ("shape", "iou", "3"),
    ("shape", "iou", "10"),
    ("images_per_second",),
    ("share_of_em",),
)
"""Where the figures stand in `summary.json`."""


@dataclass(frozen=True)
class Arguments:
    """What to run."""

    out: Path = Path("build/mission")
    """Folder of drives and runs."""
    worlds: tuple[Literal["street", "indoor"], ...] = ("street", "indoor")
    """Kinds of worlds."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Worlds of each kind."""
    preset: Literal["default", "demo"] = "default"
    """Length of the drives."""
    model: str = "tiny"
    """Observation model: name of weights in the package, or a folder."""
    online: bool = False
    """Keyframe by keyframe instead of in one batch."""
    ground: bool = False
    """Lengths of the odometry from the ground under the camera instead of the truth."""
    workers: int = 1
    """Processes that render."""


def figure(summary: Mapping[str, Any], path: Sequence[str]) -> float | None:
    """One figure of a summary, None where it is not there."""
    value: Any = summary
    for key in path:
        value = value.get(key) if isinstance(value, Mapping) else None
    return value


def run_one(arguments: Arguments, world: Literal["street", "indoor"], seed: int) -> dict[str, Any]:
    """Summary of the run of one world."""
    drive, config = arguments.out / f"{world}-{seed}" / "drive", sequence_preset(arguments.preset, world, UNSEEN + seed)
    write_sequence_folder(config, drive, arguments.workers)
    height = config.camera_height if arguments.ground else None
    return run_pipeline(
        RunConfig(
            images=drive / "images",
            intrinsics=drive / "intrinsics.json",
            truth=drive / "truth.txt",
            truth_objects=drive,
            out=drive.parent / "run",
            model=arguments.model,
            online=arguments.online,
            camera_height=height,
            camera_pitch=math.radians(config.tilt),
        )
    )


def main() -> None:
    """Run everything, print the table."""
    arguments = tyro.cli(Arguments, description=__doc__)
    summaries = {f"{world}-{seed}": run_one(arguments, world, seed) for world in arguments.worlds for seed in arguments.seeds}
    write_json(arguments.out / "figures.json", summaries)
    names = ["/".join(path) for path in FIGURES]
    width = max(map(len, names))
    print(" " * width, *(f"{name:>10}" for name in summaries), f"{'median':>10}")
    for name, path in zip(names, FIGURES):
        values = [figure(summary, path) for summary in summaries.values()]
        known = [value for value in values if value is not None]
        middle = statistics.median(known) if known else None
        print(f"{name:<{width}}", *(f"{'-':>10}" if value is None else f"{value:>10.3f}" for value in [*values, middle]))


if __name__ == "__main__":
    main()
