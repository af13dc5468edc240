"""The mission on a small generated drive: rendered, observed, driven by visual odometry, corrected by EM, told in a report."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nolbo_ppl.pipeline.mapping_pipeline import run_pipeline
from nolbo_ppl.pipeline.run_config import RunConfig
from nolbo_ppl.pipeline.run_summary import score_table

DEMO_SEED = 88_000
"""Seeds of the demonstration's worlds start here: neither training nor evaluation uses them."""


@dataclass(frozen=True)
class DemoResult:
    """What the demonstration made."""

    table: str
    """Its figures, as lines for a terminal."""
    summary: dict[str, Any]
    """`summary.json` of the run."""
    drive: Path
    """Folder of the drive."""
    run: Path
    """Folder of the run."""

    @property
    def report(self) -> Path:
        """The report."""
        return self.run / "report.html"


def run_demo(out: Path, seed: int = 0, *, model: str = "tiny", workers: int = 1, device: str = "auto") -> DemoResult:
    """Render a small street drive into `out/drive` and run it into `out/run`; what is there already is not made again.

    Visual odometry has the lengths of its steps from the ground under the camera, so that nothing of the truth enters the map.

    Args:
        out: folder.
        seed: which world; no training has seen its shapes.
        model: observation model.
        workers: processes that render.
        device: where the networks run.

    Raises:
        NolboError: the folders hold something else, or there is no such model.
    """
    from nolbo_ppl.synthetic.worlds import sequence_preset, write_sequence_folder  # brings the renderer

    drive, run = out / "drive", out / "run"
    world = sequence_preset("demo", "street", DEMO_SEED + seed)
    write_sequence_folder(world, drive, workers)
    summary = run_pipeline(
        RunConfig(
            images=drive / "images",
            intrinsics=drive / "intrinsics.json",
            truth=drive / "truth.txt",
            truth_objects=drive,
            out=run,
            model=model,
            device=device,
            seed=seed,
            camera_height=world.camera_height,
            camera_pitch=math.radians(world.tilt),
        )
    )
    return DemoResult(score_table(summary), summary, drive, run)
