"""Drives read back: true poses, objects and what each frame shows, with errors that name file and line."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import is_rotation
from nolbo_ppl.io.camera_files import read_camera
from nolbo_ppl.io.fields import is_number, is_whole, number_array
from nolbo_ppl.io.files import read_json, read_json_object, read_jsonl
from nolbo_ppl.io.npz import read_voxels
from nolbo_ppl.io.scenes import image_field, parse_record
from nolbo_ppl.io.text import read_times
from nolbo_ppl.io.trajectories import read_trajectory
from nolbo_ppl.structures.annotations import Annotations
from nolbo_ppl.synthetic.dataset_writer import DRIVE, SCENES
from nolbo_ppl.synthetic.worlds.sequence_folder import INTRINSICS, OBJECTS, TIMES, TRUTH, VOXELS, read_image


@dataclass(frozen=True)
class SequenceObject:
    """One true object of a drive."""

    id: str
    category: str
    instance: str
    symmetry: int
    T_world_object: Float[np.ndarray, "4 4"]
    """Pose of its box centre; of a moving object, in the first frame."""
    diagonal: float
    """Box diagonal, m."""
    dimensions: Float[np.ndarray, " 3"]
    """Side lengths of the box, m."""
    moving: bool


@dataclass(frozen=True)
class SequenceFolder:
    """A drive folder."""

    path: Path
    intrinsics: Float[np.ndarray, " 4"]
    size: tuple[int, int]
    """Width and height of the images, px."""
    T_world_camera: Float[np.ndarray, "n 4 4"]
    times: Float[np.ndarray, " n"]
    objects: tuple[SequenceObject, ...]
    frames: tuple[Annotations, ...]
    """What each frame shows; every object has the `id` of `objects`."""
    facts: dict[str, Any]
    """The content of `drive.json`."""

    def __len__(self) -> int:
        return len(self.frames)

    def image(self, frame: int) -> UInt8[np.ndarray, "h w 3"]:
        """The image of a frame."""
        file = self.frames[frame].file
        assert file is not None  # it was found when the folder was read
        return read_image(file)

    def voxels(self) -> dict[str, UInt8[np.ndarray, " bytes"]]:
        """Packed 32^3 occupancy of each instance; see `nolbo_ppl.geometry.voxels.unpack_voxels`."""
        return read_voxels(self.path / VOXELS)


def read_objects(path: str | os.PathLike[str]) -> tuple[SequenceObject, ...]:
    """Read `objects.json`.

    Raises:
        InputError: missing, malformed, or an entry lacks something; names the entry.
    """
    rows = read_json(path)
    if not isinstance(rows, list):
        raise input_error("true objects", got=type(rows).__name__, expected="a list of objects", file=path)
    found: list[SequenceObject] = []
    for number, row in enumerate(rows):
        where = f"entry {number}: "
        if not isinstance(row, dict) or not isinstance(row.get("id"), str):
            raise input_error(where + "id", got=row, expected='an object with a name "id"', file=path)
        if row.get("category") not in CATEGORIES:
            raise input_error(where + "category", got=row.get("category"), expected=", ".join(CATEGORIES), file=path)
        T = number_array(row.get("T_world_object"), (4, 4))
        if T is None or not bool(is_rotation(T[:3, :3], tolerance=1e-3)):
            raise input_error(where + "T_world_object", got=row.get("T_world_object"), expected="a 4 x 4 pose", file=path)
        dimensions, diagonal = number_array(row.get("dimensions"), (3,)), row.get("diagonal")
        if dimensions is None or (dimensions <= 0).any() or not is_number(diagonal, 1e-9):
            got = f"{row.get('dimensions')}, {row.get('diagonal')}"
            raise input_error(where + "dimensions, diagonal", got=got, expected="metres", file=path)
        symmetry = row.get("symmetry", 1)
        if not is_whole(symmetry):
            raise input_error(where + "symmetry", got=symmetry, expected="1 none, n n-fold, 0 free", file=path)
        found.append(
            SequenceObject(
                row["id"],
                row["category"],
                str(row.get("instance", "")),
                symmetry,
                T,
                float(diagonal),
                dimensions,
                bool(row.get("moving", False)),
            )
        )
    if len({thing.id for thing in found}) != len(found):
        raise input_error("true objects", got="two with one id", expected="each id once", file=path)
    return tuple(found)


def read_sequence_folder(path: str | os.PathLike[str]) -> SequenceFolder:
    """Read a drive folder; images are read when asked for.

    Raises:
        InputError: not a complete drive, or a file of it is malformed; names file and line.
    """
    path = Path(path)
    if not (path / SCENES).is_file() or not (path / DRIVE).is_file():
        raise input_error(
            "not a complete drive",
            got=path,
            expected=f"a folder with {DRIVE} and {SCENES}",
            do="write it with nolbo drive --out, which also resumes a drive that was stopped",
        )
    camera = read_camera(path / INTRINSICS)
    if camera.width is None or camera.height is None:
        raise input_error("intrinsics without the images' size", expected='"width" and "height"', file=path / INTRINSICS)
    intrinsics, size = camera.vector, (camera.width, camera.height)
    objects = read_objects(path / OBJECTS)
    poses = read_trajectory(path / TRUTH).T_world_camera
    times = read_times(path / TIMES)
    frames = tuple(_frames(path, size, {thing.id for thing in objects}))
    if not len(frames) == len(poses) == len(times):
        raise input_error(
            "lengths differ", got=f"{len(frames)} frames, {len(poses)} poses, {len(times)} times", expected="equal", file=path
        )
    return SequenceFolder(path, intrinsics, size, poses, times, objects, frames, read_json_object(path / DRIVE))


def _frames(path: Path, size: tuple[int, int], known: set[str]) -> list[Annotations]:
    file, frames = path / SCENES, []
    for line, row in read_jsonl(file):
        record = parse_record(row, file, line, CATEGORIES, size, image_field(row, path, file, line))
        unknown = [str(name) for name in record.id if name not in known]
        if unknown:
            raise input_error("id", got=unknown[0], expected=f"one of {OBJECTS}", file=file, line=line)
        frames.append(record)
    return frames
