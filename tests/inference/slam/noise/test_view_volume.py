"""The space that detections come from, against bodies of known volume."""

import numpy as np
import pytest

from nolbo_ppl.inference.slam.noise.view_volume import FLAT_WORLD, MIN_REACH, view_volume, widening
from nolbo_ppl.structures.detections import Detections


def ball(count: int, seed: int) -> np.ndarray:
    """Points uniform in the unit ball."""
    rng = np.random.default_rng(seed)
    direction = rng.standard_normal((count, 3))
    return direction / np.linalg.norm(direction, axis=1, keepdims=True) * rng.random((count, 1)) ** (1 / 3)


def detections(position: np.ndarray) -> Detections:
    return Detections.from_arrays(np.zeros(len(position), dtype=int), position)


def test_volume_of_an_ellipsoid() -> None:
    half = np.array([6.0, 3.0, 5.0])
    volumes = np.array([view_volume(detections(half * ball(2000, seed) + [0.0, 0.0, 8.0])) for seed in range(30)])
    error = volumes.std(ddof=1) / np.sqrt(len(volumes))
    assert abs(volumes.mean() - 4 / 3 * np.pi * half.prod()) < 5 * error


def test_a_flat_world_is_as_thick_as_a_part_of_its_extent() -> None:
    half = np.array([6.0, 0.0, 6.0])
    volume = view_volume(detections(half * ball(4000, 1) + [0.0, 0.0, 8.0]))
    assert volume == pytest.approx(4 / 3 * np.pi * 6.0 * (6.0 * FLAT_WORLD) * 6.0, rel=0.05)


def test_detections_at_one_place_come_from_no_less_than_a_part_of_their_range() -> None:
    near = np.array([0.0, 0.0, 8.0]) + np.random.default_rng(0).normal(0, 0.1, (500, 3))
    largest = np.sqrt(np.linalg.eigvalsh(np.cov(near.T))[-1])
    assert widening(near) * largest == pytest.approx(MIN_REACH * np.linalg.norm(near, axis=1).mean())
    assert widening(10.0 * ball(500, 2)) == 1.0  # seen all around: nothing to widen
    assert widening(near[:1]) == 1.0
