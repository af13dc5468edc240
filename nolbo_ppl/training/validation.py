"""Held-out figures during training: cheap, at the responsible regions, without decoding (evaluation proper: `evaluate`)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

import torch

from nolbo_ppl._moved import renamed
from nolbo_ppl.devices import placed
from nolbo_ppl.geometry.boxes import box_iou
from nolbo_ppl.geometry.rotation import geodesic_angle, viewpoint_to_matrix
from nolbo_ppl.inference.elbo import INCLUSIVE, PURE_BOUND, SceneELBO
from nolbo_ppl.models.guide import orientation_posterior
from nolbo_ppl.models.observation_model import Nolbo, evaluation_mode
from nolbo_ppl.models.observed_scene import ObservedScene
from nolbo_ppl.models.scene_batch import SceneBatch, decode_box


@torch.no_grad()
def validate(model: Nolbo, batches: Iterable[SceneBatch], decode: int = 16) -> dict[str, float]:
    """Figures of a model on held-out batches.

    Returns the pure bound by term (`bound/...`, nats a scene, and their sum `bound`), the inclusive terms
    (`inclusive/...`, nats a scene), and at the regions responsible for the true objects: `box50` (share of boxes with
    IoU of at least 0.5), `category` (accuracy by maximum likelihood over the prior means), `acc_pi6` and
    `med_err_deg` (objects of categories without declared symmetry), `azimuth_in_90` (share of true azimuths inside the
    90 % region). `left_out` is the share of objects that no region is responsible for.
    """
    sums: dict[str, float] = {}
    scenes = objects = left_out = 0
    found: dict[str, list[torch.Tensor]] = {name: [] for name in ("box50", "category", "error", "region")}
    device = next(model.parameters()).device
    with evaluation_mode(model):
        for batch in batches:
            batch = placed(batch, device)
            scene = model.guide.observe(batch)
            scenes += len(batch.image)
            objects, left_out = objects + int(batch.present.sum()), left_out + int(scene.left_out.sum())
            for prefix, weights in (("bound", PURE_BOUND), ("inclusive", INCLUSIVE)):
                terms = SceneELBO(weights).evaluate(model.story, model.guide, scene, decode=decode).terms
                for name, value in terms.items():
                    key = f"{prefix}/{name.removesuffix('_inclusive')}"
                    sums[key] = sums.get(key, 0.0) + float(value)
            _collect(model, scene, found)
    result = {name: value / max(scenes, 1) for name, value in sums.items()}
    result["left_out"] = left_out / max(objects, 1)
    result["bound"] = sum(value for name, value in result.items() if name.startswith("bound/"))
    stacked = {name: torch.cat(values) if values else torch.zeros(0) for name, values in found.items()}
    error = stacked.pop("error")
    result.update({name: float(value.double().mean()) if len(value) else math.nan for name, value in stacked.items()})
    result["azimuth_in_90"] = result.pop("region")
    if len(error):
        result["acc_pi6"] = float((error < math.pi / 6).double().mean())
        result["med_err_deg"] = float(torch.rad2deg(error.median()))
    return {name: value for name, value in result.items() if math.isfinite(value)}


def _collect(model: Nolbo, scene: ObservedScene, found: dict[str, list[torch.Tensor]]) -> None:
    """Append the figures of the objects of one batch, those at least half visible."""
    batch, where, config = scene.batch, scene.assignment, model.config
    mask = where.assigned & (batch.visibility >= 0.5)
    mean = model.story.prior.label_mean()
    q = scene.posterior.map(lambda value: value[mask]).at_map_category(mean)
    box = decode_box(q.box_loc, where.cell[mask], scene.encoding.columns, config)
    found["box50"].append(box_iou(box, batch.box[mask]) >= 0.5)
    labelled = batch.category[mask] >= 0
    half = config.category_dim
    distance = (q.shape_loc[:, None, :half] - mean[:, :half]).square().sum(-1)
    found["category"].append((distance.argmin(-1) == batch.category[mask])[labelled])
    plain = torch.tensor(config.symmetry, device=mask.device)[batch.category[mask].clamp_min(0)] == 1
    use = labelled & plain & batch.has_viewpoint[mask]
    if bool(use.any()):
        posterior = orientation_posterior(q.map(lambda value: value[use]), config)
        truth = batch.viewpoint[mask][use]
        mode = posterior.mode if config.orientation != "sincos" else posterior.viewpoint_of(posterior.mean)
        found["error"].append(geodesic_angle(viewpoint_to_matrix(mode), viewpoint_to_matrix(truth)))
        if config.orientation == "mixture":
            found["region"].append(posterior.azimuth.hpd_mass(truth[:, 0]) <= 0.9)


if not TYPE_CHECKING:  # type checkers know the new names alone
    __getattr__ = renamed(__name__)
