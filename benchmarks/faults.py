"""Faults injected into every verb that writes: kills, signals, a full or read-only disk, inputs that vanish.

    python benchmarks/faults.py --count 100 --out build/faults.json        (make faults)

Each verb runs undisturbed once, at tiny size. Then it is disturbed again and again: at a random call that opens, moves or
deletes a file under its output (or reads one of its inputs), or at a random time. Afterwards

- nothing half-written stands under a final name, and a result that appears at once is the complete one or not there;
- the status is the signal's (130, 143), or 2 with one line that tells why, without a traceback, and no temporary file is left;
- the same command again ends with the same files as the run that nothing disturbed.

Runs are forked from one process that has imported everything, so that the faults fall into the work and not into the start.
"""

from __future__ import annotations

import argparse
import errno
import hashlib
import json
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from forked_verbs import Stage, Verb, heavy_imports, stage_inputs, verbs_of

CLOCK = {
    "seconds",
    "cpu_seconds",
    "images_per_second",
    "waited",
    "waiting",
    "share_of_em",
    "seconds_per_image",
    "frames_per_second",
}
"""Keys of JSON whose values depend on the clock."""
KINDS = ("kill", "kill-late", "interrupt", "terminate", "full", "read-only", "vanish", "small")
"""Faults: SIGKILL at a call or at a time, SIGINT, SIGTERM, ENOSPC and EROFS at a call, an input deleted at a call, and a limit
of the system on the size of files."""
WRITES = {"os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate"}


@dataclass
class Outcome:
    """What the faults found."""

    runs: dict[str, int] = field(default_factory=dict)
    """Faults that struck, by verb and kind; a run may end before its fault."""
    late: int = 0
    """Runs that ended before their fault."""
    defects: list[str] = field(default_factory=list)
    """What went wrong."""


def of_output(event: str, arguments: tuple[Any, ...], out: str) -> bool:
    """Whether an audit event changes something under a path."""
    if event == "open":
        path, mode, flags = arguments
        writes = any(letter in mode for letter in "wax+") if mode else bool(flags & (os.O_WRONLY | os.O_RDWR))
        return writes and isinstance(path, str | os.PathLike) and os.fspath(path).startswith(out)
    return event in WRITES and any(isinstance(a, str | os.PathLike) and str(os.fspath(a)).startswith(out) for a in arguments[:2])


def of_input(event: str, arguments: tuple[Any, ...], folder: str) -> bool:
    """Whether an audit event opens an input."""
    return event == "open" and isinstance(arguments[0], str | os.PathLike) and str(os.fspath(arguments[0])).startswith(folder)


def settled(value: Any) -> Any:
    """A JSON value without the clock."""
    if isinstance(value, dict):
        return {key: settled(item) for key, item in value.items() if key not in CLOCK}
    return [settled(item) for item in value] if isinstance(value, list) else value


def digest(path: Path) -> str:
    """What a file holds, the clock aside; raises where it cannot be read."""
    import numpy as np
    from PIL import Image
    from safetensors import safe_open

    data = path.read_bytes()
    match path.suffix:
        case ".json":
            data = json.dumps(settled(json.loads(data))).encode()
        case ".jsonl":
            data = json.dumps([settled(json.loads(line)) for line in data.splitlines()]).encode()
        case ".npz":
            with np.load(path) as archive:
                data = b"".join(name.encode() + archive[name].tobytes() for name in archive.files)
        case ".png":
            with Image.open(path, formats=("PNG",)) as image:
                data = image.tobytes()
        case ".safetensors":
            with safe_open(path, "np") as archive:  # type: ignore[no-untyped-call]
                data = b"".join(name.encode() + archive.get_tensor(name).tobytes() for name in sorted(archive.keys()))
        case ".html":  # tells times
            if not data.rstrip().endswith(b"</html>"):
                raise ValueError("cut")
            data = b""
    return hashlib.sha256(data).hexdigest()


def standing(out: Path) -> dict[str, str]:
    """Files under their final names and what they hold; what is under way lies under names of its own."""
    from nolbo_ppl.io.files import TEMPORARY
    from nolbo_ppl.io.output_folder import COMPLETE, LOCK, NEW

    def final(path: Path) -> bool:
        parts = path.relative_to(out.parent).parts
        return not any(part in (LOCK, NEW, COMPLETE, ".parts") or TEMPORARY.fullmatch(part) for part in parts)

    files = [out] if out.is_file() else sorted(out.rglob("*"))
    return {str(path.relative_to(out.parent)): digest(path) for path in files if path.is_file() and final(path)}


def leftovers(out: Path) -> list[str]:
    """Hidden files and folders: what a run that was not killed has no business to leave."""
    beside = [path for path in out.parent.glob(".*") if path.name != ".."]
    return [str(path) for path in [*beside, *(out.rglob(".*") if out.is_dir() else ())] if path.name != ".parts"]


def fault_of(kind: str, number: int, verb: Verb, scratch: Path) -> Callable[[str, tuple[Any, ...]], None]:
    """The audit hook that strikes at the `number`-th call, and counts all of them where it never does."""
    out, inputs = str(scratch / verb.out), str(scratch / "in")
    left, busy = number, False

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal left, busy
        if busy or not (of_input(event, arguments, inputs) if kind == "vanish" else of_output(event, arguments, out)):
            return
        left -= 1
        if left >= 0:
            return
        busy = True
        match kind:
            case "kill":
                os.kill(os.getpid(), signal.SIGKILL)
            case "interrupt" | "terminate":
                if left == -1:
                    os.kill(os.getpid(), signal.SIGINT if kind == "interrupt" else signal.SIGTERM)
            case "full" | "read-only":
                if event != "os.remove" and event != "os.rmdir":
                    code = errno.ENOSPC if kind == "full" else errno.EROFS
                    busy = False
                    raise OSError(code, os.strerror(code), str(arguments[0]))
            case "vanish":
                if left == -1:
                    name = os.fspath(arguments[0])
                    if os.path.isfile(name):
                        os.remove(name)
        busy = False

    return hook


def calls_of(stage: Stage, verb: Verb, reading: bool) -> int:
    """How many calls of a run a fault can strike at."""
    out, inputs, counter = str(stage.scratch / verb.out), str(stage.scratch / "in"), stage.scratch / "calls"
    counter.write_bytes(b"")

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if of_input(event, arguments, inputs) if reading else of_output(event, arguments, out):
            descriptor = os.open(counter, os.O_WRONLY | os.O_APPEND)
            os.write(descriptor, b"x")
            os.close(descriptor)

    stage.run(verb, hook)
    return counter.stat().st_size


def clear(out: Path) -> None:
    """Nothing under the output and beside it."""
    shutil.rmtree(out, ignore_errors=True)
    out.unlink(missing_ok=True)


@dataclass(frozen=True)
class Reference:
    """A run that nothing disturbed."""

    files: dict[str, str]
    seconds: float
    writes: int
    reads: int


def reference_of(stage: Stage, verb: Verb) -> Reference:
    """Run a verb undisturbed; raises where it fails."""
    out = stage.scratch / verb.out
    clear(out)
    start = time.monotonic()
    status = stage.run(verb)
    seconds = time.monotonic() - start
    if status:
        raise RuntimeError(f"{verb.name} ends with {status}: {stage.said()[-2000:]}")
    files = standing(out)
    clear(out)
    writes = calls_of(stage, verb, reading=False)
    clear(out)
    reads = calls_of(stage, verb, reading=True) if verb.inputs else 0
    clear(out)
    return Reference(files, seconds, writes, reads)


def strike(stage: Stage, verb: Verb, reference: Reference, kind: str, rng: random.Random) -> tuple[bool, list[str]]:
    """One fault; whether it struck, and what is wrong afterwards."""
    out = stage.scratch / verb.out
    if kind != "vanish" and rng.random() < 0.3 and verb.at_once and stage.run(verb):  # over an older result
        return True, [f"{verb.name} before {kind}: {stage.said()[-300:]}"]
    older = out.exists()
    at = rng.randrange(max(reference.reads if kind == "vanish" else reference.writes, 1))
    what = f"{verb.name}, {kind} at {at}{' over an older result' if older else ''}"
    inputs = {path: path.read_bytes() for path in verb.inputs} if kind == "vanish" else {}
    if kind == "kill-late":
        status = stage.run(verb, after=rng.uniform(0.0, reference.seconds))
    elif kind == "small":
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (rng.choice((0, 50, 500, 5000, 50_000)), before[1]))
        try:
            status = stage.run(verb)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
    else:
        status = stage.run(verb, fault_of(kind, at, verb, stage.scratch))
    for path, data in inputs.items():
        path.write_bytes(data)
    wrong = judge(stage, verb, reference, kind, status, older)
    struck = status != 0
    again = stage.run(verb)
    if again:
        wrong.append(f"the same command again ends with {again}: {stage.said()[-300:]}")
    else:
        files = standing(out)
        if files != reference.files:
            differing = sorted({k for k in {*files, *reference.files} if files.get(k) != reference.files.get(k)})
            wrong.append(f"the same command again gives other files: {differing[:5]}")
        if leftovers(out):
            wrong.append(f"left over after the same command again: {leftovers(out)[:3]}")
    clear(out)
    return struck, [f"{what}: {text}" for text in wrong]


def judge(stage: Stage, verb: Verb, reference: Reference, kind: str, status: int, older: bool) -> list[str]:
    """What is wrong right after a fault."""
    out, said, wrong = stage.scratch / verb.out, stage.said(), []
    expected = {
        "kill": (0, -signal.SIGKILL),
        "kill-late": (0, -signal.SIGKILL),
        "interrupt": (0, 128 + signal.SIGINT),
        "terminate": (0, 128 + signal.SIGTERM),
    }.get(kind, (0, 2))
    if status not in expected:
        wrong.append(f"status {status}, not one of {expected}: {said[-400:]}")
    if "Traceback" in said:
        wrong.append(f"a traceback: {said[-600:]}")
    if status > 0 and not re.search(rf"^nolbo {verb.arguments[0]}: .+", said, re.MULTILINE):
        wrong.append(f"no line that tells why: {said[-300:]!r}")
    if status in (0, 2, 130, 143) and kind not in ("full", "read-only") and leftovers(out):
        wrong.append(f"left over: {leftovers(out)[:3]}")
    if not out.exists():
        return [*wrong, "the older result is gone"] if older else wrong
    try:
        files = standing(out)
    except Exception as error:
        return [*wrong, f"half-written: {type(error).__name__}: {error}"]
    moving = (out / ".nolbo-complete").exists()
    if verb.at_once and files and files != reference.files and not moving:
        wrong.append(f"neither complete nor absent: {sorted(set(reference.files) - set(files))[:5]} missing")
    return [*wrong, "the older result is gone"] if older and verb.at_once and not files and not moving else wrong


def inject(count: int, seed: int, only: tuple[str, ...] = (), kinds: tuple[str, ...] = KINDS, seconds: float = 1e9) -> Outcome:
    """Strike each verb in turn, `count` times in all or until the time is over."""
    names = {verb.arguments[0] for verb, _ in verbs_of(Path()) if not only or verb.name in only}
    heavy_imports(names | {"simulate", *(("scenes",) if names - {"simulate", "slam", "convert"} else ())})
    outcome, rng, end = Outcome(), random.Random(seed), time.monotonic() + seconds
    with tempfile.TemporaryDirectory() as folder:
        stage = Stage(Path(folder).resolve())
        verbs = stage_inputs(stage, only)
        references: dict[str, Reference] = {}
        for turn in range(count):
            if time.monotonic() > end:
                break
            verb = verbs[turn % len(verbs)]
            kind = kinds[(turn + turn // len(kinds)) % len(kinds)]
            if kind == "vanish" and not verb.inputs:
                kind = "kill"
            if verb.name not in references:
                references[verb.name] = reference_of(stage, verb)
            start = time.monotonic()
            struck, wrong = strike(stage, verb, references[verb.name], kind, rng)
            outcome.defects += wrong
            if struck:
                key = f"{verb.name}: {kind}"
                outcome.runs[key] = outcome.runs.get(key, 0) + 1
            else:
                outcome.late += 1
            result = "; ".join(wrong) or ("held" if struck else "too late")
            print(f"{turn:>4} {verb.name:<14} {kind:<10} {time.monotonic() - start:6.1f} s  {result}", flush=True)
    return outcome


def main() -> int:
    """Command line: inject faults, print and write what was found; status 1 with a defect."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=1e9)
    parser.add_argument("--out", type=Path, default=Path("build/faults.json"))
    parser.add_argument("--only", nargs="*", default=[], help="names of verbs")
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), choices=KINDS)
    options = parser.parse_args()
    outcome = inject(options.count, options.seed, tuple(options.only), tuple(options.kinds), options.seconds)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(vars(outcome), indent=2) + "\n")
    print(f"{sum(outcome.runs.values())} faults struck, {outcome.late} came too late, {len(outcome.defects)} defects")
    for name, number in sorted(outcome.runs.items()):
        print(f"    {name:<28}{number:>5}")
    return int(bool(outcome.defects))


if __name__ == "__main__":
    sys.exit(main())
