"""Ray casting against brute force in double precision, and shading where its answer is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.synthetic.renderer import textures
from nolbo_ppl.synthetic.renderer.camera_view import Environment, Light, Mesh, MeshInstance, Surface, View
from nolbo_ppl.synthetic.renderer.materials import PATTERNS, Material, material_table, sample_material
from nolbo_ppl.synthetic.renderer.ray_casting import average_down, pixel_directions, shade, shadowed, to_display, trace
from nolbo_ppl.synthetic.scenes.distractors import KINDS, sample_distractors, unit_mesh
from nolbo_ppl.synthetic.shapes import MATERIAL_ROLES

GREY = Material((0.4, 0.4, 0.4), specular=0.0)
FLAT = np.full((2, 3), 0.5)


def rotation(rng: np.random.Generator) -> np.ndarray:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def placed(kind: str, linear: np.ndarray, offset: np.ndarray, instance_id: int = -1, material: Material = GREY) -> MeshInstance:
    vertices, faces = unit_mesh(kind)
    mesh = Mesh(vertices, faces, np.zeros(len(faces), dtype=np.int64))
    return MeshInstance(mesh, linear, np.asarray(offset), (material,), instance_id)


def make_view(things: list[MeshInstance], lights: tuple[Light, ...] = (), size: int = 32, **backdrop) -> View:
    """A camera one unit above the ground, tilted down by 30 degrees."""
    tilt = np.radians(30)
    up = np.array([0.0, -np.cos(tilt), -np.sin(tilt)])
    return View(
        height=size,
        width=size,
        intrinsics=np.array([1.1 * size, 1.2 * size, size / 2 + 1.3, size / 2 - 0.7]),
        up=up,
        north=np.array([1.0, 0.0, 0.0]),
        camera_height=1.0,
        placed=tuple(things),
        lights=lights,
        ambient_sky=np.full(3, 0.5),
        ambient_ground=np.full(3, 0.2),
        backdrop=Environment(np.array([0.2, 0.4, 0.8]), np.full(3, 0.7), Surface(FLAT), **backdrop),
    )


def brute_force(things: list[MeshInstance], origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Thing and distance of the first hit of each ray, by Moeller and Trumbore over every triangle."""
    best, index = np.full(len(directions), np.inf), np.full(len(directions), -1)
    for k, thing in enumerate(things):
        corner = (thing.mesh.vertices @ thing.linear.T + thing.offset)[thing.mesh.faces]
        for a, b, c in corner:
            e1, e2 = b - a, c - a
            p = np.cross(directions, e2)
            det = p @ e1
            det = np.where(np.abs(det) < 1e-14, np.nan, det)
            s = origins - a
            u = np.einsum("nd,nd->n", s, p) / det
            q = np.cross(s, e1)
            v = np.einsum("nd,nd->n", directions, q) / det
            t = q @ e2 / det
            hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-9) & (t < best)
            best[hit], index[hit] = t[hit], k
    return index, best


@pytest.fixture(scope="module")
def crowd() -> list[MeshInstance]:
    rng = np.random.default_rng(5)
    things = []
    for k in range(5):
        linear = rotation(rng) * np.exp(rng.normal(-0.6, 0.4, 3))[None, :]
        offset = rng.uniform([-0.9, -0.6, 2.2], [0.9, 0.6, 4.0])
        things.append(placed(KINDS[k % 4], linear, offset, k))
    return things


def test_trace_agrees_with_brute_force(crowd: list[MeshInstance]) -> None:
    view = make_view(crowd)
    hits = trace(view)
    rays = pixel_directions(0, 0, 32, 32, view.intrinsics).astype(np.float64)
    index, depth = brute_force(crowd, np.zeros_like(rays), rays)
    differ = hits.index.ravel() != index
    assert differ.mean() < 0.005  # single precision at the very edges
    same = ~differ & (index >= 0)
    assert same.sum() > 200 and len(np.unique(index[same])) == 5
    np.testing.assert_allclose(hits.depth.ravel()[same], depth[same], rtol=2e-5)
    assert np.isinf(hits.depth.ravel()[~differ & (index < 0)]).all()
    for k, thing in enumerate(crowd):
        alone, _ = brute_force([thing], np.zeros_like(rays), rays)
        inside = (alone >= 0).sum()
        assert hits.silhouette[k] >= inside - 3
        assert hits.instance_visible[k] == pytest.approx((index == k).sum(), abs=3)


def test_shadows_agree_with_brute_force(crowd: list[MeshInstance]) -> None:
    view = make_view(crowd)
    rng = np.random.default_rng(0)
    points = rng.uniform([-1.5, -0.5, 1.5], [1.0, 1.5, 4.5], size=(600, 3))
    light = np.array([0.4, -0.8, -0.3]) / np.linalg.norm([0.4, -0.8, -0.3])
    dark = shadowed(view, points, light)
    index, _ = brute_force(crowd, points, np.broadcast_to(light, points.shape))
    assert (dark != (index >= 0)).mean() < 0.005
    assert dark.sum() > 20


def test_nearer_thing_hides_the_farther_one() -> None:
    near = placed("box", 0.4 * np.eye(3), [0, 0, 2.0], 0)
    far = placed("box", 0.8 * np.eye(3), [0, 0, 4.0], 1)
    for order in ([near, far], [far, near]):
        hits = trace(make_view(order))
        middle = order[hits.index[16, 16]]
        assert middle.instance_id == 0
        assert hits.depth[16, 16] == pytest.approx(1.8, rel=1e-5)
    assert hits.instance_visible[0] == hits.instance_silhouette[0]
    assert hits.instance_visible[1] < hits.instance_silhouette[1]


def test_silhouette_counts_what_the_border_cuts_off() -> None:
    thing = placed("box", 0.6 * np.eye(3), [0, 0, 3.0], 0)
    whole = trace(make_view([thing]))
    assert whole.instance_visible[0] == whole.instance_silhouette[0]
    view = make_view([thing])
    cut = replace(view, intrinsics=view.intrinsics + np.array([0, 0, 14.0, 0]))  # half of it is beyond the right border
    hits = trace(cut)
    assert hits.instance_silhouette[0] == whole.instance_silhouette[0]
    assert 0.2 < hits.instance_visible[0] / hits.instance_silhouette[0] < 0.8


def test_lambert_and_shadow_on_the_ground() -> None:
    """A pixel in the sun is brighter than one in the shadow by exactly the light's cosine times the albedo."""
    view = make_view([])
    light = Light(view.up, np.full(3, 0.8))
    clear = shade(replace(view, lights=(light,)), trace(view))
    centre = 2.0 * np.array([0, 0, 1.0]) + 0.7 * view.up  # 0.7 above the ground where the optical axis meets it
    thing = placed("ball", 0.3 * np.eye(3), centre)
    shaded_view = replace(view, placed=(thing,), lights=(light,))
    shaded = shade(shaded_view, trace(shaded_view))
    row, column = np.floor(view.intrinsics[[3, 2]]).astype(int)  # the ball hangs above the optical axis
    assert trace(shaded_view).index[row, column] < 0
    albedo, haze = 0.5, (2.0 / 60) ** 2
    sun, dark = clear[row, column, 0], shaded[row, column, 0]
    assert sun == pytest.approx(albedo * (0.5 + 0.8) * (1 - haze) + 0.7 * haze, abs=2e-3)
    assert dark == pytest.approx(albedo * 0.5 * (1 - haze) + 0.7 * haze, abs=2e-3)


def test_shading_of_a_face_towards_the_light() -> None:
    """Ambient by height of the normal, plus albedo times cosine, on the front face of a box."""
    material = Material((0.3, 0.5, 0.7), specular=0.0)
    thing = placed("box", np.eye(3), [0, 0, 3.0], 0, material)
    direction = np.array([0.0, -0.6, -0.8])
    view = make_view([thing], (Light(direction, np.array([1.0, 0.5, 0.25])),))
    colour = shade(view, trace(view))[16, 16]
    normal = np.array([0.0, 0.0, -1.0])
    lift = 0.5 + 0.5 * normal @ view.up
    ambient = 0.2 + lift * 0.3
    expected = np.array(material.albedo) * (ambient + np.array([1.0, 0.5, 0.25]) * 0.8)
    np.testing.assert_allclose(colour, expected, rtol=1e-4)


def test_picture_is_kept_but_for_shadows() -> None:
    rng = np.random.default_rng(1)
    picture = rng.random((32, 32, 3)).astype(np.float32)
    empty = make_view([], picture=picture)
    thing = placed("box", 0.3 * np.eye(3), np.array([0, 0, 2.0]) + 0.7 * empty.up, 0)
    view = replace(empty, placed=(thing,), lights=(Light(empty.up, np.ones(3)),))
    hits = trace(view)
    colour = shade(view, hits)
    background = hits.index < 0
    ratio = (colour / picture)[background]
    assert np.isclose(ratio, 1, atol=1e-4).all(axis=-1).mean() > 0.5
    assert (ratio < 1 + 1e-4).all()
    assert (ratio < 0.9).any()  # the shadow of the box


@pytest.mark.parametrize("pattern", textures.PLANE_PATTERNS)
def test_plane_patterns_mix_two_colours(pattern: str) -> None:
    number = textures.PLANE_PATTERNS.index(pattern)
    points = np.random.default_rng(0).uniform(-9, 9, (200, 2))
    values = np.array([textures.plane_pattern(number, u, v, 3) for u, v in points])
    assert ((values >= 0) & (values <= 1)).all()
    assert (values.std() > 0.05) == (pattern != "plain")


@pytest.mark.parametrize("dimensions", [2, 3])
def test_noise_interpolates_its_lattice(dimensions: int) -> None:
    """Half way between two corners the smooth weight is a half, whatever its form; corners are independent."""
    rng = np.random.default_rng(dimensions)
    corner = rng.integers(-50, 50, (300, dimensions)).astype(float)
    step = np.eye(dimensions)[0]
    first, second = (textures.fractal_noise(corner + k * step, 9, 1) for k in (0, 1))
    middle = textures.fractal_noise(corner + 0.5 * step, 9, 1)
    np.testing.assert_allclose(middle, 0.5 * (first + second), atol=1e-6)
    assert abs(np.corrcoef(first, second)[0, 1]) < 5 / np.sqrt(300)
    assert abs(first.mean() - 0.5) < 5 * np.sqrt(1 / 12 / 300)
    assert not np.allclose(first, textures.fractal_noise(corner, 10, 1))


def test_materials_are_plausible_for_every_role() -> None:
    rng = np.random.default_rng(0)
    for role in (*MATERIAL_ROLES, "a role of somebody else"):
        table = material_table([sample_material(role, rng) for _ in range(20)])
        assert ((table.albedo >= 0) & (table.albedo <= 1)).all(), role
        assert ((table.mirror >= 0) & (table.mirror <= 1)).all() and (table.shininess > 0).all(), role
    rear = np.array([sample_material("light_rear", rng).albedo for _ in range(20)])
    assert (rear[:, 0] > 5 * rear[:, 1:].max(axis=1)).all()  # red
    assert max(max(sample_material("tyre", rng).albedo) for _ in range(20)) < 0.05  # black
    with pytest.raises(InputError, match=r"unknown texture of a material: got .*'marble'.*expected none"):
        material_table([Material((0, 0, 0), pattern="marble")])
    assert PATTERNS[0] == "none"


@pytest.mark.parametrize("kind", KINDS)
def test_unit_meshes_are_closed_and_fill_the_unit_cube(kind: str) -> None:
    vertices, faces = unit_mesh(kind)
    used = vertices[np.unique(faces)]
    np.testing.assert_allclose(used.min(axis=0), -0.5, atol=1e-9)
    np.testing.assert_allclose(used.max(axis=0), 0.5, atol=1e-9)
    points = {tuple(np.round(v, 9)): i for i, v in enumerate(vertices)}  # apexes may coincide
    merged = np.array([points[tuple(np.round(v, 9))] for v in vertices])[faces]
    merged = merged[(merged[:, 0] != merged[:, 1]) & (merged[:, 1] != merged[:, 2]) & (merged[:, 2] != merged[:, 0])]
    edges = np.sort(merged[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all()


def test_clutter_has_a_unit_diagonal() -> None:
    rng = np.random.default_rng(3)
    for _ in range(50):
        parts, box = sample_distractors(rng)
        corners = np.concatenate([unit_mesh(p.kind)[0] @ p.linear.T + p.offset for p in parts])
        np.testing.assert_allclose(np.stack((corners.min(axis=0), corners.max(axis=0))), box, atol=1e-9)
        assert np.linalg.norm(box[1] - box[0]) == pytest.approx(1.0)
        np.testing.assert_allclose(box[0], -box[1], atol=1e-9)


def test_display_values() -> None:
    light = np.linspace(0, 1.2, 300).reshape(10, 10, 3).astype(np.float32)
    expected = np.round(np.clip(light * 0.9, 0, 1) ** (1 / 2.2) * 255)
    assert np.abs(to_display(light, 0.9).astype(int) - expected).max() <= 3  # the table's steps, near black
    assert np.abs(to_display(light, 0.9).astype(int) - expected)[light > 0.02].max() <= 1
    np.testing.assert_allclose(average_down(np.arange(48.0).reshape(4, 4, 3), 2)[0, 0], [7.5, 8.5, 9.5])
