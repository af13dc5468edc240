"""What SLAM is given, wherever it comes from: observations with positions, boxes alone, detections of a bag."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from nolbo_ppl.data.converters.foreign_detections import ForeignDetections, read_foreign_detections
from nolbo_ppl.data.converters.placed_boxes import Heights, observations_by_parallax, undistorted
from nolbo_ppl.data.converters.ros_detections import odometry_at, read_bag_detections
from nolbo_ppl.errors import input_error
from nolbo_ppl.io.camera_files import CameraIntrinsics, read_camera
from nolbo_ppl.io.files import read_jsonl
from nolbo_ppl.io.observations import read_observations
from nolbo_ppl.io.ros_bags import is_bag
from nolbo_ppl.io.trajectories import Trajectory, read_trajectory
from nolbo_ppl.io.trajectory_tables import TableFormat
from nolbo_ppl.structures.detections import Detections


@dataclass(frozen=True)
class SlamInputs:
    """Odometry and detections of one drive."""

    odometry: Trajectory
    """Poses, a row a frame."""
    detections: Detections
    """Detections with positions."""
    remarks: tuple[str, ...] = ()
    """What a reader of the figures has to know."""


def holds_boxes_alone(path: Path) -> bool:
    """Whether the first line of a file of observations is a box or a mask without a position."""
    row = next((row for _, row in read_jsonl(path)), {})
    return "position" not in row and ("box" in row or "mask" in row)


def read_slam_inputs(
    odometry: Path,
    observations: Path,
    *,
    form: TableFormat | None = None,
    intrinsics: Path | None = None,
    heights: Heights | None = None,
    minimum_score: float = 0.0,
    causal: bool = False,
) -> SlamInputs:
    """Read odometry and observations.

    Args:
        odometry: a trajectory, or `BAG:/topic`.
        observations: JSON Lines with positions; of boxes or masks alone; or `BAG:/topic` of detections, whose messages are then
            the frames, with poses between those of the odometry.
        form: format of the odometry, where it is not to be told from the file.
        intrinsics: the camera, which boxes alone need.
        heights: height and standard deviation by category, m, for boxes alone; none by default.
        minimum_score: boxes below are left out.
        causal: place boxes as while driving.

    Raises:
        InputError: malformed files, boxes without a camera, or a bag whose detections the odometry does not reach.
    """
    if is_bag(observations):
        seen = read_bag_detections(observations)
        path, known = odometry_at(odometry, seen.times)
        remarks = [] if known.all() else [f"{int((~known).sum())} of {len(known)} frames lie outside of the odometry's times"]
        number = np.cumsum(known) - 1
        inside = known[seen.found.frame]
        found = _select(seen.found, np.flatnonzero(inside))
        found = replace(found, frame=number[found.frame])
        return _placed(path, found, observations, intrinsics, heights, minimum_score, causal, remarks)
    path = read_trajectory(odometry, form)
    if not holds_boxes_alone(observations):
        return SlamInputs(path, read_observations(observations, frames=len(path)))
    found = read_foreign_detections(observations, "lines")
    return _placed(path, found, observations, intrinsics, heights, minimum_score, causal, [])


def _select(found: ForeignDetections, rows: np.ndarray) -> ForeignDetections:
    """Some of the detections."""
    names = ("frame", "box", "score", "position", "rotation", "size", "mask_centre", "covariance")
    values = {name: getattr(found, name) for name in names}
    chosen: dict[str, Any] = {name: None if value is None else value[rows] for name, value in values.items()}
    return ForeignDetections(category=tuple(found.category[k] for k in rows), **chosen)


def _placed(
    odometry: Trajectory,
    found: ForeignDetections,
    file: Path,
    intrinsics: Path | None,
    heights: Heights | None,
    minimum_score: float,
    causal: bool,
    remarks: list[str],
) -> SlamInputs:
    if len(found) and found.frame.max() >= len(odometry):
        expected = f"0 to {len(odometry) - 1}, a row of the odometry"
        raise input_error("`frame` out of range", got=int(found.frame.max()), expected=expected, file=file)
    camera = CameraIntrinsics(1.0, 1.0, 0.0, 0.0)
    if not np.isfinite(found.position).all():
        if intrinsics is None:
            raise input_error("boxes alone need a camera", expected="positions, or --intrinsics", file=file)
        camera = read_camera(intrinsics)
        found = undistorted(found, camera)
    size = (camera.width, camera.height) if camera.width and camera.height else None
    table, left_out = observations_by_parallax(
        found, odometry.T_world_camera, camera.vector, size, heights, minimum_score, causal=causal
    )
    if left_out:
        remarks.append(f"{len(table)} of {len(found)} boxes placed: " + ", ".join(f"{n} {why}" for why, n in left_out.items()))
    return SlamInputs(odometry, table, tuple(remarks))
