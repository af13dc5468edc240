"""Short-term tracks against Gaussian algebra and enumeration."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from nolbo_ppl.inference.slam import SlamConfig
from nolbo_ppl.inference.slam.detection_features import FeaturePrior
from nolbo_ppl.inference.slam.latent_population import LatentPopulation
from nolbo_ppl.inference.slam.tracking import Tracker
from tests.position_measurements import position_measurements

PRIOR = FeaturePrior(np.zeros(0), LatentPopulation.of_one(np.zeros(0), np.zeros(0)), (), np.zeros(0), 0.05)


def covariances(rng: np.random.Generator, n: int) -> np.ndarray:
    root = 0.1 * rng.standard_normal((n, 3, 3))
    return root @ np.swapaxes(root, 1, 2) + 0.02 * np.eye(3)


def test_a_track_is_the_posterior_of_a_walk() -> None:
    """Mean and covariance after n detections: those of the last place of a random walk, by one dense linear system."""
    rng = np.random.default_rng(0)
    n, step, turn = 6, 0.05, 0.01
    covariance = covariances(rng, n)
    position = np.array([1.0, 0.5, 6.0]) + 0.1 * rng.standard_normal((n, 3))
    tracker = Tracker(SlamConfig(), 0, PRIOR, birth_intensity=1e-3, clutter_intensity=1e-4)
    information, vector = np.zeros((3 * n, 3 * n)), np.zeros(3 * n)
    for t in range(n):
        own = slice(3 * t, 3 * t + 3)
        if t:
            distance = np.linalg.norm(tracker.mean[0])  # the camera stays at the origin
            drift = np.linalg.inv((step**2 + turn**2 * distance**2) * np.eye(3))
            tracker.predict(np.eye(4), t, turn, step)
            before = slice(3 * t - 3, 3 * t)
            information[own, own] += drift
            information[before, before] += drift
            information[own, before] -= drift
            information[before, own] -= drift
        assigned, _ = tracker.associate(position_measurements(position[[t]], covariance[[t]]), t)
        assert assigned.tolist() == [0]
        information[own, own] += np.linalg.inv(covariance[t])
        vector[own] += np.linalg.solve(covariance[t], position[t])
    joint = np.linalg.inv(information)
    np.testing.assert_allclose(tracker.mean[0], (joint @ vector)[-3:], rtol=1e-9)
    np.testing.assert_allclose(tracker.covariance[0], joint[-3:, -3:], rtol=1e-8, atol=1e-14)


def test_weights_of_a_frame_equal_enumeration() -> None:
    """Three detections near two tracks: all one-to-one associations, with densities of scipy."""
    rng = np.random.default_rng(1)
    birth, clutter, log_odds = 2e-2, 1e-2, 1.0
    place = np.array([[0.0, 0.0, 5.0], [0.4, 0.0, 5.0]])
    first = covariances(rng, 2)
    tracker = Tracker(SlamConfig(), 0, PRIOR, birth, clutter)
    assert tracker.associate(position_measurements(place, first), 0)[0].tolist() == [0, 1]
    tracker.predict(np.eye(4), 1, 0.0, 0.1)
    position = np.array([[0.1, 0.0, 5.1], [0.35, 0.1, 5.0], [0.2, 0.3, 4.9]])
    covariance = covariances(rng, 3)
    spread = first + 0.1**2 * np.eye(3)
    odds = np.array(
        [
            [np.exp(log_odds) * multivariate_normal.pdf(position[k], place[j], covariance[k] + spread[j]) for j in range(2)]
            for k in range(3)
        ]
    )
    none = np.exp(log_odds) * birth + clutter
    total, weight, null = 0.0, np.zeros((3, 2)), np.zeros(3)
    for choice in product((-1, 0, 1), repeat=3):
        used = [j for j in choice if j >= 0]
        if len(used) == len(set(used)):
            value = float(np.prod([none if j < 0 else odds[k, j] for k, j in enumerate(choice)]))
            total += value
            for k, j in enumerate(choice):
                if j < 0:
                    null[k] += value
                else:
                    weight[k, j] += value
    weight, null = weight / total, null / total
    assigned, stated = tracker.associate(position_measurements(position, covariance, log_odds), 1)
    best = np.where(weight.max(axis=1) > 0.5, weight.argmax(axis=1), -1)
    assert (best >= 0).sum() == 2  # two detections continue the tracks
    np.testing.assert_array_equal(assigned[best >= 0], best[best >= 0])
    np.testing.assert_allclose(stated, np.where(best >= 0, weight.max(axis=1), null), rtol=1e-9)


@pytest.mark.parametrize(("wait", "same"), [(3, True), (4, False)])
def test_a_track_ends_after_its_gap(wait: int, same: bool) -> None:
    tracker = Tracker(SlamConfig(track_gap=3), 0, PRIOR, 1e-3, 1e-4)
    place, covariance = np.array([[0.0, 0.0, 5.0]]), 0.01 * np.eye(3)[None]
    tracker.associate(position_measurements(place, covariance), 0)
    for frame in range(1, wait + 1):
        tracker.predict(np.eye(4), frame, 1e-3, 1e-2)
    assert tracker.associate(position_measurements(place, covariance), wait)[0].tolist() == [0 if same else 1]
    assert len(tracker.index) == 1 and tracker.total == (1 if same else 2)
