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
from nolbo_ppl.metrics.calibration import chi_square_mass
from nolbo_ppl.structures.detection_checks import check_table
from nolbo_ppl.structures.detections import Detections
from nolbo_ppl.structures.latent_modes import LatentModes, modes_by_category
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


PRIOR_MEAN = np.array([[0.0, 0.0], [3.0, -4.0]])


def mixed(**change: Any) -> ObjectPosteriors:
    """The first object is car or bottle, of the second nothing but bottle is likely."""
    posterior = np.log([[0.2, 0.8], [0.99, 0.01]])
    latent = np.arange(4.0).reshape(2, 2)
    return observations(
        class_log_posterior=posterior, latent=latent, latent_modes=modes_by_category(latent, posterior, PRIOR_MEAN), **change
    )


def test_latent_is_a_mixture_over_categories() -> None:
    """sum_l q(l | I) N(z; prior mean + residual, scale), summed by hand, the residual that of the likeliest category."""
    seen = mixed()
    assert seen.latent_modes is not None
    np.testing.assert_array_equal(seen.latent_modes.category[0], [1, 0])
    np.testing.assert_array_equal(seen.latent_modes.mean[:, 0], seen.latent)
    np.testing.assert_allclose(seen.latent_modes.mean[0, 1], seen.latent[0] - PRIOR_MEAN[1])
    np.testing.assert_allclose(seen.latent_modes.weight, [[0.8, 0.2], [1.0, 0.0]])  # 0.01 is left out
    z = np.array([[-2.5, 4.8], [2.1, 3.3]])
    residual = seen.latent - PRIOR_MEAN[[1, 0]]
    for i, weights in enumerate(([0.2, 0.8], [1.0, 0.0])):
        error = (z[i] - PRIOR_MEAN - residual[i]) / seen.latent_scale[i]
        density = np.exp(-0.5 * error**2).prod(axis=1) / (2 * np.pi * seen.latent_scale[i].prod())
        np.testing.assert_allclose(seen.latent_log_density(z)[i], np.log(weights @ density), rtol=1e-12)
    plain = observations(latent=seen.latent)  # nobody states modes
    np.testing.assert_allclose(plain.latent_log_density(z)[1], seen.latent_log_density(z)[1], rtol=1e-12)
    np.testing.assert_array_equal(seen[[1]].latent_modes.weight, seen.latent_modes.weight[[1]])  # type: ignore[union-attr]


def test_region_mass_of_a_mixture_is_uniform() -> None:
    """Drawn from the mixture itself, masses are uniform, overlapping modes or not; of one mode it is that of chi square."""
    rng = np.random.default_rng(0)
    draws = rng.standard_normal((1000, 2))
    n = 400
    for distance in (1.5, 8.0):
        mean = np.tile([[0.0, 0.0], [distance, 0.0]], (n, 1, 1))
        modes = LatentModes(np.tile([0.7, 0.3], (n, 1)), mean, np.zeros((n, 2), dtype=int))
        scale = np.tile([1.0, 0.5], (n, 1))
        z = mean[np.arange(n), (rng.random(n) > 0.7).astype(int)] + scale * rng.standard_normal((n, 2))
        mass = modes.region_mass(z, scale, draws)
        assert abs(mass.mean() - 0.5) < 5 * np.sqrt(1 / 12 / n) + 5 * 0.5 / np.sqrt(1000)
        inside = np.mean(mass <= 0.9)
        assert abs(inside - 0.9) < 5 * np.sqrt(0.09 / n) + 5 * np.sqrt(0.09 / 1000)
    z = rng.standard_normal((50, 2))
    exact = chi_square_mass(z, np.ones((50, 2)))
    found = LatentModes.of_one(np.zeros((50, 2))).region_mass(z, np.ones((50, 2)), draws)
    np.testing.assert_allclose(found, exact, atol=5 * 0.5 / np.sqrt(1000))


def test_modes_of_latents_reach_files(tmp_path: Path) -> None:
    """An object of two likely categories states both modes, one that is sure states none."""
    seen = mixed().detections(frame=0)
    np.testing.assert_array_equal(seen.latent_mode_weight, [[0.8, 0.2], [0.0, 0.0]])
    np.testing.assert_array_equal(seen.latent_mode[0], [[0.0, 1.0], [-3.0, 5.0]])
    np.testing.assert_array_equal(seen.latent_mode[0, 0], seen.latent[0])
    check_table(seen, 1)
    first, second = mixed().to_records(0, "a.png")
    assert first["latent_modes"] == [{"weight": 0.8, "latent": [0.0, 1.0]}, {"weight": 0.2, "latent": [-3.0, 5.0]}]
    assert "latent_modes" not in second
    write_observations(tmp_path / "a.jsonl", seen)
    back = read_observations(tmp_path / "a.jsonl")
    np.testing.assert_array_equal(back.latent_mode_weight, seen.latent_mode_weight)
    np.testing.assert_array_equal(back.latent_mode, seen.latent_mode)
    sure = mixed()[[1]].detections(frame=1)
    assert sure.latent_mode_weight.shape == (1, 0) and sure.latent_mode.shape == (1, 0, 2)
    joined = Detections.concatenate([sure, seen, Detections.from_arrays([3], [[0, 0, 4.0]], id=["x"])])
    assert joined.latent_mode.shape == (4, 2, 2) and joined.latent_mode_weight.sum() == 1
    np.testing.assert_array_equal(joined.select(np.array([1])).latent_mode[0], seen.latent_mode[0])
