"""What a training run leaves behind: metrics.jsonl, a checkpoint to go on from, TensorBoard files if wanted."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nolbo_ppl.errors import input_error
from nolbo_ppl.inference import svi as optimisation
from nolbo_ppl.inference.svi import StepInfo
from nolbo_ppl.io.files import atomic_path, read_jsonl, write_json
from nolbo_ppl.io.tensors import load_tensors, save_tensors
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.training.stages import StageRun, TrainingStage
from nolbo_ppl.training.train_config import TrainConfig


class Journal:
    """metrics.jsonl, checkpoint and configuration of a run; only the first process writes."""

    def __init__(self, config: TrainConfig, rank: int) -> None:
        self.config, self.rank = config, rank
        self.path = config.out / "metrics.jsonl"
        self.file = config.out / "checkpoint.safetensors"
        self._board: Any = None
        if rank == 0:
            config.out.mkdir(parents=True, exist_ok=True)
            if config.tensorboard:
                from torch.utils.tensorboard import SummaryWriter

                self._board = SummaryWriter(str(config.out / "tensorboard"))

    def resume(self, model: Nolbo, stages: Sequence[TrainingStage]) -> tuple[int, dict[str, Any] | None, int]:
        """Stage to go on with, the tensors of its state if it was under way, and its step.

        Raises:
            InputError: there is a checkpoint but resuming is off, or it belongs to another configuration.
        """
        identity = self.config.identity()
        if not self.file.is_file():
            if self.rank == 0:
                self.path.unlink(missing_ok=True)
                write_json(self.config.out / "config.json", self.config.to_json())
            return 0, None, 0
        if not self.config.resume:
            raise input_error("the folder holds a run", got=self.config.out, do="choose another --out, or resume")
        tensors, meta = load_tensors(self.file)
        if meta.get("identity") != identity:
            differing = sorted(k for k in identity if identity[k] != meta.get("identity", {}).get(k))
            raise input_error(
                "the checkpoint belongs to another configuration",
                got=f"differing fields {differing}",
                file=self.file,
                do="choose another --out, or repeat the run's own options",
            )
        number, at_step = int(meta["stage"]), int(meta["step"])
        self._cut(number, at_step, stages)
        # The networks too: before a stage goes on, the shape guide in them teaches the latents of all shapes.
        model.load_state_dict(optimisation.module_tensors(tensors) if at_step else tensors)
        return number, tensors if at_step else None, at_step

    def _cut(self, number: int, at_step: int, stages: Sequence[TrainingStage]) -> None:
        """Drop the rows of metrics that were written after the checkpoint: they will be written again."""
        if self.rank or not self.path.is_file():
            return
        order = {stage.name: i for i, stage in enumerate(stages)}
        rows = _complete_rows(self.path)
        kept = [row for row in rows if (order.get(row["stage"], 0), row["step"]) <= (number, at_step)]
        with atomic_path(self.path) as temporary:
            temporary.write_text("".join(json.dumps(row) + "\n" for row in kept), encoding="utf-8")

    def log(self, stage: str, info: StepInfo, scenes: int, seconds: float, waited: float) -> None:
        """One row of the running stage: terms in nats a scene (a shape, in the first stage)."""
        if self.rank:
            return
        terms = {f"terms/{name}": round(value / scenes, 5) for name, value in info.terms.items()}
        row = {
            "stage": stage,
            "step": info.step + 1,
            "loss": round(info.loss, 5),
            **terms,
            "gradient_norm": round(info.gradient_norm, 4),
            "learning_rate": info.learning_rate,
            "seconds": round(seconds, 2),
            "waited": round(waited, 3),
        }
        self.write(row)

    def write(self, row: dict[str, Any]) -> None:
        """Append a row."""
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        if self._board is not None:
            for key, value in row.items():
                if isinstance(value, float):
                    self._board.add_scalar(f"{row['stage']}/{key}", value, row["step"])

    def checkpoint(self, stage: int, state: StageRun | Nolbo) -> None:
        """Save a stage under way, or the networks between two stages."""
        if self.rank:
            return
        if isinstance(state, StageRun):
            tensors, step = optimisation.state_tensors(state.state), state.state.step
        else:
            tensors, step = state.state_dict(), 0
        save_tensors(self.file, tensors, {"stage": stage, "step": step, "identity": self.config.identity()})

    def close(self) -> None:
        """Close TensorBoard's files."""
        if self._board is not None:
            self._board.close()


def _complete_rows(path: Path) -> list[dict[str, Any]]:
    """Rows of metrics; the last line may have been cut when the process was killed."""
    *whole, last = path.read_text(encoding="utf-8").split("\n")
    if last:
        with atomic_path(path) as temporary:
            temporary.write_text("".join(line + "\n" for line in whole), encoding="utf-8")
    return [row for _, row in read_jsonl(path)]
