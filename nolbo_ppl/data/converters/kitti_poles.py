"""KITTI odometry with the real pole map of each drive: simulated detections of real landmarks on real trajectories."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nolbo_ppl.data.converters.converted import Converted, existing
from nolbo_ppl.data.simulate import DetectorConfig, SimulatedWorld, simulate_detections
from nolbo_ppl.errors import input_error
from nolbo_ppl.io.npz import read_npy
from nolbo_ppl.io.trajectories import Trajectory, read_trajectory
from nolbo_ppl.structures.detections import Detections


def pole_positions(poles: Float[np.ndarray, "m 2"], truth: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "m 3"]:
    """Poles (x forward, y left of camera 0) in its camera frame, each at the height of the nearest camera pose."""
    flat = np.stack([-poles[:, 1], poles[:, 0]], axis=1)
    nearest = [int(np.argmin(np.sum((truth[:, [0, 2], 3] - p) ** 2, axis=1))) for p in flat]
    return np.stack([flat[:, 0], truth[nearest, 1, 3], flat[:, 1]], axis=1).reshape(len(poles), 3)


def convert_kitti_poles(
    data: str | PathLike[str],
    sequence: str,
    *,
    odometry: str = "odometry_f2f",
    every: int = 1,
    seed: int = 0,
    position_scale: float = 0.1,
    position_ratio: float = 0.03,
    miss_rate: float = 0.15,
    clutter_rate: float = 0.5,
    maximum_range: float = 30.0,
    field_of_view: float = 2.0,
) -> Converted:
    """Simulate position-only detections of the pole map of one drive.

    Args:
        data: folder with `poses/`, `poles/` and the odometry folder (`kitti_odometry`).
        sequence: two digits.
        odometry: folder of the odometry to use.
        every: keep every this many frames.
        seed: of the detections.
        position_scale: noise at range 0, m an axis; `position_ratio` its growth, m per m.
        miss_rate: probability that a pole in view is missed; `clutter_rate`: mean false detections a frame.
        maximum_range: m; `field_of_view`: full horizontal angle, rad.

    Raises:
        InputError: files are missing or do not match.
    """
    folder = Path(data)
    truth = read_trajectory(existing(folder / "poses" / f"{sequence}.txt", "true poses")).T_world_camera
    drift = read_trajectory(existing(folder / odometry / f"{sequence}.txt", "odometry")).T_world_camera
    poles = read_npy(existing(folder / "poles" / f"{sequence}.npy", "pole map"), (None, None))
    if len(truth) != len(drift):
        raise input_error("odometry and truth have different lengths", got=(len(drift), len(truth)), file=folder)
    world = pole_positions(np.asarray(poles, dtype=np.float64), truth)
    truth, drift = truth[::every], drift[::every]
    m = len(world)
    detector = DetectorConfig(
        maximum_range=maximum_range,
        field_of_view=field_of_view,
        miss_rate=miss_rate,
        clutter_rate=clutter_rate,
        position_scale=position_scale,
        position_ratio=position_ratio,
        rotation_scale=None,
    )
    objects = SimulatedWorld(world, np.tile(np.eye(3), (m, 1, 1)), np.zeros(m, np.int64), np.zeros((m, 0)), np.zeros((1, 0)))
    table, source = simulate_detections(truth, objects, detector, np.random.default_rng(seed))
    plain = Detections.from_arrays(
        table.frame, table.position, position_covariance=table.position_covariance, category=["pole"] * len(table), id=table.id
    )
    poses = {f"pole-{j}": np.block([[np.eye(3), world[j][:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]) for j in range(m)}
    settings = {
        "kind": "kitti-poles",
        "sequence": sequence,
        "odometry": odometry,
        "every": every,
        "seed": seed,
        "position_scale": position_scale,
        "position_ratio": position_ratio,
        "miss_rate": miss_rate,
        "clutter_rate": clutter_rate,
        "maximum_range": maximum_range,
        "field_of_view": field_of_view,
    }
    return Converted(
        odometry=Trajectory(drift),
        truth=Trajectory(truth),
        observations=plain,
        objects=tuple(f"pole-{j}" if j >= 0 else None for j in source),
        trusted=np.ones(len(truth), bool),
        T_world_object=poses,
        source=settings,
    )
