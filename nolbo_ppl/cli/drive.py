"""Render a drive through a generated world: `nolbo drive --out DIR`, or `python -m nolbo_ppl.cli.drive --out DIR`."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

from nolbo_ppl.synthetic.worlds import SequenceConfig, sequence_preset, write_sequence_folder


@dataclass(frozen=True)
class DriveConfig:
    """Render a drive with true poses and objects into a folder. Options that are not given come from the preset."""

    out: Path
    """Folder of the drive; calling again resumes a run that was stopped."""
    world: Literal["street", "indoor"] = "street"
    """A loop of streets, or a passage round a furnished floor."""
    seed: int = 0
    """Which world, shapes and light."""
    preset: Literal["default", "demo"] = "default"
    """`demo`: 120 frames and 60 objects, and the loop closes."""
    frames: int | None = None
    """Number of images."""
    laps: float | None = None
    """How often the loop is driven round."""
    opposite: float | None = None
    """Laps driven afterwards in the opposite direction."""
    step: float | None = None
    """Distance between frames, m."""
    size: tuple[int, int] | None = None
    """Width and height of the images, px."""
    focal: float | None = None
    """Focal length over image width."""
    camera_height: float | None = None
    """Height of the camera, m."""
    tilt: float | None = None
    """Downward tilt of the camera, degrees."""
    objects: int | None = None
    """Number of objects wanted."""
    look_alikes: float | None = None
    """Share of objects that are copies of another one."""
    clutter: int | None = None
    """Number of small things that are no object."""
    moving: int | None = None
    """Vehicles in the opposite lane (street)."""
    supersample: int | None = None
    """Rays along each side of a pixel that differs from its neighbours; 1 leaves jagged edges."""
    noise: float | None = None
    """Scale of the sensor noise, over full range."""
    workers: int = max(1, min(8, os.cpu_count() or 1))
    """Processes; the files do not depend on it."""


def config_of(options: DriveConfig) -> SequenceConfig:
    """The drive the options describe. Raises `InputError` for unusable ones."""
    base = sequence_preset(options.preset, options.world, options.seed)
    names = {field.name for field in fields(SequenceConfig)}
    given = {name: value for name, value in asdict(options).items() if name in names and value is not None}
    return replace(base, **given)


def run(options: DriveConfig) -> dict[str, Any]:
    """Write the drive.

    Returns:
        The folder, numbers of frames, objects, seen objects, instances and labels, metres driven, and the seconds it took.
    """
    begin = time.perf_counter()
    summary = asdict(write_sequence_folder(config_of(options), options.out, options.workers))
    return {**summary, "out": str(options.out), "seconds": round(time.perf_counter() - begin, 3)}


def main(args: Sequence[str] | None = None) -> dict[str, Any]:
    """Command line: parse the options and run."""
    import tyro

    return run(tyro.cli(DriveConfig, prog="nolbo drive", args=args, description=__doc__))


if __name__ == "__main__":
    main()
