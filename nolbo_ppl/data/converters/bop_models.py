"""The objects of a data set in the layout of BOP: their names, boxes, symmetries and meshes (`models_info.json`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import is_rotation
from nolbo_ppl.io.fields import is_number, number_array
from nolbo_ppl.io.files import read_json_object

YCB_VIDEO = (
    "002_master_chef_can", "003_cracker_box", "004_sugar_box", "005_tomato_soup_can", "006_mustard_bottle",
    "007_tuna_fish_can", "008_pudding_box", "009_gelatin_box", "010_potted_meat_can", "011_banana", "019_pitcher_base",
    "021_bleach_cleanser", "024_bowl", "025_mug", "035_power_drill", "036_wood_block", "037_scissors", "040_large_marker",
    "051_large_clamp", "052_extra_large_clamp", "061_foam_brick",
)  # fmt: skip
"""The 21 objects of YCB-Video, in the order of their numbers from 1."""
LARGEST = 1e6
"""Largest length taken from a file, mm."""


@dataclass(frozen=True)
class BopModel:
    """One object of a data set."""

    centre: Float[np.ndarray, " 3"]
    """Centre of its box in its own frame, m."""
    dimensions: Float[np.ndarray, " 3"]
    """Sides of that box, m."""
    symmetry: int
    """About its vertical axis: 0 free, n n-fold, 1 none. Symmetries about other axes are left out."""


def object_names(root: Path, names: Sequence[str] | None = None) -> Mapping[int, str]:
    """Names of objects by number: given ones from 1 on, those of YCB-Video where the folder is it; others are `obj_000001`."""
    if names is None and (root / "camera_uw.json").is_file():
        names = YCB_VIDEO
    return dict(enumerate(names or (), start=1))


def model_folder(root: Path) -> Path:
    """Folder of the models: `models`, else the first of another type.

    Raises:
        InputError: none has a models_info.json.
    """
    found = [path.parent for path in sorted(root.glob("models*/models_info.json"))]
    if not found:
        raise input_error("not a data set of BOP", got="no models", expected="models/models_info.json", file=root)
    return found[0]


def read_models(root: str | PathLike[str]) -> dict[int, BopModel]:
    """Boxes and symmetries of all objects by number.

    Raises:
        InputError: names file and field.
    """
    file = model_folder(Path(root)) / "models_info.json"
    models = {}
    for key, row in read_json_object(file).items():
        if not key.isdecimal() or not isinstance(row, dict):
            raise input_error("an object of models_info.json", got=key, expected='{"1": {"size_x": ...}}', file=file)
        low = [length_of(row, f"min_{axis}", f"{key}.", file) for axis in "xyz"]
        size = [length_of(row, f"size_{axis}", f"{key}.", file) for axis in "xyz"]
        if min(size) <= 0:
            raise input_error(f"{key}.size", got=size, expected="above 0 mm", file=file)
        dimensions = np.array(size) / 1000
        models[int(key)] = BopModel(np.array(low) / 1000 + dimensions / 2, dimensions, _symmetry(row, key, file))
    if not models:
        raise input_error("a data set without objects", file=file)
    return models


def _symmetry(row: Mapping[str, Any], key: str, file: Path) -> int:
    """Symmetry about the vertical axis, of `symmetries_continuous` and `symmetries_discrete`."""
    for field in ("symmetries_continuous", "symmetries_discrete"):
        if not isinstance(row.get(field, []), list):
            raise input_error(f"{key}.{field}", got=row[field], expected="a list", file=file)
    for number, one in enumerate(row.get("symmetries_continuous", [])):
        axis = number_array(one.get("axis") if isinstance(one, dict) else None, (3,))
        if axis is None or not np.linalg.norm(axis) > 0:
            got = f"axis {None if axis is None else axis.tolist()}"
            raise input_error(f"{key}.symmetries_continuous[{number}]", got=got, expected='{"axis": [x, y, z]}', file=file)
        if abs(axis[2]) > 0.999 * np.linalg.norm(axis):
            return 0
    turns = 1
    for number, one in enumerate(row.get("symmetries_discrete", [])):
        matrix = number_array(one, (16,))
        if matrix is None or not is_rotation(matrix.reshape(4, 4)[:3, :3], 1e-2):
            raise input_error(f"{key}.symmetries_discrete[{number}]", got=one, expected="a rigid motion of 16 numbers", file=file)
        turns += bool(abs(matrix[10]) > 0.999 and matrix[10] > 0 and matrix[0] < 0.999)  # z stays, x turns
    return turns


def length_of(row: Mapping[str, Any], name: str, where: str, file: Path) -> float:
    """A finite number of a field."""
    value = row.get(name)
    if not is_number(value, -LARGEST, LARGEST):
        raise input_error(f"{where}{name}", got=value, expected="a number", file=file)
    return float(value)


def numbers_of(row: Mapping[str, Any], name: str, shape: tuple[int, ...], where: str, file: Path) -> np.ndarray:
    """Finite numbers of a field, in BOP's row-wise lists."""
    value = number_array(row.get(name), (int(np.prod(shape)),))
    if value is None:
        raise input_error(f"{where}{name}", got=row.get(name), expected=f"{np.prod(shape)} finite numbers", file=file)
    return value.reshape(shape)


def model_files(root: str | PathLike[str], names: Sequence[str] | None = None) -> dict[str, Path]:
    """The mesh of every object by its name.

    Raises:
        InputError: a mesh is missing.
    """
    root = Path(root)
    folder, called = model_folder(root), object_names(root, names)
    found = {called.get(number, f"obj_{number:06d}"): folder / f"obj_{number:06d}.ply" for number in sorted(read_models(root))}
    for name, file in found.items():
        if not file.is_file():
            raise input_error(f"mesh of {name}", got="no such file", expected=file.name, file=folder)
    return found
