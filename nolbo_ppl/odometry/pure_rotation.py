"""The motion without parallax: a rotation alone, by weighted alignment of rays, and who contradicts it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from nolbo_ppl.geometry.pose import nearest_rotation
from nolbo_ppl.odometry.epipolar import GATE, MIN_SCALE, student_weights


def transfer_residual(
    R: Float[np.ndarray, "3 3"],
    first: Float[np.ndarray, "m 3"],
    second: Float[np.ndarray, "m 3"],
    intrinsics: Float[np.ndarray, " 4"],
) -> Float[np.ndarray, "m 2"]:
    """Corner of the earlier view less that of the later one turned into it, px."""
    turned = second @ R.T
    return (first[:, :2] - turned[:, :2] / np.where(np.abs(turned[:, 2:]) < 1e-9, 1e-9, turned[:, 2:])) * intrinsics[:2]


def align_rays(
    first: Float[np.ndarray, "m 3"], second: Float[np.ndarray, "m 3"], weight: Float[np.ndarray, " m"]
) -> Float[np.ndarray, "3 3"]:
    """Rotation R_earlier_later that best turns the later rays onto the earlier ones (Wahba's problem by SVD)."""
    a = first / np.linalg.norm(first, axis=1, keepdims=True)
    b = second / np.linalg.norm(second, axis=1, keepdims=True)
    return nearest_rotation((a * weight[:, None]).T @ b)


def rotation_only(
    first: Float[np.ndarray, "m 3"],
    second: Float[np.ndarray, "m 3"],
    intrinsics: Float[np.ndarray, " 4"],
    threshold: float,
    iterations: int = 10,
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"], float]:
    """Robust rotation between two views, its covariance (rad^2, later camera's axes), and the scale of its residuals, px."""
    weight = np.ones(len(first))
    R, scale = np.eye(3), threshold
    for _ in range(iterations):
        R = align_rays(first, second, weight)
        residual = np.linalg.norm(transfer_residual(R, first, second, intrinsics), axis=1)
        # The median of a Rayleigh variable is 1.1774 standard deviations of a coordinate.
        scale = max(float(np.median(residual)) / 1.1774, MIN_SCALE)
        weight = np.where(residual < GATE * scale, student_weights(residual, scale), 0.0)
    ray = second / np.linalg.norm(second, axis=1, keepdims=True)
    focal = float(np.sqrt(intrinsics[0] * intrinsics[1]))
    used = weight > 0
    information = (used.sum() * np.eye(3) - ray[used].T @ ray[used]) * (focal / scale) ** 2
    return R, np.linalg.inv(information + np.eye(3)), scale


def parallax_share(
    R: Float[np.ndarray, "3 3"],
    first: Float[np.ndarray, "m 3"],
    second: Float[np.ndarray, "m 3"],
    intrinsics: Float[np.ndarray, " 4"],
    scale: float,
) -> float:
    """Part of the matches that no rotation explains: residual beyond 3 standard deviations of both corners."""
    residual = np.linalg.norm(transfer_residual(R, first, second, intrinsics), axis=1)
    return float(np.mean(residual > 3.0 * np.sqrt(2.0) * max(scale, 0.2)))
