"""The command line: help, versions, exit statuses, and errors without tracebacks."""

from __future__ import annotations

import errno
import importlib
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from nolbo_ppl import __version__
from nolbo_ppl.cli import VERBS, main, system_message
from nolbo_ppl.errors import InputError, NolboError
from nolbo_ppl.io.files import atomic_path
from nolbo_ppl.io.output_folder import locked

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"]])
def test_help_names_every_verb(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    main(arguments)
    text = capsys.readouterr().out
    assert text.startswith("usage: nolbo VERB")
    for verb, what in VERBS.items():
        assert re.search(rf"^  {verb} +{re.escape(what)}$", text, re.MULTILINE)


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--version"])
    assert capsys.readouterr().out == __version__ + "\n"


def test_an_unknown_verb(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["observ"])
    assert stop.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "unknown verb 'observ'" in captured.err
    assert "usage: nolbo VERB" in captured.err


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_help(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([verb, "--help"])
    assert stop.value.code == 0
    assert "--" in capsys.readouterr().out


@pytest.mark.parametrize("verb", VERBS)
def test_an_unknown_option_is_refused(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([verb, *(["folder"] if verb in ("curves", "report", "view") else []), "--no-such-option", "1"])
    assert stop.value.code == 2
    assert "no-such-option" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("raised", "status", "message"),
    [(NolboError("the disc is full"), 2, "nolbo train: the disc is full"), (KeyboardInterrupt(), 130, "interrupted")],
)
def test_errors_end_with_a_status_and_one_line(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    raised: BaseException,
    status: int,
    message: str,
) -> None:
    def fail(arguments: list[str]) -> None:
        assert arguments == ["--seed", "1"]
        raise raised

    monkeypatch.setattr(importlib.import_module("nolbo_ppl.cli.train"), "main", fail)
    with pytest.raises(SystemExit) as stop:
        main(["train", "--seed", "1"])
    assert stop.value.code == status
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_bad_input_of_a_real_run_ends_without_a_traceback(tmp_path: Path) -> None:
    options = ["--images", str(tmp_path), "--out", str(tmp_path / "out")]
    command = [sys.executable, "-m", "nolbo_ppl.cli", "observe", *options]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert f"{tmp_path}: no image in the folder" in done.stderr
    assert not (tmp_path / "out").exists()


def documented_commands() -> list[tuple[str, str]]:
    """(document, command) of every `nolbo VERB ...` line in the code blocks of the README and the documents."""
    found = []
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        for block in re.findall(r"^```[a-z]*\n(.*?)^```", path.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE):
            for line in block.replace("\\\n", " ").splitlines():
                command = re.match(r"^(?:\.venv/bin/)?nolbo (.*)$", line.split("  #")[0].strip())
                if command:
                    found.append((path.name, command.group(1)))
    return found


def test_documented_commands_exist(capsys: pytest.CaptureFixture[str]) -> None:
    commands = documented_commands()
    assert {text.split()[0] for _, text in commands} == set(VERBS)
    helps: dict[str, str] = {}
    for document, text in commands:
        verb, *rest = text.split()
        assert verb in VERBS, f"{document}: nolbo {text}"
        help_of = [verb, rest[0]] if verb in ("convert", "data") else [verb]
        if "--stage" in rest:  # a stage of the paper's programme has options of its own
            help_of += ["--stage", rest[rest.index("--stage") + 1]]
        key = " ".join(help_of)
        if key not in helps:
            with pytest.raises(SystemExit):
                main([*help_of, "--help"])
            helps[key] = capsys.readouterr().out
        for option in re.findall(r"--[a-z][a-z0-9.-]*", text):
            assert re.search(re.escape(option) + r"(?![a-z0-9-])", helps[key]), f"{document}: {option} of nolbo {key}"


@pytest.mark.parametrize("empty", [["--out", ""], ["--out="], ["--out", " "]])
def test_an_empty_output_is_not_the_current_folder(
    empty: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as caught:
        main(["simulate", *empty, "--frames", "4"])
    assert caught.value.code == 2 and "--out is empty" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_what_the_system_says_is_a_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "file"
    file.write_text("x")
    message = system_message(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(file)))
    assert message == f"{file}: No space left on device"
    assert system_message(OSError(errno.EACCES, "no", "a", None, "b")) == "a -> b: no"
    assert system_message(OSError("odd")) == "odd"
    assert system_message(TimeoutError()) == "TimeoutError"


@pytest.mark.parametrize(
    ("error", "status", "message"),
    [
        (OSError(errno.EACCES, "Permission denied", "/place"), 2, "nolbo report: /place: Permission denied"),
        (MemoryError(), 2, "nolbo report: needs more memory than there is"),
        (KeyboardInterrupt(), 130, "nolbo report: interrupted"),
        (InputError("x.json: bad"), 2, "nolbo report: x.json: bad"),
    ],
)
def test_every_kind_of_failure_has_its_status(
    error: BaseException, status: int, message: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: object) -> None:
        raise error

    monkeypatch.setattr("nolbo_ppl.cli.report.main", fail)
    with pytest.raises(SystemExit) as caught:
        main(["report"])
    assert caught.value.code == status
    assert capsys.readouterr().err == message + "\n"


def test_a_defect_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("nolbo_ppl.cli.report.main", fail)
    with pytest.raises(ZeroDivisionError):
        main(["report"])


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_signal_cleans_up(
    number: signal.Signals, status: int, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def work(_: object) -> None:
        with locked(tmp_path / "out"), atomic_path(tmp_path / "out" / "x.txt") as temporary:
            temporary.write_text("half")
            signal.raise_signal(number)

    monkeypatch.setattr("nolbo_ppl.cli.report.main", work)
    inherited = signal.signal(number, signal.SIG_DFL)  # under nohup SIGHUP is ignored, and stays so
    try:
        with pytest.raises(SystemExit) as caught:
            main(["report"])
        assert signal.getsignal(number) == signal.SIG_DFL
    finally:
        signal.signal(number, inherited)
    assert caught.value.code == status
    assert f"stopped by signal {number.name}" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
