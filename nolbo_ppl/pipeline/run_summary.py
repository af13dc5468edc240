"""`summary.json` of a run: what was found, how it compares with the truth where there is one, and how long it took."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from nolbo_ppl.evaluation.sequence_scores import (
    ShapeModel,
    coverage_scores,
    detection_scores,
    finite,
    landmark_errors,
    loop_scores,
    map_scores,
    matched_ground_truth,
    position_scores,
    shape_scores,
)
from nolbo_ppl.evaluation.sequence_truth import (
    MatchResult,
    SequenceGroundTruth,
    match_detections,
    object_shown,
    read_ground_truth,
)
from nolbo_ppl.inference.slam import SlamConfig, SlamProblem, solve_with_associations
from nolbo_ppl.io.noise_file import read_noise
from nolbo_ppl.io.run_folder import RunFolder
from nolbo_ppl.metrics.association import landmark_to_object
from nolbo_ppl.metrics.trajectory import path_length, trajectory_errors
from nolbo_ppl.odometry import StepFlag
from nolbo_ppl.structures.detections import Detections

ASSOCIATION_IOU = 0.3
"""Overlap from which a detection is held to be of an object where its association is judged: loose boxes are no wrong loops."""


def trajectory_scores(run: RunFolder) -> dict[str, Any]:
    """Errors before and after, as the EM has stated them, and their ratio; empty without a true trajectory."""
    errors = run.trajectory_errors
    if run.truth_given is None or "before" not in errors:
        return {}
    before, after = errors["before"]["ate"], errors["after"]["ate"]
    length = finite(path_length(run.truth_given))
    return {"path_length": length, **errors, "after_over_before": finite(after / before) if before > 0 else None}


def odometry_scores(run: RunFolder) -> dict[str, Any]:
    """How many steps of visual odometry between keyframes lacked what; empty where the odometry was given."""
    flags = run.odometry_flags
    if flags is None:
        return {}
    counts = {str(flag.name): int(np.sum((flags & flag) > 0)) for flag in StepFlag if flag}
    return {"odometry": {"steps": len(flags), "doubtful": int(np.sum(flags > 0)), **counts}}


def ground_truth_association_scores(
    run: RunFolder, problem: SlamProblem, object_of: Int[np.ndarray, " k"], config: SlamConfig
) -> dict[str, Any]:
    """Errors of the same detections under the same noise, associated by the truth: what is left to the association."""
    assert run.truth_given is not None
    state = solve_with_associations(problem, object_of, config, read_noise(run.slam / "noise.npz"))
    oracle, after = trajectory_errors(state.estimate.T_world_camera, run.truth_given), run.trajectory_errors["after"]["ate"]
    return {"oracle": oracle, "after_over_oracle": finite(after / oracle["ate"]) if oracle["ate"] > 0 else None}


def observation_scores(
    table: Detections, matched: MatchResult, truth: SequenceGroundTruth, model: ShapeModel | None
) -> dict[str, Any]:
    """Detections, positions and regions against the truth."""
    true = matched_ground_truth(matched, table.frame, truth)["position"]
    true[~matched.counted] = np.nan
    return {
        **detection_scores(matched, table, truth),
        "position_error": position_scores(table.position, true),
        "coverage90": coverage_scores(matched, table, truth, model),
    }


def ground_truth_scores(
    run: RunFolder,
    problem: SlamProblem,
    truth: SequenceGroundTruth,
    loosely: Int[np.ndarray, " k"],
    model: ShapeModel | None,
    config: SlamConfig,
    loop_gap: int,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Everything that is held against the true objects; `loosely` is whose each observation is, for its association."""
    table, found = problem.observations, run.associations
    assert found is not None
    matched = match_detections(table.frame, table.box, table.objectness, truth)
    owner, purity = landmark_to_object(loosely, found.landmark_of, len(run.landmarks))
    exists = np.array([landmark.in_map for landmark in run.landmarks], dtype=bool)
    out: dict[str, Any] = {
        "observation_scores": observation_scores(table, matched, truth, model),
        "loops": loop_scores(table.frame, loosely, found.landmark_of, loop_gap),
        "map": map_scores(loosely, owner, purity, exists, truth, config.track_minimum),
    }
    if run.truth_given is not None:
        static = np.where((loosely >= 0) & truth.moving[loosely], -1, loosely)
        out |= ground_truth_association_scores(run, problem, static, config)
        position = np.array([landmark.position for landmark in run.landmarks]).reshape(-1, 3)
        # Poses of objects are in the world of the drive, that of its true trajectory.
        error = landmark_errors(position, owner, truth, run.estimate, run.truth_given)
        error = error[exists & np.isfinite(error)]
        out["map"]["median_position_error"] = finite(np.median(error)) if len(error) else None
    if model is not None:
        out["shape"] = shape_scores(table, found.landmark_of, owner, truth, model, rng)
    return out


def time_scores(seconds: Mapping[str, float], cpu_seconds: Mapping[str, float], keyframes: int) -> dict[str, Any]:
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
    run: RunFolder,
    seconds: Mapping[str, float],
    cpu_seconds: Mapping[str, float],
    problem: SlamProblem,
    *,
    drive: Path | None,
    model: ShapeModel | None,
    config: SlamConfig,
    loop_gap: int,
    seed: int,
) -> tuple[dict[str, Any], dict[str, str | None] | None]:
    """Everything `summary.json` holds, and the true object of each observation, where there is a truth.

    Args:
        run: the run, complete up to its crops.
        seconds: time of its stages.
        cpu_seconds: processor time of them.
        problem: what SLAM was given.
        drive: folder of the drive with the true objects, or None.
        model: decodes and encodes shapes, for coverage of latents and shapes by number of views; None leaves them out.
        config: settings of the EM.
        loop_gap: least keyframes between two detections of a loop pair.
        seed: of the views drawn.
    """
    table = problem.observations
    out: dict[str, Any] = {
        "frames": len(run),
        "observations": len(table),
        "landmarks": sum(landmark.in_map for landmark in run.landmarks),
        "loop_pairs": run.slam_summary.get("loop_pairs"),
        **odometry_scores(run),
        **trajectory_scores(run),
    }
    objects = None
    if drive is not None:
        truth = read_ground_truth(drive, run.image_names)
        loosely = object_shown(table.frame, table.box, truth, ASSOCIATION_IOU)
        objects = {name: truth.names[i] if i >= 0 else None for name, i in zip(table.id, loosely.tolist())}
        out |= ground_truth_scores(run, problem, truth, loosely, model, config, loop_gap, np.random.default_rng([seed, 3]))
    out |= time_scores(seconds, cpu_seconds, len(run))
    return {**out, "warnings": run.slam_summary.get("warnings", [])}, objects


def score_table(summary: Mapping[str, Any]) -> str:
    """The figures as lines for a terminal."""
    rows: list[tuple[str, str]] = [
        ("keyframes, observations, landmarks", f"{summary['frames']}, {summary['observations']}, {summary['landmarks']}"),
    ]

    def number(value: Any, pattern: str = "{:.3f}") -> str:
        return "-" if value is None else pattern.format(value)

    if "odometry" in summary:
        steps = summary["odometry"]
        why = ", ".join(f"{name} {count}" for name, count in steps.items() if count and name not in ("steps", "doubtful"))
        rows.append(
            ("steps of visual odometry, doubtful", f"{steps['steps']}, {steps['doubtful']}" + (f" ({why})" if why else ""))
        )
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
    if "observation_scores" in summary:
        seen = summary["observation_scores"]
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
