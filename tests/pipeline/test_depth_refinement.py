"""Depth refines positions: the product of Gaussians against quadrature, boxes with background, stereo on a known plane."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import so3_exp
from nolbo_ppl.pipeline.depth_refinement import (
    FRONT,
    DepthScale,
    front_depth,
    fuse_along_ray,
    half_extent_along_ray,
    read_depth,
    refine_positions,
    stereo_depth,
    stereo_scale,
)
from tests.structures.test_object_posteriors import observations

CAMERA = np.array([200.0, 200.0, 96.0, 64.0])


def test_the_fused_position_is_the_product_of_both_gaussians() -> None:
    """Mean and covariance of the product by quadrature on a grid, with a covariance that is not aligned with the ray."""
    position = np.array([0.4, -0.3, 2.0])
    R = so3_exp(np.array([0.3, -0.5, 0.2]))
    covariance = R @ np.diag([0.02, 0.05, 0.2]) @ R.T
    measured, scale = 2.3, 0.15
    mean, fused = fuse_along_ray(position[None], covariance[None], np.array([measured]), np.array([scale]))
    side = np.linspace(-2.5, 2.5, 81)
    grid = position + np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    ray = position / np.linalg.norm(position)
    difference = grid - position
    log = -0.5 * np.einsum("ni,ij,nj->n", difference, np.linalg.inv(covariance), difference)
    log -= 0.5 * ((grid @ ray - measured) / scale) ** 2
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    expected = weight @ grid
    np.testing.assert_allclose(mean[0], expected, atol=1e-6)
    np.testing.assert_allclose(fused[0], (weight[:, None] * (grid - expected)).T @ (grid - expected), atol=1e-6)


def test_along_the_ray_precisions_add() -> None:
    """Isotropic guide: the range's variance is 1 / (1/v + 1/s^2), across the ray nothing changes."""
    position = np.array([[0.0, 0.0, 4.0], [0.0, 0.0, 4.0]])
    covariance = np.tile(0.25 * np.eye(3), (2, 1, 1))
    mean, fused = fuse_along_ray(position, covariance, np.array([5.0, np.nan]), np.array([0.25, np.nan]))
    np.testing.assert_allclose(np.diag(fused[0]), [0.25, 0.25, 1 / (4 + 16)])
    np.testing.assert_allclose(mean[0], [0, 0, (4 * 4 + 5 * 16) / 20])
    np.testing.assert_array_equal(mean[1], position[1])  # nothing measured: nothing changes
    np.testing.assert_array_equal(fused[1], covariance[1])


def test_half_extent_of_an_ellipsoid() -> None:
    size = np.array([[4.0, 2.0, 1.0]] * 3)
    R = np.tile(np.eye(3), (3, 1, 1))
    R[2] = so3_exp(np.array([0.0, 0.0, np.pi / 2]))
    ray = np.array([[1.0, 0, 0], [0, 0.6, 0.8], [1.0, 0, 0]])
    found = half_extent_along_ray(size, R, ray)
    point = found[1] * ray[1]
    assert (2 * point[1] / 2) ** 2 + (2 * point[2] / 1) ** 2 == pytest.approx(1.0)  # on the ellipsoid
    np.testing.assert_allclose(found[[0, 2]], [2.0, 1.0])  # turned by a quarter, its y axis lies along the ray


def ellipsoid_depth(centre: np.ndarray, radius: float, background: float, height: int = 128, width: int = 192) -> np.ndarray:
    """Depth map of a sphere before a wall, by intersecting the ray of every pixel with it."""
    v, u = np.mgrid[:height, :width] + 0.5
    ray = np.stack([(u - CAMERA[2]) / CAMERA[0], (v - CAMERA[3]) / CAMERA[1], np.ones_like(u)], axis=-1)
    a, b = np.sum(ray**2, axis=-1), ray @ centre
    discriminant = b**2 - a * (centre @ centre - radius**2)
    return np.where(discriminant > 0, (b - np.sqrt(np.maximum(discriminant, 0))) / a, background)


def seen(centre: np.ndarray, radius: float, guide: float, spread: float) -> object:
    """The guide's view of that sphere: right direction, range `guide` times the true one with that relative scale."""
    position = guide * centre
    pixel = CAMERA[2:] + CAMERA[:2] * centre[:2] / centre[2]
    half = CAMERA[0] * radius / centre[2]
    ray = position / np.linalg.norm(position)
    covariance = 1e-4 * np.eye(3) + (spread * np.linalg.norm(position)) ** 2 * np.outer(ray, ray)
    return observations(
        position=np.tile(position, (2, 1)),
        position_covariance=np.tile(covariance, (2, 1, 1)),
        box=np.tile([*(pixel - half), *(pixel + half)], (2, 1)),
        size=np.full((2, 3), 2 * radius),
    )


@pytest.mark.parametrize("guide", [0.8, 1.0, 1.25])
def test_a_sphere_before_a_wall(guide: float) -> None:
    centre, radius = np.array([0.6, -0.4, 5.0]), 0.5
    depth = ellipsoid_depth(centre, radius, background=9.0)
    depth[::3] = np.nan
    before = seen(centre, radius, guide, spread=0.15)
    after = refine_positions(before, depth, (192, 128), DepthScale())  # type: ignore[arg-type]
    assert np.linalg.norm(after.position - centre, axis=1).max() < 0.12
    assert (np.linalg.eigvalsh(after.position_covariance)[:, 2] < 0.25**2).all()
    half = refine_positions(before, depth[::2, ::2], (192, 128), DepthScale())  # type: ignore[arg-type]
    np.testing.assert_allclose(half.position, after.position, atol=0.03)  # the map may be of another size


def test_depth_of_something_else_is_left_aside() -> None:
    """A fence right before the camera: no depth near the guide's range, the guide's answer stays."""
    centre = np.array([0.6, -0.4, 5.0])
    before = seen(centre, 0.5, 1.1, spread=0.05)
    after = refine_positions(before, np.full((128, 192), 1.0), (192, 128), DepthScale())  # type: ignore[arg-type]
    np.testing.assert_array_equal(after.position, before.position)  # type: ignore[attr-defined]
    assert np.isnan(front_depth(np.full(100, 1.0), 5.0, 0.2, 0.5)[0])
    assert np.isnan(front_depth(np.full(5, 5.0), 5.0, 0.2, 0.5)[0])
    mixed = np.concatenate([np.full(40, 4.9), np.full(60, 11.0)])
    assert front_depth(mixed, 5.0, 0.2, 0.5)[0] == pytest.approx(4.9)


def test_front_is_the_mean_depth_of_a_sphere_s_middle() -> None:
    """The constant against the average over the central half of a sphere's box, by quadrature."""
    u = np.linspace(-0.5, 0.5, 401)
    x, y = np.meshgrid(u, u)
    assert np.sqrt(1 - x**2 - y**2).mean() == pytest.approx(FRONT, abs=0.02)


def test_stereo_depth_of_a_textured_plane() -> None:
    rng = np.random.default_rng(0)
    focal, baseline, disparity = 200.0, 0.4, 20
    texture = np.kron(rng.integers(0, 256, (40, 100, 3)), np.ones((4, 4, 1))).astype(np.uint8)
    left, right = texture[:, : 320 - disparity], texture[:, disparity:320]
    depth = stereo_depth(left, right, focal, baseline)
    known = depth[20:-20, 40:-20]
    assert np.isfinite(known).mean() > 0.8
    assert np.nanmedian(known) == pytest.approx(focal * baseline / disparity, rel=0.01)
    assert stereo_scale(focal, baseline).ratio * 4.0**2 == pytest.approx(0.5 * 4.0**2 / (focal * baseline))
    with pytest.raises(InputError, match="two images of one size"):
        stereo_depth(left, right[:-1], focal, baseline)


def test_depth_pictures(tmp_path: Path) -> None:
    raw = np.zeros((4, 6), dtype=np.uint16)
    raw[1, 2] = 12000
    Image.fromarray(raw).save(tmp_path / "depth.png")
    depth = read_depth(tmp_path / "depth.png", DepthScale(unit=1 / 5000))
    assert depth[1, 2] == pytest.approx(2.4) and np.isnan(depth).sum() == 23
    Image.new("RGB", (6, 4)).save(tmp_path / "colour.png")
    with pytest.raises(InputError, match="one channel of 16 bits"):
        read_depth(tmp_path / "colour.png", DepthScale())
    (tmp_path / "text.png").write_text("no picture")
    with pytest.raises(InputError, match="not a readable depth image"):
        read_depth(tmp_path / "text.png", DepthScale())
