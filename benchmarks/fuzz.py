"""Mutated inputs through every reader: `python benchmarks/fuzz.py --seconds 600 --out build/fuzz.json`.

A good file of each kind is made, changed at random (bytes, words, JSON values, NPZ members, lengths), and read. What a reader
may do is raise an `InputError` that names the file, or accept what is finite. A traceback, an error without the file, a number
that is not finite, and more than ten seconds are defects; their inputs are kept beside the report.
"""

from __future__ import annotations

import argparse
import io
import json
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nolbo_ppl.errors import InputError

SLOWEST = 10
"""Seconds a reader may take."""
WORDS = (
    b"1e400",
    b"-1e308",
    b"1e-320",
    b"NaN",
    b"Infinity",
    b"9" * 40,
    b"-0",
    b"true",
    b"null",
    b'"x"',
    b"[]",
    b"{}",
    b"[[[",
    b"\xff\xfe",
    b"\xe9",
    b"\x00",
    b"\n",
    b"\r",
    b",",
    b":",
    b"#",
    b"../" * 4,
    b"1",
    b"0",
    b'"' + b"a" * 300 + b'"',
    b"[" * 3000,
    b"PK\x03\x04",
    b"%!PS-Adobe",
)
VALUES: tuple[Any, ...] = (
    None,
    True,
    "x",
    "",
    [],
    {},
    [1],
    -1,
    0,
    1.5,
    10**9,
    10**18,
    10**40,
    1e300,
    -1e300,
    1e-320,
    [[]],
    {"a": 1},
    "\ud800",
    "../../x",
)


@dataclass
class Counts:
    """What became of the inputs of one surface."""

    inputs: int = 0
    clear: int = 0
    accepted: int = 0
    defects: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Surface:
    """A kind of file: its name, a good example, and what reads it."""

    name: str
    good: bytes
    read: Callable[[Path], Any]
    beside: tuple[tuple[str, bytes], ...] = ()
    """Files that lie beside it."""
    missing: bool = False
    """Whether NaN stands for what a file may leave out."""


def changed_bytes(data: bytes, rng: random.Random) -> bytes:
    """The data with one to four changes."""
    out = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        at, size = rng.randrange(len(out) + 1), rng.choice((1, 1, 2, 8, 64))
        match rng.randrange(6):
            case 0:
                out[at : at + size] = rng.randbytes(size)
            case 1:
                del out[at : at + size]
            case 2:
                out[at:at] = rng.choice(WORDS)
            case 3:
                out[at : at + size] = rng.choice(WORDS)
            case 4:
                del out[at:]
            case _:
                out[at:at] = out[at : at + 4 * size]
    return bytes(out)


def changed_value(value: Any, rng: random.Random) -> Any:
    """A JSON value with one change somewhere inside."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = rng.choice(list(value))
        if rng.random() < 0.1:
            return {k: v for k, v in value.items() if k != key}
        return {**value, key: changed_value(value[key], rng)}
    if isinstance(value, list) and value and rng.random() < 0.8:
        at = rng.randrange(len(value))
        if rng.random() < 0.1:
            return value[:at] + value[at + 1 :]
        return [*value[:at], changed_value(value[at], rng), *value[at + 1 :]]
    return rng.choice(VALUES)


def changed_json(data: bytes, rng: random.Random) -> bytes:
    """JSON or JSON Lines with a changed value."""
    lines = data.decode().splitlines() if data.count(b"\n{") else [data.decode()]
    at = rng.randrange(len(lines))
    try:
        lines[at] = json.dumps(changed_value(json.loads(lines[at]), rng))
    except ValueError:
        return changed_bytes(data, rng)
    return ("\n".join(lines) + "\n").encode()


def changed_npz(data: bytes, rng: random.Random) -> bytes:
    """An archive with one array exchanged, left out, or of another form."""
    with np.load(io.BytesIO(data)) as archive:
        arrays: dict[str, Any] = {name: archive[name] for name in archive.files}
    name = rng.choice(list(arrays))
    value = np.asarray(arrays[name])
    match rng.randrange(7):
        case 0:
            del arrays[name]
        case 1:
            arrays[name] = value.reshape(-1)[: rng.randrange(value.size + 1)]
        case 2:
            arrays[name] = np.full(value.shape, rng.choice((np.nan, np.inf, 1e300, -1e300, 0.0)))
        case 3:
            arrays[name] = np.array(["text", "more"])
        case 4:
            arrays[name] = value.astype(rng.choice(("complex64", "int8", "bool", "float16")))
        case 5:
            arrays[name] = value[None]
        case _:
            arrays[name] = np.zeros((rng.choice((10**6, 10**7)), 1), np.uint8)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def mutate(surface: Surface, rng: random.Random) -> bytes:
    """One mutated input of a surface."""
    if rng.random() < 0.5:
        if surface.name.endswith((".json", ".jsonl")):
            return changed_json(surface.good, rng)
        if surface.name.endswith(".npz"):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # casts to smaller types
                return changed_npz(surface.good, rng)
    return changed_bytes(surface.good, rng)


def not_finite(value: Any, missing: bool = False) -> bool:
    """Whether an array among what was read holds a number that is not finite; `missing`: NaN may stand for what is left out."""
    if isinstance(value, np.ndarray) and value.dtype.kind == "f":
        return bool((np.isinf(value) if missing else ~np.isfinite(value)).any())
    if isinstance(value, dict):
        return any(not_finite(item, missing) for item in value.values())
    if isinstance(value, list | tuple):
        return any(not_finite(item, missing) for item in value)
    return hasattr(value, "__dict__") and any(not_finite(item, missing) for item in vars(value).values())


class TooSlow(BaseException):
    """A reader took longer than it may."""


@contextmanager
def limited(seconds: int) -> Iterator[None]:
    """Raise `TooSlow` in the block when its time is over."""

    def stop(*_: object) -> None:
        raise TooSlow

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def judge(surface: Surface, data: bytes, folder: Path) -> str | None:
    """Read one input: None when it was accepted, "" for a clear error, else what is wrong."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name, content in surface.beside:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)
    path = folder / surface.name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
    try:
        with limited(SLOWEST), warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            found = surface.read(path)
    except InputError as error:
        return "" if str(folder) in str(error) else f"error without the file: {error}"
    except TooSlow:
        return f"more than {SLOWEST} s"
    except Exception as error:
        return f"{type(error).__name__}: {error} at {traceback.format_exc().splitlines()[-3].strip()}"
    if not_finite(found, surface.missing):
        return "a number that is not finite"
    numeric = [str(one.message) for one in told if issubclass(one.category, RuntimeWarning)]
    return f"warning: {numeric[0]}" if numeric else None


def surfaces() -> list[Surface]:
    """Every kind of file, with a good example."""
    from PIL import Image

    from nolbo_ppl.data.dataset_folder import SceneFolder
    from nolbo_ppl.inference.posterior.model_folder import read_model_config
    from nolbo_ppl.io.camera_files import read_camera
    from nolbo_ppl.io.images import open_image
    from nolbo_ppl.io.npz import read_voxels, save_npz
    from nolbo_ppl.io.observations import read_observations
    from nolbo_ppl.io.tensors import load_tensors, save_tensors
    from nolbo_ppl.io.text import read_lengths, read_times
    from nolbo_ppl.io.trajectories import read_covariance, read_trajectory
    from nolbo_ppl.models.model_config import nano
    from nolbo_ppl.synthetic.worlds.sequence_reader import read_objects

    def encoded(image: np.ndarray, kind: str) -> bytes:
        buffer = io.BytesIO()
        Image.fromarray(image).save(buffer, kind)
        return buffer.getvalue()

    def written(write: Callable[[Path], None]) -> bytes:
        with tempfile.TemporaryDirectory() as folder:
            write(Path(folder) / "file")
            return next(Path(folder).iterdir()).read_bytes()

    def lines(rows: list[dict[str, Any]]) -> bytes:
        return "".join(json.dumps(row) + "\n" for row in rows).encode()

    rng = np.random.default_rng(0)
    picture = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
    png = encoded(picture, "PNG")
    eye = [1.0, 0.0, 0.0, 0.5, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 2.0]
    kitti = "".join(" ".join(map(str, [*eye[:11], k])) + "\n" for k in range(6)).encode()
    tum = b"# time x y z qx qy qz qw\n" + "".join(f"{k}.25 {k} 0 0 0 0 0 1\n" for k in range(6)).encode()
    mode = {"weight": 0.5, "rotation": [0, 0, 0, 1], "std": 0.1}
    detection = {"frame": 1, "position": [0.5, 0.1, 4.0], "position_std": 0.1, "rotation": [0, 0, 0, 1], "rotation_std": 0.1}
    detection |= {"rotation_modes": [mode, mode], "latent": [0.1, -0.2], "latent_std": 0.5, "objectness": 0.9}
    detection |= {"category": "chair", "size": [0.5, 0.5, 1.0], "symmetry": 1}
    thing = {"box": [4, 4, 30, 30], "category": "chair", "rotation": [0, 0, 0, 1], "position": [0.1, 0.0, 3.0], "size": 1.0}
    scene = {"image": "images/a.png", "intrinsics": [50, 50, 32, 24], "objects": [thing, {**thing, "visibility": 0.5}]}
    camera = {"fx": 50.0, "fy": 50.0, "cx": 32.0, "cy": 24.0, "width": 64, "height": 48}
    known = {"id": "a", "category": "car", "instance": "car-1", "symmetry": 1, "T_world_object": np.eye(4).tolist()}
    known |= {"diagonal": 4.0, "dimensions": [1.0, 2.0, 3.0], "moving": False}
    voxels = {"car-1": rng.integers(0, 256, 4096, dtype=np.uint8), "car-2": np.zeros(4096, np.uint8)}
    tensors = {"a": np.ones((3, 4), np.float32), "b": np.arange(5.0)}

    def store_tensors(path: Path) -> None:
        import torch

        save_tensors(path, {name: torch.from_numpy(value) for name, value in tensors.items()}, {"step": 1})

    return [
        Surface(
            "observations.jsonl",
            lines([detection, {**detection, "frame": 2, "id": "b"}]),
            lambda p: read_observations(p, 6),
            missing=True,
        ),
        Surface("kitti.txt", kitti, read_trajectory),
        Surface("tum.txt", tum, read_trajectory),
        Surface("covariance.npz", written(lambda p: save_npz(p, {"covariance": np.tile(np.eye(6), (5, 1, 1))})), read_covariance),
        Surface("intrinsics.json", json.dumps(camera).encode(), read_camera),
        Surface("intrinsics.txt", b"50 50 32 24\n", read_camera),
        Surface("times.txt", b"0.0\n0.1\n0.2\n", read_times),
        Surface("wheel.txt", b"0.5\n0.1\n0.2\n", read_lengths),
        Surface("scenes.jsonl", lines([scene, scene]), lambda p: SceneFolder(p).batch([0]), (("images/a.png", png),)),
        Surface("voxels.npz", written(lambda p: save_npz(p, voxels)), read_voxels),
        Surface("objects.json", json.dumps([known]).encode(), read_objects),
        Surface("a.png", png, open_image),
        Surface("a.jpg", encoded(picture, "JPEG"), open_image),
        Surface("a.tiff", encoded(picture[..., 0].astype(np.uint16) * 200, "TIFF"), open_image),
        Surface("a.ppm", encoded(picture, "PPM"), open_image),
        Surface("a.webp", encoded(picture, "WEBP"), open_image),
        Surface(
            "config.json",
            json.dumps({"model": nano().to_json(), "calibration": {"shape_scale": 1.0}}).encode(),
            read_model_config,
        ),
        Surface("model.safetensors", written(store_tensors), lambda p: load_tensors(p)[1]),
        *run_surfaces(),
    ]


def run_surfaces() -> list[Surface]:
    """Files of a run, read by the report."""
    from nolbo_ppl.report import read_run

    landmark = {"name": "L0", "position": [1.0, 0.0, 3.0], "position_covariance": np.eye(3).tolist(), "existence": 0.9}
    landmark |= {"detections": 3.0, "first_frame": 0, "last_frame": 3, "rotation": [0, 0, 0, 1], "category": "chair"}
    landmark |= {"class_posterior": {"chair": 0.9, "sofa": 0.1}, "size": [1.0, 1.0, 1.0]}
    way = "".join(f"1 0 0 {k} 0 1 0 0 0 0 1 0\n" for k in range(4)).encode()
    rows = "".join(
        json.dumps({"id": f"d{k}", "landmarks": {"L0": 0.9}, "new": 0.05, "background": 0.05}) + "\n" for k in range(3)
    )
    frames = "".join(json.dumps({"frame": k, "image": f"{k}.png", "index": k, "time": 0.1 * k}) + "\n" for k in range(4))
    buffer = io.BytesIO()
    np.savez_compressed(buffer, T_world_camera=np.tile(np.eye(4, dtype=np.float32), (2, 4, 1, 1)), landmarks_0=np.zeros((1, 3)))
    files = {
        "trajectory.txt": way,
        "landmarks.json": json.dumps([landmark]).encode(),
        "associations.jsonl": rows.encode(),
        "frames.jsonl": frames.encode(),
        "iterations.npz": buffer.getvalue(),
        "summary.json": json.dumps({"warnings": ["x"], "iterations": [{"change": 1.0}], "before": {"ate": 1.0}}).encode(),
    }

    def read(path: Path) -> Any:
        run = read_run(path.parent)
        return run.estimate, run.iterations, run.landmarks, run.associations

    beside = {name: tuple((other, content) for other, content in files.items() if other != name) for name in files}
    return [Surface(name, files[name], read, beside[name], missing=True) for name in files]


def fuzz(chosen: list[Surface], seconds: float, seed: int, keep: Path | None = None, most: int = 10**9) -> dict[str, Counts]:
    """Take the surfaces in turn until the time is over, or `most` inputs of each."""
    counts = {surface.name: Counts() for surface in chosen}
    rng, end = random.Random(seed), time.monotonic() + seconds
    with tempfile.TemporaryDirectory() as scratch:
        for turn in range(most):
            for surface in chosen:
                if time.monotonic() > end:
                    return counts
                data = mutate(surface, rng) if turn else surface.good
                answer, count = judge(surface, data, Path(scratch) / "input"), counts[surface.name]
                count.inputs += 1
                if answer is None:
                    count.accepted += 1
                elif not answer and turn:
                    count.clear += 1
                else:
                    count.defects.append(answer or "the good file is refused")
                    if keep is not None:
                        keep.mkdir(parents=True, exist_ok=True)
                        (keep / f"{count.inputs}-{surface.name}").write_bytes(data)
    return counts


def main() -> int:
    """Command line: fuzz, print the table, write the report; status 1 with a defect."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("build/fuzz.json"))
    parser.add_argument("--only", nargs="*", default=[], help="names of surfaces")
    options = parser.parse_args()
    chosen = [one for one in surfaces() if not options.only or one.name in options.only]
    counts = fuzz(chosen, options.seconds, options.seed, options.out.parent / "fuzz-defects")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps({name: asdict(count) for name, count in counts.items()}, indent=2) + "\n")
    print(f"{'surface':<22}{'inputs':>9}{'clear':>9}{'accepted':>9}{'defects':>9}")
    for name, count in counts.items():
        print(f"{name:<22}{count.inputs:>9}{count.clear:>9}{count.accepted:>9}{len(count.defects):>9}")
        for defect in sorted(set(count.defects))[:5]:
            print(f"    {defect[:200]}")
    return int(any(count.defects for count in counts.values()))


if __name__ == "__main__":
    sys.exit(main())
