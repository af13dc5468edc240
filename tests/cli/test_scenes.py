"""The verb that makes data sets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nolbo_ppl.cli.scenes import ScenesConfig, main, run, source_of
from nolbo_ppl.data.dataset_folder import SceneFolder
from nolbo_ppl.errors import InputError
from nolbo_ppl.io.files import read_json


def options(out: Path, *more: str) -> list[str]:
    return ["--out", str(out), "--count", "3", "--size", "32", "--instances", "1", "--workers", "1", *more]


def test_command_line_writes_a_data_set(tmp_path: Path) -> None:
    summary = main(options(tmp_path / "set", "--seed", "4", "--difficulty", "easy"))
    assert summary["scenes"] == 3 and summary["out"] == str(tmp_path / "set") and summary["seconds"] > 0
    folder = SceneFolder(tmp_path / "set", size=32)
    assert len(folder) == 3
    assert read_json(tmp_path / "set" / "source.json")["seed"] == 4
    assert sorted(path.name for path in (tmp_path / "set" / "images").iterdir()) == [f"{k:06d}.png" for k in range(3)]
    again = run(ScenesConfig(tmp_path / "again", count=3, seed=4, size=32, difficulty="easy", instances=1, workers=1))
    assert {**again, "out": 0, "seconds": 0} == {**summary, "out": 0, "seconds": 0}
    np.testing.assert_array_equal(SceneFolder(tmp_path / "again", size=32).image(2), folder.image(2))


def test_backgrounds_and_cad_reach_the_scenes(tmp_path: Path) -> None:
    Image.new("RGB", (64, 48), (10, 200, 30)).save(tmp_path / "green.png")
    source = source_of(ScenesConfig(tmp_path / "x", backgrounds=tmp_path, size=32))
    assert source.photographs is not None and len(source.photographs.paths) == 1
    mesh = tmp_path / "cad" / "car"
    mesh.mkdir(parents=True)
    corners = "0 0 0\n1 0 0\n0 2 0\n0 0 0.5\n"
    (mesh / "wedge.off").write_text(f"OFF\n4 4 0\n{corners}3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n")
    source = source_of(ScenesConfig(tmp_path / "x", cad=tmp_path / "cad", size=32))
    assert source.cad is not None and [shape.category for shape in source.cad] == ["car"]
    labels = [label for k in range(3) for label in source.render(k).labels]
    assert {label.category for label in labels} == {"car"}


def test_bad_options(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="size of the scenes: got 33"):
        run(ScenesConfig(tmp_path / "a", size=33))
    with pytest.raises(InputError, match="number of scenes: got 0"):
        run(ScenesConfig(tmp_path / "b", count=0))
    with pytest.raises(InputError, match="no such folder of images"):
        run(ScenesConfig(tmp_path / "c", backgrounds=tmp_path / "absent"))
    assert not (tmp_path / "c" / "images").exists()
