"""Rotations, viewpoints and the step between allocentric and egocentric orientation. Batched, any float dtype.

Object frame of PASCAL3D+: x is right as seen by a viewer standing in front of the object, z is up, and the front faces
-y. Camera frame: x right, y down, z forward. A viewpoint is (azimuth, elevation, in-plane rotation) in radians; azimuth
zero looks at the front, positive elevation looks down on the object.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from nolbo_ppl.errors import input_error


def wrap_angle(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Wrap angles in radians to [-pi, pi)."""
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


def _axis_rotation(axis: int, cosine: Tensor, sine: Tensor) -> Tensor:
    zero, one = torch.zeros_like(cosine), torch.ones_like(cosine)
    rows = {
        0: (one, zero, zero, zero, cosine, -sine, zero, sine, cosine),
        2: (cosine, -sine, zero, sine, cosine, zero, zero, zero, one),
    }[axis]
    matrix = torch.stack(rows, dim=-1)
    return matrix.reshape(*matrix.shape[:-1], 3, 3)


def viewpoint_moments_to_matrix(
    cosine: Float[Tensor, "*#batch 3"], sine: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*batch 3 3"]:
    """Rotation from the cosines and sines of (azimuth, elevation, in-plane).

    It is linear in the (cos, sin) pair of each angle, so that with independent angles the expected rotation is this
    function of the expected cosines and sines (the closed form behind the expected matrix-Fisher log likelihood).
    `R_camera_object = diag(1, -1, -1) Rz(t) Rx(e - pi/2) Rz(-a)`: the PASCAL3D+ rotation maps into x right, y up,
    z backward; the leading matrix takes that to x right, y down, z forward.
    """
    cos_a, cos_e, cos_t = cosine.unbind(-1)
    sin_a, sin_e, sin_t = sine.unbind(-1)
    in_plane = _axis_rotation(2, cos_t, sin_t)
    tilt = _axis_rotation(0, sin_e, -cos_e)  # cos(e - pi/2) = sin e, sin(e - pi/2) = -cos e
    turn = _axis_rotation(2, cos_a, -sin_a)
    flip = torch.tensor([1.0, -1.0, -1.0], dtype=cosine.dtype, device=cosine.device)
    return flip[:, None] * (in_plane @ tilt @ turn)


def viewpoint_to_matrix(viewpoint: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """R_camera_object of a viewpoint (azimuth, elevation, in-plane) in radians (PASCAL3D+; docs/story.md, conventions)."""
    return viewpoint_moments_to_matrix(torch.cos(viewpoint), torch.sin(viewpoint))


def matrix_to_viewpoint(R_camera_object: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Viewpoint (azimuth, elevation, in-plane) of a rotation: elevation in [-pi/2, pi/2], the others in [-pi, pi).

    The object's vertical axis in the camera is `(-sin t cos e, -cos t cos e, -sin e)`. At elevation +-pi/2 azimuth and
    in-plane rotation turn about the same axis; then the in-plane rotation is set to zero.
    """
    up = R_camera_object[..., :, 2]
    horizontal = torch.linalg.vector_norm(up[..., :2], dim=-1)
    elevation = torch.atan2(-up[..., 2], horizontal)
    degenerate = horizontal < 1e-7
    in_plane = torch.where(degenerate, torch.zeros_like(elevation), torch.atan2(-up[..., 0], -up[..., 1]))
    zero = torch.zeros_like(elevation)
    unturned = viewpoint_to_matrix(torch.stack((zero, elevation, in_plane), dim=-1))
    turn = unturned.mT @ R_camera_object  # = Rz(-a)
    azimuth = torch.atan2(turn[..., 0, 1] - turn[..., 1, 0], turn[..., 0, 0] + turn[..., 1, 1])
    return torch.stack((wrap_angle(azimuth), elevation, wrap_angle(in_plane)), dim=-1)


def geodesic_angle(R1: Float[Tensor, "*#batch 3 3"], R2: Float[Tensor, "*#batch 3 3"]) -> Float[Tensor, "*batch"]:
    """Angle in radians between two rotations, `||log(R1' R2)||_F / sqrt 2`, accurate at both ends of [0, pi]."""
    chord = torch.linalg.matrix_norm(R1 - R2) / (2 * math.sqrt(2.0))  # = sin(angle / 2)
    cosine_half = torch.sqrt(((R1 * R2).sum((-2, -1)) + 1).clamp_min(0.0)) / 2
    return 2 * torch.atan2(chord, cosine_half)


def quaternion_to_matrix(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation of a quaternion (qx, qy, qz, qw), normalised first. Raises `InputError` when one has no length."""
    norm = torch.linalg.vector_norm(quaternion, dim=-1, keepdim=True)
    if not bool((norm > 1e-12).all()):
        raise input_error("a quaternion without length", got=quaternion.tolist(), expected="[qx, qy, qz, qw]")
    x, y, z, w = (quaternion / norm).unbind(-1)
    rows = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - z * w),
        2 * (x * z + y * w),
        2 * (x * y + z * w),
        1 - 2 * (x * x + z * z),
        2 * (y * z - x * w),
        2 * (x * z - y * w),
        2 * (y * z + x * w),
        1 - 2 * (x * x + y * y),
    )
    matrix = torch.stack(rows, dim=-1)
    return matrix.reshape(*matrix.shape[:-1], 3, 3)


def matrix_to_quaternion(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Quaternion (qx, qy, qz, qw) of a rotation with qw >= 0, from the largest of the four components (stable)."""
    m = R
    t = torch.stack(
        (
            1 + m[..., 0, 0] - m[..., 1, 1] - m[..., 2, 2],
            1 - m[..., 0, 0] + m[..., 1, 1] - m[..., 2, 2],
            1 - m[..., 0, 0] - m[..., 1, 1] + m[..., 2, 2],
            1 + m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2],
        ),
        dim=-1,
    )
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    candidates = torch.stack(
        (
            torch.stack((t[..., 0], xy, xz, wx), -1),
            torch.stack((xy, t[..., 1], yz, wy), -1),
            torch.stack((xz, yz, t[..., 2], wz), -1),
            torch.stack((wx, wy, wz, t[..., 3]), -1),
        ),
        dim=-2,
    )
    best = t.argmax(-1)[..., None, None].expand(*t.shape[:-1], 1, 4)
    quaternion = torch.gather(candidates, -2, best).squeeze(-2)
    quaternion = quaternion / torch.linalg.vector_norm(quaternion, dim=-1, keepdim=True)
    return torch.where(quaternion[..., 3:] < 0, -quaternion, quaternion)


def ray_rotation(ray: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The smallest rotation that takes the optical axis (0, 0, 1) to the direction of `ray`, a point with z > 0.

    Raises:
        InputError: a ray has no length or points straight backwards, where no smallest rotation exists.
    """
    x, y, z = (ray / torch.linalg.vector_norm(ray, dim=-1, keepdim=True)).unbind(-1)
    if not bool((z > -1 + 1e-9).all()):
        raise input_error("no rotation from the optical axis to a ray", got=ray.tolist(), expected="a point in front")
    k = 1 / (1 + z)
    rows = (1 - k * x * x, -k * x * y, x, -k * x * y, 1 - k * y * y, y, -x, -y, z)
    matrix = torch.stack(rows, dim=-1)
    return matrix.reshape(*matrix.shape[:-1], 3, 3)


def allocentric_to_egocentric(
    R_allocentric: Float[Tensor, "*#batch 3 3"], ray: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*batch 3 3"]:
    """R_camera_object from the orientation relative to the ray through the object's centre (docs/story.md, conventions)."""
    return ray_rotation(ray) @ R_allocentric


def egocentric_to_allocentric(
    R_camera_object: Float[Tensor, "*#batch 3 3"], ray: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*batch 3 3"]:
    """Orientation relative to the viewing ray, what the image of the object shows, from R_camera_object."""
    return ray_rotation(ray).mT @ R_camera_object


def symmetry_rotations(order: int, dtype: torch.dtype = torch.float64) -> Float[Tensor, "order 3 3"]:
    """The rotations about the object's vertical axis that leave an `order`-fold symmetric object as it is."""
    if order < 1:
        raise input_error("a symmetry group without elements", got=order, expected="an order of at least 1")
    angle = torch.arange(order, dtype=dtype) * (2 * math.pi / order)
    return _axis_rotation(2, torch.cos(angle), torch.sin(angle))
