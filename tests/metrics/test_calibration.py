import math

import numpy as np
import pytest
from scipy.special import i0
from scipy.stats import chi2, multivariate_normal, vonmises

from nolbo_ppl.errors import InputError
from nolbo_ppl.metrics.calibration import (
    angular_distance,
    chi_square_mass,
    circular_crps,
    coverage,
    expected_calibration_error,
    reliability,
    top_label,
)


def naive_ece(confidence, outcome, bins):
    total = 0.0
    for k in range(bins):
        low, high = k / bins, (k + 1) / bins
        rows = [i for i, c in enumerate(confidence) if low <= c < high or (k == bins - 1 and c == 1)]
        if rows:
            total += len(rows) / len(confidence) * abs(np.mean(outcome[rows]) - np.mean(confidence[rows]))
    return total


def test_ece_against_a_loop():
    rng = np.random.default_rng(0)
    confidence = np.append(rng.random(400), [0.0, 1.0, 1.0])
    outcome = rng.random(403) < confidence**2
    for bins in (1, 10, 15):
        got = expected_calibration_error(confidence, outcome, bins=bins)[0]
        assert got == pytest.approx(naive_ece(confidence, outcome, bins), abs=1e-12)


def test_ece_hand_computed():
    confidence = np.array([0.95, 0.95, 0.95, 0.95, 0.55, 0.55])
    outcome = np.array([1, 1, 1, 0, 1, 0], dtype=bool)
    assert expected_calibration_error(confidence, outcome, bins=10)[0] == pytest.approx(4 / 6 * 0.2 + 2 / 6 * 0.05)


def test_ece_of_a_calibrated_forecast_falls_to_zero():
    rng = np.random.default_rng(1)
    confidence = rng.random(200_000)
    outcome = rng.random(200_000) < confidence
    # Expectation of a mean of |N(0, p(1-p)/n)| over 15 bins: 15 * 0.8 * 0.41 / sqrt(15 n) is about 3e-3.
    assert expected_calibration_error(confidence, outcome)[0] < 6e-3


def test_ece_weights_equal_repetition():
    rng = np.random.default_rng(2)
    confidence, outcome = rng.random(50), rng.random(50) < 0.5
    weight = rng.integers(0, 4, (3, 50))
    got = expected_calibration_error(confidence, outcome, weight.astype(float))
    for row, value in zip(weight, got):
        repeated = expected_calibration_error(np.repeat(confidence, row), np.repeat(outcome, row))[0]
        assert value == pytest.approx(repeated, abs=1e-12)


def test_reliability_reproduces_the_error():
    rng = np.random.default_rng(3)
    confidence = rng.random(300) * 0.6  # empty bins at the end
    outcome = rng.random(300) < confidence
    diagram = reliability(confidence, outcome, bins=10)
    used = diagram.count > 0
    assert diagram.count.sum() == 300 and not used[6:].any() and np.isnan(diagram.frequency[6:]).all()
    gap = np.abs(diagram.frequency - diagram.confidence)[used] @ diagram.count[used] / 300
    assert gap == pytest.approx(expected_calibration_error(confidence, outcome, bins=10)[0], abs=1e-12)


def test_top_label():
    posterior = np.array([[0.2, 0.7, 0.1], [0.5, 0.3, 0.2]])
    confidence, right = top_label(posterior, np.array([1, 2]))
    np.testing.assert_array_equal(confidence, [0.7, 0.5])
    np.testing.assert_array_equal(right, [True, False])


def test_chi_square_mass_against_scipy():
    rng = np.random.default_rng(4)
    factor = rng.normal(size=(20, 3, 3))
    covariance = factor @ factor.transpose(0, 2, 1) + 0.1 * np.eye(3)
    difference = rng.normal(size=(20, 3))
    distance = [d @ np.linalg.inv(c) @ d for d, c in zip(difference, covariance)]
    np.testing.assert_allclose(chi_square_mass(difference, covariance), chi2.cdf(distance, 3), atol=1e-12)
    diagonal = np.einsum("nii->ni", covariance)
    expected = chi_square_mass(difference, diagonal[:, :, None] * np.eye(3))
    np.testing.assert_allclose(chi_square_mass(difference, diagonal), expected, atol=1e-12)


def test_coverage_of_exact_posteriors_is_nominal():
    rng = np.random.default_rng(5)
    covariance = np.array([[2.0, 0.5, 0.0], [0.5, 1.0, 0.3], [0.0, 0.3, 0.2]])
    draws = multivariate_normal(np.zeros(3), covariance).rvs(20_000, random_state=rng)
    mass = chi_square_mass(draws, np.broadcast_to(covariance, (20_000, 3, 3)))
    for level in (0.5, 0.9):
        assert coverage(mass, level) == pytest.approx(level, abs=5 * math.sqrt(level * (1 - level) / 20_000))
    # Scales half the truth cover as the closed form says, so the figure can fail.
    narrow = chi_square_mass(draws, np.broadcast_to(covariance / 4, (20_000, 3, 3)))
    expected = chi2.cdf(chi2.ppf(0.9, 3) / 4, 3)
    assert coverage(narrow) == pytest.approx(expected, abs=5 * math.sqrt(expected * (1 - expected) / 20_000))


def test_crps_of_a_point_is_the_distance():
    nodes = 360
    log_density = np.full((2, nodes), -np.inf)
    log_density[0, 180] = 0.0  # angle 0
    log_density[1, 0] = 0.0  # angle -pi
    np.testing.assert_allclose(circular_crps(log_density, np.array([1.2, 3.0])), [1.2, math.pi - 3.0], atol=1e-12)


def test_crps_of_the_uniform_is_a_quarter_of_pi():
    # E a(V, v) = pi / 2 for any v, E a(V, V') / 2 = pi / 4.
    np.testing.assert_allclose(circular_crps(np.zeros((3, 256)), np.array([0.0, 1.0, -3.0])), math.pi / 4, atol=1e-4)


def test_crps_against_samples():
    rng = np.random.default_rng(6)
    kappa, mean, truth, n = 3.0, 0.7, -0.4, 200_000
    grid = -math.pi + 2 * math.pi * np.arange(720) / 720
    log_density = kappa * np.cos(grid - mean) - math.log(2 * math.pi * i0(kappa))
    a, b = (vonmises(kappa, loc=mean).rvs(n, random_state=rng) for _ in range(2))
    per_sample = angular_distance(a, np.full(n, truth)) - angular_distance(a, b) / 2
    got = circular_crps(log_density[None], np.array([truth]))[0]
    assert got == pytest.approx(per_sample.mean(), abs=5 * per_sample.std() / math.sqrt(n))


def test_crps_is_proper():
    # Over truths of the density itself no other concentration scores better.
    rng = np.random.default_rng(7)
    truth = vonmises(4.0).rvs(4000, random_state=rng)
    grid = -math.pi + 2 * math.pi * np.arange(360) / 360

    def mean_score(kappa):
        return circular_crps(np.tile(kappa * np.cos(grid), (4000, 1)), truth).mean()

    assert mean_score(4.0) < min(mean_score(0.5), mean_score(1.5), mean_score(12.0), mean_score(60.0))


def test_errors():
    with pytest.raises(InputError, match=r"confidence.*1\.2.*\[0, 1\]"):
        expected_calibration_error(np.array([1.2]), np.array([True]))
    with pytest.raises(InputError, match=r"confidences.*one outcome for each"):
        reliability(np.array([0.5]), np.array([True, False]))
    with pytest.raises(InputError, match="bins of a calibration error"):
        reliability(np.array([0.5]), np.array([True]), bins=0)
    with pytest.raises(InputError, match=r"masses of posterior regions.*at least one"):
        coverage(np.empty(0))
    with pytest.raises(InputError, match="masses of posterior regions"):
        coverage(np.array([0.5, np.nan]))
    with pytest.raises(InputError, match=r"level of a region.*1.5"):
        coverage(np.array([0.5]), 1.5)
    with pytest.raises(InputError, match="not positive definite"):
        chi_square_mass(np.zeros((1, 2)), np.array([[[1.0, 2.0], [2.0, 1.0]]]))
    with pytest.raises(InputError, match=r"variance.*-1\.0"):
        chi_square_mass(np.zeros((1, 2)), np.array([[1.0, -1.0]]))
    with pytest.raises(InputError, match=r"covariance.*\(1, 2, 2\) or \(1, 2\)"):
        chi_square_mass(np.zeros((1, 2)), np.ones((1, 3)))
    with pytest.raises(InputError, match="densities on the circle"):
        circular_crps(np.zeros((2, 4)), np.zeros(2))
