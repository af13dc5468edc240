"""What each image of a batch contributes to bound and objective: its terms, and how much of it is labelled."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from nolbo_ppl.inference.elbo import INCLUSIVE, SceneELBO
from nolbo_ppl.models.observation_model import Nolbo, evaluation_mode
from nolbo_ppl.models.scene_batch import SceneBatch


@dataclass(frozen=True)
class ImageTerms:
    """One image's part."""

    terms: dict[str, float]
    """By name, nats; a term of which the image says nothing is 0."""
    loss: float
    """Weighted negative sum: the losses of a batch's images have its loss as their mean."""
    regions: int
    """Regions whose objectness counts."""
    unknown_regions: int
    """Regions of which nobody knows whether they describe an object: ignored, or of a category not labelled exhaustively."""
    objects: int
    categories: int
    """Objects with a known category."""
    viewpoints: int
    """With a known viewpoint."""
    ranges: int
    """With a known position and size."""
    shapes: int
    """With known voxels."""


@torch.no_grad()
def image_terms(
    model: Nolbo, batch: SceneBatch, weights: Mapping[str, float] = INCLUSIVE, decode: int | None = None
) -> list[ImageTerms]:
    """Evaluate the objective image by image, in evaluation mode.

    Args:
        model: the networks; their mode comes back.
        batch: images with what is known of them.
        weights: of the terms.
        decode: see `nolbo_ppl.inference.elbo.SceneELBO.evaluate`.
    """
    elbo, found = SceneELBO(weights), []
    with evaluation_mode(model):
        for k in range(len(batch.image)):
            scene = model.guide.observe(batch[k : k + 1])
            result = elbo.evaluate(model.story, model.guide, scene, scenes=1, decode=decode)
            counted, one = scene.assignment.counted, scene.batch
            regions = scene.encoding.objectness_logit.numel()
            known = regions if counted is None else int(counted.sum())
            there = scene.assignment.assigned
            found.append(
                ImageTerms(
                    {name: float(value) for name, value in result.terms.items()},
                    float(result.loss),
                    known,
                    regions - known,
                    int(there.sum()),
                    int((there & (batch.category[k : k + 1] >= 0)).sum()),
                    int((there & one.has_viewpoint).sum()),
                    int((there & scene.assignment.has_range).sum()),
                    int((there & one.has_voxels).sum()),
                )
            )
    return found
