"""Files of observations: `Detections` read from and written to JSON Lines, checked field by field.

One detection a line: `frame` (row of the odometry, from 0) and `position` [x, y, z] m in the camera frame; optional
`position_std` (a number or 3) or `position_cov` (3x3), `position_tails` [degrees of freedom, factor on the covariance] of
Student's t about the position, `position_cov_shared` (3x3, the part of the covariance that is one error for all views of
an object), `rotation` [qx, qy, qz, qw] (R_camera_object), `rotation_std` rad,
`rotation_modes` (a list of `weight`, `rotation`, `std`: all modes of the orientation), `latent` [d], `latent_std` (a number
or d), `latent_modes` (a list of `weight`, `latent`: all modes of the latent, each with `latent_std`), `objectness` (default 1),
`category`, `size` [3] m, `symmetry` (1 none, n n-fold, 0 free about the object's vertical axis), `id`. A model's own lines say
more, which SLAM does not use and every reader keeps: `image`, `time` s, `box` [x0, y0, x1, y1] px, `class_posterior`
(probability by category), `viewpoint` [azimuth, elevation, in-plane] rad, `azimuth_modes` (a list of `weight`, `azimuth`,
`concentration`).
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nolbo_ppl._moved import renamed
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import quaternion_to_matrix
from nolbo_ppl.io.fields import is_number, is_whole, number_array
from nolbo_ppl.io.files import read_jsonl, write_jsonl
from nolbo_ppl.structures.detection_checks import MAX_POSITION, check_table
from nolbo_ppl.structures.detection_records import to_records
from nolbo_ppl.structures.detections import ARRAYS, Detections, heaviest_latent, heaviest_mode, merged_order, padding

FIELDS = (
    "frame",
    "image",
    "time",
    "id",
    "box",
    "objectness",
    "category",
    "class_posterior",
    "position",
    "position_std",
    "position_cov",
    "position_tails",
    "position_cov_shared",
    "rotation",
    "rotation_std",
    "rotation_modes",
    "viewpoint",
    "azimuth_modes",
    "latent",
    "latent_std",
    "latent_modes",
    "size",
    "symmetry",
)
"""Fields a line may have."""
LARGEST = 1e9
"""Largest number of a vector."""
SMALLEST_SCALE, LARGEST_SCALE = 1e-12, 1e12
"""Standard deviations whose squares, and sums of them, are numbers to calculate with."""
WEIGHT_ROUNDING = 1e-4
"""Weights that sum to one within this are taken as they are: a file rounds them."""


def _vector(row: dict[str, Any], key: str, length: int | None, where: dict[str, Any]) -> np.ndarray:
    vector = number_array(row[key], (length,), LARGEST)
    if vector is None:
        expected = f"a list of {length or 'd'} numbers, at most {LARGEST:g}"
        raise input_error(f"`{key}` is no vector", got=row[key], expected=expected, **where)
    return vector


def _scale(row: dict[str, Any], key: str, length: int, where: dict[str, Any]) -> np.ndarray:
    value = row[key]
    vector = number_array(value, (length,)) if isinstance(value, list) else None
    if is_number(value):
        vector = np.full(length, float(value))
    if vector is None or not ((vector >= SMALLEST_SCALE) & (vector <= LARGEST_SCALE)).all():
        expected = f"numbers from {SMALLEST_SCALE:g} to {LARGEST_SCALE:g}"
        raise input_error(f"`{key}` is no standard deviation", got=value, expected=expected, **where)
    return vector


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
    weight = _mode_weights("rotation_modes", value, ("weight", "rotation", "std"), where)
    return {
        "mode_weight": weight,
        "mode_rotation": np.stack([_rotation(mode, where, "rotation_modes") for mode in value]),
        "mode_std": np.concatenate([_scale(mode, "std", 1, where) for mode in value]),
    }


def _latent_modes(value: Any, where: dict[str, Any]) -> dict[str, np.ndarray]:
    """The modes of a latent; weights sum to one."""
    if not isinstance(value, list) or not value or not all(isinstance(mode, dict) for mode in value):
        expected = '[{"weight": w, "latent": [z, ...]}, ...]'
        raise input_error("`latent_modes` is no list of modes", got=value, expected=expected, **where)
    weight = _mode_weights("latent_modes", value, ("weight", "latent"), where)
    latents = [_vector(mode, "latent", None, where) for mode in value]
    lengths = sorted({len(latent) for latent in latents})
    if len(lengths) > 1:
        raise input_error("`latent_modes` of different lengths", got=lengths, expected="one length", **where)
    return {"latent_mode_weight": weight, "latent_mode": np.stack(latents)}


def _mode_weights(name: str, modes: list[dict[str, Any]], keys: tuple[str, ...], where: dict[str, Any]) -> np.ndarray:
    """Weights of a list of modes, which sum to one; every mode has the given fields."""
    weight = []
    for i, mode in enumerate(modes):
        if set(mode) != set(keys):
            raise input_error(f"`{name}` {i} has wrong fields", got=sorted(mode), expected=", ".join(keys), **where)
        w = mode["weight"]
        if not is_number(w, 0, 1 + WEIGHT_ROUNDING):
            raise input_error(f"`{name}` {i}: `weight` is no weight", got=w, expected="0 or more", **where)
        weight.append(float(w))
    total = sum(weight)
    if not abs(total - 1) < 1e-2:
        raise input_error(f"weights of `{name}` do not sum to one", got=total, expected="1", **where)
    return np.array(weight) / (1.0 if abs(total - 1) <= WEIGHT_ROUNDING else total)


def _number(value: Any, low: float, high: float, what: str, where: dict[str, Any]) -> float:
    """A number in a range."""
    if not is_number(value, low, high):
        raise input_error(what, got=value, expected=f"{low:g} to {high:g}", **where)
    return float(value)


def _azimuth_modes(value: Any, where: dict[str, Any]) -> dict[str, np.ndarray]:
    """The von Mises modes of an azimuth, as they are stated."""
    names = {"weight": (0.0, np.inf), "azimuth": (-np.inf, np.inf), "concentration": (0.0, np.inf)}
    if not isinstance(value, list) or not all(isinstance(mode, dict) and set(mode) == set(names) for mode in value):
        expected = '[{"weight": w, "azimuth": rad, "concentration": k}, ...]'
        raise input_error("`azimuth_modes` is no list of modes", got=value, expected=expected, **where)
    columns = {
        name: np.array([_number(mode[name], *limits, f"`azimuth_modes`: `{name}` is out of range", where) for mode in value])
        for name, limits in names.items()
    }
    return {
        "azimuth_weight": columns["weight"],
        "azimuth": columns["azimuth"],
        "azimuth_concentration": columns["concentration"],
    }


def _image_fields(row: dict[str, Any], where: dict[str, Any]) -> dict[str, Any]:
    """What a line says of the image and of the model's whole answer."""
    out: dict[str, Any] = {}
    if row.get("image") is not None:
        if not isinstance(row["image"], str):
            raise input_error("`image` is no name", got=row["image"], expected="a string", **where)
        out["image"] = row["image"]
    if row.get("time") is not None:
        out["time"] = _number(row["time"], -np.inf, np.inf, "`time` is no number of seconds", where)
    if row.get("box") is not None:
        out["box"] = box = _vector(row, "box", 4, where)
        if (box[2:] < box[:2]).any():
            raise input_error(
                "`box` is turned inside out", got=row["box"], expected="[x0, y0, x1, y1], x0 <= x1, y0 <= y1", **where
            )
    if row.get("class_posterior") is not None:
        posterior = row["class_posterior"]
        if not isinstance(posterior, dict):
            raise input_error("`class_posterior` is no probability by category", got=posterior, expected="{name: p}", **where)
        out["class_posterior"] = {
            name: _number(p, 0.0, 1.0, f"`class_posterior`: {name!r} is no probability", where) for name, p in posterior.items()
        }
    if row.get("viewpoint") is not None:
        out["viewpoint"] = _vector(row, "viewpoint", 3, where)
    if row.get("azimuth_modes") is not None:
        out.update(_azimuth_modes(row["azimuth_modes"], where))
    return out


def _shared(value: Any, whole: np.ndarray | None, where: dict[str, Any]) -> np.ndarray:
    """The part of a position's covariance that all views of an object have in common."""
    shared = number_array(value, (3, 3), LARGEST_SCALE**2)
    if shared is None:
        raise input_error("`position_cov_shared` is no 3x3 matrix", got=value, **where)
    size = np.abs(shared if whole is None else whole).max()
    least = min(np.linalg.eigvalsh(part)[0] for part in (shared, shared if whole is None else whole - shared))
    if np.abs(shared - shared.T).max() > 1e-6 * np.abs(shared).max() or least < -1e-9 * size:
        expected = "symmetric, eigenvalues of 0 or more, and so of what it leaves of `position_cov`"
        raise input_error("`position_cov_shared` is no part of a covariance", got=value, expected=expected, **where)
    return shared


def _parse(row: dict[str, Any], where: dict[str, Any]) -> dict[str, Any]:
    """One checked line: python values by table column."""
    for key in ("frame", "position"):
        if key not in row:
            raise input_error(f"`{key}` is missing", got=sorted(row), **where)
    frame = row["frame"]
    if not is_whole(frame):
        raise input_error("`frame` is no row number", got=frame, expected="an integer from 0", **where)
    out: dict[str, Any] = {"frame": frame, "position": _vector(row, "position", 3, where)}
    if np.abs(out["position"]).max() > MAX_POSITION:
        raise input_error("`position` out of range", got=row["position"], expected=f"within {MAX_POSITION:g} m", **where)
    if row.get("position_cov") is not None:
        covariance = number_array(row["position_cov"], (3, 3), LARGEST_SCALE**2)
        if covariance is None:
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
    if row.get("position_tails") is not None:
        out["position_tails"] = tails = _vector(row, "position_tails", 2, where)
        if not (tails > 0).all():
            expected = "degrees of freedom and a factor, above 0"
            raise input_error("`position_tails` are no law", got=row["position_tails"], expected=expected, **where)
    if row.get("position_cov_shared") is not None:
        out["position_shared"] = _shared(row["position_cov_shared"], out.get("position_covariance"), where)
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
    if row.get("latent_modes") is not None:
        out.update(_latent_modes(row["latent_modes"], where))
        mode = out["latent_mode"]
        best = heaviest_latent(out["latent_mode_weight"][None], mode[None])[0]
        if len(out.setdefault("latent", best)) != mode.shape[1]:
            got, expected = mode.shape[1], f"{len(out['latent'])}, as `latent` has"
            raise input_error("`latent_modes` have another length", got=got, expected=expected, **where)
    if "latent" in out and row.get("latent_std") is not None:
        out["latent_scale"] = _scale(row, "latent_std", len(out["latent"]), where)
    objectness = row.get("objectness", 1.0)
    if not is_number(objectness, 0, 1):
        raise input_error("`objectness` is no probability", got=objectness, expected="0 to 1", **where)
    out["objectness"] = float(objectness)
    category = row.get("category")
    if category is not None and not isinstance(category, str):
        raise input_error("`category` is no name", got=category, expected="a string", **where)
    out["category"] = category
    if row.get("size") is not None:
        out["size"] = _scale(row, "size", 3, where)
    symmetry = row.get("symmetry")
    if symmetry is not None and not is_whole(symmetry, 0, 1000):
        raise input_error("`symmetry` is no order", got=symmetry, expected="1 none, n n-fold, 0 free", **where)
    out["symmetry"] = -1 if symmetry is None else symmetry
    out.update(_image_fields(row, where))
    return out


def read_observations(path: str | PathLike[str], frames: int | None = None) -> Detections:
    """Read detections from JSON Lines: every field of a line is kept, and `write_observations` writes it again.

    >>> from tempfile import mkdtemp
    >>> path = mkdtemp() + "/observations.jsonl"
    >>> write_observations(path, Detections.from_arrays([0, 4], [[0, 0, 5.0], [1, 0, 8]], category=["car", None]))
    >>> read_observations(path, frames=5).category
    ('car', None)

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
        unknown = set(row) - set(FIELDS)
        if unknown:
            raise input_error("unknown field", got=sorted(unknown), expected=f"some of {sorted(FIELDS)}", **where)
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
    return _table(rows)


def _table(rows: list[dict[str, Any]]) -> Detections:
    """Parsed lines as one table."""

    def longest(name: str) -> int:
        return max((len(row[name]) for row in rows if name in row), default=0)

    latent, modes, azimuths = longest("latent"), longest("mode_weight"), longest("azimuth")
    latents = longest("latent_mode_weight")
    names = merged_order(tuple(row["class_posterior"]) for row in rows if "class_posterior" in row)
    for row in rows:
        if "class_posterior" in row:
            row["class_posterior"] = np.array([row["class_posterior"].get(name, np.nan) for name in names])
    shapes = {
        "position": (3,),
        "position_covariance": (3, 3),
        "position_shared": (3, 3),
        "rotation": (3, 3),
        "latent": (latent,),
        "latent_scale": (latent,),
        "size": (3,),
        "mode_weight": (modes,),
        "mode_rotation": (modes, 3, 3),
        "mode_std": (modes,),
        "box": (4,),
        "class_posterior": (len(names),),
        "viewpoint": (3,),
        "azimuth_weight": (azimuths,),
        "azimuth": (azimuths,),
        "azimuth_concentration": (azimuths,),
        "position_tails": (2,),
        "latent_mode_weight": (latents,),
        "latent_mode": (latents, latent),
    }

    def column(name: str) -> np.ndarray:
        shape = (len(rows), *shapes.get(name, ()))
        values = padding(name, shape)
        for i, row in enumerate(rows):
            if name in row:
                values[(i, slice(len(row[name]))) if len(shape) > 1 else i] = row[name]
        return values.astype(np.int64) if name in ("frame", "symmetry") else values

    return Detections(
        **{name: column(name) for name in ARRAYS},
        category=tuple(row["category"] for row in rows),
        id=tuple(row["id"] for row in rows),
        image=tuple(row.get("image") for row in rows),
        class_names=names,
    )


def write_observations(path: str | PathLike[str], detections: Detections) -> None:
    """Write detections as JSON Lines, atomically; missing fields are left out.

    Numbers are written with all their digits, rotations as quaternions of eight decimals: what `read_observations` has read is
    written as the same lines again.

    >>> from tempfile import mkdtemp
    >>> path = mkdtemp() + "/observations.jsonl"
    >>> write_observations(path, Detections.from_arrays([7], [[0, 0, 5.0]], category=["car"]))
    >>> print(open(path).read().strip())
    {"frame": 7, "id": "0", "objectness": 1.0, "category": "car", "position": [0.0, 0.0, 5.0]}
    """
    write_jsonl(path, to_records(detections))


def to_record(table: Detections, i: int) -> dict[str, Any]:
    """One row of a table in the form of the file."""
    return next(to_records(table.select(np.array([i]))))


__all__ = [
    "Detections",
    "check_table",
    "read_observations",
    "write_observations",
]


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
