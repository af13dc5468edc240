"""Two maps, no common frame: constellations find the place they share, or that there is none."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from nolbo_ppl.geometry.pose import inverse, relative, se3_exp, se3_log, transform
from nolbo_ppl.inference.slam import SlamConfig
from nolbo_ppl.inference.slam.common_place import (
    MapPoints,
    extents,
    find_common_place,
    fit_motion,
    fits_together,
    place_log_odds,
)

FLOOR = 0.05
T_A_B = se3_exp(np.array([0.1, 2.0, -0.2, 15.0, -1.0, 30.0]))


def town(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.uniform([-30.0, -1.0, -30.0], [30.0, 1.0, 30.0], (count, 3))


def seen_map(rng: np.random.Generator, points: np.ndarray, drift: float = 0.3, own: float = 0.1) -> MapPoints:
    """A map of these points with an error that grows along x, shared by neighbours, and one of each landmark's own."""
    along = drift / 30.0 * points[:, 0]
    error = along[:, None] * rng.standard_normal(3) + own * rng.standard_normal(points.shape)
    between = np.outer(along, along) + own**2 * np.eye(len(points))
    return MapPoints(points + error, np.einsum("mn,ij->minj", between, np.eye(3)), points, 15.0)


def features(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Four categories told apart."""
    return np.where(a[:, None] % 4 == b[None] % 4, np.log(4.0), -10.0)


def two_maps(seed: int, common: int, other: int) -> tuple[MapPoints, MapPoints, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    world = town(rng, 15)
    here = np.arange(15)
    there = np.concatenate([here[:common], 100 + np.arange(other)])
    points = np.concatenate([world[:common], town(rng, other)])
    return seen_map(rng, world), seen_map(rng, transform(inverse(T_A_B), points)), here, there


@pytest.mark.parametrize("seed", range(3))
def test_place_and_partners_are_found(seed: int) -> None:
    first, second, here, there = two_maps(seed, common=9, other=5)
    place = find_common_place(first, second, features(here, there), SlamConfig(), FLOOR)
    assert place is not None
    error = se3_log(relative(place.T_a_b, T_A_B))
    assert error @ np.linalg.solve(place.covariance, error) < chi2.ppf(0.9999, 6)
    assert (here[place.a] == there[place.b]).mean() == 1.0 and len(place.a) >= 7
    assert place.log_odds >= place.margin >= 4.0


@pytest.mark.parametrize("seed", range(6))
def test_towns_that_share_nothing_have_no_common_place(seed: int) -> None:
    first, second, here, there = two_maps(seed, common=0, other=15)
    assert find_common_place(first, second, features(here, there), SlamConfig(), FLOOR) is None


def test_a_row_of_equal_posts_fits_itself_in_two_ways_and_says_so() -> None:
    rng = np.random.default_rng(0)
    row = np.stack([5.0 * np.arange(10), np.zeros(10), np.zeros(10)], axis=1) + np.array([0.0, 0.5, 10.0])
    first, second = seen_map(rng, row, drift=0.0), seen_map(rng, transform(inverse(T_A_B), row), drift=0.0)
    assert find_common_place(first, second, np.zeros((10, 10)), SlamConfig(), FLOOR) is None
    empty = MapPoints(np.zeros((0, 3)), np.zeros((0, 3, 0, 3)), row, 10.0)
    assert find_common_place(first, empty, np.zeros((10, 0)), SlamConfig(), FLOOR) is None


def test_what_has_moved_is_no_partner() -> None:
    rng = np.random.default_rng(4)
    world = town(rng, 12)
    moved = world.copy()
    moved[3] += [1.5, 0.0, -1.5]
    first, second = seen_map(rng, world), seen_map(rng, transform(inverse(T_A_B), moved))
    same = np.where(np.eye(12, dtype=bool), 3.0, -10.0)
    place = find_common_place(first, second, same, SlamConfig(), FLOOR)
    assert place is not None and 3 not in place.a and len(place.a) >= 9


def test_stated_covariance_is_that_of_the_motion_over_many_maps() -> None:
    rng = np.random.default_rng(1)
    world, square = town(rng, 10), []
    index = np.arange(10)
    for _ in range(200):
        first, second = seen_map(rng, world), seen_map(rng, transform(inverse(T_A_B), world))
        fit = fit_motion(first, second, index, index, 1e-3)
        error = se3_log(relative(fit.T_a_b, T_A_B))
        square.append(error @ np.linalg.solve(fit.covariance, error))
    assert abs(np.mean(square) / 6 - 1) < 5 * np.sqrt(2 / (6 * 200))  # the mean of chi-square, 6 degrees of freedom


def test_distances_that_agree_fit_and_no_landmark_is_used_twice() -> None:
    first, second, here, _ = two_maps(2, common=15, other=0)
    i, j = np.append(here, 0), np.append(here, 1)
    together = fits_together(first, second, i, j, FLOOR)
    assert together[np.ix_(here, here)][~np.eye(15, dtype=bool)].mean() > 0.97
    assert not together[15, 0] and not together[15, 1] and (together == together.T).all()


def test_evidence_is_the_integral_over_motions() -> None:
    """Importance sampling of `int p(T) N(...) dT` about the fit, by the uniform densities themselves."""
    rng = np.random.default_rng(3)
    world = town(rng, 5)
    first = seen_map(rng, world, drift=0.0, own=0.4)
    second = seen_map(rng, transform(inverse(T_A_B), world), drift=0.0, own=0.4)
    index = np.arange(5)
    fit = fit_motion(first, second, index, index, FLOOR)
    value = place_log_odds(first, second, fit, np.zeros(5), index, FLOOR)
    variance = 2 * 0.4**2 + 2 * FLOOR**2
    moved = transform(fit.T_a_b, second.position)
    centre = moved.mean(axis=0)
    L = np.linalg.cholesky(1.5 * np.linalg.inv(fit.information))
    noise = rng.standard_normal((20000, 6))
    delta = noise @ L.T
    log_proposal = -0.5 * np.sum(noise**2, axis=1) - 3 * np.log(2 * np.pi) - np.log(np.diag(L)).sum()
    turned = transform(se3_exp(delta), moved[:, None] - centre).swapaxes(0, 1) + centre
    square = np.sum((first.position - turned) ** 2, axis=(1, 2)) / variance
    log_weight = -0.5 * square - 7.5 * np.log(2 * np.pi * variance) - log_proposal
    integral = np.logaddexp.reduce(log_weight) - np.log(len(log_weight))
    sides_a, sides_b = extents(first.position, FLOOR), extents(second.position, FLOOR)
    prior = -np.log(8 * np.pi**2) - np.log(sides_a + sides_b).sum()
    objects = 5 * (np.log(0.5) - np.log(5.0) + np.log(sides_b).sum())
    assert value == pytest.approx(integral + prior + objects, abs=0.1)
