"""Boxes as observations of SLAM: each on its own ray, at the depth its whole track tells, as uncertain along it as one view is.

SLAM's graph must triangulate anew, with the poses it corrects: what a track knows of the depth is where its observations
are linearised, not a measurement. An observation is therefore wide along its ray, `SHARE` standard deviations of the whole track
times the root of its number of views: all of them together add 1 / SHARE^2 of the information that their directions hold. The
height of a category, which is evidence of its own, counts once for a track, however many views repeat it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from nolbo_ppl.errors import input_error
from nolbo_ppl.inference.slam.boxes.box_tracker import BoxConfig, BoxRays, BoxTracker, long_enough, track_boxes
from nolbo_ppl.inference.slam.boxes.box_triangulation import triangulate

SHARE = 3.0
"""How wide along the ray: 1 / SHARE^2 is the part of the information on depth that is counted twice."""
CENTRE_SHARE = 0.05
"""Standard deviation of a box's centre from the object's, in parts of the box, ..."""
SHARED_CENTRE = 0.03
"""... and the part of it that all views of an object have in common: a box's centre is not the projection of the object's.
Looking again does not average it out."""
MIN_PIXELS = 1.0
"""Least standard deviation of a box's centre, px."""
MISFIT = 3.0
"""Root mean square residual above which a track is of no one static object."""
HEIGHT_NOISE = 0.05
"""Relative error of a box's height."""


@dataclass(frozen=True)
class BoxPlacement:
    """Positions of boxes in their cameras."""

    position: Float[np.ndarray, "n 3"]
    """Camera frame, m; NaN where there is none."""
    covariance: Float[np.ndarray, "n 3 3"]
    """m^2."""
    shared: Float[np.ndarray, "n 3 3"]
    """The part of it that is one error for all views of an object, m^2."""
    track: Int[np.ndarray, " n"]
    """Number of the track."""
    reason: tuple[str, ...]
    """Why a box has no position; "" where it has one."""

    @property
    def placed(self) -> Bool[np.ndarray, " n"]:
        """Boxes with a position."""
        return np.isfinite(self.position[:, 0])

    def counts(self) -> dict[str, int]:
        """How many have none, by reason."""
        return {name: self.reason.count(name) for name in sorted(set(self.reason) - {""})}


def rays_of(
    box: Float[np.ndarray, "n 4"],
    category: Sequence[str],
    intrinsics: Float[np.ndarray, " 4"],
    centre: Float[np.ndarray, "n 2"] | None,
    height: Float[np.ndarray, " n"] | None,
    height_scale: Float[np.ndarray, " n"] | None,
) -> BoxRays:
    """Boxes in units of the focal length, with the depth that heights of categories tell (NaN: nobody knows).

    Raises:
        InputError: arrays of different lengths.
    """
    n = len(box)
    for name, values in (("category", category), ("centre", centre), ("height", height), ("height_scale", height_scale)):
        if values is not None and len(values) != n:
            raise input_error(f"`{name}` has another length", got=len(values), expected=n)
    centre = 0.5 * (box[:, :2] + box[:, 2:]) if centre is None else centre
    height, height_scale = (np.full(n, np.nan) if values is None else values for values in (height, height_scale))
    extent = box[:, 2:] - box[:, :2]
    names = sorted(set(category))
    tall = extent[:, 1] / intrinsics[1]
    return BoxRays(
        direction=(centre - intrinsics[2:]) / intrinsics[:2],
        scale=np.maximum(CENTRE_SHARE * extent, np.hypot(MIN_PIXELS, SHARED_CENTRE * extent)) / intrinsics[:2],
        shared=SHARED_CENTRE * extent / intrinsics[:2],
        height=tall,
        category=np.array([names.index(name) for name in category], dtype=np.int64),
        depth=height / tall,
        depth_scale=np.hypot(height_scale / height, HEIGHT_NOISE),
    )


def _observation(
    rays: BoxRays, row: int, z: float, spread: float, views: int
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]]:
    """Position, covariance and its shared part of one view of a track; `spread`: of the depth without heights."""
    unit = np.array([*rays.direction[row], 1.0])
    information = 1 / (SHARE**2 * views * (spread * z) ** 2)
    if np.isfinite(rays.depth[row]):
        information += 1 / (views * (rays.depth_scale[row] * z) ** 2)
    along = unit / np.sqrt(information)
    across = np.diag([*(z * rays.scale[row]), 1e-3 * z]) ** 2
    return z * unit, across + np.outer(along, along), np.diag([*(z * rays.shared[row]), 0.0]) ** 2


def place_boxes(
    frame: Int[np.ndarray, " n"],
    box: Float[np.ndarray, "n 4"],
    category: Sequence[str],
    T_world_camera: Float[np.ndarray, "f 4 4"],
    intrinsics: Float[np.ndarray, " 4"],
    size: tuple[int, int],
    *,
    centre: Float[np.ndarray, "n 2"] | None = None,
    height: Float[np.ndarray, " n"] | None = None,
    height_scale: Float[np.ndarray, " n"] | None = None,
    config: BoxConfig | None = None,
) -> BoxPlacement:
    """Positions of the boxes of a whole drive, by the parallax that the odometry tells and by heights where they are known.

    Args:
        frame: row of the odometry of each box.
        box: x0 y0 x1 y1, px, of images without distortion.
        category: name of each.
        T_world_camera: odometry.
        intrinsics: fx fy cx cy, px.
        size: width and height of the images, px.
        centre: where the object's centre is seen, px; the box's by default.
        height: height of the object, m, NaN where nobody knows it, with its standard deviation.
        height_scale: m.
        config: settings.

    Raises:
        InputError: a frame without a row of the odometry, or arrays of different lengths.
    """
    n, config = len(frame), config or BoxConfig()
    if len(box) != n:
        raise input_error("`box` has another length", got=len(box), expected=n)
    outside = frame[(frame < 0) | (frame >= len(T_world_camera))]
    if len(outside):
        raise input_error(
            "frame of a box", got=int(outside[0]), expected=f"0 to {len(T_world_camera) - 1}, a row of the odometry"
        )
    rays = rays_of(box, category, intrinsics, centre, height, height_scale)
    view = float(np.prod(np.array(size) / intrinsics[:2]))
    track = track_boxes(frame, rays, T_world_camera, config, view)
    position, (covariance, shared) = np.full((n, 3), np.nan), np.full((2, n, 3, 3), np.nan)
    own = np.sqrt(rays.scale**2 - rays.shared**2)
    reason = np.full(n, "seen too rarely", dtype=object)
    kept = long_enough(track, config.minimum_views)
    order = np.flatnonzero(kept)[np.argsort(track[kept], kind="stable")]
    for rows in np.split(order, np.flatnonzero(np.diff(track[order])) + 1) if len(order) else []:
        poses = T_world_camera[frame[rows]]
        begin, prior = _beginning(rays, rows, config)
        seen = (poses, rays.direction[rows], own[rows], begin)
        steps = np.diff(frame[rows]), np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        drift = np.column_stack([config.rotation_drift * np.sqrt(steps[0]), config.translation_drift * steps[1]])
        found = triangulate(*seen, prior, rays.shared[rows], drift)
        free = found if prior is None else triangulate(*seen, None, rays.shared[rows], drift)
        z = np.einsum("ni,ni->n", found.position - poses[:, :3, 3], poses[:, :3, 2])
        if found.misfit > MISFIT or (z <= 0.5 * config.nearest).any():
            reason[rows] = "not one static object"
        elif found.depth_spread > config.maximum_spread:
            reason[rows] = "too little parallax"
        else:
            reason[rows] = ""
            for row, depth in zip(rows, z):
                placed = _observation(rays, int(row), float(depth), free.depth_spread, len(rows))
                position[row], covariance[row], shared[row] = placed
    return BoxPlacement(position, covariance, shared, track, tuple(reason.tolist()))


def _beginning(rays: BoxRays, rows: np.ndarray, config: BoxConfig) -> tuple[np.ndarray, tuple[float, float] | None]:
    """Depths in the middle view to begin with, and that of the category's height where it is known."""
    middle = rows[len(rows) // 2]
    if not np.isfinite(rays.depth[middle]):
        return np.geomspace(config.nearest, config.farthest, 16), None
    # Heights of all views, each carried to the middle one by the ratio of the boxes: their errors are one object's.
    own = float(np.median(rays.depth[rows] * rays.height[rows])) / float(rays.height[middle])
    return own * np.array([0.7, 1.0, 1.4]), (own, float(np.median(rays.depth_scale[rows])))


class BoxPlacer:
    """Boxes placed while they come in, by what was seen up to now: for `IncrementalSlam`.

    Args:
        intrinsics: fx fy cx cy, px.
        size: width and height of the images, px.
        config: settings.
    """

    def __init__(self, intrinsics: Float[np.ndarray, " 4"], size: tuple[int, int], config: BoxConfig | None = None) -> None:
        self._numbers: dict[str, int] = {}
        self.intrinsics = np.asarray(intrinsics, dtype=np.float64)
        self.config = config or BoxConfig()
        self.tracker = BoxTracker(self.config, float(np.prod(np.array(size) / self.intrinsics[:2])))
        self._frame = 0

    def place(
        self,
        T_world_camera: Float[np.ndarray, "4 4"],
        box: Float[np.ndarray, "n 4"],
        category: Sequence[str],
        *,
        centre: Float[np.ndarray, "n 2"] | None = None,
        height: Float[np.ndarray, " n"] | None = None,
        height_scale: Float[np.ndarray, " n"] | None = None,
    ) -> BoxPlacement:
        """Positions of the boxes of the next frame; those whose track has not enough parallax yet have none.

        Args:
            T_world_camera: odometry of the frame.
            box: x0 y0 x1 y1, px.
            category: name of each.
            centre: where the object's centre is seen, px; the box's by default.
            height: height of the object, m, NaN where nobody knows it.
            height_scale: its standard deviation, m.

        Raises:
            InputError: arrays of different lengths.
        """
        n = len(box)
        rays = rays_of(box, category, self.intrinsics, centre, height, height_scale)
        numbers = np.array([self._numbers.setdefault(name, len(self._numbers)) for name in category], dtype=np.int64)
        rays = replace(rays, category=numbers)  # the same in every frame
        track = self.tracker.step(T_world_camera, self._frame, rays)
        self._frame += 1
        position, (covariance, shared) = np.full((n, 3), np.nan), np.full((2, n, 3, 3), np.nan)
        reason = ["seen too rarely"] * n
        for row in range(n):
            z, scale, views = self.tracker.depth_of(int(track[row]), T_world_camera)
            if views < self.config.minimum_views:
                continue
            if z <= 0.5 * self.config.nearest or scale > self.config.maximum_spread * z:
                reason[row] = "too little parallax"
                continue
            reason[row] = ""
            position[row], covariance[row], shared[row] = _observation(rays, row, z, scale / z, views)
        return BoxPlacement(position, covariance, shared, track, tuple(reason))
