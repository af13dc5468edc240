"""The layout of BOP: images of rigid objects with known models and true poses, YCB-Video among them.

`ROOT/SPLIT/SCENE/` has scene_gt.json (poses), scene_camera.json, scene_gt_info.json (boxes, visible shares), rgb/ or gray/, and
depth/; `ROOT/models*/` has models_info.json and obj_000001.ply. Lengths are mm, here m. T. Hodan et al.: BOP: Benchmark for 6D
Object Pose Estimation, ECCV 2018.

A model's frame is its object's frame: z up; which side is the front nobody says. The camera is that of OpenCV: p_camera =
R p_model + t, and the first pixel's centre is (0, 0), half a pixel from this library's. Boxes are (x, y, width, height) between
the middles of their outermost pixels.
"""

from __future__ import annotations

import re
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nolbo_ppl.data.converters.bop_models import BopModel, length_of, numbers_of, object_names, read_models
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import inverse, is_rotation, make_pose, nearest_rotation
from nolbo_ppl.io.fields import is_whole
from nolbo_ppl.io.files import atomic_path, read_json, read_json_object, write_json, write_jsonl
from nolbo_ppl.io.images import IMAGE_SUFFIXES, image_size, is_passed_over, open_depth_image
from nolbo_ppl.io.npz import save_npz
from nolbo_ppl.io.scenes import annotations_record
from nolbo_ppl.io.trajectories import Trajectory, write_trajectory
from nolbo_ppl.structures.annotations import Annotations

GROUND_TRUTH, CAMERAS, INFORMATION = "scene_gt.json", "scene_camera.json", "scene_gt_info.json"
"""Files of a scene."""
MINIMUM_VISIBILITY = 0.1
"""Objects of which less is seen are no targets of BOP's evaluation."""
PIXEL_CENTRE = 0.5
"""Where the centre of the first pixel lies in this library's coordinates; it is 0 in BOP's."""
COLUMNS = ("box", "category", "instance", "R_camera_object", "position", "dimensions", "visibility", "symmetry")
"""What is known of every object."""


@dataclass(frozen=True)
class BopImage:
    """One image with its labels and its camera."""

    scene: str
    """Its scene's folder."""
    number: int
    """Its number within the scene."""
    annotations: Annotations
    """Boxes, poses, sizes and visible shares of the objects; their category and instance is the object's name."""
    depth: Path | None
    """The depth image, where there is one."""
    metres_per_step: float
    """Metres of one step of the depth image."""
    T_world_camera: Float[np.ndarray, "4 4"] | None
    """Pose of the camera in its scene, m, where it is stated."""

    def depth_in_metres(self) -> Float[np.ndarray, "h w"] | None:
        """Depth along the optical axis, m, NaN where it is unknown; None without a depth image.

        Raises:
            InputError: the image cannot be read.
        """
        if self.depth is None:
            return None
        steps = open_depth_image(self.depth)
        return np.where(steps > 0, steps * self.metres_per_step, np.nan)


def _rotation(row: Mapping[str, Any], name: str, where: str, file: Path) -> np.ndarray:
    R = numbers_of(row, name, (3, 3), where, file)
    if not is_rotation(R):
        raise input_error(f"{where}{name}", got=R.tolist(), expected="a rotation", file=file)
    return nearest_rotation(R)


def scene_folders(root: str | PathLike[str], split: str) -> list[Path]:
    """Folders of a split's scenes, by number.

    Raises:
        InputError: no such split, or no scene in it; names the splits there are.
    """
    root = Path(root)
    found = [path.parent for path in sorted((root / split).glob(f"*/{GROUND_TRUTH}")) if not is_passed_over(path.parent)]
    if not found:
        raise input_error(
            "split of a data set of BOP", got=split, expected=f"one of {splits(root)}, with SCENE/{GROUND_TRUTH}", file=root
        )
    return found


def splits(root: Path) -> list[str]:
    """Names of the splits of a data set."""
    return sorted({path.parts[-3] for path in root.glob(f"*/*/{GROUND_TRUTH}")})


def read_targets(file: str | PathLike[str]) -> set[tuple[int, int]]:
    """Scene and image numbers of a list of targets (`test_targets_bop19.json`).

    Raises:
        InputError: names the file and the row.
    """
    rows = read_json(file)
    if not isinstance(rows, list):
        raise input_error("targets", got=type(rows).__name__, expected="a list", file=file)
    for number, row in enumerate(rows):
        if not isinstance(row, dict) or not (is_whole(row.get("scene_id")) and is_whole(row.get("im_id"))):
            raise input_error(f"[{number}]", got=row, expected='{"scene_id": 48, "im_id": 1, ...}', file=file)
    return {(row["scene_id"], row["im_id"]) for row in rows}


def read_bop(
    root: str | PathLike[str],
    split: str = "test",
    *,
    names: Sequence[str] | None = None,
    targets: set[tuple[int, int]] | None = None,
    every: int = 1,
    minimum_visibility: float = MINIMUM_VISIBILITY,
) -> Iterator[BopImage]:
    """Images of a split with their objects, by scene and number.

    Objects of which less is seen than `minimum_visibility` are regions to ignore, or nothing where none of it is in the image.

    Args:
        root: folder of the data set.
        split: `test`, `train_real`, `train_pbr`, ...
        names: of the objects, from number 1 on.
        targets: only these images, (scene, image).
        every: only every this many images of a scene.
        minimum_visibility: least visible share of an object.

    Raises:
        InputError: names file and field.
    """
    root = Path(root)
    models, called = read_models(root), object_names(root, names)
    for folder in scene_folders(root, split):
        yield from read_scene(folder, models, called, targets, every, minimum_visibility)


def read_scene(
    folder: Path,
    models: Mapping[int, BopModel],
    names: Mapping[int, str],
    targets: set[tuple[int, int]] | None = None,
    every: int = 1,
    minimum_visibility: float = MINIMUM_VISIBILITY,
) -> Iterator[BopImage]:
    """Images of one scene, as `read_bop`."""
    truth, cameras = read_json_object(folder / GROUND_TRUTH), read_json_object(folder / CAMERAS)
    about = read_json_object(folder / INFORMATION)
    pictures = _by_number(folder, ("rgb", "gray"))
    depths = _by_number(folder, ("depth",))
    for key in truth:
        if not key.isdecimal():
            raise input_error("number of an image", got=key, expected="digits", file=folder / GROUND_TRUTH)
    for number, key in sorted((int(key), key) for key in truth)[::every]:
        if targets is not None and (not folder.name.isdecimal() or (int(folder.name), number) not in targets):
            continue
        camera = cameras.get(key)
        if not isinstance(camera, dict):
            raise input_error(f"camera of image {key}", got=camera, expected='{"cam_K": [...]}', file=folder / CAMERAS)
        path = pictures.get(number)
        if path is None:
            raise input_error("image of an annotation", got=number, expected=f"rgb/{number:06d}.png or .jpg", file=folder)
        annotations = _annotations(folder, key, truth[key], about.get(key), camera, path, models, names, minimum_visibility)
        where = f"{key}."
        pose = None
        if "cam_R_w2c" in camera:
            R = _rotation(camera, "cam_R_w2c", where, folder / CAMERAS)
            pose = inverse(make_pose(R, numbers_of(camera, "cam_t_w2c", (3,), where, folder / CAMERAS) / 1000))
        step = length_of(camera, "depth_scale", where, folder / CAMERAS) / 1000 if "depth_scale" in camera else 1e-3
        if step <= 0:
            raise input_error(f"{where}depth_scale", got=camera["depth_scale"], expected="above 0", file=folder / CAMERAS)
        yield BopImage(folder.name, number, annotations, depths.get(number), step, pose)


def _by_number(folder: Path, names: Sequence[str]) -> dict[int, Path]:
    """Images of the first of some sub-folders that is there, by number."""
    place = next((folder / name for name in names if (folder / name).is_dir()), None)
    files = sorted(place.iterdir()) if place is not None else []
    fit = [path for path in files if path.suffix.lower() in IMAGE_SUFFIXES and path.stem.isdecimal()]
    return {int(path.stem): path for path in fit}


def intrinsics_of(camera: Mapping[str, Any], where: str, file: Path) -> Float[np.ndarray, " 4"]:
    """[fx, fy, cx, cy], px, the first pixel's centre at (0.5, 0.5)."""
    K = numbers_of(camera, "cam_K", (3, 3), where, file)
    if K[0, 0] <= 0 or K[1, 1] <= 0 or np.abs(K[[0, 1, 2, 2], [1, 0, 0, 1]]).max() > 1e-6 or K[2, 2] != 1:
        raise input_error(f"{where}cam_K", got=K.tolist(), expected="[fx, 0, cx, 0, fy, cy, 0, 0, 1] without skew", file=file)
    return np.array([K[0, 0], K[1, 1], K[0, 2] + PIXEL_CENTRE, K[1, 2] + PIXEL_CENTRE])


def _annotations(
    folder: Path,
    key: str,
    rows: Any,
    about: Any,
    camera: Mapping[str, Any],
    path: Path,
    models: Mapping[int, BopModel],
    names: Mapping[int, str],
    minimum_visibility: float,
) -> Annotations:
    """The objects of one image."""
    truth_file, about_file = folder / GROUND_TRUTH, folder / INFORMATION
    if not isinstance(rows, list):
        raise input_error(f"image {key}", got=rows, expected="a list of objects", file=truth_file)
    if not isinstance(about, list) or len(about) != len(rows):
        got = len(about) if isinstance(about, list) else about
        raise input_error(f"image {key}", got=got, expected=f"{len(rows)} objects, as in {GROUND_TRUTH}", file=about_file)
    width, height = image_size(path)
    limit = np.array([width, height, width, height], dtype=np.float64)
    found: dict[str, Any] = {name: [] for name in COLUMNS}
    ignore = []
    for place, (row, info) in enumerate(zip(rows, about)):
        where = f"{key}[{place}]."
        if not isinstance(row, dict) or not isinstance(info, dict):
            raise input_error(where[:-1], got=row, expected='{"obj_id": 1, ...}', file=truth_file)
        number = row.get("obj_id")
        if not is_whole(number) or number not in models:
            raise input_error(f"{where}obj_id", got=number, expected="an object of models_info.json", file=truth_file)
        model = models[number]
        R = _rotation(row, "cam_R_m2c", where, truth_file)
        position = R @ model.centre + numbers_of(row, "cam_t_m2c", (3,), where, truth_file) / 1000
        share = length_of(info, "visib_fract", where, about_file)
        x, y, w, h = numbers_of(info, "bbox_obj", (4,), where, about_file)
        if not -1e-6 <= share <= 1 + 1e-6:
            raise input_error(f"{where}visib_fract", got=share, expected="a share from 0 to 1", file=about_file)
        box = np.clip([x, y, x + w + 1, y + h + 1], 0, limit)
        if w <= 0 or h <= 0 or box[0] >= box[2] or box[1] >= box[3] or share <= 0:
            continue  # nothing of it is in the image
        if share < minimum_visibility or position[2] <= 0:
            ignore.append(box)
            continue
        name = names.get(number, f"obj_{number:06d}")
        one = (box, name, name, R, position, model.dimensions, min(share, 1.0), model.symmetry)
        for values, value in zip(found.values(), one):
            values.append(value)
    intrinsics = intrinsics_of(camera, f"{key}.", folder / CAMERAS)
    return Annotations.from_arrays(intrinsics, **found, ignore=ignore, file=path)


def write_bop(
    out: str | PathLike[str], images: Iterator[BopImage], source: Mapping[str, Any], shapes: Mapping[str, np.ndarray]
) -> dict[str, int]:
    """Write scenes: images, scenes.jsonl, voxels.npz, source.json (its `categories` are the names that occur), and the path of
    the camera of every scene whose poses are stated, `trajectories/SCENE.txt`, times being numbers of images.

    Args:
        out: folder, made when missing.
        images: what the data set holds.
        source: where it came from.
        shapes: packed bits of the occupancy of each object, by name.

    Returns:
        Counts: `images`, `objects`, `ignore`.

    Raises:
        InputError: no image.
    """
    out, lines, counts = Path(out), [], Counter[str]()
    paths: dict[str, list[BopImage]] = {}
    for image in images:
        file = image.annotations.file
        assert file is not None
        name = f"images/{image.scene}-{image.number:06d}{file.suffix.lower()}"
        with atomic_path(out / name) as temporary:
            shutil.copyfile(file, temporary)
        lines.append(annotations_record(image.annotations, name))
        counts.update(images=1, objects=len(image.annotations), ignore=len(image.annotations.ignore))
        paths.setdefault(image.scene, []).append(image)
    if not lines:
        raise input_error("no image", got=source.get("split"), expected="at least one annotated image")
    for scene, part in paths.items():
        poses = [one.T_world_camera for one in part if one.T_world_camera is not None]
        if len(poses) == len(part):
            times = np.array([one.number for one in part], dtype=np.float64)
            write_trajectory(out / "trajectories" / f"{scene}.txt", Trajectory(np.array(poses), times, "tum"))
    occurring = sorted({thing["category"] for line in lines for thing in line["objects"]})
    if shapes:
        save_npz(out / "voxels.npz", dict(shapes))
    numbers = {name: counts[name] for name in ("images", "objects", "ignore")}
    write_json(out / "source.json", {"kind": "bop", **source, **numbers, "categories": occurring})
    write_jsonl(out / "scenes.jsonl", lines)
    return numbers


def looks_like_bop(names: frozenset[str], root: Path) -> bool:
    """Whether a folder is a data set of BOP, by the names in it."""
    kinds = [name for name in sorted(names) if re.match(r"(train|val|test)(_|$)", name)]
    return any(name.startswith("models") for name in names) and any(any((root / k).glob(f"*/{GROUND_TRUTH}")) for k in kinds)
