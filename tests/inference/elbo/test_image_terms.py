"""What images contribute: their parts sum to the batch's, and what is not labelled contributes nothing."""

from __future__ import annotations

import pytest
import torch

from nolbo_ppl.inference.elbo import INCLUSIVE, PURE_BOUND, SceneELBO
from nolbo_ppl.inference.image_terms import image_terms
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.scene_batch import SceneBatch
from tests.factories import random_batch, tiny_config


def partly_labelled(config: object) -> SceneBatch:
    batch = random_batch(config, scenes=3, seed=2, objects=2)  # type: ignore[arg-type]
    has = batch.has_viewpoint.clone()
    has[1] = False
    exhaustive = torch.ones(3, 4, dtype=torch.bool)
    exhaustive[2, 0] = False
    ignore = torch.zeros(3, 1, 4)
    ignore[0, 0] = torch.tensor([0.0, 0.0, 40.0, 40.0])
    return batch.replace(has_viewpoint=has, exhaustive=exhaustive, ignore=ignore)


@pytest.mark.parametrize("detector", ["", "yolox_nano"])
@pytest.mark.parametrize("weights", [INCLUSIVE, PURE_BOUND], ids=["inclusive", "bound"])
def test_parts_sum_to_the_whole(detector: str, weights: dict[str, float]) -> None:
    model = Nolbo.from_seed(tiny_config(detector=detector), 0).double()
    batch = partly_labelled(model.config)
    parts = image_terms(model, batch, weights)
    model.eval()
    with torch.no_grad():
        whole = SceneELBO(weights).evaluate(model.story, model.guide, model.guide.observe(batch), scenes=3)
    for name, value in whole.terms.items():
        assert sum(part.terms[name] for part in parts) == pytest.approx(float(value), rel=1e-6, abs=1e-8), name
    assert sum(part.loss for part in parts) / 3 == pytest.approx(float(whole.loss), rel=1e-6)
    assert [part.viewpoints for part in parts] == [2, 0, 2] and [part.objects for part in parts] == [2, 2, 2]
    assert (
        parts[0].unknown_regions > 0
        and parts[0].regions + parts[0].unknown_regions == parts[1].regions + parts[1].unknown_regions
    )
    name = "orientation_inclusive" if weights is INCLUSIVE else "orientation_kl"
    same = [one for one in parts[1].terms if "azimuth" in one or one == name or "angle" in one]
    assert all(parts[1].terms[one] == 0 for one in same)


def test_what_is_ignored_does_not_reach_the_objectness() -> None:
    model = Nolbo.from_seed(tiny_config(), 0).double()
    batch = random_batch(model.config, scenes=1, seed=3, objects=0)
    blind = batch.replace(ignore=torch.tensor([[[0.0, 0.0, 64.0, 64.0]]]))
    (plain,), (nothing,) = image_terms(model, batch), image_terms(model, blind)
    assert plain.unknown_regions == 0 and nothing.regions == 0 and nothing.unknown_regions == plain.regions
    objectness = [name for name in plain.terms if "objectness" in name]
    assert objectness and all(nothing.terms[name] == 0 != plain.terms[name] for name in objectness)
    unlabelled = batch.replace(exhaustive=torch.zeros(1, len(model.config.categories), dtype=torch.bool))
    assert image_terms(model, unlabelled)[0].regions == 0
