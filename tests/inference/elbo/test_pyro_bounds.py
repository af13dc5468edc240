"""The bound against Pyro's own."""

from __future__ import annotations

import warnings

import pytest
import torch
from pyro import poutine
from pyro.infer import Trace_ELBO, TraceEnum_ELBO, TraceMeanField_ELBO
from torch import Tensor

from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.observed_scene import ObservedScene
from tests.bound_cases import FORMS, terms_of, unsymmetric
from tests.factories import (
    assert_within,
    instance_config,
    observed_scene,
    random_batch,
    repeat_scene,
    tiny_config,
    tiny_model,
)


def pyro_losses(elbo: object, model: Nolbo, scene: ObservedScene, copies: int, runs: int) -> Tensor:
    """Pyro's loss of the story and the guide, many copies at a time, a number a copy and run."""
    many = repeat_scene(scene, copies)
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("error")
        return torch.tensor([elbo.loss(model.story, model.guide, many, decode=0) / copies for _ in range(runs)])  # type: ignore[attr-defined]


@pytest.mark.parametrize("form", FORMS)
def test_agrees_with_pyros_own_bound(form: str) -> None:
    """Pyro's bound, on the same story and guide and without a warning, estimates the same number."""
    config = tiny_config(orientation=form)
    model = tiny_model(config)
    batch = unsymmetric(random_batch(config, scenes=1, objects=2, seed=5)).replace(noise=None)
    scene = observed_scene(config, batch)
    expected = -sum(terms_of(model, scene, decode=0).values())
    losses = pyro_losses(Trace_ELBO(max_plate_nesting=2), model, scene, 200, 20)
    assert_within(losses, expected, slack=1e-9)


@pytest.mark.parametrize("form", ["angle", "sincos"])
def test_agrees_with_trace_mean_field(form: str) -> None:
    """Pyro's bound with analytic KLs; it takes reparameterised sites only, so the objectness stays out."""
    config = tiny_config(orientation=form)
    model = tiny_model(config)
    batch = unsymmetric(random_batch(config, scenes=1, objects=2, seed=5)).replace(noise=None)
    scene = observed_scene(config, batch)
    terms = terms_of(model, scene, decode=0)
    expected = -sum(value for name, value in terms.items() if name != "objectness")
    many = repeat_scene(scene, 200)
    story, guide = (poutine.block(part, hide=["objectness"]) for part in (model.story, model.guide))
    elbo = TraceMeanField_ELBO(max_plate_nesting=2)
    with torch.no_grad():
        losses = torch.tensor([elbo.loss(story, guide, many, decode=0) / 200 for _ in range(20)])
    assert_within(losses, expected, slack=1e-9)


@pytest.mark.parametrize("instances", [False, True])
def test_missing_labels_agree_with_trace_enum(instances: bool) -> None:
    """A missing category (and instance) is summed out as Pyro's enumerating bound does."""
    config = instance_config() if instances else tiny_config()
    model = tiny_model(config)
    batch = unsymmetric(random_batch(config, scenes=2, objects=2, seed=6)).replace(noise=None)
    batch.category[0, 0] = -1
    batch.category[1, 1] = -1
    if instances:
        batch.instance[0, 0] = batch.instance[1, 1] = batch.instance[1, 0] = -1
    scene = observed_scene(config, batch)
    expected = -sum(terms_of(model, scene, decode=0).values())
    losses = pyro_losses(TraceEnum_ELBO(max_plate_nesting=2), model, scene, 200, 20)
    assert_within(losses, expected, slack=1e-9)
