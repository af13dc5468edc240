"""Converters: geometry of the frames on made-up files, and the real files where they are present."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.data.converters import convert_kitti_poles, convert_kitti_tracking, convert_ycbv_slam, write_converted
from nolbo_ppl.data.converters.kitti_tracking import car_rotation, longest_run, planar_poses
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import is_rotation, make_pose, matrix_to_quaternion, relative, transform
from nolbo_ppl.io.files import read_json
from nolbo_ppl.io.observations import check_table, read_observations
from nolbo_ppl.io.trajectories import Trajectory, read_trajectory, write_trajectory


def test_planar_poses_turn_left_with_theta() -> None:
    T = planar_poses(np.array([[0.0, 0.0, 0.0], [2.0, 1.0, np.pi / 2]]))
    np.testing.assert_allclose(T[0], np.eye(4), atol=1e-15)
    np.testing.assert_allclose(T[1, :3, 3], [-1.0, 0.0, 2.0], atol=1e-12)  # 1 m left is x = -1, 2 m ahead is z = 2
    np.testing.assert_allclose(T[1, :3, 2], [-1.0, 0.0, 0.0], atol=1e-12)  # the optical axis now looks left


def test_cars_face_along_rotation_y() -> None:
    R = car_rotation(np.array([0.0, np.pi / 2, -0.7]))
    assert is_rotation(R).all()
    np.testing.assert_allclose(-R[0, :, 1], [1.0, 0.0, 0.0], atol=1e-12)  # rotation_y 0: front along camera x
    np.testing.assert_allclose(-R[1, :, 1], [0.0, 0.0, -1.0], atol=1e-12)  # pi/2: towards the camera
    np.testing.assert_allclose(R[:, :, 2], np.tile([0.0, -1.0, 0.0], (3, 1)), atol=1e-12)


@pytest.mark.parametrize(("mask", "run"), [([0, 1, 1, 0, 1], (1, 3)), ([1, 1], (0, 2)), ([0, 0, 0], (0, 3))])
def test_longest_run(mask: list[int], run: tuple[int, int]) -> None:
    assert longest_run(np.array(mask, dtype=bool)) == run


def make_kitti_poles(folder: Path) -> None:
    T = make_pose(np.tile(np.eye(3), (20, 1, 1)), np.arange(20)[:, None] * np.array([0.0, 0.0, 1.0]))
    for name in ("poses", "odometry_f2f"):
        write_trajectory(folder / name / "00.txt", Trajectory(T))
    (folder / "poles").mkdir()
    np.save(folder / "poles" / "00.npy", np.array([[25.0, 5.0], [30.0, -4.0]]))


def test_poles_are_seen_where_they_are(tmp_path: Path) -> None:
    make_kitti_poles(tmp_path)
    data = convert_kitti_poles(tmp_path, "00", position_scale=1e-6, position_ratio=0.0, miss_rate=0.0, clutter_rate=0.0)
    world = transform(data.truth.T_world_camera[data.observations.frame], data.observations.position)
    expected = {"pole-0": [-5.0, 0.0, 25.0], "pole-1": [4.0, 0.0, 30.0]}
    assert set(data.objects) == set(expected)
    for point, name in zip(world, data.objects):
        assert name is not None
        np.testing.assert_allclose(point, expected[name], atol=1e-4)
    again = convert_kitti_poles(tmp_path, "00", seed=1)
    np.testing.assert_array_equal(again.observations.position, convert_kitti_poles(tmp_path, "00", seed=1).observations.position)


def test_poles_noise_misses_and_clutter_are_as_stated(tmp_path: Path) -> None:
    make_kitti_poles(tmp_path)
    clutter, missed, whitened = 0, 0, []
    full = sum(o is not None for o in convert_kitti_poles(tmp_path, "00", miss_rate=0.0, clutter_rate=0.0).objects)
    runs = 60
    for seed in range(runs):
        data = convert_kitti_poles(tmp_path, "00", seed=seed)
        true = np.array([o is not None for o in data.objects])
        clutter += int((~true).sum())
        missed += full - int(true.sum())
        place = np.array([data.T_world_object[o][:3, 3] for o in data.objects if o is not None])
        world = transform(data.truth.T_world_camera[data.observations.frame[true]], data.observations.position[true])
        scale = np.sqrt(data.observations.position_covariance[true][:, 0, 0])
        whitened.append(((world - place) / scale[:, None]).ravel())
    z = np.concatenate(whitened)
    assert z.std() == pytest.approx(1.0, abs=5 / np.sqrt(2 * len(z)))
    assert clutter / (20 * runs) == pytest.approx(0.5, abs=5 * np.sqrt(0.5 / (20 * runs)))
    assert missed / (full * runs) == pytest.approx(0.15, abs=5 * np.sqrt(0.15 * 0.85 / (full * runs)))


def test_missing_and_mismatched_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="true poses not found"):
        convert_kitti_poles(tmp_path, "00")
    make_kitti_poles(tmp_path)
    write_trajectory(tmp_path / "odometry_f2f" / "00.txt", Trajectory(np.tile(np.eye(4), (3, 1, 1))))
    with pytest.raises(InputError, match="different lengths"):
        convert_kitti_poles(tmp_path, "00")


def test_tracking_lines_are_checked(tmp_path: Path) -> None:
    for name in ("labels", "detections_car", "pseudo_ego"):
        (tmp_path / name).mkdir()
    np.savez(tmp_path / "pseudo_ego" / "0000.npz", P=np.zeros((4, 3)), cov=np.ones(4))
    (tmp_path / "labels" / "0000.txt").write_text("")
    detection = "1,2,0,0,1,1,9.0,1.5,1.6,4.0,1.0,2.0,10.0,0.0,0.0"
    (tmp_path / "detections_car" / "0000.txt").write_text(detection + "\n")
    data = convert_kitti_tracking(tmp_path, "0000")
    np.testing.assert_allclose(data.observations.position, [[1.0, 1.25, 10.0]])
    np.testing.assert_allclose(data.observations.size, [[1.6, 4.0, 1.5]])
    assert data.objects == (None,)
    (tmp_path / "detections_car" / "0000.txt").write_text(detection + "\n1,2,3\n")
    with pytest.raises(InputError, match=":2: not a detection"):
        convert_kitti_tracking(tmp_path, "0000")


def test_ycbv_rows_of_zeros_are_no_detections(tmp_path: Path) -> None:
    n = 30
    rng = np.random.default_rng(0)
    position = np.cumsum(0.01 * rng.standard_normal((n, 3)), axis=0)
    quaternion = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))
    truth = np.concatenate([position, quaternion], axis=1)
    world = make_pose(np.eye(3), np.array([0.1, 0.2, 1.0]))
    local = relative(make_pose(np.tile(np.eye(3), (n, 1, 1)), position), world)
    rows = np.concatenate([local[:, :3, 3], matrix_to_quaternion(local[:, :3, :3])], axis=1)
    detected = rows.copy()
    detected[::2] = 0.0
    np.savez(
        tmp_path / "0001.npz",
        **{"t": np.arange(n) / 10, "cam_gt": truth, "odom_est": truth, "det_initial/box": detected, "gt/box": rows},
    )
    data = convert_ycbv_slam(tmp_path, "0001", every=3, rotation_drift=0.0, translation_drift=0.0)
    assert len(data.odometry) == 10 and len(data.observations) == 5
    np.testing.assert_allclose(data.T_world_object["box"], world, atol=1e-9)
    np.testing.assert_allclose(data.odometry.T_world_camera, data.truth.T_world_camera, atol=1e-9)
    with pytest.raises(InputError, match="no such detections"):
        convert_ycbv_slam(tmp_path, "0001", detections="det_none")


def test_real_files_convert_and_read_back(data_dir: Path, tmp_path: Path) -> None:
    data = convert_kitti_tracking(data_dir / "kitti_tracking", "0009")
    write_converted(tmp_path, data)
    table = read_observations(tmp_path / "observations.jsonl", frames=len(data.odometry))
    check_table(table, len(read_trajectory(tmp_path / "odometry.txt")))
    assert read_json(tmp_path / "objects.json")["objects"].keys() == set(table.id)
    # Parked cars stay in place under the rebuilt ego motion: the frames are consistent.
    world = transform(data.truth.T_world_camera[data.observations.frame], data.observations.position)
    parked = [o for o in data.T_world_object if sum(x == o for x in data.objects) > 20]
    assert len(parked) > 10
    spread = [
        np.median(np.abs(world[[x == o for x in data.objects]] - np.median(world[[x == o for x in data.objects]], axis=0)))
        for o in parked
    ]
    assert np.median(spread) < 0.15
    box = convert_ycbv_slam(data_dir / "ycbv_slam", "0033")
    assert box.odometry.format == "tum" and len(box.observations) > 50


def test_ycbv_states_the_drift_it_added(tmp_path: Path) -> None:
    n = 30
    identity = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (n, 1))
    camera = identity.copy()
    camera[:, 2] = np.arange(n) * 0.01
    arrays = {"t": np.arange(n) / 30, "cam_gt": camera, "odom_est": camera, "det_initial/cup": identity, "gt/cup": identity}
    np.savez(tmp_path / "0001.npz", **arrays)  # type: ignore[arg-type]
    data = convert_ycbv_slam(tmp_path, "0001", rotation_drift=0.02, translation_drift=0.005)
    assert data.odometry_covariance is not None and data.odometry_covariance.shape == (2, 6, 6)
    np.testing.assert_allclose(np.sqrt(np.diag(data.odometry_covariance[0])), [0.02] * 3 + [0.005] * 3)
    write_converted(tmp_path / "out", data)
    with np.load(tmp_path / "out" / "odometry_covariance.npz", allow_pickle=False) as file:
        np.testing.assert_array_equal(file["covariance"], data.odometry_covariance)
