"""Results as files: trajectory, map, association of every observation, summary."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from nolbo_ppl.inference.slam.hypotheses import ambiguity
from nolbo_ppl.inference.slam.landmark_shapes import LatentDecoder
from nolbo_ppl.inference.slam.slam_result import SlamResult
from nolbo_ppl.inference.slam.slam_state import given_odometry
from nolbo_ppl.io.files import read_json_object, write_json
from nolbo_ppl.io.landmarks import Iterations, write_associations, write_iterations, write_landmarks, write_voxels
from nolbo_ppl.io.npz import save_npz
from nolbo_ppl.io.ros_maps import MCAP
from nolbo_ppl.io.trajectories import Trajectory, write_trajectory
from nolbo_ppl.metrics.association import association_pairs
from nolbo_ppl.metrics.trajectory import known_rows, trajectory_errors
from nolbo_ppl.structures.association_table import AssociationTable

RESULT = (
    "trajectory.txt",
    "landmarks.json",
    "landmarks_voxels.npz",
    "associations.jsonl",
    "iterations.npz",
    "scale.npz",
    "summary.json",
    "map.png",
    MCAP,
)
"""Files of a result of SLAM."""


def is_result(folder: Path) -> bool:
    """Whether a folder holds a result of SLAM, which another may replace."""
    file = folder / "summary.json"
    return file.is_file() and {"loop_pairs", "configuration", "versions"} <= set(read_json_object(file))


def association_table(result: SlamResult) -> AssociationTable:
    """The association of every observation, in the order of the observations."""
    found, table = result.associations, result.state.problem.observations
    return AssociationTable(table.id, found.row, found.landmark, found.weight, found.new, found.background, table.frame)


def loop_pair_count(result: SlamResult, minimum_gap: int = 50) -> int:
    """Pairs of detections on one landmark more than `minimum_gap` frames apart."""
    label = association_table(result).landmark_of
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
    if result.scale is not None and result.scale_standard_deviation is not None and len(result.scale):
        out["scale"] = {
            "median": float(np.median(result.scale)),
            "least": float(result.scale.min()),
            "largest": float(result.scale.max()),
            "standard_deviation": float(np.median(result.scale_standard_deviation)),
        }
    if truth is not None:
        out["frames_with_truth"] = int(known_rows(truth).sum())
        out["before"] = trajectory_errors(given_odometry(state), truth)
        out["after"] = trajectory_errors(result.T_world_camera, truth)
    return out


def write_result(
    out: str | PathLike[str],
    result: SlamResult,
    odometry: Trajectory,
    truth: np.ndarray | None = None,
    model: LatentDecoder | None = None,
    calibration: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Write every file into `out`, each atomically, the summary last; returns the summary.

    Args:
        out: folder, made when missing.
        result: the answer.
        odometry: the input, for its format and times.
        truth: true poses of the same rows, for errors.
        model: decodes the landmarks' latents into `landmarks_voxels.npz`.
        calibration: what the map states beside the truth (`evaluation.map_calibration`), for the summary.

    Raises:
        InputError: the latents do not have the model's dimension; nothing is written.
    """
    out = Path(out)
    if model is not None:
        write_voxels(out / "landmarks_voxels.npz", result.decode_landmarks(model))
    write_trajectory(out / "trajectory.txt", Trajectory(result.T_world_camera, odometry.times, odometry.format))
    if result.history:
        poses = np.stack([estimate.T_world_camera for estimate in result.history])
        landmarks = tuple(estimate.T_world_landmark[:, :3, 3] for estimate in result.history)
        write_iterations(out / "iterations.npz", Iterations(poses, landmarks))
    if result.scale is not None and result.scale_standard_deviation is not None:
        save_npz(out / "scale.npz", {"scale": result.scale, "standard_deviation": result.scale_standard_deviation})
    write_landmarks(out / "landmarks.json", result.landmarks)
    names = [landmark.name for landmark in result.landmarks]
    write_associations(out / "associations.jsonl", association_table(result), names)
    report = summary(result, truth) | ({"calibration": dict(calibration)} if calibration else {})
    write_json(out / "summary.json", report)
    return report
