"""`nolbo curves`: a picture for each run, and what is no run is refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image

from nolbo_ppl.cli import main


def make_run(folder: Path, steps: int) -> Path:
    folder.mkdir()
    rows = [{"stage": "scenes", "step": s, "loss": 9.0 / s, "terms/box": -9.0 / s} for s in range(1, steps + 1)]
    rows.append({"stage": "scenes", "step": steps, "bound/box": -1.0, "inclusive/box": -2.0, "box50": 0.5})
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


def test_a_run_gets_its_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, out = make_run(tmp_path / "run", 4), tmp_path / "pictures" / "run.png"
    main(["curves", str(run), "--out", str(out)])
    assert capsys.readouterr().out == f"{out}\n"
    with Image.open(out) as picture:
        assert picture.width > 1000 and len(picture.convert("RGB").getcolors(1 << 24) or []) > 100
    assert not (run / "curves.png").exists()


def test_several_runs_get_one_each(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = [make_run(tmp_path / name, steps) for name, steps in (("a", 2), ("b", 30))]
    main(["curves", str(runs[0]), str(runs[1] / "metrics.jsonl")])
    pictures = [run / "curves.png" for run in runs]
    assert capsys.readouterr().out.splitlines() == list(map(str, pictures))
    assert pictures[0].read_bytes() != pictures[1].read_bytes()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "no run to draw"),
        (["run", "run", "--out", "c.png"], "one picture of several runs: got 2 runs; leave --out out"),
        (["run", "--out", "c.txt"], "kind of picture: got c.txt, expected a name that ends in .png, .svg, .pdf"),
        (["empty"], "metrics.jsonl: no such file"),
    ],
)
def test_what_cannot_be_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    make_run(tmp_path / "run", 2)
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        main(["curves", *arguments])
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("nolbo curves: ") and message in error
    assert not list(tmp_path.rglob("c*.*")) and not list(tmp_path.rglob("*.png"))
