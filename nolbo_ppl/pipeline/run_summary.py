"""`summary.json` of a run: what was found, how it compares with the truth where there is one, and how long it took."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from nolbo_ppl.evaluation.sequence_scores import (
    ShapeModel,
    coverage_figures,
    detection_figures,
    finite,
    landmark_errors,
    loop_figures,
    map_figures,
    matched_truth,
    owners,
    position_figures,
    shape_figures,
)
from nolbo_ppl.evaluation.sequence_truth import DriveTruth, MatchResult, match_detections, object_shown, read_truth
from nolbo_ppl.inference.slam import NoiseModel, SlamConfig, SlamProblem, solve_with_associations
from nolbo_ppl.inference.slam.map_files import trajectory_errors
from nolbo_ppl.io.files import read_json, read_jsonl
from nolbo_ppl.io.observations import Detections, read_observations
from nolbo_ppl.io.trajectories import covariance_beside, read_trajectory
from nolbo_ppl.metrics.trajectory import path_length
from nolbo_ppl.pipeline.map_mesh import stands
from nolbo_ppl.pipeline.noise_file import read_noise

ASSOCIATION_IOU = 0.3
"""Overlap from which a detection is held to be of an object where its association is judged: loose boxes are no wrong loops."""


@dataclass(frozen=True)
class RunResult:
    """What the files of a run say."""

    table: Detections
    """Observations."""
    box: Float[np.ndarray, "k 4"]
    """Their boxes, px."""
    azimuth_modes: tuple[Any, ...]
    """Their azimuth posteriors."""
    odometry: Float[np.ndarray, "n 4 4"]
    """Before."""
    estimate: Float[np.ndarray, "n 4 4"]
    """After."""
    truth: Float[np.ndarray, "n 4 4"] | None
    """True poses."""
    covariance: Float[np.ndarray, "n-1 6 6"] | None
    """Covariance of the odometry's steps."""
    landmarks: tuple[Mapping[str, Any], ...]
    """Rows of `landmarks.json`."""
    landmark_of: Int[np.ndarray, " k"]
    """Landmark that has more than half of each observation's weight, -1 for none."""
    slam: Mapping[str, Any]
    """`slam/summary.json`."""
    noise: NoiseModel
    """The noise the EM has settled on."""
    images: tuple[str, ...]
    """Names of the keyframes' images."""

    @property
    def exists(self) -> np.ndarray:
        """Landmarks that are part of the map."""
        return np.array([stands(row) for row in self.landmarks], dtype=bool)


def read_result(folder: Path) -> RunResult:
    """Read what the stages before have written."""
    odometry = read_trajectory(folder / "odometry.txt").T_world_camera
    truth = folder / "truth.txt"
    rows = [row for _, row in read_jsonl(folder / "observations.jsonl")]
    landmarks = tuple(read_json(folder / "slam" / "landmarks.json"))
    number = {row["name"]: j for j, row in enumerate(landmarks)}
    landmark_of = np.full(len(rows), -1)
    for k, (_, found) in enumerate(read_jsonl(folder / "slam" / "associations.jsonl")):
        best = max(found["landmarks"].items(), key=lambda item: item[1], default=("", 0.0))
        if best[1] > 0.5:
            landmark_of[k] = number[best[0]]
    return RunResult(
        table=read_observations(folder / "observations.jsonl", frames=len(odometry)),
        box=np.array([row.get("box", [np.nan] * 4) for row in rows], dtype=np.float64).reshape(-1, 4),
        azimuth_modes=tuple(row.get("azimuth_modes") for row in rows),
        odometry=odometry,
        estimate=read_trajectory(folder / "slam" / "trajectory.txt").T_world_camera,
        truth=read_trajectory(truth, lost=True).T_world_camera if truth.is_file() else None,
        covariance=covariance_beside(folder / "odometry.txt"),
        landmarks=landmarks,
        landmark_of=landmark_of,
        slam=read_json(folder / "slam" / "summary.json"),
        noise=read_noise(folder / "slam" / "noise.npz"),
        images=tuple(str(row["image"]) for _, row in read_jsonl(folder / "frames.jsonl")),
    )


def trajectory_figures(result: RunResult) -> dict[str, Any]:
    """Errors before and after, and their ratio; empty without a true trajectory."""
    if result.truth is None:
        return {}
    before, after = (trajectory_errors(T, result.truth) for T in (result.odometry, result.estimate))
    ratio = after["ate"] / before["ate"] if before["ate"] > 0 else float("nan")
    length = finite(path_length(result.truth))
    return {"path_length": length, "before": before, "after": after, "after_over_before": finite(ratio)}


def oracle_figures(
    result: RunResult, problem: SlamProblem, object_of: Int[np.ndarray, " k"], config: SlamConfig
) -> dict[str, Any]:
    """Errors of the same detections under the same noise, associated by the truth: what is left to the association."""
    assert result.truth is not None
    state = solve_with_associations(problem, object_of, config, result.noise)
    oracle = trajectory_errors(state.estimate.T_world_camera, result.truth)
    after = trajectory_errors(result.estimate, result.truth)["ate"]
    return {"oracle": oracle, "after_over_oracle": finite(after / oracle["ate"]) if oracle["ate"] > 0 else None}


def observation_figures(result: RunResult, matched: MatchResult, truth: DriveTruth, model: ShapeModel | None) -> dict[str, Any]:
    """Detections, positions and regions against the truth."""
    true = matched_truth(matched, result.table.frame, truth)["position"]
    true[~matched.counted] = np.nan
    return {
        **detection_figures(matched, result.table, truth),
        "position_error": position_figures(result.table.position, true),
        "coverage90": coverage_figures(matched, result.table, result.azimuth_modes, truth, model),
    }


def truth_figures(
    result: RunResult,
    problem: SlamProblem,
    truth: DriveTruth,
    loosely: Int[np.ndarray, " k"],
    model: ShapeModel | None,
    config: SlamConfig,
    loop_gap: int,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Everything that is held against the true objects; `loosely` is whose each observation is, for its association."""
    table = result.table
    matched = match_detections(table.frame, result.box, table.objectness, truth)
    owner, purity = owners(loosely, result.landmark_of, len(result.landmarks))
    out: dict[str, Any] = {
        "observation_figures": observation_figures(result, matched, truth, model),
        "loops": loop_figures(table.frame, loosely, result.landmark_of, loop_gap),
        "map": map_figures(loosely, owner, purity, result.exists, truth, config.track_minimum),
    }
    if result.truth is not None:
        static = np.where((loosely >= 0) & truth.moving[loosely], -1, loosely)
        out |= oracle_figures(result, problem, static, config)
        position = np.array([row["position"] for row in result.landmarks]).reshape(-1, 3)
        # Poses of objects are in the world of the drive, that of its true trajectory.
        error = landmark_errors(position, owner, truth, result.estimate, result.truth)
        error = error[result.exists & np.isfinite(error)]
        out["map"]["median_position_error"] = finite(np.median(error)) if len(error) else None
    if model is not None:
        out["shape"] = shape_figures(table, result.landmark_of, owner, truth, model, rng)
    return out


def time_figures(seconds: Mapping[str, float], cpu_seconds: Mapping[str, float], keyframes: int) -> dict[str, Any]:
    """Seconds by stage, by the clock and of the processor; images a second through the guide, share of the EM.

    The share is one of processor time: it does not depend on what else the machine does.
    """
    total, observe = sum(cpu_seconds.values()), seconds.get("observe", 0.0)
    return {
        "seconds": {name: round(value, 3) for name, value in seconds.items()},
        "cpu_seconds": {name: round(value, 3) for name, value in cpu_seconds.items()},
        "images_per_second": finite(keyframes / observe) if observe > 0 else None,
        "share_of_em": finite(cpu_seconds.get("slam", 0.0) / total) if total > 0 else None,
    }


def summarise(
    folder: Path,
    seconds: Mapping[str, float],
    cpu_seconds: Mapping[str, float],
    problem: SlamProblem,
    *,
    drive: Path | None,
    model: ShapeModel | None,
    config: SlamConfig,
    loop_gap: int,
    seed: int,
) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """Everything `summary.json` holds, and `objects.json`: the true object of each observation, where there is a truth.

    Args:
        folder: the run, complete up to its crops.
        seconds: time of its stages.
        cpu_seconds: processor time of them.
        problem: what SLAM was given.
        drive: folder of the drive with the true objects, or None.
        model: decodes and encodes shapes, for coverage of latents and shapes by number of views; None leaves them out.
        config: settings of the EM.
        loop_gap: least keyframes between two detections of a loop pair.
        seed: of the views drawn.
    """
    result = read_result(folder)
    out: dict[str, Any] = {
        "frames": len(result.estimate),
        "observations": len(result.table),
        "landmarks": int(result.exists.sum()),
        "loop_pairs": result.slam.get("loop_pairs"),
        **trajectory_figures(result),
    }
    objects = None
    if drive is not None:
        truth, table = read_truth(drive, result.images), result.table
        loosely = object_shown(table.frame, result.box, truth, ASSOCIATION_IOU)
        objects = {"objects": {name: truth.names[i] if i >= 0 else None for name, i in zip(table.id, loosely.tolist())}}
        out |= truth_figures(result, problem, truth, loosely, model, config, loop_gap, np.random.default_rng([seed, 3]))
    out |= time_figures(seconds, cpu_seconds, len(result.estimate))
    return {**out, "warnings": result.slam.get("warnings", [])}, objects


def figure_table(summary: Mapping[str, Any]) -> str:
    """The figures as lines for a terminal."""
    rows: list[tuple[str, str]] = [
        ("keyframes, observations, landmarks", f"{summary['frames']}, {summary['observations']}, {summary['landmarks']}"),
    ]

    def number(value: Any, pattern: str = "{:.3f}") -> str:
        return "-" if value is None else pattern.format(value)

    if "before" in summary:
        rows.append(("ATE before / after, m", f"{summary['before']['ate']:.3f} / {summary['after']['ate']:.3f}"))
        rows.append(("  after over before", number(summary["after_over_before"])))
    if "oracle" in summary:
        rows.append(("  oracle association, m", f"{summary['oracle']['ate']:.3f}"))
        rows.append(("  after over oracle", number(summary["after_over_oracle"])))
    if "loops" in summary:
        loops = summary["loops"]
        rows.append(("loop pairs: precision / recall", f"{number(loops['precision'])} / {number(loops['recall'])}"))
        chart = summary["map"]
        rows.append(("landmarks / objects detected", f"{chart['landmarks']} / {chart['objects_detected']}"))
        rows.append(("  mapped, duplicates, spurious", f"{chart['objects_mapped']}, {chart['duplicates']}, {chart['spurious']}"))
    if "observation_figures" in summary:
        seen = summary["observation_figures"]
        rows.append(("detections: recall / precision", f"{number(seen['recall'])} / {number(seen['precision'])}"))
        rows.append(("  right category", number(seen["category_accuracy"])))
        for name, band in seen["position_error"].items():
            label = f"position error {name}: median, 90 %, m"
            rows.append((label, f"{number(band['median'], '{:.2f}')}, {number(band['p90'], '{:.2f}')} ({band['count']})"))
        cover = seen["coverage90"]
        rows.append(
            (
                "in the 90 % region: position, azimuth, latent",
                ", ".join(number(cover[key], "{:.2f}") for key in ("position", "orientation", "latent")),
            )
        )
    if summary.get("shape"):
        views = summary["shape"]["iou"]
        rows.append((f"voxel IoU from {', '.join(views)} views", ", ".join(number(value) for value in views.values())))
    rows.append(("images a second through the guide", number(summary["images_per_second"], "{:.1f}")))
    for key, name in (("seconds", "seconds by stage"), ("cpu_seconds", "  of the processor")):
        rows.append((name, ", ".join(f"{stage} {value:.1f}" for stage, value in summary[key].items())))
    rows.append(("share of the EM", number(summary["share_of_em"], "{:.2f}")))
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)
