"""Stages: done once, done again from the first change on, nothing half-written when one stops."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.pipeline.stage_store import RECORD, PipelineStage, fingerprints, run_stages


class Workshop:
    """Three stages that write a file each and note that they ran."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.ran, self.fail = folder, [], ""

    def work(self, name: str) -> None:
        self.ran.append(name)
        (self.folder / f"{name}.txt").write_text(name)
        if name == "b":
            (self.folder / "b").mkdir()
            (self.folder / "b" / "inside.txt").write_text("x")
        if name == self.fail:
            raise KeyboardInterrupt

    def stages(self, **settings: int) -> list[PipelineStage]:
        outputs = {"a": ("a.txt",), "b": ("b.txt", "b", "maybe.txt?"), "c": ("c.txt",)}
        return [
            PipelineStage(name, out, settings.get(name, 0), lambda name=name: self.work(name)) for name, out in outputs.items()
        ]

    def run(self, **settings: int) -> dict[str, float]:
        self.ran = []
        seconds: dict[str, float] = {}
        run_stages(self.folder, self.stages(**settings), {"x": 1}, {"v": "2"}, seconds, {})
        return seconds


def test_complete_stages_are_not_done_again(tmp_path: Path) -> None:
    shop = Workshop(tmp_path / "run")
    first = shop.run()
    assert shop.ran == ["a", "b", "c"] and list(first) == ["a", "b", "c"]
    record = json.loads((tmp_path / "run" / RECORD).read_text())
    assert record["configuration"] == {"x": 1} and record["versions"] == {"v": "2"} and record["complete"] == ["a", "b", "c"]
    assert list(record["cpu_seconds"]) == ["a", "b", "c"]
    again = shop.run()
    assert shop.ran == [] and again == pytest.approx(first, abs=1e-3)  # their times are remembered
    shop.run(b=1)
    assert shop.ran == ["b", "c"]
    (tmp_path / "run" / "a.txt").unlink()
    shop.run(b=1)
    assert shop.ran == ["a", "b", "c"]


def test_stages_are_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO", logger="nolbo_ppl"):
        Workshop(tmp_path).run()
    assert [record.getMessage().split(":")[0] for record in caplog.records] == ["a", "b", "c"]


def test_an_interrupted_stage_leaves_nothing(tmp_path: Path) -> None:
    shop = Workshop(tmp_path)
    shop.fail = "b"
    with pytest.raises(KeyboardInterrupt):
        shop.run()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.txt", RECORD]
    shop.fail = ""
    shop.run()
    assert shop.ran == ["b", "c"]


def test_what_a_killed_run_left_is_removed(tmp_path: Path) -> None:
    """Killed in the middle, a stage cannot clean up: the next run does, before anything else."""
    shop = Workshop(tmp_path)
    shop.run()
    record = json.loads((tmp_path / RECORD).read_text())
    del record["fingerprints"]["b"], record["fingerprints"]["c"]
    (tmp_path / RECORD).write_text(json.dumps(record))
    (tmp_path / "maybe.txt").write_text("stale")
    shop.run()
    assert shop.ran == ["b", "c"] and not (tmp_path / "maybe.txt").exists()


def test_a_later_stage_depends_on_all_before_it() -> None:
    shop = Workshop(Path())
    before, after = fingerprints(shop.stages()), fingerprints(shop.stages(b=3))
    assert before["a"] == after["a"] and before["b"] != after["b"] and before["c"] != after["c"]


def test_other_folders_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(InputError, match="something else than a run"):
        Workshop(tmp_path).run()
    (tmp_path / RECORD).write_text("{}")
    with pytest.raises(InputError, match="not the record of a run"):
        Workshop(tmp_path).run()
    assert (tmp_path / "thesis.tex").read_text() == "x"
