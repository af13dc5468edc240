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
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from fuzz_surfaces import Surface

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
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
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
    from foreign_surfaces import foreign_surfaces
    from fuzz_surfaces import own_surfaces

    own = own_surfaces()
    return [*own, *foreign_surfaces(next(one.good for one in own if one.name == "a.png"))]


def fuzz(chosen: list[Surface], seconds: float, seed: int, keep: Path | None = None, most: int = 10**9) -> dict[str, Counts]:
    """Take the surfaces in turn until the time is over, or `most` inputs of each."""
    counts = {surface.name: Counts() for surface in chosen}
    rng, end = random.Random(seed), time.monotonic() + seconds
    with tempfile.TemporaryDirectory() as scratch:
        for turn in range(most):
            for surface in chosen:
                if turn and time.monotonic() > end:  # the good files first, however slow the machine is
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
