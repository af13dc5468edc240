"""Output folders: locked, complete or unchanged after a kill at any moment, and never over somebody else's files."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.io import output_folder as module
from nolbo_ppl.io.output_folder import COMPLETE, LOCK, NEW, contents, locked, output_folder, settle

OWN = ("a.txt", "b.txt", "images", "record.json")


def is_own(folder: Path) -> bool:
    return (folder / "record.json").is_file()


def write(out: Path, text: str, names: tuple[str, ...] = OWN, **options: object) -> None:
    with output_folder(out, OWN, is_own=is_own, **options) as folder:
        for name in names:
            if name == "images":
                (folder / name).mkdir()
                (folder / name / f"{text}.png").write_text(text)
            else:
                (folder / name).write_text(text)


def state(out: Path) -> dict[str, str]:
    return {str(p.relative_to(out)): p.read_text() for p in sorted(out.rglob("*")) if p.is_file()}


def test_a_result_takes_the_place_of_an_older_one_and_leaves_the_rest(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    write(out, "old")
    assert sorted(state(out)) == ["a.txt", "b.txt", "images/old.png", "record.json"]
    (out / "notes.txt").write_text("mine")
    write(out, "new", ("a.txt", "images", "record.json"))
    assert state(out) == {"a.txt": "new", "images/new.png": "new", "record.json": "new", "notes.txt": "mine"}


def test_a_failure_changes_nothing(tmp_path: Path) -> None:
    for out in (tmp_path / "none" / "deep", tmp_path / "old"):
        if out.name == "old":
            write(out, "old")
        before = state(out) if out.exists() else None
        with pytest.raises(RuntimeError), output_folder(out, OWN, is_own=is_own) as folder:
            (folder / "a.txt").write_text("half")
            raise RuntimeError
        assert (state(out) if out.exists() else None) == before
    assert not (tmp_path / "none").exists()


def test_killed_at_any_step_of_the_move_the_result_is_the_old_or_the_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every call that changes the disk in turn is the last one; whoever comes next finds the old or the new result, whole."""
    write(tmp_path / "reference", "old")
    old = state(tmp_path / "reference")
    write(tmp_path / "reference", "new", ("a.txt", "images", "record.json"))
    new = state(tmp_path / "reference")

    class Killed(BaseException):
        pass

    def counted(function: object, calls: list[int], last: int) -> object:
        def call(*arguments: object, **options: object) -> object:
            calls.append(1)
            if len(calls) > last:
                raise Killed
            return function(*arguments, **options)

        return call

    seen = set()
    for last in range(30):
        out = tmp_path / f"out-{last}"
        write(out, "old")
        calls: list[int] = []
        with monkeypatch.context() as patch:
            for owner, name in ((os, "replace"), (Path, "unlink"), (Path, "rmdir"), (module, "_remove")):
                patch.setattr(owner, name, counted(getattr(owner, name), calls, last))
            try:
                write(out, "new", ("a.txt", "images", "record.json"))
            except Killed:
                pass
            else:
                break
        settle(out)
        found = {name: text for name, text in state(out).items() if not name.startswith((LOCK, NEW))}
        assert found in (old, new), (last, found)
        seen.add(found == new)
        write(out, "third")
        assert set(state(out).values()) == {"third"}
    else:
        pytest.fail("the move never ended")
    assert seen == {False, True}


def test_files_of_others_stay(tmp_path: Path) -> None:
    out = tmp_path / "stranger"
    out.mkdir()
    (out / "a.txt").write_text("theirs")
    with pytest.raises(InputError, match=r"stranger: the folder holds something else: got a\.txt"):
        write(out, "new")
    assert state(out) == {"a.txt": "theirs"}
    (out / "a.txt").rename(out / "c.txt")
    write(out, "new")
    assert state(out)["c.txt"] == "theirs"


def test_inputs_stay(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write(out, "old")
    (tmp_path / "link").symlink_to(out)
    for given in (out / "a.txt", out / "images" / "old.png", tmp_path / "link" / "b.txt", out / ".." / "out" / "a.txt"):
        with pytest.raises(InputError, match="would replace an input"):
            write(out, "new", inputs=(None, given))
    assert set(state(out).values()) == {"old"}
    (out / "input.txt").write_text("input")
    write(out, "new", inputs=(out / "input.txt",))


def test_a_file_where_the_folder_should_be(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="the output is a file"):
        write(tmp_path / "file", "new")
    with pytest.raises(OSError, match="Not a directory") as caught:
        write(tmp_path / "file" / "deep", "new")
    assert str(tmp_path / "file") in str(caught.value.filename)


def test_a_second_process_is_told(tmp_path: Path) -> None:
    program = (
        "import sys; from nolbo_ppl.io.output_folder import locked\n"
        "with locked(sys.argv[1]):\n print('held', flush=True)\n sys.stdin.read()"
    )
    command = [sys.executable, "-c", program, str(tmp_path / "out")]
    other = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert other.stdin is not None
    assert other.stdout is not None
    assert other.stdout.readline() == b"held\n"
    with pytest.raises(InputError, match=rf"another process writes into the folder: got process {other.pid} on"):
        write(tmp_path / "out", "new")
    other.kill()
    other.wait()
    other.stdin.close()
    other.stdout.close()
    assert (tmp_path / "out" / LOCK).is_file(), "a killed process leaves its lock"
    write(tmp_path / "out", "new")
    assert LOCK not in os.listdir(tmp_path / "out")


def test_a_lock_of_another_machine_is_believed(tmp_path: Path) -> None:
    (tmp_path / LOCK).write_text(json.dumps({"process": 7, "host": "elsewhere"}))
    with pytest.raises(InputError, match=r"process 7 on elsewhere.*delete .nolbo-lock"), locked(tmp_path):
        pass
    assert (tmp_path / LOCK).is_file()
    for text in ("", "{", "[]", json.dumps({"process": 7, "host": socket.gethostname()})):
        (tmp_path / LOCK).write_text(text)
        with locked(tmp_path):
            assert json.loads((tmp_path / LOCK).read_text())["process"] == os.getpid()
        assert not (tmp_path / LOCK).exists()


def test_leftovers_are_swept_and_count_for_nothing(tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / NEW).mkdir(parents=True)
    (out / "images").mkdir()
    for name in (f".record.{2**22}.tmp.json", "images/.000002.999.tmp.png", ".hidden", LOCK):
        (out / name).write_text("x")
    assert contents(out) == [".hidden", "images"]
    (out / "images").rename(out / "pictures")
    write(out, "new")
    assert set(state(out)) == {".hidden", "a.txt", "b.txt", "images/new.png", "record.json"}
    assert not (out / COMPLETE).exists()
