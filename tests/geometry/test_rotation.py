"""Viewpoints, rotations and quaternions against scipy and against what a camera would see."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.linalg import logm
from scipy.spatial.transform import Rotation

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry import rotation as r

FLIP = np.diag([1.0, -1.0, -1.0])


def rotations(count: int, seed: int = 0) -> tuple[Rotation, torch.Tensor]:
    scipy_rotations = Rotation.random(count, rng=np.random.default_rng(seed))
    return scipy_rotations, torch.from_numpy(scipy_rotations.as_matrix())


def pascal(azimuth: float, elevation: float, in_plane: float) -> np.ndarray:
    """PASCAL3D+'s own formula, from scipy's rotations about the axes."""
    about = Rotation.from_euler
    return (about("z", in_plane) * about("x", elevation - np.pi / 2) * about("z", -azimuth)).as_matrix()


def test_viewpoint_follows_pascals_formula() -> None:
    rng = np.random.default_rng(1)
    viewpoints = rng.uniform([-np.pi, -np.pi / 2, -np.pi], [np.pi, np.pi / 2, np.pi], (50, 3))
    ours = r.viewpoint_to_matrix(torch.from_numpy(viewpoints)).numpy()
    expected = np.stack([FLIP @ pascal(*v) for v in viewpoints])
    np.testing.assert_allclose(ours, expected, atol=1e-14)


def test_viewpoint_zero_looks_at_the_front() -> None:
    """The front (-y) faces the camera, the object's right as the viewer sees it is on the right, its top is up."""
    R = r.viewpoint_to_matrix(torch.zeros(3))
    torch.testing.assert_close(R @ torch.tensor([0.0, -1.0, 0.0]), torch.tensor([0.0, 0.0, -1.0]))
    torch.testing.assert_close(R @ torch.tensor([1.0, 0.0, 0.0]), torch.tensor([1.0, 0.0, 0.0]))
    torch.testing.assert_close(R @ torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.0, -1.0, 0.0]))


def test_positive_elevation_looks_down_on_the_object() -> None:
    R = r.viewpoint_to_matrix(torch.tensor([0.3, 0.5, 0.0]))
    top = R @ torch.tensor([0.0, 0.0, 1.0])
    assert top[2] < 0, "the top of an object seen from above is turned to the camera"
    assert top[1] < 0, "and is still up in the image"


def test_azimuth_moves_the_camera_round_the_object() -> None:
    """At azimuth a the camera sits in the object's frame at (sin a, -cos a): from the front (-y) towards x."""
    for azimuth in (0.4, 2.0, -1.3):
        R = r.viewpoint_to_matrix(torch.tensor([azimuth, 0.0, 0.0]))
        camera = R.mT @ torch.tensor([0.0, 0.0, -1.0])  # from the object to the camera
        torch.testing.assert_close(camera, torch.tensor([math.sin(azimuth), -math.cos(azimuth), 0.0]))


def test_matrix_to_viewpoint_round_trip() -> None:
    _, R = rotations(500)
    viewpoint = r.matrix_to_viewpoint(R)
    torch.testing.assert_close(r.viewpoint_to_matrix(viewpoint), R, atol=1e-13, rtol=0)
    assert bool((viewpoint[:, 1].abs() <= math.pi / 2).all())
    generator = torch.Generator().manual_seed(0)
    angles = (torch.rand(500, 3, generator=generator) - 0.5) * torch.tensor([2.0, 0.99, 2.0]) * math.pi
    torch.testing.assert_close(r.matrix_to_viewpoint(r.viewpoint_to_matrix(angles)), angles, atol=1e-10, rtol=0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("offset", [0.0, 1e-12, 1e-9, 1e-5])
def test_gimbal_lock_keeps_the_rotation(sign: float, offset: float) -> None:
    generator = torch.Generator().manual_seed(3)
    angles = (torch.rand(40, 3, generator=generator) - 0.5) * 2 * math.pi
    angles[:, 1] = sign * (math.pi / 2 - offset)
    R = r.viewpoint_to_matrix(angles)
    viewpoint = r.matrix_to_viewpoint(R)
    assert bool(torch.isfinite(viewpoint).all())
    assert bool((viewpoint[:, [0, 2]] < math.pi).all())
    torch.testing.assert_close(r.viewpoint_to_matrix(viewpoint), R, atol=3e-7 if offset == 1e-9 else 1e-9, rtol=0)
    if offset == 0:
        torch.testing.assert_close(viewpoint[:, 2], torch.zeros(40))


def test_moments_are_linear_in_each_angle() -> None:
    """The matrix built from mean cosines and sines is the mean of the matrices, for independent angles."""
    generator = torch.Generator().manual_seed(5)
    angles = torch.randn(3, 4, generator=generator)  # four equally likely values of each angle
    grid = torch.stack(torch.meshgrid(*angles, indexing="ij"), -1)
    mean = r.viewpoint_to_matrix(grid).mean((0, 1, 2))
    moments = r.viewpoint_moments_to_matrix(angles.cos().mean(1), angles.sin().mean(1))
    torch.testing.assert_close(moments, mean, atol=1e-14, rtol=0)


def test_geodesic_angle_against_scipy_and_logm() -> None:
    a, A = rotations(60, 1)
    b, B = rotations(60, 2)
    angle = r.geodesic_angle(A, B)
    np.testing.assert_allclose(angle.numpy(), (a.inv() * b).magnitude(), atol=1e-12)
    by_logm = [np.linalg.norm(logm(x.T @ y)) / np.sqrt(2) for x, y in zip(A.numpy(), B.numpy(), strict=True)]
    np.testing.assert_allclose(angle.numpy(), by_logm, atol=1e-9)


def test_geodesic_angle_is_accurate_at_both_ends() -> None:
    a, A = rotations(30, 3)
    axis = Rotation.random(30, rng=np.random.default_rng(4)).as_rotvec()
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    for angle in (0.0, 1e-9, 1e-5, np.pi - 1e-9, np.pi - 1e-5, np.pi):
        B = torch.from_numpy((a * Rotation.from_rotvec(angle * axis)).as_matrix())
        # half of pi - angle is a difference of two numbers near one half: only its square root's precision is left
        tolerance = 2e-8 if angle > 3 else 1e-14 + 1e-7 * angle
        np.testing.assert_allclose(r.geodesic_angle(A, B).numpy(), angle, atol=tolerance)


def test_quaternions_against_scipy() -> None:
    a, A = rotations(300, 5)
    quaternion = r.matrix_to_quaternion(A).numpy()
    expected = a.as_quat(canonical=True)
    np.testing.assert_allclose(quaternion, expected, atol=1e-14)
    np.testing.assert_allclose(r.quaternion_to_matrix(torch.from_numpy(3.7 * expected)).numpy(), A.numpy(), atol=1e-14)
    half_turns = torch.diag_embed(torch.tensor([[1.0, -1, -1], [-1, 1, -1], [-1, -1, 1], [1, 1, 1]]))
    torch.testing.assert_close(r.quaternion_to_matrix(r.matrix_to_quaternion(half_turns)), half_turns)
    torch.testing.assert_close(r.matrix_to_quaternion(half_turns).abs(), torch.eye(4))


def test_wrap_angle() -> None:
    angle = torch.linspace(-20, 20, 1001)
    wrapped = r.wrap_angle(angle)
    assert bool(((wrapped >= -math.pi) & (wrapped < math.pi)).all())
    torch.testing.assert_close(torch.exp(1j * wrapped), torch.exp(1j * angle))


def test_ray_rotation_is_the_smallest() -> None:
    generator = torch.Generator().manual_seed(7)
    ray = torch.randn(200, 3, generator=generator)
    R = r.ray_rotation(ray)
    torch.testing.assert_close(R @ R.mT, torch.eye(3).expand_as(R))
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(200))
    unit = ray / ray.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(R[..., 2], unit)
    # the angle of every rotation that takes one direction to another is at least the angle between them
    between = torch.atan2(unit[:, :2].norm(dim=-1), unit[:, 2])
    torch.testing.assert_close(r.geodesic_angle(R, torch.eye(3).expand_as(R)), between, atol=1e-10, rtol=0)
    torch.testing.assert_close(r.ray_rotation(torch.tensor([0.0, 0.0, 5.0])), torch.eye(3))


def test_allocentric_is_what_the_ray_sees() -> None:
    """A camera turned by the shortest way to look straight at the object sees its allocentric rotation."""
    _, R = rotations(20, 8)
    ray = torch.tensor([3.0, -1.0, 1.5])  # 65 degrees off the optical axis
    R_camera_object = r.allocentric_to_egocentric(R, ray.expand(20, 3))
    torch.testing.assert_close(r.egocentric_to_allocentric(R_camera_object, ray.expand(20, 3)), R)
    axis = torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]), ray)
    shortest = Rotation.from_rotvec((axis / axis.norm() * torch.atan2(axis.norm(), ray[2])).numpy())
    R_ray = torch.from_numpy(shortest.as_matrix())
    torch.testing.assert_close(R_ray.mT @ R_camera_object, R)
    off_axis = math.acos(1.5 / float(ray.norm()))
    assert float(r.geodesic_angle(R_camera_object[0], R[0])) == pytest.approx(off_axis, abs=1e-9)


def test_object_far_off_axis_differs_from_its_egocentric_rotation() -> None:
    """Two buses side by side, parallel in the world: their allocentric azimuths differ by the angle of the rays."""
    R_camera_object = r.viewpoint_to_matrix(torch.tensor([0.7, 0.0, 0.0]))
    rays = torch.tensor([[0.0, 0.0, 1.0], [math.tan(0.6), 0.0, 1.0]])
    seen = r.matrix_to_viewpoint(r.egocentric_to_allocentric(R_camera_object.expand(2, 3, 3), rays))
    torch.testing.assert_close(seen[:, 1:], torch.zeros(2, 2), atol=1e-12, rtol=0)
    torch.testing.assert_close(r.wrap_angle(seen[1, 0] - seen[0, 0]).abs(), torch.tensor(0.6))
    # standing further to the object's right in the image, the viewer sees more of its left: the azimuth falls
    assert seen[1, 0] < seen[0, 0]


def test_relative_orientation_with_a_pair_that_does_not_commute() -> None:
    """R_camera_object = R_world_camera' R_world_object; the paper's R_object R_camera^-1 is another rotation."""
    _, R_world_camera = rotations(1, 9)
    _, R_world_object = rotations(1, 10)
    R_camera_object = R_world_camera.mT @ R_world_object
    point = torch.tensor([0.3, -0.8, 0.5])
    in_world = R_world_object[0] @ point
    in_camera = R_world_camera[0].mT @ in_world
    torch.testing.assert_close(R_camera_object[0] @ point, in_camera)
    papers = R_world_object @ R_world_camera.mT
    assert float(r.geodesic_angle(papers, R_camera_object)[0]) > 0.3


def test_symmetry_rotations_are_a_group_about_the_vertical() -> None:
    R = r.symmetry_rotations(4)
    expected = np.stack([Rotation.from_euler("z", k * np.pi / 2).as_matrix() for k in range(4)])
    np.testing.assert_allclose(R.numpy(), expected, atol=1e-15)
    # turning the object by the group's elements moves the azimuth by its steps
    viewpoint = torch.tensor([0.4, 0.3, 0.1])
    turned = r.matrix_to_viewpoint(r.viewpoint_to_matrix(viewpoint) @ R)
    steps = r.wrap_angle(turned[:, 0] - viewpoint[0])
    np.testing.assert_allclose(np.sort(steps.abs().numpy()), [0, np.pi / 2, np.pi / 2, np.pi], atol=1e-12)


def test_refusals() -> None:
    with pytest.raises(InputError, match="quaternion without length"):
        r.quaternion_to_matrix(torch.zeros(2, 4))
    with pytest.raises(InputError, match="no rotation from the optical axis"):
        r.ray_rotation(torch.tensor([0.0, 0.0, -1.0]))
    with pytest.raises(InputError, match="no rotation from the optical axis"):
        r.ray_rotation(torch.zeros(3))
    with pytest.raises(InputError, match="symmetry group"):
        r.symmetry_rotations(0)


def test_precision_is_kept() -> None:
    viewpoint = torch.tensor([0.3, 0.1, -0.2], dtype=torch.float32)
    R = r.viewpoint_to_matrix(viewpoint)
    assert R.dtype == torch.float32
    for value in (r.matrix_to_viewpoint(R), r.matrix_to_quaternion(R), r.ray_rotation(R[:, 2].abs())):
        assert value.dtype == torch.float32
