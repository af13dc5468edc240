"""Files of a map: landmarks, the association of every detection, voxels of the shapes, where EM stood after each iteration."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import R_WORLD_UPRIGHT, make_pose, matrix_to_quaternion, quaternion_to_matrix
from nolbo_ppl.io.fields import is_number, number_array
from nolbo_ppl.io.files import read_json, read_jsonl, write_json, write_jsonl
from nolbo_ppl.io.npz import Npz, save_npz
from nolbo_ppl.structures.association_table import AssociationTable
from nolbo_ppl.structures.landmark import Landmark

Voxels = tuple[Float[np.ndarray, "v v v"], Float[np.ndarray, "v v v"]]
"""Mean occupancy probability and its variance, per voxel of the canonical grid."""
MAX_VALUE = 1e9
"""Largest coordinate, m, size or variance of a landmark that can be shown."""
MAX_VOXELS = 128
"""Longest side of a decoded shape that is shown."""
MIN_PROBABILITY = 1e-6
"""Categories of less are left out of files."""


# -- landmarks.json -----------------------------------------------------------------------------------------------------


def landmark_record(landmark: Landmark) -> dict[str, Any]:
    """One landmark as JSON, without what is not known."""
    row: dict[str, Any] = {"name": landmark.name, "position": landmark.position.tolist()}
    if np.isfinite(landmark.position_covariance).all():
        row["position_covariance"] = landmark.position_covariance.tolist()
    for name in ("existence", "detections"):
        if np.isfinite(getattr(landmark, name)):
            row[name] = getattr(landmark, name)
    if landmark.frames is not None:
        row["first_frame"], row["last_frame"] = landmark.frames
    if landmark.oriented:
        row["rotation"] = matrix_to_quaternion(landmark.T_world_object[:3, :3]).tolist()
        if np.isfinite(landmark.covariance[:3, :3]).all():
            row["rotation_covariance"] = landmark.covariance[:3, :3].tolist()
    if landmark.category is not None:
        row["category"] = landmark.category
    if landmark.class_posterior:
        row["class_posterior"] = {c: p for c, p in landmark.class_posterior.items() if p > MIN_PROBABILITY}
    if landmark.latent is not None and landmark.latent_variance is not None:
        row["latent"] = landmark.latent.tolist()
        row["latent_std"] = np.sqrt(landmark.latent_variance).tolist()
    if landmark.size is not None:
        row["size"] = landmark.size.tolist()
    return row


def _array(row: dict[str, Any], key: str, shape: tuple[int | None, ...], where: dict[str, Any]) -> np.ndarray | None:
    if row.get(key) is None:
        return None
    value = number_array(row[key], shape, MAX_VALUE)
    if value is None:
        expected = f"numbers of shape {shape}, at most {MAX_VALUE:g}"
        raise input_error(f"`{key}` of a landmark", got=row[key], expected=expected, **where)
    return value


def _number(row: dict[str, Any], key: str, where: dict[str, Any]) -> float:
    value = row.get(key)
    if value is None:
        return np.nan
    if not is_number(value):
        raise input_error(f"`{key}` of a landmark", got=value, expected="a number", **where)
    return float(value)


def parse_landmark(row: Any, where: dict[str, Any]) -> Landmark:
    """One landmark from its JSON object; upright in a world whose y points down where no orientation was observed.

    Raises:
        InputError: name or position are missing, or a field has the wrong form.
    """
    if not isinstance(row, dict) or "name" not in row or row.get("position") is None:
        raise input_error("a landmark needs a name and a position", got=repr(row)[:120], **where)
    quaternion = _array(row, "rotation", (4,), where)
    if quaternion is not None and not 0.9 < np.linalg.norm(quaternion) < 1.1:
        raise input_error("`rotation` of a landmark", got=row["rotation"], expected="a unit quaternion", **where)
    first, last = _number(row, "first_frame", where), _number(row, "last_frame", where)
    posterior = row.get("class_posterior") or {}
    if not isinstance(posterior, dict) or not all(is_number(p, 0, 1) for p in posterior.values()):
        raise input_error("`class_posterior` of a landmark", got=posterior, expected="a probability by category", **where)
    position = _array(row, "position", (3,), where)
    assert position is not None
    R = R_WORLD_UPRIGHT if quaternion is None else quaternion_to_matrix(quaternion)
    covariance, unknown = np.full((6, 6), np.nan), np.full((3, 3), np.nan)
    stated = _array(row, "position_covariance", (3, 3), where)
    position_covariance = unknown if stated is None else stated
    if quaternion is not None:
        stated = _array(row, "rotation_covariance", (3, 3), where)
        covariance[:3, :3] = unknown if stated is None else stated
        covariance[3:, 3:] = R.T @ position_covariance @ R
    latent, scale = _array(row, "latent", (None,), where), _array(row, "latent_std", (None,), where)
    return Landmark(
        name=str(row["name"]),
        T_world_object=make_pose(R, position),
        covariance=covariance,
        position_covariance=position_covariance,
        oriented=quaternion is not None,
        existence=_number(row, "existence", where),
        class_posterior={str(c): float(p) for c, p in posterior.items()},
        latent=latent,
        latent_variance=None if scale is None else scale**2,
        size=_array(row, "size", (3,), where),
        detections=_number(row, "detections", where),
        first_frame=-1 if np.isnan(first) else int(first),
        last_frame=-1 if np.isnan(last) else int(last),
        category=None if row.get("category") is None else str(row["category"]),
    )


def read_landmarks(path: str | PathLike[str]) -> tuple[Landmark, ...]:
    """All landmarks of `landmarks.json`.

    Raises:
        InputError: no such file, not a list, or a landmark of the wrong form.
    """
    rows = read_json(path)
    if not isinstance(rows, list):
        raise input_error("the map is no list of landmarks", got=type(rows).__name__, file=path)
    landmarks = tuple(parse_landmark(row, {"file": path}) for row in rows)
    if len({landmark.name for landmark in landmarks}) < len(landmarks):
        raise input_error("two landmarks of one name", expected="each name once", file=path)
    return landmarks


def write_landmarks(path: str | PathLike[str], landmarks: Iterable[Landmark]) -> None:
    """Write `landmarks.json`, atomically."""
    write_json(path, [landmark_record(landmark) for landmark in landmarks])


# -- associations.jsonl -------------------------------------------------------------------------------------------------


def write_associations(path: str | PathLike[str], found: AssociationTable, names: Sequence[str]) -> None:
    """Write a row a detection: probability of each landmark, of a new object, of background; atomically.

    Args:
        path: the file.
        found: the weights.
        names: names of the landmarks.
    """
    weights: list[dict[str, float]] = [{} for _ in range(len(found))]
    for k, j, w in zip(found.row.tolist(), found.landmark.tolist(), found.weight.tolist()):
        weights[k][names[j]] = round(w, 6)
    write_jsonl(
        path,
        (
            {
                "id": found.id[k],
                "landmarks": dict(sorted(weights[k].items(), key=lambda item: -item[1])),
                "new": round(float(found.new[k]), 6),
                "background": round(float(found.background[k]), 6),
            }
            for k in range(len(found))
        ),
    )


def read_associations(
    path: str | PathLike[str], names: Sequence[str], frame_of: Mapping[str, int] | None = None
) -> AssociationTable:
    """All rows of `associations.jsonl`, in their order.

    Args:
        path: the file.
        names: names of the landmarks; weights of others are left out.
        frame_of: frame of each detection by its id, None when the observations are not at hand.

    Raises:
        InputError: no such file, or a row of the wrong form.
    """
    index = {name: j for j, name in enumerate(names)}
    rows = []
    for number, row in read_jsonl(path):
        weights = row.get("landmarks", {})
        good = isinstance(weights, dict) and all(is_number(w, 0, 1) for w in weights.values())
        good = good and all(row.get(name) is None or is_number(row[name], 0, 1) for name in ("new", "background"))
        if "id" not in row or not good:
            raise input_error(
                "not an association", got=repr(row)[:120], expected='{"id": ..., "landmarks": {...}}', file=path, line=number
            )
        rows.append(row)
    ids = tuple(str(row["id"]) for row in rows)
    frame = None
    if frame_of is not None and all(name in frame_of for name in ids):
        frame = np.array([frame_of[name] for name in ids], dtype=np.int64)
    found = [
        (k, index[str(name)], float(w))
        for k, row in enumerate(rows)
        for name, w in row.get("landmarks", {}).items()
        if str(name) in index
    ]
    return AssociationTable(
        id=ids,
        row=np.array([k for k, _, _ in found], dtype=np.int64),
        landmark=np.array([j for _, j, _ in found], dtype=np.int64),
        weight=np.array([w for _, _, w in found], dtype=np.float64),
        new=np.array([float(row.get("new") or 0.0) for row in rows]),
        background=np.array([float(row.get("background") or 0.0) for row in rows]),
        frame=frame,
    )


# -- landmarks_voxels.npz -----------------------------------------------------------------------------------------------


def write_voxels(path: str | PathLike[str], voxels: Mapping[str, Voxels]) -> None:
    """Write `<name>/mean` and `<name>/variance` of every landmark as float16 arrays of one NPZ file, atomically."""
    parts = ("mean", "variance")
    save_npz(path, {f"{name}/{part}": x.astype(np.float16) for name, pair in voxels.items() for part, x in zip(parts, pair)})


def voxel_names(archive: Npz) -> frozenset[str]:
    """Landmarks whose shape a file of voxels holds."""
    return frozenset(name.removesuffix("/mean") for name in archive.names if name.endswith("/mean"))


def read_voxels(archive: Npz, name: str) -> Voxels:
    """Mean and variance of the occupancy of one landmark; the variance of a coin where the file has none.

    Raises:
        InputError: the file cannot be read, or its arrays are no grids.
    """
    side = max(archive.headers[f"{name}/mean"].shape, default=0)
    cube = (side, side, side)
    if not 0 < side <= MAX_VOXELS:
        raise input_error(f"voxels of {name}", got=f"side {side}", expected=f"1 to {MAX_VOXELS}", file=archive.path)
    mean = archive.array(f"{name}/mean", cube, kinds="f").astype(np.float64)
    known = f"{name}/variance" in archive.headers
    variance = archive.array(f"{name}/variance", cube, kinds="f").astype(np.float64) if known else mean * (1 - mean)
    return mean, variance


# -- iterations.npz -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Iterations:
    """Where EM stood after every iteration; the first is the odometry, the last one the result."""

    T_world_camera: Float[np.ndarray, "i n 4 4"]
    """Poses of every iteration."""
    landmarks: tuple[Float[np.ndarray, "_ 3"], ...]
    """World positions, m, of each iteration's landmarks; empty where none were kept."""

    def __len__(self) -> int:
        return len(self.T_world_camera)


def write_iterations(path: str | PathLike[str], iterations: Iterations) -> None:
    """Every iteration in one NPZ file, atomically: `T_world_camera` [i, n, 4, 4] float32, `landmarks_0` [m, 3], ..., m."""
    landmarks = {f"landmarks_{i}": x.astype(np.float32) for i, x in enumerate(iterations.landmarks)}
    save_npz(path, {"T_world_camera": iterations.T_world_camera.astype(np.float32), **landmarks})


def read_iterations(path: Path, count: int) -> Iterations:
    """Read them back.

    Raises:
        InputError: the file cannot be read, or holds no poses of `count` keyframes.
    """
    with Npz(path) as archive:
        T = archive.array("T_world_camera", (None, count, 4, 4)).astype(np.float64)
        names = [f"landmarks_{i}" for i in range(len(T))]
        landmarks = tuple(
            archive.array(name, (None, 3)).astype(np.float64) if name in archive.names else np.zeros((0, 3)) for name in names
        )
    return Iterations(T, landmarks)
