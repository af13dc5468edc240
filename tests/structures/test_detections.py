"""Tables of detections: nothing is lost on the way to a file and back, or when tables are stacked."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import quaternion_to_matrix, so3_exp
from nolbo_ppl.io.observations import read_observations, write_observations
from nolbo_ppl.structures.detection_records import rounded_quaternion, significant, to_records
from nolbo_ppl.structures.detections import ARRAYS, TEXTS, Detections, heaviest_mode


def random_detections(rng: np.random.Generator, n: int) -> Detections:
    """Every field, each missing in some rows."""
    root = rng.standard_normal((n, 3, 3))
    covariance = root @ np.swapaxes(root, 1, 2) + np.eye(3)
    scale = rng.random((n, 3)) + 0.1
    covariance = np.where(rng.random(n)[:, None, None] < 0.5, (covariance + np.swapaxes(covariance, 1, 2)) / 2, 0)
    covariance = np.where(covariance == 0, scale[:, :, None] ** 2 * np.eye(3), covariance)
    weight = rng.dirichlet([1.0, 1.0, 1.0], n)
    weight[:, 1] *= rng.random(n) < 0.5  # fewer modes
    weight /= weight.sum(axis=1, keepdims=True)
    some = rng.random(n) < 0.5
    mode_rotation = so3_exp(rng.standard_normal((n, 3, 3)) * 2)
    mode_std = rng.random((n, 3)) + 0.1
    rotation, rotation_scale = heaviest_mode(np.where(some[:, None], weight, 0.0), mode_rotation, mode_std)
    lone = ~some & (rng.random(n) < 0.5)
    rotation = np.where(lone[:, None, None], so3_exp(rng.standard_normal((n, 3))), rotation)

    def missing(values: np.ndarray) -> np.ndarray:
        gone = rng.random(n) < 0.3
        return np.where(gone.reshape(-1, *(1,) * (values.ndim - 1)), np.nan, values)

    def texts(kinds: list[str | None]) -> tuple[str | None, ...]:
        return tuple(kinds[k] for k in rng.integers(len(kinds), size=n))

    box = np.sort(rng.random((n, 2, 2)), axis=1).reshape(n, 4) * 600
    posterior = rng.dirichlet([1.0, 1.0], n)
    latent = missing(rng.standard_normal((n, 4)))
    latent[0] = 1.0
    share = np.where(rng.random(n) < 0.5, rng.random(n), 1.0)
    stated = np.isfinite(latent).all(axis=1) & (rng.random(n) < 0.7)
    latent_weight = np.where(stated[:, None], np.stack([share, 1 - share], axis=1), 0.0)
    return Detections(
        frame=rng.integers(0, 9, n),
        position=rng.standard_normal((n, 3)) * 10,
        position_covariance=missing(covariance),
        rotation=rotation,
        rotation_scale=rotation_scale,
        latent=latent,
        latent_scale=np.where(np.isnan(latent), np.nan, missing(rng.random((n, 4)) + 0.1)),
        objectness=rng.random(n),
        category=texts(["car", "bus", None]),
        size=missing(rng.random((n, 3)) + 0.5),
        symmetry=rng.integers(-1, 5, n),
        id=tuple(f"d{k}" for k in range(n)),
        mode_weight=np.where(some[:, None], weight, 0.0),
        mode_rotation=mode_rotation,
        mode_std=mode_std,
        image=texts(["a.png", 'b \u00e9".png', None]),
        time=missing(rng.random(n) * 1e9),
        box=missing(box),
        class_names=("car", "bus"),
        class_posterior=np.where(rng.random((n, 2)) < 0.3, np.nan, posterior),
        viewpoint=missing(rng.standard_normal((n, 3))),
        azimuth_weight=weight,
        azimuth=rng.standard_normal((n, 3)),
        azimuth_concentration=rng.random((n, 3)) * 100,
        latent_mode_weight=latent_weight,
        latent_mode=np.where(latent_weight[..., None] > 0, rng.standard_normal((n, 2, 4)), 0.0),
    )


@pytest.mark.parametrize("seed", range(20))
def test_what_was_read_is_written_as_the_same_file(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    given = random_detections(rng, int(rng.integers(1, 12)))
    first, again = tmp_path / "first.jsonl", tmp_path / "again.jsonl"
    write_observations(first, given)
    read = read_observations(first, frames=9)
    write_observations(again, read)
    assert again.read_bytes() == first.read_bytes()
    twice = read_observations(again)
    for name in ARRAYS:  # and to read it is to have the same table, to the last bit
        np.testing.assert_array_equal(getattr(twice, name), getattr(read, name), err_msg=name)
    for name in (*TEXTS, "class_names"):
        assert getattr(twice, name) == getattr(read, name)
    rounded = {"mode_weight", "mode_rotation", "mode_std", "rotation", "class_posterior"}
    for name in set(ARRAYS) - rounded:  # all other numbers keep all their digits
        wanted = getattr(given, name)
        wanted = wanted[:, : read.latent_mode_weight.shape[1]] if name == "latent_mode" else wanted
        np.testing.assert_array_equal(getattr(read, name), wanted[..., : getattr(read, name).shape[-1]], err_msg=name)
    column = [given.class_names.index(name) for name in read.class_names]
    np.testing.assert_array_equal(read.class_posterior, given.class_posterior[:, column])
    np.testing.assert_allclose(read.rotation, given.rotation, atol=5e-8)
    np.testing.assert_allclose(np.sort(read.mode_weight.sum(1)), np.sort(given.mode_weight.sum(1)), atol=1e-12)


def test_quaternions_of_files_stay_what_they_are() -> None:
    """Half turns included, where q and -q are told apart by nothing but rounding."""
    rng = np.random.default_rng(0)
    axes = rng.standard_normal((2000, 3))
    axes[:3] = np.eye(3)
    angle = np.where(np.arange(2000) % 4 == 0, np.pi, rng.uniform(-np.pi, np.pi, 2000))
    R = so3_exp(axes / np.linalg.norm(axes, axis=1, keepdims=True) * angle[:, None])
    once = rounded_quaternion(R)
    np.testing.assert_array_equal(rounded_quaternion(quaternion_to_matrix(once)), once)
    np.testing.assert_allclose(quaternion_to_matrix(once), R, atol=5e-8)
    assert (once[:, 3] >= 0).all()


def test_significant_digits() -> None:
    np.testing.assert_array_equal(significant(np.array([[123.456789012, -0.000123456789], [0.0, 5e9]])),
                                  [[123.4568, -0.0001234568], [0.0, 5e9]])  # fmt: skip
    values = np.random.default_rng(1).standard_normal(100)
    np.testing.assert_array_equal(significant(significant(values)), significant(values))
    np.testing.assert_allclose(significant(values, 10), values, rtol=5e-10)


def test_stacking_makes_room_for_what_others_lack() -> None:
    rng = np.random.default_rng(3)
    rich = random_detections(rng, 4)
    other = dataclasses.replace(rich, class_names=("bus", "tram"), id=tuple("wxyz"))
    bare = Detections.from_arrays([1, 2], np.ones((2, 3)), id=["p", "q"])
    joined = Detections.concatenate([bare, rich, other])
    assert len(joined) == 10 and joined.class_names == ("car", "bus", "tram") and joined.latent_dim == 4
    assert np.isnan(joined.latent[:2]).all() and np.isnan(joined.class_posterior[:2]).all()
    np.testing.assert_array_equal(joined.class_posterior[2:6, :2], rich.class_posterior)
    np.testing.assert_array_equal(joined.class_posterior[6:, 1:], rich.class_posterior)
    assert np.isnan(joined.class_posterior[6:, 0]).all()
    np.testing.assert_array_equal(joined.mode_weight[:2], 0)
    np.testing.assert_array_equal(joined.mode_rotation[:2], np.tile(np.eye(3), (2, 3, 1, 1)))
    back = joined.select(np.arange(10) // 4 == 1)  # rows 4 to 7
    assert back.id == ("d2", "d3", "w", "x")
    with pytest.raises(InputError, match="latents of different lengths"):
        Detections.concatenate([rich, Detections.from_arrays([0], [[0, 0, 1.0]], latent=[[1.0]])])
    with pytest.raises(InputError, match="at least one"):
        Detections.concatenate([])


def test_a_record_leaves_out_what_is_missing() -> None:
    table = Detections.from_arrays([3], [[1.0, 2.0, 4.0]], position_scale=0.1, time=[2.5], box=[[1, 2, 3, 4]])
    assert list(to_records(table)) == [
        {
            "frame": 3,
            "time": 2.5,
            "id": "0",
            "box": [1.0, 2.0, 3.0, 4.0],
            "objectness": 1.0,
            "position": [1.0, 2.0, 4.0],
            "position_std": [0.1, 0.1, 0.1],
        }
    ]
