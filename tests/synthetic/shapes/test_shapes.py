"""Parametric shapes: primitives against ray casting, canonical frames, symmetry, fronts that differ from backs."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from nolbo_ppl.categories import CATEGORIES, CATEGORY_SYMMETRY
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.voxels import voxel_centres, voxel_iou
from nolbo_ppl.synthetic.shapes import MATERIAL_ROLES, AnalyticSolid, Shape, make_shape, shape_from_seed
from nolbo_ppl.synthetic.shapes import canonical_shape as shape_module
from nolbo_ppl.synthetic.shapes.canonical_shape import assemble
from nolbo_ppl.synthetic.shapes.polygon import grid_inside, half_thickness, signed_area, triangulate
from nolbo_ppl.synthetic.shapes.primitives import Extrusion, Loft, Primitive
from nolbo_ppl.synthetic.shapes.tubes import Torus, Tube

ASYMMETRIC = [name for name, order in CATEGORY_SYMMETRY.items() if order == 1]
L_PROFILE = np.array([(0, 0), (1, 0), (1, 0.3), (0.4, 0.3), (0.4, 1), (0, 1)], dtype=float)
DIAGONALS = {
    "aeroplane": (8, 110),
    "bicycle": (1.3, 3),
    "boat": (2.5, 250),
    "bottle": (0.15, 0.4),
    "bus": (6, 16),
    "car": (3.5, 8),
    "chair": (0.8, 2),
    "diningtable": (0.9, 3),
    "motorbike": (1.8, 3.5),
    "sofa": (1, 4),
    "train": (8, 32),
    "tvmonitor": (0.35, 2.2),
}


def sample(category: str, count: int, first: int = 0) -> list[Shape]:
    return [shape_from_seed(category, seed) for seed in range(first, first + count)]


def signed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    return float(np.einsum("fi,fi->", a, np.cross(b, c))) / 6


def is_closed(faces: np.ndarray) -> bool:
    """Whether every directed edge is matched by exactly one reversed edge."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).tolist()
    forward = set(map(tuple, edges))
    return len(forward) == len(edges) and {(b, a) for a, b in forward} == forward


def mesh_contains(primitive: Primitive, points: np.ndarray) -> np.ndarray:
    """Ray parity (embreex), an independent inside test."""
    vertices, faces, _ = primitive.mesh()
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    return np.asarray(mesh.contains(points))


def grid_points(primitive: Primitive, n: int) -> tuple[list[np.ndarray], np.ndarray]:
    low, high = primitive.bounds()
    # An irrational margin keeps the points off faces and edges.
    axes = [np.linspace(a - 0.0173 * np.pi, b + 0.0211 * np.pi, n) for a, b in zip(low, high)]
    return axes, np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


# -- polygons


def test_triangulation_covers_a_polygon_once() -> None:
    rng = np.random.default_rng(0)
    for n in range(3, 14):
        angle = np.sort(rng.random(n)) * 2 * np.pi
        polygon = np.stack([np.cos(angle), np.sin(angle)], -1) * rng.uniform(0.3, 1.0, (n, 1))
        if np.max(np.diff([*angle, angle[0] + 2 * np.pi])) > np.pi:
            continue  # the centre is not inside: the star may cross itself
        triangles = triangulate(polygon)
        areas = [signed_area(polygon[list(t)]) for t in triangles]
        assert len(triangles) == n - 2 and min(areas) > -1e-12
        assert sum(areas) == pytest.approx(signed_area(polygon), abs=1e-12)


def test_polygon_grid_agrees_with_its_triangles() -> None:
    x, y = np.linspace(-0.11, 1.13, 37), np.linspace(-0.07, 1.09, 41)
    points = np.stack(np.meshgrid(x, y, indexing="ij"), -1)
    expected = np.zeros((37, 41), dtype=bool)
    for a, b, c in (L_PROFILE[list(t)] for t in triangulate(L_PROFILE)):
        sides = [(q - p)[0] * (points - p)[..., 1] - (q - p)[1] * (points - p)[..., 0] for p, q in ((a, b), (b, c), (c, a))]
        expected |= np.min(sides, axis=0) >= 0
    assert (grid_inside(L_PROFILE, x, y) == expected).all()


def test_polygon_margin_is_a_distance() -> None:
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], dtype=float)
    x = np.linspace(-0.5, 1.5, 61)
    outside = [np.maximum(np.maximum(-c, c - 1), 0) for c in np.meshgrid(x, x, indexing="ij")]
    distance = np.hypot(*outside)
    near = np.abs(distance - 0.2) < 1e-9
    assert (grid_inside(square, x, x, margin=0.2) == (distance <= 0.2))[~near].all()


def test_half_thickness_of_strips() -> None:
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    strip = np.array([(0, 0), (3, 0), (3, 0.1), (0, 0.1)], dtype=float)
    assert half_thickness(strip) == pytest.approx(0.05)
    assert half_thickness(strip @ turn.T) == pytest.approx(0.05)


def test_clockwise_polygon_is_refused() -> None:
    with pytest.raises(InputError, match=r"cannot be triangulated.*expected simple, counter-clockwise"):
        triangulate(L_PROFILE[::-1])


# -- primitives

ONE = ("body", "body")
RECTANGLE = np.array([(0, 0), (1, 0), (1, 2), (0, 2)], dtype=float)
KEEL = np.array([(-1, 1), (-0.8, 0), (0, -1), (0.8, 0), (1, 1)], dtype=float)


def hull() -> Primitive:
    centre, half = np.array([(0, 0.2), (0, 0), (0.1, 0.1)]), np.array([(0.1, 0.3), (0.6, 0.5), (0.5, 0.4)])
    return Loft(1, np.array([0.0, 0.5, 2.0]), centre, half, 2.0, KEEL, 0, ONE, ONE)


def ellipse() -> Primitive:
    centre, half = np.array([(0, 0), (0.2, 0), (0.3, 0)]), np.array([(0.4, 0.2), (0.5, 0.4), (0.1, 0.1)])
    return Loft(0, np.array([0.0, 0.7, 1.0]), centre, half, 2.0, None, 160, ONE, ONE)


def boxy() -> Primitive:
    half = np.array([(0.5, 0.4), (0.3, 0.4)])
    return Loft(2, np.array([0.0, 1.0]), np.zeros((2, 2)), half, 5.0, None, 160, ("body",), ONE)


def straight_tube() -> Primitive:
    return Tube(np.array([(0, 0, 0), (0.8, 0.3, 1.0)]), np.array([0.2, 0.35]), "body", 96)


PRIMITIVES: dict[str, Callable[[], Primitive]] = {
    "box": lambda: Extrusion(2, RECTANGLE, (0.1, 0, 0), (0.7, 0, 0), ("body",) * 4, ONE),
    "slanted": lambda: Extrusion(0, L_PROFILE, (-0.5, 0.1, 0.05), (0.6, -0.2, 0.1), ("body",) * 6, ONE),
    "clockwise": lambda: Extrusion(1, L_PROFILE[::-1], (0.0, 0.2, 0.0), (1.0, 0.0, 0.3), ("body",) * 6, ONE),
    "hull": hull,
    "ellipse": ellipse,
    "boxy": boxy,
    "tube": straight_tube,
    "torus": lambda: Torus(1, (0.1, -0.2, 0.3), 0.7, 0.2, "body", (120, 60)),
}


@pytest.mark.parametrize("name", PRIMITIVES)
def test_primitive_is_closed_and_wound_outwards(name: str) -> None:
    primitive = PRIMITIVES[name]()
    vertices, faces, roles = primitive.mesh()
    assert is_closed(faces)
    assert signed_volume(vertices, faces) > 0
    assert len(roles) == len(faces)
    low, high = primitive.bounds()
    assert (vertices >= low - 1e-12).all() and (vertices <= high + 1e-12).all()


@pytest.mark.parametrize("name", PRIMITIVES)
def test_inside_test_agrees_with_ray_casting(name: str) -> None:
    """Two independent computations; round forms have fine meshes here, so that few points lie between the two."""
    primitive = PRIMITIVES[name]()
    axes, points = grid_points(primitive, 31)
    inside = primitive.inside(*axes, 0.0).ravel()
    assert 0.02 < inside.mean() < 0.98
    # Sides of a loft between polygons of different form are cut into two triangles: their middle differs a little.
    assert (inside != mesh_contains(primitive, points)).mean() < (1e-3 if name in ("box", "slanted", "clockwise") else 6e-3)


@pytest.mark.parametrize("name", PRIMITIVES)
def test_volume_of_the_inside_test_is_that_of_the_mesh(name: str) -> None:
    primitive = PRIMITIVES[name]()
    low, high = primitive.bounds()
    n = 90
    axes = [a + (b - a) * (np.arange(n) + 0.5) / n for a, b in zip(low, high)]
    volume = primitive.inside(*axes, 0.0).mean() * np.prod(high - low)
    vertices, faces, _ = primitive.mesh()
    assert volume == pytest.approx(signed_volume(vertices, faces), rel=0.01)


def test_bent_tube_is_the_set_near_its_path() -> None:
    path = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0.2), (0.4, 1.2, 0.9)], dtype=float)
    tube = Tube(path, np.full(4, 0.15), "body", 24)
    axes, points = grid_points(tube, 28)
    distance = np.full(len(points), np.inf)
    for a, b in itertools.pairwise(path):
        for share in np.linspace(0, 1, 80):
            distance = np.minimum(distance, np.linalg.norm(points - a - share * (b - a), axis=-1))
    inside = tube.inside(*axes, 0.0).ravel()
    ends = ((points - path[0]) @ (path[1] - path[0]) < 0) | ((points - path[-1]) @ (path[-1] - path[-2]) > 0)
    clear = np.abs(distance - 0.15) > 1e-3
    assert (inside == (distance <= 0.15))[clear & ~ends].all()
    assert not inside[ends & (distance > 0.16)].any()
    vertices, faces, _ = tube.mesh()
    assert is_closed(faces) and signed_volume(vertices, faces) > 0


def test_edge_roles_follow_their_edges() -> None:
    """A role stays on its edge when the profile is given clockwise."""
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], dtype=float)
    for profile, roles in (
        (square, ("body", "glass", "metal", "wood")),
        (square[::-1], ("metal", "glass", "body", "wood")),
    ):
        vertices, faces, names = Extrusion(0, profile, (0, 0, 0), (1, 0, 0), roles, ("trim", "plate")).mesh()
        centre = {role: vertices[faces[[n == role for n in names]]].mean(axis=(0, 1)) for role in set(names)}
        assert centre["body"][2] == 0 and centre["metal"][2] == 1  # edges z = 0 and z = 1
        assert centre["glass"][1] == 1 and centre["wood"][1] == 0
        assert centre["trim"][0] == 0 and centre["plate"][0] == 1


def test_primitives_refuse_nonsense() -> None:
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], dtype=float)
    with pytest.raises(InputError, match="one role per edge: got 3, expected 4"):
        Extrusion(0, square, (0, 0, 0), (1, 0, 0), ("body",) * 3, ("body", "body"))
    with pytest.raises(InputError, match="planes of an extrusion cross"):
        Extrusion(0, square, (0, 0, 0), (-0.1, 0.3, 0), ("body",) * 4, ("body", "body"))
    with pytest.raises(InputError, match=r"unknown material role.*chocolate"):
        assemble("car", "x", [Tube(np.eye(3), np.ones(3), "chocolate")], [], 1)
    with pytest.raises(InputError, match="without a solid part"):
        assemble("car", "x", [], [], 1)


def test_thin_parts_survive_voxels() -> None:
    """A wire, a plate, a slanted panel a hundredth of a voxel thick: an unbroken set of voxels, one or two thick."""
    from scipy.ndimage import label

    n, t = 32, 1e-4
    strip = np.array([(-0.3, -0.4), (-0.3 + t, -0.4), (0.35 + t, 0.4), (0.35, 0.4)])
    parts: dict[str, Primitive] = {
        "wire": Tube(np.array([(-0.4, -0.3, -0.35), (0.4, 0.2, 0.33)]), np.full(2, t), "metal"),
        "plate": Extrusion(2, L_PROFILE * 0.8 - 0.4, (0.0123, 0, 0), (0.0123 + t, 0, 0), ("body",) * 6, ONE),
        "panel": Extrusion(0, strip, (-0.3, 0, 0), (0.3, 0, 0), ("body",) * 4, ONE),
        "rod": Loft(2, np.array([-0.4, 0.4]), np.full((2, 2), 0.04), np.full((2, 2), t), 2.0, None, 6, ("body",), ONE),
        "ring": Torus(0, (0.0, 0.0, 0.0), 0.35, t, "tyre"),
    }
    for name, part in parts.items():
        grid = AnalyticSolid((part,), np.zeros(3), 1.0).fill(n)
        _, pieces = label(grid, np.ones((3, 3, 3)))
        assert pieces == 1, name
        vertices, faces, _ = part.mesh()
        area = trimesh.Trimesh(vertices, faces, process=False).area / 2
        if name in ("plate", "panel"):
            assert area * n**2 * 0.95 < grid.sum() < area * n**2 * 2.4, name
        extent = np.ptp(np.argwhere(grid), axis=0) + 1
        assert (np.abs(extent - np.ptp(vertices, axis=0) * n) <= 2.01).all(), name


# -- families


@pytest.mark.parametrize("category", CATEGORIES)
def test_shape_is_canonical(category: str) -> None:
    for item in sample(category, 12):
        low, high = item.vertices.min(axis=0), item.vertices.max(axis=0)
        assert np.abs(low + high).max() < 1e-12
        assert np.linalg.norm(high - low) == pytest.approx(1.0, abs=1e-12)
        assert item.vertices.dtype == np.float64 and item.faces.dtype == np.int64
        assert item.faces.min() == 0 and item.faces.max() == len(item.vertices) - 1
        assert 30 <= len(item.faces) <= 3000
        assert item.part.shape == (len(item.faces),)
        assert set(np.unique(item.part)) == set(range(len(item.parts)))
        assert set(item.parts) <= set(MATERIAL_ROLES) and len(set(item.parts)) == len(item.parts)
        assert DIAGONALS[category][0] < item.diagonal < DIAGONALS[category][1]
        assert np.allclose(item.dimensions, (high - low) * item.diagonal)
        assert item.category == category


@pytest.mark.parametrize("category", CATEGORIES)
def test_every_part_is_closed_and_wound_outwards(category: str) -> None:
    for item in sample(category, 8):
        assert isinstance(item.solid, AnalyticSolid)
        for primitive in item.solid.primitives:
            vertices, faces, _ = primitive.mesh()
            assert is_closed(faces)
            assert signed_volume(vertices, faces) > 0
            assert np.isfinite(vertices).all()


@pytest.mark.parametrize("category", CATEGORIES)
def test_same_seed_same_shape(category: str) -> None:
    a, b, other = shape_from_seed(category, 7), shape_from_seed(category, 7), shape_from_seed(category, 8)
    assert a.instance == f"{category}-00000007"
    assert (a.vertices == b.vertices).all() and (a.faces == b.faces).all() and (a.part == b.part).all()
    assert a.diagonal == b.diagonal and (a.voxels(16) == b.voxels(16)).all()
    assert a.diagonal != other.diagonal
    drawn = make_shape(category, np.random.default_rng(3))
    again = shape_from_seed(category, int(drawn.instance.rpartition("-")[2]))
    assert again.instance == drawn.instance and (again.vertices == drawn.vertices).all()
    named = make_shape(category, np.random.default_rng(3), "mine")
    assert named.instance == "mine"
    copied = copy.deepcopy(a)
    assert (copied.voxels(16) == a.voxels(16)).all()


@pytest.mark.parametrize("category", CATEGORIES)
def test_instances_differ(category: str) -> None:
    """Among fifty instances no two share their shape, and they spread widely."""
    grids = np.stack([item.voxels(32) for item in sample(category, 50)]).reshape(50, -1).astype(np.float32)
    both = grids @ grids.T
    total = grids.sum(axis=1)
    iou = (both / (total[:, None] + total - both))[np.triu_indices(50, 1)]
    assert iou.max() < 0.999
    assert np.median(iou) < 0.85


@pytest.mark.parametrize("category", ["car", "chair", "aeroplane", "bottle", "boat", "sofa"])
def test_voxels_agree_with_ray_casting_of_the_parts(category: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without thickening the fill is the union of the parts; with it, a little more and never less."""
    n = 32
    x = voxel_centres(n) + 1e-6
    points = np.stack(np.meshgrid(x, x, x, indexing="ij"), -1).reshape(-1, 3)
    for item in sample(category, 2, first=20):
        assert isinstance(item.solid, AnalyticSolid)
        metric = points * item.diagonal + item.solid.centre
        expected = np.zeros(len(points), dtype=bool)
        for primitive in item.solid.primitives:
            low, high = primitive.bounds()
            near = ((metric >= low) & (metric <= high)).all(axis=1)
            if near.any():
                expected[near] |= mesh_contains(primitive, metric[near])
        thick = item.voxels(n).ravel()
        assert (expected & ~thick).sum() <= 0.005 * expected.sum() + 2
        with monkeypatch.context() as patch:
            patch.setattr(shape_module, "MIN_HALF_VOXELS", 0.0)
            exact = item.voxels(n).ravel()
        # Round parts have coarse meshes inscribed in them: the difference is a thin rind.
        assert (expected & ~exact).sum() <= 0.005 * expected.sum() + 2
        assert (exact & ~expected).sum() <= 0.1 * expected.sum()


def test_voxels_keep_chair_legs_and_bicycle_frames_in_one_piece() -> None:
    from scipy.ndimage import label

    for category in ("chair", "bicycle", "diningtable", "motorbike", "tvmonitor"):
        for item in sample(category, 10):
            grid = item.voxels(32)
            pieces, count = label(grid, np.ones((3, 3, 3)))
            sizes = np.bincount(pieces.ravel())[1:]
            assert sizes.max() > 0.97 * sizes.sum(), (item.instance, count)
            low, high = item.vertices.min(axis=0), item.vertices.max(axis=0)
            occupied = np.argwhere(grid)
            assert (np.abs(occupied.min(axis=0) / 32 - 0.5 - low) < 1.7 / 32).all()
            assert (np.abs((occupied.max(axis=0) + 1) / 32 - 0.5 - high) < 1.7 / 32).all()


def test_voxels_of_any_size() -> None:
    item = shape_from_seed("car", 0)
    for n in (1, 7, 16, 64):
        assert item.voxels(n).shape == (n, n, n) and item.voxels(n).dtype == bool
    coarse = item.voxels(64).reshape(32, 2, 32, 2, 32, 2).mean(axis=(1, 3, 5)) >= 0.5
    assert voxel_iou(coarse, item.voxels(32)) > 0.85
    with pytest.raises(InputError, match="voxel grid size: got 0"):
        item.voxels(0)


def role_image(item: Shape, azimuth: float, n: int = 40) -> np.ndarray:
    """Roles seen from a viewpoint by parallel rays, -1 beside the object; azimuth 0 is the front."""
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    elevation = 0.2
    away = np.array([np.sin(azimuth) * np.cos(elevation), -np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
    right = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    t = voxel_centres(n)
    origins = 2 * away + (t[:, None, None] * right + t[None, :, None] * np.cross(away, right)).reshape(-1, 3)
    mesh = trimesh.Trimesh(item.vertices, item.faces, process=False)
    hit = RayMeshIntersector(mesh).intersects_first(origins, np.tile(-away, (len(origins), 1)))
    names = np.array([MATERIAL_ROLES.index(role) for role in item.parts])
    return np.where(hit < 0, -1, names[item.part[hit]]).reshape(n, n)


@pytest.mark.parametrize("category", ASYMMETRIC)
def test_front_and_back_look_different(category: str) -> None:
    """From the front, from the quarter and from the side: turned by half a turn, much of the picture changes role."""
    for item in sample(category, 12):
        assert item.symmetry == 1
        for azimuth in (0.0, 0.7):
            front, back = role_image(item, azimuth), role_image(item, azimuth + np.pi)
            seen = (front >= 0) | (back >= 0)
            assert (front != back)[seen].mean() > 0.15, (item.instance, azimuth)


@pytest.mark.parametrize("category", ASYMMETRIC)
def test_front_faces_minus_y(category: str) -> None:
    """What tells the front lies at -y, what tells the rear at +y."""
    front_roles = {"windscreen", "light_front", "display", "propeller", "screen"}
    rear_roles = {"grille", "label"} if category == "tvmonitor" else {"light_rear", "saddle"}
    for item in sample(category, 12):
        centre = item.vertices[item.faces].mean(axis=1)
        edge = item.vertices[item.faces[:, 1:]] - item.vertices[item.faces[:, :1]]
        area = np.linalg.norm(np.cross(edge[:, 0], edge[:, 1]), axis=-1)

        def middle(roles: set[str], item: Shape = item, centre: np.ndarray = centre, area: np.ndarray = area) -> float | None:
            mask = np.isin(item.part, [i for i, role in enumerate(item.parts) if role in roles])
            return float(np.average(centre[mask, 1], weights=area[mask])) if mask.any() else None

        if category in ("chair", "sofa"):  # the back rest: the highest voxels
            occupied = np.argwhere(item.voxels(32))
            high = occupied[occupied[:, 2] >= occupied[:, 2].max() - 2]
            assert high[:, 1].mean() > 15.5 + 2
            continue
        if category == "boat":  # the bow is pointed: the hull is narrower at -y
            hull = item.vertices[np.unique(item.faces[item.part == item.parts.index("hull")])]
            bow, stern = hull[hull[:, 1] < hull[:, 1].min() + 0.02], hull[hull[:, 1] > hull[:, 1].max() - 0.02]
            assert np.ptp(bow[:, 0]) < 0.5 * np.ptp(stern[:, 0])
            continue
        front, rear = middle(front_roles), middle(rear_roles)
        assert front is not None and front < (0.05 if category in ("aeroplane", "tvmonitor") else 0.0), item.instance
        assert rear is None or rear > front


@pytest.mark.parametrize("category", ["bottle", "diningtable"])
def test_declared_symmetry_holds(category: str) -> None:
    orders = set()
    for item in sample(category, 40):
        orders.add(item.symmetry)
        grid = item.voxels(48)
        half, quarter = (voxel_iou(grid, np.rot90(grid, k, axes=(0, 1))) for k in (2, 1))
        assert half > 0.97
        if item.symmetry in (0, 4):
            assert quarter > 0.97
        else:
            assert item.symmetry == 2 and quarter < 0.95
        radius = np.linalg.norm(item.vertices[:, :2], axis=1)
        if item.symmetry == 0:
            # Every corner of the mesh has company all around: as many in each eighth of the turn.
            angle = np.arctan2(item.vertices[:, 1], item.vertices[:, 0])[radius > 0.02]
            counts, _ = np.histogram(angle + 1e-3, bins=8, range=(-np.pi + 1e-3, np.pi + 1e-3))
            assert counts.min() > 0.9 * counts.max()
    assert orders == ({0, 4} if category == "bottle" else {0, 2, 4})


def test_bad_requests_are_refused() -> None:
    with pytest.raises(InputError, match="unknown category: got 'spoon', expected aeroplane, "):
        make_shape("spoon", np.random.default_rng(0))
    with pytest.raises(InputError, match="unknown category: got 'spoon'"):
        shape_from_seed("spoon", 1)
    with pytest.raises(InputError, match="seed of a shape: got -1"):
        shape_from_seed("car", -1)
