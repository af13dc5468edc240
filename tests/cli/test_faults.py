"""Faults injected into real verbs (`make faults` strikes all of them), and that the judge of those sees what breaks."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nolbo_ppl.cli import main
from nolbo_ppl.errors import InputError
from nolbo_ppl.io.npz import save_npz
from nolbo_ppl.io.output_folder import contents, output_folder

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
import faults
from forked_verbs import Stage, Verb, verbs_of

ROOT = Path(__file__).resolve().parents[2]
SMALL = ("--frames", "12", "--laps", "1", "--radius", "6", "--world.objects", "4")


@pytest.mark.slow
def test_no_fault_breaks_a_verb(tmp_path: Path) -> None:
    """Every kind of fault once, on verbs that take less than a second."""
    program = [sys.executable, str(ROOT / "benchmarks" / "faults.py"), "--count", "8", "--only", "simulate", "convert"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [*program, "--out", str(tmp_path / "f.json")], capture_output=True, text=True, env=environment, check=False
    )
    found = json.loads((tmp_path / "f.json").read_text())
    assert done.returncode == 0, done.stdout + done.stderr
    assert not found["defects"]
    assert sum(found["runs"].values()) >= 5
    assert {name.partition(": ")[0] for name in found["runs"]} == {"simulate", "convert"}


def test_every_verb_that_writes_is_struck() -> None:
    from nolbo_ppl.cli import VERBS

    struck = {verb.arguments[0] for verb, _ in verbs_of(Path("in"))}
    # demo calls drive and run; report, curves and data write one file by `atomic_path`; view writes nothing. merge and export
    # write their folder as slam does, by `output_folder`; reproduce trains as train does and writes its tables one by one.
    assert set(VERBS) - struck == {"demo", "report", "curves", "data", "view", "merge", "export", "reproduce"}


def stage_with(tmp_path: Path, said: str) -> Stage:
    stage = Stage(tmp_path)
    stage.text = said
    return stage


VERB = Verb("v", ("v",))
SAID = "nolbo v: out of luck\n"


@pytest.mark.parametrize(
    ("kind", "status", "said", "wrong"),
    [
        ("kill", -signal.SIGKILL, "", None),
        ("interrupt", 130, SAID, None),
        ("terminate", 143, SAID, None),
        ("full", 2, SAID, None),
        ("full", 1, SAID, "status 1"),
        ("interrupt", 2, SAID, "status 2"),
        ("kill", 124, "", "status 124"),
        ("read-only", 2, "Traceback (most recent call last)\n" + SAID, "a traceback"),
        ("vanish", 2, "", "no line that tells why"),
    ],
)
def test_the_judge_knows_statuses_and_messages(kind: str, status: int, said: str, wrong: str | None, tmp_path: Path) -> None:
    found = faults.judge(stage_with(tmp_path, said), VERB, faults.Reference({}, 1.0, 1, 1), kind, status, older=False)
    assert not found if wrong is None else wrong in found[0]


def test_the_judge_reads_every_file(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "a.json").write_text('{"seconds": 1.5, "kept": [1, {"seconds": 2}]}')
    (out / "b.jsonl").write_text('{"a": 1}\n{"a": 2}\n')
    save_npz(out / "c.npz", {"x": np.arange(3.0)})
    whole = faults.Reference(faults.standing(out), 1.0, 1, 1)
    (out / "a.json").write_text('{"seconds": 3.5, "kept": [1, {"seconds": 1}]}')
    (out / ".x.12.tmp.json").write_text("half")
    (out / ".nolbo-new").mkdir()
    (out / ".nolbo-new" / "a.json").write_text("half")
    stage = stage_with(tmp_path, "")

    def judged(status: int = -9) -> str:
        return " ".join(faults.judge(stage, VERB, whole, "kill", status, older=True))

    assert judged() == ""
    assert "left over" in judged(0)
    (out / "a.json").write_text('{"kept": [2]}')
    assert "neither complete nor absent" in judged()
    (out / "b.jsonl").write_text('{"a": 1}\n{"a"')
    assert "half-written" in judged()
    for name in ("a.json", "b.jsonl", "c.npz"):
        (out / name).unlink()
    assert "the older result is gone" in judged()


def test_hooks_strike_at_the_call_they_are_told(tmp_path: Path) -> None:
    inside, given = str(tmp_path / "out" / "a.json"), tmp_path / "in" / "a.json"
    hook = faults.fault_of("full", 1, VERB, tmp_path)
    hook("open", (inside, "r", os.O_RDONLY))
    hook("open", ("/elsewhere", "w", os.O_WRONLY))
    hook("open", (inside, "w", os.O_WRONLY))
    for _ in range(2):  # a disk that is full stays full
        with pytest.raises(OSError, match="No space") as caught:
            hook("os.rename", (inside, inside + "2", -1, -1))
        assert caught.value.errno == errno.ENOSPC
    hook("os.remove", (inside, -1))
    given.parent.mkdir()
    given.write_text("x")
    faults.fault_of("vanish", 0, VERB, tmp_path)("open", (str(given), None, os.O_RDONLY))
    assert not given.exists()


def test_an_interrupt_among_the_moves_ends_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever call Ctrl-C falls on, before it or after it, nothing is left over: the new result is there, or none."""
    seen = set()
    for number in range(2 * 30):
        calls = 0

        def counted(function: Callable[..., Any]) -> Callable[..., Any]:
            def call(*names: Any, **options: Any) -> Any:
                nonlocal calls
                calls += 1
                mine = calls == number // 2 + 1  # noqa: B023 - called within the turn
                if mine and number % 2:  # noqa: B023
                    function(*names, **options)
                if mine:
                    raise KeyboardInterrupt
                return function(*names, **options)

            return call

        out = tmp_path / str(number) / "out"
        with monkeypatch.context() as patch:
            places = ((os, "replace"), (Path, "unlink"), (Path, "rmdir"), (shutil, "rmtree"))
            for owner, name in places:
                patch.setattr(owner, name, counted(getattr(owner, name)))
            try:
                with output_folder(out, ("a", "b"), is_own=lambda _: False) as folder:
                    (folder / "a").write_text("a")
                    (folder / "b").write_text("b")
            except KeyboardInterrupt:
                pass
            else:
                break
        found = sorted(path.name for path in out.iterdir()) if out.exists() else []
        assert found in ([], ["a", "b"]), (number, found)
        assert found or not (tmp_path / str(number)).exists(), number
        seen.add(tuple(found))
    else:
        pytest.fail("the calls never ended")
    assert seen == {(), ("a", "b")}


def test_simulate_replaces_nothing_of_others(tmp_path: Path) -> None:
    out = tmp_path / "world"
    out.mkdir()
    (out / "odometry.txt").write_text("mine")
    with pytest.raises(SystemExit) as stop:
        main(["simulate", "--out", str(out), *SMALL])
    assert stop.value.code == 2
    assert contents(out) == ["odometry.txt"] and (out / "odometry.txt").read_text() == "mine"
    main(["simulate", "--out", str(tmp_path / "own"), *SMALL])
    main(["simulate", "--out", str(tmp_path / "own"), *SMALL])
    from nolbo_ppl.cli.simulate import SimulateConfig, run

    with pytest.raises(InputError, match="would replace an input"):
        run(SimulateConfig(tmp_path / "own", trajectory=tmp_path / "own" / "truth.txt"))
