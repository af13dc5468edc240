"""What a model answers beside what is true: the step from `ObjectPosteriors` to the records of `metrics.figures`.

Detection is measured on everything the model finds; category, viewpoint, position and shape at the true boxes, on the
region responsible for each ("with ground truth bounding box", NOLBO Table 1).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8

from nolbo_ppl.errors import input_error
from nolbo_ppl.evaluation.records import DetectionRecords, ObjectRecords
from nolbo_ppl.geometry.rotation import egocentric_to_allocentric, matrix_to_viewpoint
from nolbo_ppl.geometry.voxels import pack_voxels, unpack_voxels
from nolbo_ppl.metrics.calibration import chi_square_mass, circular_crps
from nolbo_ppl.metrics.detection import Matches, match
from nolbo_ppl.metrics.heavy_tails import GAUSSIAN_DOF, StudentT
from nolbo_ppl.metrics.viewpoint_error import rotation_error
from nolbo_ppl.metrics.voxel import voxel_average_precision, voxel_iou
from nolbo_ppl.models.distributions import VonMisesMixture
from nolbo_ppl.structures.annotations import Annotations
from nolbo_ppl.structures.latent_modes import LatentModes
from nolbo_ppl.structures.object_posteriors import ObjectPosteriors

LATENT_DRAWS = 2000
"""Draws that measure regions of mixtures: their masses are right to 0.011."""
CRPS_NODES = 360
"""Nodes on the circle of the ranked probability score: one a degree."""


@runtime_checkable
class ShapeModel(Protocol):
    """What measuring needs of a model besides its observations (`nolbo_ppl.inference.posterior.predictor.ObservationModel`)."""

    def decode(self, latent: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n v v v"]:
        """Occupancy probabilities of latents."""

    def shape_posterior(self, packed: UInt8[np.ndarray, "n bytes"]) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, "n d"]]:
        """Mean and scale of the latent of true shapes."""

    def prior_mean(self) -> Float[np.ndarray, "labels d"]:
        """Mean latent of each category."""


def measure_objects(
    truth: Sequence[Annotations],
    answers: Sequence[ObjectPosteriors],
    slots: Sequence[Int[np.ndarray, " _"]],
    scenes: Sequence[int],
    model: ShapeModel,
    tails: StudentT | None = None,
) -> ObjectRecords:
    """Compare the answers at true boxes with the truth.

    Args:
        truth: labelled scenes.
        answers: for each, the observations at the boxes of its objects `slots`, in that order.
        slots: rows of the objects asked for.
        scenes: numbers of these scenes.
        model: decoder, prior means and shape autoencoder.
        tails: law of the positions about their covariances, as the model's calibration states it; None: Gaussian.

    Raises:
        InputError: the lists do not match each other.
    """
    if not len(truth) == len(answers) == len(slots) or any(len(a) != len(s) for a, s in zip(answers, slots)):
        raise input_error("answers at true boxes", got=[len(a) for a in answers], expected=[len(s) for s in slots])

    def true(name: str) -> np.ndarray:
        return np.concatenate([getattr(scene, name)[rows] for scene, rows in zip(truth, slots)])

    def said(name: str) -> np.ndarray:
        return np.concatenate([np.asarray(getattr(one, name), dtype=np.float64) for one in answers])

    labels = [scene.labels(answer.categories)[rows] for scene, answer, rows in zip(truth, answers, slots)]
    category, symmetry, position = np.concatenate(labels), true("symmetry"), true("position")
    R_truth = true("R_camera_object")
    viewpoint = _allocentric(R_truth, _rays(truth, slots))
    orientation = _orientation(viewpoint, symmetry, answers)
    voxels = np.concatenate([_voxels(scene)[rows] for scene, rows in zip(truth, slots)])
    shape = _shape(voxels, category, said("latent"), said("latent_scale"), _latent_modes(answers), model)
    log_posterior = said("class_log_posterior")
    oriented = np.isfinite(R_truth).all((1, 2))
    error = np.full(len(category), np.nan)
    error[oriented] = rotation_error(said("R_camera_object")[oriented], R_truth[oriented], symmetry[oriented])
    tilt = _wrap(viewpoint[:, 1:] - said("elevation_inplane"))
    distance = np.linalg.norm(position, axis=1)
    depth = said("position")[:, 2]
    return ObjectRecords(
        scene=np.repeat(np.asarray(scenes), [len(rows) for rows in slots]),
        slot=np.concatenate([np.asarray(rows) for rows in slots]),
        category=category,
        symmetry=symmetry,
        side=true("side"),
        visibility=true("visibility"),
        likeliest=said("class_log_likelihood").argmax(1),
        class_posterior=np.exp(log_posterior - np.logaddexp.reduce(log_posterior, axis=1, keepdims=True)),
        rotation_error=error,
        tilt_mass=chi_square_mass(tilt, said("elevation_inplane_scale") ** 2),
        position_mass=chi_square_mass(position - said("position"), said("position_covariance")),
        **_position_densities(position - said("position"), said("position_covariance"), tails),
        range_error=np.abs(np.linalg.norm(said("position"), axis=1) / distance - 1),
        depth_error=np.abs(depth / position[:, 2] - 1),
        # An image shows the ratio of distance and size: the true size takes the place of the estimated one.
        sized_depth_error=np.abs(depth * true("diagonal") / said("diagonal") / position[:, 2] - 1),
        azimuth_error=np.where(symmetry == 1, _wrap(said("viewpoint")[:, 0] - viewpoint[:, 0]), np.nan),
        **orientation,
        **shape,
    )


def _position_densities(
    error: Float[np.ndarray, "n 3"], covariance: Float[np.ndarray, "n 3 3"], tails: StudentT | None
) -> dict[str, Float[np.ndarray, " n"]]:
    """Log density of the truth under the Gaussian and under the law with tails, and the mass of the latter's region."""
    squared = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    log_determinant = np.linalg.slogdet(2 * np.pi * covariance)[1]
    law = tails or StudentT(GAUSSIAN_DOF, 1.0)
    return {
        "position_squared": squared,
        "position_log_density": -0.5 * (squared + log_determinant),
        "position_tails_mass": law.mass(squared, 3),
        "position_tails_log_density": law.log_density(squared, log_determinant, 3),
    }


def _voxels(scene: Annotations) -> UInt8[np.ndarray, "m bytes"]:
    """Packed grids of a scene's objects. Raises `InputError` when nobody has looked them up."""
    if scene.voxels is None:
        raise input_error("objects without grids", got=scene.file, expected="`voxels`, all zero where one is unknown")
    return scene.voxels


def _wrap(angle: np.ndarray) -> np.ndarray:
    return np.remainder(angle + np.pi, 2 * np.pi) - np.pi


def _rays(truth: Sequence[Annotations], slots: Sequence[np.ndarray]) -> Float[np.ndarray, "n 3"]:
    """Towards each object's centre where its position is known, else through the middle of its box."""
    rays = []
    for scene, rows in zip(truth, slots):
        box, position = scene.box[rows], scene.position[rows]
        slope = ((box[:, :2] + box[:, 2:]) / 2 - scene.intrinsics[2:]) / scene.intrinsics[:2]
        through_box = np.concatenate((slope, np.ones((len(slope), 1))), axis=1)
        rays.append(np.where(np.isfinite(position).all(1, keepdims=True), position, through_box))
    return np.concatenate(rays)


def _allocentric(R: Float[np.ndarray, "n 3 3"], ray: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Allocentric viewpoint of each rotation, NaN where it is unknown."""
    viewpoint = np.full((len(R), 3), np.nan)
    known = np.isfinite(R).all((1, 2))
    if known.any():
        allocentric = egocentric_to_allocentric(torch.from_numpy(R[known]), torch.from_numpy(ray[known]))
        viewpoint[known] = matrix_to_viewpoint(allocentric).numpy()
    return viewpoint


def _orientation(
    viewpoint: Float[np.ndarray, "n 3"], symmetry: Int[np.ndarray, " n"], answers: Sequence[ObjectPosteriors]
) -> dict[str, Float[np.ndarray, " n"]]:
    """Mass, log density and ranked score of the azimuth posteriors at the truth; a free axis has no azimuth."""
    parts = {
        name: np.concatenate([getattr(a.viewpoint_modes, name) for a in answers]).astype(np.float64)
        for name in ("weights", "azimuth", "concentration")
    }
    result = {name: np.full(len(symmetry), np.nan) for name in ("azimuth_mass", "azimuth_log_density", "azimuth_crps")}
    rows = np.flatnonzero(np.isfinite(viewpoint[:, 0]) & (symmetry != 0))
    if not len(rows):
        return result
    weights, mean, concentration = (torch.from_numpy(parts[name][rows]) for name in parts)
    posterior = VonMisesMixture.from_mean_concentration(
        weights.clamp_min(1e-300).log(), mean, concentration, max_concentration=float(concentration.max()) + 1
    )
    azimuth, order = torch.from_numpy(viewpoint[rows, 0]), torch.from_numpy(symmetry[rows])
    result["azimuth_mass"][rows] = posterior.hpd_mass(azimuth, order).numpy()
    plain = symmetry[rows] == 1
    nodes = torch.arange(CRPS_NODES, dtype=torch.float64) * (2 * torch.pi / CRPS_NODES) - torch.pi
    density = posterior.log_density(nodes[:, None]).T.numpy()
    result["azimuth_log_density"][rows[plain]] = posterior.log_density(azimuth).numpy()[plain]
    result["azimuth_crps"][rows[plain]] = circular_crps(density[plain], viewpoint[rows, 0][plain])
    return result


def _latent_modes(answers: Sequence[ObjectPosteriors]) -> LatentModes:
    """The latents of all answers as mixtures, those of models without categories of one mode."""
    parts = [one.latent_modes or LatentModes.of_one(one.latent) for one in answers]
    return LatentModes(
        *(np.concatenate([getattr(part, field.name) for part in parts]) for field in dataclasses.fields(LatentModes))
    )


def _latent_regions(
    teacher: Float[np.ndarray, "n d"],
    latent: Float[np.ndarray, "n d"],
    scale: Float[np.ndarray, "n d"],
    modes: LatentModes,
) -> dict[str, Float[np.ndarray, " n"]]:
    """Mass and log density of the latents' mixtures at the truth, and of the likeliest category's Gaussian beside them."""
    one = chi_square_mass(teacher - latent, scale**2)
    mass, several = one.copy(), np.flatnonzero((modes.weight > 0).sum(axis=1) > 1)
    if len(several):
        # One set of draws for all: an object's figure does not depend on which others are measured with it.
        draws = np.random.default_rng(0).standard_normal((LATENT_DRAWS, latent.shape[1]))
        mass[several] = modes.select(several).region_mass(teacher[several], scale[several], draws)
    return {
        "latent_mass": mass,
        "latent_log_density": modes.log_density(teacher, scale),
        "latent_gaussian_mass": one,
        "latent_gaussian_log_density": LatentModes.of_one(latent).log_density(teacher, scale),
    }


def _shape(
    packed: UInt8[np.ndarray, "n bytes"],
    category: Int[np.ndarray, " n"],
    latent: Float[np.ndarray, "n d"],
    latent_scale: Float[np.ndarray, "n d"],
    modes: LatentModes,
    model: ShapeModel,
) -> dict[str, Float[np.ndarray, " n"]]:
    """Voxel figures and those of the latent's regions, NaN where the true shape is unknown."""
    regions = [f"latent{law}_{figure}" for law in ("", "_gaussian") for figure in ("mass", "log_density")]
    names = (*regions, "voxel_iou", "category_iou", "teacher_iou", "voxel_ap")
    result = {name: np.full(len(category), np.nan) for name in names}
    rows = np.flatnonzero(packed.any(1))
    if not len(rows):
        return result
    prior = model.decode(model.prior_mean())
    side = round((8 * packed.shape[1]) ** (1 / 3))
    truth = unpack_voxels(packed[rows], side)
    teacher, _ = model.shape_posterior(pack_voxels(_refined(truth, prior.shape[1])))
    for name, value in _latent_regions(teacher, latent[rows], latent_scale[rows], modes.select(rows)).items():
        result[name][rows] = value
    decoded = _coarsened(model.decode(latent[rows]), side)
    result["voxel_iou"][rows] = voxel_iou(decoded, truth)
    result["voxel_ap"][rows] = voxel_average_precision(decoded, truth)
    result["teacher_iou"][rows] = voxel_iou(_coarsened(model.decode(teacher), side), truth)
    labelled = category[rows] >= 0
    of_category = _coarsened(prior, side)[category[rows][labelled]]
    result["category_iou"][rows[labelled]] = voxel_iou(of_category, truth[labelled])
    return result


def _factor(fine: int, coarse: int) -> int:
    if fine % coarse:
        raise input_error("voxel grids", got=f"{coarse}^3 for a model of {fine}^3", expected="the same or a divisor")
    return fine // coarse


def _refined(truth: Bool[np.ndarray, "n v v v"], side: int) -> Bool[np.ndarray, "n w w w"]:
    """Grids with every voxel repeated up to the model's resolution."""
    factor = _factor(side, truth.shape[1])
    for axis in (1, 2, 3) if factor > 1 else ():
        truth = truth.repeat(factor, axis=axis)
    return truth


def _coarsened(probability: Float[np.ndarray, "n w w w"], side: int) -> Float[np.ndarray, "n v v v"]:
    """Mean probability over blocks, down to the resolution of the truth."""
    factor = _factor(probability.shape[1], side)
    if factor == 1:
        return probability
    return probability.reshape(-1, side, factor, side, factor, side, factor).mean((2, 4, 6))


def measure_detections(
    truth_boxes: Sequence[Float[np.ndarray, "_ 4"]],
    truth_categories: Sequence[Int[np.ndarray, " _"]],
    counts: Sequence[Bool[np.ndarray, " _"]],
    answers: Sequence[tuple[Float[np.ndarray, "_ 4"], Float[np.ndarray, " _"], Float[np.ndarray, "_ labels"]]],
    labels: int,
    iou_threshold: float = 0.5,
    regions: Sequence[Float[np.ndarray, "_ 4"]] | None = None,
) -> DetectionRecords:
    """Match everything a model found, as objects of any category and category by category.

    Args:
        truth_boxes: boxes of every object of each scene.
        truth_categories: their labels.
        counts: whether each counts; a detection of one that does not is left out.
        answers: boxes, objectness and class posterior of the detections of each scene.
        labels: number of categories.
        iou_threshold: least overlap of a match.
        regions: parts of each scene where detections are not judged.
    """
    boxes, objectness = [box for box, _, _ in answers], [score for _, score, _ in answers]
    found = match(boxes, objectness, truth_boxes, [~c for c in counts], iou_threshold, regions)
    best = [posterior.argmax(1) if len(posterior) else np.empty(0, dtype=int) for _, _, posterior in answers]
    score = [o * (p.max(1) if len(p) else 1.0) for _, o, p in answers]

    def of(label: int) -> Matches:
        own = [b == label for b in best]
        # An object without a category label may be of this one: it neither counts nor penalises.
        concerned = [(c == label) | (c < 0) for c in truth_categories]
        ignore = [(~n | (c < 0))[k] for n, c, k in zip(counts, truth_categories, concerned)]
        return match(
            [b[k] for b, k in zip(boxes, own)],
            [s[k] for s, k in zip(score, own)],
            [t[k] for t, k in zip(truth_boxes, concerned)],
            ignore,
            iou_threshold,
            regions,
        )

    return DetectionRecords(found, tuple(of(label) for label in range(labels)))
