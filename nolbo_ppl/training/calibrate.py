"""Fit the calibration factors on held-out scenes: one number a head, so that little data is enough."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable

import torch
from jaxtyping import Float, Int
from scipy.optimize import brentq, minimize
from scipy.stats import chi2
from torch import Tensor

from nolbo_ppl.devices import placed
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.rotation import wrap_angle
from nolbo_ppl.inference.posterior.decode import box_sigmas, position_covariance
from nolbo_ppl.metrics.heavy_tails import GAUSSIAN_DOF, StudentT, fit_student_t, supported_probability
from nolbo_ppl.models.distributions import VonMisesMixture
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.observed_scene import RegionParameters
from nolbo_ppl.models.posterior_calibration import CERTAIN, Calibration
from nolbo_ppl.models.scene_batch import Assignment, SceneBatch, decode_box, decode_range

MIN_OBJECTS = 50
"""Fewer held-out objects than this fix no factor."""


class TooFewObjects(InputError):
    """Not enough held-out objects to fit the factors on."""


def region_factor(squared: Float[Tensor, " n"], dimensions: int, level: float = 0.9) -> float:
    """Factor on a Gaussian's scales after which its `level` region covers just that share of the truths.

    `squared` holds squared Mahalanobis distances. A maximum-likelihood factor would follow the heavy tails of the few
    objects that are taken for something else, and leave the region of all others too wide.
    """
    return float(torch.sqrt(torch.quantile(squared.double(), level) / chi2.ppf(level, dimensions)))


def position_factor(
    error: Float[Tensor, "n 3"], by_range: Float[Tensor, "n 3 3"], by_box: Float[Tensor, "n 3 3"], level: float = 0.9
) -> float:
    """Factor f after which the `level` region of covariances `f^2 by_range + by_box` covers just that share of the errors.

    Limited to [0.05, 20], where no factor in between does.
    """
    wanted = chi2.ppf(level, 3)

    def excess(log_factor: float) -> float:
        covariance = math.exp(2 * log_factor) * by_range + by_box
        solved = torch.linalg.solve(covariance, error[..., None])[..., 0]
        return float(torch.log(torch.quantile((error * solved).sum(-1), level).clamp_min(1e-300) / wanted))

    low, high = math.log(0.05), math.log(20.0)
    if excess(low) <= 0:
        return math.exp(low)
    return math.exp(high if excess(high) >= 0 else brentq(excess, low, high, xtol=1e-4))


def view_correlation(error: Float[Tensor, "n d"], group: Int[Tensor, " n"]) -> float:
    """Correlation of whitened errors between members of a group (views of one shape); at least 0, 0 without pairs.

    Fisher's intraclass correlation about a mean of zero: products of all pairs of a group over mean squares. Errors are cut at
    three scales, so that a few gross ones do not decide; a group of n views counts n - 1 times.
    """
    z = error.double().clamp(-3, 3)
    _, member, count = torch.unique(group, return_inverse=True, return_counts=True)
    total = torch.zeros(len(count), z.shape[1], dtype=z.dtype).index_add_(0, member, z)
    square = torch.zeros(len(count), dtype=z.dtype).index_add_(0, member, z.square().sum(1))
    several = count > 1
    if not bool(several.any()):
        return 0.0
    products = (total.square().sum(1) - square)[several] / count[several]
    squares = (square * (count - 1) / count)[several]
    return float((products.sum() / squares.sum().clamp_min(1e-12)).clamp(0.0, 0.99))


def _fit(loss, start: list[float]) -> list[float]:
    """Minimise a smooth loss of few parameters with gradients from autograd."""

    def value_and_gradient(x):
        parameters = torch.tensor(x, dtype=torch.float64, requires_grad=True)
        value = loss(parameters)
        (gradient,) = torch.autograd.grad(value, parameters)
        return float(value.detach()), gradient.numpy()

    return [float(v) for v in minimize(value_and_gradient, start, jac=True, method="L-BFGS-B").x]


@torch.no_grad()
def _collect(model: Nolbo, batches: Iterable[SceneBatch]) -> dict[str, Tensor]:
    found: dict[str, list[Tensor]] = {}

    def add(name: str, value: Tensor) -> None:
        value = value.cpu()  # the factors are fitted in double precision, which not every device has
        found.setdefault(name, []).append(value.double() if value.is_floating_point() else value)

    device = next(model.parameters()).device
    for batch in batches:
        batch = placed(batch, device)
        scene = model.guide.observe(batch)
        where, q = scene.assignment, scene.posterior.at_map_category(model.story.prior.label_mean())
        known = torch.ones_like(where.is_object) if where.counted is None else where.counted
        add("logit", scene.encoding.objectness_logit[known])
        add("is_object", where.is_object[known])
        mask = where.assigned & (batch.visibility >= 0.5)
        labelled = mask & (batch.category >= 0)
        add("label_logits", q.label_logits[labelled])
        add("category", batch.category[labelled])
        oriented = mask & batch.has_viewpoint
        add("azimuth_logits", q.azimuth_logits[oriented])
        add("azimuth_natural", q.azimuth_natural[oriented])
        add("azimuth", batch.viewpoint[oriented][:, 0])
        add("order", batch.symmetry[oriented])
        angle = wrap_angle(q.angle_loc - batch.viewpoint[..., 1:])[oriented] / q.angle_scale[oriented]
        add("angle", angle.square().sum(-1))
        box = (q.box_loc - where.box_target)[mask] / q.box_scale[mask]
        add("box", box.square().sum(-1))
        for name, value in _positions(model, scene.encoding.columns, batch, q, where, mask & where.has_range).items():
            add(name, value)
        if batch.shape_loc is not None:
            shaped = mask & batch.has_voxels
            error = (q.shape_loc - batch.shape_loc)[shaped] / q.shape_scale[shaped]
            add("shape", error.square().sum(-1))
            if batch.shape_index is not None:
                add("shape_error", error)
                add("shape_index", batch.shape_index[shaped])
                add("shape_latent", q.shape_loc[shaped] / q.shape_scale[shaped])
    joined = {name: torch.cat(values) for name, values in found.items()}
    if model.config.description.decoded and "shape_index" in joined:  # nothing but a shape's own views says where it lies
        joined["shape_error"] = about_mean(joined["shape_latent"], joined["shape_index"])
        joined["shape"] = joined["shape_error"].square().sum(-1)
        joined["shape_index"] = torch.full((len(joined["shape"]),), -1)
    return joined


def about_mean(value: Float[Tensor, "n d"], group: Int[Tensor, " n"]) -> Float[Tensor, "m d"]:
    """Deviations of members of groups from their mean, times sqrt(n / (n - 1)); groups of one, and -1, are left out."""
    kept = group >= 0
    value, (_, member, count) = value[kept], torch.unique(group[kept], return_inverse=True, return_counts=True)
    mean = torch.zeros(len(count), value.shape[1], dtype=value.dtype).index_add_(0, member, value) / count[:, None]
    several = count[member] > 1
    n = count[member][several, None].to(value.dtype)
    return (value - mean[member])[several] * (n / (n - 1)).sqrt()


def _positions(
    model: Nolbo, columns: int, batch: SceneBatch, q: RegionParameters, where: Assignment, mask: Tensor
) -> dict[str, Tensor]:
    """Errors of the positions, and their covariances by the range latent alone and by the box alone, as answers have them."""
    config, cell = model.config, where.cell[mask]
    at = q.map(lambda value: value[mask])
    camera = batch.intrinsics[:, None].expand(-1, mask.shape[1], -1)[mask]
    box = decode_box(at.box_loc, cell, columns, config)
    box_scale = box_sigmas(at, config)
    position, _ = decode_range(at.range_loc, box, camera, config)
    still = dataclasses.replace(at, range_scale=torch.zeros_like(at.range_scale))
    return {
        "position": batch.position[mask].double() - position.double(),
        "by_range": position_covariance(at, box, torch.zeros_like(box_scale), position, camera, config),
        "by_box": position_covariance(still, box, box_scale, position, camera, config),
    }


def _shape_correlation(found: dict[str, Tensor]) -> float:
    """Of the objects whose shape the table knows."""
    if "shape_index" not in found:
        return 0.0
    index = found["shape_index"]
    return view_correlation(found["shape_error"][index >= 0], index[index >= 0]) if len(index) else 0.0


def calibrate(model: Nolbo, batches: Iterable[SceneBatch]) -> Calibration:
    """Fit every factor on labelled held-out scenes the network was not trained on.

    Objectness, label and azimuth by maximum likelihood (they are proper scores of discrete or multimodal answers),
    Gaussian heads by their 90 % regions: the range's by that of the position, which is what answers state.

    Raises:
        TooFewObjects: the scenes hold fewer than `MIN_OBJECTS` objects.
    """
    model.eval()
    found = _collect(model, batches)
    count = len(found.get("box", ()))
    if count < MIN_OBJECTS:
        raise TooFewObjects(f"too few objects to calibrate on: got {count}, expected at least {MIN_OBJECTS}")

    def objectness(x: Tensor) -> Tensor:
        odds = x[0].exp() * found["logit"] + x[1]
        return torch.nn.functional.binary_cross_entropy_with_logits(odds, found["is_object"].double())

    def label(x: Tensor) -> Tensor:
        return torch.nn.functional.cross_entropy(x[0].exp() * found["label_logits"], found["category"])

    def azimuth(x: Tensor) -> Tensor:
        natural = x[0].exp() * found["azimuth_natural"]
        q = VonMisesMixture(found["azimuth_logits"], natural, max_concentration=model.config.max_concentration)
        return -q.log_prob_symmetric(found["azimuth"], found["order"]).mean()

    slope, shift = _fit(objectness, [0.0, 0.0])
    label_slope = _fit(label, [0.0])[0] if len(found["category"]) else 0.0
    concentration = _fit(azimuth, [0.0])[0] if len(found["azimuth"]) else 0.0
    factor = [math.exp(value) for value in (slope, label_slope, concentration)]
    box_scale = region_factor(found["box"], 4)
    range_scale = 1.0
    if len(found["position"]):
        range_scale = position_factor(found["position"], found["by_range"], box_scale**2 * found["by_box"])
    tails = StudentT(GAUSSIAN_DOF, 1.0)
    if len(found["position"]) >= MIN_OBJECTS:
        covariance = range_scale**2 * found["by_range"] + box_scale**2 * found["by_box"]
        error = found["position"]
        squared = (error * torch.linalg.solve(covariance, error[..., None])[..., 0]).sum(-1)
        tails = fit_student_t(squared.numpy(), 3)
    stated = torch.sigmoid(factor[0] * found["logit"] + shift)
    return Calibration(
        objectness_slope=factor[0],
        objectness_shift=shift,
        label_slope=factor[1],
        azimuth_concentration=factor[2],
        angle_scale=region_factor(found["angle"], 2) if len(found["angle"]) else 1.0,
        shape_scale=region_factor(found["shape"], model.config.latent_dim) if len(found.get("shape", ())) else 1.0,
        box_scale=box_scale,
        range_scale=range_scale,
        shape_correlation=_shape_correlation(found),
        position_dof=tails.dof,
        position_spread=tails.spread,
        objectness_limit=min(supported_probability(stated.numpy(), found["is_object"].numpy()), CERTAIN),
    )
