"""Files of a map: what is written comes back, what is not known stays unknown; whose a detection is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.geometry.pose import R_WORLD_UPRIGHT, make_pose, so3_exp
from nolbo_ppl.io.files import read_json, write_json
from nolbo_ppl.io.landmarks import (
    Iterations,
    read_associations,
    read_iterations,
    read_landmarks,
    read_voxels,
    voxel_names,
    write_associations,
    write_iterations,
    write_landmarks,
    write_voxels,
)
from nolbo_ppl.io.npz import Npz
from nolbo_ppl.structures.association_table import AssociationTable, majority_landmark
from nolbo_ppl.structures.landmark import Landmark


def known_landmark(rng: np.random.Generator) -> Landmark:
    root = rng.standard_normal((6, 6))
    T, covariance = make_pose(so3_exp(rng.standard_normal(3)), rng.standard_normal(3)), root @ root.T + np.eye(6)
    return Landmark(
        name="L3",
        T_world_object=T,
        covariance=covariance,
        position_covariance=T[:3, :3] @ covariance[3:, 3:] @ T[:3, :3].T,
        oriented=True,
        existence=0.75,
        class_posterior={"car": 0.25, "bus": 0.75},
        latent=rng.standard_normal(3),
        latent_variance=rng.random(3) + 0.1,
        size=np.array([1.0, 2.0, 2.0]),
        detections=3.5,
        first_frame=2,
        last_frame=9,
    )


def test_a_landmark_comes_back(tmp_path: Path) -> None:
    given = known_landmark(np.random.default_rng(0))
    write_landmarks(tmp_path / "landmarks.json", [given])
    (back,) = read_landmarks(tmp_path / "landmarks.json")
    for name in ("T_world_object", "position_covariance", "latent", "latent_variance", "size"):
        np.testing.assert_allclose(getattr(back, name), getattr(given, name), rtol=1e-9, atol=1e-12, err_msg=name)
    for name in ("name", "oriented", "existence", "class_posterior", "detections", "frames", "category"):
        assert getattr(back, name) == getattr(given, name)
    assert back.category == "bus" and back.diagonal == 3.0
    np.testing.assert_allclose(back.covariance[:3, :3], given.covariance[:3, :3])
    np.testing.assert_allclose(back.covariance[3:, 3:], given.covariance[3:, 3:])  # in the object's own frame again
    assert np.isnan(back.covariance[:3, 3:]).all()  # files do not hold it
    write_landmarks(tmp_path / "again.json", [back])
    assert read_json(tmp_path / "again.json")[0].keys() == read_json(tmp_path / "landmarks.json")[0].keys()


def test_what_a_file_does_not_say_is_unknown(tmp_path: Path) -> None:
    write_json(tmp_path / "landmarks.json", [{"name": "any text", "position": [1, 2, 3]}])
    (bare,) = read_landmarks(tmp_path / "landmarks.json")
    np.testing.assert_array_equal(bare.T_world_object, make_pose(R_WORLD_UPRIGHT, np.array([1.0, 2.0, 3.0])))
    assert np.isnan(bare.existence) and np.isnan(bare.detections) and np.isnan(bare.spread) and bare.frames is None
    assert bare.category is None and bare.size is None and not bare.oriented and bare.likely and bare.in_map
    write_landmarks(tmp_path / "again.json", [bare])
    assert read_json(tmp_path / "again.json") == [{"name": "any text", "position": [1.0, 2.0, 3.0]}]


@pytest.mark.parametrize(
    ("existence", "detections", "likely", "in_map"),
    [(0.9, 2.0, True, True), (0.4, 2.0, False, False), (0.9, 0.1, True, False), (np.nan, np.nan, True, True)],
)
def test_what_is_part_of_the_map(existence: float, detections: float, likely: bool, in_map: bool) -> None:
    landmark = Landmark("L0", np.eye(4), existence=existence, detections=detections)
    assert (landmark.likely, landmark.in_map) == (likely, in_map)


def test_associations_come_back_and_sort_by_time(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    frame = np.array([4, 0, 2, 2])
    found = AssociationTable(
        ("a", "b", "c", "d"),
        np.array([0, 0, 1, 3]),
        np.array([0, 2, 1, 1]),
        np.array([0.625, 0.25, 0.5, 0.75]),
        rng.random(4).round(3),
        rng.random(4).round(3),
        frame,
    )
    assert found.landmark_of.tolist() == [0, -1, -1, 1]  # one half is not more than half
    write_associations(tmp_path / "a.jsonl", found, ["L0", "L1", "L2"])
    back = read_associations(tmp_path / "a.jsonl", ["L0", "L1", "L2"], dict(zip(found.id, frame.tolist())))
    for name in ("row", "landmark", "weight", "new", "background", "frame"):
        np.testing.assert_array_equal(getattr(back, name), getattr(found, name), err_msg=name)
    in_time = back.in_time()
    assert in_time.id == ("b", "c", "d", "a") and in_time.frame.tolist() == [0, 2, 2, 4]
    assert dict(zip(in_time.id, in_time.landmark_of.tolist())) == dict(zip(found.id, found.landmark_of.tolist()))
    np.testing.assert_array_equal(in_time.new, found.new[[1, 2, 3, 0]])
    without = read_associations(tmp_path / "a.jsonl", ["L1"])
    assert without.frame is None and without.in_time() is without and without.weight.tolist() == [0.5, 0.75]


def test_whose_a_detection_is_against_a_dense_table() -> None:
    rng = np.random.default_rng(2)
    dense = rng.dirichlet(np.full(5, 0.3), 200)[:, :4]  # the last column: none of them
    row, landmark = np.nonzero(dense > 0.01)
    order = rng.permutation(len(row))
    found = majority_landmark(row[order], landmark[order], dense[row, landmark][order], 200)
    np.testing.assert_array_equal(found, np.where(dense.max(axis=1) > 0.5, dense.argmax(axis=1), -1))


def test_voxels_and_iterations_come_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    mean, variance = rng.random((4, 4, 4)), rng.random((4, 4, 4))
    write_voxels(tmp_path / "v.npz", {"L0": (mean, variance)})
    with Npz(tmp_path / "v.npz") as archive:
        assert voxel_names(archive) == {"L0"}
        np.testing.assert_allclose(read_voxels(archive, "L0"), (mean, variance), atol=1e-3)
    given = Iterations(rng.random((2, 3, 4, 4)), (np.zeros((0, 3)), rng.random((5, 3))))
    write_iterations(tmp_path / "i.npz", given)
    back = read_iterations(tmp_path / "i.npz", 3)
    np.testing.assert_allclose(back.T_world_camera, given.T_world_camera, rtol=1e-6)
    assert len(back) == 2 and len(back.landmarks[0]) == 0
    np.testing.assert_allclose(back.landmarks[1], given.landmarks[1], rtol=1e-6)
