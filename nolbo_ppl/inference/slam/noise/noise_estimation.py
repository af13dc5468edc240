"""Noise scales from the data: consecutive detections of one object tell the detector's scales before any map exists."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from nolbo_ppl.geometry.pose import relative, so3_log
from nolbo_ppl.inference.slam.latent_mixture import nearest_difference
from nolbo_ppl.inference.slam.noise.neighbour_gaps import SURE_GAIN, NeighbourGaps, consecutive_pairs
from nolbo_ppl.inference.slam.noise.view_volume import view_volume
from nolbo_ppl.inference.slam.orientation import nearest_of_modes, observed_modes, resolved_symmetry
from nolbo_ppl.inference.slam.slam_problem import NoiseModel, SlamConfig, SlamProblem
from nolbo_ppl.io.observations import Detections

MAD_TO_SCALE = 1.4826
"""Standard deviation of a normal variable over its median absolute deviation."""

DEFAULT_ROTATION_STEP = 0.004
"""Standard deviation of each angle of an odometry step where nothing is stated, rad (refined on the graph)."""
DEFAULT_TRANSLATION_RATIO = 0.02
"""The same for its translation, m per m."""
ROTATION_LIMITS, TRANSLATION_LIMITS = (1e-8, 10.0), (1e-8, 1e6)
"""Standard deviations of odometry steps are kept within these, rad and m."""
TOO_SMALL = 1.35
"""A stated scale is called too small when normalised residuals are this wide, and `SURE_GAIN` nats more probable so."""
MIN_RANGE_PART = 1e-4
"""Least estimated scale of a position, as a part of the median range: detections of a simulator have none."""


def robust_scale(values: Float[np.ndarray, " n"], weight: Float[np.ndarray, " n"] | None = None) -> float:
    """Standard deviation of the bulk about zero by the (weighted) median absolute value; NaN without values."""
    if not len(values):
        return float("nan")
    if weight is None:
        return float(MAD_TO_SCALE * np.median(np.abs(values)))
    order = np.argsort(np.abs(values), kind="stable")
    total = np.cumsum(weight[order])
    return float(MAD_TO_SCALE * np.abs(values[order[min(np.searchsorted(total, 0.5 * total[-1]), len(order) - 1)]]))


def fit_range_model(distance: Float[np.ndarray, " n"], value: Float[np.ndarray, " n"], bins: int = 4) -> tuple[float, float]:
    """Standard deviation `a + b * range` of single detections from differences `value` of two, by range quantile.

    Both are non-negative; the model never falls below a quarter of the overall scale.
    """
    overall = robust_scale(value) / np.sqrt(2)
    if len(value) < 20 * bins or overall <= 0:
        return overall, 0.0
    edges = np.quantile(distance, np.linspace(0, 1, bins + 1))
    which = np.clip(np.searchsorted(edges, distance, side="right") - 1, 0, bins - 1)
    centre = np.array([np.median(distance[which == k]) for k in range(bins) if (which == k).any()])
    scale = np.array([robust_scale(value[which == k]) / np.sqrt(2) for k in range(bins) if (which == k).any()])
    scale = np.maximum(scale, 1e-3 * overall)  # a bin of exact detections
    design = np.stack([np.ones_like(centre), centre], axis=1) / scale[:, None]
    a, b = np.linalg.lstsq(design, np.ones(len(scale)), rcond=None)[0]
    if b < 0:
        return float(overall), 0.0
    return float(max(a, 0.25 * overall if b == 0 else 0.02 * overall)), float(b)


def ray_covariance(
    position: Float[np.ndarray, "n 3"], lateral: Float[np.ndarray, " n"], radial: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3 3"]:
    """Covariance with one scale along the ray and another across it, m^2."""
    distance = np.linalg.norm(position, axis=1, keepdims=True)
    ray = np.where(distance > 1e-9, position / np.maximum(distance, 1e-9), np.array([0.0, 0.0, 1.0]))
    along = ray[:, :, None] * ray[:, None, :]
    return lateral[:, None, None] ** 2 * (np.eye(3) - along) + radial[:, None, None] ** 2 * along


def estimate_noise(problem: SlamProblem, config: SlamConfig) -> NoiseModel:
    """Every scale in use: stated by observation, else by configuration, else estimated; too small ones are reported.

    Odometry scales nobody stated start from defaults here and are refined on the graph (`refine_odometry`).
    """
    table = problem.observations
    rotation_step, translation_step, correlation = step_sigmas(problem, config)
    pairs = consecutive_pairs(problem, (rotation_step, translation_step))
    report: dict[str, float] = {"pairs": float(len(pairs.first))}
    warnings: list[str] = []
    covariance = _position_covariance(table, pairs, config, report, warnings)
    dof, spread = position_law(table, config)
    covariance = covariance * spread[:, None, None]
    rotation_scale = _rotation_scale(problem, pairs, config, report, warnings)
    latent_scale = _latent_scale(table, pairs, config, report, warnings)
    volume = view_volume(table)
    seen = max(len(np.unique(table.frame)), 1)
    rate = len(table) / seen / volume if len(table) else 1.0
    # Where it is calibrated, objectness says how many are false; the marginals of the map correct it later.
    false = 1.0 - float(np.mean(np.clip(table.objectness, *config.objectness_limits))) if len(table) else 0.1
    return NoiseModel(
        rotation_step=rotation_step,
        translation_step=translation_step,
        position_covariance=covariance,
        rotation_scale=rotation_scale,
        latent_scale=latent_scale,
        birth_intensity=config.birth_intensity if config.birth_intensity is not None else 0.2 * rate,
        clutter_intensity=config.clutter_intensity if config.clutter_intensity is not None else false * rate,
        report=report,
        warnings=tuple(warnings),
        step_correlation=correlation,
        position_dof=dof,
    )


def position_law(table: Detections, config: SlamConfig) -> tuple[float | None, Float[np.ndarray, " n"]]:
    """Degrees of freedom of all positions (None: Gaussian), and the factor that makes each stated covariance a scale matrix.

    The configuration's, else what the detections state, where it is asked for: the median of their degrees of freedom, each its
    own factor.
    """
    stated = np.isfinite(table.position_covariance).all(axis=(1, 2))
    if config.position_tails is not None:
        return config.position_tails[0], np.where(stated, config.position_tails[1], 1.0)
    told = np.isfinite(table.position_tails).all(axis=1)
    if not (config.stated_tails and told.any()):
        return None, np.ones(len(table))
    return float(np.median(table.position_tails[told, 0])), np.where(stated & told, table.position_tails[:, 1], 1.0)


def step_sigmas(
    problem: SlamProblem, config: SlamConfig
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, "n 6 6"] | None]:
    """Scales of each step, and its covariance in units of them where the problem states it."""
    covariance = problem.odometry_covariance
    if covariance is None:
        length = np.linalg.norm(np.diff(problem.odometry[:, :3, 3], axis=0), axis=1)
        return *odometry_sigmas(length, config), None
    rotation, translation = (
        np.sqrt(np.trace(covariance[:, part, part], axis1=1, axis2=2) / 3) for part in (slice(3), slice(3, 6))
    )
    scale = np.repeat(np.stack([rotation, translation], axis=1), 3, axis=1)
    correlation = covariance / scale[:, :, None] / scale[:, None, :]
    # Numbers beyond these leave no digit for the rest of the graph.
    rotation, translation = np.clip(rotation, *ROTATION_LIMITS), np.clip(translation, *TRANSLATION_LIMITS)
    return rotation, translation, correlation


def odometry_sigmas(
    length: Float[np.ndarray, " n"], config: SlamConfig
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Scales of each step from the configuration: a constant and a part that grows with the step, added as variances."""
    typical = float(np.sqrt(np.mean(length**2))) if len(length) else 1.0
    typical = max(typical, 1e-3)
    rotation = DEFAULT_ROTATION_STEP if config.odometry_rotation_scale is None else config.odometry_rotation_scale
    constant, ratio = config.odometry_translation_scale, config.odometry_translation_ratio
    if constant is None and ratio is None:
        ratio = DEFAULT_TRANSLATION_RATIO
        constant = 0.3 * ratio * typical
    constant, ratio = constant or 0.0, ratio or 0.0
    translation = np.sqrt(constant**2 + (ratio * length) ** 2)
    return np.full(len(length), max(rotation, 1e-6)), np.maximum(translation, 1e-4 * typical)


def _ray_parts(position: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residual along the ray [n] and across it [n, 3]."""
    ray = position / np.maximum(np.linalg.norm(position, axis=1, keepdims=True), 1e-9)
    along = np.sum(ray * residual, axis=1)
    return along, residual - along[:, None] * ray


def _position_covariance(
    table: Detections, pairs: NeighbourGaps, config: SlamConfig, report: dict[str, float], warnings: list[str]
) -> np.ndarray:
    given = np.isfinite(table.position_covariance).all(axis=(1, 2))
    distance = np.linalg.norm(table.position, axis=1)
    along, across = _ray_parts(table.position[pairs.second], pairs.residual)
    at = distance[pairs.second]
    if config.position_scale is not None or config.position_ratio is not None:
        lateral = radial = np.maximum((config.position_scale or 0.0) + (config.position_ratio or 0.0) * distance, 1e-6)
    elif len(pairs.first) >= 5:
        # Across the ray two components are left: their length is Rayleigh, its median 1.1774 scales.
        length = np.linalg.norm(across, axis=1) * (1 / 1.1774 / MAD_TO_SCALE)
        a_lateral, b_lateral = fit_range_model(at, length)
        a_radial, b_radial = fit_range_model(at, along)
        report.update(
            position_lateral=a_lateral, position_lateral_ratio=b_lateral, position_radial=a_radial, position_radial_ratio=b_radial
        )
        lateral, radial = a_lateral + b_lateral * distance, a_radial + b_radial * distance
    else:
        lateral = radial = 0.05 * distance + 1e-3
    floor = MIN_RANGE_PART * max(float(np.median(distance)) if len(distance) else 1.0, 1e-3)
    estimated = ray_covariance(table.position, np.maximum(lateral, floor), np.maximum(radial, floor))
    covariance = np.where(given[:, None, None], np.nan_to_num(table.position_covariance), estimated)
    ratio, gain = pairs.ratio_to_stated
    if np.isfinite(ratio):
        report["position_ratio_to_stated"] = ratio
        if ratio > TOO_SMALL and gain > SURE_GAIN:
            warnings.append(f"stated position scales are too small: gaps between frames are {ratio:.2f} times as wide")
            if config.correct_scales:
                covariance = np.where(given[:, None, None], covariance * ratio**2, covariance)
    return covariance


def _rotation_scale(
    problem: SlamProblem, pairs: NeighbourGaps, config: SlamConfig, report: dict[str, float], warnings: list[str]
) -> np.ndarray:
    table = problem.observations
    scale = table.rotation_scale.copy()
    both = table.has_rotation[pairs.first] & table.has_rotation[pairs.second] if len(pairs.first) else np.zeros(0, bool)
    default = config.rotation_scale
    if both.sum() >= 5:
        i, j = pairs.first[both], pairs.second[both]
        carried = relative(problem.odometry[table.frame[j]], problem.odometry[table.frame[i]])[:, :3, :3] @ table.rotation[i]
        symmetry = resolved_symmetry(table, config)
        observed = nearest_of_modes(carried, observed_modes(table, np.ones(len(table)), j), symmetry[j])
        error = so3_log(np.swapaxes(carried, 1, 2) @ observed)
        error[symmetry[j] == 0, 2] = np.nan
        values = error[np.isfinite(error)]
        # A third of detectors' angles are nearly constrained (upright objects): the widest axis is the scale.
        weight = pairs.weight[both]
        widest = max(
            robust_scale(error[use, k], weight[use]) for k, use in enumerate(np.isfinite(error).T) if use.any()
        ) / np.sqrt(2)
        report["rotation_scale"] = widest
        if default is None:
            default = max(widest, 1e-3)
        stated = np.isfinite(scale[i]) & np.isfinite(scale[j])
        if stated.sum() >= 30:
            width = np.sqrt(scale[i] ** 2 + scale[j] ** 2)[:, None]
            normalised = (error / width)[stated]
            use = np.isfinite(normalised)
            ratio = robust_scale(normalised[use], np.broadcast_to(weight[stated, None], use.shape)[use])
            report["rotation_ratio_to_stated"] = ratio
            if ratio > TOO_SMALL and len(values):
                warnings.append(f"stated rotation scales are too small: gaps between frames are {ratio:.2f} times as wide")
                if config.correct_scales:
                    scale = scale * ratio
    return np.where(np.isfinite(scale), scale, 0.1 if default is None else default)


def _latent_scale(
    table: Detections, pairs: NeighbourGaps, config: SlamConfig, report: dict[str, float], warnings: list[str]
) -> np.ndarray:
    scale = table.latent_scale.copy()
    if not table.latent_dim:
        return scale
    default = config.latent_scale
    own = 1.0 - (config.latent_correlation or 0.0)  # share of the variance in which two views of an object differ
    both = table.has_latent[pairs.first] & table.has_latent[pairs.second] if len(pairs.first) else np.zeros(0, bool)
    if both.sum() >= 5:
        i, j = pairs.first[both], pairs.second[both]
        difference = nearest_difference(table, i, j)
        weight = np.repeat(pairs.weight[both], difference.shape[1])
        measured = robust_scale(difference.ravel(), weight) / np.sqrt(2 * own)
        report["latent_scale"] = measured
        if default is None:
            default = max(measured, 1e-6)
        stated = np.isfinite(scale[i]).all(axis=1) & np.isfinite(scale[j]).all(axis=1)
        if stated.sum() >= 30:
            normalised = (difference / np.sqrt(own * (scale[i] ** 2 + scale[j] ** 2)))[stated].ravel()
            ratio = robust_scale(normalised, np.repeat(pairs.weight[both][stated], difference.shape[1]))
            report["latent_ratio_to_stated"] = ratio
            if ratio > TOO_SMALL:
                warnings.append(f"stated latent scales are too small: gaps between frames are {ratio:.2f} times as wide")
                if config.correct_scales:
                    scale = scale * ratio
    return np.where(np.isfinite(scale), scale, 1.0 if default is None else default)
