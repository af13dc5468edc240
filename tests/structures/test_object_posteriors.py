"""What the guide observed, as SLAM takes it: every azimuth mode turned into the camera's frame, nothing of it lost."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nolbo_ppl.geometry.pose import quaternion_to_matrix, rotation_angle, so3_exp
from nolbo_ppl.io.observations import read_observations, write_observations
from nolbo_ppl.structures.detection_checks import check_table
from nolbo_ppl.structures.detections import Detections
from nolbo_ppl.structures.object_posteriors import ObjectPosteriors, ViewpointModes

UPRIGHT_AND_FACING_BACK = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""R_camera_object of an object whose front (-y) looks along -z of the camera, its top (z) along -y."""


def observations(**change: Any) -> ObjectPosteriors:
    """Two objects with three azimuth modes each."""
    n, modes = 2, 3
    values: dict[str, Any] = {
        "categories": ("bottle", "car"),
        "objectness": np.array([0.9, 0.4]),
        "box": np.tile([10.0, 12.0, 40.0, 42.0], (n, 1)),
        "box_scale": np.ones((n, 4)),
        "class_log_posterior": np.log([[0.2, 0.8], [0.7, 0.3]]),
        "class_log_likelihood": np.array([[-9.0, -2.0], [-1.0, -3.0]]),
        "instance_log_posterior": None,
        "latent": np.arange(4.0).reshape(n, 2),
        "latent_scale": np.array([[0.1, 0.2], [0.3, 0.4]]),
        "position": np.array([[0.0, 0.0, 5.0], [1.0, 2.0, 4.0]]),
        "position_covariance": np.tile(np.diag([0.01, 0.01, 0.2]), (n, 1, 1)),
        "viewpoint_modes": ViewpointModes(
            np.array([[0.7, 0.2996, 0.0004], [0.4, 0.3, 0.3]]),
            np.array([[0.0, math.pi, 0.5], [0.1, 1.0, -2.0]]),
            np.array([[100.0, 25.0, 0.0], [4.0, 9.0, 16.0]]),
        ),
        "elevation_inplane": np.zeros((n, 2)),
        "elevation_inplane_scale": np.array([[0.03, 0.04], [0.1, 0.1]]),
        "viewpoint": np.zeros((n, 3)),
        "R_camera_object": np.tile(np.eye(3), (n, 1, 1)),
        "rotation_scale": np.array([0.1, 0.2]),
        "diagonal": np.ones(n),
        "diagonal_log_scale": np.full(n, 0.1),
        "size": np.full((n, 3), 0.5),
        "voxel_mean": None,
        "voxel_variance": None,
    }
    values.update(change)
    assert values["viewpoint_modes"].weights.shape[1] == modes
    return ObjectPosteriors(**values)


@pytest.mark.parametrize("bearing", [0.0, 0.9, -1.1])
def test_modes_of_an_object_far_off_axis(bearing: float) -> None:
    """By hand: an object to the right that faces back along the camera's axis shows the camera its right-hand side.

    The camera lies, seen from the object, in direction (-sin b, -cos b) of its x and y axes; azimuth a names the direction
    (sin a, -cos a); so a = -b. Half a turn more is the same object with its back to where its front was.
    """
    position = np.tile(7.0 * np.array([math.sin(bearing), 0.0, math.cos(bearing)]), (2, 1))
    azimuth = np.tile([-bearing, math.pi - bearing, 0.0], (2, 1))
    modes = observations(
        position=position, viewpoint_modes=ViewpointModes(np.full((2, 3), 1 / 3), azimuth, np.full((2, 3), 10.0))
    ).rotation_modes()
    np.testing.assert_allclose(modes.R_camera_object[:, 0], np.tile(UPRIGHT_AND_FACING_BACK, (2, 1, 1)), atol=1e-12)
    half_turn = UPRIGHT_AND_FACING_BACK @ np.diag([-1.0, -1.0, 1.0])
    np.testing.assert_allclose(modes.R_camera_object[:, 1], np.tile(half_turn, (2, 1, 1)), atol=1e-12)
    # The third mode is the azimuth that would be right straight ahead: off by the bearing, as the naive reading would be.
    np.testing.assert_allclose(rotation_angle(UPRIGHT_AND_FACING_BACK.T @ modes.R_camera_object[0, 2]), abs(bearing), atol=1e-9)


def test_modes_of_an_object_above_and_aside_follow_rodrigues() -> None:
    """Off axis in both directions: the turn is about the axis at right angles to optical axis and ray, by their angle."""
    position = np.array([[3.0, -2.0, 2.5], [-1.0, 4.0, 1.0]])
    found = observations(position=position).rotation_modes()
    straight = observations(position=np.tile([0.0, 0.0, 1.0], (2, 1))).rotation_modes()
    for i, ray in enumerate(position / np.linalg.norm(position, axis=1, keepdims=True)):
        axis = np.cross([0.0, 0.0, 1.0], ray)
        turn = so3_exp(axis / np.linalg.norm(axis) * math.acos(ray[2]))
        np.testing.assert_allclose(found.R_camera_object[i], turn @ straight.R_camera_object[i], atol=1e-12)


def test_scale_of_a_mode_is_the_root_mean_square_of_its_angles() -> None:
    found = observations().rotation_modes().scale
    np.testing.assert_allclose(found[0, 0], math.sqrt((0.1**2 + 0.03**2 + 0.04**2) / 3))
    np.testing.assert_allclose(found[1, 1], math.sqrt((1 / 9 + 0.02) / 3))
    assert math.isfinite(found[0, 2])  # no concentration at all


def test_detections_are_what_a_file_of_them_holds(tmp_path: Path) -> None:
    """To the last bit: a map from memory is the map from the file."""
    rng = np.random.default_rng(5)
    root = rng.standard_normal((2, 3, 3))
    seen = observations(
        position=rng.standard_normal((2, 3)) + [0, 0, 6],
        position_covariance=root @ root.swapaxes(1, 2) + 1e-3 * np.eye(3),
        latent=rng.standard_normal((2, 2)).astype(np.float32),
        R_camera_object=so3_exp(rng.standard_normal((2, 3))),
        viewpoint=rng.standard_normal((2, 3)),
    )
    table = Detections.concatenate([seen.detections(3, "a.png", 0.25), seen[:0].detections(4), seen.detections(5, "b.png")])
    write_observations(tmp_path / "o.jsonl", table)
    back = read_observations(tmp_path / "o.jsonl", frames=6)
    for field in dataclasses.fields(Detections):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(table, field.name), err_msg=field.name)
    check_table(table, frames=6)
    assert table.image == ("a.png", "a.png", "b.png", "b.png") and table.time[1] == 0.25 and np.isnan(table.time[2])
    np.testing.assert_allclose(table.latent[2:], seen.latent, rtol=1e-6)
    np.testing.assert_allclose(table.position_covariance[0], seen.position_covariance[0], rtol=1e-9)


def test_rows_carry_the_whole_posterior() -> None:
    seen = observations()
    first, second = seen.to_records(7, "000007.png")
    with pytest.warns(FutureWarning, match="rows is now to_records"):
        assert list(seen.rows(7, "000007.png")) == [first, second]
    assert first["frame"] == 7 and first["id"] == "000007-000" and first["image"] == "000007.png"
    assert first["category"] == "car" and first["class_posterior"] == {"bottle": 0.2, "car": 0.8}
    assert second["objectness"] == 0.4 and second["latent_std"] == [0.3, 0.4]
    np.testing.assert_allclose(first["position_std"], np.sqrt(np.diag(seen.position_covariance[0])))
    modes = seen.rotation_modes()
    # A mode without weight is left out, the others sum to one.
    assert [m["weight"] for m in first["rotation_modes"]] == [float(f"{w / 0.9996:.7g}") for w in (0.7, 0.2996)]
    assert len(second["rotation_modes"]) == 3
    for row, i in ((first, 0), (second, 1)):
        for k, mode in enumerate(row["rotation_modes"]):
            np.testing.assert_allclose(quaternion_to_matrix(np.array(mode["rotation"])), modes.R_camera_object[i, k], atol=1e-7)
            assert mode["std"] == pytest.approx(modes.scale[i, k], abs=1e-5)
