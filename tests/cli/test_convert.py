"""`nolbo convert`: the command around the converters."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.cli import main
from nolbo_ppl.geometry.pose import make_pose
from nolbo_ppl.io.observations import read_observations
from nolbo_ppl.io.trajectories import Trajectory, read_trajectory, write_trajectory


def test_poles_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    T = make_pose(np.tile(np.eye(3), (10, 1, 1)), np.arange(10)[:, None] * np.array([0.0, 0.0, 1.0]))
    for name in ("poses", "odometry_f2f"):
        write_trajectory(tmp_path / name / "00.txt", Trajectory(T))
    (tmp_path / "poles").mkdir()
    np.save(tmp_path / "poles" / "00.npy", np.array([[15.0, 5.0]]))
    main(["convert", "kitti-poles", "--data", str(tmp_path), "--sequence", "00", "--out", str(tmp_path / "out"), "--every", "2"])
    assert "5 frames" in capsys.readouterr().out
    assert len(read_trajectory(tmp_path / "out" / "odometry.txt")) == 5
    assert len(read_observations(tmp_path / "out" / "observations.jsonl", frames=5)) > 0
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "objects.json",
        "observations.jsonl",
        "odometry.txt",
        "source.json",
        "truth.txt",
    ]


def test_missing_data_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["convert", "ycbv-slam", "--data", str(tmp_path), "--sequence", "0001", "--out", str(tmp_path / "out")])
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("nolbo convert: ") and "sequence not found" in error
    assert not (tmp_path / "out").exists()
