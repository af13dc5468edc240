"""Reading a run folder: what it holds, what is refused."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import make_pose, so3_exp
from nolbo_ppl.io.trajectories import Trajectory, write_trajectory
from nolbo_ppl.report import read_run
from tests.report.factory import FRAMES, drive


@pytest.fixture
def folder(run_folder: Path, tmp_path: Path) -> Path:
    shutil.copytree(run_folder, tmp_path / "run")
    return tmp_path / "run"


def test_reads_everything(run_folder: Path) -> None:
    run = read_run(run_folder)
    assert run.estimate.shape == (FRAMES, 4, 4) and run.odometry is not None and run.plane == (0, 2)
    assert len(run.images) == FRAMES and all(path is not None and path.is_file() for path in run.images)
    np.testing.assert_allclose(run.times, 0.3 * np.arange(FRAMES))  # type: ignore[arg-type]
    assert run.associations is not None and run.associations.frame is not None
    in_time = run.associations_in_time
    assert in_time is not None and in_time.frame is not None and (np.diff(in_time.frame) >= 0).all()
    whose = dict(zip(run.associations.id, run.associations.landmark_of.tolist()))
    assert dict(zip(in_time.id, in_time.landmark_of.tolist())) == whose and max(whose.values()) > 0
    assert run.iterations is not None
    np.testing.assert_allclose(run.iterations.T_world_camera[0], drive().odometry, atol=1e-5)
    assert run.crop(run.landmarks[0].name) is not None and run.voxels(run.landmarks[0].name) is not None
    assert run.voxels(run.landmarks[-1].name) is None


def test_truth_is_moved_onto_the_estimate(folder: Path) -> None:
    before = read_run(folder)
    T = make_pose(so3_exp(np.array([0.1, 2.0, -0.3])), np.array([100.0, -20.0, 7.0]))
    write_trajectory(folder / "truth.txt", Trajectory(T @ drive().truth))
    after = read_run(folder)
    np.testing.assert_allclose(after.truth, before.truth, atol=1e-6)  # type: ignore[arg-type]


def test_a_crop_cannot_lead_out_of_the_folder(folder: Path) -> None:
    run = read_run(folder)
    (folder / "secret.png").write_bytes(b"")
    assert run.crop("../secret") is None and run.crop("/etc/passwd") is None and run.crop("a\0b") is None


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("slam/landmarks.json", "{}", "no list of landmarks"),
        ("slam/landmarks.json", '[{"name": "L0"}]', "a name and a position"),
        ("slam/landmarks.json", '[{"name": "L0", "position": [1, 2]}]', "`position` of a landmark"),
        ("slam/landmarks.json", '[{"name": "L0", "position": [1, 2, 3], "existence": "x"}]', "`existence`"),
        ("slam/landmarks.json", '[{"name": "L0", "position": [1, 2, 3], "rotation": [0, 0, 0, 0]}]', "unit quaternion"),
        ("slam/associations.jsonl", '{"landmarks": {}}', "not an association"),
        ("slam/iterations.npz", "nothing", "not a readable NPZ file"),
        ("slam/landmarks_voxels.npz", "nothing", "not a readable NPZ file"),
        ("frames.jsonl", '{"frame": 0}', "frames do not match"),
        ("observations.jsonl", '{"id": "a"}', "`frame` is missing"),
        ("odometry.txt", "1 0 0 0 0 1 0 0 0 0 1 0", "the odometry does not match"),
        ("truth.txt", "1 0 0 0 0 1 0 0 0 0 1 0", "the truth does not match"),
        ("run.json", "[]", "not a JSON object"),
        ("run.json", '{"format": 3}', "another format: got 3, expected 1 to 2; update nolbo_ppl"),
        ("run.json", '{"format": "new"}', "another format"),
    ],
)
def test_malformed_files_are_named(folder: Path, name: str, text: str, match: str) -> None:
    (folder / name).write_text(text)
    with pytest.raises(InputError, match=match) as caught:
        run = read_run(folder)
        run.voxels(run.landmarks[0].name)
    assert Path(name).name in str(caught.value)
