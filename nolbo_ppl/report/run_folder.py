"""A run's folder as the report and the viewer take it: everything but the trajectory and the map may be missing."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.io.fields import is_whole, number_array
from nolbo_ppl.io.files import inside, read_json, read_json_object, read_jsonl
from nolbo_ppl.io.npz import Npz
from nolbo_ppl.io.output_folder import settle
from nolbo_ppl.io.trajectories import read_frame_poses, read_trajectory
from nolbo_ppl.metrics.trajectory import align
from nolbo_ppl.report.run_landmarks import RunAssociations, RunLandmark, read_associations, read_landmarks
from nolbo_ppl.viz.map_plots import principal_plane

Poses = Float[np.ndarray, "n 4 4"]
MOST_VOXELS = 128
"""Longest side of a decoded shape that is shown."""


@dataclass(frozen=True)
class Iterations:
    """Where EM stood after every iteration; the first is the odometry."""

    T_world_camera: Float[np.ndarray, "i n 4 4"]
    landmarks: tuple[Float[np.ndarray, "_ 3"], ...]
    """World positions, m, of each iteration's landmarks; empty where none were kept."""

    def __len__(self) -> int:
        return len(self.T_world_camera)


@dataclass(frozen=True)
class RunFolder:
    """What is in the folder."""

    path: Path
    """The folder."""
    slam: Path
    """The folder with the answer: `slam/` inside, or the folder itself."""
    estimate: Poses
    """Corrected T_world_camera, one row a keyframe."""
    landmarks: tuple[RunLandmark, ...]
    odometry: Poses | None = None
    truth: Poses | None = None
    """True poses in the run's own world: moved rigidly onto the estimate."""
    truth_given: Poses | None = None
    """True poses as the file has them."""
    times: Float[np.ndarray, " n"] | None = None
    """Seconds."""
    images: tuple[Path | None, ...] = ()
    """Picture of each keyframe, None where it is not found; empty when none are listed."""
    intrinsics: dict[str, float] | None = None
    associations: RunAssociations | None = None
    iterations: Iterations | None = None
    objects: dict[str, str | None] | None = None
    """True object of each detection by its id, None for clutter; others are not known. None when nobody said anything."""
    run: dict[str, Any] = field(default_factory=dict)
    """`run.json`."""
    summary: dict[str, Any] = field(default_factory=dict)
    """`summary.json` of the run."""
    slam_summary: dict[str, Any] = field(default_factory=dict)
    """`summary.json` of the answer."""

    def __len__(self) -> int:
        return len(self.estimate)

    @cached_property
    def plane(self) -> tuple[int, int]:
        """The two axes seen from above."""
        return principal_plane(self.estimate[:, :3, 3])

    @cached_property
    def categories(self) -> tuple[str, ...]:
        """Categories of the landmarks, sorted."""
        return tuple(sorted({x.category for x in self.landmarks if x.category is not None}))

    @cached_property
    def voxel_names(self) -> frozenset[str]:
        """Landmarks with a decoded shape."""
        archive = self._voxels
        return frozenset(() if archive is None else (n[: -len("/mean")] for n in archive.names if n.endswith("/mean")))

    @cached_property
    def _voxels(self) -> Npz | None:
        """The file of decoded shapes, open as long as the run."""
        path = self.slam / "landmarks_voxels.npz"
        return Npz(path) if path.is_file() else None

    def voxels(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        """Mean and variance of a landmark's occupancy, [n, n, n]; None without a decoded shape.

        Raises:
            InputError: the file cannot be read.
        """
        archive = self._voxels
        if archive is None or name not in self.voxel_names:
            return None
        side = max(archive.headers[f"{name}/mean"].shape, default=0)
        cube = (side, side, side)
        if not 0 < side <= MOST_VOXELS:
            raise input_error(f"voxels of {name}", got=f"side {side}", expected=f"1 to {MOST_VOXELS}", file=archive.path)
        mean = archive.array(f"{name}/mean", cube, kinds="f").astype(np.float64)
        known = f"{name}/variance" in archive.headers
        variance = archive.array(f"{name}/variance", cube, kinds="f").astype(np.float64) if known else mean * (1 - mean)
        return mean, variance

    def crop(self, name: str) -> Path | None:
        """Best picture of a landmark; None when there is none, or it would lead out of the run's folder."""
        path = inside(self.path, f"crops/{name}.png")
        return path if path is not None and path.parent == self.path / "crops" and path.is_file() else None


def _json(path: Path) -> dict[str, Any]:
    return read_json_object(path) if path.is_file() else {}


def _rows(path: Path | None, count: int, times: np.ndarray | None, what: str) -> Poses | None:
    """Poses of an optional trajectory: rows of the estimate, or rows matched by time."""
    return None if path is None else read_frame_poses(path, count, times, what=what, of="the estimate").T_world_camera


def _iterations(path: Path, count: int) -> Iterations | None:
    if not path.is_file():
        return None
    with Npz(path) as archive:
        T = archive.array("T_world_camera", (None, count, 4, 4)).astype(np.float64)
        names = [f"landmarks_{i}" for i in range(len(T))]
        landmarks = tuple(
            archive.array(name, (None, 3)).astype(np.float64) if name in archive.headers else np.zeros((0, 3)) for name in names
        )
    return Iterations(T, landmarks)


def _frames(folder: Path, count: int, pictures: Path | None) -> tuple[tuple[Path | None, ...], np.ndarray | None]:
    """Pictures and times of the keyframes; pictures are looked for in the run's folder and in that of the pictures alone."""
    path = folder / "frames.jsonl"
    if not path.is_file():
        return (), None
    rows = [row for _, row in read_jsonl(path)]
    if len(rows) != count:
        raise input_error("frames do not match the estimate", got=f"{len(rows)} lines", expected=f"{count}", file=path)
    images = tuple(_picture(row.get("image"), folder, pictures) for row in rows)
    times = number_array([row.get("time") for row in rows], (count,))
    return images, times


def _picture(name: object, folder: Path, pictures: Path | None) -> Path | None:
    """The file of a picture, where it lies within one of the folders: a file names it, and may have come from anywhere."""
    if not isinstance(name, str):
        return None
    tried = [inside(folder, name)]
    if pictures is not None:
        given = (folder / name).resolve()
        tried.append(inside(pictures, os.path.relpath(given, pictures.resolve())))
        tried.append(inside(pictures, Path(name).name))
    return next((place for place in tried if place is not None and place.is_file()), None)


def _frame_of(path: Path | None) -> dict[str, int] | None:
    """Frame of each observation by its id."""
    if path is None:
        return None
    frame_of = {}
    for number, row in read_jsonl(path):
        frame = row.get("frame")
        if not is_whole(frame):
            raise input_error("`frame` is no row number", got=frame, file=path, line=number)
        frame_of[str(row["id"]) if row.get("id") is not None else f"line-{number}"] = frame
    return frame_of


def _objects(path: Path) -> dict[str, str | None] | None:
    """True object of each detection from `objects.json` as converters write it, without the rows whose truth is not
    trusted; other files of that name say nothing.
    """
    value = read_json(path) if path.is_file() else None
    value = value if isinstance(value, dict) else {}
    found = value.get("objects")
    if not isinstance(found, dict):
        return None
    trusted = value.get("trusted")
    kept = trusted if isinstance(trusted, list) and len(trusted) == len(found) else [True] * len(found)
    return {str(k): None if v is None else str(v) for (k, v), keep in zip(found.items(), kept) if keep}


def read_run(
    path: str | PathLike[str],
    *,
    odometry: str | PathLike[str] | None = None,
    observations: str | PathLike[str] | None = None,
    truth: str | PathLike[str] | None = None,
    pictures: str | PathLike[str] | None = None,
) -> RunFolder:
    """Read the folder of `nolbo run` or of `nolbo slam`.

    Args:
        path: the folder.
        odometry: trajectory before the correction, when it is not in the folder as `odometry.txt`.
        observations: what SLAM was given, when it is not in the folder as `observations.jsonl`.
        truth: true trajectory, when it is not in the folder as `truth.txt`.
        pictures: folder of the images: those outside of the run's folder and of this one are not read, whatever
            `frames.jsonl` says.

    Raises:
        InputError: no such folder, no trajectory and map in it, or a file that is malformed or does not match.
    """
    path = Path(path)
    if not path.is_dir():
        raise input_error("no such folder of a run", file=path)
    settle(path)
    slam = next((place for place in (path / "slam", path) if (place / "trajectory.txt").is_file()), None)
    if slam is None:
        raise input_error(
            "no result of a run in this folder",
            expected="trajectory.txt or slam/trajectory.txt",
            do="name what --out of `nolbo run` or `nolbo slam` named",
            file=path,
        )

    def place(given: str | PathLike[str] | None, name: str) -> Path | None:
        if given is not None:
            return Path(given)
        return path / name if (path / name).is_file() else None

    answer = read_trajectory(slam / "trajectory.txt")
    estimate, count = answer.T_world_camera, len(answer)
    images, times = _frames(path, count, None if pictures is None else Path(pictures))
    times = answer.times if times is None else times
    truth_given = _rows(place(truth, "truth.txt"), count, times, "the truth")
    landmarks = read_landmarks(slam / "landmarks.json") if (slam / "landmarks.json").is_file() else ()
    names = [x.name for x in landmarks]
    associations = None
    if (slam / "associations.jsonl").is_file():
        associations = read_associations(slam / "associations.jsonl", names, _frame_of(place(observations, "observations.jsonl")))
    return RunFolder(
        path=path,
        slam=slam,
        estimate=estimate,
        landmarks=landmarks,
        odometry=_rows(place(odometry, "odometry.txt"), count, times, "the odometry"),
        truth=None if truth_given is None else align(truth_given, estimate, "pose"),
        truth_given=truth_given,
        times=times,
        images=images,
        intrinsics=_json(path / "intrinsics.json") or None,
        associations=associations,
        iterations=_iterations(slam / "iterations.npz", count),
        objects=_objects(path / "objects.json"),
        run=_json(path / "run.json"),
        summary=_json(path / "summary.json") if slam != path else {},
        slam_summary=_json(slam / "summary.json"),
    )
