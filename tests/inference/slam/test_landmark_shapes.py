"""Decoding landmarks: voxel mean and variance against the decoder called sample by sample."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.inference.slam.landmark_shapes import decode_landmarks, write_voxels
from nolbo_ppl.inference.slam.slam_result import Landmark
from tests.factories import tiny_model


def landmark(index: int, latent: np.ndarray | None, scale: float = 0.5) -> Landmark:
    variance = None if latent is None else np.full(len(latent), scale**2)
    return Landmark(f"L{index}", np.eye(4), np.eye(6), np.eye(3), False, 1.0, {}, latent, variance, None, 3.0, 0, 2)


@pytest.fixture(scope="module")
def model() -> ObservationModel:
    return ObservationModel(tiny_model())


def test_moments_of_the_decoded_samples(model: ObservationModel) -> None:
    latent = np.array([0.3, -1.0, 0.5, 2.0])
    found = decode_landmarks([landmark(3, latent), landmark(5, None)], model, samples=6, seed=4)
    assert list(found) == ["L3"]
    draws = np.random.default_rng(4).standard_normal((6, 4))
    single = [model.decode((latent + 0.5 * draw)[None])[0] for draw in draws]
    mean = sum(single) / 6
    np.testing.assert_allclose(found["L3"][0], mean, atol=1e-12)
    np.testing.assert_allclose(found["L3"][1], sum((x - mean) ** 2 for x in single) / 5, atol=1e-12)
    assert found["L3"][1].max() > 0


def test_a_certain_latent_has_no_variance_and_company_changes_nothing(model: ObservationModel) -> None:
    a, b = landmark(0, np.ones(4)), landmark(1, np.zeros(4), scale=1e-9)
    both = decode_landmarks([a, b], model)
    np.testing.assert_array_equal(both["L0"][0], decode_landmarks([a], model)["L0"][0])
    assert both["L1"][1].max() < 1e-15
    np.testing.assert_allclose(both["L1"][0], model.decode(np.zeros((1, 4)))[0], atol=1e-8)


def test_file_holds_half_precision_by_name(model: ObservationModel, tmp_path: Path) -> None:
    found = decode_landmarks([landmark(7, np.ones(4))], model)
    write_voxels(tmp_path / "landmarks_voxels.npz", found)
    with np.load(tmp_path / "landmarks_voxels.npz", allow_pickle=False) as file:
        assert sorted(file.files) == ["L7/mean", "L7/variance"]
        for part, values in zip(("mean", "variance"), found["L7"]):
            assert file[f"L7/{part}"].dtype == np.float16
            np.testing.assert_allclose(file[f"L7/{part}"], values, rtol=1e-3, atol=1e-7)


def test_misfits_are_refused(model: ObservationModel) -> None:
    with pytest.raises(InputError, match=r"got \(8, 3\).*expected \(n, 4\)"):
        decode_landmarks([landmark(0, np.ones(3))], model)
    with pytest.raises(InputError, match="at least 2"):
        decode_landmarks([landmark(0, np.ones(4))], model, samples=1)
