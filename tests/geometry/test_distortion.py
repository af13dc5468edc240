"""Lens distortion against its formulas, and images, points and boxes without it."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.distortion import (
    distort_points,
    undistort_boxes,
    undistort_depth,
    undistort_image,
    undistort_points,
    zoom_without_rims,
)

CAMERA = np.array([300.0, 310.0, 330.0, 238.0])
LENSES = {
    "radial-tangential": (-0.28, 0.07, 0.0012, -0.0008, 0.003),
    "rational": (-0.2, 0.05, 0.001, -0.001, 0.01, 0.1, 0.02, 0.005),
    "fisheye": (0.02, -0.01, 0.004, -0.001),
}


def by_formula(points: np.ndarray, model: str, c: tuple[float, ...]) -> np.ndarray:
    """Brown's model and Kannala and Brandt's, written out."""
    x, y = ((points - CAMERA[2:]) / CAMERA[:2]).T
    r2 = x * x + y * y
    if model == "fisheye":
        r = np.sqrt(r2)
        angle = np.arctan(r)
        bent = angle * (1 + c[0] * angle**2 + c[1] * angle**4 + c[2] * angle**6 + c[3] * angle**8)
        return np.stack([x * bent / r, y * bent / r], 1) * CAMERA[:2] + CAMERA[2:]
    k = (*c, 0, 0, 0, 0)[:8]
    radial = (1 + k[0] * r2 + k[1] * r2**2 + k[4] * r2**3) / (1 + k[5] * r2 + k[6] * r2**2 + k[7] * r2**3)
    u = x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x)
    v = y * radial + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y
    return np.stack([u, v], 1) * CAMERA[:2] + CAMERA[2:]


@pytest.mark.parametrize("model", list(LENSES))
def test_points_follow_the_formula_and_come_back(model: str) -> None:
    points = np.random.default_rng(0).uniform((20, 20), (620, 460), (200, 2))
    seen = distort_points(points, CAMERA, model, LENSES[model])
    np.testing.assert_allclose(seen, by_formula(points, model, LENSES[model]), atol=1e-9)
    assert np.abs(seen - points).max() > 5
    np.testing.assert_allclose(undistort_points(seen, CAMERA, model, LENSES[model]), points, atol=1e-5)


def test_boxes_hold_what_was_in_them() -> None:
    """Points of a distorted box lie inside its undistorted box, which is no larger than their hull."""
    rng, lens = np.random.default_rng(1), LENSES["radial-tangential"]
    box = np.array([[400.0, 60.0, 560.0, 200.0]])
    found = undistort_boxes(box, CAMERA, "radial-tangential", lens)[0]
    inside = undistort_points(rng.uniform(box[0, :2], box[0, 2:], (4000, 2)), CAMERA, "radial-tangential", lens)
    assert (inside >= found[:2] - 0.05).all() and (inside <= found[2:] + 0.05).all()
    np.testing.assert_allclose([*inside.min(0), *inside.max(0)], found, atol=2.0)


@cache
def pixels_through(model: str) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of an image of 640 x 480 px, and where the pinhole camera sees what is there."""
    v, u = np.mgrid[:480, :640]
    pixels = np.stack([u.ravel(), v.ravel()], 1).astype(np.float64)
    return pixels, undistort_points(pixels, CAMERA, model, LENSES[model])


@pytest.mark.parametrize("model", list(LENSES))
def test_images_are_what_a_pinhole_camera_sees(model: str) -> None:
    """A pattern painted through the lens, undistorted, is the pattern."""

    def pattern(points: np.ndarray) -> np.ndarray:
        return 128 + 100 * np.sin(points[:, 0] / 40) * np.cos(points[:, 1] / 31)

    pixels, ideal = pixels_through(model)
    image = np.repeat(pattern(ideal).reshape(480, 640, 1), 3, axis=2).astype(np.uint8)
    found = undistort_image(image, CAMERA, model, LENSES[model])[..., 0]
    expected = pattern(pixels).reshape(480, 640)
    seen = found[60:-60, 60:-60] > 0
    assert np.abs(found[60:-60, 60:-60].astype(float) - expected[60:-60, 60:-60])[seen].max() < 4


@pytest.mark.parametrize("model", list(LENSES))
def test_depth_is_moved_and_never_mixed(model: str) -> None:
    """Two walls through the lens: the pinhole camera sees them where they are, at their own depths, at half size as well."""

    def walls(points: np.ndarray) -> np.ndarray:
        return np.where(points[:, 0] + 0.3 * points[:, 1] < 380, 2.0, 5.0)

    pixels, ideal = pixels_through(model)
    seen = walls(ideal).reshape(480, 640)
    for depth, step in ((seen, 1), (seen[::2, ::2], 2)):
        found = undistort_depth(depth, CAMERA, model, LENSES[model], size=(640, 480))
        expected = walls(pixels).reshape(480, 640)[::step, ::step]
        inner = slice(70 // step, -(70 // step))
        assert set(np.unique(found[inner, inner])) <= {0.0, 2.0, 5.0}
        known = found[inner, inner] > 0
        assert known.mean() > 0.9 and np.mean(found[inner, inner][known] != expected[inner, inner][known]) < 0.01 * step


def test_no_rims_without_a_picture() -> None:
    pincushion = (0.2, 0.0, 0.0, 0.0)
    factor = zoom_without_rims(CAMERA, (640, 480), "radial-tangential", pincushion)
    assert 1.05 < factor < 1.5
    target = CAMERA * [factor, factor, 1, 1]
    white = np.full((480, 640, 3), 255, np.uint8)
    assert (undistort_image(white, CAMERA, "radial-tangential", pincushion, target)[2:-2, 2:-2] == 255).all()
    assert (undistort_image(white, CAMERA, "radial-tangential", pincushion)[2:-2, 2:-2] == 0).any()
    assert zoom_without_rims(CAMERA, (640, 480), "radial-tangential", (-0.28, 0.07, 0.0, 0.0)) == 1.0


def test_pixels_that_no_ray_reaches_are_refused() -> None:
    with pytest.raises(InputError, match="pixel that the distortion model cannot undo: got"):
        undistort_points(np.array([[5000.0, 240.0]]), CAMERA, "radial-tangential", (-0.28, 0.0, 0.0, 0.0))


def test_depth_that_is_no_number_is_unknown() -> None:
    depth = np.full((48, 64), 2.0)
    depth[20:24, 30:34] = [np.inf, -np.inf, np.nan, np.inf]
    found = undistort_depth(depth, CAMERA / 10, "radial-tangential", (0.0, 0.0, 0.0, 0.0))
    assert set(np.unique(found)) == {0.0, 2.0} and (found == 0).sum() == 16
