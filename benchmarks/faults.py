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
import contextlib
import errno
import hashlib
import importlib
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
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

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
LIMIT = 120.0
"""Seconds after which a run counts as hanging."""


@dataclass(frozen=True)
class Verb:
    """A command at tiny size."""

    name: str
    arguments: tuple[str, ...]
    """Without `--out`."""
    out: str = "out"
    """Name of the output, in the scratch folder."""
    at_once: bool = True
    """Whether its results appear all at once."""
    inputs: tuple[Path, ...] = ()
    """Files that may vanish."""


@dataclass
class Outcome:
    """What the faults found."""

    runs: dict[str, int] = field(default_factory=dict)
    """Faults that struck, by verb and kind; a run may end before its fault."""
    late: int = 0
    """Runs that ended before their fault."""
    defects: list[str] = field(default_factory=list)
    """What went wrong."""


def heavy_imports(verbs: set[str]) -> None:
    """All that the verbs import, once, before the forks."""
    import torch

    torch.set_num_threads(1)
    more = {
        "slam": ("viz.map_plots", "inference.slam.incremental.incremental_slam"),
        "observe": ("viz.posterior_plots",),
        "run": ("viz.map_plots", "report"),
        "train": ("training.trainer",),
    }
    for verb in sorted(verbs):
        for name in (f"cli.{verb}", *more.get(verb, ())):
            importlib.import_module(f"nolbo_ppl.{name}")


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


def small_chunks() -> None:
    """Many jobs and checkpoints at tiny size."""
    from nolbo_ppl.synthetic import dataset_writer
    from nolbo_ppl.synthetic.worlds import sequence_folder

    dataset_writer.CHUNK, sequence_folder.CHUNK = 2, 2


class Stage:
    """A scratch folder with inputs, and runs of verbs in it."""

    def __init__(self, scratch: Path) -> None:
        self.scratch = scratch
        self.text = ""

    def run(self, verb: Verb, fault: Callable[[str, tuple[Any, ...]], None] | None = None, after: float | None = None) -> int:
        """Fork, run the verb, return its status (negative: a signal).

        Args:
            verb: what to run.
            fault: an audit hook.
            after: seconds after which it is killed.
        """
        read, write = os.pipe()  # not a file: limits of their size would cut what is said
        os.set_blocking(read, False)
        child = os.fork()
        if not child:
            os.setsid()
            os.dup2(write, 1)
            os.dup2(write, 2)
            status = 1
            try:
                from nolbo_ppl.cli import main

                signal.signal(signal.SIGINT, signal.default_int_handler)
                signal.signal(signal.SIGTERM, signal.SIG_DFL)
                small_chunks()
                if fault is not None:
                    sys.addaudithook(fault)
                main([*verb.arguments, "--out", str(self.scratch / verb.out)])
                status = 0
            except SystemExit as stop:
                status = stop.code if isinstance(stop.code, int) else 1
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(status)
        os.close(write)
        said, end, done, status = b"", time.monotonic() + (LIMIT if after is None else after), 0, 0
        while not done and time.monotonic() < end:
            done, status = os.waitpid(child, os.WNOHANG)
            with contextlib.suppress(BlockingIOError):
                while part := os.read(read, 1 << 16):
                    said += part
            time.sleep(0.002)
        os.close(read)
        self.text = said.decode(errors="replace")
        if done:
            return os.waitstatus_to_exitcode(status)
        os.killpg(child, signal.SIGKILL)
        os.waitpid(child, 0)
        return -signal.SIGKILL if after is not None else 124

    def said(self) -> str:
        """What the last run wrote."""
        return self.text


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
                    number = errno.ENOSPC if kind == "full" else errno.EROFS
                    busy = False
                    raise OSError(number, os.strerror(number), str(arguments[0]))
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


SIMULATE = ("simulate", "--frames", "30", "--laps", "2", "--radius", "8", "--world.objects", "10")
SCENES = ("scenes", "--count", "6", "--size", "64", "--difficulty", "easy", "--instances", "1", "--workers", "1")
DRIVE = (
    *("drive", "--world", "indoor", "--frames", "4", "--step", "2", "--laps", "0.2", "--size", "96", "64", "--objects", "8"),
    *("--clutter", "2", "--seed", "4", "--workers", "1"),
)
TRAIN = (
    *("train", "--preset", "nano", "--batch", "2", "--shape-batch", "2", "--shape-steps", "3", "--single-steps", "2"),
    *("--scene-steps", "3", "--checkpoint-every", "1", "--log-every", "1", "--evaluate-every", "2", "--evaluate-scenes", "2"),
    *("--threads", "1", "--no-bf16"),
)
BOXES = {
    "images": [{"id": 1, "file_name": "000000.png", "width": 96, "height": 64}],
    "categories": [{"id": 1, "name": "chair"}],
    "annotations": [{"image_id": 1, "category_id": 1, "bbox": [10, 10, 20, 30], "score": 0.9}],
}
CAMERA = {"fx": 70.0, "fy": 70.0, "cx": 32.0, "cy": 32.0, "width": 64, "height": 64}
ROOTS = {"world": SIMULATE, "scenes": SCENES, "drive": DRIVE}
"""Inputs that verbs make."""


def verbs_of(given: Path) -> list[tuple[Verb, str]]:
    """All verbs that write, and the folder of `ROOTS` that each needs (empty: none); inputs lie below `given`."""
    world, scenes, drive = given / "world", given / "scenes", given / "drive"
    camera, poses, boxes = given / "camera.json", given / "poses.txt", given / "boxes.json"
    slam = ("slam", "--odometry", str(world / "odometry.txt"), "--observations", str(world / "observations.jsonl"))
    seen = (str(scenes / "images"), str(camera))
    way = ("--scale", "truth", "--truth", str(drive / "truth.txt"))
    drawn = (str(drive / "images"), str(drive / "intrinsics.json"))
    return [
        (Verb("simulate", SIMULATE), ""),
        (Verb("slam", (*slam, "--truth", str(world / "truth.txt"))), "world"),
        (
            Verb("convert", ("convert", "detections", "--data", str(boxes), "--format", "coco", "--intrinsics", str(camera))),
            "boxes",
        ),
        (Verb("slam --online", (*slam, "--online")), "world"),
        (Verb("scenes", SCENES, at_once=False), ""),
        (Verb("drive", DRIVE, at_once=False), ""),
        (Verb("evaluate", ("evaluate", "--scenes", str(scenes), "--count", "4", "--resamples", "20", "--no-pictures")), "scenes"),
        (Verb("observe", ("observe", "--images", seen[0], "--model", "tiny", "--camera", seen[1])), "scenes"),
        (
            Verb("odometry", ("odometry", "--images", drawn[0], "--intrinsics", drawn[1], *way)),
            "drive",
        ),
        (
            Verb(
                "run",
                (
                    "run",
                    "--images",
                    seen[0],
                    "--intrinsics",
                    seen[1],
                    "--odometry",
                    str(poses),
                    "--test-sizes",
                    "128",
                    "--score-threshold",
                    "0.3",
                ),
                at_once=False,
            ),
            "scenes",
        ),
        (Verb("train", (*TRAIN, "--scenes", str(scenes)), at_once=False), "scenes"),
    ]


def stage_inputs(stage: Stage, only: tuple[str, ...]) -> list[Verb]:
    """Make tiny inputs below `in`; the chosen verbs, on them."""
    given = stage.scratch / "in"
    given.mkdir()
    (given / "boxes.json").write_text(json.dumps(BOXES))
    (given / "camera.json").write_text(json.dumps(CAMERA))
    (given / "poses.txt").write_text("".join(f"1 0 0 {0.1 * k} 0 1 0 0 0 0 1 0\n" for k in range(6)))
    chosen = [(verb, root) for verb, root in verbs_of(given) if not only or verb.name in only]
    for root in {root for _, root in chosen} & set(ROOTS):
        status = stage.run(Verb(root, ROOTS[root], f"in/{root}"))
        if status:
            raise RuntimeError(f"{ROOTS[root]} ends with {status}: {stage.said()[-2000:]}")
    files = {root: tuple(sorted(p for p in (given / root).rglob("*.*") if p.is_file())) for root in ROOTS}
    files["boxes"] = (given / "boxes.json", given / "camera.json")
    return [replace(verb, inputs=files.get(root, ())) for verb, root in chosen]


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
