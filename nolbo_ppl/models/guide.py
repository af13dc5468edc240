"""The amortised guide q(o, l, z | I): the whole scene goes in once, every region's posterior comes out (NOLBO fig. 2c)."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from jaxtyping import Bool, Float, Int
from pyro import poutine
from torch import Tensor, nn

from nolbo_ppl.devices import mixed_precision
from nolbo_ppl.geometry.boxes import box_iou
from nolbo_ppl.models.backbones import check_image, make_encoder, normalise_image
from nolbo_ppl.models.crops import image_levels
from nolbo_ppl.models.distributions import (
    NoisyNormal,
    ViewpointMixture,
    ViewpointNormal,
    ViewpointSinCos,
    kl_to_each_component,
)
from nolbo_ppl.models.distributions.bernoulli import Objectness
from nolbo_ppl.models.head import RegionHead
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.observed_scene import Detail, Encoding, ObservedScene, RegionParameters
from nolbo_ppl.models.prior import LabelPrior
from nolbo_ppl.models.pyro_parameters import declare_parameters
from nolbo_ppl.models.scene_batch import Assignment, SceneBatch, cell_centre, cell_of, decode_box, encode_box, encode_range
from nolbo_ppl.models.shape_look import ShapeLook


def orientation_posterior(parameters: RegionParameters, config: ModelConfig) -> dist.TorchDistribution:
    """q(z^v | I) in the configured form: a mixture over azimuths, one mode, or the paper's factorised (sin, cos)."""
    if config.orientation == "mixture":
        return ViewpointMixture(
            parameters.azimuth_logits,
            parameters.azimuth_natural,
            parameters.angle_loc,
            parameters.angle_scale,
            max_concentration=config.max_concentration,
        )
    natural = parameters.azimuth_natural[..., 0, :]
    concentration = torch.linalg.vector_norm(natural, dim=-1).clamp(1e-3, config.max_concentration)
    loc = torch.cat((torch.atan2(natural[..., 1], natural[..., 0])[..., None], parameters.angle_loc), -1)
    scale = torch.cat((torch.rsqrt(concentration)[..., None], parameters.angle_scale), -1)
    return ViewpointNormal(loc, scale) if config.orientation == "angle" else ViewpointSinCos(loc, scale)


class Guide(nn.Module):
    """Encoder and head, and the Pyro guide they amortise.

    A region is responsible for one object: where a cell holds more objects than predictors, those of the worst overlap
    find none. Their regions count as background and their other terms are masked (`ObservedScene.left_out`; validation
    reports their share).

    Example:
        >>> import nolbo_ppl, torch
        >>> from nolbo_ppl.models.model_config import nano
        >>> config = nano()
        >>> guide = nolbo_ppl.Guide(config, nolbo_ppl.GenerativeModel(config).prior)
        >>> encoding = guide.encode(torch.zeros(1, 3, 64, 96, dtype=torch.uint8))
        >>> encoding.objectness_logit.shape == (1, (64 // config.stride) * (96 // config.stride) * config.predictors)  # regions
        True
    """

    def __init__(self, config: ModelConfig, prior: LabelPrior) -> None:
        super().__init__()
        self.config = config
        self.encoder = make_encoder(config)
        self.head = RegionHead(self.encoder.channels, config, self.encoder.fine_channels, self.encoder.fine_strides)
        self.shape_look = ShapeLook(sum(self.head.sizes), config) if config.shape_look else None
        self._shared = (prior,)  # the generative model's own: a tuple, so that it is no module of the guide's state
        self.half_precision = False
        """Run encoder and head in bfloat16, everything after them in the weights' own precision."""

    def _prior(self) -> LabelPrior:
        return self._shared[0]

    def encode(self, image: Tensor, detail: Detail | None = None) -> Encoding:
        """Run the encoder on whole images, uint8 or float in 0..255, sides multiples of 32.

        Args:
            image: the images.
            detail: the same larger, for looks at objects cut out of them; not needed by guides that take none.

        Raises:
            InputError: the image batch has the wrong shape or sides.
        """
        check_image(image)
        dtype = self.head.objectness.weight.dtype
        x = normalise_image(image, dtype)
        if dtype == torch.float32:  # faster convolutions on CPUs, and on GPUs in half precision
            x = x.contiguous(memory_format=torch.channels_last)
        with self._autocast():
            maps, fine = self.encoder(x)
            features = maps.flatten(2).transpose(1, 2)
            logit = self.head.objectness(features).flatten(1)
        levels, factor = () if self.shape_look is None else image_levels(x), None
        if self.shape_look is not None and detail is not None:
            levels, factor = image_levels(normalise_image(detail.image, dtype)), detail.factor
        return Encoding(features, logit.to(dtype), maps.shape[2], maps.shape[3], fine, levels=levels, detail=factor)

    def parameters_at(
        self,
        encoding: Encoding,
        row: Int[Tensor, " n"],
        region: Int[Tensor, " n"],
        look: bool = True,
        box: Float[Tensor, "n 4"] | None = None,
    ) -> RegionParameters:
        """Posterior parameters of given regions.

        Args:
            encoding: the encoded images.
            row: the image of each region.
            region: its number, cell * predictors + predictor.
            look: refine the parameters by each region's box (`roi_refinement`). Boxes are the same without it, and soon found.
            box: boxes to look at instead of the regions' own, px.
        """
        cell, predictor = region // self.config.predictors, region % self.config.predictors
        with self._autocast():
            raw = self.head(encoding.features[row, cell])[torch.arange(len(row), device=row.device), predictor]
            raw = raw.to(self.head.objectness.weight.dtype)
            if look:
                raw = self.head.refine(raw, encoding.fine, row, cell, encoding.columns, box)
        if look and self.shape_look is not None:
            own = decode_box(self.head.box_latent(raw), cell, encoding.columns, self.config) if box is None else box
            raw = self.look_at_shapes(raw, encoding, row, own)
        return self.head.parameters_of(raw, self._prior().label_mean())

    def look_at_shapes(
        self, raw: Float[Tensor, "n outputs"], encoding: Encoding, row: Int[Tensor, " n"], box: Float[Tensor, "n 4"]
    ) -> Float[Tensor, "n outputs"]:
        """Raw outputs with what the look at shapes adds to the shape latent; as they are in guides without one.

        Args:
            raw: outputs so far.
            encoding: the encoded images.
            row: the image of each object.
            box: where it is cut out, px.
        """
        if self.shape_look is None or len(row) == 0:
            return raw
        with self._autocast():
            change = self.shape_look(encoding.levels, row, box, raw, encoding.detail).to(raw.dtype)
        before = self.head.sizes[0]
        return raw + nn.functional.pad(change, (before, raw.shape[-1] - before - change.shape[-1]))

    def _raw(self, encoding: Encoding, cell: Int[Tensor, "b m"]) -> Float[Tensor, "b m predictors outputs"]:
        index = cell[..., None].expand(-1, -1, encoding.features.shape[-1])
        with self._autocast():
            raw = self.head(torch.gather(encoding.features, 1, index))
        return raw.to(self.head.objectness.weight.dtype)

    def _autocast(self) -> AbstractContextManager[Any]:
        return mixed_precision(self.head.objectness.weight.device, self.half_precision)

    def observe(self, batch: SceneBatch) -> ObservedScene:
        """Encode a batch and find the responsible region of each object."""
        encoding = self.encode(batch.image)
        batch = self._prior().complete(batch.neutral())
        stride, columns = self.config.stride, encoding.columns
        cell = cell_of(batch.box, encoding.rows, columns, stride)
        raw = self._raw(encoding, cell)
        with torch.no_grad():
            boxes = decode_box(self.head.box_latent(raw), cell[..., None].expand(raw.shape[:3]), columns, self.config)
            iou = box_iou(boxes, batch.box[:, :, None])
            predictor, assigned = assign_predictors(cell, iou, batch.present)
            region = cell * self.config.predictors + predictor
            regions = encoding.objectness_logit.shape[1]
            is_object = torch.zeros(
                len(cell), regions + 1, dtype=torch.bool, device=cell.device
            )  # the last column takes the rest
            is_object.scatter_(1, torch.where(assigned, region, regions), True)
            has_range = batch.has_position & batch.has_size
            assignment = Assignment(
                cell=cell,
                predictor=predictor,
                assigned=assigned,
                is_object=is_object[:, :regions],
                box_target=encode_box(batch.box, cell, columns, self.config),
                range_target=encode_range(
                    batch.position,
                    batch.diagonal,
                    batch.box,
                    batch.intrinsics[:, None].expand(-1, batch.box.shape[1], -1),
                    self.config,
                ),
                has_range=has_range,
                counted=known_cells(batch, encoding.rows, columns, self.config, is_object[:, :regions]),
            )
        posterior = self._posterior(_select(raw, predictor), encoding, cell, assigned)
        return ObservedScene(batch, encoding, assignment, posterior)

    def _posterior(
        self, raw: Float[Tensor, "b m outputs"], encoding: Encoding, cell: Int[Tensor, "b m"], assigned: Tensor
    ) -> RegionParameters:
        """Posterior parameters of every slot; assigned objects alone are refined by their boxes."""
        row, slot = assigned.nonzero(as_tuple=True)
        with self._autocast():
            refined = self.head.refine(raw[row, slot], encoding.fine, row, cell[row, slot], encoding.columns)
        refined = refined.to(raw.dtype)
        if self.shape_look is not None:
            box = decode_box(self.head.box_latent(refined).detach(), cell[row, slot], encoding.columns, self.config)
            refined = self.look_at_shapes(refined, encoding, row, box)
        return self.head.parameters_of(raw.index_put((row, slot), refined), self._prior().label_mean())

    def responsible_region(self, encoding: Encoding, row: Int[Tensor, " n"], box: Float[Tensor, "n 4"]) -> Int[Tensor, " n"]:
        """Region responsible for each given box: in its cell the predictor whose own box overlaps it most (NOLBO,
        implementation)."""
        p, columns = self.config.predictors, encoding.columns
        cell = cell_of(box, encoding.rows, columns, self.config.stride)
        region = (cell[:, None] * p + torch.arange(p, device=cell.device)).flatten()
        q = self.parameters_at(encoding, row.repeat_interleave(p), region, look=False)
        own = decode_box(q.box_loc, region // p, columns, self.config).unflatten(0, (-1, p))
        return cell * p + box_iou(own, box[:, None]).argmax(-1)

    def forward(self, scene: ObservedScene, decode: int | None = None) -> None:
        """The Pyro guide: the latent sites of `GenerativeModel`, amortised.

        Args:
            scene: the batch as `observe` encoded it, anew for each step of an optimiser.
            decode: an argument of the generative model; the guide decodes nothing.
        """
        declare_parameters("guide", self)
        batch, q, assigned = scene.batch, scene.posterior, scene.assignment.assigned
        scenes = pyro.plate("scenes", assigned.shape[0], dim=-2)
        regions = pyro.plate("regions", scene.encoding.objectness_logit.shape[1], dim=-1)
        counted = True if scene.assignment.counted is None else scene.assignment.counted
        with scenes, regions, poutine.mask(mask=counted):
            pyro.sample("objectness", Objectness(logits=scene.encoding.objectness_logit))
        with scenes, pyro.plate("objects", assigned.shape[1], dim=-1), poutine.mask(mask=assigned):
            label = self._label(batch, q)
            latent = self._prior().category_dim
            noise = torch.zeros_like(q.shape_loc) if self.config.description.point else batch.noise
            pyro.sample(
                "shape_latent",
                NoisyNormal(
                    q.shape_loc[..., :latent], q.shape_scale[..., :latent], None if noise is None else noise[..., :latent]
                ).to_event(1),
            )
            if self._prior().instance is not None:
                self._instance(batch, q, label)
                pyro.sample(
                    "instance_latent",
                    NoisyNormal(
                        q.shape_loc[..., latent:],
                        q.shape_scale[..., latent:],
                        None if noise is None else noise[..., latent:],
                    ).to_event(1),
                )
            with poutine.mask(mask=batch.has_viewpoint):
                pyro.sample("orientation_latent", orientation_posterior(q, self.config))
            pyro.sample("box_latent", dist.Normal(q.box_loc, q.box_scale).to_event(1))
            with poutine.mask(mask=scene.assignment.has_range):
                pyro.sample("range_latent", dist.Normal(q.range_loc, q.range_scale).to_event(1))

    def _label(self, batch: SceneBatch, q: RegionParameters) -> Tensor:
        """q(l | I): observed where the label is known; where it is missing the head's probabilities, enumerated."""
        posterior = dist.Categorical(logits=q.label_logits)
        missing = batch.category < 0
        category = batch.category.clamp_min(0)
        with poutine.mask(mask=missing):  # a known label has no q of its own in the bound
            if not bool((missing & batch.present).any()):
                return pyro.sample("label", posterior, obs=category, infer={"is_auxiliary": True})
            logits = torch.where(missing[..., None], posterior.logits, _certain(category, posterior.logits))
            infer = {"enumerate": "parallel", "posterior": posterior}
            return pyro.sample("label", dist.Categorical(logits=logits), infer=infer)

    def _instance(self, batch: SceneBatch, q: RegionParameters, label: Tensor) -> None:
        """q(i | l, I) where an instance is missing: the bound's exact maximiser, proportional to p(i | l) exp(-KL_i)."""
        prior = self._prior()
        missing = batch.instance < 0
        if not bool((missing & batch.present).any()):
            return
        latent = prior.category_dim
        kl = kl_to_each_component(q.shape_loc[..., latent:], q.shape_scale[..., latent:], prior.instance_mean())
        posterior = torch.log_softmax(prior.instance_log_probability(label) - kl, -1)
        logits = torch.where(missing[..., None], posterior, _certain(batch.instance.clamp_min(0), posterior))
        with poutine.mask(mask=missing):
            pyro.sample("instance", dist.Categorical(logits=logits), infer={"enumerate": "parallel"})


def _certain(index: Int[Tensor, "b m"], like: Float[Tensor, "*l b m n"]) -> Float[Tensor, "b m n"]:
    """Log probabilities of what is known: zero for it, -inf for all else (as probabilities they would be rounded up)."""
    one_hot = torch.nn.functional.one_hot(index, like.shape[-1]).bool()
    return torch.where(one_hot, 0.0, -torch.inf).to(like.dtype)


def _select(raw: Float[Tensor, "b m p o"], predictor: Int[Tensor, "b m"]) -> Float[Tensor, "b m o"]:
    index = predictor[..., None, None].expand(-1, -1, 1, raw.shape[-1])
    return torch.gather(raw, 2, index).squeeze(2)


def known_cells(
    batch: SceneBatch, rows: int, columns: int, config: ModelConfig, is_object: Bool[Tensor, "b k"]
) -> Bool[Tensor, "b k"] | None:
    """Regions of which it is known whether they describe an object; None where everything is labelled.

    Unknown are cells whose centre lies in a part of the image that is not labelled, and all cells of an image of which some
    category is not labelled exhaustively, unless they are responsible for an object.
    """
    if batch.ignore is None and batch.exhaustive is None:
        return None
    known = torch.ones_like(is_object)
    if batch.ignore is not None:
        centre = cell_centre(torch.arange(rows * columns, device=is_object.device), columns, config.stride, batch.ignore.dtype)
        box = batch.ignore[:, None]
        inside = (centre[:, None] > box[..., :2]).all(-1) & (centre[:, None] < box[..., 2:]).all(-1)
        known &= ~inside.any(-1).repeat_interleave(config.predictors, 1)
    if batch.exhaustive is not None:
        known &= batch.exhaustive.all(1)[:, None]
    return known | is_object


def assign_predictors(
    cell: Int[Tensor, "b m"], iou: Float[Tensor, "b m p"], present: Tensor
) -> tuple[Int[Tensor, "b m"], Tensor]:
    """Responsible predictor of each object: in its cell, the free one with the highest IoU (NOLBO, implementation).

    Objects choose in the order of their best IoU, so that two objects of one cell get different predictors; an object
    that finds none free is left out (second result false).
    """
    b, m, p = iou.shape
    device = iou.device
    order = torch.where(present, iou.max(-1).values, -1.0).argsort(dim=1, descending=True, stable=True)
    taken = torch.zeros(b, m, p, dtype=torch.bool, device=device)  # predictors already taken in the cell of each object
    predictor = torch.zeros(b, m, dtype=torch.long, device=device)
    assigned = torch.zeros(b, m, dtype=torch.bool, device=device)
    rows, predictors = torch.arange(b, device=device), torch.arange(p, device=device)
    same_cell = cell[:, :, None] == cell[:, None, :]
    for rank in range(m):
        slot = order[:, rank]
        score = torch.where(taken[rows, slot], -1.0, iou[rows, slot])
        best = score.argmax(-1)
        free = present[rows, slot] & (score[rows, best] >= 0)
        predictor[rows, slot] = best
        assigned[rows, slot] = free
        taken |= (same_cell[rows, slot] & free[:, None])[..., None] & (predictors == best[:, None])[:, None]
    return predictor, assigned
