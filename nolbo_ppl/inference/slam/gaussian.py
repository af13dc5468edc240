"""Batched three-dimensional Gaussians in closed form: LAPACK costs ten times as much on a million 3 x 3 systems."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from nolbo_ppl.metrics.heavy_tails import student_log_density

LOG_2PI = float(np.log(2.0 * np.pi))


def squared_distance(
    error: Float[np.ndarray, "... 3"], covariance: Float[np.ndarray, "... 3 3"]
) -> tuple[Float[np.ndarray, " ..."], Float[np.ndarray, " ..."]]:
    """Squared Mahalanobis distance and `log |2 pi S|` of symmetric positive definite S, by cofactors."""
    a, b, c = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 0, 2]
    d, e, f = covariance[..., 1, 1], covariance[..., 1, 2], covariance[..., 2, 2]
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    D, E, F = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = np.maximum(a * A + b * B + c * C, 1e-300)
    x, y, z = error[..., 0], error[..., 1], error[..., 2]
    square = (A * x * x + D * y * y + F * z * z + 2.0 * (B * x * y + C * x * z + E * y * z)) / determinant
    return np.maximum(square, 0.0), np.log(determinant) + 3.0 * LOG_2PI


def position_log_density(
    square: Float[np.ndarray, " n"], log_det: Float[np.ndarray, " n"], dof: float | None
) -> Float[np.ndarray, " n"]:
    """Log density of positions from squared distances and `log |2 pi S|`: Gaussian, or Student's t with `dof` degrees of freedom.

    S may hold more than the detection's own scale matrix (where the landmark is): a t with the same degrees of freedom stands
    for the sum, which is right where either of the two is small.
    """
    return -0.5 * (square + log_det) if dof is None else student_log_density(square, log_det, dof)


def log_normal(error: Float[np.ndarray, "... 3"], covariance: Float[np.ndarray, "... 3 3"]) -> Float[np.ndarray, " ..."]:
    """Log density of N(error; 0, S), per m^3."""
    square, log_det = squared_distance(error, covariance)
    return -0.5 * (square + log_det)


def upper_root(covariance: Float[np.ndarray, "k 3 3"]) -> Float[np.ndarray, "k 3 3"]:
    """Upper triangular roots `U U'` of matrices without negative eigenvalues.

    Of all roots the one that follows the views: its last column is along the ray wherever depth is shared, the others are the
    image's axes, so that one vector of numbers means one error in all of them.

    >>> upper_root(np.array([[[4.0, 0, 0], [0, 9, 0], [0, 0, 0]]]))[0].tolist()
    [[2.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 0.0]]
    """
    rest = np.array(covariance, dtype=np.float64)
    root = np.zeros_like(rest)
    for i in (2, 1, 0):
        own = np.sqrt(np.maximum(rest[:, i, i], 0.0))
        column = np.where(own[:, None] > 0, rest[:, :, i] / np.where(own > 0, own, 1.0)[:, None], 0.0)
        column[:, i + 1 :] = 0.0
        root[:, :, i] = column
        rest = rest - column[:, :, None] * column[:, None, :]
    return root
