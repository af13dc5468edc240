"""Evidence about objects, re-binned into the guide's own regions, and the small network that weighs it.

Two sources answer for every image: a detector that knows photographs, and the guide's own scene network, which knows
generated scenes. Every prediction of a source goes to the cell that holds the centre of its box; of those below 48 px
the best is the cell's first predictor's, of those above the best is its second predictor's, the roles that the
predictors of the scene network have. What a region then says (objectness, category, box) is the detector's evidence on
photographs, and on generated scenes the scene network's plus what the fusion network learns to change in it.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from nolbo_ppl.geometry.boxes import box_iou
from nolbo_ppl.models.layers import OutputLinear
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.scene_batch import cell_of, encode_box
from nolbo_ppl.models.yolox import CLASSES, Predictions

ROLE_SIDE = 48.0
"""Longer side, px, from which on a box belongs to a cell's second predictor."""
COCO_LABELS = {
    "aeroplane": 4, "bicycle": 1, "boat": 8, "bottle": 39, "bus": 5, "car": 2, "chair": 56, "diningtable": 60,
    "motorbike": 3, "sofa": 57, "train": 6, "tvmonitor": 62,
}  # fmt: skip
"""Number of each category among COCO's."""
TRUCK = 7
"""COCO's trucks: what the detector says of a quarter of all vans, kept apart from the cars' evidence."""
WEAK = -6.0
"""Regions of which both sources say less than this (log odds) are not weighed: hardly one of them describes an object, and nine
of ten regions are of this kind."""
MIN_LOG = -9.0
"""Log odds and log probabilities below this are as good as none."""


@dataclass
class Evidence:
    """What one source says of every region of a batch of images."""

    found: Float[Tensor, "b k"]
    """1 where it says anything."""
    log_odds: Float[Tensor, "b k"]
    """That the region describes an object; `MIN_LOG` where it says nothing."""
    labels: Float[Tensor, "b k l"]
    """Log probability of each category, and of others that the source knows."""
    box: Float[Tensor, "b k 4"]
    """[x0, y0, x1, y1], px of the image; a box of a stride's side at the cell where it says nothing."""

    def at(self, region: Int[Tensor, "b r"]) -> Evidence:
        """The evidence about some of each image's regions."""

        def chosen(value: Tensor) -> Tensor:
            index = region.view(*region.shape, *(1,) * (value.dim() - 2))
            return value.gather(1, index.expand(-1, -1, *value.shape[2:]))

        return Evidence(*(chosen(getattr(self, field.name)) for field in dataclasses.fields(self)))


def bin_best(
    box: Float[Tensor, "b n 4"], score: Float[Tensor, "b n"], rows: int, columns: int, config: ModelConfig
) -> tuple[Int[Tensor, "b k"], Tensor]:
    """Row of the best prediction of each region, and whether there is one.

    Args:
        box: boxes of all predictions, px.
        score: their scores.
        rows: cells above each other.
        columns: cells side by side.
        config: stride and predictors; with one predictor all sizes share it.
    """
    role = ((box[..., 2:] - box[..., :2]).amax(-1) >= ROLE_SIDE).long().clamp(max=config.predictors - 1)
    region = cell_of(box, rows, columns, config.stride) * config.predictors + role
    regions = rows * columns * config.predictors
    best = score.new_full((len(box), regions), -torch.inf).scatter_reduce(1, region, score, "amax")
    winner = score == best.gather(1, region)
    index = region.new_full((len(box), regions + 1), -1)
    number = torch.arange(box.shape[1], device=box.device).expand(len(box), -1)
    index.scatter_(1, torch.where(winner, region, regions), number)
    index = index[:, :regions]
    return index.clamp_min(0), index >= 0


def gather_evidence(
    box: Float[Tensor, "b n 4"],
    log_odds: Float[Tensor, "b n"],
    labels: Float[Tensor, "b n l"],
    rows: int,
    columns: int,
    config: ModelConfig,
) -> Evidence:
    """The predictions of a source as evidence about regions (module's docstring)."""
    with torch.no_grad():
        index, found = bin_best(box.detach(), log_odds.detach(), rows, columns, config)

    def at(values: Tensor) -> Tensor:
        return values.gather(1, index[..., None].expand(-1, -1, values.shape[-1]))

    cell = torch.arange(rows * columns, device=box.device).repeat_interleave(config.predictors)
    x, y = (cell % columns + 0.5) * config.stride, (cell // columns + 0.5) * config.stride
    half = config.stride / 2
    empty = torch.stack((x - half, y - half, x + half, y + half), -1).to(box.dtype)
    seen = found[..., None]
    return Evidence(
        found.to(box.dtype),
        torch.where(found, log_odds.gather(1, index), MIN_LOG).clamp_min(MIN_LOG),
        torch.where(seen, at(labels), -math.log(labels.shape[-1])).clamp_min(MIN_LOG),
        torch.where(seen, at(box), empty),
    )


def detector_evidence(predictions: Predictions, rows: int, columns: int, config: ModelConfig) -> Evidence:
    """The detector's predictions by region; labels are the categories', then trucks, then the best of all others."""
    own = [COCO_LABELS[name] for name in config.categories]
    rest = [label for label in range(CLASSES) if label not in (*own, TRUCK)]
    with torch.no_grad():
        of_class = nn.functional.logsigmoid(predictions.classes)
        device = of_class.device
        known, others = (of_class.index_select(-1, torch.tensor(which, device=device)) for which in (own, rest))
        labels = torch.cat((known, of_class[..., TRUCK, None], others.amax(-1, keepdim=True)), -1)
        named = predictions.classes.index_select(-1, torch.tensor(own, device=device)).amax(-1)
        log_odds = _joint_log_odds(predictions.objectness, named)
    return gather_evidence(predictions.box, log_odds, labels, rows, columns, config)


def _joint_log_odds(found: Tensor, named: Tensor) -> Tensor:
    """Log odds of two independent events from the log odds of each: 1 / odds = e^-a + e^-b + e^-(a + b)."""
    if torch.jit.is_tracing():  # exported graphs know no expm1
        largest = -math.log(math.expm1(1e-6))
        return -torch.logsumexp(torch.stack((-found, -named, -found - named)), 0).clamp_min(-largest)
    joint = (nn.functional.logsigmoid(found) + nn.functional.logsigmoid(named)).clamp(max=-1e-6)
    return joint - torch.log(-torch.expm1(joint))


@dataclass
class Fused:
    """What the evidence together says of every region."""

    objectness_logit: Float[Tensor, "b k"]
    label_logits: Float[Tensor, "b k labels"]
    look_weight: Float[Tensor, "b k"]
    """Weight of the label logits of the RoI refinement."""
    box_loc: Float[Tensor, "b k 4"]
    """Mean of the box latent."""
    box_raw: Float[Tensor, "b k 4"]
    """Raw scales of the box latent, as the head's."""


class Fusion(nn.Module):
    """Detector's and scene network's evidence -> objectness, category and box of every region.

    On photographs a region says what the detector says, up to a factor and a shift of its log odds and a factor of its log
    probabilities: what more was learnt from a few thousand of them ranked detections worse (average precision of COCO .34
    against .53), and shifts by category and size were wrong in streets. On generated scenes, which the detector does not know,
    a small network weighs what the two sources state. It sees no features of theirs: of a few dozen backgrounds it would learn
    those by heart. The image itself says which of the two it is.

    Args:
        context: numbers that describe an image as a whole.
        config: categories, predictors.
    """

    def __init__(self, context: int, config: ModelConfig) -> None:
        super().__init__()
        self.config, labels = config, len(config.categories)
        inputs = (labels + 2) + labels + 2 + 2 + 4 + 1
        self.domain_norm, self.domain = nn.LayerNorm(context), nn.Linear(context, 1)
        nn.init.zeros_(self.domain.weight)
        nn.init.constant_(self.domain.bias, -30.0)
        self.photograph = nn.Parameter(torch.tensor([1.0, 0.0, 1.0, 0.0]))
        self.slopes = nn.Parameter(torch.tensor([1.0, 0.0]))  # of the scene network's log odds, of the detector's
        self.shift = nn.Parameter(torch.zeros(()))
        self.sizes = (1, labels, 3, 1, 4, 4)
        last = OutputLinear(64, sum(self.sizes))
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.weigh = nn.Sequential(nn.Linear(inputs, 96), nn.GELU(), nn.Linear(96, 64), nn.GELU(), last)

    def forward(
        self, detector: Evidence, scene: Evidence, context: Float[Tensor, "b c"], cell: Int[Tensor, "b k"], columns: int
    ) -> Fused:
        """Weigh the evidence about regions of a batch of images.

        Args:
            detector: evidence of the detector.
            scene: evidence of the scene network, about the same regions.
            context: what describes each image as a whole.
            cell: the cell of each region.
            columns: cells side by side.
        """
        config = self.config
        inputs = torch.cat(
            (
                detector.labels / 4, scene.labels / 4,
                torch.stack((detector.log_odds / 4, scene.log_odds / 4, detector.found, scene.found), -1),
                _log_size(detector.box), _log_size(scene.box), box_iou(detector.box, scene.box)[..., None],
            ),
            -1,
        )  # fmt: skip
        objectness, label, weight, mix, shift, scale = self.weigh(inputs).split(self.sizes, -1)
        labels = len(config.categories)
        generated = self.generated(context)[:, None]
        share = torch.lerp(torch.ones_like(mix), torch.sigmoid(mix - 3.0), generated[..., None])
        alone = torch.where((detector.found == 0) & (scene.found > 0), 0.0, 1.0)  # the box of the only source that has one
        share = torch.where((detector.found * scene.found > 0)[..., None], share, alone[..., None])
        box = torch.lerp(encode_box(scene.box, cell, columns, config), encode_box(detector.box, cell, columns, config), share)
        strength = torch.maximum(detector.log_odds, scene.log_odds)
        of_scene, of_detector = self.slopes
        weighed = of_scene * scene.log_odds + of_detector * detector.log_odds + self.shift + objectness[..., 0]
        factor, offset, label_factor, look = self.photograph
        own = detector.labels[..., :labels]
        plain = factor * detector.log_odds + offset
        mixed = (1 + weight[..., :1]) * scene.labels + weight[..., 1:2] * own + label
        return Fused(
            torch.where(strength > WEAK, torch.lerp(plain, weighed, generated), strength),
            torch.lerp(label_factor * own, mixed, generated[..., None]),
            torch.lerp(look.expand_as(weight[..., 2]), torch.tanh(weight[..., 2]), generated),
            box + 0.3 * shift * generated[..., None],
            scale,
        )

    def generated(self, context: Float[Tensor, "b c"]) -> Float[Tensor, " b"]:
        """Probability that an image is a generated scene, not a photograph."""
        return torch.sigmoid(self.domain(self.domain_norm(context)))[:, 0]


def _log_size(box: Float[Tensor, "b k 4"]) -> Float[Tensor, "b k 2"]:
    return ((box[..., 2:] - box[..., :2]).clamp_min(1.0) / 64.0).log()
