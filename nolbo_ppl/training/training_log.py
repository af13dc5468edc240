"""What a training run leaves behind: metrics.jsonl, a checkpoint to go on from, TensorBoard files if wanted."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import torch
from torch import Tensor, nn

from nolbo_ppl._moved import renamed
from nolbo_ppl.errors import input_error
from nolbo_ppl.inference import svi as optimisation
from nolbo_ppl.inference.svi import OptimizerState, StepInfo
from nolbo_ppl.io.fields import is_whole
from nolbo_ppl.io.files import atomic_path, read_json_object, read_jsonl, write_json
from nolbo_ppl.io.output_folder import contents, locked, sweep
from nolbo_ppl.io.tensors import check_tensors, load_tensors, save_tensors

FILES = frozenset({"metrics.jsonl", "checkpoint.safetensors", "config.json", "model", "core.safetensors", "tensorboard"})
"""What a run writes into its folder."""


def is_run(folder: Path) -> bool:
    """Whether a folder holds a run: the configuration of a model is another file of the same name."""
    file = folder / "config.json"
    if not file.is_file():
        return (folder / "checkpoint.safetensors").is_file()
    stated = set(read_json_object(file))
    return {"out", "scene_steps"} <= stated or {"out", "stage", "data"} <= stated


@contextmanager
def run_folder(folder: Path) -> Iterator[None]:
    """Hold the folder of a run; what a killed process left in it is deleted.

    Raises:
        InputError: the folder holds something else under a name that a run writes, or another process writes into it.
    """
    with locked(folder):
        sweep(folder)
        taken = sorted({*contents(folder)} & FILES)
        if taken and not is_run(folder):
            raise input_error(
                "the folder holds something else than a run",
                got=", ".join(taken),
                expected="a run, or a folder without files of these names",
                do="choose another --out",
                file=folder,
            )
        yield


class RunOptions(Protocol):
    """What is asked of the configuration of a run."""

    @property
    def out(self) -> Path:
        """Its folder."""

    @property
    def resume(self) -> bool:
        """Go on from its checkpoint."""

    @property
    def tensorboard(self) -> bool:
        """Write TensorBoard files."""

    def identity(self) -> dict[str, Any]:
        """What a checkpoint must agree with."""

    def to_json(self) -> dict[str, Any]:
        """As JSON keeps it."""


class Named(Protocol):
    """A stage, or a phase of one, with the name that rows of metrics.jsonl have."""

    @property
    def name(self) -> str:
        """The name."""


class UnderWay(Protocol):
    """A stage under way."""

    state: OptimizerState
    """Everything a step changes."""


class TrainingLogger:
    """metrics.jsonl, checkpoint and configuration of a run; only the first process writes."""

    def __init__(self, config: RunOptions, rank: int) -> None:
        self.config, self.rank = config, rank
        self.path = config.out / "metrics.jsonl"
        self.file = config.out / "checkpoint.safetensors"
        self._board: Any = None
        self.resumed: dict[str, Any] = {}
        """What the checkpoint says beside its tensors."""
        if rank == 0:
            config.out.mkdir(parents=True, exist_ok=True)
            if config.tensorboard:
                from torch.utils.tensorboard import SummaryWriter

                self._board = SummaryWriter(str(config.out / "tensorboard"))

    def resume(self, model: nn.Module, stages: Sequence[Named]) -> tuple[int, dict[str, Any] | None, int]:
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
        stated, number, at_step = meta.get("identity"), meta.get("stage"), meta.get("step")
        if not isinstance(stated, dict) or not is_whole(number, 0, len(stages)) or not is_whole(at_step):
            got = f"stage {number!r}, step {at_step!r}"
            raise input_error("not a checkpoint of a run", got=got, do="delete it to begin anew", file=self.file)
        if stated != identity:
            differing = sorted(k for k in {*identity, *stated} if identity.get(k) != stated.get(k))
            raise input_error(
                "the checkpoint belongs to another configuration",
                got=f"differing fields {differing}",
                file=self.file,
                do="choose another --out, or repeat the run's own options",
            )
        self._check(model, tensors, at_step)
        self._cut(number, at_step, stages)
        # The networks too: before a stage goes on, the shape guide in them teaches the latents of all shapes.
        model.load_state_dict(optimisation.module_tensors(tensors) if at_step else tensors)
        self.resumed = meta
        return number, tensors if at_step else None, at_step

    def _check(self, model: nn.Module, tensors: Mapping[str, Tensor], at_step: int) -> None:
        """Raise `InputError` for a checkpoint of other networks, or with numbers that are not finite."""
        own = model.state_dict()
        if not at_step:
            return check_tensors(own, tensors, self.file)
        for name, tensor in tensors.items():
            if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
                raise input_error(f"tensor {name}", got="NaN or infinity", expected="finite numbers", file=self.file)
        for part in ("model", "average"):
            check_tensors(own, optimisation.part_of(tensors, f"{part}/"), self.file)
        shapes = dict(model.named_parameters())
        for name, tensor in optimisation.part_of(tensors, "optimizer/").items():
            parameter = shapes.get(name.rpartition("/")[0])
            if parameter is None or tensor.numel() not in (1, parameter.numel()):  # Muon keeps matrices
                got = f"{name} of shape {tuple(tensor.shape)}"
                raise input_error(
                    "state of the optimiser",
                    got=got,
                    expected="NAME/KEY of a parameter, a number for each of its own",
                    file=self.file,
                )

    def _cut(self, number: int, at_step: int, stages: Sequence[Named]) -> None:
        """Drop the rows of metrics that were written after the checkpoint: they will be written again."""
        if self.rank or not self.path.is_file():
            return
        order = {stage.name: i for i, stage in enumerate(stages)}
        rows = _complete_rows(self.path)
        for line, row in rows:
            if row.get("stage") not in order or not is_whole(row.get("step")):
                got = f"stage {row.get('stage')!r}, step {row.get('step')!r}"
                raise input_error("not a row of this run", got=got, file=self.path, line=line)
        kept = [row for _, row in rows if (order[row["stage"]], row["step"]) <= (number, at_step)]
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

    def checkpoint(self, stage: int, state: UnderWay | nn.Module, more: Mapping[str, Any] | None = None) -> None:
        """Save a stage under way, or the networks between two stages."""
        if self.rank:
            return
        if isinstance(state, nn.Module):
            tensors, step = state.state_dict(), 0
        else:
            tensors, step = optimisation.state_tensors(state.state), state.state.step
        save_tensors(self.file, tensors, {**(more or {}), "stage": stage, "step": step, "identity": self.config.identity()})

    def close(self) -> None:
        """Close TensorBoard's files."""
        if self._board is not None:
            self._board.close()


def _complete_rows(path: Path) -> list[tuple[int, dict[str, Any]]]:
    """Lines and rows of metrics; the last line may have been cut when the process was killed."""
    *whole, last = path.read_bytes().split(b"\n")
    if last:
        with atomic_path(path) as temporary:
            temporary.write_bytes(b"".join(line + b"\n" for line in whole))
    return list(read_jsonl(path))


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
