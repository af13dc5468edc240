"""Colours of CAD files (OBJ with MTL and textures, GLB) and libraries of Sweet Home 3D, from files made here."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from nolbo_ppl.errors import InputError
from nolbo_ppl.synthetic.assets.cad import axis_rotation, load_cad_folder
from nolbo_ppl.synthetic.assets.face_colours import PALETTE, painted_parts
from nolbo_ppl.synthetic.assets.shape_library import ShapeLibrary
from nolbo_ppl.synthetic.renderer.materials import sample_material
from nolbo_ppl.synthetic.scenes.scene_config import preset
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator
from nolbo_ppl.synthetic.shapes.canonical_shape import Shape

OBJ = """mtllib parts.mtl
{vertices}
vt 0.25 0.25
vt 0.75 0.75
usemtl red
f 1 2 3 4
f 5 8 7 6
usemtl picture
f 1/1 5/1 6/1 2/1
f 2/2 6/2 7/2 3/2
usemtl lost
f 3 7 8 4
f 4 8 5 1
"""
MTL = "newmtl red\nKd 1 0 0\nnewmtl picture\nKd 1 1 1\nmap_Kd pictures/four.png\n"


def box_obj(width: float, height: float, depth: float) -> str:
    """A box with y up: x across, y high, z deep."""
    x, y, z = width / 2, height / 2, depth / 2
    corners = [(-x, -y, -z), (x, -y, -z), (x, y, -z), (-x, y, -z), (-x, -y, z), (x, -y, z), (x, y, z), (-x, y, z)]
    return OBJ.format(vertices="\n".join(f"v {a} {b} {c}" for a, b, c in corners))


def four_colours() -> bytes:
    """Blue below left, green above right, black elsewhere."""
    pixels = np.zeros((8, 8, 3), dtype=np.uint8)
    pixels[4:, :4], pixels[:4, 4:] = (0, 0, 255), (0, 255, 0)
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG")
    return stream.getvalue()


COLOURS = {"colour #ff0000", "colour #0000ff", "colour #00ff00", "colour #999999"}


def area_of(shape: Shape, name: str) -> float:
    """Area of a part, in squared diagonals."""
    a, b, c = (shape.vertices[shape.faces[shape.part == shape.parts.index(name)][:, k]] for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def test_materials_and_textures_of_obj_files(tmp_path: Path) -> None:
    folder = tmp_path / "car"
    (folder / "pictures").mkdir(parents=True)
    (folder / "one.obj").write_text(box_obj(2, 1, 4))
    (folder / "parts.mtl").write_text(MTL)
    (folder / "pictures" / "four.png").write_bytes(four_colours())
    (shape,) = load_cad_folder(tmp_path, up="+y")
    assert set(shape.parts) == COLOURS and sorted(np.bincount(shape.part).tolist()) == [2, 2, 4, 4]
    scale = 1 / np.linalg.norm([2, 1, 4]) ** 2
    assert area_of(shape, "colour #ff0000") == pytest.approx(2 * 2 * 1 * scale)  # front and back: 2 x 1 each
    assert area_of(shape, "colour #0000ff") == pytest.approx(2 * 4 * scale)  # the underside: 2 x 4
    (folder / "pictures" / "four.png").write_bytes(b"no picture")  # the material's own colour stands for it
    assert "colour #ffffff" in load_cad_folder(tmp_path, up="+y")[0].parts
    (folder / "parts.mtl").write_text(MTL.replace("pictures/four.png", "../../four.png"))  # out of the folder: not read
    assert "colour #ffffff" in load_cad_folder(tmp_path, up="+y")[0].parts
    (folder / "parts.mtl").unlink()
    assert load_cad_folder(tmp_path, up="+y")[0].parts == ("body",)


def test_simplified_meshes_keep_their_colours(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(4)
    top = ball.triangles_center[:, 2] > 0
    ball.visual.face_colors = np.where(top[:, None], [255, 0, 0, 255], [0, 0, 255, 255]).astype(np.uint8)
    (tmp_path / "bottle").mkdir()
    ball.export(tmp_path / "bottle" / "ball.ply")
    (shape,) = load_cad_folder(tmp_path, max_faces=600)
    assert len(shape.faces) <= 600 and set(shape.parts) == {"colour #ff0000", "colour #0000ff"}
    middle = shape.vertices[shape.faces].mean(1)[:, 2]
    red = shape.part == shape.parts.index("colour #ff0000")
    assert middle[red].min() > -0.05 and middle[~red].max() < 0.05


def test_textures_of_glb_files(tmp_path: Path) -> None:
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    box.unmerge_vertices()
    uv = np.where(np.repeat(np.arange(12) < 6, 3)[:, None], 0.25, 0.75) * np.ones((36, 2))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.open(io.BytesIO(four_colours())))
    box.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    box.vertices = box.vertices @ axis_rotation("+y", "+z")
    (tmp_path / "chair").mkdir()
    box.export(tmp_path / "chair" / "box.glb")
    (shape,) = load_cad_folder(tmp_path)
    assert set(shape.parts) == {"colour #0000ff", "colour #00ff00"}
    assert np.bincount(shape.part).tolist() == [6, 6]


def test_many_colours_become_few() -> None:
    colours = np.random.default_rng(0).random((500, 3))
    part, names = painted_parts(colours)
    assert len(names) <= PALETTE and len(part) == 500
    painted = np.array([[int(name[k : k + 2], 16) / 255 for k in (8, 10, 12)] for name in names])[part]
    assert np.abs(painted - colours).max() < 0.35
    material = sample_material("colour #804020", np.random.default_rng(1))
    assert material.albedo == pytest.approx([(v / 255) ** 2.2 for v in (0x80, 0x40, 0x20)])


CATALOGUE = """# furniture
license=CC0
id#1=a
name#1=Dining table
model#1=/models/table/table.obj
width#1=180
depth#1=90
height#1=75
creator#1=N. N.
license#1=CC BY 3.0
name#2=Table lamp
model#2=/models/lamp.obj
width#2=20
depth#2=20
height#2=40
name#3=Armchair \\u00e0 la mode
model#3=/models/chair.obj
width#3=80
depth#3=60
height#3=100
modelRotation#3=0 0 1 0 1 0 -1 0 0
"""


def library(path: Path, catalogue: str = CATALOGUE) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("PluginFurnitureCatalog.properties", catalogue)
        archive.writestr("models/table/table.obj", box_obj(2, 1, 1))
        archive.writestr("models/table/parts.mtl", MTL)
        archive.writestr("models/table/pictures/four.png", four_colours())
        archive.writestr("models/chair.obj", box_obj(3, 5, 4))  # turned by a quarter: 4 across, 3 deep
    return path


def test_furniture_libraries(tmp_path: Path) -> None:
    table, chair = sorted(load_cad_folder(library(tmp_path / "some.sh3f")), key=lambda shape: shape.category, reverse=True)
    assert (table.category, table.instance, table.licence) == ("diningtable", "diningtable-0001-dining-table", "N. N., CC BY 3.0")
    assert (chair.category, chair.licence, chair.parts) == ("chair", "CC0", ("body",))
    np.testing.assert_allclose(table.dimensions, [1.8, 0.9, 0.75])
    np.testing.assert_allclose(chair.dimensions, [0.8, 0.6, 1.0])
    assert set(table.parts) == COLOURS
    low = table.vertices[:, 2].min()  # the texture's lower left quarter lies on the underside (y down in the file)
    underside = np.isclose(table.vertices[table.faces][:, :, 2], low).all(1)
    assert {table.parts[k] for k in table.part[underside]} == {"colour #0000ff"}
    described = ShapeLibrary(cad=[table, chair]).describe()
    assert described["licences"] == {table.instance: table.licence, chair.instance: chair.licence}
    source = SceneGenerator(preset("easy", 64), seed=0, cad=(table, chair))
    assert source.render(1).image.shape == (64, 64, 3)


def test_damaged_libraries_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text.sh3f").write_text("no archive")
    with pytest.raises(InputError, match="not a furniture library"):
        load_cad_folder(tmp_path / "text.sh3f")
    for name, old, new, message in (
        ("size", "width#1=180", "width#1=wide", "size of entry 1"),
        ("model", "table/table.obj", "table/none.obj", "model of entry 1"),
        ("turn", "0 0 1 0 1 0 -1 0 0", "0 0 1", "modelRotation of entry 3"),
        ("none", "name#", "title#", "no model of the wanted categories"),
    ):
        with pytest.raises(InputError, match=message):
            load_cad_folder(library(tmp_path / f"{name}.sh3f", CATALOGUE.replace(old, new)))
    torn, name = tmp_path / "torn.sh3f", "PluginFurnitureCatalog.properties"
    with zipfile.ZipFile(torn, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, CATALOGUE)
    data = bytearray(torn.read_bytes())
    data[30 + len(name)] = 0xFF  # the first packed byte, behind the header of 30 bytes: no such kind of block
    torn.write_bytes(data)
    with pytest.raises(InputError, match="not a furniture library"):
        load_cad_folder(torn)
    data = bytearray(library(tmp_path / "shifted.sh3f", CATALOGUE).read_bytes())
    start = int.from_bytes(data[-6:-2], "little") + 100  # the catalogue of the archive: entries then begin before the file does
    data[-6:-2] = start.to_bytes(4, "little")
    torn.write_bytes(data)
    with pytest.raises(InputError, match="not a furniture library"):
        load_cad_folder(torn)
    with zipfile.ZipFile(tmp_path / "empty.sh3f", "w") as archive:
        archive.writestr("other", "")
    with pytest.raises(InputError, match="without a catalogue"):
        load_cad_folder(tmp_path / "empty.sh3f")
