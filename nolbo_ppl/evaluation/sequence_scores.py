"""Figures of a run against the truth of its drive: observations, trajectory, loops, map, shapes by number of views."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from nolbo_ppl.evaluation.measure import ShapeModel
from nolbo_ppl.evaluation.sequence_truth import MatchResult, SequenceGroundTruth
from nolbo_ppl.geometry.alignment import known_rows, pose_alignment
from nolbo_ppl.geometry.rotation import egocentric_to_allocentric, matrix_to_viewpoint
from nolbo_ppl.geometry.voxels import unpack_voxels
from nolbo_ppl.inference.slam.detection_features import weighted_latents
from nolbo_ppl.metrics.association import association_pairs
from nolbo_ppl.metrics.calibration import chi_square_mass, coverage
from nolbo_ppl.metrics.viewpoint_error import rotation_error
from nolbo_ppl.metrics.voxel import voxel_iou
from nolbo_ppl.models.distributions import VonMisesMixture
from nolbo_ppl.structures.detections import Detections

RANGES = (0.0, 5.0, 10.0, 20.0, 40.0)
"""Edges of the bands of range position errors are told for, m; the last band is open."""
VIEWS = (1, 3, 10)
"""Numbers of views whose fused latent is decoded."""
REPEATS = 4
"""Draws of the views of one object."""
TRUE_SIDE = 32
"""Voxels along a side of a drive's true grids."""


def finite(value: float) -> float | None:
    """A number that JSON knows, None for NaN."""
    return round(float(value), 6) if np.isfinite(value) else None


def band_name(low: float, high: float) -> str:
    """`5-10 m`, `40 m and more`."""
    return f"{low:g} m and more" if np.isinf(high) else f"{low:g}-{high:g} m"


def matched_ground_truth(matched: MatchResult, frame: Int[np.ndarray, " k"], truth: SequenceGroundTruth) -> dict[str, np.ndarray]:
    """True position and rotation of each matched detection, NaN for the others."""
    position, rotation = np.full((len(frame), 3), np.nan), np.full((len(frame), 3, 3), np.nan)
    for k in np.flatnonzero(matched.object >= 0):
        seen = truth.frames[frame[k]]
        position[k], rotation[k] = seen.position[matched.row[k]], seen.R_camera_object[matched.row[k]]
    return {"position": position, "rotation": rotation}


def detection_scores(matched: MatchResult, table: Detections, truth: SequenceGroundTruth) -> dict[str, Any]:
    """Recall, precision, share of right categories, median orientation error of the objects that count."""
    rows = np.flatnonzero(matched.counted)
    true = matched_ground_truth(matched, table.frame, truth)
    right = [table.category[k] == truth.category[matched.object[k]] for k in rows]
    oriented = rows[table.has_rotation[rows]]
    error = rotation_error(table.rotation[oriented], true["rotation"][oriented], truth.symmetry[matched.object[oriented]])
    return {
        "objects": matched.wanted,
        "detections": len(table),
        "recall": finite(matched.recall),
        "precision": finite(matched.precision),
        "category_accuracy": finite(np.mean(right)) if len(rows) else None,
        "median_rotation_error_deg": finite(np.degrees(np.median(error))) if len(error) else None,
    }


def position_scores(
    position: Float[np.ndarray, "k 3"], true: Float[np.ndarray, "k 3"], edges: Sequence[float] = RANGES
) -> dict[str, dict[str, Any]]:
    """Count, median and 90th percentile of the position error (m), and of its share of the range, by true range."""
    known = np.isfinite(true).all(axis=1)
    error = np.linalg.norm(position[known] - true[known], axis=1)
    distance = np.linalg.norm(true[known], axis=1)
    bands = [("all", 0.0, np.inf)] + [(band_name(a, b), a, b) for a, b in zip(edges, [*edges[1:], np.inf])]
    out = {}
    for name, low, high in bands:
        rows = (distance >= low) & (distance < high)
        if rows.any():
            share = error[rows] / distance[rows]
            out[name] = {
                "count": int(rows.sum()),
                "median": finite(np.median(error[rows])),
                "p90": finite(np.quantile(error[rows], 0.9)),
                "median_share": finite(np.median(share)),
                "p90_share": finite(np.quantile(share, 0.9)),
            }
    return out


def orientation_mass(
    seen: Detections,
    position: Float[np.ndarray, "k 3"],
    R_camera_object: Float[np.ndarray, "k 3 3"],
    symmetry: Int[np.ndarray, " k"],
) -> Float[np.ndarray, " k"]:
    """Mass of the azimuth posterior's highest-density region that reaches out to the truth.

    Args:
        seen: detections, all of which state the modes of their azimuth.
        position: where the object truly is, camera frame: its direction turns egocentric into allocentric.
        R_camera_object: true rotation.
        symmetry: order of the object; the posterior is folded by it.
    """
    if not len(seen):
        return np.zeros(0)
    weight, mean, concentration = (np.nan_to_num(x) for x in (seen.azimuth_weight, seen.azimuth, seen.azimuth_concentration))
    posterior = VonMisesMixture.from_mean_concentration(
        torch.from_numpy(np.log(np.maximum(weight, 1e-300))),
        torch.from_numpy(mean),
        torch.from_numpy(concentration),
        max_concentration=float(concentration.max()) + 1,
    )
    R = egocentric_to_allocentric(torch.from_numpy(R_camera_object), torch.from_numpy(position))
    return posterior.hpd_mass(matrix_to_viewpoint(R)[:, 0], torch.from_numpy(symmetry)).numpy()


def coverage_scores(
    matched: MatchResult,
    table: Detections,
    truth: SequenceGroundTruth,
    model: ShapeModel | None,
) -> dict[str, Any]:
    """Share of the truths inside the 90 % regions of position, orientation (azimuth) and latent."""
    rows = np.flatnonzero(matched.counted)
    out: dict[str, Any] = {"count": len(rows), "position": None, "orientation": None, "latent": None}
    true = matched_ground_truth(matched, table.frame, truth)
    stated = rows[np.isfinite(table.position_covariance[rows]).all(axis=(1, 2))]
    if len(stated):
        difference = true["position"][stated] - table.position[stated]
        out["position"] = finite(coverage(chi_square_mass(difference, table.position_covariance[stated])))
    symmetry = truth.symmetry[matched.object]
    oriented = rows[table.has_azimuth[rows] & (symmetry[rows] != 0)]  # a free axis has no azimuth
    if len(oriented):
        seen = table.select(oriented)
        mass = orientation_mass(seen, true["position"][oriented], true["rotation"][oriented], symmetry[oriented])
        out["orientation"] = finite(coverage(mass))
    shaped = rows[table.has_latent[rows]]
    if model is not None and len(shaped):
        names = sorted({truth.instance[matched.object[k]] for k in shaped})
        teacher, _ = model.shape_posterior(np.stack([truth.packed[name] for name in names]))
        mean = teacher[[names.index(truth.instance[matched.object[k]]) for k in shaped]]
        out["latent"] = finite(coverage(chi_square_mass(mean - table.latent[shaped], table.latent_scale[shaped] ** 2)))
    return out


def loop_scores(
    frame: Int[np.ndarray, " k"], object_of: Int[np.ndarray, " k"], landmark_of: Int[np.ndarray, " k"], gap: int
) -> dict[str, Any]:
    """Precision and recall over pairs of detections more than `gap` frames apart.

    A found pair is right when both detections are of one object and wrong when only one is of an object, or both are of
    different ones. Two detections of things nobody labelled (a manhole taken for a table twice) have no truth to be held
    against: `precision` leaves them out, `precision_strict` counts them as wrong.
    """
    score = association_pairs(frame, object_of, landmark_of, gap)
    unknown = object_of < 0
    unjudged = association_pairs(frame[unknown], object_of[unknown], landmark_of[unknown], gap).found_pairs
    judged = score.found_pairs - unjudged
    return {
        "gap_frames": gap,
        "true_pairs": score.true_pairs,
        "found_pairs": score.found_pairs,
        "unlabelled_pairs": unjudged,
        "precision": finite(score.correct_pairs / judged) if judged else None,
        "precision_strict": finite(score.precision) if score.found_pairs else None,
        "recall": finite(score.recall) if score.true_pairs else None,
    }


def map_scores(
    object_of: Int[np.ndarray, " k"],
    owner: Int[np.ndarray, " m"],
    purity: Float[np.ndarray, " m"],
    exists: Bool[np.ndarray, " m"],
    truth: SequenceGroundTruth,
    least_detections: int,
) -> dict[str, Any]:
    """Landmarks against the objects that were detected often enough to be mapped."""
    counts = np.bincount(object_of[object_of >= 0], minlength=len(truth))
    mappable = (counts >= least_detections) & ~truth.moving
    of_object = np.bincount(owner[exists & (owner >= 0)], minlength=len(truth))
    return {
        "landmarks": int(exists.sum()),
        "objects": len(truth),
        "objects_detected": int(mappable.sum()),
        "objects_mapped": int((mappable & (of_object > 0)).sum()),
        "duplicates": int(np.maximum(of_object - 1, 0).sum()),
        "spurious": int((exists & (owner < 0)).sum()),
        "mean_purity": finite(purity[exists].mean()) if exists.any() else None,
    }


def landmark_errors(
    position: Float[np.ndarray, "m 3"],
    owner: Int[np.ndarray, " m"],
    truth: SequenceGroundTruth,
    estimate: Float[np.ndarray, "n 4 4"],
    T_world_camera: Float[np.ndarray, "n 4 4"],
) -> Float[np.ndarray, " m"]:
    """Distance of each landmark from its object, m, after the estimated path was laid onto the true one; NaN without one.

    Positions of a straight road say nothing of a turn about it, which moves whatever stands beside it: orientations do.
    """
    both = known_rows(T_world_camera)
    R, t = pose_alignment(estimate[both], T_world_camera[both])
    placed = position @ R.T + t
    known = (owner >= 0) & ~truth.moving[owner]
    return np.where(known, np.linalg.norm(placed - truth.T_world_object[owner, :3, 3], axis=1), np.nan)


def shape_scores(
    table: Detections,
    landmark_of: Int[np.ndarray, " k"],
    owner: Int[np.ndarray, " m"],
    truth: SequenceGroundTruth,
    model: ShapeModel,
    rng: np.random.Generator,
    views: Sequence[int] = VIEWS,
) -> dict[str, Any] | None:
    """Mean voxel IoU of the same landmarks from 1, 3, 10 of their detections; None where none has enough.

    The latents of the views are fused by precision (NOLBO eq. optimal_mu, corrected), the views are drawn at random.
    """
    latents, truths, groups = [], [], 0
    usable = table.has_latent & (landmark_of >= 0)
    for j in np.flatnonzero(owner >= 0):
        rows = np.flatnonzero(usable & (landmark_of == j))
        if len(rows) < max(views):
            continue
        groups += 1
        for _ in range(REPEATS):
            drawn = rng.permutation(rows)
            for n in views:
                chosen = drawn[:n]
                fused, _ = weighted_latents(
                    table.latent[chosen], table.latent_scale[chosen] ** 2, np.zeros(n, dtype=np.int64), np.ones(n), 1
                )
                latents.append(fused[0])
            truths.append(unpack_voxels(truth.packed[truth.instance[owner[j]]], TRUE_SIDE))
    if not groups:
        return None
    decoded = model.decode(np.array(latents))
    if decoded.shape[1] != TRUE_SIDE:
        return None
    iou = voxel_iou(decoded, np.repeat(np.stack(truths), len(views), axis=0)).reshape(-1, len(views)).mean(axis=0)
    return {"landmarks": groups, "iou": {str(n): finite(value) for n, value in zip(views, iou)}}
