"""Weights of the terms by method, and the losses of methods that have a discriminator or a phase of joint learning."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits

from nolbo_ppl.errors import input_error
from nolbo_ppl.inference.elbo import SHAPE_STAGE, ElboResult
from nolbo_ppl.models.baselines.adversary import adversarial_terms
from nolbo_ppl.models.baselines.method import METHODS, MethodName
from nolbo_ppl.models.normalisation import world_size
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.scene_batch import SceneBatch, unpack_bits
from nolbo_ppl.models.shape_vae import ShapeBatch

ADVERSARIAL_TERMS = ("discriminator", "generator")
"""Terms of the 3D-VAE-GAN that are no part of a bound (`nolbo_ppl.models.baselines.adversary`)."""

DETECTION: dict[str, float] = {"objectness_inclusive": 0.8, "box_inclusive": 0.3, "range_inclusive": 0.3}
"""What every method of whole scenes learns of detection: the weights of the inclusive objective."""

GENERATOR = 50.0
"""Weight of the generator's term in the stage of shapes: log D is one nat a shape, beside thousands of the voxels."""

DECODED = 0.002
"""Factor on the bound of shapes in the stages on images: at full weight voxels drown detection (docs/training.md)."""


def shape_weights(method: MethodName) -> dict[str, float]:
    """Weights of the stage of shapes: the label-conditioned bound, the bound under N(0, I), or voxels alone."""
    description = METHODS[method]
    if description.label_prior:
        return dict(SHAPE_STAGE)
    weights = {"voxels": 1.0} if description.point else {"voxels": 1.0, "shape_kl": 1.0}
    return {**weights, "generator": GENERATOR, "discriminator": 1.0} if description.adversary else weights


def image_weights(method: MethodName, objective: Mapping[str, float]) -> dict[str, float]:
    """Weights of the stages on images.

    Args:
        method: the method.
        objective: weights of NOLBO's own objective.
    """
    description = METHODS[method]
    if description.one_object:  # another detector says where objects are
        return {name: weight for name, weight in objective.items() if not name.startswith("objectness")}
    if description.describes:
        return dict(objective)
    if not description.decoded:  # to a point of scale one the KL is half the squared distance: the TL-network's loss
        return {**DETECTION, "shape_inclusive": 0.75}
    return {**DETECTION, **{name: DECODED * weight for name, weight in shape_weights(method).items()}}


class AdversarialLoss(nn.Module):
    """Another loss with the terms of a discriminator beside its own.

    Args:
        loss: loss of shapes or of scenes.
        model: the networks, with a discriminator.
        weights: weight of each of `ADVERSARIAL_TERMS`.

    Raises:
        InputError: the networks have no discriminator.
    """

    def __init__(self, loss: nn.Module, model: Nolbo, weights: Mapping[str, float]) -> None:
        super().__init__()
        if model.discriminator is None:
            raise input_error("adversarial terms", got=f"method {model.config.method}", expected="a method with a discriminator")
        self.loss, self.discriminator, self.decoder = loss, model.discriminator, model.story.decoder
        self.weights, self.config = dict(weights), model.config

    def forward(self, batch: SceneBatch | ShapeBatch, **options: int | None) -> ElboResult:
        """The other loss, less the weighted terms a scene (a shape, in the stage of shapes)."""
        result = self.loss(batch, **options)
        packed, noise, share, scenes = _true_shapes(batch, options.get("decode"))
        if len(packed) < 2:  # batch normalisation needs two
            return result
        dtype = self.decoder.dense.weight.dtype
        voxels = unpack_bits(packed, self.config.voxel_size).to(dtype)
        terms = adversarial_terms(self.discriminator, self.decoder, voxels, noise.to(dtype))
        terms = {name: share * value for name, value in terms.items()}
        added = torch.stack([self.weights.get(name, 0.0) * value for name, value in terms.items()]).sum()
        return ElboResult({**result.terms, **terms}, result.loss - added / scenes)


class JointLoss(nn.Module):
    """The TL-network's third phase: both of its networks learn together (Girdhar et al. 2016, section 3.3).

    The latent of an image and that of its shape, as the 3D encoder gives it now, are drawn to each other, and the shape's is
    decoded to the shape itself.

    Args:
        loss: loss of scenes, whose truth of the shape latent is the 3D encoder's.
        model: the networks.
        weight: weight of the voxels.
    """

    def __init__(self, loss: nn.Module, model: Nolbo, weight: float) -> None:
        super().__init__()
        self.loss, self.shape_guide, self.decoder = loss, model.shape_guide, model.story.decoder
        self.weight, self.size = weight, model.config.voxel_size

    def forward(self, batch: SceneBatch, decode: int | None = None) -> ElboResult:
        """The loss of scenes less the weighted voxels a scene; `voxels` stands for all known shapes, of which `decode` are
        decoded."""
        known = (batch.present & batch.has_voxels).flatten().nonzero().squeeze(-1)
        if not len(known) and world_size() == 1:
            return self.loss(batch, decode=0)
        packed = batch.voxels.flatten(0, 1)[known]
        loc, scale = self.shape_guide.posterior(packed)
        result = self.loss(batch.replace(**_targets(batch, known, loc, scale)), decode=0)
        order = torch.arange(len(known), device=known.device)
        if batch.decode_order is not None:
            order = batch.decode_order.flatten()[known].argsort(stable=True)
        chosen = order if decode is None else order[:decode]
        truth = unpack_bits(packed[chosen], self.size).to(loc.dtype)
        share = len(known) / max(len(chosen), 1)
        voxels = -share * binary_cross_entropy_with_logits(self.decoder(loc[chosen]), truth, reduction="sum")
        return ElboResult({**result.terms, "voxels": voxels}, result.loss - self.weight * voxels / len(batch.image))


def _targets(batch: SceneBatch, known: Tensor, loc: Tensor, scale: Tensor) -> dict[str, Tensor]:
    """Latents of the batch's shapes with those of some objects in place of the batch's own."""
    found = {}
    for name, value in (("shape_loc", loc), ("shape_scale", scale)):
        own = getattr(batch, name)
        own = loc.new_ones(*batch.present.shape, loc.shape[-1]) if own is None else own
        found[name] = own.flatten(0, 1).index_put((known,), value.to(own.dtype)).view_as(own)
    return found


def _true_shapes(batch: SceneBatch | ShapeBatch, decode: int | None) -> tuple[Tensor, Tensor, float, int]:
    """Packed shapes, as many samples of the prior, how many each stands for, and the number of scenes.

    The samples are the noise of the batch's own latents, handed on by one object, which makes them independent of the latents.
    """
    if isinstance(batch, ShapeBatch):
        return batch.voxels, _handed_on(batch.noise), 1.0, len(batch.voxels)
    known = (batch.present & batch.has_voxels).flatten().nonzero().squeeze(-1)
    total = len(known)
    if decode is not None and total > decode:
        order = batch.decode_order
        rank = torch.rand(total, device=known.device) if order is None else order.flatten()[known]
        known = known[rank.argsort(stable=True)[:decode]]
    packed = batch.voxels.flatten(0, 1)[known]
    noise = None if batch.noise is None else batch.noise.flatten(0, 1)[known]
    return packed, _handed_on(noise), total / max(len(known), 1), len(batch.image)


def _handed_on(noise: Tensor | None) -> Tensor:
    if noise is None:
        raise input_error("a batch for a discriminator", got="no noise", expected="the noise of its latents")
    return noise.roll(1, 0)
