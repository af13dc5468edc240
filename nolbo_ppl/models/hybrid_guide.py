"""The guide of photographs: evidence of a detector and of the scene network, and RoI refinement of each object, cut out.

One amortised posterior with the sites of every guide. The image goes once through a frozen detector and, at half its size,
through a frozen network that knows generated scenes (`scene_network`); their predictions are evidence about the same regions
(`evidence`). Objects are then cut out at one size and sent through the guide's own encoder, head and RoI refinement
(`crops`): viewpoint, shape and range come from there, category from both. In evaluation mode the mirror image of each object
is looked at too: the azimuth's posterior is the mean of both.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nolbo_ppl.geometry.boxes import box_area, box_iou
from nolbo_ppl.models.backbones import check_image, normalise_image
from nolbo_ppl.models.category_sizes import CategorySizes
from nolbo_ppl.models.crops import SIDE, Crops, brightened, cut_out_detailed, image_levels, range_shift, with_mirrored
from nolbo_ppl.models.evidence import ROLE_SIDE, Evidence, Fused, Fusion, detector_evidence, gather_evidence
from nolbo_ppl.models.guide import Guide
from nolbo_ppl.models.image_shift import ImageShift
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.normalisation import SyncBatchNorm2d
from nolbo_ppl.models.observed_scene import Detail, Encoding, ObservedScene, RegionParameters
from nolbo_ppl.models.prior import LabelPrior
from nolbo_ppl.models.scene_batch import Assignment, SceneBatch, cell_of, decode_box, encode_box, encode_range
from nolbo_ppl.models.scene_network import SceneNetwork
from nolbo_ppl.models.yolox import WIDTH, YoloxNano

REDUCTION = 2
"""The scene network sees the image reduced by this factor."""
SAME_OBJECT = 0.5
"""A region whose box overlaps an object's this much describes it."""


@dataclass
class HybridEncoding(Encoding):
    """What detector and scene network made of a batch of images."""

    fused: Fused | None = None
    """The evidence about every region."""
    box: Float[Tensor, "b k 4"] | None = None
    """Box of every region, px."""


@dataclass
class GatheredEvidence:
    """What detector and scene network say of a batch of images, before it is weighed."""

    detector: Evidence
    scene: Evidence
    context: Float[Tensor, "b c"]
    """What describes each image as a whole: mean features of both networks."""
    rows: int
    columns: int
    levels: tuple[Float[Tensor, "b 3 _ _"], ...]
    """See `Encoding`."""


class HybridGuide(Guide):
    """Guide with a detector beside its encoder; see the module's docstring."""

    def __init__(self, config: ModelConfig, prior: LabelPrior) -> None:
        super().__init__(config, prior)
        self.detector = YoloxNano()
        self.scene = SceneNetwork(config)
        self.fusion = Fusion(self.encoder.channels + 2 * WIDTH, config)
        self.shift = ImageShift(self.encoder.channels + 2 * WIDTH)
        self.sizes = CategorySizes(len(config.categories))

    def train(self, mode: bool = True) -> HybridGuide:
        """Training mode; the statistics of batch normalisations stay as they were learnt.

        Batches mix photographs with generated scenes: joint statistics are those of neither.
        """
        super().train(mode)
        for module in self.modules():
            if isinstance(module, SyncBatchNorm2d):
                module.eval()
        return self

    def gather(self, image: Tensor) -> GatheredEvidence:
        """Run detector and scene network on whole images, uint8 or float in 0..255, sides multiples of 32.

        Raises:
            InputError: the image batch has the wrong shape or sides.
        """
        check_image(image)
        config, dtype = self.config, self.head.objectness.weight.dtype
        colours = image.to(dtype).contiguous(memory_format=torch.channels_last)
        rows, columns = image.shape[2] // config.stride, image.shape[3] // config.stride
        levels = image_levels(normalise_image(colours, dtype))
        with self._autocast(), torch.no_grad():
            predictions, scene = self.detector(colours), self.scene(levels[1])
        return GatheredEvidence(
            detector_evidence(predictions, rows, columns, config),
            gather_evidence(REDUCTION * scene.box, scene.log_odds, scene.labels, rows, columns, config),
            torch.cat((scene.features, predictions.features.mean(1)), -1),
            rows,
            columns,
            levels,
        )

    def encode(self, image: Tensor, detail: Detail | None = None) -> HybridEncoding:
        """Gather the evidence of whole images and weigh it; see `gather` and `Guide.encode`."""
        one = self.gather(image)
        cell = torch.arange(one.rows * one.columns, device=image.device).repeat_interleave(self.config.predictors)
        cell = cell.expand(len(image), -1)
        fused = self.fusion(one.detector, one.scene, one.context, cell, one.columns)
        box = decode_box(fused.box_loc, cell, one.columns, self.config)
        with torch.no_grad():
            shift, generated = self.shift(one.context), self.fusion.generated(one.context)
        logit = fused.objectness_logit
        levels, factor = one.levels, None
        if detail is not None:
            levels, factor = image_levels(normalise_image(detail.image, logit.dtype)), detail.factor
        nothing = logit.new_zeros(len(image), 0, 0)  # no features of cells: objects are looked at cut out
        whole = (nothing, logit, one.rows, one.columns, (), shift, generated)
        return HybridEncoding(*whole, levels, factor, fused=fused, box=box)

    def parameters_at(
        self,
        encoding: Encoding,
        row: Int[Tensor, " n"],
        region: Int[Tensor, " n"],
        look: bool = True,
        box: Float[Tensor, "n 4"] | None = None,
    ) -> RegionParameters:
        """Posterior parameters of given regions; see `Guide.parameters_at`."""
        assert isinstance(encoding, HybridEncoding)
        raw, mirror = self._look(encoding, row, region, look, box)
        return self._parameters_of(raw, mirror)

    def _parameters_of(self, raw: Float[Tensor, "*n outputs"], mirror: Float[Tensor, "*n outputs"] | None) -> RegionParameters:
        """Posterior parameters of raw outputs, and of those of the mirror images where they were looked at."""
        prior_mean = self._prior().label_mean()
        q = self.head.parameters_of(raw, prior_mean)
        return q if mirror is None else q.with_mirrored(self.head.parameters_of(mirror, prior_mean))

    def _look(
        self,
        encoding: HybridEncoding,
        row: Int[Tensor, " n"],
        region: Int[Tensor, " n"],
        look: bool = True,
        box: Float[Tensor, "n 4"] | None = None,
    ) -> tuple[Float[Tensor, "n outputs"], Float[Tensor, "n outputs"] | None]:
        """Raw outputs of regions: of the RoI refinement, with category and box of the evidence; and, in evaluation mode, those
        of the mirror images, of which the azimuth alone is taken."""
        fused, dtype = encoding.fused, encoding.objectness_logit.dtype
        assert fused is not None and encoding.box is not None
        labels = fused.label_logits[row, region]
        located = torch.cat((fused.box_loc[row, region], fused.box_raw[row, region]), -1)
        label_size, _, _, _, box_size, _ = self.head.sizes
        first = sum(self.head.sizes[:4])
        if not look or len(row) == 0:
            start = self.head.get_buffer("start")[-1].to(dtype).expand(len(row), -1)
            raw = torch.cat((labels, start[:, label_size:first], located, start[:, first + box_size :]), -1)
            return raw, None if self.training else raw
        place = encoding.box[row, region] if box is None else box
        crops = self._crops(encoding.levels, row, place, encoding.detail)
        factor = crops.factor
        looks = self._look_into(crops if self.training else with_mirrored(crops)).split(len(row))
        raw, mirror = looks[0], None if self.training else looks[1]
        shift = range_shift(factor, self.config.range_spread[0])
        ranges = torch.cat((raw[:, first + box_size :][:, :1] + shift[:, None], raw[:, first + box_size + 1 :]), -1)
        seen = fused.look_weight[row, region][:, None] * torch.log_softmax(raw[:, :label_size], -1)
        answer = torch.cat((labels + seen, raw[:, label_size:first], located, ranges), -1)
        return self.look_at_shapes(answer, encoding, row, place), mirror

    def look_at(
        self,
        levels: tuple[Tensor, ...],
        row: Int[Tensor, " n"],
        box: Float[Tensor, "n 4"],
        detail: Float[Tensor, " b"] | None = None,
    ) -> tuple[Float[Tensor, "n outputs"], Float[Tensor, " n"]]:
        """Raw outputs of the RoI refinement by boxes, px, cut out of images (`crops.cut_out_detailed`), and pixels of each crop
        over those of its image."""
        crops = self._crops(levels, row, box, detail)
        return self._look_into(crops), crops.factor

    @staticmethod
    def _crops(
        levels: tuple[Tensor, ...], row: Int[Tensor, " n"], box: Float[Tensor, "n 4"], detail: Float[Tensor, " b"] | None
    ) -> Crops:
        """Objects cut out, dark ones brightened."""
        with torch.no_grad():
            return brightened(cut_out_detailed(levels, detail, row, box.detach()))

    def _look_into(self, crops: Crops) -> Float[Tensor, "n outputs"]:
        """Raw outputs of the RoI refinement of crops."""
        dtype = self.head.objectness.weight.dtype
        number, cells = torch.arange(len(crops.box), device=crops.box.device), SIDE // self.config.stride
        cell = torch.full_like(number, (cells * cells) // 2)
        with self._autocast():
            maps, fine = self.encoder(crops.image)
            raw = self.head(maps[:, :, cells // 2, cells // 2])[:, -1]
            return self.head.refine(raw.to(dtype), fine, number, cell, cells, crops.box).to(dtype)

    def responsible_region(self, encoding: Encoding, row: Int[Tensor, " n"], box: Float[Tensor, "n 4"]) -> Int[Tensor, " n"]:
        """Region that describes each box best: the largest overlap, the likelier of like ones."""
        assert isinstance(encoding, HybridEncoding) and encoding.box is not None
        own, logit = encoding.box[row], encoding.objectness_logit[row]
        quality, _ = region_quality(own, logit, box[:, None], encoding.rows, encoding.columns, self.config)
        return quality[:, 0].argmax(-1)

    def observe(self, batch: SceneBatch) -> ObservedScene:
        """Encode a batch and find the responsible region of each object, and the regions whose objectness is known."""
        encoding = self.encode(batch.image)
        batch = self._prior().complete(batch.neutral())
        config, fused = self.config, encoding.fused
        assert fused is not None and encoding.box is not None
        with torch.no_grad():
            region, assigned, overlap = assign_regions(
                encoding.box, encoding.objectness_logit, batch.box, batch.present, encoding.rows, encoding.columns, config
            )
            regions = encoding.objectness_logit.shape[1]
            is_object = torch.zeros(len(region), regions + 1, dtype=torch.bool, device=region.device)  # the last takes the rest
            is_object = is_object.scatter(1, torch.where(assigned, region, regions), True)[:, :regions]
            counted = known_regions(encoding.box, fused.label_logits, batch) | is_object
            cell = region // config.predictors
            camera = batch.intrinsics[:, None].expand(-1, batch.box.shape[1], -1)
            assignment = Assignment(
                cell=cell,
                predictor=region % config.predictors,
                assigned=assigned,
                is_object=is_object,
                box_target=encode_box(batch.box, cell, encoding.columns, config),
                range_target=encode_range(batch.position, batch.diagonal, batch.box, camera, config),
                has_range=batch.has_position & batch.has_size,
                counted=counted,
            )
            row, slot = assigned.nonzero(as_tuple=True)
            at = region[row, slot]
            found = overlap[row, slot] >= SAME_OBJECT  # where an object is not found, the look is taken where it is
            box = torch.where(found[:, None], encoding.box[row, at], batch.box[row, slot])
        start = self.head.get_buffer("start")[-1].to(encoding.objectness_logit).expand(*region.shape, -1)
        raw, mirror = self._look(encoding, row, at, True, box)
        mirror = None if mirror is None else start.index_put((row, slot), mirror)
        posterior = self._parameters_of(start.index_put((row, slot), raw), mirror)
        return ObservedScene(batch, encoding, assignment, posterior)


def region_quality(
    own: Float[Tensor, "b k 4"],
    logit: Float[Tensor, "b k"],
    box: Float[Tensor, "b m 4"],
    rows: int,
    columns: int,
    config: ModelConfig,
) -> tuple[Float[Tensor, "b m k"], Float[Tensor, "b m k"]]:
    """How well each region describes each box, and their overlap.

    Overlap and probability together: of regions with like boxes the likeliest is the one that suppression keeps. Where
    no region overlaps a box, the region it belongs to by place and size.
    """
    overlap = box_iou(own[:, None], box[:, :, None])
    quality = torch.where(overlap >= SAME_OBJECT, overlap + 0.25 * torch.sigmoid(logit)[:, None], 0.1 * overlap)
    role = ((box[..., 2:] - box[..., :2]).amax(-1) >= ROLE_SIDE).long().clamp(max=config.predictors - 1)
    home = cell_of(box, rows, columns, config.stride) * config.predictors + role
    return quality.scatter_add(2, home[..., None], torch.full_like(quality[..., :1], 0.11)), overlap


def assign_regions(
    own: Float[Tensor, "b k 4"],
    logit: Float[Tensor, "b k"],
    box: Float[Tensor, "b m 4"],
    present: Bool[Tensor, "b m"],
    rows: int,
    columns: int,
    config: ModelConfig,
) -> tuple[Int[Tensor, "b m"], Bool[Tensor, "b m"], Float[Tensor, "b m"]]:
    """Responsible region of each object, whether it has one, and the overlap of their boxes.

    Objects choose in the order of their best quality, so that no two share a region.
    """
    quality, overlap = region_quality(own, logit, box, rows, columns, config)
    b, m, k = quality.shape
    best = torch.where(present, quality.amax(-1), -1.0)
    order = best.argsort(dim=1, descending=True, stable=True)
    free = torch.ones(b, k, dtype=torch.bool, device=box.device)
    region = torch.zeros(b, m, dtype=torch.long, device=box.device)
    images = torch.arange(b, device=box.device)
    for rank in range(m):
        slot = order[:, rank]
        choice = torch.where(free, quality[images, slot], -1.0).argmax(-1)
        region[images, slot] = choice
        free[images, choice] &= ~present[images, slot]
    return region, present.clone(), overlap.gather(2, region[..., None])[..., 0]


def known_regions(own: Float[Tensor, "b k 4"], labels: Float[Tensor, "b k l"], batch: SceneBatch) -> Bool[Tensor, "b k"]:
    """Regions that are known to be background, where they are responsible for no object.

    Unknown are regions that describe an object for which another is responsible, those half of whose box lies in a part of
    the image that is not labelled, and those that look like a category of which not every instance is labelled.
    """
    overlap = torch.where(batch.present[..., None], box_iou(own[:, None], batch.box[:, :, None]), 0.0)
    known = ~(overlap >= SAME_OBJECT).any(1)
    if batch.ignore is not None:
        low = torch.maximum(own[:, None, :, :2], batch.ignore[:, :, None, :2])
        high = torch.minimum(own[:, None, :, 2:], batch.ignore[:, :, None, 2:])
        covered = (high - low).clamp_min(0).prod(-1)
        known &= ~(covered > 0.5 * box_area(own)[:, None]).any(1)
    if batch.exhaustive is not None:
        known &= batch.exhaustive.gather(1, labels.argmax(-1))
    return known
