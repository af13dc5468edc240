"""Student's t in several dimensions: positions whose bulk is narrow and whose tails are heavy, as a network's are.

A Gaussian fitted to such errors holds at one level alone: fitted at 90 %, its 50 % region is too wide and its 99 % region too
narrow. Given normalised squared errors `s = e' C^-1 e` the law is `s / (c d) ~ F(d, nu)` for scale matrix `c C` and `nu` degrees
of freedom. As a mixture of Gaussians over scales, it weighs an error in least squares by `(nu + d) / (nu + s / c)`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Shaped
from scipy.optimize import minimize
from scipy.special import gammaln
from scipy.stats import f

from nolbo_ppl.errors import input_error

GAUSSIAN_DOF = 1e4
"""Degrees of freedom that stand for a Gaussian: the log density differs by less than 0.013 within five scales."""
DOF_LIMITS = (1.5, GAUSSIAN_DOF)
"""Least and largest degrees of freedom of a fit; with less than two the variance does not exist."""


@dataclass(frozen=True)
class StudentT:
    """Law of errors about Gaussian covariances that were stated for them."""

    dof: float
    """Degrees of freedom."""
    spread: float
    """Factor on the stated covariance: the scale matrix."""

    def mass(self, squared: Float[np.ndarray, " n"], dimensions: int) -> Float[np.ndarray, " n"]:
        """Mass of the region that reaches to each error, from its squared distance under the stated covariance."""
        return np.asarray(f.cdf(np.asarray(squared) / (self.spread * dimensions), dimensions, self.dof))

    def log_density(
        self, squared: Float[np.ndarray, " n"], log_determinant: Float[np.ndarray, " n"] | float, dimensions: int
    ) -> Float[np.ndarray, " n"]:
        """Log density of each error.

        Args:
            squared: squared distance under the stated covariance.
            log_determinant: `log |2 pi C|` of it.
            dimensions: of the error.
        """
        scaled = np.asarray(squared) / self.spread
        determinant = np.asarray(log_determinant) + dimensions * np.log(self.spread)
        return student_log_density(scaled, determinant, self.dof, dimensions)


def student_log_density(
    squared: Float[np.ndarray, " n"], log_determinant: Float[np.ndarray, " n"] | float, dof: float, dimensions: int = 3
) -> Float[np.ndarray, " n"]:
    """Log density of Student's t from squared distances under its scale matrix S and `log |2 pi S|`.

    Example:
        >>> bool(abs(student_log_density(np.array([0.0]), 0.0, 1e9)[0]) < 1e-5)  # the Gaussian's
        True
    """
    d = dimensions
    constant = gammaln((dof + d) / 2) - gammaln(dof / 2) - 0.5 * d * np.log(dof / 2)
    return np.asarray(constant - 0.5 * np.asarray(log_determinant) - 0.5 * (dof + d) * np.log1p(np.asarray(squared) / dof))


def student_weight(squared: Float[np.ndarray, " n"], dof: float, dimensions: int = 3) -> Float[np.ndarray, " n"]:
    """Weight of each error in least squares: the mean precision of the scale mixture given the error."""
    return np.asarray((dof + dimensions) / (dof + np.asarray(squared)))


def fit_student_t(squared: Float[np.ndarray, " n"], dimensions: int) -> StudentT:
    """Maximum likelihood of degrees of freedom and spread from squared distances under the stated covariances.

    Raises:
        InputError: fewer than ten errors, or one that is negative or not finite.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> squared = 3 * 0.5 * rng.f(3, 4.0, 5000)
        >>> found = fit_student_t(squared, 3)
        >>> 3.5 < found.dof < 4.5, 0.45 < found.spread < 0.55
        (True, True)
    """
    s = np.asarray(squared, dtype=np.float64)
    if len(s) < 10 or not np.isfinite(s).all() or (s < 0).any():
        raise input_error("squared errors to fit tails to", got=f"{len(s)}, beginning with {s[:3]}", expected="ten, 0 or more")

    def loss(x: np.ndarray) -> float:
        return -float(np.mean(StudentT(float(np.exp(x[1])), float(np.exp(x[0]))).log_density(s, 0.0, dimensions)))

    bounds = [(np.log(1e-4), np.log(1e4)), tuple(np.log(DOF_LIMITS))]
    starts = [np.log([max(float(np.median(s)) / dimensions, 2e-4), dof]) for dof in (3.0, 30.0)]
    best = min((minimize(loss, start, method="L-BFGS-B", bounds=bounds) for start in starts), key=lambda found: float(found.fun))
    return StudentT(float(np.exp(best.x[1])), float(np.exp(best.x[0])))


def supported_probability(stated: Float[np.ndarray, " n"], happened: Shaped[np.ndarray, " n"]) -> float:
    """The largest probability that held-out cases support: of those stated near one, `(k + 1) / (n + 2)` came true.

    The best over groups stated above several levels, each under a uniform prior: 400 cases without a mistake support 0.9975, no
    number of them supports certainty.

    Args:
        stated: probabilities.
        happened: whether each came true, as booleans or as 0 and 1.

    Raises:
        InputError: no case, or shapes that do not match.
    """
    p, y = np.asarray(stated, dtype=np.float64), np.asarray(happened, dtype=np.float64)
    if not len(p) or p.shape != y.shape:
        raise input_error("held-out probabilities", got=(p.shape, y.shape), expected="one outcome for each, at least one")
    levels = np.array([0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.998, 0.999])
    groups = [y[p >= level] for level in levels]
    return float(max((g.sum() + 1) / (len(g) + 2) for g in groups))
