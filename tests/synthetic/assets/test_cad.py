"""CAD folders: layouts, formats, axes, open and broken meshes, archives with ready voxels."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.voxels import pack_voxels, unpack_voxels, voxel_iou
from nolbo_ppl.synthetic.assets.cad import axis_rotation, load_cad_folder
from nolbo_ppl.synthetic.assets.cad_mesh import GridSolid, mesh_to_shape
from nolbo_ppl.synthetic.assets.cad_sizes import DEFAULT_DIAGONAL, TYPICAL_DIAGONAL, typical_diagonal
from nolbo_ppl.synthetic.assets.obj_file import read_obj
from nolbo_ppl.synthetic.shapes import shape_from_seed

FORMATS = ("off", "obj", "ply", "glb")


def wedge() -> trimesh.Trimesh:
    """A closed body without symmetry: 3 long to the front (-y), 2 wide, 1 high, thin in front."""
    mesh = trimesh.creation.box((2.0, 3.0, 1.0))
    front_top = (mesh.vertices[:, 1] < 0) & (mesh.vertices[:, 2] > 0)
    mesh.vertices[front_top, 2] = -0.3
    mesh.vertices += (5.0, -7.0, 2.0)
    return mesh


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    trimesh.Trimesh(vertices, faces, process=False).export(path)


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("flat", [False, True])
def test_round_trip_through_files(tmp_path: Path, suffix: str, flat: bool) -> None:
    mesh = wedge()
    file = tmp_path / f"car_beetle.{suffix}" if flat else tmp_path / "car" / f"beetle.{suffix}"
    file.parent.mkdir(exist_ok=True)
    stored = mesh.copy()
    if suffix == "glb":  # y up, front to z, by its standard
        stored.vertices = stored.vertices @ axis_rotation("+y", "+z")
    stored.export(file)
    (shape,) = load_cad_folder(tmp_path)
    assert (shape.category, shape.instance, shape.parts, shape.symmetry) == ("car", "car-beetle", ("body",), 1)
    assert (shape.part == 0).all() and len(shape.part) == len(shape.faces) == 12
    assert shape.diagonal == TYPICAL_DIAGONAL["car"]
    low, high = shape.vertices.min(axis=0), shape.vertices.max(axis=0)
    assert np.allclose(low + high, 0, atol=1e-6) and np.linalg.norm(high - low) == pytest.approx(1.0)
    assert np.allclose(high - low, np.array([2, 3, 1]) / np.sqrt(14), atol=1e-6)
    # Front (-y) is low, back is high, as in the file.
    front = shape.vertices[shape.vertices[:, 1] < 0]
    assert front[:, 2].max() < 0 < shape.vertices[shape.vertices[:, 1] > 0][:, 2].max()
    scaled = mesh.copy()
    scaled.vertices = (mesh.vertices - mesh.bounds.mean(axis=0)) / mesh.scale
    x = (np.arange(32) + 0.5) / 32 - 0.5 + 1e-5
    points = np.stack(np.meshgrid(x, x, x, indexing="ij"), -1).reshape(-1, 3)
    assert voxel_iou(shape.voxels(32), scaled.contains(points).reshape(32, 32, 32)) > 0.85


def test_folders_may_be_deep_and_mixed(tmp_path: Path) -> None:
    for name in ("car/a/model.obj", "car/b/model.obj", "bus/one.off", "fire_extinguisher_red_2.ply", "gizmo_7.glb"):
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        wedge().export(file)
    (tmp_path / "readme.txt").write_text("not a mesh")
    shapes = load_cad_folder(tmp_path)
    names = sorted((s.category, s.instance) for s in shapes)
    assert names == [
        ("bus", "bus-one"),
        ("car", "car-a-model"),
        ("car", "car-b-model"),
        ("fire_extinguisher", "fire_extinguisher-red_2"),
        ("gizmo", "gizmo-7"),
    ]
    assert [s.instance for s in load_cad_folder(tmp_path, categories=["bus", "gizmo"])] == ["bus-one", "gizmo-7"]
    assert {s.category: s.diagonal for s in shapes}["gizmo"] == DEFAULT_DIAGONAL
    assert load_cad_folder(tmp_path, ["car"], diagonals={"car": 3.3})[0].diagonal == 3.3


@pytest.mark.parametrize(("up", "front"), [("+y", "+z"), ("+z", "+x"), ("-x", "+y"), ("+y", "-x")])
def test_axes_are_turned(tmp_path: Path, up: str, front: str) -> None:
    turn = axis_rotation(up, front)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    axis = {s + n: (1 if s == "+" else -1) * np.eye(3)[i] for s in "+-" for i, n in enumerate("xyz")}
    assert np.allclose(turn @ axis[up], (0, 0, 1)) and np.allclose(turn @ axis[front], (0, -1, 0))
    mesh = wedge()
    mesh.vertices[:, 0] += 0.3 * mesh.vertices[:, 1]  # no mirror symmetry either
    (tmp_path / "canonical").mkdir()
    (tmp_path / "turned").mkdir()
    mesh.export(tmp_path / "canonical" / "car_a.ply")
    mesh.vertices = mesh.vertices @ turn  # the inverse rotation: into the other frame
    mesh.export(tmp_path / "turned" / "car_a.ply")
    (expected,), (got,) = (
        load_cad_folder(tmp_path / "canonical"),
        load_cad_folder(tmp_path / "turned", up=up, front=front),
    )
    assert np.allclose(got.vertices, expected.vertices, atol=1e-6)


def test_obj_counts_from_either_end_of_what_was_read(tmp_path: Path) -> None:
    """Parts whose faces count back from the last vertex, with materials in between, are the same shape as absolute ones."""
    parts = [trimesh.creation.box((1, 1, 0.2)), trimesh.creation.box((1, 0.2, 1)).apply_translation((0, 0.4, 0.6))]
    absolute, relative, first = "", "mtllib a.mtl\n", 0
    for part in parts:
        lines = "".join("v {} {} {}\n".format(*v) for v in part.vertices)
        absolute += lines + "".join("f {} {} {}\n".format(*(f + first + 1)) for f in part.faces)
        back = part.faces - len(part.vertices)
        relative += lines + "usemtl same\n" + "".join("f {}/1/1 {}/1/1 {}/1/1\n".format(*f) for f in back)
        first += len(part.vertices)
    for name, text in (("a", absolute), ("b", relative)):
        (tmp_path / f"chair_{name}.obj").write_text(text)
    one, two = load_cad_folder(tmp_path)
    assert voxel_iou(one.voxels(32), two.voxels(32)) == 1.0
    np.testing.assert_array_equal(read_obj(tmp_path / "chair_a.obj")[1], read_obj(tmp_path / "chair_b.obj")[1])
    (tmp_path / "chair_edges.obj").write_text(absolute + "f 1 2\nf 3\nl 1 2 3\n")  # as modellers write edges without a surface
    np.testing.assert_array_equal(read_obj(tmp_path / "chair_a.obj")[1], read_obj(tmp_path / "chair_edges.obj")[1])
    (tmp_path / "chair_edges.obj").unlink()
    (tmp_path / "chair_c.obj").write_text("v 0 0 0\nv 1 0 0\nf -1 -2 -3\n")
    with pytest.raises(InputError, match=r"chair_c\.obj:3: not a vertex or face of an OBJ file: got 'f -1 -2 -3'"):
        load_cad_folder(tmp_path)


def test_the_same_shape_in_every_format(tmp_path: Path) -> None:
    """GLB is y up by its standard, also with parts placed by transforms; the voxels are those of the OFF, all of them."""
    mesh = wedge()
    mesh.vertices[:, 0] += 0.3 * mesh.vertices[:, 1]
    mesh.export(tmp_path / "car_a.off")
    scene = trimesh.Scene()
    turned = axis_rotation("+y", "+z").T @ np.diag([1.0, 1, 1])
    for k, rows in enumerate((mesh.faces[:6], mesh.faces[6:])):
        part = trimesh.Trimesh(mesh.vertices, rows, process=False)
        place = np.eye(4)
        place[:3, :3] = turned
        scene.add_geometry(part, node_name=f"part{k}", transform=place)
    scene.export(tmp_path / "car_b.glb")
    off, glb = load_cad_folder(tmp_path)
    assert voxel_iou(off.voxels(32), glb.voxels(32)) == 1.0
    (lying,) = load_cad_folder(tmp_path, categories=["car"], up="+z", front="-y")[1:]
    assert voxel_iou(off.voxels(32), lying.voxels(32)) < 0.6


def test_parts_of_a_scene_stay_in_their_places(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    scene.add_geometry(box, transform=trimesh.transformations.translation_matrix((0, 0, 0)))
    scene.add_geometry(box, transform=trimesh.transformations.translation_matrix((4, 0, 0)))
    scene.export(tmp_path / "car_pair.glb")
    (shape,) = load_cad_folder(tmp_path)
    assert np.allclose(np.ptp(shape.vertices, axis=0), np.array([5, 1, 1]) / np.sqrt(27), atol=1e-6)
    assert not shape.voxels(32)[16].any()


def test_open_mesh_with_a_slit_is_solid_and_one_without_a_side_is_a_shell(tmp_path: Path) -> None:
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    lidless = box.faces[box.face_normals[:, 2] < 0.5]
    write_ply(tmp_path / "chair_open.ply", box.vertices, lidless)
    slit = box.vertices.copy()
    apart = np.concatenate([box.vertices[box.faces[:6]].reshape(-1, 3) * 0.999, slit[box.faces[6:]].reshape(-1, 3)])
    write_ply(tmp_path / "chair_slit.ply", apart, np.arange(36).reshape(-1, 3))
    opened, slitted = load_cad_folder(tmp_path)
    assert not opened.voxels(32)[16, 16, 16] and opened.voxels(32)[16, 16].any()
    assert slitted.voxels(32)[16, 16, 16]
    again = opened.voxels(32)
    again[:] = True
    assert not opened.voxels(32).all()  # the kept grid is not handed out


def test_thin_rods_survive(tmp_path: Path) -> None:
    rod = trimesh.creation.cylinder(radius=0.002, height=1.0, sections=6)
    rod.apply_transform(trimesh.transformations.rotation_matrix(0.6, (1, 0.3, 0.2)))
    rod.export(tmp_path / "chair_rod.ply")
    (shape,) = load_cad_folder(tmp_path)
    from scipy.ndimage import label

    grid = shape.voxels(32)
    assert label(grid, np.ones((3, 3, 3)))[1] == 1
    assert np.linalg.norm(np.ptp(np.argwhere(grid), axis=0) + 1) > 30


def test_parametric_shape_survives_the_trip_through_a_file(tmp_path: Path) -> None:
    least = {"car": 0.8, "sofa": 0.8, "boat": 0.65, "bottle": 0.85}
    for category in least:
        shape = shape_from_seed(category, 3)
        write_ply(tmp_path / f"{category}_x.ply", shape.vertices * 7 + 1, shape.faces)
    for shape in load_cad_folder(tmp_path):
        original = shape_from_seed(shape.category, 3)
        assert np.allclose(np.ptp(shape.vertices, axis=0), np.ptp(original.vertices, axis=0), atol=1e-5)
        assert voxel_iou(shape.voxels(32), original.voxels(32)) > least[shape.category], shape.category


def test_symmetry_is_measured_where_the_category_declares_one() -> None:
    cylinder = trimesh.creation.cylinder(radius=0.3, height=1.0, sections=48)
    square, oblong = trimesh.creation.box((1, 1, 0.6)), trimesh.creation.box((1.5, 0.7, 0.6))
    lame = trimesh.util.concatenate([oblong, trimesh.creation.box((0.4, 0.7, 1.6)).apply_translation((0.55, 0, 0))])

    def order(category: str, mesh: trimesh.Trimesh) -> int:
        return mesh_to_shape(category, "x", np.array(mesh.vertices), np.array(mesh.faces)).symmetry

    assert [order("diningtable", m) for m in (cylinder, square, oblong, lame)] == [0, 4, 2, 1]
    assert [order("bottle", m) for m in (cylinder, square)] == [0, 4]
    assert [order("car", m) for m in (cylinder, square)] == [1, 1]
    assert [order("gizmo", m) for m in (cylinder, square, oblong)] == [0, 1, 1]


def test_large_meshes_are_simplified() -> None:
    ball = trimesh.creation.icosphere(subdivisions=5)
    vertices, faces = np.array(ball.vertices), np.array(ball.faces)
    full = mesh_to_shape("gizmo", "x", vertices, faces)
    small = mesh_to_shape("gizmo", "x", vertices, faces, max_faces=2000)
    assert len(full.faces) == len(faces) and 200 < len(small.faces) <= 2000
    assert np.linalg.norm(np.ptp(small.vertices, axis=0)) == pytest.approx(1.0)
    assert len(small.part) == len(small.faces) and small.faces.max() == len(small.vertices) - 1
    assert voxel_iou(full.voxels(32), small.voxels(32)) > 0.9


def test_bad_meshes_are_named(tmp_path: Path) -> None:
    vertices, faces = np.eye(3), np.array([[0, 1, 2]])
    cases = {
        "car_text.off": (b"this is no mesh", r"car_text\.off: unreadable CAD file"),
        "car_cut.glb": (b"glTF\x02\x00\x00\x00\xff\x00\x00\x00", r"car_cut\.glb: unreadable CAD file"),
        "car_points.obj": (b"v 0 0 0\nv 1 0 0\n", r"car_points\.obj: (CAD mesh without faces|unreadable)"),
        "car_flat.obj": (b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", r"car_flat\.obj: degenerate CAD mesh"),
        "car_dot.obj": (b"v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", r"car_dot\.obj: degenerate CAD mesh"),
        "car_nan.obj": (
            b"v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n",
            r"car_nan\.obj: CAD mesh with vertices that are NaN",
        ),
    }
    for name, (content, message) in cases.items():
        folder = tmp_path / name.partition(".")[0]
        folder.mkdir()
        (folder / name).write_bytes(content)
        with pytest.raises(InputError, match=message):
            load_cad_folder(folder)
    with pytest.raises(InputError, match=r"faces past its vertices: got 3, expected < 3"):
        mesh_to_shape("car", "x", vertices, faces + 1)


def test_bad_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere: no such folder"):
        load_cad_folder(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"no CAD model found.*CATEGORY/NAME\.EXT"):
        load_cad_folder(tmp_path)
    wedge().export(tmp_path / "beetle.obj")
    with pytest.raises(InputError, match=r"category is not told: got beetle\.obj"):
        load_cad_folder(tmp_path)
    (tmp_path / "beetle.obj").rename(tmp_path / "car_beetle.obj")
    with pytest.raises(InputError, match=r"models of bus, train"):
        load_cad_folder(tmp_path, categories=["train", "bus"])
    with pytest.raises(InputError, match=r"up axis: got '\+w'"):
        load_cad_folder(tmp_path, up="w")
    with pytest.raises(InputError, match=r"got \+z and -z, expected two different axes"):
        load_cad_folder(tmp_path, front="-z")
    with pytest.raises(InputError, match="max_faces: got 2"):
        load_cad_folder(tmp_path, max_faces=2)
    with pytest.raises(InputError, match="box diagonal of car: got 0"):
        load_cad_folder(tmp_path, diagonals={"car": 0})
    wedge().export(tmp_path / "car_beetle.ply")
    with pytest.raises(InputError, match=r"two CAD models of one name: got car_beetle\.ply and car_beetle\.obj"):
        load_cad_folder(tmp_path)


def test_sizes_are_metres_of_every_category() -> None:
    from nolbo_ppl.categories import CATEGORIES

    assert set(CATEGORIES) <= set(TYPICAL_DIAGONAL)
    for category in CATEGORIES:  # the parametric families agree with the table to a factor of four
        median = np.median([shape_from_seed(category, seed).diagonal for seed in range(21)])
        assert 1 / 4 < median / typical_diagonal(category) < 4


def write_archive(folder: Path, names: list[str], broken: str | None = None) -> dict[str, np.ndarray]:
    """Write an archive of parametric shapes; the mesh of `broken` has lost its upper half."""
    meshes, solids, meta = {}, {}, {}
    for name in names:
        shape = shape_from_seed(name.rstrip("0123456789"), 5)
        faces = shape.faces
        if name == broken:
            faces = faces[shape.vertices[faces].max(axis=1)[:, 2] < 0]
        used, index = np.unique(faces, return_inverse=True)
        meshes[f"{name}_v"] = shape.vertices[used].astype(np.float32)
        meshes[f"{name}_f"] = index.reshape(-1, 3).astype(np.uint16)
        solids[name] = shape.voxels(64)
        box = np.stack([shape.vertices.min(axis=0), shape.vertices.max(axis=0)])
        meta[name] = {"category": shape.category, "bbox_min": box[0].tolist(), "bbox_max": box[1].tolist()}
    np.savez(folder / "meshes.npz", **meshes)
    packed = np.stack([pack_voxels(solids[name]) for name in names])
    np.savez(folder / "voxels64.npz", names=np.array(names), solid=packed)
    (folder / "meta.json").write_text(json.dumps(meta))
    return solids


def test_archive_uses_its_own_voxels(tmp_path: Path) -> None:
    solids = write_archive(tmp_path, ["car01", "chair02", "bottle03"], broken="chair02")
    car, chair, bottle = load_cad_folder(tmp_path)
    assert [s.instance for s in (car, chair, bottle)] == ["car01", "chair02", "bottle03"]
    assert [s.symmetry for s in (car, chair)] == [1, 1] and bottle.symmetry in (0, 4)
    assert (car.voxels(64) == solids["car01"]).all()
    assert voxel_iou(car.voxels(32), shape_from_seed("car", 5).voxels(32)) > 0.85
    # The mesh without its upper half is replaced by the surface of the voxels, in the frame of that surface.
    assert np.linalg.norm(np.ptp(chair.vertices, axis=0)) == pytest.approx(1.0)
    assert np.ptp(chair.vertices[:, 2]) > 0.5
    assert voxel_iou(chair.voxels(32), shape_from_seed("chair", 5).voxels(32)) > 0.5
    occupied = np.argwhere(chair.voxels(64))
    assert np.abs(occupied.min(axis=0) / 64 - 0.5 - chair.vertices.min(axis=0)).max() < 2 / 64
    assert np.abs((occupied.max(axis=0) + 1) / 64 - 0.5 - chair.vertices.max(axis=0)).max() < 2 / 64
    assert [s.category for s in load_cad_folder(tmp_path, ["bottle"])] == ["bottle"]


def test_malformed_archive_is_refused(tmp_path: Path) -> None:
    write_archive(tmp_path, ["car01"])
    meta = json.loads((tmp_path / "meta.json").read_text())
    (tmp_path / "meta.json").write_text(json.dumps({"bus09": meta["car01"]}))
    with pytest.raises(InputError, match="malformed CAD archive: got KeyError: 'bus09'"):
        load_cad_folder(tmp_path)
    (tmp_path / "meta.json").write_text("{")
    with pytest.raises(InputError, match=r"meta\.json:1: not valid JSON"):
        load_cad_folder(tmp_path)
    (tmp_path / "meta.json").write_text(json.dumps(meta))
    for content in (b"PK\x03\x04 cut", b"", b"no archive"):
        (tmp_path / "meshes.npz").write_bytes(content)
        with pytest.raises(InputError, match=r"meshes\.npz: .*(NPZ|empty)"):
            load_cad_folder(tmp_path)


def test_grid_solid_keeps_its_voxels_at_its_own_size() -> None:
    grid = np.random.default_rng(0).random((64, 64, 64)) < 0.1
    solid = GridSolid(pack_voxels(grid), 64)
    assert (solid.fill(64) == grid).all()
    assert solid.fill(32).shape == (32, 32, 32)


def test_real_archive(data_dir: Path) -> None:
    folder = data_dir / "objectnet3d_cad"
    if not folder.is_dir():
        pytest.skip(f"no CAD archive at {folder}")
    categories = ["aeroplane", "bottle", "bus", "car", "chair", "diningtable", "sofa", "train"]
    shapes = load_cad_folder(folder, categories)
    assert {s.category for s in shapes} == set(categories)
    meta = json.loads((folder / "meta.json").read_text())
    with np.load(folder / "voxels64.npz", allow_pickle=False) as file:
        solids = dict(zip(file["names"].tolist(), file["solid"]))
    for shape in shapes:
        low, high = shape.vertices.min(axis=0), shape.vertices.max(axis=0)
        assert np.abs(low + high).max() < 1e-9 and np.linalg.norm(high - low) == pytest.approx(1.0)
        assert voxel_iou(shape.voxels(64), unpack_voxels(solids[shape.instance], 64)) > 0.5
        assert (shape.symmetry == 1) or shape.category in ("bottle", "diningtable")
        nose = meta[shape.instance]["keypoints"].get("noselanding")
        if nose is not None:
            assert nose[1] < 0  # the front faces -y
