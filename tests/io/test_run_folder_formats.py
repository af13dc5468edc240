"""Run folders as version 0.1.0 wrote them are still read: its files, letter by letter."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.io.run_folder import FORMAT, RunFolder, read_run
from nolbo_ppl.pipeline.stage_store import recorded
from nolbo_ppl.report import build_page

FILES = {
    "run.json": """{
  "configuration": {"images": "drive/images", "model": "tiny", "loop_gap": 2, "slam": {"samples": 64}},
  "versions": {"nolbo-ppl": "0.1.0", "gtsam": "4.2"},
  "seconds": {"odometry": 0.5, "observe": 2.25, "slam": 1.0},
  "cpu_seconds": {"odometry": 0.5, "observe": 4.0, "slam": 1.0},
  "complete": ["odometry", "observe", "slam"],
  "fingerprints": {"odometry": "0123456789abcdef", "observe": "1123456789abcdef", "slam": "2123456789abcdef"}
}""",
    "frames.jsonl": """{"frame": 0, "image": "../drive/images/000000.png", "index": 0, "time": null}
{"frame": 1, "image": "../drive/images/000002.png", "index": 2, "time": null}
""",
    "intrinsics.json": '{"fx": 199.68, "fy": 199.68, "cx": 192.0, "cy": 96.0, "width": 384, "height": 192}',
    "odometry.txt": "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1 1.5\n",
    "truth.txt": "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1 1\n",
    "observations.jsonl": """{"frame": 0, "image": "000000.png", "id": "000000-000", "box": [10.12, 20.0, 60.5, 70.25], \
"objectness": 0.987654, "category": "car", "class_posterior": {"car": 0.9, "bus": 0.1}, "position": [1.0, 0.5, 8.12345], \
"position_cov": [[0.01, 0.0, 0.002], [0.0, 0.01, 0.001], [0.002, 0.001, 0.25]], \
"rotation": [0.70710678, 0.0, 0.0, 0.70710678], "rotation_std": 0.12345, \
"rotation_modes": [{"weight": 0.69999, "rotation": [0.70710678, 0.0, 0.0, 0.70710678], "std": 0.12345}, \
{"weight": 0.3, "rotation": [0.0, 0.70710678, 0.70710678, 0.0], "std": 0.2}], "viewpoint": [0.1, 0.2, -0.05], \
"azimuth_modes": [{"weight": 0.7, "azimuth": 0.1, "concentration": 40.123}, {"weight": 0.3, "azimuth": -3.04, \
"concentration": 12.0}], "latent": [0.12345, -1.5], "latent_std": [0.1, 0.2], "size": [1.5, 4.0, 1.25]}
{"frame": 1, "image": "000002.png", "id": "000001-000", "box": [12.0, 20.0, 62.5, 70.25], "objectness": 0.5, \
"category": "bus", "class_posterior": {"car": 0.4, "bus": 0.6}, "position": [1.0, 0.5, 7.0], \
"position_cov": [[0.01, 0.0, 0.002], [0.0, 0.01, 0.001], [0.002, 0.001, 0.25]], "latent": [0.2, -1.25], \
"latent_std": [0.1, 0.2], "size": [1.5, 4.0, 1.25]}
""".replace("\\\n", ""),
    "objects.json": '{"objects": {"000000-000": "O1", "000001-000": null}}',
    "slam/trajectory.txt": "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1 1.125\n",
    "slam/landmarks.json": """[{"name": "L0", "position": [1.0, 0.5, 8.1],
  "position_covariance": [[0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.04]], "existence": 0.96, "detections": 1.7, "first_frame": 0,
  "last_frame": 1, "rotation": [0.70710678, 0, 0, 0.70710678],
  "rotation_covariance": [[0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.01]], "category": "car",
  "class_posterior": {"car": 0.8, "bus": 0.2}, "latent": [0.15, -1.4], "latent_std": [0.08, 0.15], "size": [1.5, 4.0, 1.25]}]""",
    "slam/associations.jsonl": """{"id": "000000-000", "landmarks": {"L0": 0.97}, "new": 0.01, "background": 0.02}
{"id": "000001-000", "landmarks": {"L0": 0.45}, "new": 0.05, "background": 0.5}
""",
    "slam/summary.json": """{"frames": 2, "observations": 2, "landmarks": 1, "loop_pairs": 0, "iterations": [],
  "before": {"ate": 0.25, "rpe_translation": 0.5, "rpe_rotation": 0.0},
  "after": {"ate": 0.0625, "rpe_translation": 0.125, "rpe_rotation": 0.0}, "warnings": ["position_std was too small"]}""",
}


@pytest.fixture
def old(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    for name, text in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    np.savez_compressed(
        folder / "slam" / "iterations.npz",
        T_world_camera=np.tile(np.eye(4, dtype=np.float32), (2, 2, 1, 1)),
        landmarks_0=np.zeros((0, 3), np.float32),
        landmarks_1=np.ones((1, 3), np.float32),
    )
    grid = np.zeros((8, 8, 8), np.float16)
    grid[2:6, 2:6, 2:6] = 0.9
    np.savez_compressed(folder / "slam" / "landmarks_voxels.npz", **{"L0/mean": grid, "L0/variance": grid / 10})
    return folder


def test_a_run_of_the_first_version_is_read(old: Path) -> None:
    run = read_run(old)
    assert len(run) == 2 and run.image_names[1] == "../drive/images/000002.png" and run.keyframes.tolist() == [0, 2]
    assert run.trajectory_errors["after"]["ate"] == 0.0625 and run.record["seconds"]["observe"] == 2.25
    seen, found = run.detections, run.associations
    assert seen is not None and found is not None
    assert seen.class_names == ("car", "bus") and seen.azimuth_weight.shape == (2, 2)
    np.testing.assert_array_equal(seen.box[0], [10.12, 20.0, 60.5, 70.25])
    np.testing.assert_array_equal(seen.mode_weight, [[0.69999, 0.3], [0, 0]])
    assert found.landmark_of.tolist() == [0, -1] and found.frame is not None
    (landmark,) = run.landmarks
    assert landmark.category == "car" and landmark.oriented and landmark.frames == (0, 1) and landmark.latent is not None
    assert run.voxels("L0") is not None and run.objects == {"000000-000": "O1", "000001-000": None}
    page = build_page(run)
    assert "position_std was too small" in page and "L0" in page


def test_a_run_of_the_first_version_is_continued(old: Path) -> None:
    """Its record is that of a run: stages whose fingerprints fit are kept, the others are done again."""
    assert recorded(old)["fingerprints"]["odometry"] == "0123456789abcdef"


def test_a_run_of_a_later_version_is_refused(old: Path) -> None:
    record = json.loads((old / "run.json").read_text())
    for stated in (FORMAT + 1, "2", True, 0):
        (old / "run.json").write_text(json.dumps({**record, "format": stated}))
        for read in (read_run, recorded, lambda path: RunFolder(path).record):
            with pytest.raises(InputError, match=r"run\.json: a run folder of another format"):
                read(old)
    (old / "run.json").write_text(json.dumps({**record, "format": FORMAT}))
    assert read_run(old).record["format"] == FORMAT
