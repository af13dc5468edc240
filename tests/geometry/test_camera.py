"""The pinhole camera: projection, its inverse, and the pixel convention."""

from __future__ import annotations

import torch

from nolbo_ppl.geometry.camera import pixel_ray, project

INTRINSICS = torch.tensor([700.0, 650.0, 320.0, 180.0], dtype=torch.float64)


def test_project_and_ray_round_trip() -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(100, 3, generator=generator) * torch.tensor([4.0, 4.0, 1.0]) + torch.tensor([0.0, 0.0, 6.0])
    camera = INTRINSICS * (1 + 0.1 * torch.rand(100, 4, generator=generator))
    ray = pixel_ray(project(points, camera), camera)
    torch.testing.assert_close(ray, points / points.norm(dim=-1, keepdim=True))
    torch.testing.assert_close(ray.norm(dim=-1), torch.ones(100))


def test_projection_against_the_camera_matrix() -> None:
    K = torch.tensor([[700.0, 0, 320], [0, 650, 180], [0, 0, 1]])
    point = torch.tensor([1.5, -0.7, 8.0])
    homogeneous = K @ point
    torch.testing.assert_close(project(point, INTRINSICS), homogeneous[:2] / homogeneous[2])


def test_axes() -> None:
    """x to the right, y down, the optical axis through the principal point; twice the image, twice the intrinsics."""
    right, below = project(torch.tensor([[1.0, 0.0, 5.0], [0.0, 1.0, 5.0]]), INTRINSICS)
    assert right[0] > 320 and right[1] == 180
    assert below[0] == 320 and below[1] > 180
    torch.testing.assert_close(pixel_ray(INTRINSICS[2:], INTRINSICS), torch.tensor([0.0, 0.0, 1.0]))
    point = torch.tensor([0.3, 0.4, 2.0])
    torch.testing.assert_close(project(point, 2 * INTRINSICS), 2 * project(point, INTRINSICS))
