"""The generative model of a scene in Pyro (NOLBO fig. 2; docs/story.md).

Every region k of a scene has a label: an object's category (and instance), or background. The label throws the
objectness; an object's label throws the shape latent, which the decoder turns into voxels; its viewpoint throws the
orientation latent, from which the observed rotation comes; a box and a range latent throw the box and the range. Regions
without an object contribute their objectness only.

Each latent site carries, where the truth is known in training, its exact posterior given that truth
(`infer["target"]`): the target of the inclusive objective. Observed sites that have one carry the closed form of their
expected log likelihood (`infer["expected_log_prob"]`). What Pyro makes of models works on this one: `SVI` with the guide,
`Predictive` (in parallel too), `poutine.uncondition`, `pyro.render_model`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Bool, Float
from pyro import poutine
from pyro.distributions.torch_distribution import TorchDistributionMixin
from torch import Tensor, nn
from torch.distributions import kl_divergence

from nolbo_ppl._moved import renamed
from nolbo_ppl.geometry.rotation import viewpoint_to_matrix
from nolbo_ppl.models.distributions import (
    SinCosNormal,
    SymmetricMatrixFisher,
    ViewpointMixture,
    ViewpointNormal,
    ViewpointSinCos,
    WrappedNormal,
)
from nolbo_ppl.models.distributions.bernoulli import Objectness
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.normalisation import world_size
from nolbo_ppl.models.observed_scene import ObservedScene
from nolbo_ppl.models.prior import LabelPrior
from nolbo_ppl.models.pyro_parameters import declare_parameters
from nolbo_ppl.models.rotation_term import expected_rotation_log_prob
from nolbo_ppl.models.scene_batch import SceneBatch, unpack_bits
from nolbo_ppl.models.shape_networks import VoxelDecoder


def conjugate_target(observed: Float[Tensor, "*n d"], scale: float) -> TorchDistributionMixin:
    """p(z | y) of z ~ N(0, 1), y ~ N(z, scale^2): N(y / (1 + scale^2), scale^2 / (1 + scale^2)), per dimension."""
    shrink = 1 / (1 + scale**2)
    return dist.Normal(observed * shrink, torch.full_like(observed, scale * math.sqrt(shrink))).to_event(1)


def expected_normal_log_prob(
    loc: Float[Tensor, "*n d"], variance: Float[Tensor, "*n d"], observed: Float[Tensor, "*n d"], scale: float
) -> Float[Tensor, "*n"]:
    """E_q[log N(y; z, scale^2)] for q(z) of the given mean and variance, summed over dimensions."""
    deviation = ((observed - loc).square() + variance) / scale**2
    return -0.5 * (deviation + math.log(2 * math.pi * scale**2)).sum(-1)


def elevation_inplane_kl(truth: ViewpointNormal | ViewpointSinCos, q: dist.TorchDistribution) -> Float[Tensor, "*n"]:
    """KL(p || q) of elevation and in-plane rotation alone, nats: the angles are independent in both."""
    loc, scale = truth.loc[..., 1:], truth.scale[..., 1:]
    if isinstance(q, ViewpointMixture):
        return kl_divergence(WrappedNormal(loc, scale), q.elevation_inplane).sum(-1)
    kind = SinCosNormal if isinstance(q, ViewpointSinCos) else WrappedNormal
    return kl_divergence(kind(loc, scale), kind(q.loc[..., 1:], q.scale[..., 1:])).sum(-1)


class GenerativeModel(nn.Module):
    """The generative model, owner of the prior networks and of the decoder.

    A torch module whose forward makes Pyro statements, of its parameters too (`declare_parameters`): an optimiser of
    Pyro's finds them, and they never enter Pyro's global store.

    Example:
        >>> import nolbo_ppl, torch
        >>> from nolbo_ppl.models.model_config import nano
        >>> config = nano()
        >>> model = nolbo_ppl.GenerativeModel(config)
        >>> model.prior.label_mean().shape == (len(config.categories), config.latent_dim)  # mu_psi(l) of every category
        True
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.prior = LabelPrior(config)
        self.decoder = VoxelDecoder(config)

    def forward(self, scene: ObservedScene, decode: int | None = None) -> None:
        """The Pyro model of a batch.

        Args:
            scene: the batch with its responsible regions.
            decode: at most this many objects are decoded, those of the smallest `decode_order` (a random subset); their
                voxel term is scaled up to stand for all. None decodes all, 0 none.
        """
        declare_parameters("model", self)
        batch, where, config = scene.batch, scene.assignment, self.config
        scenes = pyro.plate("scenes", where.assigned.shape[0], dim=-2)
        with scenes, pyro.plate("regions", where.is_object.shape[1], dim=-1):
            eps = config.objectness_epsilon
            logit = math.log1p(-eps) - math.log(eps)
            prior = Objectness(logits=torch.where(where.is_object, logit, -logit).to(batch.box))
            with poutine.mask(mask=True if where.counted is None else where.counted):
                pyro.sample("objectness", prior, infer={"target": prior})
        with scenes, pyro.plate("objects", where.assigned.shape[1], dim=-1), poutine.mask(mask=where.assigned):
            latent = shape_site(self.prior, batch, where.assigned)
            self._orientation(batch)
            self._box_and_range(scene)
        self._voxels(batch, where.assigned, latent, decode)

    def _orientation(self, batch: SceneBatch) -> None:
        config = self.config
        with poutine.mask(mask=batch.has_viewpoint):
            scale = torch.full_like(batch.viewpoint, config.orientation_scale)
            if config.orientation == "sincos":
                prior: dist.TorchDistribution = ViewpointSinCos(batch.viewpoint, scale)
            else:
                prior = ViewpointNormal(batch.viewpoint, scale, order=batch.symmetry)
            parts = {
                "azimuth_inclusive": lambda q: kl_divergence(prior, q) - elevation_inplane_kl(prior, q),
                "tilt_inclusive": lambda q: elevation_inplane_kl(prior, q),
            }
            value = pyro.sample("orientation_latent", prior, infer={"target": prior, "target_parts": parts})
            angles = torch.atan2(value[..., 0], value[..., 1]) if config.orientation == "sincos" else value
            kappa = batch.viewpoint.new_tensor(config.rotation_concentration)
            R = viewpoint_to_matrix(batch.viewpoint)
            likelihood = SymmetricMatrixFisher(viewpoint_to_matrix(angles), kappa, batch.symmetry)

            def expected(q: Any) -> Tensor:
                return expected_rotation_log_prob(q, R, kappa, batch.symmetry)

            pyro.sample("rotation", likelihood, obs=R, infer={"expected_log_prob": ("orientation_latent", expected)})

    def _box_and_range(self, scene: ObservedScene) -> None:
        config, where = self.config, scene.assignment
        for name, observed, scale, mask in (
            ("box", where.box_target, config.box_scale, None),
            ("range", where.range_target, config.range_scale, where.has_range),
        ):
            with poutine.mask(mask=where.assigned if mask is None else mask):
                zero = torch.zeros_like(observed)
                truth = conjugate_target(observed, scale)
                z = pyro.sample(f"{name}_latent", dist.Normal(zero, zero + 1).to_event(1), infer={"target": truth})
                pyro.sample(
                    name,
                    dist.Normal(z, scale).to_event(1),
                    obs=observed,
                    infer={"expected_log_prob": (f"{name}_latent", _normal_expectation(observed, scale))},
                )

    def _voxels(self, batch: SceneBatch, assigned: Tensor, latent: Tensor, decode: int | None) -> None:
        known = assigned & batch.has_voxels
        index = known.flatten().nonzero().squeeze(-1)
        total = len(index)
        if decode is not None and total > decode:
            index = index[_subset(batch.decode_order, index, decode)]
        if decode == 0 or (len(index) == 0 and world_size() == 1):
            return  # with other processes an empty batch goes through, for their normalisation waits for every one
        latent = latent.expand(*latent.shape[:-3], *assigned.shape, -1).flatten(-3, -2)[..., index, :]
        logits = self.decoder(latent.flatten(0, -2))
        if latent.dim() > 2:  # an outer plate, as `Predictive` has in parallel; this site is outside of the plate of scenes
            logits = logits.unflatten(0, latent.shape[:-1]).unsqueeze(-5)
        observed = unpack_bits(batch.voxels.flatten(0, 1)[index], self.config.voxel_size).to(logits.dtype)
        voxel_site(logits, observed, total / len(index) if len(index) else 1.0)


def _subset(order: Tensor | None, index: Tensor, count: int) -> Tensor:
    """Positions of a random subset of so many objects, in their own order; by torch's generator when none is given."""
    rank = torch.rand(len(index), device=index.device) if order is None else order.flatten()[index]
    return rank.argsort(stable=True)[:count].sort().values


def _normal_expectation(observed: Tensor, scale: float) -> Callable[[dist.TorchDistribution], Tensor]:
    return lambda q: expected_normal_log_prob(q.mean, q.variance, observed, scale)


def shape_site(prior: LabelPrior, batch: SceneBatch, assigned: Bool[Tensor, "b m"]) -> Float[Tensor, "*n d"]:
    """Label, instance and shape latent of each object; returns the whole latent.

    The label's prior is uniform; where labels are known that is a constant which the bound leaves out (c_1 of NOLBO).
    """
    missing, category = batch.category < 0, batch.category.clamp_min(0)
    with poutine.mask(mask=missing):
        label = pyro.sample(
            "label",
            dist.Categorical(logits=batch.box.new_zeros(*missing.shape, prior.labels)),
            obs=None if bool((missing & batch.present).any()) else category,
            infer={"target": dist.Delta(category), "target_mask": assigned & ~missing},
        )
    mean = prior.category_mean()[label]
    latent = pyro.sample(
        "shape_latent",
        dist.Normal(mean, torch.ones_like(mean)).to_event(1),
        infer=_teacher(batch, assigned, slice(None, prior.category_dim)),
    )
    if prior.instance is None:
        return latent
    missing = batch.instance < 0
    with poutine.mask(mask=missing):
        instance = pyro.sample(
            "instance",
            dist.Categorical(logits=prior.instance_log_probability(label)),
            obs=None if bool((missing & batch.present).any()) else batch.instance.clamp_min(0),
        )
    mean = prior.instance_mean()[instance]
    own = pyro.sample(
        "instance_latent",
        dist.Normal(mean, torch.ones_like(mean)).to_event(1),
        infer=_teacher(batch, assigned, slice(prior.category_dim, None)),
    )
    return torch.cat((latent, own), -1)


def _teacher(batch: SceneBatch, assigned: Tensor, part: slice) -> dict[str, Any]:
    """The shape autoencoder's posterior of the true voxels as the truth of a shape latent, where voxels are known."""
    if batch.shape_loc is None or batch.shape_scale is None:
        return {}
    truth = dist.Normal(batch.shape_loc[..., part], batch.shape_scale[..., part]).to_event(1)
    return {"target": truth, "target_mask": assigned & batch.has_voxels}


def voxel_site(logits: Float[Tensor, "*draws n v v v"], observed: Float[Tensor, "n v v v"], scale: float = 1.0) -> None:
    """Voxels of n decoded objects, independent Bernoulli; `scale` makes a subset stand for all."""
    count = logits.shape[-4]
    if count == 0:  # Pyro has no empty plates; the site keeps the decoder in the graph (see `GenerativeModel._voxels`)
        pyro.sample("voxels", dist.Bernoulli(logits=logits.flatten(), validate_args=False), obs=observed.flatten())
        return
    with pyro.plate("decoded", count, dim=-1), poutine.scale(scale=scale):
        pyro.sample("voxels", dist.Bernoulli(logits=logits, validate_args=False).to_event(3), obs=observed)


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
