"""What is not observed changes nothing."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from nolbo_ppl.inference.elbo import (
    SceneELBO,
    SceneLoss,
)
from nolbo_ppl.models.scene_batch import SceneBatch
from tests.bound_cases import EVERYTHING, FORMS, terms_of
from tests.factories import (
    instance_config,
    observed_scene,
    random_batch,
    tiny_config,
    tiny_model,
)


def test_background_contributes_objectness_only() -> None:
    """A scene without objects has the objectness of its regions and zero for everything else."""
    config = tiny_config()
    model = tiny_model(config)
    scene = observed_scene(config, random_batch(config, scenes=1, slots=2, objects=0))
    found = terms_of(model, scene, set(EVERYTHING))
    assert float(found.pop("objectness")) < 0
    assert float(found.pop("objectness_inclusive")) < 0
    assert len(found) >= 10
    assert all(float(value) == 0 for value in found.values()), found


def test_an_empty_scene_changes_no_objects_terms() -> None:
    config = tiny_config()
    model = tiny_model(config, scatter=0.1).eval()
    batch = random_batch(config, scenes=2, objects=2, seed=1)
    batch.category[0, 0] = -1
    alone = terms_of(model, model.guide.observe(batch[:1]), set(EVERYTHING))
    empty = random_batch(config, scenes=2, slots=3, objects=0, seed=9)
    fields = {
        f.name: torch.cat((getattr(batch, f.name)[:1], getattr(empty, f.name)[:1]))
        for f in dataclasses.fields(SceneBatch)
        if getattr(batch, f.name) is not None
    }
    both = terms_of(model, model.guide.observe(batch.replace(**fields)), set(EVERYTHING))
    just_empty = terms_of(model, model.guide.observe(empty[:1]), set(EVERYTHING))
    assert set(alone) == set(both)
    for name in alone:
        expected = alone[name] + just_empty[name] if name.startswith("objectness") else alone[name]
        torch.testing.assert_close(both[name], expected, rtol=1e-12, atol=1e-12)


def test_permuting_object_slots_changes_nothing() -> None:
    config = instance_config()
    model = tiny_model(config, scatter=0.1).eval()
    batch = random_batch(config, scenes=2, slots=4, objects=3, seed=1)
    batch.category[0, 0] = -1
    batch.instance[0, 0] = -1
    batch.has_voxels[1, 2] = False
    before = terms_of(model, model.guide.observe(batch), set(EVERYTHING))
    order = torch.tensor([2, 3, 0, 1])
    per_slot = {
        f.name: getattr(batch, f.name)[:, order]
        for f in dataclasses.fields(SceneBatch)
        if f.name not in ("image", "intrinsics") and getattr(batch, f.name) is not None
    }
    after = terms_of(model, model.guide.observe(batch.replace(**per_slot)), set(EVERYTHING))
    assert set(before) == set(after)
    for name in before:
        torch.testing.assert_close(after[name], before[name], rtol=1e-12, atol=1e-12)


def test_permuting_regions_changes_nothing() -> None:
    config = tiny_config()
    model = tiny_model(config)
    scene = observed_scene(config, random_batch(config))
    before = terms_of(model, scene, set(EVERYTHING))
    order = torch.randperm(scene.encoding.objectness_logit.shape[1])
    scene.encoding.objectness_logit = scene.encoding.objectness_logit[:, order]
    scene.assignment.is_object = scene.assignment.is_object[:, order]
    after = terms_of(model, scene, set(EVERYTHING))
    for name in before:
        torch.testing.assert_close(after[name], before[name], rtol=1e-12, atol=1e-12)


def corrupted(batch: SceneBatch, value: float) -> SceneBatch:
    """Other values wherever the masks say that there is nothing to see."""
    out = dataclasses.replace(
        batch,
        **{f.name: getattr(batch, f.name).clone() for f in dataclasses.fields(SceneBatch) if getattr(batch, f.name) is not None},
    )
    out.viewpoint[~batch.has_viewpoint] = value
    out.position[~batch.has_position] = value
    out.diagonal[~batch.has_size] = value
    out.voxels[~batch.has_voxels] = 255
    out.shape_loc[~batch.has_voxels] = value
    out.shape_scale[~batch.has_voxels] = 7.0
    absent = ~batch.present
    out.box[absent] = torch.tensor([5.0, 5.0, 5.0, 5.0])
    out.noise[absent] = 3.0
    out.symmetry[absent] = 4
    out.visibility[absent] = value
    return out


def partly_labelled(config: object) -> SceneBatch:
    batch = random_batch(config, scenes=2, slots=3, objects=2, seed=1)  # type: ignore[arg-type]
    batch.has_viewpoint[0, 0] = False
    batch.has_position[0, 1] = False
    batch.has_size[1, 0] = False
    batch.has_voxels[1, 1] = False
    return batch


@pytest.mark.parametrize("value", [0.0, 50.0, -1.0, math.nan])
@pytest.mark.parametrize("form", FORMS)
def test_values_under_the_masks_do_not_matter(value: float, form: str) -> None:
    config = tiny_config(orientation=form)
    batch = partly_labelled(config)
    results = []
    for one in (batch, corrupted(batch, value)):
        model = tiny_model(config, scatter=0.1)
        torch.manual_seed(2)
        result = SceneLoss(model.story, model.guide, SceneELBO(EVERYTHING))(one, decode=None)
        result.loss.backward()
        gradient = {name: p.grad for name, p in model.named_parameters() if p.grad is not None}
        assert all(bool(torch.isfinite(g).all()) for g in gradient.values())
        results.append((result, gradient))
    (first, g1), (second, g2) = results
    assert set(first.terms) == set(second.terms)
    for name in first.terms:
        assert float(first.terms[name].detach()) == float(second.terms[name].detach()), name
    for name in g1:
        assert torch.equal(g1[name], g2[name]), name


def test_masked_labels_give_no_gradient() -> None:
    """What is missing has a term of exactly zero and pulls at nothing."""
    config = tiny_config()
    batch = random_batch(config, seed=1)
    batch = batch.replace(
        **{name: torch.zeros_like(batch.present) for name in ("has_viewpoint", "has_position", "has_size", "has_voxels")}
    )
    scene = observed_scene(config, batch)
    posterior = scene.posterior.map(lambda value: value.requires_grad_())
    result = SceneELBO(EVERYTHING).evaluate(
        tiny_model(config).story, tiny_model(config).guide, dataclasses.replace(scene, posterior=posterior)
    )
    for name in ("orientation_kl", "rotation", "range_kl", "range", "orientation_inclusive", "range_inclusive"):
        assert float(result.terms[name].detach()) == 0
    assert float(result.terms["shape_inclusive"].detach()) == 0
    assert "voxels" not in result.terms
    result.loss.backward()
    for name in ("azimuth_logits", "azimuth_natural", "angle_loc", "angle_scale", "range_loc", "range_scale"):
        gradient = getattr(posterior, name).grad
        assert gradient is None or bool((gradient == 0).all()), name
    assert bool((posterior.box_loc.grad != 0).all())
