"""Colours of CAD faces from their materials and textures, as parts that the renderer paints."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from nolbo_ppl.errors import InputError
from nolbo_ppl.io.images import open_image
from nolbo_ppl.synthetic.assets.obj_file import ObjMesh

PALETTE = 48
"""Colours of a shape at most: a part of the renderer each."""
PLAIN = (0.6, 0.6, 0.6)
"""Display colour of faces whose material says nothing."""

Resource = Callable[[str], bytes | None]
"""Content of a file beside the model by its name, None where there is none."""
Colours = Float[np.ndarray, "f 3"]
"""Display colour of each face, 0 to 1."""


def read_materials(text: str) -> dict[str, tuple[tuple[float, float, float], str | None]]:
    """Diffuse colour and texture's file of each material of an MTL file; what cannot be read is passed over.

    Example:
        >>> read_materials("newmtl red\\nKd 1 0 0\\nnewmtl wood\\nmap_Kd -s 1 1 1 oak.png")
        {'red': ((1.0, 0.0, 0.0), None), 'wood': ((1.0, 1.0, 1.0), 'oak.png')}
    """
    found: dict[str, tuple[tuple[float, float, float], str | None]] = {}
    name = None
    for line in text.splitlines():
        key, _, rest = line.strip().partition(" ")
        rest = rest.strip()
        if key == "newmtl":
            name = rest
            found[name] = ((1.0, 1.0, 1.0), None)
        elif name is not None and key == "Kd":
            try:
                r, g, b = (min(max(float(word), 0.0), 1.0) for word in rest.split()[:3])
            except ValueError:
                continue
            found[name] = ((r, g, b), found[name][1])
        elif name is not None and key == "map_Kd" and rest:
            found[name] = (found[name][0], rest if not rest.startswith("-") else rest.split()[-1])
    return found


def sampled(texture: UInt8[np.ndarray, "h w 3"], at: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Colours of a texture that repeats, at (right, up) from its lower left corner; nearest pixel."""
    height, width = texture.shape[:2]
    u, v = np.nan_to_num(at[:, 0]) % 1.0, np.nan_to_num(at[:, 1]) % 1.0
    column = np.minimum((u * width).astype(int), width - 1)
    row = np.minimum(((1 - v) * height).astype(int), height - 1)
    return texture[row, column] / 255.0


def obj_colours(mesh: ObjMesh, resource: Resource) -> Colours | None:
    """Display colour of each face of an OBJ file; None where no material of it is found.

    Args:
        mesh: the file's content.
        resource: reads its libraries of materials and their textures.
    """
    materials: dict[str, tuple[tuple[float, float, float], str | None]] = {}
    folders: dict[str, PurePosixPath] = {}
    for library in mesh.libraries:
        data = resource(library)
        if data is not None:
            own = read_materials(data.decode("utf-8-sig", errors="replace"))
            materials.update(own)
            folders.update(dict.fromkeys(own, PurePosixPath(library.replace("\\", "/")).parent))
    if not any(name in materials for name in mesh.materials):
        return None
    colours = np.tile(PLAIN, (len(mesh.faces), 1)).astype(np.float64)
    for number, name in enumerate(mesh.materials):
        rows = np.flatnonzero(mesh.material == number)
        if name not in materials or not len(rows):
            continue
        diffuse, file = materials[name]
        colours[rows] = diffuse
        texture = None if file is None else _texture(str(folders[name] / file.replace("\\", "/")), resource)
        if texture is not None:
            colours[rows] = sampled(texture, mesh.texture[rows])
    return colours


def _texture(name: str, resource: Resource) -> UInt8[np.ndarray, "h w 3"] | None:
    """A texture; None where it is missing or no picture: the material's colour stands for it."""
    data = resource(name)
    if data is None:
        return None
    try:
        return open_image(io.BytesIO(data), label=name)
    except InputError:
        return None


def trimesh_colours(mesh: Any) -> Colours | None:
    """Display colour of each face of one of trimesh's meshes: texture, colour of its material, of its faces or vertices."""
    visual = getattr(mesh, "visual", None)
    if visual is None or not getattr(visual, "defined", False):
        return None
    faces = np.asarray(mesh.faces)
    material, uv = getattr(visual, "material", None), getattr(visual, "uv", None)
    if material is not None:
        base = getattr(material, "baseColorFactor", None)
        if base is None:
            base = getattr(material, "diffuse", None)
        factor = np.ones(3) if base is None else np.asarray(base, dtype=np.float64)[:3] / (255.0 if np.max(base) > 1 else 1.0)
        image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
        if base is None and image is None:
            return None
        colours = np.tile(factor, (len(faces), 1))
        if image is not None and uv is not None and len(uv) == len(mesh.vertices):
            colours = colours * sampled(np.asarray(image.convert("RGB")), np.asarray(uv, dtype=np.float64)[faces].mean(1)[:, :2])
        return colours
    own = np.asarray(visual.face_colors, dtype=np.float64)[:, :3] / 255.0
    return own if len(own) == len(faces) else None


def painted_parts(colours: Colours) -> tuple[Int[np.ndarray, " f"], tuple[str, ...]]:
    """Part of each face and the parts' names, `colour #rrggbb`, of at most `PALETTE` colours.

    Colours are binned finer and finer as long as there are few enough bins; each bin is its mean.

    Example:
        >>> painted_parts(np.array([[1.0, 0, 0], [1.0, 0, 0], [0, 0, 1.0]]))
        (array([1, 1, 0]), ('colour #0000ff', 'colour #ff0000'))
    """
    levels = 256
    while True:
        code = np.minimum((np.clip(colours, 0, 1) * levels).astype(int), levels - 1)
        _, part = np.unique(code, axis=0, return_inverse=True)
        part = part.reshape(-1)
        count = int(part.max()) + 1 if len(part) else 0
        if count <= PALETTE or levels <= 3:
            break
        levels = int(levels * 0.8)
    total = np.stack([np.bincount(part, colours[:, k], minlength=count) for k in range(3)], axis=1)
    mean = np.clip(total / np.bincount(part, minlength=count)[:, None], 0, 1)
    names = tuple("colour #" + "".join(f"{round(255 * v):02x}" for v in row) for row in mean)
    return part.astype(np.int64), names
