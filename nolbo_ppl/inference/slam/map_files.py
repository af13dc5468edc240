"""Results as files: trajectory, map, association of every observation, summary."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from nolbo_ppl.geometry.pose import matrix_to_quaternion
from nolbo_ppl.inference.slam.graph import SlamEstimate
from nolbo_ppl.inference.slam.hypotheses import ambiguity
from nolbo_ppl.inference.slam.landmark_shapes import LatentDecoder, write_voxels
from nolbo_ppl.inference.slam.slam_result import SlamResult
from nolbo_ppl.io.files import read_json_object, write_json, write_jsonl
from nolbo_ppl.io.npz import save_npz
from nolbo_ppl.io.trajectories import Trajectory, write_trajectory
from nolbo_ppl.metrics.trajectory import absolute_trajectory_error, known_rows, relative_pose_error
from nolbo_ppl.structures.landmark import Landmark

RESULT = (
    "trajectory.txt",
    "landmarks.json",
    "landmarks_voxels.npz",
    "associations.jsonl",
    "iterations.npz",
    "summary.json",
    "map.png",
)
"""Files of a result of SLAM."""


def is_result(folder: Path) -> bool:
    """Whether a folder holds a result of SLAM, which another may replace."""
    file = folder / "summary.json"
    return file.is_file() and {"loop_pairs", "configuration", "versions"} <= set(read_json_object(file))


def landmark_row(landmark: Landmark) -> dict[str, Any]:
    """One landmark as JSON."""
    row: dict[str, Any] = {
        "name": landmark.name,
        "position": landmark.T_world_object[:3, 3].tolist(),
        "position_covariance": landmark.position_covariance.tolist(),
        "existence": landmark.existence,
        "detections": landmark.detections,
        "first_frame": landmark.first_frame,
        "last_frame": landmark.last_frame,
    }
    if landmark.oriented:
        row["rotation"] = matrix_to_quaternion(landmark.T_world_object[:3, :3]).tolist()
        row["rotation_covariance"] = landmark.covariance[:3, :3].tolist()
    if landmark.class_posterior:
        row["category"] = max(landmark.class_posterior, key=lambda c: landmark.class_posterior[c])
        row["class_posterior"] = {c: p for c, p in landmark.class_posterior.items() if p > 1e-6}
    if landmark.latent is not None and landmark.latent_variance is not None:
        row["latent"] = landmark.latent.tolist()
        row["latent_std"] = np.sqrt(landmark.latent_variance).tolist()
    if landmark.size is not None:
        row["size"] = landmark.size.tolist()
    return row


def association_rows(result: SlamResult) -> list[dict[str, Any]]:
    """A row for each observation, in order: probability of each landmark, of a new object, of background."""
    found = result.associations
    weights: dict[int, dict[str, float]] = defaultdict(dict)
    for k, j, w in zip(found.row.tolist(), found.landmark.tolist(), found.weight.tolist()):
        weights[k][f"L{j}"] = round(w, 6)
    table = result.state.problem.observations
    return [
        {
            "id": table.id[k],
            "landmarks": dict(sorted(weights[k].items(), key=lambda item: -item[1])),
            "new": round(float(found.new[k]), 6),
            "background": round(float(found.background[k]), 6),
        }
        for k in range(len(table))
    ]


def loop_pair_count(result: SlamResult, minimum_gap: int = 50) -> int:
    """Pairs of detections on one landmark more than `minimum_gap` frames apart."""
    from nolbo_ppl.metrics.association import association_pairs

    found = result.associations
    label = np.full(len(found.new), -1)
    strong = found.weight > 0.5
    label[found.row[strong]] = found.landmark[strong]
    return association_pairs(result.state.problem.observations.frame, label, label, minimum_gap).found_pairs


def library_versions() -> dict[str, str]:
    """Versions of what computed the result."""
    out = {}
    for name in ("nolbo-ppl", "gtsam", "numpy", "scipy", "networkx", "numba"):
        try:
            out[name] = version(name)
        except PackageNotFoundError:
            out[name] = "unknown"
    return out


def trajectory_errors(estimate: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """ATE (SE(3) aligned) and RPE over one row, as root mean squares, over the rows whose truth is known (not NaN)."""
    out = {"ate": absolute_trajectory_error(estimate, truth).rmse}
    known = known_rows(truth)
    if (known[1:] & known[:-1]).any():
        out["rpe_translation"] = relative_pose_error(estimate, truth).rmse
        out["rpe_rotation"] = relative_pose_error(estimate, truth, part="rotation").rmse
    return out


def write_iterations(path: str | PathLike[str], history: Sequence[SlamEstimate]) -> None:
    """Every iteration in one NPZ file, atomically: `T_world_camera` [i, n, 4, 4] float32, and `landmarks_0` [m, 3], ...,
    the positions of the landmarks each iteration held, in m; 0 is the odometry, the last one the result.
    """
    arrays = {f"landmarks_{i}": x.T_world_landmark[:, :3, 3].astype(np.float32) for i, x in enumerate(history)}
    poses = np.stack([x.T_world_camera for x in history]).astype(np.float32)
    save_npz(path, {"T_world_camera": poses, **arrays})


def summary(result: SlamResult, truth: np.ndarray | None = None) -> dict[str, Any]:
    """What `summary.json` holds."""
    state = result.state
    out: dict[str, Any] = {
        "frames": len(state.problem),
        "observations": len(state.problem.observations),
        "landmarks": len(state.static),
        "tracklets": len(state.tracklets),
        "moving_tracklets": int(state.tracklets.moving.sum()),
        "loop_pairs": loop_pair_count(result),
        "associations_exact": result.associations.exact,
        "iterations": [asdict(info) for info in result.infos],
        "final_log_evidence": float(np.sum(result.associations.log_evidence)),
        "noise": {k: float(v) for k, v in state.noise.report.items()},
        "warnings": list(state.noise.warnings),
        "ambiguous": ambiguity(result.hypotheses),
        "hypotheses": [
            {"weight": h.weight, "log_evidence": h.log_evidence, "landmarks": len(h.state.static)} for h in result.hypotheses
        ],
        "seconds": result.seconds,
        "versions": library_versions(),
        "configuration": {k: dict(v) if k == "category_symmetry" else v for k, v in asdict(state.config).items()},
    }
    if truth is not None:
        out["frames_with_truth"] = int(known_rows(truth).sum())
        out["before"] = trajectory_errors(state.problem.odometry, truth)
        out["after"] = trajectory_errors(result.T_world_camera, truth)
    return out


def write_result(
    out: str | PathLike[str],
    result: SlamResult,
    odometry: Trajectory,
    truth: np.ndarray | None = None,
    model: LatentDecoder | None = None,
) -> dict[str, Any]:
    """Write every file into `out`, each atomically, the summary last; returns the summary.

    Args:
        out: folder, made when missing.
        result: the answer.
        odometry: the input, for its format and times.
        truth: true poses of the same rows, for errors.
        model: decodes the landmarks' latents into `landmarks_voxels.npz`.

    Raises:
        InputError: the latents do not have the model's dimension; nothing is written.
    """
    out = Path(out)
    if model is not None:
        write_voxels(out / "landmarks_voxels.npz", result.decode_landmarks(model))
    write_trajectory(out / "trajectory.txt", Trajectory(result.T_world_camera, odometry.times, odometry.format))
    if result.history:
        write_iterations(out / "iterations.npz", result.history)
    write_json(out / "landmarks.json", [landmark_row(landmark) for landmark in result.landmarks])
    write_jsonl(out / "associations.jsonl", association_rows(result))
    report = summary(result, truth)
    write_json(out / "summary.json", report)
    return report
