"""Landmarks and associations as a run's files hold them, checked; nothing here knows how they were computed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import make_pose, quaternion_to_matrix
from nolbo_ppl.io.fields import is_number, number_array
from nolbo_ppl.io.files import read_json, read_jsonl

LARGEST = 1e9
"""Largest coordinate, m, size or variance of a landmark that can be shown."""
STRONG = 0.5
"""A detection belongs to the landmark that holds more than this of its weight."""


@dataclass(frozen=True)
class RunLandmark:
    """One object of the map, as read from `landmarks.json`."""

    name: str
    """Its name: any text."""
    position: Float[np.ndarray, " 3"]
    """Position in the world, m."""
    position_covariance: Float[np.ndarray, "3 3"] | None = None
    """Its covariance in the world frame, m^2."""
    rotation: Float[np.ndarray, "3 3"] | None = None
    """R_world_object, where an orientation was observed."""
    existence: float | None = None
    """Probability that it is an object."""
    detections: float | None = None
    """Sum of its association weights."""
    frames: tuple[int, int] | None = None
    """First and last frame it was seen in."""
    category: str | None = None
    """Most probable category."""
    class_posterior: dict[str, float] = field(default_factory=dict)
    """Probability of each category."""
    size: Float[np.ndarray, " 3"] | None = None
    """Extent, m."""

    @property
    def T_world_object(self) -> Float[np.ndarray, "4 4"]:
        """Pose; without an orientation it stands upright in a world whose y points down."""
        upright = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
        return make_pose(upright if self.rotation is None else self.rotation, self.position)

    @property
    def diagonal(self) -> float | None:
        """Diagonal of its box, m: the unit of the canonical frame."""
        return None if self.size is None else float(np.linalg.norm(self.size))

    @property
    def spread(self) -> float | None:
        """Root of the largest eigenvalue of the position's covariance, m."""
        if self.position_covariance is None:
            return None
        return float(np.sqrt(max(np.linalg.eigvalsh(self.position_covariance)[-1], 0.0)))


@dataclass(frozen=True)
class RunAssociations:
    """Weights of every detection, in the order of time."""

    id: tuple[str, ...]
    """Identifier of each detection: any text."""
    frame: Int[np.ndarray, " k"] | None
    """Its frame; None when the observations are not at hand."""
    row: Int[np.ndarray, " p"]
    """Detection of each weight."""
    landmark: Int[np.ndarray, " p"]
    """Landmark of each weight, an index into the landmarks."""
    weight: Float[np.ndarray, " p"]
    """Marginal probability."""
    new: Float[np.ndarray, " k"]
    """Probability of an object that is not in the map."""
    background: Float[np.ndarray, " k"]
    """Probability of no object."""

    def __len__(self) -> int:
        return len(self.id)

    @property
    def landmark_of(self) -> Int[np.ndarray, " k"]:
        """The landmark that holds most of each detection, -1 for none."""
        label = np.full(len(self), -1, dtype=np.int64)
        strong = self.weight > STRONG
        label[self.row[strong]] = self.landmark[strong]
        return label


def _array(row: dict[str, Any], key: str, shape: tuple[int, ...], where: dict[str, Any]) -> np.ndarray | None:
    if row.get(key) is None:
        return None
    value = number_array(row[key], shape, LARGEST)
    if value is None:
        expected = f"numbers of shape {shape}, at most {LARGEST:g}"
        raise input_error(f"`{key}` of a landmark", got=row[key], expected=expected, **where)
    return value


def _number(row: dict[str, Any], key: str, where: dict[str, Any]) -> float | None:
    value = row.get(key)
    if value is None:
        return None
    if not is_number(value):
        raise input_error(f"`{key}` of a landmark", got=value, expected="a number", **where)
    return float(value)


def parse_landmark(row: Any, where: dict[str, Any]) -> RunLandmark:
    """One landmark from its JSON object.

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
    return RunLandmark(
        name=str(row["name"]),
        position=position,
        position_covariance=_array(row, "position_covariance", (3, 3), where),
        rotation=None if quaternion is None else quaternion_to_matrix(quaternion),
        existence=_number(row, "existence", where),
        detections=_number(row, "detections", where),
        frames=None if first is None or last is None else (int(first), int(last)),
        category=None if row.get("category") is None else str(row["category"]),
        class_posterior={str(c): float(p) for c, p in posterior.items()},
        size=_array(row, "size", (3,), where),
    )


def read_landmarks(path: Path) -> tuple[RunLandmark, ...]:
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


def read_associations(path: Path, names: Sequence[str], frame_of: dict[str, int] | None) -> RunAssociations:
    """All rows of `associations.jsonl`, sorted by frame where frames are known.

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
    frame = None
    if frame_of is not None and all(str(row["id"]) in frame_of for row in rows):
        frame = np.array([frame_of[str(row["id"])] for row in rows], dtype=np.int64)
        order = np.argsort(frame, kind="stable")
        rows, frame = [rows[k] for k in order], frame[order]
    found = [
        (k, index[str(name)], float(w))
        for k, row in enumerate(rows)
        for name, w in row.get("landmarks", {}).items()
        if str(name) in index
    ]
    return RunAssociations(
        id=tuple(str(row["id"]) for row in rows),
        frame=frame,
        row=np.array([k for k, _, _ in found], dtype=np.int64),
        landmark=np.array([j for _, j, _ in found], dtype=np.int64),
        weight=np.array([w for _, _, w in found], dtype=np.float64),
        new=np.array([float(row.get("new") or 0.0) for row in rows]),
        background=np.array([float(row.get("background") or 0.0) for row in rows]),
    )
