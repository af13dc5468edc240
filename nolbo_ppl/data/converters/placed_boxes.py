"""Boxes alone as observations for SLAM: by the parallax of an odometry, with heights of categories where they are known."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nolbo_ppl.data.converters.foreign_detections import RIM, ForeignDetections, is_whole
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.distortion import undistort_boxes
from nolbo_ppl.inference.slam.boxes.box_placement import BoxPlacer, place_boxes
from nolbo_ppl.inference.slam.boxes.box_tracker import BoxConfig
from nolbo_ppl.io.camera_files import CameraIntrinsics
from nolbo_ppl.io.fields import number_array
from nolbo_ppl.io.files import read_json
from nolbo_ppl.structures.detections import Detections

Heights = Mapping[str, tuple[float, float]]
"""Height and its standard deviation by category, m."""


def read_heights(path: Path) -> dict[str, tuple[float, float]]:
    """`{"category": [height, standard deviation], ...}` in m. Raises `InputError` where it is anything else."""
    given = read_json(path)
    values = number_array(list(given.values()) if isinstance(given, dict) else None, (None, 2))
    if values is None or not (values > 0).all():
        raise input_error("heights", expected='{"category": [height, standard deviation], ...} in m', file=path)
    return {name: (float(h), float(s)) for name, (h, s) in zip(given, values)}


def undistorted(found: ForeignDetections, camera: CameraIntrinsics) -> ForeignDetections:
    """Boxes and centres of masks as a pinhole camera would have them."""
    if camera.model is None:
        return found
    box = undistort_boxes(found.box, camera.vector, camera.model, camera.distortion)
    moved = 0.5 * (box - found.box).reshape(-1, 2, 2).sum(axis=1)
    return replace(found, box=box, mask_centre=None if found.mask_centre is None else found.mask_centre + moved)


def observations_by_parallax(
    found: ForeignDetections,
    T_world_camera: Float[np.ndarray, "f 4 4"],
    intrinsics: Float[np.ndarray, " 4"],
    size: tuple[int, int] | None = None,
    heights: Heights | None = None,
    minimum_score: float = 0.0,
    *,
    causal: bool = False,
    config: BoxConfig | None = None,
) -> tuple[Detections, dict[str, int]]:
    """Observations for SLAM of boxes whose depth nobody states, and how many were left out and why.

    Each box gets the depth that its track over the images has by the odometry's parallax, and a covariance that is long along
    its ray (`nolbo_ppl.inference.slam.boxes`). Boxes whose track has too little of it are no observations yet. Detections that
    state their position keep it.

    Args:
        found: detections; `frame` is a row of the odometry.
        T_world_camera: odometry.
        intrinsics: fx, fy, cx, cy, px, of images without distortion.
        size: width and height of the images: boxes at the rim are cut off, and left out.
        heights: height and standard deviation by category, m, of those that are known; none by default.
        minimum_score: detections below are left out.
        causal: place each box by what was seen up to its frame, as while driving.
        config: settings of the tracks.

    Raises:
        InputError: a frame that is no row of the odometry.
    """
    n, heights = len(found), heights or {}
    reason = np.full(n, "", dtype=object)
    placed = np.isfinite(found.position).all(axis=1)
    limit = np.array(size, dtype=np.float64) if size is not None else np.nanmax(found.box[:, 2:], axis=0, initial=1.0) + 2 * RIM
    reason[~placed & ~is_whole(found.box, limit)] = "cut off by the image"
    reason[found.score < minimum_score] = "below the score"
    rows = np.flatnonzero((reason == "") & ~placed)
    tall = np.array([heights.get(name, (np.nan, np.nan)) for name in found.category], dtype=np.float64).reshape(-1, 2)
    position, (covariance, shared) = found.position.copy(), np.full((2, n, 3, 3), np.nan)
    if found.covariance is not None:
        covariance[placed] = found.covariance[placed]
    area = (int(limit[0]), int(limit[1]))
    if causal:
        placer = BoxPlacer(intrinsics, area, config)
        for t, T in enumerate(T_world_camera):
            now = rows[found.frame[rows] == t]
            answer = placer.place(
                T,
                found.box[now],
                [found.category[k] for k in now],
                centre=found.centre[now],
                height=tall[now, 0],
                height_scale=tall[now, 1],
            )
            position[now], covariance[now], shared[now] = answer.position, answer.covariance, answer.shared
            reason[now] = list(answer.reason)
    elif len(rows):
        answer = place_boxes(
            found.frame[rows],
            found.box[rows],
            [found.category[k] for k in rows],
            T_world_camera,
            intrinsics,
            area,
            centre=found.centre[rows],
            height=tall[rows, 0],
            height_scale=tall[rows, 1],
            config=config,
        )
        position[rows], covariance[rows], shared[rows] = answer.position, answer.covariance, answer.shared
        reason[rows] = list(answer.reason)
    table = found.placed(np.flatnonzero(reason == ""), position, covariance, shared)
    return table, dict(sorted(Counter(name for name in reason.tolist() if name).items()))
