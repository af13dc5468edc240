"""The demonstration: the whole mission on a small world, and what is refused."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

import nolbo_ppl.synthetic.worlds as drives
from nolbo_ppl.cli.demo import DemoConfig, main, run
from nolbo_ppl.errors import InputError
from nolbo_ppl.io.files import read_json
from nolbo_ppl.pipeline.demo_run import DEMO_SEED


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """A drive of twelve small images; the drives asked for are listed."""
    asked: list[Any] = []
    original = drives.sequence_preset

    def preset(name: str, world: Any, seed: int) -> drives.SequenceConfig:
        asked.append((name, world, seed))
        config = original(name, world, seed)
        return dataclasses.replace(config, frames=12, laps=0.12, size=(192, 96), objects=12, clutter=6)

    monkeypatch.setattr(drives, "sequence_preset", preset)
    return asked


@pytest.mark.slow
def test_the_mission_on_a_small_world(small: list[Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "demo"
    main(["--out", str(out), "--seed", "3", "--workers", "1"])
    assert small == [("demo", "street", DEMO_SEED + 3)]
    printed = capsys.readouterr().out
    assert str(out / "run" / "report.html") in printed
    for name in ("report.html", "summary.json", "map.glb", "observations.jsonl", "slam/trajectory.txt"):
        assert (out / "run" / name).is_file(), name
    assert len(list((out / "drive" / "images").iterdir())) == 12
    stages = read_json(out / "run" / "run.json")
    again = run(DemoConfig(out, seed=3, workers=1))
    assert read_json(out / "run" / "run.json") == stages, "nothing was made again"
    assert again.table in printed
    with pytest.raises(InputError, match="another drive"):
        run(DemoConfig(out, seed=4, workers=1))


@pytest.mark.parametrize(("change", "match"), [({"workers": 0}, "--workers"), ({"seed": -1}, "--seed")])
def test_options_that_make_no_sense(change: dict[str, int], match: str) -> None:
    with pytest.raises(InputError, match=match):
        DemoConfig(**change)  # type: ignore[arg-type]
