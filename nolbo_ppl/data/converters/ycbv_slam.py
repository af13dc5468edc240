"""YCB-Video SLAM: real 6D object detections with heavy tails, real odometry with drift added to it."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np

from nolbo_ppl.data.converters.converted import Converted, existing
from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.pose import chain, make_pose, nearest_rotation, quaternion_to_matrix, relative, se3_exp, so3_log
from nolbo_ppl.io.npz import Npz
from nolbo_ppl.io.trajectories import Trajectory
from nolbo_ppl.structures.detections import Detections


def poses_of(rows: np.ndarray) -> np.ndarray:
    """4 x 4 poses of rows x y z qx qy qz qw; an all-zero row (no pose) gives NaN."""
    rows = np.asarray(rows, dtype=np.float64)
    present = np.abs(rows).sum(axis=1) > 0
    T = np.full((len(rows), 4, 4), np.nan)
    T[present] = make_pose(quaternion_to_matrix(rows[present, 3:]), rows[present, :3])
    return T


def median_pose(T: np.ndarray) -> np.ndarray:
    """Median position and a rotation near the median one: robust against rows that are off."""
    position = np.median(T[:, :3, 3], axis=0)
    R = nearest_rotation(T[:, :3, :3].mean(axis=0))
    for _ in range(5):
        R = R @ np.asarray(nearest_rotation(np.eye(3) + _skew(np.median(so3_log(R.T @ T[:, :3, :3]), axis=0))))
    return make_pose(R, position)


def _skew(v: np.ndarray) -> np.ndarray:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def convert_ycbv_slam(
    data: str | PathLike[str],
    sequence: str,
    *,
    detections: str = "det_initial",
    every: int = 10,
    seed: int = 0,
    rotation_drift: float = np.deg2rad(1.0),
    translation_drift: float = 0.005,
) -> Converted:
    """Keyframes of one sequence; each odometry step between them gets seeded noise, which is stated as its covariance.

    Args:
        data: folder of the NPZ files (`ycbv_slam`).
        sequence: four digits.
        detections: det_initial, det_selftrained or det_supervised.
        every: keep every this many frames.
        rotation_drift: scale of each angle of the noise on one step, rad.
        translation_drift: scale of each coordinate, m.

    Raises:
        InputError: the file is missing or holds no such detections.
    """
    path = existing(Path(data) / f"{sequence}.npz", "sequence")
    with Npz(path) as file:
        arrays = {
            name: file.array(name, kinds="fiub", finite=False) for name in file.names if file.headers[name].dtype.kind != "U"
        }
    names = sorted(name.split("/", 1)[1] for name in arrays if name.startswith(f"{detections}/"))
    if not names:
        raise input_error(
            "no such detections", got=detections, expected="det_initial, det_selftrained or det_supervised", file=path
        )
    keep = np.arange(0, len(arrays["t"]), every)
    truth = poses_of(arrays["cam_gt"][keep])
    steps = relative(*(lambda T: (T[:-1], T[1:]))(poses_of(arrays["odom_est"][keep])))
    rng = np.random.default_rng(seed)
    noise = np.concatenate(
        [rotation_drift * rng.standard_normal((len(steps), 3)), translation_drift * rng.standard_normal((len(steps), 3))], axis=1
    )
    odometry = chain(truth[0], steps @ se3_exp(noise))
    frames, poses, labels, world = [], [], [], {}
    for name in names:
        T = poses_of(arrays[f"{detections}/{name}"][keep])
        rows = np.flatnonzero(np.isfinite(T[:, 0, 0]))
        frames.append(rows)
        poses.append(T[rows])
        labels += [name] * len(rows)
        local = poses_of(arrays[f"gt/{name}"][keep])
        seen = np.isfinite(local[:, 0, 0])
        if seen.any():
            world[name] = median_pose(truth[seen] @ local[seen])
    frame = np.concatenate(frames)
    order = np.argsort(frame, kind="stable")
    T = np.concatenate(poses)[order]
    labels = [labels[i] for i in order]
    frame = frame[order]
    table = Detections.from_arrays(
        frame, T[:, :3, 3], rotation=T[:, :3, :3], category=labels, id=[f"{t:06d}-{name}" for t, name in zip(frame, labels)]
    )
    settings = {
        "kind": "ycbv-slam",
        "sequence": sequence,
        "detections": detections,
        "every": every,
        "seed": seed,
        "rotation_drift": rotation_drift,
        "translation_drift": translation_drift,
    }
    times = np.asarray(arrays["t"], dtype=np.float64)[keep]
    # The real odometry's own errors are far below the drift added to it.
    covariance = np.diag(np.repeat(np.maximum([rotation_drift, translation_drift], 1e-4) ** 2, 3))
    return Converted(
        odometry=Trajectory(odometry, times, "tum"),
        truth=Trajectory(truth, times, "tum"),
        observations=table,
        objects=tuple(labels),
        trusted=np.ones(len(keep), bool),
        T_world_object=world,
        odometry_covariance=np.tile(covariance, (len(steps), 1, 1)),
        source=settings,
    )
