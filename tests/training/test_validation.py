"""Held-out figures against their definitions, recomputed object by object."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from nolbo_ppl.geometry.boxes import box_iou
from nolbo_ppl.geometry.rotation import viewpoint_to_matrix
from nolbo_ppl.inference.elbo import INCLUSIVE, SceneELBO
from nolbo_ppl.models.guide import orientation_posterior
from nolbo_ppl.models.scene_batch import decode_box
from nolbo_ppl.training.validation import validate
from tests.factories import random_batch, tiny_config, tiny_model


@pytest.mark.parametrize("form", ["mixture", "angle", "sincos"])
def test_figures_by_hand(form: str) -> None:
    config = tiny_config(orientation=form)
    model = tiny_model(config, scatter=0.1)
    batches = [random_batch(config, scenes=3, slots=4, objects=3, seed=k).replace(noise=torch.zeros(3, 4, 4)) for k in range(2)]
    batches[0].visibility[0, 0] = 0.3
    batches[1].category[1, 1] = -1
    batches[1].has_viewpoint[2, 2] = False
    # one box the guide finds exactly
    with torch.no_grad():
        scene = model.eval().guide.observe(batches[0])
        own = decode_box(scene.posterior.box_loc, scene.assignment.cell, 4, config)
        batches[0].box[1, 1] = own[1, 1]
    model.train()
    figures = validate(model, batches)
    model.eval()
    overlap, category, errors, inside = [], [], [], []
    bound, inclusive = {}, {}
    for batch in batches:
        with torch.no_grad():
            scene = model.guide.observe(batch)
            for into, weights in ((bound, None), (inclusive, set(INCLUSIVE))):
                kwargs = {"decode": 16}
                for name, value in SceneELBO().terms(model.story, model.guide, scene, names=weights, **kwargs).items():
                    into[name] = into.get(name, 0.0) + float(value) / 6
        q = scene.posterior
        mean = model.story.prior.category_mean().detach()
        boxes = decode_box(q.box_loc, scene.assignment.cell, 4, config).detach()
        density = orientation_posterior(q, config)
        for b, m in scene.assignment.assigned.nonzero().tolist():
            if batch.visibility[b, m] < 0.5:
                continue
            overlap.append(float(box_iou(boxes[b, m], batch.box[b, m])) >= 0.5)
            label = int(batch.category[b, m])
            if label < 0:
                continue
            category.append(int((q.shape_loc[b, m].detach() - mean).norm(dim=-1).argmin()) == label)
            if config.symmetry[label] != 1 or not batch.has_viewpoint[b, m]:
                continue
            if form == "mixture":
                grid = torch.linspace(-math.pi, math.pi, 4001)[:, None, None]
                level = density.azimuth.log_density(grid)[:, b, m].detach()
                point = torch.cat((grid[level.argmax()].flatten(), q.angle_loc[b, m].detach()))
                at_truth = density.azimuth.log_density(batch.viewpoint[..., 0])[b, m].detach()
                mass = float((level.exp() * (level > at_truth)).mean() * 2 * math.pi)
                inside.append(mass <= 0.9)
            else:
                point = density.loc[b, m].detach()
            turn = Rotation.from_matrix(viewpoint_to_matrix(point).numpy().T @ viewpoint_to_matrix(batch.viewpoint[b, m]).numpy())
            errors.append(turn.magnitude())
    assert figures["box50"] == pytest.approx(np.mean(overlap))
    assert figures["box50"] > 0
    assert figures["category"] == pytest.approx(np.mean(category))
    assert figures["acc_pi6"] == pytest.approx(np.mean(np.array(errors) < math.pi / 6))
    assert figures["med_err_deg"] == pytest.approx(np.rad2deg(sorted(errors)[(len(errors) - 1) // 2]), abs=0.2)
    assert ("azimuth_in_90" in figures) == (form == "mixture")
    if inside:
        assert figures["azimuth_in_90"] == pytest.approx(np.mean(inside))
    for name, value in bound.items():
        assert figures[f"bound/{name}"] == pytest.approx(value, rel=1e-9), name
    assert figures["bound"] == pytest.approx(sum(bound.values()), rel=1e-9)
    for name, value in inclusive.items():
        assert figures[f"inclusive/{name.removesuffix('_inclusive')}"] == pytest.approx(value, rel=1e-9), name


def test_modes_are_left_as_they_were() -> None:
    model = tiny_model()
    model.train()
    model.story.eval()
    before = {name: module.training for name, module in model.named_modules()}
    state = {name: value.clone() for name, value in model.state_dict().items()}
    validate(model, [random_batch(tiny_config())])
    assert {name: module.training for name, module in model.named_modules()} == before
    assert all(torch.equal(value, state[name]) for name, value in model.state_dict().items())


def test_nothing_to_look_at() -> None:
    figures = validate(tiny_model(), [random_batch(tiny_config(), objects=0)])
    assert "box50" not in figures
    assert math.isfinite(figures["bound"])
