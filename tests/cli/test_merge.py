"""`nolbo merge`: drives that share a place become one map, others stay apart."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.cli import main
from nolbo_ppl.data.simulate import (
    DetectorConfig,
    SimulatedWorld,
    WorldConfig,
    simulate_circuit,
    simulate_detections,
    simulate_odometry,
    simulate_world,
)
from nolbo_ppl.geometry.pose import inverse, relative
from nolbo_ppl.io.landmarks import read_landmarks
from nolbo_ppl.io.observations import write_observations
from nolbo_ppl.io.trajectories import Trajectory, read_trajectory, write_trajectory

OPTIONS = ["--config.hypotheses", "1", "--config.odometry-rotation-scale", "0.003", "--config.odometry-translation-ratio", "0.01"]


def write_sequence_folder(folder: Path, truth: np.ndarray, world: SimulatedWorld, rng: np.random.Generator) -> None:
    folder.mkdir()
    odometry = simulate_odometry(inverse(truth[0]) @ truth, rng, rotation_scale=0.003, translation_ratio=0.01)
    table, _ = simulate_detections(truth, world, DetectorConfig(), rng)
    write_trajectory(folder / "odometry.txt", Trajectory(odometry))
    write_trajectory(folder / "truth.txt", Trajectory(truth))
    write_observations(folder / "observations.jsonl", table)


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """Folders a and b of one place, c of another; the true pose of b's world in a's."""
    folder, rng = tmp_path_factory.mktemp("drives"), np.random.default_rng(5)
    circle = simulate_circuit(rng, laps=1, radius=18.0, frames_per_lap=50)
    here, there = (simulate_world(circle, WorldConfig(objects=22, categories=5, latent_dim=4), rng) for _ in range(2))
    for name, rows, world in (("a", slice(0, 32), here), ("b", slice(12, 44), here), ("c", slice(5, 35), there)):
        write_sequence_folder(folder / name, circle[rows], world, rng)
    return folder, relative(circle[0], circle[12])


def test_drives_are_joined_and_others_stay_apart(
    drives: tuple[Path, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, true = drives
    main(["merge", *(str(folder / name) for name in "abc"), "--out", str(tmp_path / "joined"), *OPTIONS])
    said = capsys.readouterr().out
    assert "not all drives share a place" in said and "map_1: " in said
    report = json.loads((tmp_path / "joined/sessions.json").read_text())
    assert [row["map"] for row in report["sessions"]] == [0, 0, 1] and report["maps"] == 2
    error = relative(np.array(report["sessions"][1]["T_world_session"]), true)
    assert np.linalg.norm(error[:3, 3]) < 0.7
    assert report["sessions"][1]["after"]["ate"] < 1.5 * report["sessions"][1]["before"]["ate"] + 0.1
    assert np.linalg.eigvalsh(np.array(report["sessions"][1]["covariance"]))[0] > 0
    ((place,)) = report["places"]
    assert place["sessions"] == [0, 1] and place["objects"] >= 4 and place["log_odds"] > 8
    whole = read_trajectory(tmp_path / "joined/map_0/trajectory.txt").T_world_camera
    parts = [read_trajectory(tmp_path / f"joined/map_0/trajectory_{k}.txt").T_world_camera for k in (0, 1)]
    np.testing.assert_allclose(np.concatenate(parts), whole, atol=1e-6)
    assert len(read_landmarks(tmp_path / "joined/map_0/landmarks.json")) > len(
        read_landmarks(tmp_path / "joined/map_1/landmarks.json")
    )


@pytest.mark.parametrize(("runs", "message"), [(("a",), "two or more"), (("a", "missing"), "no odometry.txt")])
def test_bad_input_ends_with_status_2(
    drives: tuple[Path, np.ndarray],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    runs: tuple[str, ...],
    message: str,
) -> None:
    with pytest.raises(SystemExit) as error:
        main(["merge", *(str(drives[0] / name) for name in runs), "--out", str(tmp_path / "out")])
    assert error.value.code == 2 and message in capsys.readouterr().err
    assert not (tmp_path / "out" / "sessions.json").exists()
