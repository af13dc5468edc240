"""`nolbo slam`: files in and out, errors that name file and line, nothing half-written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.cli import main
from nolbo_ppl.data.simulate import WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.inference.posterior.model_folder import save
from nolbo_ppl.io.observations import write_observations
from nolbo_ppl.io.trajectories import Trajectory, read_trajectory, write_trajectory
from nolbo_ppl.models.posterior_calibration import Calibration
from tests.factories import tiny_model


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("drive")
    rng = np.random.default_rng(0)
    drive = simulate_sequence(
        simulate_circuit(rng, laps=2, frames_per_lap=60), rng, world=WorldConfig(objects=25, categories=4, latent_dim=4)
    )
    times = np.arange(len(drive.truth)) * 0.1 + 100.0
    write_trajectory(out / "odometry.txt", Trajectory(drive.odometry, times, "tum"))
    write_trajectory(out / "truth.txt", Trajectory(drive.truth, times, "tum"))
    write_trajectory(out / "kitti.txt", Trajectory(drive.odometry))
    write_observations(out / "observations.jsonl", drive.observations)
    return out


def arguments(folder: Path, out: Path, **change: str) -> list[str]:
    values = {
        "odometry": str(folder / "odometry.txt"),
        "observations": str(folder / "observations.jsonl"),
        "out": str(out),
        **change,
    }
    return ["slam", *(part for name, value in values.items() for part in (f"--{name}", value))]


def test_every_file_is_written(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save(folder / "model", tiny_model().float(), Calibration(), {})
    main(
        [
            *arguments(folder, tmp_path, truth=str(folder / "truth.txt"), model=str(folder / "model")),
            "--config.em-iterations",
            "2",
        ]
    )
    assert "ATE" in capsys.readouterr().out
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "associations.jsonl",
        "iterations.npz",
        "landmarks.json",
        "landmarks_voxels.npz",
        "map.png",
        "summary.json",
        "trajectory.txt",
    ]
    back = read_trajectory(tmp_path / "trajectory.txt")
    assert back.format == "tum" and len(back) == 120 and back.times is not None and back.times[0] == 100.0
    ids = [json.loads(line)["id"] for line in (folder / "observations.jsonl").read_text().splitlines()]
    rows = [json.loads(line) for line in (tmp_path / "associations.jsonl").read_text().splitlines()]
    assert [row["id"] for row in rows] == ids
    with np.load(tmp_path / "iterations.npz", allow_pickle=False) as history:
        poses = history["T_world_camera"]
        assert poses.dtype == np.float32 and len(history.files) == len(poses) + 1 and len(poses) > 2
        np.testing.assert_allclose(poses[0], read_trajectory(folder / "odometry.txt").T_world_camera, atol=1e-4)
        np.testing.assert_allclose(poses[-1], back.T_world_camera, atol=1e-4)
        landmarks = [landmark["position"] for landmark in json.loads((tmp_path / "landmarks.json").read_text())]
        np.testing.assert_allclose(history[f"landmarks_{len(poses) - 1}"], landmarks, atol=1e-4)
    names = {landmark["name"] for landmark in json.loads((tmp_path / "landmarks.json").read_text())}
    with np.load(tmp_path / "landmarks_voxels.npz", allow_pickle=False) as voxels:
        assert set(voxels.files) == {f"{name}/{part}" for name in names for part in ("mean", "variance")}
    for row in rows:
        assert set(row["landmarks"]) <= names
        assert sum(row["landmarks"].values()) + row["new"] + row["background"] == pytest.approx(1.0, abs=5e-3)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["after"]["ate"] < summary["before"]["ate"]
    assert summary["configuration"]["em_iterations"] == 2
    assert summary["versions"]["gtsam"] != "unknown"
    assert {"iterations", "loop_pairs", "landmarks", "seconds"} <= summary.keys()


def test_kitti_in_kitti_out_and_no_observations(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "none.jsonl").write_text("")
    main(arguments(folder, tmp_path / "out", odometry=str(folder / "kitti.txt"), observations=str(tmp_path / "none.jsonl")))
    back = read_trajectory(tmp_path / "out" / "trajectory.txt")
    assert back.format == "kitti"
    np.testing.assert_allclose(back.T_world_camera, read_trajectory(folder / "kitti.txt").T_world_camera, atol=1e-6)
    assert json.loads((tmp_path / "out" / "landmarks.json").read_text()) == []


def test_covariances_of_odometry_steps(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    n = len(read_trajectory(folder / "odometry.txt"))
    scale = np.repeat([0.01, 0.03], 3)
    np.savez(tmp_path / "good.npz", covariance=np.tile(np.diag(scale**2), (n - 1, 1, 1)))
    bad = np.tile(np.diag(scale**2), (n - 1, 1, 1))
    bad[7, 2, 2] = -1.0
    np.savez(tmp_path / "bad.npz", covariance=bad)
    np.savez(tmp_path / "other.npz", sigma=bad)
    (tmp_path / "text.npz").write_text("no archive")
    option = "odometry-covariance"
    main(arguments(folder, tmp_path / "out", **{option: str(tmp_path / "good.npz"), "truth": str(folder / "truth.txt")}))
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["after"]["ate"] < summary["before"]["ate"]
    expected = {"bad": "step 7", "other": "no array `covariance`", "text": "not a readable NPZ", "none": "no such file"}
    for name, match in expected.items():
        with pytest.raises(SystemExit):
            main(arguments(folder, tmp_path / "no", **{option: str(tmp_path / f"{name}.npz")}))
        assert match in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        (
            "observations",
            '{"frame": 0, "position": [0, 0, 1]}\n{"frame": 500, "position": [0, 0, 1]}\n',
            ":2: .*out of range",
        ),
        ("observations", '{"frame": 0, "position": [0, 0', ":1: not a line of JSON"),
        ("odometry", "1 2 3\n", "unknown trajectory format"),
        ("truth", "1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n", "truth has no time of the odometry"),
    ],
)
def test_errors_go_to_stderr_and_nothing_is_written(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, text: str, match: str
) -> None:
    import re

    (tmp_path / "bad").write_text(text)
    with pytest.raises(SystemExit) as stop:
        main(arguments(folder, tmp_path / "out", **{name: str(tmp_path / "bad")}))
    assert stop.value.code == 2
    assert re.search(match, capsys.readouterr().err)
    assert not (tmp_path / "out").exists()


def test_interruption_leaves_no_half_written_file(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import nolbo_ppl.inference.slam.map_files as export

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(export, "association_table", interrupted)
    with pytest.raises(SystemExit) as stop:
        main([*arguments(folder, tmp_path), "--config.em-iterations", "1"])
    assert stop.value.code == 130
    assert not list(tmp_path.iterdir()), "a result is complete or absent"


def test_the_map_as_mcap(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    from nolbo_ppl.io.ros_bags import Bag

    main([*arguments(folder, tmp_path / "map"), "--mcap", "--config.em-iterations", "1", "--config.hypotheses", "1"])
    times = read_trajectory(folder / "odometry.txt").times
    assert times is not None
    landmarks = json.loads((tmp_path / "map" / "landmarks.json").read_text())
    with Bag(tmp_path / "map" / "map.mcap") as bag:
        assert [time for time, _ in bag.raw("/tf")] == [round(t * 1e9) for t in times]
        _, objects = next(bag.messages("/nolbo/objects"))
    assert {one.id for one in objects.detections} <= {row["name"] for row in landmarks} and objects.detections
