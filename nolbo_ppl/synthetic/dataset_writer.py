"""Data sets on disk: `images/*.png`, `scenes.jsonl`, `voxels.npz`, written in parallel, resumed, never half-written."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from nolbo_ppl.errors import input_error
from nolbo_ppl.io.files import atomic_path, read_json, read_jsonl, write_json, write_jsonl
from nolbo_ppl.io.npz import Npz, save_npz
from nolbo_ppl.io.output_folder import contents, locked, sweep
from nolbo_ppl.io.scenes import annotations_record
from nolbo_ppl.parallel import parallel
from nolbo_ppl.progress import progress_bar
from nolbo_ppl.synthetic.assets.shape_library import VOXELS
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator

CHUNK = 128
"""Scenes that one job renders."""
SCENES = "scenes.jsonl"
"""Written last: a folder that has it is complete."""
DRIVE = "drive.json"
"""What a rendered drive was made of, in its folder."""


def _write_chunk(source: SceneGenerator, out: Path, first: int, last: int) -> int:
    """Images of scenes `first` to `last`, then their lines and voxels, which mark the chunk as done."""
    rows: list[dict[str, Any]] = []
    voxels: dict[str, np.ndarray] = {}
    for index in range(first, last):
        rendered = source.render(index)
        name = f"images/{index:06d}.png"
        with atomic_path(out / name) as temporary:
            Image.fromarray(rendered.image).save(temporary)
        rows.append(annotations_record(rendered.annotations, name))
        for asset in rendered.assets:
            voxels.setdefault(asset.shape.instance, asset.voxels)
    parts = out / ".parts"
    save_npz(parts / f"{first:06d}.npz", voxels, compressed=False)
    write_jsonl(parts / f"{first:06d}.jsonl", rows)
    return last - first


def write_scenes(out: str | os.PathLike[str], source: SceneGenerator, count: int, workers: int = 1) -> dict[str, Any]:
    """Write the first `count` scenes of a source; a run that was killed is resumed by calling it again.

    Args:
        out: folder of the data set, made when missing.
        source: the scenes.
        count: how many.
        workers: processes; the files do not depend on it.

    Returns:
        `{"scenes": n, "objects": n, "instances": n}`.

    Raises:
        InputError: `count` is not positive, or the folder holds another data set, or another process writes there.
    """
    if count < 1:
        raise input_error("number of scenes", got=count, expected="at least 1")
    out = Path(out)
    with locked(out):
        sweep(out)
        return _write(out, source, count, workers)


def _write(out: Path, source: SceneGenerator, count: int, workers: int) -> dict[str, Any]:
    description = {"count": count, **source.describe()}
    made = out / "source.json"
    if made.is_file():
        if read_json(made) != _plain(description):
            raise input_error(
                "the folder holds other scenes",
                got=out,
                expected="a new folder, or the same options to resume",
                do="choose another --out or delete it",
            )
    elif contents(out):
        raise input_error("the folder is not empty", got=out, expected="a new folder", do="choose another --out")
    else:
        write_json(made, description)
    if not (out / SCENES).is_file():
        write_missing(_write_chunk, source, out, count, CHUNK, workers, "scene")
        _join(out, count)
    rows = [row for _, row in read_jsonl(out / SCENES)]
    objects = [thing for row in rows for thing in row["objects"]]
    return {"scenes": len(rows), "objects": len(objects), "instances": len({o["instance"] for o in objects})}


def is_generated(folder: str | os.PathLike[str]) -> bool:
    """Whether a folder of scenes, or of a drive, was rendered here; photographs, and scenes of other origin, were not."""
    if (Path(folder) / DRIVE).is_file():
        return True
    made = Path(folder) / "source.json"
    if not made.is_file():
        return False
    described = read_json(made)
    return isinstance(described, dict) and {"config", "seed"} <= described.keys()


def _plain(value: Any) -> Any:
    """The value as it comes back from JSON: tuples are lists."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def write_missing(
    write_chunk: Callable[[Any, Path, int, int], int], source: Any, out: Path, count: int, chunk: int, workers: int, unit: str
) -> None:
    """Write those of `count` images that are missing, `chunk` of them in a job; a chunk whose lines are there is done.

    Args:
        write_chunk: writes images `first` to `last` of a source, then their lines as `.parts/FIRST.jsonl`; returns how many.
        source: what it takes the images from.
        out: folder of the data set.
        count: images in all.
        chunk: images that one job writes.
        workers: processes.
        unit: what an image is, on the progress bar.
    """
    (out / "images").mkdir(parents=True, exist_ok=True)
    chunks = [(first, min(first + chunk, count)) for first in range(0, count, chunk)]
    missing = [(first, last) for first, last in chunks if not (out / ".parts" / f"{first:06d}.jsonl").is_file()]
    jobs = [(write_chunk, (source, out, first, last)) for first, last in missing]
    done = count - sum(last - first for first, last in missing)
    with progress_bar(None, f"writing {unit}s", unit, total=count, done=done) as bar:
        for number in parallel(jobs, min(workers, max(len(jobs), 1))):
            bar.update(number)


def _join(out: Path, count: int) -> None:
    """Join the chunks: voxels first, the lines last."""
    parts = out / ".parts"
    voxels: dict[str, np.ndarray] = {}
    rows: list[dict[str, Any]] = []
    for first in range(0, count, CHUNK):
        with Npz(parts / f"{first:06d}.npz") as stored:
            voxels.update({name: stored.array(name, (VOXELS**3 // 8,)) for name in stored.names})
        rows.extend(row for _, row in read_jsonl(parts / f"{first:06d}.jsonl"))
    save_npz(out / "voxels.npz", dict(sorted(voxels.items())))
    write_jsonl(out / SCENES, rows)
    shutil.rmtree(parts)
