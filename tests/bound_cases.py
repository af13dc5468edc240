"""What the tests of the bound share: forms of the orientation, terms as numbers."""

from __future__ import annotations

import torch
from torch import Tensor

from nolbo_ppl.inference.elbo import INCLUSIVE, INCLUSIVE_TERMS, PURE_BOUND, SceneELBO
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.observed_scene import ObservedScene
from nolbo_ppl.models.scene_batch import SceneBatch

FORMS = ("mixture", "angle", "sincos")
EVERYTHING = {**PURE_BOUND, **dict.fromkeys(INCLUSIVE_TERMS.values(), 1.0), **dict.fromkeys(INCLUSIVE, 1.0)}


def terms_of(model: Nolbo, scene: ObservedScene, names: set[str] | None = None, **kwargs: object) -> dict[str, Tensor]:
    """Terms without gradients, as numbers."""
    found = SceneELBO(EVERYTHING).terms(model.story, model.guide, scene, names=names, **kwargs)
    return {name: value.detach() for name, value in found.items()}


def unsymmetric(batch: SceneBatch) -> SceneBatch:
    """Every object without symmetry: the closed forms of rotations are exact there, bounds elsewhere."""
    return batch.replace(symmetry=torch.ones_like(batch.symmetry))
