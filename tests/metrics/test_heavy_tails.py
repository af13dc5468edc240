"""Student's t about stated covariances, and what held-out cases support."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import gamma, multivariate_t

from nolbo_ppl.errors import InputError
from nolbo_ppl.metrics.heavy_tails import (
    GAUSSIAN_DOF,
    StudentT,
    fit_student_t,
    student_log_density,
    student_weight,
    supported_probability,
)

C = np.array([[0.5, 0.1, 0.0], [0.1, 0.3, -0.05], [0.0, -0.05, 0.2]])


def squared(error: np.ndarray) -> np.ndarray:
    return np.asarray(np.einsum("ni,ij,nj->n", error, np.linalg.inv(C), error))


@pytest.mark.parametrize(("dof", "spread"), [(2.5, 1.0), (4.0, 0.3), (60.0, 2.0)])
def test_density_is_scipys(dof: float, spread: float) -> None:
    error = np.random.default_rng(0).standard_normal((50, 3))
    found = StudentT(dof, spread).log_density(squared(error), np.linalg.slogdet(2 * np.pi * C)[1], 3)
    np.testing.assert_allclose(found, multivariate_t(shape=spread * C, df=dof).logpdf(error), rtol=1e-10)


def test_many_degrees_of_freedom_are_a_gaussian() -> None:
    s = np.linspace(0, 25, 20)
    np.testing.assert_allclose(student_log_density(s, 1.7, GAUSSIAN_DOF), -0.5 * (s + 1.7), atol=0.013)
    np.testing.assert_allclose(student_log_density(s, 1.7, 1e8), -0.5 * (s + 1.7), atol=1e-5)


def test_mass_is_uniform_for_errors_of_the_law_and_wrong_for_others() -> None:
    law = StudentT(3.0, 0.4)
    error = multivariate_t(shape=0.4 * C, df=3.0).rvs(20000, random_state=1)
    mass = law.mass(squared(error), 3)
    for level in (0.5, 0.9, 0.99):
        assert abs((mass <= level).mean() - level) < 5 * np.sqrt(level * (1 - level) / 20000)
    gaussian = StudentT(GAUSSIAN_DOF, 1.0).mass(squared(error), 3)
    assert (gaussian <= 0.5).mean() > 0.6 and (gaussian <= 0.99).mean() < 0.97  # too wide inside, too narrow outside


@pytest.mark.parametrize(("dof", "spread"), [(2.5, 0.5), (8.0, 1.5)])
def test_fit_finds_the_law(dof: float, spread: float) -> None:
    error = multivariate_t(shape=spread * C, df=dof).rvs(6000, random_state=2)
    found = fit_student_t(squared(error), 3)
    assert found.dof == pytest.approx(dof, rel=0.2) and found.spread == pytest.approx(spread, rel=0.08)
    gaussian = fit_student_t(squared(np.random.default_rng(3).multivariate_normal(np.zeros(3), 2 * C, 4000)), 3)
    assert gaussian.dof > 40 and gaussian.spread == pytest.approx(2.0, rel=0.1)


def test_weight_is_the_mean_precision_of_the_mixture() -> None:
    """`e / scale ~ N(0, 1 / u)`, u gamma with shape and rate nu / 2: the posterior mean of u given the error, by quadrature."""
    dof, s = 3.0, 7.5

    def joint(u: float) -> float:
        return float(gamma(dof / 2, scale=2 / dof).pdf(u) * u**1.5 * np.exp(-0.5 * u * s))

    mean = quad(lambda u: u * joint(u), 0, np.inf)[0] / quad(joint, 0, np.inf)[0]
    assert student_weight(np.array([s]), dof)[0] == pytest.approx(mean, rel=1e-8)


def test_certainty_is_supported_by_no_number_of_cases() -> None:
    assert supported_probability(np.full(400, 0.9999), np.ones(400)) == pytest.approx(401 / 402)
    y = np.ones(1000)
    y[:20] = 0
    assert supported_probability(np.full(1000, 0.9999), y) == pytest.approx(981 / 1002)
    assert supported_probability(np.full(10, 0.2), np.zeros(10)) == 0.5  # nothing was stated above one half
    with pytest.raises(InputError, match="at least one"):
        supported_probability(np.zeros(0), np.zeros(0))
    with pytest.raises(InputError, match="ten"):
        fit_student_t(np.ones(5), 3)
