"""Drives on disk: written frame by frame, in parallel, resumed, never half-written; and read with every check.

A folder holds `images/000000.png` and on, `intrinsics.json`, `truth.txt` (KITTI rows `T_world_camera`; the world is the
first camera's frame), `times.txt`, `objects.json`, `scenes.jsonl` (`nolbo_ppl.io.scenes`, each object with the "id" of
`objects.json`), `voxels.npz` (instance to packed 32^3 bits) and `drive.json`. `scenes.jsonl` is written last.
"""

from __future__ import annotations

import os
import shutil
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from nolbo_ppl._version import __version__
from nolbo_ppl.errors import input_error
from nolbo_ppl.io.files import atomic_path, read_json, read_jsonl, write_json, write_jsonl
from nolbo_ppl.io.images import open_image
from nolbo_ppl.io.npz import save_npz
from nolbo_ppl.io.output_folder import contents, locked, sweep
from nolbo_ppl.io.trajectories import Trajectory, write_trajectory
from nolbo_ppl.synthetic.dataset_writer import DRIVE, SCENES, write_missing
from nolbo_ppl.synthetic.worlds.world import World, make_world
from nolbo_ppl.synthetic.worlds.world_config import SequenceConfig
from nolbo_ppl.synthetic.worlds.world_frame import render_frame

CHUNK = 8
"""Frames that one job renders."""
OBJECTS, TRUTH, TIMES = "objects.json", "truth.txt", "times.txt"
INTRINSICS, VOXELS = "intrinsics.json", "voxels.npz"
LAYOUT = 1
"""Version of the worlds: a folder of another one cannot be resumed, since its frames show another world."""


@dataclass(frozen=True)
class SequenceSummary:
    """What was written."""

    out: Path
    frames: int
    objects: int
    """Objects that stand in the world."""
    seen: int
    """Objects that are labelled in at least one frame."""
    instances: int
    """Different shapes among them."""
    labels: int
    """Labels over all frames."""
    metres: float
    """Length of the drive."""


@lru_cache(maxsize=1)
def _world(config: SequenceConfig) -> World:
    """The world, made once in each process."""
    return make_world(config)


def _write_chunk(config: SequenceConfig, out: Path, first: int, last: int) -> int:
    """Images of frames `first` to `last`, then their lines, which mark the chunk as done."""
    world, rows = _world(config), []
    for frame in range(first, last):
        made, name = render_frame(world, frame), f"images/{frame:06d}.png"
        with atomic_path(out / name) as temporary:
            Image.fromarray(made.rendered.image).save(temporary)
        rows.append(made.record(name))
    write_jsonl(out / ".parts" / f"{first:06d}.jsonl", rows)
    return last - first


def describe_object(world: World, number: int) -> dict[str, Any]:
    """The entry of `objects.json` of an object."""
    thing = world.objects[number]
    shape = thing.look.item.shape
    T_world_object = world.T_world_ground @ thing.T_ground_object
    return {
        "id": thing.id,
        "category": shape.category,
        "instance": shape.instance,
        "symmetry": shape.symmetry,
        "T_world_object": [[round(v, 9) for v in row] for row in T_world_object.tolist()],
        "diagonal": round(shape.diagonal, 9),
        "dimensions": [round(v, 9) for v in shape.dimensions.tolist()],
        "moving": thing.moving is not None,
        "look": thing.look.seed,
    }


def _plain(config: SequenceConfig) -> dict[str, Any]:
    return {key: list(value) if isinstance(value, tuple) else value for key, value in asdict(config).items()}


def write_sequence_folder(config: SequenceConfig, out: str | os.PathLike[str], workers: int = 1) -> SequenceSummary:
    """Render a drive into a folder; a run that was killed goes on where it stopped when called again.

    Args:
        config: the drive.
        out: folder, made when missing.
        workers: processes; the files do not depend on it.

    Raises:
        InputError: the folder holds something else, or another process writes into it.
    """
    out = Path(out)
    with locked(out):
        sweep(out)
        return _write(config, out, workers)


def _write(config: SequenceConfig, out: Path, workers: int) -> SequenceSummary:
    made = {"layout": LAYOUT, "config": _plain(config)}
    known = out / DRIVE
    if known.is_file():
        stored = read_json(known)
        if not isinstance(stored, dict) or {key: stored.get(key) for key in made} != made:
            raise input_error(
                "the folder holds another drive",
                got=out,
                expected="a new folder, or the same options to resume",
                do="choose another --out or delete it",
            )
    elif contents(out):
        raise input_error("the folder is not empty", got=out, expected="a new folder", do="choose another --out")
    if not (out / SCENES).is_file():
        world = _world(config)
        write_json(known, {**made, "version": __version__, **_facts(world)})
        _write_ground_truth(world, out)
        write_missing(_write_chunk, config, out, config.frames, CHUNK, workers, "frame")
        rows = [row for first in range(0, config.frames, CHUNK) for _, row in read_jsonl(out / ".parts" / f"{first:06d}.jsonl")]
        write_jsonl(out / SCENES, rows)
        shutil.rmtree(out / ".parts")
    return _summary(out)


def _facts(world: World) -> dict[str, Any]:
    steps = np.linalg.norm(np.diff(world.T_world_camera[:, :3, 3], axis=0), axis=1)
    return {
        "loop_metres": round(world.loop.length, 3),
        "drive_metres": round(float(steps.sum()), 3),
        "objects": len(world.objects),
        "T_world_ground": [[round(v, 9) for v in row] for row in world.T_world_ground.tolist()],
    }


def _write_ground_truth(world: World, out: Path) -> None:
    width, height = world.config.size
    values = dict(zip(("fx", "fy", "cx", "cy"), (float(v) for v in world.intrinsics)))
    write_json(out / INTRINSICS, {**values, "width": width, "height": height})
    write_trajectory(out / TRUTH, Trajectory(world.T_world_camera))
    with atomic_path(out / TIMES) as temporary:
        temporary.write_text("".join(f"{t:.6f}\n" for t in world.times), encoding="utf-8")
    write_json(out / OBJECTS, [describe_object(world, k) for k in range(len(world.objects))])
    items = {thing.look.item.shape.instance: thing.look.item for thing in world.objects}
    save_npz(out / VOXELS, {name: item.voxels for name, item in sorted(items.items())})


def _summary(out: Path) -> SequenceSummary:
    facts, objects = read_json(out / DRIVE), read_json(out / OBJECTS)
    rows = [row for _, row in read_jsonl(out / SCENES)]
    return SequenceSummary(
        out=out,
        frames=len(rows),
        objects=len(objects),
        seen=len({o["id"] for row in rows for o in row["objects"]}),
        instances=len({thing["instance"] for thing in objects}),
        labels=sum(len(row["objects"]) for row in rows),
        metres=facts["drive_metres"],
    )


def read_image(path: str | os.PathLike[str]) -> UInt8[np.ndarray, "h w 3"]:
    """`nolbo_ppl.io.images.open_image` under its name of 0.1.0."""
    return open_image(path)
