"""Progress bars are quiet unless they are asked for, and the commands ask for them."""

from __future__ import annotations

import ast
import io
import sys
from pathlib import Path

import pytest

import nolbo_ppl
from nolbo_ppl.cli import main
from nolbo_ppl.progress import progress_bar, show_progress


class Terminal(io.StringIO):
    """An error stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


def terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """A terminal in the error stream's place; called in a test itself, for the capture of output is set up anew for it."""
    made = Terminal()
    monkeypatch.setattr(sys, "stderr", made)
    return made


def test_a_library_is_quiet_even_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    made = terminal(monkeypatch)
    assert list(progress_bar(range(3), "counting", "number")) == [0, 1, 2]
    assert made.getvalue() == ""


def test_bars_are_drawn_where_they_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    made = terminal(monkeypatch)
    show_progress()
    try:
        with progress_bar(None, "counting", "number", total=5, done=2) as bar:
            bar.update(3)
        assert "counting" in made.getvalue() and "5/5" in made.getvalue()
        length = len(made.getvalue())
        list(progress_bar(range(3), "hidden", "number", shown=False))
        assert len(made.getvalue()) == length
    finally:
        show_progress(False)


def test_nothing_is_drawn_into_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    show_progress()
    try:
        list(progress_bar(range(3), "counting", "number"))
    finally:
        show_progress(False)
    assert stream.getvalue() == ""


def test_commands_show_them(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal(monkeypatch)
    drawn: list[bool] = []

    def verb(args: object) -> None:
        drawn.append(not progress_bar(range(1), "x", "y").disable)

    monkeypatch.setattr("nolbo_ppl.cli.run.main", verb)
    main(["run"])
    assert drawn == [True]
    assert progress_bar(range(1), "x", "y").disable  # and leave the library as it was


def test_every_bar_is_one_of_these() -> None:
    package = Path(nolbo_ppl.__file__).parent
    for path in sorted(package.rglob("*.py")):
        names = {
            alias.name
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("tqdm")
            for alias in node.names
        }
        assert not names or path.name == "progress.py", f"{path} draws a bar of its own: use nolbo_ppl.progress"


def test_a_long_solve_is_seen_to_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = ["--frames", "40", "--laps", "2", "--radius", "8", "--world.objects", "10"]
    main(["simulate", "--out", str(tmp_path / "world"), *small])
    made = terminal(monkeypatch)
    files = [f"--odometry={tmp_path}/world/odometry.txt", f"--observations={tmp_path}/world/observations.jsonl"]
    main(["slam", *files, "--out", str(tmp_path / "map")])
    main(["slam", *files, "--online", "--out", str(tmp_path / "map")])
    for what in ("tracking", "/40 [", "closing loops", "following", "keyframe/s"):
        assert what in made.getvalue(), what
