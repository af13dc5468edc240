"""The verb that renders drives."""

from __future__ import annotations

from pathlib import Path

import pytest

from nolbo_ppl.cli.drive import DriveConfig, config_of, main
from nolbo_ppl.errors import InputError
from nolbo_ppl.synthetic.worlds import read_sequence_folder

SMALL = ["--frames", "4", "--step", "2", "--laps", "0.2", "--size", "64", "32", "--objects", "8", "--clutter", "2"]


def test_command_line_writes_a_drive(tmp_path: Path) -> None:
    options = ["--out", str(tmp_path / "d"), "--world", "indoor", "--seed", "4", "--workers", "1", *SMALL]
    summary = main(options)
    assert (summary["out"], summary["frames"], summary["objects"]) == (str(tmp_path / "d"), 4, 8)
    assert summary["seconds"] > 0
    drive = read_sequence_folder(tmp_path / "d")
    assert drive.size == (64, 32) and drive.facts["config"]["seed"] == 4
    again = main(options)  # already complete
    assert {**again, "seconds": 0} == {**summary, "seconds": 0}


def test_options_override_the_preset(tmp_path: Path) -> None:
    config = config_of(DriveConfig(tmp_path, preset="demo", laps=1.3, moving=2, size=(320, 160)))
    assert (config.frames, config.objects, config.laps, config.moving, config.size) == (120, 60, 1.3, 2, (320, 160))
    plain = config_of(DriveConfig(tmp_path, world="indoor"))
    assert (plain.world, plain.frames, plain.step) == ("indoor", 300, 0.25)


def test_bad_options(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"loop of the drive: got .* m"):
        main(["--out", str(tmp_path / "d"), "--frames", "10"])
    assert not (tmp_path / "d").exists()
