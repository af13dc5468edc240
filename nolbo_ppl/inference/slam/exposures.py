"""How often places of the world are in view: what a missed detection is counted against."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.special import logsumexp

from nolbo_ppl.geometry.pose import inverse, transform
from nolbo_ppl.inference.slam.frame_model import PROBABILITY_LIMITS, FrameModel
from nolbo_ppl.inference.slam.measurements import Measurements

CHUNK_CELLS = 1 << 21
"""Numbers of a matrix of frames and points that are held at a time."""
FEW = 10.0
"""Places in view in fewer frames are averaged over: there a miss more or less matters."""
NODES, NODE_WEIGHTS = np.array([-np.sqrt(3.0), 0.0, np.sqrt(3.0)]), np.array([1 / 6, 2 / 3, 1 / 6])
"""Gauss-Hermite nodes of a normal distribution, in standard deviations, and their weights."""


@dataclass(frozen=True)
class Exposures:
    """How often points of the world are in view, by cell of the view.

    Counts, and not one entry for each point and frame: those grow with the square of the laps (36 million, 0.9 GB, for 100 000
    detections on twelve laps).
    """

    count: Int[np.ndarray, "m c"]
    """Frames in which each point is in each cell."""

    def totals(self, model: FrameModel) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
        """Number of exposures of each point and its mean detection probability over them."""
        number = self.count.sum(axis=1).astype(np.float64)
        return number, self.count @ model.detection_probability.ravel() / np.maximum(number, 1.0)

    def by_cell(self, weight: Float[np.ndarray, " m"]) -> Float[np.ndarray, " c"]:
        """Exposures in each cell, every point by its weight."""
        return weight @ self.count


def exposures_of(model: FrameModel, T_world_camera: Float[np.ndarray, "n 4 4"], point: Float[np.ndarray, "m 3"]) -> Exposures:
    """How often points of the world are in view, over all frames."""
    reach, cells = float(model.range_edges[-1]), model.detection_probability.size
    count = np.zeros((len(point), cells), dtype=np.int32)
    T_camera_world = inverse(T_world_camera)
    chunk = int(np.clip(CHUNK_CELLS // max(len(point), 1), 1, 128))
    for start in range(0, len(T_world_camera) if len(point) else 0, chunk):
        centre = T_world_camera[start : start + chunk, :3, 3]
        square = np.sum(centre**2, axis=1)[:, None] + np.sum(point**2, axis=1)[None] - 2 * centre @ point.T
        t, j = np.nonzero(square <= reach**2)
        cell = model.cell(transform(T_camera_world[start + t], point[j]))
        inside = cell >= 0
        np.add.at(count, (j[inside], cell[inside]), 1)
    return Exposures(count)


@dataclass(frozen=True)
class PlaceExposures:
    """Exposures of the places of single detections, averaged over where they can be.

    A place at the rim of the view seems to be in view hardly ever else; but that an object was detected there says that it stands
    where it can be. In 20 worlds without false detections 58 objects were seen once: measured places predict 82, the average
    over the nodes in the plane of the view 59, over 40 samples of the whole covariance 65.
    """

    middle: Exposures
    """Exposures of the measured places."""
    few: Int[np.ndarray, " f"]
    """Detections whose place is in view in few frames."""
    node: tuple[Exposures, ...]
    """Exposures of nine nodes about each of these."""
    cell: Int[np.ndarray, "9 f"]
    """Cell of each node in the frame of its detection, -1 out of view."""

    def weights(self, model: FrameModel) -> Float[np.ndarray, "9 f"]:
        """Posterior weight of each node: prior times the probability of having been detected there."""
        weight = np.outer(NODE_WEIGHTS, NODE_WEIGHTS).reshape(-1, 1)
        weight = weight * model.detection_probability.ravel()[np.maximum(self.cell, 0)] * (self.cell >= 0)
        total = weight.sum(axis=0)
        middle = (np.arange(9) == 4)[:, None]
        return np.where(total > 0, weight / np.maximum(total, 1e-300), middle)

    def log_only_here(self, model: FrameModel) -> Float[np.ndarray, " n"]:
        """Log probability that an object detected there is missed in all other frames."""
        out = _log_only_here(model, self.middle)
        if len(self.few):
            log_weight = np.log(np.maximum(self.weights(model), 1e-300))
            parts = log_weight + np.array([_log_only_here(model, exposures) for exposures in self.node])
            out[self.few] = logsumexp(parts, axis=0)
        return out


def _log_only_here(model: FrameModel, exposures: Exposures) -> Float[np.ndarray, " n"]:
    count, chance = exposures.totals(model)
    chance = np.clip(chance, *PROBABILITY_LIMITS)
    return model.log_pattern(np.ones(len(count)), np.maximum(count, 1.0), chance) - np.log(chance)


def exposures_of_places(model: FrameModel, T_world_camera: Float[np.ndarray, "n 4 4"], seen: Measurements) -> PlaceExposures:
    """Exposures of the places of detections.

    Args:
        model: cells of the view.
        T_world_camera: camera poses.
        seen: the detections, in camera frames.
    """
    middle = exposures_of(model, T_world_camera, transform(T_world_camera[seen.frame], seen.position))
    few = np.flatnonzero(middle.count.sum(axis=1) < FEW)
    seen = seen.select(few)
    T = T_world_camera[seen.frame]
    distance = np.maximum(np.linalg.norm(seen.position, axis=1, keepdims=True), 1e-9)
    ray = seen.position / distance
    across = np.stack([ray[:, 2], np.zeros(len(few)), -ray[:, 0]], axis=1)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    along_scale, across_scale = (np.sqrt(np.einsum("ni,nij,nj->n", u, seen.covariance, u))[:, None] for u in (ray, across))
    nodes, cells = [], []
    for along, aside in itertools.product(NODES, NODES):
        position = ray * np.maximum(distance + along * along_scale, 0.05 * distance) + aside * across_scale * across
        cells.append(model.cell(position))
        nodes.append(exposures_of(model, T_world_camera, transform(T, position)))
    return PlaceExposures(middle, few, tuple(nodes), np.array(cells).reshape(9, -1))
