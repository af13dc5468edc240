"""The verbs of the command line at tiny size, each run in a fork of a process that has imported everything."""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

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
                    "--model",
                    "tiny",
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
