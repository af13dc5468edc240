"""The demonstration on a drive of a few frames: rendered, run, reported; a second call finds everything made."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import nolbo_ppl.synthetic.worlds as drives
from nolbo_ppl.inference.posterior.model_folder import save
from nolbo_ppl.io.trajectories import read_trajectory
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error
from nolbo_ppl.models.posterior_calibration import Calibration
from nolbo_ppl.pipeline.demo_run import DEMO_SEED, run_demo
from tests.factories import tiny_model


@pytest.mark.slow
def test_the_demonstration_ends_in_a_table_and_a_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    preset, asked = drives.sequence_preset, []

    def small(name: str, world: drives.config.WorldName, seed: int) -> drives.SequenceConfig:
        asked.append((name, world, seed))
        return replace(preset("demo", world, seed), frames=6, laps=0.3, step=5.0, size=(128, 64), objects=8, clutter=4)

    monkeypatch.setattr(drives, "sequence_preset", small)
    save(tmp_path / "model", tiny_model(scatter=0.1).float(), Calibration(objectness_shift=-2.0), {})
    result = run_demo(tmp_path / "demo", seed=2, model=str(tmp_path / "model"))
    assert asked == [("demo", "street", DEMO_SEED + 2)]
    assert result.report.is_file() and "ATE before / after" in result.table and "detections: recall" in result.table
    truth, odometry = (read_trajectory(result.run / name).T_world_camera for name in ("truth.txt", "odometry.txt"))
    error = absolute_trajectory_error(odometry, truth).rmse
    assert result.summary["frames"] == 6 and result.summary["before"]["ate"] == pytest.approx(error, rel=1e-6)
    stamp = result.report.stat().st_mtime_ns
    again = run_demo(tmp_path / "demo", seed=2, model=str(tmp_path / "model"))
    assert again.table == result.table and again.report.stat().st_mtime_ns == stamp
