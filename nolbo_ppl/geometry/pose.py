"""Rigid motions in numpy, batched: SO(3) and SE(3) maps, quaternions, composition. Poses are 4 x 4, `T_world_body`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

R_WORLD_UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""R_world_object of an object that stands upright: its z is up, the world's y points down (x -> x, z -> -y, so y -> z)."""


def skew(vector: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3 3"]:
    """Matrix of the cross product, `skew(a) @ b = a x b`."""
    x, y, z = np.moveaxis(np.asarray(vector, dtype=np.float64), -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)


def so3_exp(vector: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3 3"]:
    """Rotation matrix of a rotation vector in rad (Rodrigues)."""
    vector = np.asarray(vector, dtype=np.float64)
    square = np.sum(vector**2, axis=-1)
    angle = np.sqrt(square)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0 - square / 6.0, np.sin(safe) / safe)[..., None, None]
    b = np.where(small, 0.5 - square / 24.0, (1.0 - np.cos(safe)) / safe**2)[..., None, None]
    cross = skew(vector)
    R: np.ndarray = np.eye(3) + a * cross + b * (cross @ cross)
    return R


def so3_log(R: Float[np.ndarray, "... 3 3"]) -> Float[np.ndarray, "... 3"]:
    """Rotation vector in rad, of length at most pi, through the quaternion (exact up to half turns)."""
    quaternion = matrix_to_quaternion(R)
    vector, w = quaternion[..., :3], quaternion[..., 3]
    norm = np.linalg.norm(vector, axis=-1)
    small = norm < 1e-12
    angle = 2.0 * np.arctan2(norm, w)
    return vector * np.where(small, 2.0, angle / np.where(small, 1.0, norm))[..., None]


def quaternion_to_matrix(quaternion: Float[np.ndarray, "... 4"]) -> Float[np.ndarray, "... 3 3"]:
    """Rotation matrix of [qx, qy, qz, qw]; the quaternion is normalised, a zero one gives NaN."""
    q = np.asarray(quaternion, dtype=np.float64)
    x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - z * w),
        2 * (x * z + y * w),
        2 * (x * y + z * w),
        1 - 2 * (x * x + z * z),
        2 * (y * z - x * w),
        2 * (x * z - y * w),
        2 * (y * z + x * w),
        1 - 2 * (x * x + y * y),
    ]
    return np.stack(rows, axis=-1).reshape(*x.shape, 3, 3)


def matrix_to_quaternion(R: Float[np.ndarray, "... 3 3"]) -> Float[np.ndarray, "... 4"]:
    """Quaternion [qx, qy, qz, qw] with qw >= 0, by the largest of the four candidates (never divides by a small one)."""
    R = np.asarray(R, dtype=np.float64)
    m00, m11, m22 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    # Four times the outer product of the quaternion with itself: its best-conditioned column is the quaternion.
    K = np.empty((*R.shape[:-2], 4, 4))
    K[..., 0, 0] = 1 + m00 - m11 - m22
    K[..., 1, 1] = 1 - m00 + m11 - m22
    K[..., 2, 2] = 1 - m00 - m11 + m22
    K[..., 3, 3] = 1 + m00 + m11 + m22
    K[..., 0, 1] = K[..., 1, 0] = R[..., 0, 1] + R[..., 1, 0]
    K[..., 0, 2] = K[..., 2, 0] = R[..., 0, 2] + R[..., 2, 0]
    K[..., 1, 2] = K[..., 2, 1] = R[..., 1, 2] + R[..., 2, 1]
    K[..., 0, 3] = K[..., 3, 0] = R[..., 2, 1] - R[..., 1, 2]
    K[..., 1, 3] = K[..., 3, 1] = R[..., 0, 2] - R[..., 2, 0]
    K[..., 2, 3] = K[..., 3, 2] = R[..., 1, 0] - R[..., 0, 1]
    best = np.argmax(np.stack([K[..., i, i] for i in range(4)], axis=-1), axis=-1)
    q = np.take_along_axis(K, best[..., None, None], axis=-1)[..., 0]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    standard: np.ndarray = np.where(q[..., 3:] < 0, -q, q)
    return standard


def nearest_rotation(matrix: Float[np.ndarray, "... 3 3"]) -> Float[np.ndarray, "... 3 3"]:
    """The rotation closest to a matrix in the Frobenius norm (polar factor by SVD)."""
    U, _, Vt = np.linalg.svd(matrix)
    U = U.copy()
    U[..., :, 2] *= np.linalg.det(U @ Vt)[..., None]
    R: np.ndarray = U @ Vt
    return R


def is_rotation(matrix: Float[np.ndarray, "... 3 3"], tolerance: float = 1e-3) -> Bool[np.ndarray, " ..."]:
    """Whether each matrix is orthonormal with determinant +1, within `tolerance` an entry."""
    residual = np.abs(np.swapaxes(matrix, -1, -2) @ matrix - np.eye(3)).max(axis=(-2, -1))
    return np.asarray((residual < tolerance) & (np.linalg.det(matrix) > 0))  # of one matrix too: an array of no dimension


def make_pose(R: Float[np.ndarray, "... 3 3"], position: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 4 4"]:
    """Stack rotation and position to 4 x 4 poses."""
    R, position = np.asarray(R, dtype=np.float64), np.asarray(position, dtype=np.float64)
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], position.shape[:-1]), 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, position, 1.0
    return T


def inverse(T: Float[np.ndarray, "... 4 4"]) -> Float[np.ndarray, "... 4 4"]:
    """Inverse of rigid motions."""
    R = np.swapaxes(T[..., :3, :3], -1, -2)
    return make_pose(R, -np.einsum("...ij,...j->...i", R, T[..., :3, 3]))


def relative(T_world_a: Float[np.ndarray, "... 4 4"], T_world_b: Float[np.ndarray, "... 4 4"]) -> np.ndarray:
    """`T_a_b`, pose of b in a (GTSAM's `between`)."""
    T_a_b: np.ndarray = inverse(T_world_a) @ T_world_b
    return T_a_b


def transform(T_a_b: Float[np.ndarray, "... 4 4"], points_b: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
    """Points of frame b in frame a."""
    points_a: np.ndarray = np.einsum("...ij,...j->...i", T_a_b[..., :3, :3], points_b) + T_a_b[..., :3, 3]
    return points_a


def adjoint(T: Float[np.ndarray, "... 4 4"]) -> Float[np.ndarray, "... 6 6"]:
    """Adjoint of rigid motions for twists [rotation, translation]: `T Exp(xi) T^-1 = Exp(Ad xi)`."""
    R, t = T[..., :3, :3], T[..., :3, 3]
    result = np.zeros((*T.shape[:-2], 6, 6))
    result[..., :3, :3] = result[..., 3:, 3:] = R
    result[..., 3:, :3] = skew(t) @ R
    return result


def se3_exp(xi: Float[np.ndarray, "... 6"]) -> Float[np.ndarray, "... 4 4"]:
    """Exponential of twists [omega, v] (rotation first, as in GTSAM)."""
    xi = np.asarray(xi, dtype=np.float64)
    omega, v = xi[..., :3], xi[..., 3:]
    square = np.sum(omega**2, axis=-1)
    angle = np.sqrt(square)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    b = np.where(small, 0.5 - square / 24.0, (1 - np.cos(safe)) / safe**2)[..., None, None]
    c = np.where(small, 1 / 6.0 - square / 120.0, (safe - np.sin(safe)) / safe**3)[..., None, None]
    cross = skew(omega)
    V = np.eye(3) + b * cross + c * (cross @ cross)
    return make_pose(so3_exp(omega), np.einsum("...ij,...j->...i", V, v))


def se3_log(T: Float[np.ndarray, "... 4 4"]) -> Float[np.ndarray, "... 6"]:
    """Twist [omega, v] of rigid motions; the inverse of `se3_exp` for rotations below pi."""
    omega = so3_log(T[..., :3, :3])
    square = np.sum(omega**2, axis=-1)
    angle = np.sqrt(square)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    d = np.where(small, 1 / 12.0 + square / 720.0, (1 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2)[..., None, None]
    cross = skew(omega)
    V_inverse = np.eye(3) - 0.5 * cross + d * (cross @ cross)
    return np.concatenate([omega, np.einsum("...ij,...j->...i", V_inverse, T[..., :3, 3])], axis=-1)


def rotation_angle(R: Float[np.ndarray, "... 3 3"]) -> Float[np.ndarray, " ..."]:
    """Geodesic angle of rotations in rad, `||log R||_F / sqrt 2`, by sine and cosine: accurate near zero and near pi."""
    R = np.asarray(R, dtype=np.float64)
    x, y, z = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    cosine = R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2] - 1.0  # twice, as the sine
    return np.asarray(np.arctan2(np.sqrt(x * x + y * y + z * z), cosine))


def mean_rotation(R: Float[np.ndarray, "n 3 3"], weights: Float[np.ndarray, " n"] | None = None) -> np.ndarray:
    """Chordal mean of rotations."""
    return nearest_rotation(np.average(R, axis=0, weights=weights))


def chain(T_world_first: Float[np.ndarray, "4 4"], steps: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n+1 4 4"]:
    """Poses from a first pose and relative steps, rotations renormalised along the way."""
    poses = np.empty((len(steps) + 1, 4, 4))
    poses[0] = T_world_first
    for i, step in enumerate(steps):
        poses[i + 1] = poses[i] @ step
        if i % 100 == 99:
            poses[i + 1, :3, :3] = nearest_rotation(poses[i + 1, :3, :3])
    return poses
