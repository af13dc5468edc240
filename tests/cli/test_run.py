"""`nolbo run`: from images on disk to figures, with a model that knows the drive; resumed, interrupted, refused."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from nolbo_ppl.cli.run import main, run
from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.posterior.model_folder import save
from nolbo_ppl.io.files import read_json
from nolbo_ppl.io.trajectories import Trajectory, read_trajectory, write_trajectory
from nolbo_ppl.models.posterior_calibration import Calibration
from nolbo_ppl.pipeline import mapping_pipeline as pipeline
from nolbo_ppl.pipeline.mapping_pipeline import ObjectMappingPipeline
from nolbo_ppl.pipeline.run_config import RunConfig
from tests.factories import tiny_model
from tests.simulated_sequence import DIAGONAL, SimulatedDrive, drive  # noqa: F401

FILES = {
    "crops",
    "frames.jsonl",
    "intrinsics.json",
    "map.glb",
    "objects.json",
    "observations.jsonl",
    "odometry.txt",
    "run.json",
    "slam",
    "summary.json",
    "truth.txt",
}


def config_of(drive: SimulatedDrive, out: Path, **change: Any) -> RunConfig:  # noqa: F811
    folder = drive.folder
    values: dict[str, Any] = {
        "images": folder / "images",
        "intrinsics": folder / "intrinsics.json",
        "odometry": folder / "odometry.txt",
        "truth": folder / "truth.txt",
        "truth_objects": folder,
        "out": out,
        "score_threshold": 0.05,
        "report": False,
        **change,
    }
    return RunConfig(**values)


@pytest.fixture(scope="module")
def known(drive: SimulatedDrive) -> Iterator[SimulatedDrive]:  # noqa: F811
    """Every model name loads the one that knows the drive."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "load", lambda name, device: drive.model)
        yield drive


@pytest.fixture(scope="module")
def finished(known: SimulatedDrive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "run"
    run(config_of(known, out))
    return out


def test_every_file_is_written_and_the_loop_is_closed(known: SimulatedDrive, finished: Path) -> None:
    assert {path.name for path in finished.iterdir()} == FILES
    assert {
        "trajectory.txt",
        "landmarks.json",
        "associations.jsonl",
        "iterations.npz",
        "landmarks_voxels.npz",
        "map.png",
        "noise.npz",
        "summary.json",
    } == {path.name for path in (finished / "slam").iterdir()}
    summary = read_json(finished / "summary.json")
    assert summary["frames"] == 120 and summary["after"]["ate"] < 0.4 * summary["before"]["ate"]
    assert 0.5 < summary["after_over_oracle"] < 2 and summary["after_over_before"] == pytest.approx(
        summary["after"]["ate"] / summary["before"]["ate"], abs=1e-5
    )
    # At the image's border some detections are of objects that the truth just left out: they are not held to be theirs.
    assert summary["loops"]["precision"] > 0.9 and summary["loops"]["recall"] > 0.9
    chart = summary["map"]
    assert chart["landmarks"] == summary["landmarks"] and chart["objects_mapped"] >= 0.8 * chart["objects_detected"]
    assert chart["duplicates"] <= 2 and chart["median_position_error"] < 0.5
    seen = summary["observation_scores"]
    assert seen["recall"] > 0.6 and seen["precision"] > 0.8 and seen["category_accuracy"] > 0.95
    assert seen["coverage90"]["orientation"] > 0.8
    views = list(summary["shape"]["iou"].values())
    assert views[0] < views[-1]
    assert summary["images_per_second"] > 0 and 0 < summary["share_of_em"] < 1
    assert set(summary["seconds"]) == {"odometry", "observe", "slam", "map", "crops"}


def test_the_map_shows_the_landmarks_at_their_size(finished: Path) -> None:
    landmarks = {row["name"]: row for row in read_json(finished / "slam" / "landmarks.json")}
    scene = trimesh.load_scene(finished / "map.glb")
    shown = set(scene.graph.nodes_geometry) - {"trajectory"}
    assert shown and shown <= set(landmarks)
    for name in shown:
        transform, geometry = scene.graph[name]
        corners = trimesh.transform_points(scene.geometry[geometry].vertices, transform)
        middle = (corners.max(axis=0) + corners.min(axis=0)) / 2
        np.testing.assert_allclose(middle * [1, -1, -1], landmarks[name]["position"], atol=0.15)
        assert 0.2 * DIAGONAL < np.ptp(corners, axis=0).max() < DIAGONAL
    assert {path.stem for path in (finished / "crops").iterdir()} >= shown


def test_frames_name_the_images_as_seen_from_the_run(known: SimulatedDrive, finished: Path) -> None:
    rows = [json.loads(line) for line in (finished / "frames.jsonl").read_text().splitlines()]
    assert [row["frame"] for row in rows] == [row["index"] for row in rows] == list(range(120))
    assert (finished / rows[7]["image"]).resolve() == (known.folder / "images" / "000007.png").resolve()
    camera = read_json(finished / "intrinsics.json")
    assert (camera["width"], camera["height"]) == (192, 96)


def test_whose_each_observation_is_can_be_looked_up(known: SimulatedDrive, finished: Path) -> None:
    objects = read_json(finished / "objects.json")["objects"]
    ids = [json.loads(line)["id"] for line in (finished / "observations.jsonl").read_text().splitlines()]
    assert list(objects) == ids
    assert {name for name in objects.values() if name is not None} <= {f"O{i}" for i in range(20)}
    assert sum(name is not None for name in objects.values()) > 0.8 * len(ids)


def test_a_finished_run_is_not_done_again(known: SimulatedDrive, finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = known.model.calls
    before = read_json(finished / "run.json")
    stamps = {path: path.stat().st_mtime_ns for path in finished.rglob("*") if path.name != "run.json"}
    run(config_of(known, finished))
    assert known.model.calls == calls
    assert {path: path.stat().st_mtime_ns for path in finished.rglob("*") if path.name != "run.json"} == stamps
    after = read_json(finished / "run.json")
    assert after == before and after["complete"] == ["odometry", "observe", "slam", "map", "crops", "figures"]


def test_an_interruption_keeps_what_is_complete(known: SimulatedDrive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "run"
    short = replace(config_of(known, out).slam, em_iterations=1)
    config = config_of(known, out, truth_objects=None, frame_stride=2, online=True, slam=short)
    write = pipeline.write_thumbnails

    def interrupted(folder: Path, *arguments: Any) -> None:
        write(folder, *arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(pipeline, "write_thumbnails", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(config)
    assert not (out / "crops").exists() and not (out / "summary.json").exists()
    assert read_json(out / "run.json")["complete"] == ["odometry", "observe", "slam", "map"]
    monkeypatch.setattr(pipeline, "write_thumbnails", write)
    calls = known.model.calls
    summary = run(config)
    assert known.model.calls == calls  # only the rest is done
    assert summary["frames"] == 60 and "loops" not in summary
    rows = [json.loads(line) for line in (out / "frames.jsonl").read_text().splitlines()]
    assert [row["index"] for row in rows] == list(range(0, 120, 2))
    assert len(read_trajectory(out / "truth.txt")) == 60


def test_keyframes_by_distance(known: SimulatedDrive, tmp_path: Path) -> None:
    mission = ObjectMappingPipeline(config_of(known, tmp_path, keyframe_distance=4.0))
    mission.odometry()
    kept = read_trajectory(tmp_path / "odometry.txt").T_world_camera
    given = read_trajectory(known.folder / "odometry.txt").T_world_camera
    np.testing.assert_allclose(kept, given[mission.run.keyframes], atol=1e-9)
    step = np.linalg.norm(np.diff(kept[:, :3, 3], axis=0), axis=1)
    assert step.min() >= 4.0 and step.max() < 8.0
    np.testing.assert_allclose(
        read_trajectory(tmp_path / "truth.txt").T_world_camera, known.truth[mission.run.keyframes], atol=1e-9
    )


def test_covariances_beside_an_odometry_come_with_it(known: SimulatedDrive, tmp_path: Path) -> None:
    """Steps of two images: the covariance of the first is carried into the later camera and added to the second."""
    T = read_trajectory(known.folder / "odometry.txt").T_world_camera
    write_trajectory(tmp_path / "mine" / "odometry.txt", Trajectory(T))
    one = np.diag([1e-6, 2e-6, 3e-6, 1e-4, 2e-4, 3e-4])
    np.savez(tmp_path / "mine" / "odometry_covariance.npz", covariance=np.tile(one, (119, 1, 1)))
    mission = ObjectMappingPipeline(
        config_of(known, tmp_path / "run", odometry=tmp_path / "mine" / "odometry.txt", frame_stride=2)
    )
    (tmp_path / "run").mkdir()
    mission.odometry()
    with np.load(tmp_path / "run" / "odometry_covariance.npz") as arrays:
        covariance = arrays["covariance"]
    assert covariance.shape == (59, 6, 6)
    step = np.linalg.inv(T[1]) @ T[2]
    rng = np.random.default_rng(0)
    from nolbo_ppl.geometry.pose import se3_exp, se3_log

    first, second = (rng.multivariate_normal(np.zeros(6), one, 20000) for _ in range(2))
    moved = se3_log(np.linalg.inv(step) @ se3_exp(first) @ step @ se3_exp(second))
    np.testing.assert_allclose(np.cov(moved.T), covariance[0], atol=0.05 * np.abs(covariance[0]).max())


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"odometry": None, "truth": None}, "visual odometry without a scale"),
        ({"intrinsics": Path("nothing.json")}, "no such file"),
        ({"images": Path("nowhere")}, "nowhere"),
        ({"truth": "short"}, "truth does not match the images row by row: got 5 rows, expected 120"),
    ],
)
def test_bad_input_is_refused(known: SimulatedDrive, tmp_path: Path, change: dict[str, Any], match: str) -> None:
    if change.get("truth") == "short":
        write_trajectory(tmp_path / "short.txt", Trajectory(known.truth[:5]))
        change = {"truth": tmp_path / "short.txt"}
    with pytest.raises(InputError, match=match):
        run(config_of(known, tmp_path / "run", truth_objects=None, **change))
    assert not (tmp_path / "run" / "odometry.txt").exists()


def test_results_never_replace_the_input(known: SimulatedDrive) -> None:
    with pytest.raises(InputError, match="written over the input"):
        run(config_of(known, known.folder))


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"frame_stride": 0}, "--frame-stride"),
        ({"score_threshold": 1.0}, "--score-threshold"),
        ({"test_sizes": ()}, "--test-sizes"),
        ({"batch": 0}, "--batch"),
        ({"right": Path("right")}, "a stereo pair"),
        ({"keyframe_distance": -1.0}, "spacing of keyframes"),
        ({"depth": Path("d"), "right": Path("r"), "baseline": 0.1}, "--depth and --right"),
        ({"right": Path("r"), "baseline": -0.1}, "--baseline"),
        ({"camera_height": 1.0, "step_lengths": Path("w")}, "one source of"),
    ],
)
def test_options_that_make_no_sense(change: dict[str, Any], match: str) -> None:
    with pytest.raises(InputError, match=match):
        RunConfig(images=Path("i"), intrinsics=Path("k"), out=Path("o"), **change)


def test_the_whole_way_with_a_network(drive: SimulatedDrive, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:  # noqa: F811
    """The command itself, an untrained network in place of a trained one: whatever it says, the run ends in a report."""
    save(tmp_path / "model", tiny_model(scatter=0.1).float(), Calibration(objectness_shift=-1.5), {})
    folder = drive.folder
    main(
        [
            "--images",
            str(folder / "images"),
            "--intrinsics",
            str(folder / "intrinsics.json"),
            "--truth",
            str(folder / "truth.txt"),
            "--model",
            str(tmp_path / "model"),
            "--out",
            str(tmp_path / "run"),
            "--frame-stride",
            "12",
            "--test-sizes",
            "64",
            "--slam.em-iterations",
            "1",
        ]
    )
    told = capsys.readouterr().out
    assert "ATE before / after" in told and "images a second" in told
    assert {path.name for path in (tmp_path / "run").iterdir()} >= {"report.html", "summary.json", "odometry_covariance.npz"}
    rows = [json.loads(line) for line in (tmp_path / "run" / "observations.jsonl").read_text().splitlines()]
    assert rows and {row["frame"] for row in rows} <= set(range(10))
    for row in rows[:20]:
        assert sum(mode["weight"] for mode in row["rotation_modes"]) == pytest.approx(1.0, abs=1e-3)
