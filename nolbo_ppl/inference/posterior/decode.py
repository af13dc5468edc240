"""From posterior parameters of regions to `ObjectPosteriors`: latent units become px, metres, radians and probabilities."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from nolbo_ppl.geometry.rotation import allocentric_to_egocentric, viewpoint_to_matrix
from nolbo_ppl.inference.posterior.decoded_shapes import DecodedShape
from nolbo_ppl.inference.posterior.metric_size import MetricKnowledge, with_metric_size
from nolbo_ppl.models.distributions import VonMisesMixture, kl_to_each_component
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.observed_scene import RegionParameters
from nolbo_ppl.models.prior import LabelPrior
from nolbo_ppl.models.scene_batch import decode_box, decode_range
from nolbo_ppl.structures.latent_modes import modes_by_category
from nolbo_ppl.structures.object_posteriors import ObjectPosteriors, ViewpointModes


@dataclass(frozen=True)
class SelectedRegions:
    """Regions of a batch of images to answer for."""

    q: RegionParameters
    """Their posterior, calibrated."""
    number: Int[Tensor, " n"]
    """Number of each in its image."""
    columns: int
    """Cells side by side in an image."""
    logit: Float[Tensor, " n"]
    """Log odds that each describes an object."""
    camera: Float[Tensor, "n 4"]
    """[fx, fy, cx, cy] of each one's image, px of the scaled image."""
    scale: Float[np.ndarray, "n 2"]
    """Width and height of that image over those of the given one."""
    metric: MetricKnowledge | None = None
    """What else tells their sizes and distances; None: the posterior alone."""


def assemble(
    regions: SelectedRegions,
    config: ModelConfig,
    prior: LabelPrior,
    prior_mean: Float[Tensor, "labels d"],
    shapes: Callable[[RegionParameters, Float[Tensor, " n"]], DecodedShape],
) -> ObjectPosteriors:
    """Everything the posterior of some regions says.

    Args:
        regions: which, and their posterior.
        config: configuration of the networks.
        prior: prior networks of the shape latent.
        prior_mean: mu_psi(l) of every category.
        shapes: voxels and extents from the posterior and the diagonals, m, of the objects' boxes.
    """
    q, camera, scale = regions.q, regions.camera, regions.scale
    box = decode_box(q.box_loc, regions.number // config.predictors, regions.columns, config)
    box_scale = box_sigmas(q, config)
    position, diagonal = decode_range(q.range_loc, box, camera, config)
    azimuth = VonMisesMixture(
        q.azimuth_logits, q.azimuth_natural, max_concentration=config.max_concentration, validate_args=False
    )
    # Sharp modes sit at a component's mean, a candidate of its own: a coarse grid finds the broad ones.
    viewpoint = torch.cat((azimuth.find_mode(grid=90)[:, None], q.angle_loc), -1)
    R = allocentric_to_egocentric(viewpoint_to_matrix(viewpoint), position)
    best = (azimuth.component_mean - viewpoint[:, :1]).cos().argmax(-1, keepdim=True)
    azimuth_variance = 1 / torch.gather(azimuth.concentration, -1, best)[:, 0].clamp_min(0.1)
    if regions.metric is not None:
        q = with_metric_size(q, box, position, diagonal, R, camera, regions.metric, config)
        position, diagonal = decode_range(q.range_loc, box, camera, config)
    rotation_variance = (azimuth_variance + q.angle_scale.square().sum(-1)) / 3
    voxel_mean, voxel_variance, size = shapes(q, diagonal)
    latent, class_log_posterior = q.shape_loc.numpy(), torch.log_softmax(q.label_logits.double(), -1).numpy()
    # Without categories, or with one prior for all of them, every category puts the latent at the same place.
    mixed = config.description.describes and config.description.label_prior and len(config.categories) > 1
    return ObjectPosteriors(
        categories=config.categories,
        objectness=torch.sigmoid(regions.logit.double()).numpy(),
        box=box.numpy() / np.tile(scale, 2),
        box_scale=np.concatenate((box_scale[:, :2].numpy() / scale, box_scale[:, 2:].numpy()), -1),
        class_log_posterior=class_log_posterior,
        class_log_likelihood=category_log_likelihood(q.shape_loc, prior, prior_mean).numpy(),
        instance_log_posterior=instance_log_posterior(q, prior),
        latent=latent,
        latent_scale=q.shape_scale.numpy(),
        position=position.double().numpy(),
        position_covariance=position_covariance(q, box, box_scale, position, camera, config).numpy(),
        viewpoint_modes=ViewpointModes(azimuth.weights.numpy(), azimuth.component_mean.numpy(), azimuth.concentration.numpy()),
        elevation_inplane=q.angle_loc.numpy(),
        elevation_inplane_scale=q.angle_scale.numpy(),
        viewpoint=viewpoint.numpy(),
        R_camera_object=R.double().numpy(),
        rotation_scale=rotation_variance.sqrt().numpy(),
        diagonal=diagonal.numpy(),
        diagonal_log_scale=(q.range_scale[:, 3] * config.range_spread[3]).numpy(),
        size=size,
        voxel_mean=voxel_mean,
        voxel_variance=voxel_variance,
        describes=config.description.describes,
        latent_modes=modes_by_category(latent, class_log_posterior, prior_mean.numpy()) if mixed else None,
    )


def box_sigmas(q: RegionParameters, config: ModelConfig) -> Float[Tensor, "n 4"]:
    """Scales of each box's centre, px of the scaled image, and of its log extents."""
    scale = q.box_scale * q.box_scale.new_tensor(config.box_spread)
    return torch.cat((scale[:, :2] * config.stride, scale[:, 2:]), -1)


def category_log_likelihood(
    latent: Float[Tensor, "n d"], prior: LabelPrior, prior_mean: Float[Tensor, "labels d"]
) -> Float[Tensor, "n labels"]:
    """log N(mu_q; mu_psi(l), I) of each category, over the dimensions that describe it, nats."""
    half = prior.category_dim
    squared = (latent[:, None, :half] - prior_mean[:, :half]).square().sum(-1)
    return -0.5 * (squared + half * math.log(2 * math.pi))


def instance_log_posterior(q: RegionParameters, prior: LabelPrior) -> Float[np.ndarray, "n instances"] | None:
    """Normalised log posterior of the known instances of each region's category ("novel" last); None without instance labels."""
    if prior.instance is None:
        return None
    half = prior.category_dim
    kl = kl_to_each_component(q.shape_loc[:, half:], q.shape_scale[:, half:], prior.instance_mean())
    return torch.log_softmax(prior.instance_log_probability(q.label_logits.argmax(-1)) - kl, -1).numpy()


def position_covariance(
    q: RegionParameters,
    box: Float[Tensor, "n 4"],
    box_scale: Float[Tensor, "n 4"],
    position: Float[Tensor, "n 3"],
    camera: Float[Tensor, "n 4"],
    config: ModelConfig,
) -> Float[Tensor, "n 3 3"]:
    """Covariance of the position, m^2, float64, to first order: along the ray from the range, across it from the centre's pixel.

    With slopes s = (x, y) / z and n^2 = 1 + |s|^2 the position is e^r f n^(1/2) (s, 1) (`decode_range`): a pixel turns
    the ray, and changes the range a little, for off the axis a radian covers more pixels.

    Args:
        q: posterior of the regions.
        box: mean box [x0, y0, x1, y1], px.
        box_scale: scales of its centre, px, and of its log extents.
        position: mean position in the camera frame, m.
        camera: [fx, fy, cx, cy], px.
        config: configuration of the networks.
    """
    box, box_scale, position, camera = (value.double() for value in (box, box_scale, position, camera))
    unit, loc = (position.new_tensor(v) for v in (config.range_spread, config.range_loc))
    spread, offset = q.range_scale * unit, q.range_loc * unit + loc
    extent = box[:, 2:] - box[:, :2]
    # the centre's pixel = the box's centre + offset * extent: three independent errors an axis
    relative = spread[:, 1:3].square() + (offset[:, 1:3] * box_scale[:, 2:]).square()
    pixel_variance = box_scale[:, :2].square() + extent.square() * relative
    along = position[:, :, None] * position[:, None, :] * spread[:, 0, None, None].square()
    depth = position[:, 2]
    across = torch.zeros_like(along)
    for axis in range(2):
        step = torch.zeros_like(position)
        step[:, axis] = depth / camera[:, axis]
        share = 0.5 * position[:, axis] * depth / position.square().sum(-1)  # s / (2 n^2)
        step = step + position * (share / camera[:, axis])[:, None]
        across = across + step[:, :, None] * step[:, None, :] * pixel_variance[:, axis, None, None]
    return along + across
