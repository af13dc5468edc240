"""Figures of a run: by hand, by enumeration of pairs, and where the simulation's noise is what it states."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch
from scipy.stats import vonmises

from nolbo_ppl.evaluation.sequence_scores import (
    coverage_scores,
    detection_scores,
    landmark_errors,
    loop_scores,
    map_scores,
    orientation_mass,
    position_scores,
    shape_scores,
)
from nolbo_ppl.evaluation.sequence_truth import MatchResult, read_ground_truth
from nolbo_ppl.geometry.pose import make_pose, so3_exp, transform
from nolbo_ppl.geometry.rotation import ray_rotation, viewpoint_to_matrix
from nolbo_ppl.metrics.association import landmark_to_object
from nolbo_ppl.structures.detections import Detections
from tests.evaluation.test_sequence_truth import names
from tests.simulated_sequence import SimulatedDrive


def test_position_errors_by_range() -> None:
    true = np.array([[0, 0, 2.0], [0, 0, 4.0], [0, 0, 8.0], [np.nan] * 3, [0, 0, 50.0]])
    said = true + np.array([[0, 0, 0.1], [0, 0.3, 0], [0.4, 0, 0], [1, 1, 1], [0, 0, -5.0]])
    bands = position_scores(said, true)
    assert list(bands) == ["all", "0-5 m", "5-10 m", "40 m and more"]
    assert bands["all"]["count"] == 4 and bands["all"]["median"] == pytest.approx(0.35)
    assert bands["0-5 m"]["median"] == pytest.approx(0.2) and bands["0-5 m"]["p90"] == pytest.approx(0.28)
    assert bands["40 m and more"]["median_share"] == pytest.approx(0.1)
    assert position_scores(said[:0], true[:0]) == {}


def test_mass_of_the_azimuth_region_far_off_axis() -> None:
    """One von Mises mode: the region out to the truth is an interval about the mode; the truth is told egocentrically."""
    position = np.array([4.0, -1.0, 3.0])
    R_ray = ray_rotation(torch.from_numpy(position)).numpy()
    off = 0.21
    true = R_ray @ viewpoint_to_matrix(torch.tensor([1.1 + off, 0.2, -0.1])).numpy()
    seen = dataclasses.replace(
        Detections.from_arrays([0, 0], np.tile(position, (2, 1))),
        azimuth_weight=np.array([[1.0, np.nan], [0.5, 0.5]]),
        azimuth=np.array([[1.1, np.nan], [1.1, 1.1 - math.pi]]),
        azimuth_concentration=np.array([[30.0, np.nan], [30.0, 30.0]]),
    )
    mass = orientation_mass(seen, np.tile(position, (2, 1)), np.tile(true, (2, 1, 1)), np.array([1, 2]))
    expected = vonmises(30.0).cdf(off) - vonmises(30.0).cdf(-off)
    # Two modes half a turn apart, of an object that half a turn leaves as it is: one mode.
    np.testing.assert_allclose(mass, expected, atol=2e-3)
    assert (
        len(orientation_mass(seen.select(np.zeros(0, dtype=int)), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0, dtype=int)))
        == 0
    )


def test_loop_pairs_by_enumeration() -> None:
    rng = np.random.default_rng(0)
    frame, object_of, landmark_of = rng.integers(0, 200, 80), rng.integers(-1, 6, 80), rng.integers(-1, 6, 80)
    far = [(i, j) for i, j in itertools.combinations(range(80), 2) if abs(frame[i] - frame[j]) > 50]
    true = {(i, j) for i, j in far if object_of[i] == object_of[j] >= 0}
    found = {(i, j) for i, j in far if landmark_of[i] == landmark_of[j] >= 0}
    judged = {(i, j) for i, j in found if object_of[i] >= 0 or object_of[j] >= 0}
    figures = loop_scores(frame, object_of, landmark_of, 50)
    assert (figures["true_pairs"], figures["found_pairs"]) == (len(true), len(found))
    assert figures["recall"] == pytest.approx(len(true & found) / len(true), abs=1e-6)
    assert figures["precision_strict"] == pytest.approx(len(true & found) / len(found), abs=1e-6)
    assert figures["precision"] == pytest.approx(len(true & found) / len(judged), abs=1e-6)
    assert figures["unlabelled_pairs"] == len(found) - len(judged) > 0
    nothing = loop_scores(frame, object_of, np.full(80, -1), 50)
    assert nothing["precision"] is None and nothing["recall"] == 0.0


def test_landmarks_against_objects(drive: SimulatedDrive) -> None:
    truth = read_ground_truth(drive.folder, names(drive)[:1])
    object_of = np.array([0, 0, 0, 1, 1, 2, -1, -1, 3])
    landmark_of = np.array([0, 0, 1, 2, 2, 2, 3, 3, -1])
    owner, purity = landmark_to_object(object_of, landmark_of, 5)
    np.testing.assert_array_equal(owner, [0, 0, 1, -1, -1])
    np.testing.assert_allclose(purity, [1, 1, 2 / 3, 1, 0])
    figures = map_scores(object_of, owner, purity, np.array([True, True, True, True, False]), truth, least_detections=2)
    assert figures == {
        "landmarks": 4,
        "objects": len(truth),
        "objects_detected": 2,
        "objects_mapped": 2,
        "duplicates": 1,
        "spurious": 1,
        "mean_purity": pytest.approx((1 + 1 + 2 / 3 + 1) / 4, abs=1e-6),
    }


def test_landmark_errors_do_not_depend_on_the_world_of_the_estimate(drive: SimulatedDrive) -> None:
    truth = read_ground_truth(drive.folder, names(drive)[:1])
    owner = np.array([2, 0, -1])
    T = make_pose(so3_exp(np.array([0.1, 1.0, -0.2])), np.array([3.0, 1.0, -7.0]))
    position = transform(T, np.concatenate([truth.T_world_object[owner[:2], :3, 3], np.zeros((1, 3))]))
    position[1] += T[:3, :3] @ [0.0, 0.6, 0.8]
    error = landmark_errors(position, owner, truth, T @ drive.truth, drive.truth)
    np.testing.assert_allclose(error, [0.0, 1.0, np.nan], atol=1e-9)


def known(drive: SimulatedDrive) -> MatchResult:
    """Every detection with its object, from the simulation itself."""
    truth, table = read_ground_truth(drive.folder, names(drive)), drive.model.table
    row = np.full(len(table), -1)
    for k, i in enumerate(drive.object_of):
        hit = np.flatnonzero(truth.shown[table.frame[k]] == i)
        row[k] = hit[0] if len(hit) else -1
    of = np.where(row >= 0, drive.object_of, -1)
    return MatchResult(of, row, of >= 0, int((of >= 0).sum()), int((of >= 0).sum()))


def test_regions_of_honest_noise_hold_what_they_promise(drive: SimulatedDrive) -> None:
    """The simulation draws what it states: 90 % of positions and latents lie inside, within five standard errors."""
    truth, table, matched = read_ground_truth(drive.folder, names(drive)), drive.model.table, known(drive)
    model = drive.model
    figures = coverage_scores(matched, table, truth, model)
    error = 5 * math.sqrt(0.9 * 0.1 / figures["count"])
    assert figures["position"] == pytest.approx(0.9, abs=error)
    assert figures["latent"] == pytest.approx(0.9, abs=error)
    assert figures["orientation"] is None
    narrow = coverage_scores(matched, table, truth, None)
    assert narrow["latent"] is None and narrow["position"] == figures["position"]
    seen = detection_scores(matched, table, truth)
    assert seen["category_accuracy"] == 1.0 and 1.0 < seen["median_rotation_error_deg"] < 6.0


def test_shapes_grow_with_views(drive: SimulatedDrive) -> None:
    truth, table = read_ground_truth(drive.folder, names(drive)), drive.model.table
    owner = np.arange(len(truth))
    figures = shape_scores(table, drive.object_of, owner, truth, drive.model, np.random.default_rng(0))
    assert figures is not None and figures["landmarks"] > 5
    iou = list(figures["iou"].values())
    assert iou[0] < iou[1] < iou[2] <= 1.0
    few = shape_scores(table.select(np.arange(4)), drive.object_of[:4], owner, truth, drive.model, np.random.default_rng(0))
    assert few is None
