"""Stages of the paper's programme one after the other, as `torchrun ... tests/paper_worker.py DATA OUT FROM [STOP]` runs them.

The tests call `programme` themselves, in one process, to compare with. With STOP, every process dies in that step of the last
stage.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch
import torch.distributed as distributed

from nolbo_ppl.training.paper_config import PaperConfig
from nolbo_ppl.training.paper_stages import run_paper
from nolbo_ppl.training.stages import StageRun

CATEGORIES = ("car", "chair")


def stages(data: Path, out: Path, given: Path) -> list[PaperConfig]:
    """Pictures, shapes, crops of single objects, whole scenes; every network a 64th as wide. Weights of the stages before are
    those of `given`; all objects are decoded, for each process chooses its own otherwise."""
    common: dict[str, Any] = {
        "width": 1 / 64, "steps": 4, "batch": 4, "bf16": False, "device": "cpu", "workers": 1, "log_every": 1,
        "evaluate_every": 100, "checkpoint_every": 2, "cache": out / "cache", "latent_dim": 4, "threads": 1,
    }  # fmt: skip
    scenes: dict[str, Any] = {"categories": CATEGORIES, "sizes": (32, 64), "decode": 16, "validation": data / "val"}
    return [
        PaperConfig("imagenet", data / "imagenet", out / "imagenet", sizes=(32,), **common),
        PaperConfig("vae", data / "ModelNet40", out / "vae", **common),
        PaperConfig(
            "single", data / "train", out / "single", core=given / "imagenet", decoder=given / "vae", phases=(32,), phase_steps=2,
            **scenes, **common,
        ),
        PaperConfig("multi", data / "train", out / "multi", initial=given / "single", freeze_epochs=1, **scenes, **common),
    ]  # fmt: skip


def programme(data: Path, out: Path, given: Path) -> None:
    """Run them all; what is done already is gone on with."""
    for config in stages(data, out, given):
        run_paper(config)


def main() -> None:
    """Run, or die on the way."""
    data, out, given = (Path(word) for word in sys.argv[1:4])
    torch.set_num_threads(1)
    leave = distributed.destroy_process_group
    distributed.destroy_process_group = lambda: (
        None
    )  # one group for all stages: a second one would meet the addresses of the first
    if len(sys.argv) > 4:
        original, last = StageRun.step, int(sys.argv[4])

        def dying(self: StageRun, batch: Any) -> Any:
            if self.stage.name == "scenes" and self.state.step == last:
                os._exit(3)
            return original(self, batch)

        StageRun.step = dying  # type: ignore[method-assign]
    programme(data, out, given)
    leave()


if __name__ == "__main__":
    main()
