import dataclasses
import math

import matplotlib
import numpy as np
import pytest
from PIL import Image
from scipy.integrate import quad
from scipy.stats import chi2

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.voxels import voxels_to_mesh
from nolbo_ppl.viz.overlay import bearing_range_ellipse, pixel_ellipse, place_labels, project
from nolbo_ppl.viz.panels import azimuth_density
from nolbo_ppl.viz.posterior_plots import draw_observations
from nolbo_ppl.viz.shape_plots import face_values, surface
from nolbo_ppl.viz.style import category_colour, new_figure


def titles(figure):
    return [axes.get_title() for axes in figure.axes]


def test_picture_is_written_and_leaves_matplotlib_alone(image, observations, intrinsics, tmp_path):
    before = dict(matplotlib.rcParams)
    path = tmp_path / "deep" / "picture.png"
    draw_observations(image, observations, intrinsics, prior_mean=np.zeros((12, 16)), title="a scene", path=path)
    with Image.open(path) as picture:
        assert picture.width > 1500 and picture.height > 1000
    assert dict(matplotlib.rcParams) == before
    import matplotlib.pyplot as plt

    assert plt.get_fignums() == []
    assert [p.name for p in path.parent.iterdir()] == ["picture.png"]


def test_a_row_of_panels_for_each_object(image, observations, intrinsics):
    figure = draw_observations(image, observations, intrinsics)
    assert titles(figure).count("close-up") == 3 and titles(figure).count("shape latent, mean ± scale") == 3
    fewer = draw_observations(image, observations, intrinsics, objects=1)
    assert titles(fewer).count("close-up") == 1
    assert any("2 more not shown" in text.get_text() for text in fewer.texts)


def test_without_shapes_and_without_objects(image, observations, intrinsics, tmp_path):
    plain = dataclasses.replace(observations, voxel_mean=None, voxel_variance=None)
    figure = draw_observations(image, plain, intrinsics, path=tmp_path / "a.png")
    assert len(figure.axes) == 2 + 3 * 5
    nothing = draw_observations(image, observations[:0], intrinsics, path=tmp_path / "b.png")
    assert any("no object found" in text.get_text() for text in nothing.axes[0].texts)


def test_empty_shape_and_object_behind_the_camera(image, observations, intrinsics, tmp_path):
    odd = dataclasses.replace(
        observations,
        voxel_mean=np.zeros_like(observations.voxel_mean),
        size=np.full((3, 3), 30.0),
        latent=np.zeros((3, 128)),
        latent_scale=np.ones((3, 128)),
    )
    draw_observations(image, odd, intrinsics, path=tmp_path / "a.png")
    assert (tmp_path / "a.png").is_file()


@pytest.mark.parametrize("spread", [0.0, 3.0, 12.0])
def test_labels_do_not_overlap(observations, spread):
    n = 6
    crowded = observations[np.zeros(n, dtype=int)]
    box = np.array([50.0, 40.0, 80.0, 60.0]) + spread * np.arange(n)[:, None] * np.array([1, 1, 1, 1])
    crowded = dataclasses.replace(crowded, box=box)
    figure = new_figure(6, 6)
    axes = figure.add_subplot()
    axes.set(xlim=(0, 128), ylim=(128, 0), aspect="equal")
    extents = [text.get_bbox_patch().get_window_extent() for text in place_labels(axes, crowded)]
    frame = axes.get_window_extent()
    for i, a in enumerate(extents):
        assert frame.x0 - 1 <= a.x0 and a.x1 <= frame.x1 + 1 and frame.y0 - 1 <= a.y0 and a.y1 <= frame.y1 + 1
        assert not any(a.overlaps(b) for b in extents[:i])


def test_pixel_ellipse_holds_ninety_percent(intrinsics):
    rng = np.random.default_rng(2)
    position, covariance = np.array([0.5, -0.2, 6.0]), np.diag([0.01, 0.02, 0.05]) + 0.005
    points = rng.multivariate_normal(position, covariance, 20_000)
    pixels = project(points, intrinsics)
    share = inside(pixels, pixel_ellipse(position, covariance, intrinsics, 400))
    assert share == pytest.approx(0.9, abs=5 * math.sqrt(0.09 / 20_000) + 2e-3)  # the projection is not quite linear


def test_bearing_range_ellipse_holds_ninety_percent():
    rng = np.random.default_rng(3)
    position, covariance = np.array([2.0, 0.3, 6.0]), np.diag([0.01, 0.02, 0.04]) + 0.004
    points = rng.multivariate_normal(position, covariance, 20_000)
    values = np.stack((np.arctan2(points[:, 0], points[:, 2]), np.log(np.linalg.norm(points, axis=1))), 1)
    share = inside(values, bearing_range_ellipse(position, covariance, 400))
    assert share == pytest.approx(0.9, abs=5 * math.sqrt(0.09 / 20_000) + 2e-3)
    assert chi2.cdf(np.square(1.6), 2) < 0.9  # an ellipse of the one-dimensional radius would not


def inside(points, outline):
    from matplotlib.path import Path

    return Path(outline).contains_points(points).mean()


def test_points_behind_the_camera_have_no_pixels(intrinsics):
    assert project(np.array([[0.0, 0.0, -1.0]]), intrinsics) is None
    assert project(np.array([[0.0, 0.0, 2.0]]), intrinsics) == pytest.approx(intrinsics[None, 2:])
    assert pixel_ellipse(np.array([0.0, 0.0, -1.0]), np.eye(3), intrinsics) is None


def test_azimuth_density_is_one(observations):
    total = quad(lambda a: azimuth_density(observations, 0, np.array([a]))[0], -math.pi, math.pi, points=[0.4])[0]
    assert total == pytest.approx(1, abs=1e-8)
    peak = azimuth_density(observations, 0, np.array([0.4]))[0]
    assert peak == pytest.approx(0.7 * math.sqrt(25 / (2 * math.pi)), rel=0.02)


def test_face_values_interpolate_a_linear_field():
    axis = (np.arange(8) + 0.5) / 8 - 0.5
    field = np.broadcast_to(2 * axis[:, None, None] - axis[None, None], (8, 8, 8))
    vertices = np.array([[0.1, 0.0, 0.2], [0.2, 0.1, -0.1], [-0.3, 0.05, 0.1]])
    centre = vertices.mean(0)
    assert face_values(field, vertices, np.array([[0, 1, 2]]))[0] == pytest.approx(2 * centre[0] - centre[2])


def test_noise_is_drawn_at_a_lower_resolution(monkeypatch):
    monkeypatch.setattr("nolbo_ppl.viz.shape_plots.MOST_FACES", 2000)
    noise = np.random.default_rng(4).random((16, 16, 16))
    vertices, faces = surface(noise)
    assert 0 < len(faces) <= 2000 and np.abs(vertices).max() <= 0.5
    solid = np.zeros((16, 16, 16))
    solid[4:12, 4:12, 4:12] = 1.0
    np.testing.assert_array_equal(surface(solid)[0], voxels_to_mesh(solid)[0])


def test_colours_are_fixed_and_distinct():
    colours = [category_colour(name) for name in CATEGORIES]
    assert len(set(colours)) == 12
    assert category_colour("car", ("car",)) == category_colour("car")
    assert category_colour("lamp", ("car", "lamp")) != category_colour("lamp")


def test_errors(observations, intrinsics):
    with pytest.raises(InputError, match=r"an image to draw on.*\(height, width, 3\) uint8"):
        draw_observations(np.zeros((10, 10)), observations, intrinsics)
