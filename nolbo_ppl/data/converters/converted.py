"""What every converter returns, and how it is written."""

from __future__ import annotations

from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.io.files import write_json
from nolbo_ppl.io.npz import save_npz
from nolbo_ppl.io.observations import write_observations
from nolbo_ppl.io.trajectories import COVARIANCE, Trajectory, write_trajectory
from nolbo_ppl.structures.detections import Detections


@dataclass(frozen=True)
class Converted:
    """One drive in the formats of `nolbo slam`, with its truth."""

    odometry: Trajectory
    """Drifting T_world_camera."""
    truth: Trajectory
    """True T_world_camera, row by row."""
    observations: Detections
    """Detections."""
    objects: tuple[str | None, ...]
    """True object of each detection; None for clutter."""
    trusted: Bool[np.ndarray, " n"]
    """Rows whose truth can be relied on."""
    T_world_object: dict[str, Float[np.ndarray, "4 4"]] = field(default_factory=dict)
    """True poses of static objects, where known."""
    categories: dict[str, str] = field(default_factory=dict)
    """Categories of objects, where known."""
    latents: dict[str, Float[np.ndarray, " d"]] = field(default_factory=dict)
    """Shape latents of objects, where known."""
    odometry_covariance: Float[np.ndarray, "n-1 6 6"] | None = None
    """Covariance of every odometry step, where it is known (see `SlamProblem`)."""
    source: dict[str, Any] = field(default_factory=dict)
    """Where it came from and with what settings, for the record."""


def write_converted(out: str | PathLike[str], data: Converted) -> None:
    """Write `odometry.txt`, `truth.txt`, `observations.jsonl`, `objects.json` (true object of each id), `source.json`, and
    `odometry_covariance.npz` where the covariance of the odometry is known.
    """
    out = Path(out)
    write_trajectory(out / "odometry.txt", data.odometry)
    write_trajectory(out / "truth.txt", data.truth)
    if data.odometry_covariance is not None:
        save_npz(out / COVARIANCE, {"covariance": data.odometry_covariance})
    write_observations(out / "observations.jsonl", data.observations)
    known = {"categories": data.categories, "latents": {k: v.tolist() for k, v in data.latents.items()}}
    write_json(
        out / "objects.json",
        {
            "objects": dict(zip(data.observations.id, data.objects)),
            "trusted": [bool(x) for x in data.trusted],
            "T_world_object": {k: v.tolist() for k, v in data.T_world_object.items()},
            **{name: values for name, values in known.items() if values},
        },
    )
    write_json(out / "source.json", data.source)


def existing(path: str | PathLike[str], what: str) -> Path:
    """The path, or an error that says what should be there."""
    path = Path(path)
    if not path.exists():
        raise input_error(f"{what} not found", file=path)
    return path
