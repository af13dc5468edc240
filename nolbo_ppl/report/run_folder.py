"""A run's folder as the report and the viewer take it: everything but the trajectory and the map may be missing."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass, field
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nolbo_ppl.errors import input_error
from nolbo_ppl.io.files import read_json, read_jsonl
from nolbo_ppl.io.trajectories import read_frame_poses, read_trajectory
from nolbo_ppl.metrics.trajectory import align
from nolbo_ppl.report.run_landmarks import RunAssociations, RunLandmark, read_associations, read_landmarks
from nolbo_ppl.viz.map_plots import principal_plane

Poses = Float[np.ndarray, "n 4 4"]


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
        path = self.slam / "landmarks_voxels.npz"
        if not path.is_file():
            return frozenset()
        with _archive(path) as archive:
            return frozenset(name[: -len("/mean")] for name in archive.files if name.endswith("/mean"))

    def voxels(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        """Mean and variance of a landmark's occupancy, [n, n, n]; None without a decoded shape.

        Raises:
            InputError: the file cannot be read.
        """
        if name not in self.voxel_names:
            return None
        path = self.slam / "landmarks_voxels.npz"
        with _archive(path) as archive:
            mean = archive[f"{name}/mean"].astype(np.float64)
            known = f"{name}/variance" in archive.files
            variance = archive[f"{name}/variance"].astype(np.float64) if known else mean * (1 - mean)
        if mean.ndim != 3 or len(set(mean.shape)) != 1 or variance.shape != mean.shape:
            raise input_error(
                "voxels of a landmark", got=f"{name}: {mean.shape}, {variance.shape}", expected="[n, n, n] both", file=path
            )
        return mean, variance

    def crop(self, name: str) -> Path | None:
        """Best picture of a landmark; None when there is none (or the name would lead out of the folder)."""
        folder = self.path / "crops"
        path = folder / f"{name}.png"
        return path if "\0" not in name and path.parent == folder and path.is_file() else None


def _archive(path: Path) -> Any:
    try:
        return np.load(path, allow_pickle=False)
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise input_error("not a readable NPZ file", got=error, file=path) from None


def _json(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    value = read_json(path)
    if not isinstance(value, dict):
        raise input_error("not a JSON object", got=type(value).__name__, file=path)
    return value


def _rows(path: Path | None, count: int, times: np.ndarray | None, what: str) -> Poses | None:
    """Poses of an optional trajectory: rows of the estimate, or rows matched by time."""
    return None if path is None else read_frame_poses(path, count, times, what=what, of="the estimate").T_world_camera


def _iterations(path: Path, count: int) -> Iterations | None:
    if not path.is_file():
        return None
    with _archive(path) as archive:
        if "T_world_camera" not in archive.files:
            raise input_error("iterations without `T_world_camera`", got=archive.files, file=path)
        T = archive["T_world_camera"].astype(np.float64)
        if T.ndim != 4 or T.shape[1:] != (count, 4, 4):
            raise input_error("`T_world_camera` of the iterations", got=T.shape, expected=f"[i, {count}, 4, 4]", file=path)
        landmarks = tuple(
            archive[f"landmarks_{i}"].astype(np.float64).reshape(-1, 3) if f"landmarks_{i}" in archive.files else np.zeros((0, 3))
            for i in range(len(T))
        )
    return Iterations(T, landmarks)


def _frames(folder: Path, count: int) -> tuple[tuple[Path | None, ...], np.ndarray | None]:
    """Pictures and times of the keyframes; a relative picture is looked for beside the run, then from here."""
    path = folder / "frames.jsonl"
    if not path.is_file():
        return (), None
    rows = [row for _, row in read_jsonl(path)]
    if len(rows) != count:
        raise input_error("frames do not match the estimate", got=f"{len(rows)} lines", expected=f"{count}", file=path)
    images = []
    for row in rows:
        given = Path(str(row["image"])) if row.get("image") is not None else None
        tried = [] if given is None else [folder / given, given]
        images.append(next((place for place in tried if place.is_file()), None))
    times = [row.get("time") for row in rows]
    if any(isinstance(t, bool) or not isinstance(t, (int, float)) for t in times):
        return tuple(images), None
    return tuple(images), np.array(times, dtype=np.float64)


def _frame_of(path: Path | None) -> dict[str, int] | None:
    """Frame of each observation by its id."""
    if path is None:
        return None
    frame_of = {}
    for number, row in read_jsonl(path):
        frame = row.get("frame")
        if isinstance(frame, bool) or not isinstance(frame, int):
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
) -> RunFolder:
    """Read the folder of `nolbo run` or of `nolbo slam`.

    Args:
        path: the folder.
        odometry: trajectory before the correction, when it is not in the folder as `odometry.txt`.
        observations: what SLAM was given, when it is not in the folder as `observations.jsonl`.
        truth: true trajectory, when it is not in the folder as `truth.txt`.

    Raises:
        InputError: no such folder, no trajectory and map in it, or a file that is malformed or does not match.
    """
    path = Path(path)
    if not path.is_dir():
        raise input_error("no such folder of a run", file=path)
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
    images, times = _frames(path, count)
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
