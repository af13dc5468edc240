"""Voxel grids: packing, overlap, marching cubes, resampling, and filling of meshes."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.voxels import (
    mesh_to_voxels,
    pack_voxels,
    reduce_voxels,
    unpack_voxels,
    voxel_centres,
    voxel_iou,
    voxels_to_mesh,
)


def ball(n: int, radius: float) -> np.ndarray:
    x = voxel_centres(n)
    return x[:, None, None] ** 2 + x[None, :, None] ** 2 + x[None, None, :] ** 2 <= radius**2


def edge_balance(faces: np.ndarray) -> bool:
    """Whether each directed edge is matched by exactly one reversed edge: a closed, consistently wound surface."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forward = sorted(map(tuple, edges.tolist()))
    return forward == sorted(map(tuple, edges[:, ::-1].tolist())) and len(set(forward)) == len(forward)


@pytest.mark.parametrize("n", [3, 8, 11])
def test_packing_round_trip(n: int) -> None:
    grids = np.random.default_rng(n).random((4, n, n, n)) < 0.3
    packed = pack_voxels(grids)
    assert packed.shape == (4, (n**3 + 7) // 8) and packed.dtype == np.uint8
    assert (unpack_voxels(packed, n) == grids).all()
    assert (unpack_voxels(packed[2], n) == grids[2]).all()


def test_packed_bits_are_in_c_order_with_the_first_bit_highest() -> None:
    grid = np.zeros((4, 4, 4), dtype=bool)
    grid[1, 2, 3] = True
    index = (1 * 4 + 2) * 4 + 3
    packed = pack_voxels(grid)
    assert packed[index // 8] == 1 << (7 - index % 8) and packed.sum() == packed[index // 8]


def test_packing_refuses_other_input() -> None:
    with pytest.raises(InputError, match=r"shape \(4, 4, 5\).*expected \[\.\.\., n, n, n\]"):
        pack_voxels(np.zeros((4, 4, 5), dtype=bool))
    with pytest.raises(InputError, match=r"float64.*expected bool.*threshold"):
        pack_voxels(np.zeros((4, 4, 4)))
    with pytest.raises(InputError, match=r"uint8 \(9,\), expected uint8 \[\.\.\., 8\] for a 4\^3 grid"):
        unpack_voxels(np.zeros(9, dtype=np.uint8), 4)


def test_iou_counts_voxels() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.random((2, 5, 6, 6, 6)) < 0.4
    brute = []
    for p, q in zip(a.reshape(5, -1).tolist(), b.reshape(5, -1).tolist()):
        both = sum(u and v for u, v in zip(p, q))
        brute.append(both / (sum(p) + sum(q) - both))
    assert np.allclose(voxel_iou(a, b), brute, atol=1e-15)
    empty = np.zeros((6, 6, 6), dtype=bool)
    assert voxel_iou(empty, empty) == 1.0
    assert voxel_iou(empty, a[0]) == 0.0
    with pytest.raises(InputError, match="different sizes"):
        voxel_iou(empty, np.zeros((5, 5, 5), dtype=bool))


def test_marching_cubes_finds_the_sphere() -> None:
    n, radius = 48, 0.35
    x = voxel_centres(n)
    distance = np.sqrt(x[:, None, None] ** 2 + x[None, :, None] ** 2 + x[None, None, :] ** 2)
    occupancy = 1 / (1 + np.exp((distance - radius) * n))  # one half exactly on the sphere
    vertices, faces = voxels_to_mesh(occupancy)
    assert np.abs(np.linalg.norm(vertices, axis=1) - radius).max() < 0.1 / n
    triangle = vertices[faces]
    volume = np.einsum("fi,fi->", triangle[:, 0], np.cross(triangle[:, 1], triangle[:, 2])) / 6
    assert volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.01)  # positive: wound outwards
    assert edge_balance(faces)


def test_marching_cubes_of_one_voxel_is_around_it() -> None:
    grid = np.zeros((8, 8, 8), dtype=bool)
    grid[1, 4, 6] = True
    vertices, faces = voxels_to_mesh(grid)
    assert np.allclose(vertices.mean(0), voxel_centres(8)[[1, 4, 6]])
    assert len(faces) == 8


def test_marching_cubes_closes_a_full_grid() -> None:
    vertices, faces = voxels_to_mesh(np.ones((5, 5, 5), dtype=bool))
    assert edge_balance(faces)
    assert np.allclose([vertices.min(), vertices.max()], [-0.5, 0.5])


def test_marching_cubes_of_nothing_is_empty() -> None:
    vertices, faces = voxels_to_mesh(np.full((6, 6, 6), 0.2))
    assert vertices.shape == (0, 3) and faces.shape == (0, 3)
    assert faces.dtype == np.int64


def test_marching_cubes_refuses_other_input() -> None:
    with pytest.raises(InputError, match="NaN or infinity"):
        voxels_to_mesh(np.full((4, 4, 4), np.nan))
    with pytest.raises(InputError, match=r"shape \(4, 4, 3\)"):
        voxels_to_mesh(np.zeros((4, 4, 3)))
    with pytest.raises(InputError, match=r"level of the surface: got 1\.0"):
        voxels_to_mesh(np.zeros((4, 4, 4)), level=1.0)


def test_reducing_to_the_same_size_changes_nothing() -> None:
    grid = np.random.default_rng(1).random((16, 16, 16)) < 0.3
    assert (reduce_voxels(grid, 16) == grid).all()
    assert (reduce_voxels(reduce_voxels(grid, 48), 16) == grid).all()


@pytest.mark.parametrize(("m", "expected_overlap"), [(96, 0.999), (64, 0.96), (128, 0.97), (75, 0.9)])
def test_reducing_keeps_the_size_of_solids(m: int, expected_overlap: float) -> None:
    """A ball has no thin part: what counts is whether the centre of a voxel lies in it."""
    assert voxel_iou(reduce_voxels(ball(m, 0.37), 32), ball(32, 0.37)) > expected_overlap


@pytest.mark.parametrize("k", [2, 3, 4, 5])
@pytest.mark.parametrize("offset", range(5))
def test_reducing_keeps_rods_and_plates(k: int, offset: int) -> None:
    """Whatever their thickness and however they lie to the voxels, none vanishes or breaks."""
    n = 12
    for thick in range(1, 2 * k):
        rod, plate = np.zeros((2, n * k, n * k, n * k), dtype=bool)
        first = 4 * k + offset
        rod[:, first : first + thick, first : first + thick] = True
        plate[:, :, first : first + thick] = True
        low, high = first // k, (first + thick - 1) // k
        small = reduce_voxels(rod, n)
        assert small.any(axis=(1, 2)).all()
        assert not np.delete(small, np.arange(low, high + 1), axis=1).any()
        small = reduce_voxels(plate, n)
        assert small.any(axis=2).all()
        assert not np.delete(small, np.arange(low, high + 1), axis=2).any()


def test_reducing_keeps_a_leg_on_its_table() -> None:
    fine = np.zeros((96, 96, 96), dtype=bool)
    fine[10:80, 10:80, 61:72] = True
    fine[40:42, 40:42, 5:61] = True
    small = reduce_voxels(fine, 32)
    assert small[13, 13, 2:24].all()


def test_reducing_follows_a_moved_and_scaled_frame() -> None:
    moved = reduce_voxels(ball(64, 0.2), 32, centre=(0.1, -0.05, 0.0), scale=0.8)
    x = voxel_centres(32)
    expected = (
        (0.8 * x[:, None, None] + 0.1) ** 2 + (0.8 * x[None, :, None] - 0.05) ** 2 + (0.8 * x[None, None, :]) ** 2
    ) <= 0.2**2
    assert voxel_iou(moved, expected) > 0.85
    outside = reduce_voxels(np.ones((8, 8, 8), dtype=bool), 8, scale=2.0)
    assert outside.sum() == 4**3  # beyond the fine grid there is nothing


def test_closed_mesh_is_filled() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.4)
    grid = mesh_to_voxels(mesh.vertices, mesh.faces, 32)
    assert grid[ball(32, 0.39)].all()
    assert not grid[~ball(32, 0.4 + np.sqrt(3) / 2 / 32 + 1e-9)].any()
    assert voxel_iou(reduce_voxels(mesh_to_voxels(mesh.vertices, mesh.faces, 96), 32), ball(32, 0.4)) > 0.93


def test_winding_does_not_matter_for_filling() -> None:
    mesh = trimesh.creation.box((0.6, 0.4, 0.5))
    turned = mesh.faces.copy()
    turned[::2] = turned[::2, ::-1]
    expected = mesh_to_voxels(mesh.vertices, mesh.faces, 24)
    assert (mesh_to_voxels(mesh.vertices, turned, 24) == expected).all()
    assert expected[12, 12, 12] and not expected[0].any()


def test_slender_triangles_leave_no_gap() -> None:
    vertices = np.array([[-0.45, -0.4, -0.3], [0.45, 0.41, 0.33], [0.45, 0.42, 0.33]])
    grid = mesh_to_voxels(vertices, np.array([[2, 0, 1]]), 64)
    for share in np.linspace(0, 1, 500):
        point = vertices[0] + share * (vertices[1] - vertices[0])
        near = np.floor((point + 0.5) * 64).astype(int)
        window = tuple(slice(i - 1, i + 2) for i in near)
        assert grid[window].any()
    assert grid.sum() < 400


def test_open_mesh_stays_a_shell_and_a_small_hole_is_closed() -> None:
    mesh = trimesh.creation.box((0.6, 0.6, 0.6))
    keep = mesh.face_normals[:, 2] < 0.5
    lidless = mesh_to_voxels(mesh.vertices, mesh.faces[keep], 32)
    assert not lidless[16, 16, 16] and lidless[16, 16, 6]
    # A slit of two voxels and a half along the edge of the lid.
    lid = trimesh.creation.box((0.6, 0.6, 1e-3))
    lid.apply_translation((2.5 / 32, 0, 0.3))
    slit = trimesh.util.concatenate([trimesh.Trimesh(mesh.vertices, mesh.faces[keep], process=False), lid])
    leaking, closed = (mesh_to_voxels(slit.vertices, slit.faces, 32, gap=gap) for gap in (0, 1))
    assert not leaking[16, 16, 16] and closed[16, 16, 16]


def test_mesh_outside_the_box_is_left_out() -> None:
    mesh = trimesh.creation.box((0.2, 0.2, 0.2))
    assert not mesh_to_voxels(mesh.vertices + 2.0, mesh.faces, 16).any()
    assert not mesh_to_voxels(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), 16).any()
