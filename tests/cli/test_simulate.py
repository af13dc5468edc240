"""`nolbo simulate`: worlds for `nolbo slam`, with the truth beside them."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binomtest, chi2

from nolbo_ppl.cli import main
from nolbo_ppl.cli.simulate import SimulateConfig, simulate
from nolbo_ppl.data.simulate import DetectorConfig, WorldConfig
from nolbo_ppl.data.simulated_paths import circle, figure_of_eight, room, straight
from nolbo_ppl.geometry.pose import inverse, is_rotation, relative, transform
from nolbo_ppl.io.npz import Npz
from nolbo_ppl.io.observations import read_observations
from nolbo_ppl.io.trajectories import read_trajectory

SMALL = ["--frames", "40", "--laps", "1", "--radius", "15", "--world.objects", "12"]


def test_writes_what_slam_reads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["simulate", "--out", str(tmp_path / "world"), *SMALL])
    assert "40 frames, 12 objects" in capsys.readouterr().out
    truth = read_trajectory(tmp_path / "world/truth.txt").T_world_camera
    table = read_observations(tmp_path / "world/observations.jsonl", len(truth))
    objects = json.loads((tmp_path / "world/objects.json").read_text())
    main(
        ["slam", "--odometry", str(tmp_path / "world/odometry.txt"), "--truth", str(tmp_path / "world/truth.txt")]
        + ["--observations", str(tmp_path / "world/observations.jsonl"), "--out", str(tmp_path / "map")]
    )
    assert json.loads((tmp_path / "map/summary.json").read_text())["frames"] == 40
    # The detections lie about their objects as their covariances say: the sum of squares is chi-square.
    square, count = 0.0, 0
    for k, name in enumerate(table.id):
        true = objects["objects"][name]
        if true is None:
            continue
        point = np.array(objects["T_world_object"][true])[:3, 3]
        gap = table.position[k] - transform(inverse(truth[table.frame[k]]), point)
        square += gap @ np.linalg.solve(table.position_covariance[k], gap)
        count += 3
    assert chi2.ppf(1e-6, count) < square < chi2.ppf(1 - 1e-6, count)


def test_same_seed_same_world_another_seed_another(tmp_path: Path) -> None:
    for name, seed in (("a", "3"), ("b", "3"), ("c", "4")):
        main(["simulate", "--out", str(tmp_path / name), *SMALL, "--seed", seed])
    text = {name: (tmp_path / name / "observations.jsonl").read_text() for name in "abc"}
    assert text["a"] == text["b"] != text["c"]


def test_confusions_persist() -> None:
    config = SimulateConfig(
        Path("unused"),
        frames=200,
        radius=20.0,
        world=WorldConfig(objects=40, categories=5),
        detector=DetectorConfig(confused_objects=0.5, confusion_rate=0.7, clutter_rate=0.0),
        seed=1,
    )
    drive = simulate(config)
    assert drive.world is not None
    wrong = np.array([f"c{drive.world.category[j]}" for j in drive.object_of]) != np.array(drive.observations.category)
    objects = np.unique(drive.object_of)
    share = np.array([wrong[drive.object_of == j].mean() for j in objects])
    prone = share > 0
    assert binomtest(int(prone.sum()), len(objects), 0.5).pvalue > 1e-6
    views = np.isin(drive.object_of, objects[prone])
    assert binomtest(int(wrong[views].sum()), int(views.sum()), 0.7).pvalue > 1e-6
    for j in objects[prone]:  # each prone object is always taken for one and the same other category
        assert len({c for c, w, k in zip(drive.observations.category, wrong, drive.object_of) if w and k == j}) == 1


def test_look_alikes_have_one_latent_a_category_and_scales_can_be_left_unstated() -> None:
    drive = simulate(SimulateConfig(Path("unused"), frames=50, identical=True, state_scales=False))
    assert drive.world is not None
    np.testing.assert_array_equal(drive.world.latent, drive.world.category_latent[drive.world.category])
    assert np.isnan(drive.observations.position_covariance).all()
    assert np.isnan(drive.observations.latent_scale).all()


@pytest.mark.parametrize(
    "path",
    [circle(50, 2, 10.0), straight(50, 30.0), figure_of_eight(60, 1, 10.0), room(80, 3.0, np.random.default_rng(0))],
    ids=["circle", "straight", "eight", "room"],
)
def test_paths_are_level_rigid_and_look_ahead(path: np.ndarray) -> None:
    assert is_rotation(path[:, :3, :3]).all()
    np.testing.assert_allclose(path[0], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(path[:, 1, 3], 0.0, atol=1e-9)  # the camera keeps its height
    np.testing.assert_allclose(path[:, :3, 1] @ np.array([0.0, 1.0, 0.0]), 1.0, atol=1e-9)  # y stays down
    steps = relative(path[:-1], path[1:])[:, :3, 3]
    assert (steps[:, 2] > 0.9 * np.linalg.norm(steps, axis=1)).mean() > 0.8


def test_odometry_bias_is_the_length_of_every_step(tmp_path: Path) -> None:
    quiet = ["--odometry.rotation-scale", "0", "--odometry.translation-ratio", "0", "--odometry.length-factor", "1.05"]
    main(["simulate", "--out", str(tmp_path), *SMALL, *quiet])
    odometry, truth = (read_trajectory(tmp_path / f"{name}.txt").T_world_camera for name in ("odometry", "truth"))
    lengths = [np.linalg.norm(relative(T[:-1], T[1:])[:, :3, 3], axis=1) for T in (odometry, truth)]
    np.testing.assert_allclose(lengths[0], 1.05 * lengths[1], rtol=1e-6)


@pytest.mark.parametrize(
    ("option", "value", "name"),
    [
        ("--detector.miss-rate", "1.5", "miss-rate"),
        ("--radius", "nan", "radius"),
        ("--frames", "1", "frames"),
        ("--odometry.rotation-scale", "-1", "rotation-scale"),
        ("--detector.clutter-rate", "inf", "clutter-rate"),
        ("--seed", "-1", "seed"),
    ],
)
def test_options_out_of_range_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str, value: str, name: str
) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["simulate", "--out", str(tmp_path / "world"), option, value])
    assert stop.value.code == 2
    assert name in capsys.readouterr().err
    assert not (tmp_path / "world").exists()


def test_scale_drift_is_simulated_and_solved(tmp_path: Path) -> None:
    options = ["--odometry.scale-drift", "0.01", "--odometry.length-factor", "0.3", "--laps", "2"]
    main(["simulate", "--out", str(tmp_path / "world"), *SMALL, *options])
    world, given = tmp_path / "world", ["--odometry", str(tmp_path / "world/odometry.txt")]
    given += ["--observations", str(world / "observations.jsonl"), "--truth", str(world / "truth.txt"), "--scale-drift"]
    main(["slam", *given, "--out", str(tmp_path / "map")])
    summary = json.loads((tmp_path / "map/summary.json").read_text())
    assert summary["after"]["ate"] < 0.2 * summary["before"]["ate"]
    with Npz(tmp_path / "map/scale.npz") as archive:
        scale, deviation = archive.array("scale"), archive.array("standard_deviation")
    assert scale.shape == deviation.shape == (39,)
    assert summary["scale"]["median"] == pytest.approx(np.median(scale)) and (deviation > 0).all()
    with pytest.raises(SystemExit) as error:
        main(["slam", *given, "--online", "--out", str(tmp_path / "online")])
    assert error.value.code == 2
