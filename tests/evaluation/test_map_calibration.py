"""Every probability a map states beside what happened."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.cli import main
from nolbo_ppl.data.simulate import DetectorConfig, SimulatedSequence, WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.evaluation.map_calibration import (
    association_cases,
    background_cases,
    class_cases,
    existence_cases,
    landmark_objects,
    landmark_regions,
    map_calibration,
    pose_regions,
)
from nolbo_ppl.geometry.pose import make_pose, relative, se3_exp, se3_log
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, SlamResult, solve
from nolbo_ppl.io.run_folder import read_run
from nolbo_ppl.io.true_objects import UNKNOWN, TrueObjects
from nolbo_ppl.report.calibration_section import calibration

CONFIG = SlamConfig(odometry_rotation_scale=0.01, odometry_translation_ratio=0.01, hypotheses=1)


@pytest.fixture(scope="module")
def solved() -> tuple[SimulatedSequence, SlamResult, TrueObjects]:
    rng = np.random.default_rng(0)
    truth = simulate_circuit(rng, laps=2, radius=18.0, frames_per_lap=30)[:44]
    world = WorldConfig(objects=15, categories=4, latent_dim=4)
    detector = DetectorConfig(objectness=(0.65, 0.4), clutter_rate=0.5)
    drive = simulate_sequence(truth, rng, world=world, detector=detector, odometry_rotation_scale=0.01)
    assert drive.world is not None
    poses = make_pose(drive.world.rotation, drive.world.position)
    objects = TrueObjects(drive.object_of, poses, tuple(f"c{k}" for k in drive.world.category), drive.world.latent)
    return drive, solve(SlamProblem(drive.odometry, drive.observations), CONFIG), objects


def test_landmarks_are_what_most_of_their_detections_are(solved: tuple[SimulatedSequence, SlamResult, TrueObjects]) -> None:
    drive, result, objects = solved
    owner, real = landmark_objects(result, objects.object_of)
    for j in range(len(owner)):
        mine = np.flatnonzero(result.associations.landmark == j)
        votes: dict[int, float] = {}
        for p in mine:
            of = int(objects.object_of[result.associations.row[p]])
            votes[of] = votes.get(of, 0.0) + result.associations.weight[p]
        assert owner[j] == max(votes, key=votes.__getitem__)
        assert real[j] == pytest.approx(1 - votes.get(-1, 0.0) / sum(votes.values()))
    everything_unknown = np.full(len(objects.object_of), UNKNOWN)
    assert (landmark_objects(result, everything_unknown)[0] == UNKNOWN).all()
    for cases in (background_cases, existence_cases, association_cases):
        assert len(cases(result, everything_unknown)[0]) == 0
    assert len(drive.observations) == len(background_cases(result, objects.object_of)[0])


def test_association_is_right_where_the_other_detections_are_of_that_object(
    solved: tuple[SimulatedSequence, SlamResult, TrueObjects],
) -> None:
    _, result, objects = solved
    found, of = result.associations, objects.object_of
    expected = []
    for p in range(len(found.row)):
        others = [q for q in range(len(found.row)) if q != p and found.landmark[q] == found.landmark[p]]
        if not others:
            continue
        votes = {o: sum(found.weight[q] for q in others if of[found.row[q]] == o) for o in {of[found.row[q]] for q in others}}
        most = max(votes, key=votes.__getitem__)
        expected.append((found.weight[p], float(most >= 0 and of[found.row[p]] == most)))
    stated, right = association_cases(result, of)
    np.testing.assert_allclose(sorted(zip(stated, right)), sorted(expected))
    assert right[stated > 0.9].mean() > 0.8
    # Detections nobody knows have no say: with all but two of a landmark unknown, the two stand against each other.
    j = int(np.argmax(np.bincount(found.landmark)))
    mine = found.row[(found.landmark == j) & (of[found.row] == landmark_objects(result, of)[0][j]) & (found.weight > 0.5)][:2]
    assert len(mine) == 2
    few = np.full(len(of), UNKNOWN)
    few[mine] = of[mine]
    stated, right = association_cases(result, few)
    assert right[stated > 0.5].tolist() == [1.0, 1.0]


def test_regions_are_those_of_the_stated_covariances(solved: tuple[SimulatedSequence, SlamResult, TrueObjects]) -> None:
    drive, result, objects = solved
    elsewhere = se3_exp(np.array([0.3, 1.0, -0.2, 5.0, 2.0, 7.0]))  # the truth's world need not be the answer's
    found = pose_regions(result, elsewhere @ drive.truth, every=7)
    rows = np.arange(7, len(drive.truth), 7)
    error = se3_log(relative(result.T_world_camera[rows], drive.truth[rows]))
    covariance = result.pose_covariances(rows)
    np.testing.assert_allclose(found.squared, [e @ np.linalg.inv(C) @ e for e, C in zip(error, covariance)], rtol=1e-6)
    lost = drive.truth.copy()
    lost[[0, 9]] = np.nan
    assert len(pose_regions(result, lost).squared) == 0
    regions = landmark_regions(result, objects, np.eye(4))
    owner, _ = landmark_objects(result, objects.object_of)
    assert len(regions["landmark_position"].squared) == (owner >= 0).sum() >= 8
    assert regions["landmark_latent"].degrees == 4 and 0.1 < regions["landmark_latent"].squared.mean() / 4 < 10
    assert ((regions["landmark_orientation"].mass >= 0) & (regions["landmark_orientation"].mass <= 1)).all()


def test_record_holds_what_truth_is_known_of(solved: tuple[SimulatedSequence, SlamResult, TrueObjects]) -> None:
    drive, result, objects = solved
    record = map_calibration(result, drive.truth, objects)
    assert set(record["probabilities"]) == {"background", "existence", "category", "association"}
    assert set(record["regions"]) == {"pose", "landmark_position", "landmark_orientation", "landmark_latent"}
    assert record["probabilities"]["background"]["log_score"] < 0.5
    assert json.loads(json.dumps(record, allow_nan=False)) == record
    bare = replace(objects, T_world_object=np.full_like(objects.T_world_object, np.nan), category=(None,) * 15, latent=None)
    less = map_calibration(result, None, bare)
    assert set(less["probabilities"]) == {"background", "existence", "association"} and less["regions"] == {}
    assert len(class_cases(result, objects.object_of, bare.category)[0]) == 0


def test_summary_and_report_show_it(tmp_path: Path) -> None:
    small = ["--frames", "40", "--laps", "2", "--radius", "15", "--world.objects", "12"]
    main(["simulate", "--out", str(tmp_path / "world"), *small])
    files = {name: str(tmp_path / "world" / name) for name in ("odometry.txt", "observations.jsonl", "truth.txt", "objects.json")}
    main(
        [
            "slam",
            "--odometry",
            files["odometry.txt"],
            "--observations",
            files["observations.jsonl"],
            "--truth",
            files["truth.txt"],
        ]
        + ["--truth-objects", files["objects.json"], "--out", str(tmp_path / "map"), "--config.hypotheses", "1"]
    )
    stated = json.loads((tmp_path / "map/summary.json").read_text())["calibration"]
    assert stated["regions"]["landmark_position"]["count"] >= 5 and stated["probabilities"]["category"]["count"] >= 5
    page = calibration(read_run(tmp_path / "map"))
    for words in ("Camera pose", "Landmark is an object", "if perfect", "Reliability: Detection is of the landmark"):
        assert words in page
    (tmp_path / "map/summary.json").write_text(
        json.dumps({"calibration": {"regions": 3, "probabilities": {"x": {"bins": "no"}}}})
    )
    assert "Landmark" not in calibration(read_run(tmp_path / "map"))
