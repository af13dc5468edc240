"""Smooth edges against rendering every pixel with several rays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.synthetic.renderer.antialias import shade_smoothly, uneven
from nolbo_ppl.synthetic.renderer.camera_view import Environment, Light, Mesh, MeshInstance, Surface, View
from nolbo_ppl.synthetic.renderer.materials import PATTERNS, Material
from nolbo_ppl.synthetic.renderer.ray_casting import average_down, shade, trace, trace_pixels
from nolbo_ppl.synthetic.renderer.textures import SOLID, SURFACE_PATTERNS, surface_pattern
from nolbo_ppl.synthetic.scenes.distractors import unit_mesh

LIGHT = np.array([0.3, -0.8, -0.52]) / np.linalg.norm([0.3, -0.8, -0.52])


def thing(kind: str, size: float, offset: list[float], colour: tuple[float, float, float], instance_id: int = -1) -> MeshInstance:
    vertices, faces = unit_mesh(kind)
    mesh = Mesh(vertices, faces, np.zeros(len(faces), dtype=np.int64))
    return MeshInstance(mesh, size * np.eye(3), np.array(offset), (Material(colour, specular=0.0),), instance_id)


@pytest.fixture(scope="module")
def view() -> View:
    placed = (
        thing("ball", 0.9, [0.1, 0.0, 3.0], (0.9, 0.2, 0.1)),
        thing("box", 0.5, [-0.7, 0.2, 2.5], (0.1, 0.8, 0.2)),
        thing("box", 0.6, [0.5, 0.1, 0.25], (0.3, 0.3, 0.9)),  # reaches behind the camera
        thing("cone", 0.6, [0.0, 0.1, -2.0], (1.0, 1.0, 1.0)),  # behind it
    )
    return View(
        height=64,
        width=96,
        intrinsics=np.array([80.0, 85.0, 47.3, 31.1]),
        up=np.array([0.0, -1.0, 0.0]),
        north=np.array([0.0, 0.0, 1.0]),
        camera_height=0.8,
        placed=placed,
        lights=(Light(LIGHT, np.full(3, 0.6)),),
        ambient_sky=np.full(3, 0.4),
        ambient_ground=np.full(3, 0.2),
        backdrop=Environment(np.array([0.2, 0.4, 0.8]), np.full(3, 0.7), Surface(np.full((2, 3), 0.4))),
    )


def finer(view: View, factor: int) -> View:
    return replace(view, height=factor * view.height, width=factor * view.width, intrinsics=factor * view.intrinsics)


def test_rays_through_some_pixels_meet_what_a_finer_picture_shows(view: View) -> None:
    fine = trace(finer(view, 2))
    rows, columns = (grid.ravel() for grid in np.indices((view.height, view.width)))
    offsets = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])
    _, index, face, depth = trace_pixels(view, trace(view).windows, rows, columns, offsets)
    for k, (x, y) in enumerate(((0, 0), (1, 0), (0, 1), (1, 1))):
        same = index[:, k] == fine.index[y::2, x::2].ravel()
        assert same.mean() > 0.999  # single precision at the very edges
        assert (face[same, k] == fine.face[y::2, x::2].ravel()[same]).mean() > 0.999
        hit = same & (index[:, k] >= 0)
        np.testing.assert_allclose(depth[hit, k], fine.depth[y::2, x::2].ravel()[hit], rtol=1e-4)
    assert set(np.unique(index)) == {-1, 0, 1, 2}


def test_a_mesh_that_reaches_behind_the_camera_is_followed_to_the_border(view: View) -> None:
    """The window of such a mesh is bounded on the side it does not reach, and without bound on the other."""
    window = trace(view).windows[2]
    assert window is not None and np.isfinite(window[0]) and np.isinf(window[2])
    assert trace(view).windows[3] is None
    hits = trace(view)
    assert (hits.index == 2).any() and (hits.index[:, : int(window[0])] != 2).all()


def test_edges_are_as_smooth_as_with_several_rays_everywhere(view: View) -> None:
    hits = trace(view)
    jagged = shade(view, hits)
    full = average_down(shade(finer(view, 2), trace(finer(view, 2))), 2)
    smooth = shade_smoothly(view, hits, 2)
    flag = uneven(jagged)
    assert 0.02 < flag.mean() < 0.5
    # Bar rays that pass an edge in single precision, pixels rendered again are exactly the mean of their rays.
    assert np.isclose(smooth[flag], full[flag], atol=2e-3).all(axis=-1).mean() > 0.98
    np.testing.assert_array_equal(smooth[~flag], jagged[~flag])
    assert np.abs(smooth - full).mean() < 0.15 * np.abs(jagged - full).mean()
    np.testing.assert_array_equal(shade_smoothly(view, hits, 1), jagged)


def test_a_picture_of_one_colour_stays_as_it_is(view: View) -> None:
    hits = trace(view)
    np.testing.assert_array_equal(shade_smoothly(view, hits, 2, contrast=1e9), shade(view, hits))


def test_uneven_pixels_are_those_beside_a_step() -> None:
    picture = np.full((5, 6, 3), 0.25)
    picture[2:, 3:, 1] = 0.36  # display 0.5 against 0.6
    expected = np.zeros((5, 6), dtype=bool)
    expected[2:, 2:4] = expected[1:3, 3:] = True
    np.testing.assert_array_equal(uneven(picture), expected)
    assert not uneven(picture, contrast=0.11).any()


def test_pictures_cannot_be_smoothed(view: View) -> None:
    behind = replace(view, backdrop=replace(view.backdrop, picture=np.zeros((64, 96, 3))))
    with pytest.raises(InputError, match="smooth edges before a picture"):
        shade_smoothly(behind, trace(behind), 2)


def test_things_without_shadow(view: View) -> None:
    light = (Light(np.array([0.0, -1.0, 0.0]), np.ones(3)),)
    ball = thing("ball", 0.6, [0.0, -0.2, 3.0], (0.5, 0.5, 0.5))
    dark = replace(view, placed=(ball,), lights=light)
    clear = replace(dark, placed=(replace(ball, casts_shadow=False),))
    first, second = (shade(v, trace(v)) for v in (dark, clear))
    ground = trace(dark).index < 0
    assert (second[ground] > first[ground] + 0.1).any()
    np.testing.assert_allclose(second[ground], shade(replace(dark, placed=()), trace(replace(dark, placed=())))[ground])


def test_clouds_turn_with_the_sky(view: View) -> None:
    """Turning camera and sky frame together leaves the clouds where they are in the world."""
    c, s = np.cos(0.3), np.sin(0.3)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])  # R_world_camera of a camera turned about the vertical
    sky = replace(view.backdrop, clouds=0.8, seed=4)
    still = replace(view, placed=(), lights=(), backdrop=sky)
    turned = replace(still, backdrop=replace(sky, R_sky_camera=turn))
    first, second = (shade(v, trace(v)) for v in (still, turned))
    assert np.abs(first - second).max() > 0.02
    fx, fy, cx, cy = view.intrinsics
    matched = 0
    for row in range(2, 20, 3):
        for column in range(30, 90, 4):
            ray = turn @ np.array([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, 1.0])
            x, y = ray[0] / ray[2] * fx + cx - 0.5, ray[1] / ray[2] * fy + cy - 0.5
            if 0 <= x < 95 and 0 <= y < 25:
                near = first[int(y) : int(y) + 2, int(x) : int(x) + 2].reshape(-1, 3)
                assert (second[row, column] > near.min(axis=0) - 0.03).all()
                assert (second[row, column] < near.max(axis=0) + 0.03).all()
                matched += 1
    assert matched > 20


def test_haze_takes_meshes_to_the_horizon(view: View) -> None:
    hazy = replace(view, backdrop=replace(view.backdrop, mesh_haze=0.2))
    hits = trace(view)
    clear, faded = shade(view, hits), shade(hazy, hits)
    mesh = hits.index >= 0
    fog = 1 - np.exp(-((0.2 * hits.depth[mesh]) ** 2))[:, None]
    np.testing.assert_allclose(faded[mesh], clear[mesh] + fog * (0.7 - clear[mesh]), atol=1e-5)
    np.testing.assert_array_equal(faded[~mesh], clear[~mesh])


@pytest.mark.parametrize("pattern", SURFACE_PATTERNS)
def test_surface_patterns(pattern: str) -> None:
    """Within [0, 1], laid out along the face, and even where a pixel covers many periods."""
    number = PATTERNS.index(pattern)
    assert number >= SOLID
    rng = np.random.default_rng(1)
    points = rng.uniform(-20, 20, (400, 3)).astype(np.float32)
    up, side = np.array([0, 0, 1], np.float32), np.array([0, -1, 0], np.float32)
    near = np.array([surface_pattern(number, q, up, 3, 0.001) for q in points])
    assert ((near >= 0) & (near <= 1)).all() and near.std() > 0.05
    far = np.array([surface_pattern(number, q, up, 3, 50.0) for q in points])
    assert far.std() < 0.01
    if pattern != "leaves":  # a level face does not look at z, a face towards -y not at y
        lifted = points + [0, 0, 0.37]
        np.testing.assert_array_equal(near, [surface_pattern(number, q, up, 3, 0.001) for q in lifted.astype(np.float32)])
        wall = [surface_pattern(number, q, side, 3, 0.001) for q in points]
        shifted = (points + [0, 0.37, 0]).astype(np.float32)
        np.testing.assert_array_equal(wall, [surface_pattern(number, q, side, 3, 0.001) for q in shifted])
