"""Stages of a run: each leaves its complete output or nothing, and is done again only when what it depends on has changed."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nolbo_ppl.errors import input_error
from nolbo_ppl.io.fields import is_number
from nolbo_ppl.io.files import read_json_object, write_json
from nolbo_ppl.io.output_folder import contents, locked, sweep
from nolbo_ppl.io.run_folder import FORMAT, RECORD, check_format
from nolbo_ppl.progress import progress_bar

LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class PipelineStage:
    """One step of a run."""

    name: str
    """Its name in `run.json` and in the progress bar."""
    outputs: tuple[str, ...]
    """Files and folders it writes into the run folder; those that end in `?` may be missing afterwards."""
    settings: Any
    """What it depends on besides the stages before it, as JSON."""
    work: Callable[[], None]
    """Does it."""

    def paths(self, folder: Path) -> list[Path]:
        """Where the outputs lie."""
        return [folder / name.removesuffix("?") for name in self.outputs]

    def complete(self, folder: Path) -> bool:
        """Whether every required output is there."""
        return all((folder / name).exists() for name in self.outputs if not name.endswith("?"))

    def remove(self, folder: Path) -> None:
        """Delete the outputs."""
        for path in self.paths(folder):
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)


@dataclass
class RunRecord:
    """`run.json`: how the run was made, how long its stages took, which are complete."""

    configuration: Mapping[str, Any]
    """Options of the run."""
    versions: Mapping[str, str]
    """Versions of what made it."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Time of each complete stage."""
    cpu_seconds: dict[str, float] = field(default_factory=dict)
    """Processor time of each complete stage."""
    fingerprints: dict[str, str] = field(default_factory=dict)
    """What each complete stage was made from."""

    def write(self, folder: Path) -> None:
        """Write `run.json`."""
        write_json(
            folder / RECORD,
            {
                "format": FORMAT,
                "configuration": dict(self.configuration),
                "versions": dict(self.versions),
                "seconds": {name: round(value, 3) for name, value in self.seconds.items()},
                "cpu_seconds": {name: round(value, 3) for name, value in self.cpu_seconds.items()},
                "complete": list(self.fingerprints),
                "fingerprints": self.fingerprints,
            },
        )


def recorded(folder: Path) -> dict[str, Any]:
    """What `run.json` says, empty when there is none.

    Raises:
        InputError: the folder holds something else than a run.
    """
    if not (folder / RECORD).is_file():
        if contents(folder):
            raise input_error(
                "the folder holds something else than a run",
                expected="a run, an empty folder, or none",
                do="choose another --out",
                file=folder,
            )
        return {}
    values = read_json_object(folder / RECORD)
    if not isinstance(values.get("fingerprints"), dict):
        raise input_error("not the record of a run", file=folder / RECORD, do="choose another --out")
    check_format(values, folder / RECORD)
    return values


def fingerprints(stages: Sequence[PipelineStage]) -> dict[str, str]:
    """A digest for each stage of its settings and those of all before it."""
    found, digest = {}, hashlib.sha256()
    for stage in stages:
        digest.update(json.dumps([stage.name, stage.settings], sort_keys=True).encode())
        found[stage.name] = digest.hexdigest()[:16]
    return found


def run_stages(
    folder: Path,
    stages: Sequence[PipelineStage],
    configuration: Mapping[str, Any],
    versions: Mapping[str, str],
    seconds: dict[str, float],
    cpu_seconds: dict[str, float],
) -> RunRecord:
    """Run what is not there yet, in order; an interrupted stage leaves nothing, and complete ones before it stay.

    Args:
        folder: the run.
        stages: what to do.
        configuration: options, for `run.json`.
        versions: of what does it, for `run.json`.
        seconds: filled with the time of every complete stage as they end, so that later stages can tell it.
        cpu_seconds: the same, processor time.

    Raises:
        InputError: the folder holds something else than a run, or another process writes into it.
    """
    with locked(folder):
        sweep(folder)
        return _run(folder, stages, RunRecord(configuration, versions, seconds, cpu_seconds))


def _run(folder: Path, stages: Sequence[PipelineStage], record: RunRecord) -> RunRecord:
    before = recorded(folder)
    wanted = fingerprints(stages)
    first = 0
    for stage in stages:
        if before.get("fingerprints", {}).get(stage.name) != wanted[stage.name] or not stage.complete(folder):
            break
        record.fingerprints[stage.name] = wanted[stage.name]
        for kept, name in ((record.seconds, "seconds"), (record.cpu_seconds, "cpu_seconds")):
            known = before.get(name)
            value = known.get(stage.name) if isinstance(known, dict) else None
            kept[stage.name] = float(value) if is_number(value, 0) else 0.0
        first += 1
    record.write(folder)
    for stage in stages[first:]:
        stage.remove(folder)
    for stage in progress_bar(stages[first:], "stages", "stage", leave=False):
        start, cpu = time.perf_counter(), time.process_time()
        try:
            stage.work()
        except BaseException:
            stage.remove(folder)
            raise
        record.seconds[stage.name] = time.perf_counter() - start
        record.cpu_seconds[stage.name] = time.process_time() - cpu
        record.fingerprints[stage.name] = wanted[stage.name]
        record.write(folder)
        LOG.info("%s: %.1f s", stage.name, record.seconds[stage.name])
    return record
