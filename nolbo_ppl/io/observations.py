"""Observations of objects as SLAM takes them: one table, read from and written to JSON Lines, checked field by field.

One detection a line: `frame` (row of the odometry, from 0) and `position` [x, y, z] m in the camera frame; optional
`position_std` (a number or 3) or `position_cov` (3x3), `rotation` [qx, qy, qz, qw] (R_camera_object), `rotation_std` rad,
`rotation_modes` (a list of `weight`, `rotation`, `std`: all modes of the orientation), `latent` [d], `latent_std` (a number
or d), `objectness` (default 1), `category`, `size` [3] m, `symmetry` (1 none, n n-fold, 0 free about the object's vertical
axis), `id` (carried through). What is missing is NaN in the table.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from nolbo_ppl._moved import renamed
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import matrix_to_quaternion, quaternion_to_matrix
from nolbo_ppl.io.files import read_jsonl, write_jsonl
from nolbo_ppl.structures.detections import (
    ARRAYS,
    MAXIMUM_DISTANCE,
    Detections,
    check_table,
    concatenate,
    heaviest_mode,
    make_table,
)


def _vector(row: dict[str, Any], key: str, length: int | None, where: dict[str, Any]) -> np.ndarray:
    value = row[key]
    try:
        vector = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise input_error(f"`{key}` is not numeric", got=value, **where) from None
    if vector.ndim != 1 or (length is not None and len(vector) != length):
        raise input_error(f"`{key}` has the wrong shape", got=value, expected=f"a list of {length or 'd'} numbers", **where)
    if not np.isfinite(vector).all():
        raise input_error(f"`{key}` is not finite", got=value, **where)
    return vector


def _scale(row: dict[str, Any], key: str, length: int, where: dict[str, Any]) -> np.ndarray:
    value = row[key]
    vector = np.full(length, value, dtype=np.float64) if isinstance(value, (int, float)) else _vector(row, key, length, where)
    if not (np.isfinite(vector).all() and (vector > 0).all()):
        raise input_error(f"`{key}` is no standard deviation", got=value, expected="greater than 0", **where)
    return vector


CARRIED = frozenset({"image", "box", "class_posterior", "viewpoint", "azimuth_modes"})
"""Fields of the observation model's own lines that say more than SLAM uses; they are accepted and left aside."""

_KNOWN = {
    "frame",
    "position",
    "position_std",
    "position_cov",
    "rotation",
    "rotation_std",
    "rotation_modes",
    "latent",
    "latent_std",
    "objectness",
    "category",
    "size",
    "symmetry",
    "id",
}


def _rotation(row: dict[str, Any], where: dict[str, Any], name: str = "rotation") -> np.ndarray:
    quaternion = _vector(row, "rotation", 4, where)
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1) > 1e-2:
        raise input_error(
            f"`{name}` is no unit quaternion",
            got=f"length {norm:.4g}",
            expected="1",
            do="normalise it; the order is [qx, qy, qz, qw]",
            **where,
        )
    return quaternion_to_matrix(quaternion)


def _modes(value: Any, where: dict[str, Any]) -> dict[str, np.ndarray]:
    """The modes of an orientation; weights sum to one."""
    if not isinstance(value, list) or not value or not all(isinstance(mode, dict) for mode in value):
        raise input_error(
            "`rotation_modes` is no list of modes",
            got=value,
            expected='[{"weight": w, "rotation": [qx, qy, qz, qw], "std": rad}, ...]',
            **where,
        )
    weight = []
    for i, mode in enumerate(value):
        if set(mode) != {"weight", "rotation", "std"}:
            raise input_error(
                f"`rotation_modes` {i} has wrong fields", got=sorted(mode), expected="weight, rotation, std", **where
            )
        w = mode["weight"]
        if isinstance(w, bool) or not isinstance(w, (int, float)) or not np.isfinite(w) or w < 0:
            raise input_error(f"`rotation_modes` {i}: `weight` is no weight", got=w, expected="0 or more", **where)
        weight.append(float(w))
    total = sum(weight)
    if not abs(total - 1) < 1e-2:
        raise input_error("weights of `rotation_modes` do not sum to one", got=total, expected="1", **where)
    return {
        "mode_weight": np.array(weight) / total,
        "mode_rotation": np.stack([_rotation(mode, where, "rotation_modes") for mode in value]),
        "mode_std": np.concatenate([_scale(mode, "std", 1, where) for mode in value]),
    }


def _parse(row: dict[str, Any], where: dict[str, Any]) -> dict[str, Any]:
    """One checked line: python values by table column."""
    for key in ("frame", "position"):
        if key not in row:
            raise input_error(f"`{key}` is missing", got=sorted(row), **where)
    frame = row["frame"]
    if isinstance(frame, bool) or not isinstance(frame, int) or frame < 0:
        raise input_error("`frame` is no row number", got=frame, expected="an integer from 0", **where)
    out: dict[str, Any] = {"frame": frame, "position": _vector(row, "position", 3, where)}
    if np.abs(out["position"]).max() > MAXIMUM_DISTANCE:
        raise input_error("`position` out of range", got=row["position"], expected=f"within {MAXIMUM_DISTANCE:g} m", **where)
    if row.get("position_cov") is not None:
        try:
            covariance = np.asarray(row["position_cov"], dtype=np.float64)
        except (TypeError, ValueError):
            covariance = np.zeros(0)
        if covariance.shape != (3, 3) or not np.isfinite(covariance).all():
            raise input_error("`position_cov` is no 3x3 matrix", got=row["position_cov"], **where)
        if np.abs(covariance - covariance.T).max() > 1e-6 * np.abs(covariance).max() or np.linalg.eigvalsh(covariance)[0] <= 0:
            raise input_error(
                "`position_cov` is not positive definite",
                got=row["position_cov"],
                expected="symmetric with positive eigenvalues",
                **where,
            )
        out["position_covariance"] = covariance
    elif row.get("position_std") is not None:
        out["position_covariance"] = np.diag(_scale(row, "position_std", 3, where) ** 2)
    if row.get("rotation") is not None:
        out["rotation"] = _rotation(row, where)
    if row.get("rotation_std") is not None:
        out["rotation_scale"] = float(_scale(row, "rotation_std", 1, where)[0])
    if row.get("rotation_modes") is not None:
        modes = _modes(row["rotation_modes"], where)
        out.update(modes)
        if "rotation" not in out:
            best, scale = heaviest_mode(**{name: value[None] for name, value in modes.items()})
            out["rotation"] = best[0]
            out.setdefault("rotation_scale", float(scale[0]))
    if row.get("latent") is not None:
        out["latent"] = _vector(row, "latent", None, where)
        if row.get("latent_std") is not None:
            out["latent_scale"] = _scale(row, "latent_std", len(out["latent"]), where)
    objectness = row.get("objectness", 1.0)
    if isinstance(objectness, bool) or not isinstance(objectness, (int, float)) or not 0 <= objectness <= 1:
        raise input_error("`objectness` is no probability", got=objectness, expected="0 to 1", **where)
    out["objectness"] = float(objectness)
    category = row.get("category")
    if category is not None and not isinstance(category, str):
        raise input_error("`category` is no name", got=category, expected="a string", **where)
    out["category"] = category
    if row.get("size") is not None:
        out["size"] = _scale(row, "size", 3, where)
    symmetry = row.get("symmetry")
    if symmetry is not None and (isinstance(symmetry, bool) or not isinstance(symmetry, int) or symmetry < 0):
        raise input_error("`symmetry` is no order", got=symmetry, expected="1 none, n n-fold, 0 free", **where)
    out["symmetry"] = -1 if symmetry is None else symmetry
    return out


def read_observations(path: str | PathLike[str], frames: int | None = None) -> Detections:
    """Read observations from JSON Lines.

    Args:
        path: the file.
        frames: number of rows of the odometry; frames outside raise.

    Raises:
        InputError: a missing file, a malformed line, unknown or bad fields, latents of different lengths, duplicate ids,
            frames out of range; names file and line.
    """
    path = Path(path)
    rows: list[dict[str, Any]] = []
    ids: dict[str, int] = {}
    dimension: int | None = None
    for number, row in read_jsonl(path):
        where: dict[str, Any] = {"file": path, "line": number}
        unknown = set(row) - _KNOWN - CARRIED
        if unknown:
            raise input_error("unknown field", got=sorted(unknown), expected=f"some of {sorted(_KNOWN)}", **where)
        values = _parse(row, where)
        if frames is not None and values["frame"] >= frames:
            raise input_error(
                "`frame` out of range", got=values["frame"], expected=f"0 to {frames - 1}, a row of the odometry", **where
            )
        if "latent" in values:
            if dimension not in (None, len(values["latent"])):
                raise input_error("latents of different lengths", got=len(values["latent"]), expected=dimension, **where)
            dimension = len(values["latent"])
        identity = str(row["id"]) if row.get("id") is not None else f"line-{number}"
        if identity in ids:
            raise input_error("duplicate id", got=identity, expected=f"an id of its own (line {ids[identity]} has it)", **where)
        ids[identity] = number
        values["id"] = identity
        rows.append(values)
    d = dimension or 0
    K = max((len(row["mode_weight"]) for row in rows if "mode_weight" in row), default=0)
    missing = {
        "position_covariance": np.full((3, 3), np.nan),
        "rotation": np.full((3, 3), np.nan),
        "rotation_scale": np.nan,
        "latent": np.full(d, np.nan),
        "latent_scale": np.full(d, np.nan),
        "size": np.full(3, np.nan),
    }
    padding = {"mode_weight": np.zeros(K), "mode_rotation": np.tile(np.eye(3), (K, 1, 1)), "mode_std": np.ones(K)}
    shapes = {
        "position": (3,),
        "position_covariance": (3, 3),
        "rotation": (3, 3),
        "latent": (d,),
        "latent_scale": (d,),
        "size": (3,),
        "mode_weight": (K,),
        "mode_rotation": (K, 3, 3),
        "mode_std": (K,),
    }

    def column(name: str) -> np.ndarray:
        if name in padding:  # rows with fewer modes are padded
            values = [
                np.concatenate([row[name], padding[name][len(row[name]) :]]) if name in row else padding[name] for row in rows
            ]
        else:
            values = [row.get(name, missing.get(name)) for row in rows]
        dtype = np.int64 if name in ("frame", "symmetry") else np.float64
        return np.array(values, dtype=dtype).reshape(len(rows), *shapes.get(name, ()))

    return Detections(
        **{name: column(name) for name in ARRAYS},
        category=tuple(row["category"] for row in rows),
        id=tuple(row["id"] for row in rows),
    )


def write_observations(path: str | PathLike[str], table: Detections) -> None:
    """Write a table as JSON Lines, atomically; missing fields are left out."""
    write_jsonl(path, (observation_row(table, i) for i in range(len(table))))


def observation_row(table: Detections, i: int) -> dict[str, Any]:
    """One row of a table in the form of the file."""
    row: dict[str, Any] = {"frame": int(table.frame[i]), "position": _rounded(table.position[i])}
    covariance = table.position_covariance[i]
    if np.isfinite(covariance).all():
        if np.array_equal(covariance, np.diag(np.diag(covariance))):
            row["position_std"] = _rounded(np.sqrt(np.diag(covariance)))
        else:
            row["position_cov"] = [_rounded(r, 9) for r in covariance]
    if np.isfinite(table.rotation[i]).all():
        row["rotation"] = _rounded(matrix_to_quaternion(table.rotation[i]), 8)
    if np.isfinite(table.rotation_scale[i]):
        row["rotation_std"] = float(table.rotation_scale[i])
    used = np.flatnonzero(table.mode_weight[i] > 0)
    if len(used):
        row["rotation_modes"] = [
            {
                "weight": float(table.mode_weight[i, k]),
                "rotation": _rounded(matrix_to_quaternion(table.mode_rotation[i, k]), 8),
                "std": float(table.mode_std[i, k]),
            }
            for k in used
        ]
    if table.latent_dim and np.isfinite(table.latent[i]).all():
        row["latent"] = _rounded(table.latent[i])
        if np.isfinite(table.latent_scale[i]).all():
            row["latent_std"] = _rounded(table.latent_scale[i])
    if table.objectness[i] != 1.0:
        row["objectness"] = float(table.objectness[i])
    if table.category[i] is not None:
        row["category"] = table.category[i]
    if np.isfinite(table.size[i]).all():
        row["size"] = _rounded(table.size[i])
    if table.symmetry[i] >= 0:
        row["symmetry"] = int(table.symmetry[i])
    row["id"] = table.id[i]
    return row


def _rounded(values: np.ndarray, digits: int = 6) -> list[float]:
    return [float(f"{v:.{digits + 1}g}") for v in values]


__all__ = [
    "Detections",
    "check_table",
    "concatenate",
    "make_table",
    "observation_row",
    "read_observations",
    "write_observations",
]


__getattr__ = renamed(__name__, {"ObservationTable": "Detections"})
