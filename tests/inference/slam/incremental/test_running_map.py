"""What the running map adds up: marginal likelihoods, fused features, merged landmarks."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from nolbo_ppl.inference.slam.detection_features import FeaturePrior
from nolbo_ppl.inference.slam.incremental import running_map
from nolbo_ppl.inference.slam.incremental.running_map import (
    RIGHT_TRACK,
    RunningLandmark,
    RunningMap,
    count_detections,
    new_landmark,
    variance_between_views,
)
from nolbo_ppl.inference.slam.latent_population import LatentPopulation
from nolbo_ppl.inference.slam.measurements import Measurements
from nolbo_ppl.inference.slam.orientation import OrientationModes
from nolbo_ppl.structures.noise_model import NoiseModel

PRIOR = FeaturePrior(np.zeros(3), LatentPopulation.of_one(np.zeros(3), np.ones(3)), ("car", "chair"), np.log([0.5, 0.5]), 0.05)
NOISE = NoiseModel(
    rotation_step=np.zeros(0),
    translation_step=np.zeros(0),
    position_covariance=0.01 * np.eye(3)[None],
    rotation_scale=np.zeros(1),
    latent_scale=np.zeros((1, 3)),
    birth_intensity=0.02,
    clutter_intensity=0.005,
    report={},
)


def test_evidence_is_the_marginal_likelihood_of_the_detections(monkeypatch: pytest.MonkeyPatch) -> None:
    """Chain of predictions against one density: without the place, differences to the first detection are Gaussian."""
    monkeypatch.setattr(running_map, "RIGHT_TRACK", 1 - 1e-15)
    monkeypatch.setattr(running_map, "link_scale", lambda noise: 0.0)
    rng = np.random.default_rng(0)
    n, place = 5, np.array([2.0, 0.3, 7.0])
    root = 0.2 * rng.standard_normal((n, 3, 3))
    covariance = root @ np.swapaxes(root, 1, 2) + 0.01 * np.eye(3)  # in camera frames
    R = Rotation.random(n, random_state=1).as_matrix()  # of cameras at the origin
    in_world = R @ covariance @ np.swapaxes(R, 1, 2)
    world = place + np.array([rng.multivariate_normal(np.zeros(3), S) for S in in_world])
    score = rng.normal(1.0, 0.5, n)
    landmark = new_landmark(0, 0, 0, PRIOR, 1)
    for k in range(n):
        information = sum((np.linalg.inv(S) for S in in_world[:k]), np.zeros((3, 3)))
        mean = (
            np.linalg.solve(information, sum(np.linalg.solve(S, x) for S, x in zip(in_world[:k], world[:k]))) if k else world[0]
        )
        error = R[k].T @ (mean - world[k])
        count_detections([landmark], error[None], R[k], covariance[[k]], score[[k]], NOISE)
    joint = np.kron(np.ones((n - 1, n - 1)), in_world[0])
    for k in range(1, n):
        joint[3 * k - 3 : 3 * k, 3 * k - 3 : 3 * k] += in_world[k]
    differences = (world[1:] - world[0]).ravel()
    expected = multivariate_normal.logpdf(differences, np.zeros(3 * n - 3), joint)
    expected += np.log(NOISE.birth_intensity) + score.sum() - n * np.log(NOISE.clutter_intensity)
    assert landmark.log_odds == pytest.approx(expected, abs=1e-9)
    np.testing.assert_allclose(landmark.information, np.linalg.inv(in_world).sum(axis=0), rtol=1e-9)


def test_a_stray_detection_costs_no_more_than_a_wrong_track() -> None:
    landmark = new_landmark(0, 0, 0, PRIOR, 1)
    for error in (0.0, 1e3):
        before = landmark.log_odds
        count_detections([landmark], np.full((1, 3), error), np.eye(3), 0.01 * np.eye(3)[None], np.array([2.0]), NOISE)
    assert landmark.log_odds - before == pytest.approx(np.log(1 - RIGHT_TRACK))


def observed(rng: np.random.Generator, n: int) -> tuple[Measurements, np.ndarray]:
    """Detections of one object, some without latent or size."""
    variance = rng.uniform(0.1, 2.0, (n, 3))
    variance[::3] = 1e12  # no latent
    size = rng.uniform(0.5, 2.0, (n, 3))
    size[1::4] = np.nan
    return Measurements(
        frame=np.arange(n),
        position=rng.standard_normal((n, 3)),
        covariance=np.tile(0.01 * np.eye(3), (n, 1, 1)),
        shared_root=np.zeros((n, 3, 3)),
        oriented=rng.random(n) < 0.3,
        modes=OrientationModes(np.zeros((n, 1)), np.tile(np.eye(3), (n, 1, 1, 1)), np.ones((n, 1))),
        symmetry=np.ones(n, np.int64),
        latent=rng.standard_normal((n, 3)),
        latent_variance=variance,
        category=rng.integers(-1, 2, n),
        log_object=np.zeros(n),
        log_clutter=np.zeros(n),
    ), size


def gathered(measurements: Measurements, size: np.ndarray, rows: range, number: int) -> RunningLandmark:
    landmark = new_landmark(number, 0, rows.start, PRIOR, 1)
    for k in rows:
        landmark.add(k, measurements, k, size[k])
    return landmark


def test_two_halves_are_the_whole() -> None:
    measurements, size = observed(np.random.default_rng(3), 24)
    first, second = gathered(measurements, size, range(10), 0), gathered(measurements, size, range(10, 24), 1)
    whole = gathered(measurements, size, range(24), 2)
    running = RunningMap(PRIOR)
    running.add(first, np.zeros(3))
    running.add(second, np.array([0.1, 0.0, 0.0]))
    running.add(gathered(measurements, size, range(3), 5), np.array([9.0, 0.0, 0.0]))
    running.merge(1, 0)
    joined = running.landmarks[running.standing(1)]
    assert joined is first and len(running) == 2 and running.near(np.zeros(3), 1.0) == [0]
    for name in ("views", "latent_views", "sizes", "oriented", "first", "last", "category"):
        assert getattr(joined, name) == getattr(whole, name), name
    assert list(joined.frames) == list(whole.frames) and joined.passes == 2
    np.testing.assert_allclose(joined.votes, whole.votes)
    np.testing.assert_allclose(joined.size, whole.size)
    seen = measurements.latent_variance[:, 0] < 1e6
    precision = 1.0 / measurements.latent_variance[seen]
    mean = (precision * measurements.latent[seen]).sum(axis=0) / precision.sum(axis=0)
    np.testing.assert_allclose(joined.latent, mean, rtol=1e-5)  # the prior's variance is wide, not infinite
    correlated = variance_between_views([joined], 0.2)[0]
    np.testing.assert_allclose(correlated, (1 + 0.2 * (seen.sum() - 1)) / precision.sum(axis=0), rtol=1e-5)


def test_numbers_lead_to_what_stands() -> None:
    measurements, size = observed(np.random.default_rng(4), 8)
    running = RunningMap(PRIOR)
    for j in range(4):
        running.add(gathered(measurements, size, range(2 * j, 2 * j + 2), j), np.array([float(j), 0.0, 0.0]))
    running.merge(3, 2)
    running.merge(2, 1)
    assert [running.standing(j) for j in range(4)] == [0, 1, 1, 1]
    assert running.landmarks[1].views == 6 and running.numbers.tolist() == [0, 1]
    running.forget({0})
    assert running.numbers.tolist() == [1] and running.near(np.zeros(3), np.array([5.0])) == [1]
