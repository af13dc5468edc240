"""The bound by term: its sum, and its closed forms against samples."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from pyro import poutine
from torch import Tensor, nn

from nolbo_ppl.inference import elbo as module
from nolbo_ppl.inference.elbo import (
    BOUND_TERMS,
    INCLUSIVE,
    PURE_BOUND,
    SceneELBO,
)
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.observed_scene import ObservedScene
from nolbo_ppl.models.scene_batch import unpack_bits
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


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("missing", [False, True])
def test_sum_of_terms_is_the_loss(form: str, missing: bool) -> None:
    config = instance_config(orientation=form)
    model, batch = tiny_model(config, scatter=0.1), random_batch(config, objects=2)
    batch.category[batch.present], batch.instance[batch.present] = 2, 1
    if missing:
        batch.category[0, 0] = batch.instance[0, 0] = batch.instance[1, 1] = -1
    with torch.no_grad():
        scene = model.guide.observe(batch)
        torch.manual_seed(0)
        result = SceneELBO(PURE_BOUND).evaluate(model.story, model.guide, scene, scenes=2)
    assert set(result.terms) == set(BOUND_TERMS) - (set() if missing else {"label_kl", "instance_label_kl"})
    total = sum(float(value) for value in result.terms.values())
    assert total == pytest.approx(-2 * float(result.loss), abs=1e-12 * abs(total))
    torch.manual_seed(0)
    assert terms_of(model, scene, set(BOUND_TERMS)) == result.terms


def test_weights_multiply_their_terms() -> None:
    config = tiny_config()
    model, batch = tiny_model(config), random_batch(config)
    with torch.no_grad():
        scene = model.guide.observe(batch)
    weights = {"shape_inclusive": 0.25, "box": 2.0, "orientation_inclusive": 3.0, "objectness": 0.0}
    result = SceneELBO(weights).evaluate(model.story, model.guide, scene, scenes=2, decode=0)
    assert set(result.terms) == {"shape_inclusive", "box", "orientation_inclusive"}
    total = sum(weights[name] * float(value) for name, value in result.terms.items())
    assert float(result.loss) == pytest.approx(-total / 2, rel=1e-13)


def sampled_terms(model: Nolbo, scene: ObservedScene, copies: int, decode: int | None = 0) -> dict[str, Tensor]:
    """log p - log q of each latent site and log p of each observed one, by sample and scene [copies, scenes].

    A plain Monte Carlo estimate from Pyro's own traces and the distributions' `log_prob`, masks as the sites carry them.
    """
    many = repeat_scene(scene, copies)
    with torch.no_grad():
        guide_trace = poutine.trace(model.guide).get_trace(many)
        model_trace = poutine.trace(poutine.replay(model.story, trace=guide_trace)).get_trace(many, decode=decode)
        guide_trace.compute_log_prob()
        model_trace.compute_log_prob()
    found = {}
    scenes = len(scene.batch.image)
    for name, site in model_trace.nodes.items():
        if site["type"] != "sample" or name not in (*module.KL_TERMS, *module.LIKELIHOOD_TERMS):
            continue
        value = site["log_prob"]
        if name in module.LIKELIHOOD_TERMS:
            term = name
        elif guide_trace.nodes[name]["is_observed"]:
            continue
        else:
            term = module.KL_TERMS[name]
            value = value - guide_trace.nodes[name]["log_prob"]
        if name != "voxels":
            found[term] = value.reshape(copies, scenes, -1).sum(-1)
        else:
            owner = (scene.batch.present & scene.batch.has_voxels).nonzero()[:, 0].repeat(copies)
            copy = torch.arange(copies).repeat_interleave(len(owner) // copies)
            found[term] = torch.zeros(copies, scenes).index_put((copy, owner), value, accumulate=True)
    return found


@pytest.mark.parametrize("form", FORMS)
def test_each_closed_form_against_samples(form: str) -> None:
    config = tiny_config(orientation=form)
    model = tiny_model(config)
    batch = unsymmetric(random_batch(config, objects=2, seed=3)).replace(noise=None)
    batch.has_viewpoint[0, 1] = False
    batch.has_size[1, 0] = False
    scene = observed_scene(config, batch)
    exact = terms_of(model, scene, decode=0)
    samples = sampled_terms(model, scene, 4000)
    assert set(samples) == set(BOUND_TERMS) - {"voxels", "label_kl", "instance_kl", "instance_label_kl"}
    for name, value in samples.items():
        assert_within(value.sum(1), exact[name], slack=1e-9)
    # and the whole bound, as Pyro's Trace_ELBO would estimate it
    assert_within(sum(value.sum(1) for value in samples.values()), sum(exact[name] for name in samples))


@pytest.mark.parametrize("form", ["mixture", "angle"])
def test_symmetric_objects_are_bounded_from_below(form: str) -> None:
    """Under a symmetry the orientation terms are lower bounds, and close ones while each mode is narrow."""
    config = tiny_config(orientation=form)
    model = tiny_model(config)
    batch = random_batch(config, scenes=1, slots=4, seed=2).replace(noise=None)
    batch = batch.replace(category=torch.tensor([[0, 3, 3, 3]]), symmetry=torch.tensor([[1, 2, 3, 4]]))
    scene = observed_scene(config, batch)
    if form == "mixture":  # modes that look the same on the table, at its two ends
        natural = scene.posterior.azimuth_natural
        natural[0, 1, 2:] = -natural[0, 1, :2]
    exact = terms_of(model, scene, decode=0)
    samples = sampled_terms(model, scene, 4000)
    for name in ("orientation_kl", "rotation"):
        value = samples[name].sum(1)
        error = float(value.std()) / math.sqrt(len(value))
        assert float(exact[name]) <= float(value.mean()) + 5 * error
        assert float(value.mean() - exact[name]) < 0.5


@pytest.mark.parametrize("form", ["mixture", "angle"])
@pytest.mark.parametrize("weights", [PURE_BOUND, INCLUSIVE])
def test_the_azimuth_of_a_free_axis_is_ignored(form: str, weights: dict[str, float]) -> None:
    """A bottle turned about its axis: the terms and their gradients know nothing of its azimuth."""
    config = tiny_config(orientation=form)
    model = tiny_model(config)
    batch = random_batch(config, scenes=1, slots=1, seed=2)
    batch = batch.replace(symmetry=torch.zeros(1, 1, dtype=torch.long))
    q = observed_scene(config, batch).posterior
    found = []
    for turn in (0.0, 1.1):
        scene = observed_scene(config, batch, dataclasses.replace(q, azimuth_natural=q.azimuth_natural.requires_grad_()))
        scene.batch.viewpoint[..., 0] += turn
        result = SceneELBO(weights).evaluate(model.story, model.guide, scene, decode=0)
        (gradient,) = torch.autograd.grad(result.loss, q.azimuth_natural, allow_unused=True)
        assert gradient is None or bool((gradient.abs() < 1e-12).all())
        found.append(result.terms)
    for name, value in found[0].items():
        torch.testing.assert_close(found[1][name], value)
    if weights is PURE_BOUND:  # elevation and in-plane rotation, written out
        s = q.angle_scale / config.orientation_scale
        d = (q.angle_loc - batch.viewpoint[..., 1:]) / config.orientation_scale
        torch.testing.assert_close(found[0]["orientation_kl"].detach(), -(0.5 * (s**2 + d**2 - 1) - s.log()).sum())


def test_voxel_term_is_the_decoders_log_likelihood() -> None:
    """At the sample the voxel term uses, by hand; and decoding a part of the objects scales it up to all."""
    config = tiny_config()
    model = tiny_model(config).eval()
    batch = random_batch(config, scenes=2, slots=3, objects=3)
    batch.has_voxels[0, 1] = False
    scene = observed_scene(config, batch)
    latent = scene.posterior.shape_loc + scene.posterior.shape_scale * batch.noise
    log_likelihood = torch.zeros(2, 3)
    for b in range(2):
        for m in range(3):
            truth = torch.from_numpy(np.unpackbits(batch.voxels[b, m].numpy())).reshape(32, 32, 32).double()
            p = torch.sigmoid(model.story.decoder(latent[b, m][None])[0]).detach()
            log_likelihood[b, m] = (truth * p.log() + (1 - truth) * (1 - p).log()).sum()
    known = log_likelihood[batch.has_voxels]
    torch.testing.assert_close(terms_of(model, scene)["voxels"], known.sum(), rtol=1e-12, atol=0)
    order = torch.tensor([[0.5, 0.0, 0.1], [0.9, 0.3, 0.7]])  # of known objects the smallest are (0, 2) and (1, 1)
    some = dataclasses.replace(scene, batch=scene.batch.replace(decode_order=order))
    two = (log_likelihood[0, 2] + log_likelihood[1, 1]) * 5 / 2
    torch.testing.assert_close(terms_of(model, some, decode=2)["voxels"], two, rtol=1e-12, atol=0)
    # drawn, the subset stands for all: slots that differ a lot, on average over every choice
    drawn = dataclasses.replace(scene, batch=scene.batch.replace(decode_order=None))
    each = torch.stack([terms_of(model, drawn, {"voxels"}, decode=2)["voxels"] for _ in range(60)])
    assert len({round(float(v), 6) for v in each}) > 5
    assert_within(each, known.sum())
    assert "voxels" not in terms_of(model, scene, decode=0)


def test_voxel_term_is_an_unbiased_sample() -> None:
    """Without given noise the latent is drawn: the mean over draws agrees with a hand-made average over q."""
    config = tiny_config()
    model = tiny_model(config).eval()
    scene = observed_scene(config, random_batch(config, scenes=1, slots=1).replace(noise=None))
    mean = terms_of(model, repeat_scene(scene, 100), {"voxels"})["voxels"] / 100
    q = scene.posterior
    noise = torch.randn(300, config.latent_dim)
    with torch.no_grad():
        logits = model.story.decoder(q.shape_loc[0] + q.shape_scale[0] * noise)
    truth = unpack_bits(scene.batch.voxels[0, 0], 32)
    by_hand = -nn.functional.softplus(torch.where(truth, -logits, logits)).sum((1, 2, 3))
    error = float(by_hand.std()) * math.sqrt(1 / 100 + 1 / 300)
    assert abs(float(mean - by_hand.mean())) < 5 * error
