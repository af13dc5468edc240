"""Gradients against finite differences, and refusals of bad weights."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from pyro import poutine
from torch import Tensor, nn

from nolbo_ppl.errors import InputError, NolboError
from nolbo_ppl.inference.elbo import (
    INCLUSIVE,
    PAPER,
    PURE_BOUND,
    SceneELBO,
    SceneLoss,
)
from tests.bound_cases import FORMS
from tests.factories import (
    instance_config,
    observed_scene,
    random_batch,
    tiny_config,
    tiny_model,
)


@pytest.mark.parametrize(
    ("form", "objective"), [(form, "elbo") for form in FORMS] + [("mixture", "inclusive"), ("angle", "inclusive")]
)
def test_gradients_against_finite_differences(form: str, objective: str) -> None:
    """Along random directions, one for each part of the networks, with missing labels and fixed noise.

    Without the RoI refinement: where it looks moves with the box, and no gradient is passed through that on purpose.
    """
    config = instance_config(orientation=form, glimpse=0)
    model = tiny_model(config, scatter=0.05)
    batch = random_batch(config, scenes=1, slots=3, objects=3, seed=2)
    batch.category[0, 0] = batch.instance[0, 0] = -1
    weights = {**PURE_BOUND, "voxels": 0.01} if objective == "elbo" else {**INCLUSIVE, "instance_inclusive": 1.0}
    loss = SceneLoss(model.story, model.guide, SceneELBO(weights))

    def value() -> Tensor:
        torch.manual_seed(3)
        return loss(batch, decode=None).loss

    value().backward()
    generator = torch.Generator().manual_seed(1)
    parts: dict[str, list[nn.Parameter]] = {}
    for name, parameter in model.named_parameters():
        if parameter.grad is None:
            assert name.startswith("shape_guide") or objective == "inclusive", name
            continue
        part = name.split(".")[:3] if name.startswith("guide") else name.split(".")[:2]
        parts.setdefault(".".join(part), []).append(parameter)
    expected = {
        "guide.encoder.stem",
        "guide.encoder.middle",
        "guide.encoder.deep",
        "guide.head.objectness",
        "guide.head.outputs",
        "story.prior",
    } | ({"story.decoder"} if objective == "elbo" else set())
    assert expected == set(parts)
    for part, parameters in parts.items():
        direction = [torch.randn(p.shape, generator=generator) for p in parameters]
        slope = sum(float((p.grad * d).sum()) for p, d in zip(parameters, direction, strict=True))
        values = {}
        with torch.no_grad():
            for step in (1e-6, -1e-6, 2e-6, -2e-6):
                for p, d in zip(parameters, direction, strict=True):
                    p.add_(step * d)
                values[step] = float(value())
                for p, d in zip(parameters, direction, strict=True):
                    p.sub_(step * d)
        numeric = (8 * (values[1e-6] - values[-1e-6]) - (values[2e-6] - values[-2e-6])) / 12e-6
        assert slope == pytest.approx(numeric, rel=2e-5, abs=1e-5), part


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ({"boxes": 1.0}, "unknown term of the bound: got .*boxes.*box_kl"),
        ({"box": math.nan}, "weight of box"),
        ({"box": math.inf}, "weight of box.*finite"),
    ],
)
def test_bad_weights(weights: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        SceneELBO(weights)


@pytest.mark.parametrize(
    ("hide_in", "message"),
    [("guide", r"only in the model \['box_latent'\]"), ("story", r"only in the guide \['box_latent'\]")],
)
def test_disagreeing_sites(hide_in: str, message: str) -> None:
    config = tiny_config()
    model = tiny_model(config)
    scene = observed_scene(config, random_batch(config))
    hidden: Callable[..., None] = poutine.block(model.guide if hide_in == "guide" else model.story, hide=["box_latent"])
    story, guide = (model.story, hidden) if hide_in == "guide" else (hidden, model.guide)
    with pytest.raises(NolboError, match=message):
        SceneELBO().terms(story, guide, scene)


def test_paper_weights_turn_the_objectness_round() -> None:
    assert PAPER["objectness"] == 0
    assert PAPER["objectness_inclusive"] == 1
    assert {k: v for k, v in PAPER.items() if not k.startswith("objectness")} == {
        k: v for k, v in PURE_BOUND.items() if k != "objectness"
    }
