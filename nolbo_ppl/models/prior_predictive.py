"""Whole objects from the generative model alone: shape, pose and box, of no image and no label but those that are asked for."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from pyro import poutine
from torch import Tensor

from nolbo_ppl.errors import input_error
from nolbo_ppl.models.generative import GenerativeModel
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.observed_scene import Encoding, ObservedScene, RegionParameters
from nolbo_ppl.models.scene_batch import Assignment, SceneBatch, decode_box, decode_range, grid_size


@dataclass
class PriorObjects:
    """Objects drawn from the generative model, n scenes of one object."""

    category: Int[Tensor, " n"]
    """Category label."""
    shape_latent: Float[Tensor, "n d"]
    """The whole shape latent."""
    voxel_probability: Float[Tensor, "n v v v"]
    """Decoded occupancy, canonical."""
    voxels: Float[Tensor, "n v v v"]
    """Occupancy drawn from it, 0 or 1."""
    R_camera_object: Float[Tensor, "n 3 3"]
    """Allocentric rotation."""
    box: Float[Tensor, "n 4"]
    """[x0, y0, x1, y1] in px, about the image's middle cell."""
    position: Float[Tensor, "n 3"]
    """Centre in the camera frame, m."""
    diagonal: Float[Tensor, " n"]
    """Diagonal of the object's box, m."""


def blank_scene(
    config: ModelConfig,
    viewpoint: Float[Tensor, "n 3"],
    category: Int[Tensor, " n"] | None = None,
    intrinsics: Float[Tensor, " 4"] | None = None,
) -> ObservedScene:
    """n scenes of one object each, in the middle cell, of which nothing but the viewpoint is stated.

    What the generative model conditions on is filled in with neutral values and observed nowhere: run it under
    `poutine.uncondition`, or by `Predictive`, whose answers hold its latent sites.

    Args:
        config: the model's.
        viewpoint: mean viewpoint of each object, rad: the model has no prior of it, `orientation_latent` lies about it.
        category: label of each object, which gives its symmetry; -1 or None where it is unknown (no symmetry).
        intrinsics: [fx, fy, cx, cy] in px of a camera; None for one of 90 degrees.
    """
    n, side, like, device = len(viewpoint), config.image_size, viewpoint, viewpoint.device
    rows, columns = grid_size(side, side, config)
    cell = torch.full((n, 1), (rows // 2) * columns + columns // 2, device=device)
    yes, zero = torch.ones(n, 1, dtype=torch.bool, device=device), like.new_zeros(n, 1)
    label = torch.full((n,), -1, device=device) if category is None else category
    symmetry = torch.where(label >= 0, torch.tensor(config.symmetry, device=device)[label.clamp_min(0)], 1)
    camera = like.new_tensor([side / 2, side / 2, side / 2, side / 2]) if intrinsics is None else intrinsics
    centre = like.new_tensor([(columns // 2 + 0.5) * config.stride, (rows // 2 + 0.5) * config.stride])
    half = config.stride
    batch = SceneBatch(
        image=torch.zeros(n, 3, side, side, dtype=torch.uint8, device=device),
        intrinsics=camera.expand(n, 4),
        present=yes,
        box=torch.cat((centre - half, centre + half)).expand(n, 1, 4),
        category=label[:, None],
        instance=torch.full((n, 1), -1, device=device),
        viewpoint=viewpoint[:, None],
        has_viewpoint=yes,
        symmetry=symmetry[:, None],
        position=like.new_tensor([0.0, 0.0, 1.0]).expand(n, 1, 3),
        has_position=yes,
        diagonal=zero + 1,
        has_size=yes,
        voxels=torch.zeros(n, 1, config.voxel_size**3 // 8, dtype=torch.uint8, device=device),
        has_voxels=yes,
        visibility=zero + 1,
    )
    regions = rows * columns * config.predictors
    is_object = torch.zeros(n, regions, dtype=torch.bool, device=device)
    is_object[:, int(cell[0, 0]) * config.predictors] = True
    assignment = Assignment(
        cell=cell,
        predictor=torch.zeros_like(cell),
        assigned=yes,
        is_object=is_object,
        box_target=like.new_zeros(n, 1, 4),
        range_target=like.new_zeros(n, 1, 4),
        has_range=yes,
    )
    encoding = Encoding(like.new_zeros(n, rows * columns, 0), like.new_zeros(n, regions), rows, columns)
    modes, d = config.azimuth_components, config.latent_dim

    def empty(*shape: int) -> Tensor:
        return like.new_zeros(n, 1, *shape)

    posterior = RegionParameters(  # of no image: the priors
        label_logits=empty(len(config.categories)),
        shape_loc=empty(d),
        shape_scale=empty(d) + 1,
        azimuth_logits=empty(modes),
        azimuth_natural=empty(modes, 2),
        angle_loc=empty(2),
        angle_scale=empty(2) + 1,
        box_loc=empty(4),
        box_scale=empty(4) + 1,
        range_loc=empty(4),
        range_scale=empty(4) + 1,
    )
    return ObservedScene(batch, encoding, assignment, posterior)


def prior_predictive(
    model: GenerativeModel,
    count: int,
    seed: int,
    category: Int[Tensor, " n"] | None = None,
    viewpoint: Float[Tensor, "n 3"] | None = None,
) -> PriorObjects:
    """Draw whole objects from the generative model, unconditioned.

    Args:
        model: the generative model; it draws in evaluation mode.
        count: number of objects.
        seed: of the draws; torch's global generator is left as it was.
        category: label of each object; None for uniform ones.
        viewpoint: mean viewpoint of each object, rad; None for azimuths uniform on the circle, seen from their own height.

    Raises:
        InputError: the count is not positive, or the labels or viewpoints are not as many.

    Example:
        >>> from nolbo_ppl.models.model_config import nano
        >>> objects = prior_predictive(GenerativeModel(nano()), count=3, seed=0)
        >>> objects.voxels.shape, objects.R_camera_object.shape, objects.box.shape
        (torch.Size([3, 32, 32, 32]), torch.Size([3, 3, 3]), torch.Size([3, 4]))
    """
    for name, given in (("category", category), ("viewpoint", viewpoint)):
        if given is not None and len(given) != count:
            raise input_error(f"{name} of each object", got=len(given), expected=f"{count} rows")
    if count < 1:
        raise input_error("number of objects to draw", got=count, expected="at least 1")
    config, like = model.config, next(model.parameters())
    device, dtype = like.device, like.dtype
    training = model.training
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []), torch.no_grad():
        torch.manual_seed(seed)
        if category is None:
            category = torch.randint(len(config.categories), (count,), device="cpu")
        if viewpoint is None:
            azimuth = (2 * torch.rand(count, dtype=dtype, device="cpu") - 1) * math.pi
            viewpoint = torch.nn.functional.pad(azimuth[:, None], (0, 2))
        category = category.to(device)
        scene = blank_scene(config, viewpoint.to(device, dtype), category)
        model.eval()
        drawn = poutine.condition(poutine.uncondition(model), {"label": category[:, None]})
        nodes = poutine.trace(drawn).get_trace(scene).nodes
        model.train(training)
    value = {name: nodes[name]["value"] for name in nodes if nodes[name]["type"] == "sample"}
    latent = [value[name][:, 0] for name in ("shape_latent", "instance_latent") if name in value]
    cell, columns = scene.assignment.cell[:, 0], scene.encoding.columns
    box = decode_box(value["box"][:, 0], cell, columns, config)
    position, diagonal = decode_range(value["range"][:, 0], box, scene.batch.intrinsics, config)
    return PriorObjects(
        category=category,
        shape_latent=torch.cat(latent, -1),
        voxel_probability=nodes["voxels"]["fn"].base_dist.probs,
        voxels=value["voxels"],
        R_camera_object=value["rotation"][:, 0],
        box=box,
        position=position,
        diagonal=diagonal,
    )
