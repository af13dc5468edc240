"""The folder of a run: every file in it has its reader and its writer here, for the pipeline, the report, the viewer, scores.

Everything but the trajectory may be missing. A file is read when it is first asked for; what is written is remembered, so that
a later stage of the same run does not read it again.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.alignment import align, principal_plane
from nolbo_ppl.io.camera_files import CameraIntrinsics, write_camera
from nolbo_ppl.io.fields import number_array
from nolbo_ppl.io.files import inside, read_json_object, read_jsonl, write_json, write_jsonl
from nolbo_ppl.io.landmark_views import LandmarkViews, read_views
from nolbo_ppl.io.landmarks import (
    Iterations,
    Voxels,
    read_associations,
    read_iterations,
    read_landmarks,
    read_voxels,
    voxel_names,
)
from nolbo_ppl.io.npz import Npz, save_npz
from nolbo_ppl.io.observations import read_observations, write_observations
from nolbo_ppl.io.output_folder import settle
from nolbo_ppl.io.trajectories import Trajectory, covariance_beside, read_frame_poses, read_trajectory, write_trajectory
from nolbo_ppl.io.true_objects import trusted_objects
from nolbo_ppl.structures.association_table import AssociationTable
from nolbo_ppl.structures.detections import Detections
from nolbo_ppl.structures.landmark import Landmark

Poses = Float[np.ndarray, "n 4 4"]
FORMAT = 2
"""Format of the folder, `format` in `run.json`. 1: version 0.1.0, which did not state it; the files are the same."""
RECORD = "run.json"
"""What a run folder says of itself."""


class RunFolder:
    """What is in the folder of `nolbo run` or of `nolbo slam`.

    Args:
        path: the folder.
        odometry: trajectory before the correction, when it is not in the folder as `odometry.txt`.
        observations: what SLAM was given, when it is not in the folder as `observations.jsonl`.
        truth: true trajectory, when it is not in the folder as `truth.txt`.
        pictures: folder of the images: those outside of the run's folder and of this one are not read, whatever
            `frames.jsonl` says.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        *,
        odometry: str | PathLike[str] | None = None,
        observations: str | PathLike[str] | None = None,
        truth: str | PathLike[str] | None = None,
        pictures: str | PathLike[str] | None = None,
    ) -> None:
        self.path, self.pictures = Path(path), None if pictures is None else Path(pictures)
        self.elsewhere = {
            name: Path(given)
            for name, given in (("odometry.txt", odometry), ("observations.jsonl", observations), ("truth.txt", truth))
            if given is not None
        }

    def __len__(self) -> int:
        return len(self.estimate)

    def file(self, name: str) -> Path | None:
        """A file beside the answer, or the one that was named in its place; None when there is none."""
        path = self.elsewhere.get(name, self.path / name)
        return path if name in self.elsewhere or path.is_file() else None

    def _keep(self, **values: Any) -> None:
        """Remember what was written."""
        self.__dict__.update(values)

    # -- what the run is made from -----------------------------------------------------------------------------------------

    @cached_property
    def frames(self) -> tuple[dict[str, Any], ...]:
        """Rows of `frames.jsonl`: `frame`, `image`, `index` in the sequence, `time`; none where nobody listed them."""
        path = self.path / "frames.jsonl"
        return tuple(row for _, row in read_jsonl(path)) if path.is_file() else ()

    def write_frames(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Write `frames.jsonl`, a row a keyframe."""
        write_jsonl(self.path / "frames.jsonl", (dict(row) for row in rows))
        self._keep(frames=tuple(dict(row) for row in rows))

    @property
    def image_names(self) -> tuple[str, ...]:
        """Image of every keyframe, as `frames.jsonl` has it."""
        return tuple(str(row["image"]) for row in self.frames)

    @property
    def keyframes(self) -> Int[np.ndarray, " n"]:
        """Index in the sequence of every keyframe."""
        return np.array([row["index"] for row in self.frames], dtype=np.int64)

    @cached_property
    def images(self) -> tuple[Path | None, ...]:
        """Picture of each keyframe, None where it is not found in the folders; empty when none are listed."""
        return tuple(self._picture(row.get("image")) for row in self.frames)

    def _picture(self, name: object) -> Path | None:
        """The file of a picture, where it lies within one of the folders: a file names it, and may have come from anywhere."""
        if not isinstance(name, str):
            return None
        tried = [inside(self.path, name)]
        if self.pictures is not None:
            given = (self.path / name).resolve()
            tried.append(inside(self.pictures, os.path.relpath(given, self.pictures.resolve())))
            tried.append(inside(self.pictures, Path(name).name))
        return next((place for place in tried if place is not None and place.is_file()), None)

    @cached_property
    def times(self) -> Float[np.ndarray, " n"] | None:
        """Seconds of every keyframe, None where they are not known."""
        stated = number_array([row.get("time") for row in self.frames], (None,))
        if stated is not None and len(stated):
            return stated
        answer = self.slam / "trajectory.txt"
        return read_trajectory(answer).times if answer.is_file() else None

    @cached_property
    def intrinsics(self) -> dict[str, float] | None:
        """`intrinsics.json`."""
        return _json(self.path / "intrinsics.json") or None

    def write_camera(self, camera: CameraIntrinsics) -> None:
        """Write `intrinsics.json`."""
        write_camera(self.path / "intrinsics.json", camera)

    @cached_property
    def odometry(self) -> Poses | None:
        """Trajectory before the correction, T_world_camera."""
        return self._poses("odometry.txt", "the odometry")

    @property
    def odometry_covariance(self) -> Float[np.ndarray, "s 6 6"] | None:
        """Covariance of every step of the odometry, [rotation rad, translation m]."""
        return covariance_beside(self.elsewhere.get("odometry.txt", self.path / "odometry.txt"))

    @cached_property
    def odometry_flags(self) -> UInt8[np.ndarray, " s"] | None:
        """`StepFlag` bits of the steps of visual odometry; None where the odometry was given."""
        path = self.path / "odometry_covariance.npz"
        if "odometry.txt" in self.elsewhere or not path.is_file():
            return None
        with Npz(path) as archive:
            return archive.array("flags", (None,)) if "flags" in archive.names else None

    def write_odometry(
        self,
        T_world_camera: Poses,
        covariance: Float[np.ndarray, "s 6 6"] | None = None,
        flags: UInt8[np.ndarray, " s"] | None = None,
    ) -> None:
        """Write `odometry.txt` and, where it is known, `odometry_covariance.npz` with what its steps lacked (`StepFlag` bits)."""
        if covariance is not None:
            arrays = {"covariance": covariance} | ({} if flags is None else {"flags": flags})
            save_npz(self.path / "odometry_covariance.npz", arrays)
        write_trajectory(self.path / "odometry.txt", Trajectory(T_world_camera))
        self.__dict__.pop("odometry", None)  # a file holds fewer digits: what is read is what a second run reads

    @cached_property
    def truth_given(self) -> Poses | None:
        """True poses as the file has them; NaN where the truth is not known."""
        return self._poses("truth.txt", "the truth")

    @cached_property
    def truth(self) -> Poses | None:
        """True poses in the run's own world: moved rigidly onto the estimate."""
        return None if self.truth_given is None else align(self.truth_given, self.estimate, "pose")

    def write_ground_truth(self, T_world_camera: Poses) -> None:
        """Write `truth.txt`."""
        write_trajectory(self.path / "truth.txt", Trajectory(T_world_camera))
        self.__dict__.pop("truth_given", None)

    @cached_property
    def detections(self) -> Detections | None:
        """What SLAM was given; None when it is not at hand."""
        path = self.file("observations.jsonl")
        return None if path is None else read_observations(path)

    def write_detections(self, detections: Detections) -> None:
        """Write `observations.jsonl`."""
        write_observations(self.path / "observations.jsonl", detections)
        self.__dict__.pop("detections", None)

    # -- the answer --------------------------------------------------------------------------------------------------------

    @property
    def slam(self) -> Path:
        """The folder with the answer: `slam/` inside, or the folder itself when the answer lies there."""
        alone = (self.path / "trajectory.txt").is_file() and not (self.path / "slam" / "trajectory.txt").is_file()
        return self.path if alone else self.path / "slam"

    @cached_property
    def estimate(self) -> Poses:
        """Corrected T_world_camera, one row a keyframe."""
        return read_trajectory(self.slam / "trajectory.txt").T_world_camera

    @cached_property
    def landmarks(self) -> tuple[Landmark, ...]:
        """The map."""
        path = self.slam / "landmarks.json"
        return read_landmarks(path) if path.is_file() else ()

    @cached_property
    def associations(self) -> AssociationTable | None:
        """Weights of every detection, in the order of the observations; None where they were not kept."""
        path = self.slam / "associations.jsonl"
        if not path.is_file():
            return None
        seen = self.detections
        frame_of = None if seen is None else dict(zip(seen.id, seen.frame.tolist()))
        return read_associations(path, [landmark.name for landmark in self.landmarks], frame_of)

    @cached_property
    def associations_in_time(self) -> AssociationTable | None:
        """The same in the order of time."""
        return None if self.associations is None else self.associations.in_time()

    @cached_property
    def iterations(self) -> Iterations | None:
        """Where EM stood after every iteration; None where it was not kept."""
        path = self.slam / "iterations.npz"
        return read_iterations(path, len(self)) if path.is_file() else None

    @cached_property
    def _voxels(self) -> Npz | None:
        """The file of voxels, open: its table of contents is read once."""
        path = self.slam / "landmarks_voxels.npz"
        return Npz(path) if path.is_file() else None

    @property
    def voxel_names(self) -> frozenset[str]:
        """Landmarks with a decoded shape."""
        return frozenset() if self._voxels is None else voxel_names(self._voxels)

    def voxels(self, name: str) -> Voxels | None:
        """Mean and variance of a landmark's occupancy, [n, n, n]; None without a decoded shape.

        Raises:
            InputError: the file cannot be read.
        """
        return read_voxels(self._voxels, name) if self._voxels is not None and name in self.voxel_names else None

    @cached_property
    def slam_summary(self) -> dict[str, Any]:
        """`summary.json` of the answer: errors, evidence by iteration, scales, warnings."""
        return _json(self.slam / "summary.json")

    # -- what was made of it -----------------------------------------------------------------------------------------------

    @property
    def crops(self) -> Path:
        """Folder with the best picture of each landmark."""
        return self.path / "crops"

    def crop(self, name: str) -> Path | None:
        """Best picture of a landmark; None when there is none (or the name would lead out of the folder)."""
        path = inside(self.path, f"crops/{name}.png")
        return path if path is not None and path.parent == self.crops and path.is_file() else None

    @cached_property
    def views(self) -> dict[str, LandmarkViews]:
        """Pictures of the views of each landmark; none where nobody cut them out."""
        return read_views(self.crops)

    @property
    def mesh(self) -> Path:
        """The map's shapes as one file of glTF."""
        return self.path / "map.glb"

    @cached_property
    def objects(self) -> dict[str, str | None] | None:
        """True object of each detection by its id (`trusted_objects`); None when nobody said anything."""
        path = self.path / "objects.json"
        return trusted_objects(path) if path.is_file() else None

    def write_objects(self, objects: Mapping[str, str | None]) -> None:
        """Write `objects.json`: the true object of each detection by its id, None for none."""
        write_json(self.path / "objects.json", {"objects": dict(objects)})
        self._keep(objects=dict(objects))

    @cached_property
    def record(self) -> dict[str, Any]:
        """`run.json`: options, versions, seconds of the stages; empty without one.

        Raises:
            InputError: it was written by a later version.
        """
        record = _json(self.path / RECORD)
        check_format(record, self.path / RECORD)
        return record

    @cached_property
    def summary(self) -> dict[str, Any]:
        """`summary.json` of the run; empty for the folder of `nolbo slam`, whose summary is that of the answer."""
        return {} if self.slam == self.path else _json(self.path / "summary.json")

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Write `summary.json`."""
        write_json(self.path / "summary.json", dict(summary))
        self._keep(summary=dict(summary))

    # -- views of it -------------------------------------------------------------------------------------------------------

    @cached_property
    def plane(self) -> tuple[int, int]:
        """The two axes seen from above."""
        return principal_plane(self.estimate[:, :3, 3])

    @cached_property
    def categories(self) -> tuple[str, ...]:
        """Categories of the landmarks, sorted."""
        return tuple(sorted({x.category for x in self.landmarks if x.category is not None}))

    @property
    def trajectory_errors(self) -> dict[str, dict[str, float]]:
        """Errors `before` and `after`, as the answer's summary states them; empty where no truth was given when it was made."""
        stated = {name: self.slam_summary.get(name) for name in ("before", "after")}
        return {name: value for name, value in stated.items() if isinstance(value, dict)}

    def _poses(self, name: str, what: str) -> Poses | None:
        """Poses of an optional trajectory: a row a keyframe, or rows matched by time."""
        path = self.file(name)
        if path is None:
            return None
        if not (self.slam / "trajectory.txt").is_file():  # before there is an answer
            return read_trajectory(path, lost=True).T_world_camera
        return read_frame_poses(path, len(self), self.times, what=what, of="the estimate").T_world_camera


def _json(path: Path) -> dict[str, Any]:
    return read_json_object(path) if path.is_file() else {}


def check_format(record: Mapping[str, Any], file: Path) -> None:
    """Refuse a record of a later format than this version knows. Raises `InputError`."""
    stated = record.get("format", 1)
    if not isinstance(stated, int) or isinstance(stated, bool) or not 1 <= stated <= FORMAT:
        raise input_error(
            "a run folder of another format", got=stated, expected=f"1 to {FORMAT}", do="update nolbo_ppl to read it", file=file
        )


def read_run(
    path: str | PathLike[str],
    *,
    odometry: str | PathLike[str] | None = None,
    observations: str | PathLike[str] | None = None,
    truth: str | PathLike[str] | None = None,
    pictures: str | PathLike[str] | None = None,
    unfinished: bool = False,
) -> RunFolder:
    """Read the folder of `nolbo run` or of `nolbo slam`, all of it but voxels, so that what is wrong is said at once.

    Args:
        path: the folder.
        odometry: trajectory before the correction, when it is not in the folder as `odometry.txt`.
        observations: what SLAM was given, when it is not in the folder as `observations.jsonl`.
        truth: true trajectory, when it is not in the folder as `truth.txt`.
        pictures: folder of the images: those outside of the run's folder and of this one are not read, whatever
            `frames.jsonl` says.
        unfinished: before there is a result, the odometry stands for the estimate.

    Raises:
        InputError: no such folder, no trajectory and map in it, or a file that is malformed or does not match.
    """
    run = RunFolder(path, odometry=odometry, observations=observations, truth=truth, pictures=pictures)
    if not run.path.is_dir():
        raise input_error("no such folder of a run", file=run.path)
    settle(run.path)
    if unfinished and not (run.slam / "trajectory.txt").is_file() and run.odometry is not None:
        run._keep(estimate=run.odometry)
    elif not (run.slam / "trajectory.txt").is_file():
        raise input_error(
            "no result of a run in this folder",
            expected="trajectory.txt or slam/trajectory.txt",
            do="name what --out of `nolbo run` or `nolbo slam` named",
            file=run.path,
        )
    if run.frames and len(run.frames) != len(run):
        raise input_error(
            "frames do not match the estimate",
            got=f"{len(run.frames)} lines",
            expected=f"{len(run)}",
            file=run.path / "frames.jsonl",
        )
    for name in ("landmarks", "odometry", "truth", "times", "intrinsics", "associations", "iterations", "objects", "record"):
        getattr(run, name)
    _ = run.summary, run.slam_summary
    return run
