"""Tracks of boxes whose depth nobody states: each is a mixture of Gaussians over its ray, weighed by where it is seen next.

An extended Kalman filter of one Gaussian needs a depth to linearise at; here a few stand in parallel along the first ray, each
narrow enough for that (Peach 1995, range-parametrised filters). Those that predict the wrong pixel lose their weight, as the
camera moves; while it does not, the depth stays as open as it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import logsumexp

from nolbo_ppl.inference.association import association_marginals

RATIO = 1.7
"""Ratio of successive depths: a Gaussian between them is 0.26 of its depth wide, where projection is still nearly linear."""
HEIGHT_SCALE = 0.2
"""Standard deviation of the log of a box's height about what the depth predicts, from one view to the next: boxes change with
the side that is seen."""
CATEGORY_ERROR = 0.05
"""Probability that a category differs between two views of one object."""
OUTLIER = 0.05
"""Share of a box's centres that say nothing: gross errors of detectors."""
UNIFORM_LOG_HEIGHT = np.log(3.0)
"""Log heights of boxes lie within about three nats."""
MIN_WEIGHT = 1e-6
"""Depths of less weight are given up."""
MISSED = 0.2
"""Probability that an object with a track is not detected in a frame."""


@dataclass(frozen=True)
class BoxConfig:
    """How boxes are tracked and triangulated."""

    nearest: float = 0.2
    """Least depth, m."""
    farthest: float = 100.0
    """Largest depth, m."""
    gap: int = 8
    """A track ends after this many frames without a detection."""
    birth_rate: float = 1.0
    """Detections of new objects and false ones expected in a frame."""
    minimum_views: int = 3
    """Tracks of fewer detections found no landmark."""
    maximum_spread: float = 0.4
    """Relative standard deviation of the depth above which a track is no landmark yet: parallax was too small."""
    rotation_drift: float = 1e-3
    """Standard deviation of each angle of an odometry step, rad."""
    translation_drift: float = 0.02
    """Standard deviation of each coordinate of an odometry step, m per m."""


@dataclass(frozen=True)
class BoxRays:
    """Boxes of one frame in units of the focal length."""

    direction: Float[np.ndarray, "n 2"]
    """(x / z, y / z) of where the object's centre is seen."""
    scale: Float[np.ndarray, "n 2"]
    """Its standard deviations."""
    shared: Float[np.ndarray, "n 2"]
    """The part of them that is one error for all views of an object."""
    height: Float[np.ndarray, " n"]
    """Height of the box."""
    category: Int[np.ndarray, " n"]
    """Number of the category."""
    depth: Float[np.ndarray, " n"]
    """Depth by the height of the category, m; NaN where nobody knows it."""
    depth_scale: Float[np.ndarray, " n"]
    """Its relative standard deviation."""

    def __len__(self) -> int:
        return len(self.height)

    def select(self, rows: np.ndarray) -> BoxRays:
        """Some of them."""
        names = ("direction", "scale", "shared", "height", "category", "depth", "depth_scale")
        return BoxRays(*(getattr(self, name)[rows] for name in names))


class BoxTracker:
    """Live tracks of boxes, advanced frame by frame.

    Args:
        config: settings.
        view: area of the image in units of the focal length squared.
    """

    def __init__(self, config: BoxConfig, view: float) -> None:
        self.config, self.log_view = config, float(np.log(view))
        count = int(np.ceil(np.log(config.farthest / config.nearest) / np.log(RATIO))) + 1
        self.depths = config.nearest * RATIO ** np.arange(count)
        self.index = np.zeros(0, dtype=np.int64)
        self.mean = np.zeros((0, count, 3))
        self.covariance = np.zeros((0, count, 3, 3))
        self.log_weight = np.zeros((0, count))
        self.log_size = np.zeros((0, count))
        self.category = np.zeros(0, dtype=np.int64)
        self.last = np.zeros(0, dtype=np.int64)
        self.views = np.zeros(0, dtype=np.int64)
        self.total = 0
        self._pose: np.ndarray | None = None

    def step(self, T_world_camera: Float[np.ndarray, "4 4"], frame: int, rays: BoxRays) -> Int[np.ndarray, " n"]:
        """Track of each box of a frame; those without one so far found theirs."""
        self._predict(T_world_camera, frame)
        assigned = np.full(len(rays), -1, dtype=np.int64)
        if not len(rays):
            return assigned
        if len(self.index):
            point, J = self._projected(T_world_camera)
            logs, position = self._log_likelihood(point, J, rays)
            null = np.full(len(rays), np.log(self.config.birth_rate) - self.log_view - UNIFORM_LOG_HEIGHT)
            pair = np.log1p(-MISSED) + logs.T
            weights = np.asarray(association_marginals(pair, null).weights)
            for n, m in np.argwhere(weights > 0.5):
                self._update(int(m), rays, int(n), T_world_camera, point, J, position[m, :, n], frame)
                assigned[n] = self.index[m]
        new = np.flatnonzero(assigned < 0)
        assigned[new] = self._found(T_world_camera, rays.select(new), frame)
        return assigned

    def depth_of(self, track: int, T_world_camera: Float[np.ndarray, "4 4"]) -> tuple[float, float, int]:
        """Mean and standard deviation of a live track's depth in a camera, m, and how often it was seen."""
        m = int(np.flatnonzero(self.index == track)[0])
        forward = T_world_camera[:3, 2]
        z = (self.mean[m] - T_world_camera[:3, 3]) @ forward
        variance = np.einsum("i,kij,j->k", forward, self.covariance[m], forward)
        w = np.exp(self.log_weight[m])
        mean = float(w @ z)
        return mean, float(np.sqrt(w @ (variance + (z - mean) ** 2))), int(self.views[m])

    def _predict(self, T: np.ndarray, frame: int) -> None:
        """Drop tracks not seen for long; widen the others by the drift of the odometry at their distance."""
        live = frame - self.last <= self.config.gap
        for name in ("index", "mean", "covariance", "log_weight", "log_size", "category", "last", "views"):
            setattr(self, name, getattr(self, name)[live])
        if self._pose is not None and len(self.index):
            length = float(np.linalg.norm(T[:3, 3] - self._pose[:3, 3]))
            square = np.sum((self.mean - T[:3, 3]) ** 2, axis=2)
            variance = (self.config.translation_drift * length) ** 2 + self.config.rotation_drift**2 * square
            self.covariance = self.covariance + variance[:, :, None, None] * np.eye(3)
        self._pose = T.copy()

    def _projected(self, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Every mean in the camera, and the derivative of its direction by its place in the world."""
        R = T[:3, :3]
        point = (self.mean - T[:3, 3]) @ R
        z = np.where(point[..., 2] > 1e-3, point[..., 2], np.nan)
        J = np.zeros((*z.shape, 2, 3))
        J[..., 0, 0] = J[..., 1, 1] = 1 / z
        J[..., :2, 2] = -point[..., :2] / (z**2)[..., None]
        return point, J @ R.T

    def _log_likelihood(self, point: np.ndarray, J: np.ndarray, rays: BoxRays) -> tuple[np.ndarray, np.ndarray]:
        """Log likelihood [m, n] of boxes given tracks, and its part [m, k, n] of the directions by depth."""
        spread = J @ self.covariance @ np.swapaxes(J, -1, -2)
        S = spread[:, :, None] + (rays.scale**2)[:, :, None] * np.eye(2)
        gap = rays.direction - (point[..., :2] / point[..., 2:])[:, :, None]
        det = S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] ** 2
        square = (
            S[..., 1, 1] * gap[..., 0] ** 2 - 2 * S[..., 0, 1] * gap[..., 0] * gap[..., 1] + S[..., 0, 0] * gap[..., 1] ** 2
        ) / det
        direction = np.nan_to_num(-0.5 * (square + np.log(det)) - np.log(2 * np.pi), nan=-np.inf, neginf=-np.inf)
        # What the depth makes of the height that the track has had so far.
        expected = self.log_size - np.log(np.maximum(point[..., 2], 1e-3))
        off = np.log(rays.height) - expected[:, :, None]
        height = -0.5 * (off / HEIGHT_SCALE) ** 2 - np.log(HEIGHT_SCALE * np.sqrt(2 * np.pi))
        total = logsumexp(self.log_weight[:, :, None] + direction + height, axis=1)
        same = self.category[:, None] == rays.category
        known = (self.category[:, None] >= 0) & (rays.category >= 0)
        return total + np.where(known & ~same, np.log(CATEGORY_ERROR), 0.0), direction

    def _update(
        self,
        m: int,
        rays: BoxRays,
        n: int,
        T: np.ndarray,
        point: np.ndarray,
        J: np.ndarray,
        direction: np.ndarray,
        frame: int,
    ) -> None:
        """One box to one track: every depth's filter, then the weights, under which gross errors say nothing."""
        ahead = np.isfinite(direction)
        H, C = J[m, ahead], self.covariance[m, ahead]
        S = H @ C @ np.swapaxes(H, 1, 2) + np.diag(rays.scale[n] ** 2)
        gain = C @ np.swapaxes(H, 1, 2) @ np.linalg.inv(S)
        gap = rays.direction[n] - point[m, ahead, :2] / point[m, ahead, 2:]
        square = np.einsum("ki,kij,kj->k", gap, np.linalg.inv(S), gap)
        trust = 1 / (1 + square / 9.0)  # a gross error moves the mean little
        self.mean[m, ahead] += (trust[:, None, None] * gain @ gap[:, :, None])[:, :, 0]
        smaller = C - trust[:, None, None] * (gain @ H @ C)
        self.covariance[m, ahead] = 0.5 * (smaller + np.swapaxes(smaller, 1, 2))
        value = self.log_weight[m] + np.logaddexp(np.log1p(-OUTLIER) + direction, np.log(OUTLIER) - self.log_view)
        value -= logsumexp(value)
        value[value < np.log(MIN_WEIGHT)] = -np.inf
        self.log_weight[m] = value - logsumexp(value)
        z = np.maximum((self.mean[m] - T[:3, 3]) @ T[:3, 2], 1e-3)
        rate = 1 / min(self.views[m] + 1, 4)  # the side that is seen changes
        self.log_size[m] += rate * (np.log(rays.height[n] * z) - self.log_size[m])
        if rays.category[n] >= 0 and self.category[m] < 0:
            self.category[m] = rays.category[n]
        self.last[m], self.views[m] = frame, self.views[m] + 1

    def _found(self, T: np.ndarray, rays: BoxRays, frame: int) -> Int[np.ndarray, " n"]:
        """New tracks along these rays: depths spread evenly by their logarithm, or about that of the category's height."""
        n, count = len(rays), len(self.depths)
        unit = np.column_stack([rays.direction, np.ones(n)])
        along = np.tile((RATIO - 1) / (RATIO + 1), (n, count)) * self.depths
        depth = np.tile(self.depths, (n, 1))
        log_weight = np.full((n, count), -np.log(count))
        known = np.isfinite(rays.depth)
        # Around a known depth the same mixture, weighed by it: an object taller than its kind is still followed.
        off = (np.log(self.depths) - np.log(np.where(known, rays.depth, 1.0))[:, None]) / np.hypot(
            np.where(known, rays.depth_scale, 1.0), 0.3
        )[:, None]
        weighed = -0.5 * off**2
        log_weight[known] = (weighed - logsumexp(weighed, axis=1, keepdims=True))[known]
        R = T[:3, :3]
        place = unit[:, None] * depth[..., None]
        C = np.zeros((n, count, 3, 3))
        C[..., 0, 0], C[..., 1, 1] = (depth * rays.scale[:, :1]) ** 2, (depth * rays.scale[:, 1:]) ** 2
        C += along[..., None, None] ** 2 * (unit[:, :, None] * unit[:, None, :])[:, None]
        new = np.arange(self.total, self.total + n)
        self.total += n
        self.index = np.concatenate([self.index, new])
        self.mean = np.concatenate([self.mean, place @ R.T + T[:3, 3]])
        self.covariance = np.concatenate([self.covariance, R @ C @ R.T])
        self.log_weight = np.concatenate([self.log_weight, log_weight])
        self.log_size = np.concatenate([self.log_size, np.log(rays.height[:, None] * depth)])
        self.category = np.concatenate([self.category, rays.category])
        self.last = np.concatenate([self.last, np.full(n, frame)])
        self.views = np.concatenate([self.views, np.ones(n, dtype=np.int64)])
        return new


def track_boxes(
    frame: Int[np.ndarray, " n"], rays: BoxRays, T_world_camera: Float[np.ndarray, "f 4 4"], config: BoxConfig, view: float
) -> Int[np.ndarray, " n"]:
    """Track of every box of a whole drive.

    Args:
        frame: row of the odometry of each box.
        rays: the boxes.
        T_world_camera: odometry.
        config: settings.
        view: area of the image in units of the focal length squared.
    """
    tracker, track = BoxTracker(config, view), np.full(len(rays), -1, dtype=np.int64)
    order = np.argsort(frame, kind="stable")
    frames, starts = np.unique(frame[order], return_index=True)
    for t, rows in zip(frames.tolist(), np.split(order, starts[1:])):
        track[rows] = tracker.step(T_world_camera[t], t, rays.select(rows))
    return track


def long_enough(track: Int[np.ndarray, " n"], views: int) -> Bool[np.ndarray, " n"]:
    """Boxes of tracks with at least so many."""
    count = np.bincount(track[track >= 0], minlength=int(track.max(initial=-1)) + 1)
    return (track >= 0) & (count[np.maximum(track, 0)] >= views) if len(count) else np.zeros(len(track), dtype=bool)
