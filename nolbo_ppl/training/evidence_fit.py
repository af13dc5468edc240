"""The last stage of a model with a detector: fit how its evidence is weighed, all other weights as they are.

The fusion network has few weights and takes few numbers a region. The evidence of every training image is therefore gathered
once, at the size of use, and the fusion learns from it in a minute; every tenth image of each data set decides when to stop.
Learnt together with the encoder, on what augmentation made of the images, it ranked the detections of photographs worse than the
detector alone does (mean average precision .64 against .68 on a third of the validation photographs).
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nolbo_ppl.devices import placed
from nolbo_ppl.geometry.boxes import box_area
from nolbo_ppl.models.evidence import WEAK, Evidence, Fusion
from nolbo_ppl.models.hybrid_guide import SAME_OBJECT, GatheredEvidence, HybridGuide, region_quality
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.scene_batch import SceneBatch, encode_box
from nolbo_ppl.models.shape_networks import bounded_exp

CANDIDATES = 300
"""Regions of an image that are learnt from: those with the most evidence, and those of its objects. With 48 the rest, which are
weighed too when an image is observed, came out too likely: leaving it out alone made 0.67 of an average precision of 0.63."""
MIN_BACKGROUND = 5
"""Photographs of which fewer regions are known to be background say nothing of how often the detector is wrong."""
SMOOTH = 0.01
"""Objects are certain up to this: boxes are wrong now and then."""


@dataclass
class EvidenceTable:
    """Candidate regions of n images: evidence, and what is true there."""

    detector: Evidence
    scene: Evidence
    context: Float[Tensor, "n c"]
    cell: Int[Tensor, "n r"]
    columns: int
    known: Bool[Tensor, "n r"]
    """It is known whether the region describes an object."""
    is_object: Bool[Tensor, "n r"]
    category: Int[Tensor, "n r"]
    """Of the object it is responsible for; -1 for none."""
    box: Float[Tensor, "n r 4"]
    """Box latent of that object."""
    look: Float[Tensor, "n r labels"]
    """Log probabilities of the categories by the RoI refinement there."""

    def __len__(self) -> int:
        return len(self.cell)

    def __getitem__(self, index: Tensor) -> EvidenceTable:
        """Some of the images."""
        values: dict[str, Any] = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        for name, value in values.items():
            if isinstance(value, Evidence):
                values[name] = Evidence(*(getattr(value, f.name)[index] for f in dataclasses.fields(value)))
            elif isinstance(value, Tensor):
                values[name] = value[index]
        return EvidenceTable(**values)


def table_tensors(table: EvidenceTable) -> dict[str, Tensor]:
    """The table's tensors by name, for a file."""
    tensors: dict[str, Tensor] = {"columns": torch.tensor(table.columns)}
    for field in dataclasses.fields(EvidenceTable):
        value = getattr(table, field.name)
        if isinstance(value, Evidence):
            tensors |= {f"{field.name}.{f.name}": getattr(value, f.name) for f in dataclasses.fields(Evidence)}
        elif isinstance(value, Tensor):
            tensors[field.name] = value
    return {name: value.contiguous() for name, value in tensors.items()}


def table_of(tensors: dict[str, Tensor]) -> EvidenceTable:
    """From `table_tensors`."""
    values: dict[str, Any] = {name: value for name, value in tensors.items() if "." not in name}
    values["columns"] = int(values["columns"])
    for source in ("detector", "scene"):
        values[source] = Evidence(**{f.name: tensors[f"{source}.{f.name}"] for f in dataclasses.fields(Evidence)})
    return EvidenceTable(**values)


def join_tables(tables: Iterable[EvidenceTable]) -> EvidenceTable:
    """Tables of images of one size, one after the other."""
    parts = list(tables)
    joined: dict[str, Any] = {}
    for field in dataclasses.fields(EvidenceTable):
        values = [getattr(part, field.name) for part in parts]
        if isinstance(values[0], Evidence):
            names = [f.name for f in dataclasses.fields(Evidence)]
            joined[field.name] = Evidence(*(torch.cat([getattr(value, name) for value in values]) for name in names))
        else:
            joined[field.name] = torch.cat(values) if isinstance(values[0], Tensor) else values[0]
    return EvidenceTable(**joined)


@torch.no_grad()
def gather_table(guide: HybridGuide, batch: SceneBatch) -> EvidenceTable:
    """The candidate regions of a batch; objects belong to the region of either source that describes them best."""
    config, batch = guide.config, batch.neutral()
    found = guide.gather(batch.image)
    region, unknown = _assign(found, batch, config)
    regions = found.detector.found.shape[1]
    strength = torch.maximum(found.detector.log_odds, found.scene.log_odds)
    strength = strength.scatter_add(1, torch.where(batch.present, region, 0), 100.0 * batch.present.to(strength.dtype))
    candidate = strength.topk(min(CANDIDATES, regions), dim=1).indices
    owner = torch.full((len(region), regions + 1), -1, device=region.device)
    number = torch.arange(region.shape[1], device=region.device).expand_as(region)
    owner.scatter_(1, torch.where(batch.present, region, regions), number)
    slot = owner[:, :regions].gather(1, candidate)
    is_object, at = slot >= 0, slot.clamp_min(0)
    cell = candidate // config.predictors
    true_box = batch.box.gather(1, at[..., None].expand(-1, -1, 4))
    look = found.detector.labels.new_zeros(*candidate.shape, len(config.categories))
    row, column = is_object.nonzero(as_tuple=True)
    if len(row):
        raw, _ = guide.look_at(found.levels, row, true_box[row, column])
        look[row, column] = torch.log_softmax(raw[:, : look.shape[-1]], -1)
    table = EvidenceTable(
        found.detector.at(candidate),
        found.scene.at(candidate),
        found.context,
        cell,
        found.columns,
        ~unknown.gather(1, candidate) | is_object,
        is_object,
        torch.where(is_object, batch.category.gather(1, at), -1),
        encode_box(true_box, cell, found.columns, config),
        look,
    )
    return placed(table, torch.device("cpu"))


def _assign(found: GatheredEvidence, batch: SceneBatch, config: ModelConfig) -> tuple[Int[Tensor, "b m"], Bool[Tensor, "b k"]]:
    """Region of each object, and the regions of which nothing is known."""
    parts = [
        region_quality(one.box, one.log_odds, batch.box, found.rows, found.columns, config)
        for one in (found.detector, found.scene)
    ]
    quality = torch.maximum(parts[0][0], parts[1][0] * 0.999)  # of equals the detector's
    overlap = torch.maximum(parts[0][1], parts[1][1])
    device = quality.device
    taken = torch.zeros(quality[:, 0].shape, dtype=torch.bool, device=device)
    region = torch.zeros(batch.present.shape, dtype=torch.long, device=device)
    order = torch.where(batch.present, quality.amax(-1), -1.0).argsort(dim=1, descending=True, stable=True)
    images = torch.arange(len(region), device=device)
    for rank in range(region.shape[1]):
        slot = order[:, rank]
        choice = torch.where(taken, -1.0, quality[images, slot]).argmax(-1)
        region[images, slot] = choice
        taken[images, choice] |= batch.present[images, slot]
    unknown = torch.where(batch.present[..., None], overlap, 0.0).amax(1) >= SAME_OBJECT
    likelier = (found.detector.log_odds >= found.scene.log_odds)[..., None]
    own = torch.where(likelier, found.detector.box, found.scene.box)
    if batch.ignore is not None and batch.ignore.shape[1]:
        low = torch.maximum(own[:, None, :, :2], batch.ignore[:, :, None, :2])
        high = torch.minimum(own[:, None, :, 2:], batch.ignore[:, :, None, 2:])
        unknown |= ((high - low).clamp_min(0).prod(-1) > 0.5 * box_area(own)[:, None]).any(1)
    if batch.exhaustive is not None:
        labels = len(config.categories)
        best = torch.where(likelier, found.detector.labels[..., :labels], found.scene.labels).argmax(-1)
        unknown |= ~batch.exhaustive.gather(1, best)
    return region, unknown


def fusion_loss(fusion: Fusion, table: EvidenceTable) -> dict[str, Tensor]:
    """Terms of the loss: objectness and category in nats an image, box in nats an object."""
    fused = fusion(table.detector, table.scene, table.context, table.cell, table.columns)
    target = table.is_object.to(fused.objectness_logit.dtype) * (1 - SMOOTH)
    loss = torch.nn.functional.binary_cross_entropy_with_logits(fused.objectness_logit, target, reduction="none")
    chosen = table.category >= 0
    labels = fused.label_logits + fused.look_weight[..., None] * table.look
    category = torch.nn.functional.cross_entropy(labels[chosen], table.category[chosen], reduction="sum")
    scale = 0.3 * bounded_exp(fused.box_raw, -5.0, 3.0)
    deviation = ((fused.box_loc - table.box) / scale).abs().clamp(max=20.0)  # Laplace: objects that are not found are far off
    box = (deviation + scale.log()).sum(-1)[table.is_object]
    images = len(table)
    return {
        "objectness": (loss * table.known).sum() / images,
        "category": category / images,
        "box": box.sum() / images,
    }


WEIGHTS = {"objectness": 1.0, "category": 1.0, "box": 0.15}
"""Of the terms."""


def fit_fusion(
    model: Nolbo,
    train: EvidenceTable,
    held_out: EvidenceTable,
    generated: tuple[Bool[Tensor, " n"], Bool[Tensor, " m"]],
    seed: int,
    steps: int = 3000,
    batch: int = 64,
    learning_rate: float = 2e-3,
    weight_decay: float = 0.05,
) -> dict[str, float]:
    """Fit the fusion network anew: what tells generated scenes from photographs, how evidence is weighed on the former, and the
    factors of the detector's evidence on the latter.

    Args:
        model: the networks; only the fusion network changes.
        train: evidence to learn from.
        held_out: evidence that decides when to stop weighing.
        generated: images of `train` and of `held_out` that are generated scenes: evidence is weighed on these. Where all are,
            or none, every image is taken for such a scene.
        seed: of the order of the images.
        steps: optimiser steps at most.
        batch: images a step.
        learning_rate: of AdamW, falling to nothing along a cosine.
        weight_decay: of AdamW.

    Returns:
        Held-out terms before and after.
    """  # fmt: skip
    guide = model.guide
    assert isinstance(guide, HybridGuide)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        fresh = Fusion(train.context.shape[-1], model.config).to(train.context.dtype)
    first = _judged(fresh, held_out)
    with torch.no_grad():
        fresh.domain.bias.fill_(8.0)  # weighed everywhere while that is learnt
    both = all(bool(kind.any()) and not bool(kind.all()) for kind in generated)
    of_scenes = [one[kind.nonzero()[:, 0]] if both else one for one, kind in zip((train, held_out), generated)]
    _fit_weights(fresh, of_scenes[0], of_scenes[1], seed, steps, batch, learning_rate, weight_decay)
    if both:
        _fit_domain(fresh, train.context, generated[0])
        _fit_photographs(fresh, train[(~generated[0]).nonzero()[:, 0]])
    guide.fusion.load_state_dict(fresh.state_dict())
    return {**{f"{name}_before": value for name, value in first.items()}, **_judged(fresh, held_out)}


def _judged(fusion: Fusion, table: EvidenceTable) -> dict[str, float]:
    with torch.no_grad():
        return {name: float(value) for name, value in fusion_loss(fusion, table).items()}


def _fit_weights(
    fusion: Fusion,
    train: EvidenceTable,
    held_out: EvidenceTable,
    seed: int,
    steps: int,
    batch: int,
    learning_rate: float,
    weight_decay: float,
) -> None:
    """AdamW on random batches; the weights with the least held-out loss stay."""  # fmt: skip
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.AdamW(fusion.parameters(), lr=learning_rate, weight_decay=weight_decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    best, state = _total(_judged(fusion, held_out)), copy.deepcopy(fusion.state_dict())
    for step in range(steps):
        chosen = torch.randint(len(train), (min(batch, len(train)),), generator=generator)
        parts = fusion_loss(fusion, train[chosen])
        loss = torch.stack([WEIGHTS[name] * value for name, value in parts.items()]).sum()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(fusion.parameters(), 10.0)
        optimizer.step()
        schedule.step()
        if (step + 1) % 100 == 0 or step + 1 == steps:
            now = _total(_judged(fusion, held_out))
            if now < best:
                best, state = now, copy.deepcopy(fusion.state_dict())
    fusion.load_state_dict(state)


def _fit_domain(fusion: Fusion, context: Float[Tensor, "n c"], generated: Bool[Tensor, " n"], steps: int = 300) -> None:
    """Logistic regression of the kind of an image on its context."""
    parameters = [*fusion.domain.parameters(), *fusion.domain_norm.parameters()]
    with torch.no_grad():
        fusion.domain.weight.zero_()
        fusion.domain.bias.zero_()
    optimizer = torch.optim.AdamW(parameters, lr=1e-2, weight_decay=0.01)
    target = generated.to(context.dtype)
    for _ in range(steps):
        odds = fusion.domain(fusion.domain_norm(context))[:, 0]
        loss = torch.nn.functional.binary_cross_entropy_with_logits(odds, target)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()


def _fit_photographs(fusion: Fusion, table: EvidenceTable, steps: int = 200) -> None:
    """Factor and shift of the detector's log odds, weights of its and the RoI refinement's log probabilities: four numbers."""
    labels = table.look.shape[-1]
    background = (table.known & ~table.is_object).sum(1) >= MIN_BACKGROUND
    strong = table.known & (table.detector.log_odds > WEAK) & background[:, None]
    odds, target = table.detector.log_odds[strong], table.is_object[strong].to(table.context.dtype)
    found = table.category >= 0
    own, look, category = table.detector.labels[..., :labels][found], table.look[found], table.category[found]
    with torch.no_grad():
        fusion.photograph.copy_(torch.tensor([1.0, 0.0, 1.0, 0.0]))
    optimizer = torch.optim.Adam([fusion.photograph], lr=0.05)
    for _ in range(steps):
        factor, offset, label_factor, weight = fusion.photograph
        objectness = torch.nn.functional.binary_cross_entropy_with_logits(factor * odds + offset, target)
        loss = objectness + torch.nn.functional.cross_entropy(label_factor * own + weight * look, category)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()


def _total(terms: dict[str, float]) -> float:
    return sum(WEIGHTS[name] * value for name, value in terms.items())
