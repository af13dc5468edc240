"""Noise scales from the data: consecutive detections of one object tell the detector's scales before any map exists."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.special import gammainc, gammaln

from nolbo_ppl.geometry.pose import relative, so3_log, transform
from nolbo_ppl.inference.slam.gaussian import squared_distance
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
"""A stated scale is called too small when normalised residuals are this wide."""
SURE_GAIN = 8.0
"""And when this width is more probable than the stated one by as many nats."""
MIN_PAIRS = 5
"""Fewer pairs of one object than this tell no scale."""
NEAREST = 6
"""Earlier detections looked at for each later one."""
LARGEST_FRAME = 500
"""Detections of one frame looked at."""
BALL = 5.0
"""Radius, in widths, within which gaps of one object are told from those of strangers."""
MIN_RANGE_PART = 1e-4
"""Least estimated scale of a position, as a part of the median range: detections of a simulator have none."""


@dataclass(frozen=True)
class DetectionPairs:
    """Detections of two neighbouring frames that may be of one object, each with the probability that they are."""

    first: Int[np.ndarray, " p"]
    """Rows of the earlier detections."""
    second: Int[np.ndarray, " p"]
    """Rows of the later ones."""
    residual: Float[np.ndarray, "p 3"]
    """Position of the second less the first carried over by odometry, in the second camera frame, m."""
    weight: Float[np.ndarray, " p"]
    """Probability that both are of one object."""
    ratio_to_stated: tuple[float, float]
    """Width of the gaps in units of the stated covariances (NaN: too few are stated), and what it gains over 1, nats."""


def neighbouring_pairs(problem: SlamProblem, maximum: int = 4000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All pairs of detections of equal category in consecutive frames: rows of both, and their gap after odometry, m.

    At most `NEAREST` earlier ones for each later one: farther ones are strangers that tell nothing.
    """
    table = problem.observations
    order = np.argsort(table.frame, kind="stable")
    frames, starts = np.unique(table.frame[order], return_index=True)
    groups = np.split(order, starts[1:])
    label = np.unique([c or "" for c in table.category], return_inverse=True)[1] if len(table) else np.zeros(0, int)
    first, second, residual = [], [], []
    stride = max(1, int(len(table) / max(maximum, 1)))
    for g in range(0, len(frames) - 1, stride):
        if frames[g + 1] - frames[g] > 2:
            continue
        a, b = groups[g], groups[g + 1][:LARGEST_FRAME]
        carried = transform(relative(problem.odometry[frames[g + 1]], problem.odometry[frames[g]]), table.position[a])
        gap = table.position[b][None] - carried[:, None]
        distance = np.where(label[a][:, None] == label[b][None], np.linalg.norm(gap, axis=2), np.inf)
        near = np.argsort(distance, axis=0, kind="stable")[:NEAREST]
        i, j = near.ravel(), np.tile(np.arange(len(b)), len(near))
        use = np.isfinite(distance[i, j])
        i, j = i[use], j[use]
        first.append(a[i])
        second.append(b[j])
        residual.append(gap[i, j])
    if not first:
        return np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3))
    return np.concatenate(first), np.concatenate(second), np.concatenate(residual)


def same_or_stranger(squared: Float[np.ndarray, " p"], dimension: int = 3) -> tuple[float, float, Float[np.ndarray, " p"]]:
    """Width of the gaps of one object among gaps to strangers, from whitened squared lengths.

    Two components in a ball: gaps of one object are normal of width c, strangers fill the ball evenly; share and width by
    maximum likelihood. The smallest ball in which a peak stands out is taken, so that no crowd of strangers passes for one.
    Mutual nearest neighbours, the usual way, take strangers for objects where detections are missed: scales stated exactly
    came out 1.9 times too small in drives with 60 % misses (here 1.00 to 1.10).

    Returns:
        The width c (NaN where no peak stands out), the gain in log likelihood over a width of 1 (nats), and the probability of
        every gap of being of one object.
    """
    length = np.sqrt(np.maximum(squared, 0.0))
    none = np.zeros(len(length))
    if len(length) < MIN_PAIRS:
        return float("nan"), 0.0, none
    ordered = np.sort(length)
    floor = max(1e-9 * float(ordered[-1]), 1e-150)
    start, end = max(float(ordered[MIN_PAIRS - 1]), floor), max(float(np.median(ordered)) * BALL, 2 * floor)
    for ball in np.geomspace(start, max(end, start), 16):
        fit = _peak(ordered, float(ball), dimension)
        if fit is None:
            continue
        for _ in range(4):
            closer = _peak(ordered, BALL * fit[0], dimension)
            if closer is None or abs(closer[0] / fit[0] - 1) < 0.02:
                break
            fit = closer
        width, share, ball = fit
        inside = length <= ball
        log_same, log_other = _log_components(length[inside], width, ball, dimension)
        probability = none
        probability[inside] = share / (share + (1 - share) * np.exp(np.minimum(log_other - log_same, 500)))
        return (
            width,
            _log_mixture(length, width, share, ball, dimension) - _gain_as_stated(length, share, ball, dimension),
            probability,
        )
    return float("nan"), 0.0, none


def _peak(ordered: np.ndarray, ball: float, dimension: int) -> tuple[float, float, float] | None:
    """Width and share of the peak in a ball, and the ball; None where nothing stands out of what fills it evenly."""
    x = ordered[: np.searchsorted(ordered, ball, side="right")]
    if len(x) < MIN_PAIRS:
        return None
    width, share = 0.2 * ball, 0.5
    for _ in range(80):
        log_same, log_other = _log_components(x, width, ball, dimension)
        responsibility = share / (share + (1 - share) * np.exp(np.minimum(log_other - log_same, 500)))
        total = responsibility.sum()
        share = float(np.clip(total / len(x), 1e-6, 1 - 1e-6))
        before, width = width, max(float(np.sqrt((responsibility @ x**2) / max(total, 1e-12) / dimension)), 1e-9 * ball)
        if abs(width - before) < 1e-4 * before:
            break
    if width > ball / 3 or share * len(x) < MIN_PAIRS:
        return None
    gain = _log_mixture(x, width, share, ball, dimension) - _log_components(x, width, ball, dimension)[1].sum()
    return (width, share, ball) if gain > SURE_GAIN else None


def _log_mixture(x: np.ndarray, width: float, share: float, ball: float, dimension: int) -> float:
    log_same, log_other = _log_components(x[x <= ball], width, ball, dimension)
    return float(np.logaddexp(np.log(share) + log_same, np.log1p(-share) + log_other).sum())


def _gain_as_stated(x: np.ndarray, share: float, ball: float, dimension: int) -> float:
    """The best log likelihood with a width of 1, over the share."""
    return max(_log_mixture(x, 1.0, float(s), ball, dimension) for s in (*np.linspace(0.02, 0.98, 25), share))


def _log_components(x: np.ndarray, width: float, ball: float, dimension: int) -> tuple[np.ndarray, np.ndarray]:
    """Log densities of lengths: normal of a width cut to the ball, and even in the ball."""
    log_x = np.log(np.maximum(x, 1e-300))
    inside = gammainc(dimension / 2, 0.5 * (ball / width) ** 2)  # chi-square mass in the ball
    log_norm = (dimension / 2 - 1) * np.log(2) + gammaln(dimension / 2) + np.log(max(inside, 1e-300))
    log_normal = (dimension - 1) * log_x - dimension * np.log(width) - 0.5 * (x / width) ** 2 - log_norm
    return log_normal, np.log(dimension) + (dimension - 1) * log_x - dimension * np.log(ball)


def consecutive_pairs(
    problem: SlamProblem, steps: tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]], maximum: int = 4000
) -> DetectionPairs:
    """Detections of consecutive frames that are likely (more than a half) of one object, by their gap alone.

    Gaps are measured in units of the stated covariances where both are stated, else of the range, whose share is unknown.

    Args:
        problem: odometry and detections.
        steps: scales of rotation and translation of the odometry's steps.
        maximum: about as many detections are looked at.
    """
    table = problem.observations
    first, second, residual = neighbouring_pairs(problem, maximum)
    covariance = table.position_covariance[first] + table.position_covariance[second]
    if len(first):
        # The step between the frames errs as well: its scale as stated, else the default.
        rotation, translation = (np.concatenate([[0.0], np.cumsum(scale**2)]) for scale in steps)
        begin, end = table.frame[first], table.frame[second]
        reach = np.sum(table.position[second] ** 2, axis=1)
        drift = translation[end] - translation[begin] + (rotation[end] - rotation[begin]) * reach
        covariance = covariance + drift[:, None, None] * np.eye(3)
    stated = np.isfinite(covariance).all(axis=(1, 2))
    weight = np.zeros(len(first))
    distance = np.linalg.norm(table.position[second], axis=1)
    ratio = (float("nan"), 0.0)
    if stated.any():
        squared, _ = squared_distance(residual[stated], covariance[stated])
        *ratio_and_gain, weight[stated] = same_or_stranger(squared)
        if (weight[stated] > 0.5).sum() >= 30:
            ratio = (ratio_and_gain[0], ratio_and_gain[1])
    if not stated.all():
        squared = np.sum(residual[~stated] ** 2, axis=1) / np.maximum(distance[~stated], 1e-3) ** 2
        weight[~stated] = same_or_stranger(squared)[2]
    keep = weight > 0.5
    return DetectionPairs(first[keep], second[keep], residual[keep], weight[keep], ratio)


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
        new_rate=config.new_rate if config.new_rate is not None else 0.2 * rate,
        clutter_rate=config.clutter_rate if config.clutter_rate is not None else false * rate,
        report=report,
        warnings=tuple(warnings),
        step_correlation=correlation,
    )


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
    table: Detections, pairs: DetectionPairs, config: SlamConfig, report: dict[str, float], warnings: list[str]
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
    problem: SlamProblem, pairs: DetectionPairs, config: SlamConfig, report: dict[str, float], warnings: list[str]
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
    table: Detections, pairs: DetectionPairs, config: SlamConfig, report: dict[str, float], warnings: list[str]
) -> np.ndarray:
    scale = table.latent_scale.copy()
    if not table.latent_dim:
        return scale
    default = config.latent_scale
    both = table.has_latent[pairs.first] & table.has_latent[pairs.second] if len(pairs.first) else np.zeros(0, bool)
    if both.sum() >= 5:
        i, j = pairs.first[both], pairs.second[both]
        difference = table.latent[j] - table.latent[i]
        weight = np.repeat(pairs.weight[both], difference.shape[1])
        measured = robust_scale(difference.ravel(), weight) / np.sqrt(2)
        report["latent_scale"] = measured
        if default is None:
            default = max(measured, 1e-6)
        stated = np.isfinite(scale[i]).all(axis=1) & np.isfinite(scale[j]).all(axis=1)
        if stated.sum() >= 30:
            normalised = (difference / np.sqrt(scale[i] ** 2 + scale[j] ** 2))[stated].ravel()
            ratio = robust_scale(normalised, np.repeat(pairs.weight[both][stated], difference.shape[1]))
            report["latent_ratio_to_stated"] = ratio
            if ratio > TOO_SMALL:
                warnings.append(f"stated latent scales are too small: gaps between frames are {ratio:.2f} times as wide")
                if config.correct_scales:
                    scale = scale * ratio
    return np.where(np.isfinite(scale), scale, 1.0 if default is None else default)
