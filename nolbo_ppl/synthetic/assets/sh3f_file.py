"""Furniture libraries of Sweet Home 3D (`.sh3f`): a ZIP archive of OBJ models with a catalogue of names, sizes and licences.

The catalogue is a Java properties file, `PluginFurnitureCatalog.properties`, with numbered entries: `name#1`, `model#1` (a path
in the archive), `width#1`, `depth#1`, `height#1` in cm, `modelRotation#1` (3 x 3, by rows), `creator#1`, `license#1`. Models have
y up and face +z. Creator and licence of an entry, or else of the library, go with each shape into the data set's description.
"""

from __future__ import annotations

import os
import posixpath
import re
import zipfile
from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.errors import NolboError, input_error
from nolbo_ppl.io.files import existing_file
from nolbo_ppl.synthetic.assets.cad_mesh import mesh_to_shape
from nolbo_ppl.synthetic.assets.face_colours import obj_colours
from nolbo_ppl.synthetic.assets.obj_file import parse_obj
from nolbo_ppl.synthetic.shapes.canonical_shape import Shape

CATALOGUE = "PluginFurnitureCatalog.properties"
MAXIMUM_BYTES = 1 << 26
"""Larger files of an archive are not unpacked."""
WORDS = {
    "chair": ("chair", "armchair", "stool"), "sofa": ("sofa", "couch"), "diningtable": ("table",),
    "tvmonitor": ("tv", "television", "monitor", "screen"), "bottle": ("bottle",), "bicycle": ("bicycle", "bike"),
    "bus": ("bus",), "car": ("car",), "motorbike": ("motorbike", "motorcycle", "scooter"), "boat": ("boat", "sailboat", "ship"),
    "aeroplane": ("aeroplane", "airplane", "plane"), "train": ("train", "locomotive"),
}  # fmt: skip
"""Words of English names by category."""
NOT_OF = ("lamp", "cloth", "pool", "tennis", "stand", "wheelchair", "bed", "for", "with")
"""Names with these words are of other things than their nouns say: a table lamp, a pool table."""
TO_CANONICAL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""From y up, front to +z, to z up, front to -y."""


def read_properties(text: str) -> dict[str, str]:
    """Keys and values of a Java properties file: comments, continued lines, `=` or `:`, and `\\uXXXX`.

    Example:
        >>> read_properties("# two\\nname#1=Chaise \\\\u00e0 bras\\nwidth#1: 60")
        {'name#1': 'Chaise à bras', 'width#1': '60'}
    """
    found: dict[str, str] = {}
    for line in re.sub(r"\\\r?\n[ \t]*", "", text).splitlines():
        entry = line.strip()
        if not entry or entry[0] in "#!":
            continue
        parts = re.split(r"(?<!\\)[=:]", entry, maxsplit=1)
        value = parts[1].strip() if len(parts) > 1 else ""
        value = re.sub(r"\\u([0-9a-fA-F]{4})", lambda m: chr(int(m[1], 16)), value)
        found[parts[0].strip()] = re.sub(r"\\(.)", r"\1", value)
    return found


def category_of(name: str) -> str | None:
    """Category of an English name, None where it is none of the twelve.

    Example:
        >>> category_of("Round dining table"), category_of("Table lamp"), category_of("Fridge")
        ('diningtable', None, None)
    """
    words = re.findall(r"[a-z]+", name.lower())
    if any(word in NOT_OF for word in words):
        return None
    for category, known in WORDS.items():
        if any(word in known for word in words):
            return category
    return None


def load_sh3f(
    path: str | os.PathLike[str], categories: Collection[str] | None = None, max_faces: int | None = 20_000
) -> list[Shape]:
    """The models of an archive whose names tell one of our categories, in real size, with their colours and licences.

    Args:
        path: the archive.
        categories: only these.
        max_faces: meshes with more faces are simplified.

    Raises:
        InputError: no such archive, no catalogue, or no model of these categories; an entry that cannot be read, naming it.
    """
    file = existing_file(path)
    try:
        with zipfile.ZipFile(file) as archive:
            shapes = list(_shapes(archive, file, CATEGORIES if categories is None else categories, max_faces))
    except NolboError:
        raise
    except Exception as error:  # damaged, encrypted, packed in another way: zipfile and zlib raise what they run into
        raise input_error("not a furniture library", got=error, expected="a ZIP archive with a catalogue", file=file) from None
    if not shapes:
        raise input_error("no model of the wanted categories", expected=", ".join(sorted(WORDS)), file=file)
    return shapes


def _read(archive: zipfile.ZipFile, name: str) -> bytes | None:
    """A file of the archive; None where there is none, or a huge one."""
    try:
        info = archive.getinfo(posixpath.normpath(name.lstrip("/")))
    except KeyError:
        return None
    if info.file_size > MAXIMUM_BYTES:
        return None
    data = archive.open(info).read(MAXIMUM_BYTES + 1)
    return data if len(data) <= MAXIMUM_BYTES else None


def _shapes(archive: zipfile.ZipFile, file: Path, wanted: Collection[str], max_faces: int | None) -> Iterator[Shape]:
    data = _read(archive, CATALOGUE)
    if data is None:
        raise input_error("a furniture library without a catalogue", expected=CATALOGUE, file=file)
    catalogue = read_properties(data.decode("latin-1"))  # the encoding of Java's properties
    numbers = sorted({int(m[1]) for key in catalogue if (m := re.fullmatch(r"name#(\d+)", key))})
    for number in numbers:
        entry = {key.partition("#")[0]: value for key, value in catalogue.items() if key.endswith(f"#{number}")}
        category = category_of(entry["name"])
        model = entry.get("model", "").replace("!/", "/")
        if category is None or category not in wanted or not model.lower().endswith(".obj"):
            continue
        content = _read(archive, model)
        if content is None:
            raise input_error(f"model of entry {number}", got=model, expected="a file of the archive", file=file)
        mesh = parse_obj(content.decode("utf-8-sig", errors="replace"), Path(f"{file}!{model}"))
        folder = posixpath.dirname(model)
        colours = obj_colours(mesh, lambda name, folder=folder: _read(archive, posixpath.join(folder, name)))  # type: ignore[misc]
        size = _size(entry, number, file)
        vertices = _placed(mesh.vertices, entry, size, number, file)
        slug = re.sub(r"[^a-z0-9]+", "-", entry["name"].lower()).strip("-")
        stated = [entry.get(key) or catalogue.get(key) for key in ("creator", "license")]
        yield mesh_to_shape(
            category,
            f"{category}-{number:04d}-{slug}",
            vertices,
            mesh.faces,
            max_faces,
            {category: float(np.linalg.norm(size))},
            colours=colours,
            licence=", ".join(value for value in stated if value),
            file=f"{file}!{model}",
        )


def _size(entry: dict[str, str], number: int, file: Path) -> np.ndarray:
    """Width, depth, height, m."""
    try:
        size = np.array([float(entry[name]) / 100 for name in ("width", "depth", "height")])
        if not (np.isfinite(size).all() and (size > 0).all()):
            raise ValueError
        return size
    except (KeyError, ValueError):
        got = {name: entry.get(name) for name in ("width", "depth", "height")}
        raise input_error(f"size of entry {number}", got=got, expected="positive numbers of cm", file=file) from None


def _placed(vertices: np.ndarray, entry: dict[str, str], size: np.ndarray, number: int, file: Path) -> np.ndarray:
    """Vertices turned to the canonical frame and stretched to the entry's size."""
    rotation = np.eye(3)
    if entry.get("modelRotation"):
        try:
            rotation = np.array([float(word) for word in entry["modelRotation"].split()]).reshape(3, 3)
        except ValueError:
            raise input_error(
                f"modelRotation of entry {number}", got=entry["modelRotation"], expected="nine numbers", file=file
            ) from None
    turned = vertices @ (TO_CANONICAL @ rotation).T
    if not len(turned) or not np.isfinite(turned).all():
        raise input_error(f"model of entry {number}", got="vertices: none, or not finite", expected="finite numbers", file=file)
    extent = np.ptp(turned, axis=0)
    return turned * np.where(extent > 1e-9 * extent.max(), size / np.maximum(extent, 1e-30), 1.0)
