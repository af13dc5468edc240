"""The bound by term: its sum, its closed forms against samples, its masks, its gradients."""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Callable

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro import poutine
from pyro.infer import Trace_ELBO, TraceEnum_ELBO, TraceMeanField_ELBO
from torch import Tensor, nn

from nolbo_ppl.errors import InputError, NolboError
from nolbo_ppl.inference import elbo as module
from nolbo_ppl.inference import optimisation
from nolbo_ppl.inference.elbo import (
    BOUND_TERMS,
    INCLUSIVE,
    INCLUSIVE_TERMS,
    PAPER,
    PURE_BOUND,
    ElboResult,
    SceneElbo,
    SceneLoss,
)
from nolbo_ppl.models.guide import ObservedScene
from nolbo_ppl.models.nolbo import Nolbo
from nolbo_ppl.models.scene import SceneBatch, unpack_bits
from nolbo_ppl.models.story import conjugate_truth, expected_normal_log_prob
from tests.factories import (
    assert_within,
    instance_config,
    observed_scene,
    random_batch,
    repeat_scene,
    tiny_config,
    tiny_model,
)

FORMS = ("mixture", "angle", "sincos")
EVERYTHING = {**PURE_BOUND, **dict.fromkeys(INCLUSIVE_TERMS.values(), 1.0), **dict.fromkeys(INCLUSIVE, 1.0)}


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(11)


def terms_of(model: Nolbo, scene: ObservedScene, names: set[str] | None = None, **kwargs: object) -> dict[str, Tensor]:
    """Terms without gradients, as numbers."""
    found = SceneElbo(EVERYTHING).terms(model.story, model.guide, scene, names=names, **kwargs)
    return {name: value.detach() for name, value in found.items()}


def unsymmetric(batch: SceneBatch) -> SceneBatch:
    """Every object without symmetry: the closed forms of rotations are exact there, bounds elsewhere."""
    return batch.replace(symmetry=torch.ones_like(batch.symmetry))


# --- the sum ---


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
        result = SceneElbo(PURE_BOUND).evaluate(model.story, model.guide, scene, scenes=2)
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
    result = SceneElbo(weights).evaluate(model.story, model.guide, scene, scenes=2, decode=0)
    assert set(result.terms) == {"shape_inclusive", "box", "orientation_inclusive"}
    total = sum(weights[name] * float(value) for name, value in result.terms.items())
    assert float(result.loss) == pytest.approx(-total / 2, rel=1e-13)


# --- closed forms against samples ---


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
        result = SceneElbo(weights).evaluate(model.story, model.guide, scene, decode=0)
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
    torch.testing.assert_close(terms_of(model, scene, decode=2)["voxels"], known[:2].sum() * 5 / 2, rtol=1e-12, atol=0)
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


# --- against Pyro's own bounds ---


def pyro_losses(elbo: object, model: Nolbo, scene: ObservedScene, copies: int, runs: int) -> Tensor:
    """Pyro's loss of the story and the guide, many copies at a time, a number a copy and run."""
    many = repeat_scene(scene, copies)
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("error")
        return torch.tensor([elbo.loss(model.story, model.guide, many) / copies for _ in range(runs)])  # type: ignore[attr-defined]


def decode_none(model: Nolbo) -> Nolbo:
    """Make story and guide take the same arguments, as Pyro's bounds require."""
    story = model.story.forward
    guide = model.guide.forward
    model.story.forward = lambda scene, decode=0: story(scene, decode)  # type: ignore[method-assign]
    model.guide.forward = lambda scene, decode=0: guide(scene)  # type: ignore[method-assign]
    return model


@pytest.mark.parametrize("form", FORMS)
def test_agrees_with_pyros_own_bound(form: str) -> None:
    """Pyro's bound, on the same story and guide and without a warning, estimates the same number."""
    config = tiny_config(orientation=form)
    model = tiny_model(config)
    batch = unsymmetric(random_batch(config, scenes=1, objects=2, seed=5)).replace(noise=None)
    scene = observed_scene(config, batch)
    expected = -sum(terms_of(model, scene, decode=0).values())
    losses = pyro_losses(Trace_ELBO(max_plate_nesting=2), decode_none(model), scene, 200, 20)
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
    decode_none(model)
    many = repeat_scene(scene, 200)
    story, guide = (poutine.block(part, hide=["objectness"]) for part in (model.story, model.guide))
    elbo = TraceMeanField_ELBO(max_plate_nesting=2)
    with torch.no_grad():
        losses = torch.tensor([elbo.loss(story, guide, many) / 200 for _ in range(20)])
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
    losses = pyro_losses(TraceEnum_ELBO(max_plate_nesting=2), decode_none(model), scene, 200, 20)
    assert_within(losses, expected, slack=1e-9)


# --- a missing label, by hand ---


def gaussian_kl(loc: Tensor, scale: Tensor, mean: Tensor) -> Tensor:
    """KL(N(loc, scale^2) || N(mean, 1)), written out again."""
    return (0.5 * (scale**2 + (loc - mean) ** 2 - 1) - torch.log(scale)).sum(-1)


@pytest.mark.parametrize("sharp", [1.0, 400.0])
def test_missing_category_is_summed_out(sharp: float) -> None:
    config = tiny_config()
    model = tiny_model(config)
    batch = random_batch(config, objects=2, seed=1)
    batch.category[0, 1] = batch.category[1, 0] = -1
    scene = observed_scene(config, batch)
    scene.posterior.label_logits = scene.posterior.label_logits * sharp
    found = terms_of(model, scene, decode=0)
    q = scene.posterior
    mean = model.story.prior.category_mean().detach()
    shape_kl, label_kl = torch.zeros(()), torch.zeros(())
    for b in range(2):
        for m in range(2):
            each = torch.stack([gaussian_kl(q.shape_loc[b, m], q.shape_scale[b, m], mu) for mu in mean])
            if batch.category[b, m] >= 0:
                shape_kl += each[batch.category[b, m]]
                continue
            p = torch.softmax(q.label_logits[b, m], -1)
            shape_kl += (p * each).sum()
            label_kl += torch.special.xlogy(p, p).sum() + math.log(4)
    torch.testing.assert_close(found["shape_kl"], -shape_kl, rtol=1e-12, atol=0)
    torch.testing.assert_close(found["label_kl"], -label_kl, rtol=1e-12, atol=1e-14)


def test_best_label_posterior_gives_the_log_sum() -> None:
    """With q(l | I) proportional to exp(-KL_l) the two terms are the log of the averaged exp(-KL_l)."""
    config = tiny_config()
    model = tiny_model(config)
    batch = random_batch(config, scenes=1, slots=1)
    batch.category[:] = -1
    scene = observed_scene(config, batch)
    q = scene.posterior
    mean = model.story.prior.category_mean().detach()
    kl = torch.stack([gaussian_kl(q.shape_loc[0, 0], q.shape_scale[0, 0], mu) for mu in mean])
    q.label_logits = -kl[None, None]
    found = terms_of(model, scene, decode=0)
    best = torch.logsumexp(-kl - math.log(4), -1)
    torch.testing.assert_close(found["shape_kl"] + found["label_kl"], best)
    q.label_logits = q.label_logits + 0.3 * torch.randn(1, 1, 4)
    worse = terms_of(model, scene, decode=0)
    assert float(worse["shape_kl"] + worse["label_kl"]) < float(best)


def test_instances_by_hand() -> None:
    """Split latent, two prior networks; known and missing instances, known and missing categories."""
    config = instance_config()
    model = tiny_model(config)
    batch = random_batch(config, scenes=1, slots=5, seed=4)
    batch.category[0] = torch.tensor([2, 2, -1, 0, 3])
    batch.instance[0] = torch.tensor([1, -1, -1, -1, 4])
    scene = observed_scene(config, batch)
    found = terms_of(model, scene, decode=0)
    q = scene.posterior
    category, instance = (x.detach() for x in (model.story.prior.category(), model.story.prior.instance()))
    belongs = {0: [], 1: [0], 2: [1, 2, 3], 3: [4]}

    def by_category(m: int) -> list[Tensor]:
        return [gaussian_kl(q.shape_loc[0, m, :2], q.shape_scale[0, m, :2], mean) for mean in category]

    def over_instances(m: int, c: int) -> tuple[Tensor, Tensor, Tensor]:
        """E_q(i|l)[KL_i], KL(q(i|l) || p(i|l)), and the log sum both must add up to."""
        means = [*instance[belongs[c]], torch.zeros(2)]
        kl = torch.stack([gaussian_kl(q.shape_loc[0, m, 2:], q.shape_scale[0, m, 2:], mean) for mean in means])
        p = torch.full((len(means),), 1 / len(means))
        posterior = torch.softmax(p.log() - kl, -1)
        return (posterior * kl).sum(), (posterior * (posterior / p).log()).sum(), -torch.logsumexp(p.log() - kl, -1)

    shape = sum(by_category(m)[c] for m, c in ((0, 2), (1, 2), (3, 0), (4, 3)))
    label = torch.softmax(q.label_logits[0, 2], -1)
    shape += (label * torch.stack(by_category(2))).sum()
    own = gaussian_kl(q.shape_loc[0, 0, 2:], q.shape_scale[0, 0, 2:], instance[1])
    own += gaussian_kl(q.shape_loc[0, 4, 2:], q.shape_scale[0, 4, 2:], instance[4])
    names = torch.zeros(())
    for m, c, weight in ((1, 2, 1.0), (3, 0, 1.0), *((2, c, float(label[c])) for c in range(4))):
        expected, kl, log_sum = over_instances(m, c)
        torch.testing.assert_close(expected + kl, log_sum)
        own, names = own + weight * expected, names + weight * kl
    torch.testing.assert_close(found["shape_kl"], -shape)
    torch.testing.assert_close(found["instance_kl"], -own)
    torch.testing.assert_close(found["instance_label_kl"], -names)
    torch.testing.assert_close(found["label_kl"], -(label * (label * 4).log()).sum())


def test_gradients_with_missing_instances_are_finite() -> None:
    config = instance_config()
    model = tiny_model(config)
    batch = random_batch(config, seed=4)
    batch.category[0, 0] = -1
    batch.instance[:] = -1
    result = SceneLoss(model.story, model.guide, SceneElbo(PURE_BOUND))(batch, decode=None)
    result.loss.backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is None or bool(torch.isfinite(parameter.grad).all()), name


# --- objectness ---


def test_objectness_in_both_directions_by_enumeration() -> None:
    config = tiny_config(objectness_epsilon=0.02)
    model = tiny_model(config)
    scene = observed_scene(config, random_batch(config))
    found = terms_of(model, scene, {"objectness", "objectness_inclusive"}, decode=0)
    q1 = torch.sigmoid(scene.encoding.objectness_logit)
    p1 = torch.where(scene.assignment.is_object, 0.98, 0.02)
    exclusive = inclusive = torch.zeros(())
    for q, p in ((q1, p1), (1 - q1, 1 - p1)):
        exclusive = exclusive + (q * (q / p).log()).sum()
        inclusive = inclusive + (p * (p / q).log()).sum()
    torch.testing.assert_close(found["objectness"], -exclusive)
    torch.testing.assert_close(found["objectness_inclusive"], -inclusive)


# --- inclusive terms ---


def test_inclusive_terms_are_the_guides_log_density_of_the_truth() -> None:
    """KL(p || q) = E_p[log p - log q], the truths being the story's own distributions, drawn by samples."""
    config = tiny_config()
    model = tiny_model(config)
    batch = unsymmetric(random_batch(config, scenes=1, slots=2, seed=8))
    scene = observed_scene(config, batch)
    found = terms_of(model, scene, set(module.INCLUSIVE_TERMS.values()), decode=0)
    q, where = scene.posterior, scene.assignment
    draws = 20000

    def check(name: str, p: dist.TorchDistribution, guide: dist.TorchDistribution) -> None:
        value = p.sample((draws,))
        log_ratio = (p.log_prob(value) - guide.log_prob(value)).reshape(draws, -1).sum(-1)
        assert_within(-log_ratio, found[name])

    def exact_posterior(y: Tensor, scale: float) -> dist.TorchDistribution:
        """By the precisions: prior 1, likelihood 1 / scale^2."""
        precision = 1 + scale**-2
        return dist.Normal(y * scale**-2 / precision, precision**-0.5).to_event(1)

    check("box_inclusive", exact_posterior(where.box_target, 0.05), dist.Normal(q.box_loc, q.box_scale).to_event(1))
    check(
        "range_inclusive",
        exact_posterior(where.range_target, 0.02),
        dist.Normal(q.range_loc, q.range_scale).to_event(1),
    )
    teacher = dist.Normal(batch.shape_loc, batch.shape_scale).to_event(1)
    check("shape_inclusive", teacher, dist.Normal(q.shape_loc, q.shape_scale).to_event(1))
    # the azimuth: normal numbers about the truth, the guide's density written out
    truth = batch.viewpoint + 0.05 * torch.randn(draws, 1, 2, 3)
    kappa = torch.linalg.vector_norm(q.azimuth_natural, dim=-1)
    direction = torch.stack((truth[..., 0].cos(), truth[..., 0].sin()), -1)
    exponent = (direction[..., None, :] * q.azimuth_natural).sum(-1)
    component = exponent - math.log(2 * math.pi) - (torch.special.i0e(kappa).log() + kappa)
    log_q = torch.logsumexp(torch.log_softmax(q.azimuth_logits, -1) + component, -1)
    log_q = log_q + dist.Normal(q.angle_loc, q.angle_scale).log_prob(truth[..., 1:]).sum(-1)
    log_p = dist.Normal(batch.viewpoint, 0.05).log_prob(truth).sum(-1)
    assert_within(-(log_p - log_q).sum((1, 2)), found["orientation_inclusive"])
    label = nn.functional.cross_entropy(q.label_logits[0], batch.category[0], reduction="sum")
    torch.testing.assert_close(found["label_inclusive"], -label)


def test_inclusive_optimum_is_the_exact_posterior() -> None:
    """A free guide trained by the inclusive terms: p(z | truth) for box and range, sigma^2 + error^2 in angle."""
    config = tiny_config(orientation="angle", orientation_scale=0.1)
    model = tiny_model(config)
    generator = torch.Generator().manual_seed(0)
    count = 6
    batch = unsymmetric(random_batch(config, scenes=1, slots=count, seed=3))
    error = 0.15 * torch.randn(1, count, 3, generator=generator)
    scene = observed_scene(config, batch.replace(viewpoint=torch.tensor([3.1, 0.2, 0.0]) + error))
    free = nn.Module()
    # one orientation for all objects, which look the same; a box of its own for each
    free.angle = nn.Parameter(torch.tensor([2.8, 0.0, 0.1]))
    free.log_kappa = nn.Parameter(torch.tensor(1.0))
    free.log_scale = nn.Parameter(torch.zeros(2))
    free.loc = nn.Parameter(torch.zeros(1, count, 4))
    free.log_box = nn.Parameter(torch.zeros(1, count, 4))

    def loss() -> ElboResult:
        direction = torch.stack((free.angle[0].cos(), free.angle[0].sin())) * free.log_kappa.exp()
        posterior = dataclasses.replace(
            scene.posterior,
            azimuth_natural=direction.expand(1, count, 1, 2),
            angle_loc=free.angle[1:].expand(1, count, 2),
            angle_scale=free.log_scale.exp().expand(1, count, 2),
            box_loc=free.loc,
            box_scale=free.log_box.exp(),
        )
        elbo = SceneElbo({"orientation_inclusive": 1.0, "box_inclusive": 1.0})
        return elbo.evaluate(model.story, model.guide, dataclasses.replace(scene, posterior=posterior), decode=0)

    optimiser = torch.optim.LBFGS(
        free.parameters(), max_iter=500, tolerance_grad=1e-10, tolerance_change=1e-15, line_search_fn="strong_wolfe"
    )

    def closure() -> Tensor:
        optimiser.zero_grad()
        value = loss().loss
        value.backward()
        return value

    optimiser.step(closure)
    mean = error.mean(1)[0]
    variance = 0.1**2 + (error - mean).square().mean(1)[0]
    y, s = scene.assignment.box_target, config.box_scale
    optimum = {
        "angle": torch.tensor([3.1, 0.2, 0.0]) + mean,
        "log_kappa": -variance[0].log(),
        "log_scale": 0.5 * variance[1:].log(),
        "loc": y / (1 + s**2),
        "log_box": torch.full_like(y, math.log(s / math.sqrt(1 + s**2))),
    }
    for name, parameter in free.named_parameters():
        torch.testing.assert_close(parameter.detach(), optimum[name], atol=2e-3, rtol=0)
    # at the exact answer itself nothing pulls
    with torch.no_grad():
        for name, parameter in free.named_parameters():
            parameter.copy_(optimum[name])
    closure()
    for name, parameter in free.named_parameters():
        assert parameter.grad is not None and bool((parameter.grad.abs() < 1e-9).all()), name


# --- masks ---


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
    fields = {f.name: torch.cat((getattr(batch, f.name)[:1], getattr(empty, f.name)[:1]))
              for f in dataclasses.fields(SceneBatch) if getattr(batch, f.name) is not None}  # fmt: skip
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
    per_slot = {f.name: getattr(batch, f.name)[:, order] for f in dataclasses.fields(SceneBatch)
                if f.name not in ("image", "intrinsics") and getattr(batch, f.name) is not None}  # fmt: skip
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
    out = dataclasses.replace(batch, **{f.name: getattr(batch, f.name).clone() for f in dataclasses.fields(SceneBatch)
                                        if getattr(batch, f.name) is not None})  # fmt: skip
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
        result = SceneLoss(model.story, model.guide, SceneElbo(EVERYTHING))(one, decode=None)
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
    batch = batch.replace(**{name: torch.zeros_like(batch.present) for name in
                             ("has_viewpoint", "has_position", "has_size", "has_voxels")})  # fmt: skip
    scene = observed_scene(config, batch)
    posterior = scene.posterior.map(lambda value: value.requires_grad_())
    result = SceneElbo(EVERYTHING).evaluate(
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


# --- gradients ---


@pytest.mark.parametrize(
    ("form", "objective"), [(form, "elbo") for form in FORMS] + [("mixture", "inclusive"), ("angle", "inclusive")]
)
def test_gradients_against_finite_differences(form: str, objective: str) -> None:
    """Along random directions, one for each part of the networks, with missing labels and fixed noise.

    Without the second look: where it looks moves with the box, and no gradient is passed through that on purpose.
    """
    config = instance_config(orientation=form, glimpse=0)
    model = tiny_model(config, scatter=0.05)
    batch = random_batch(config, scenes=1, slots=3, objects=3, seed=2)
    batch.category[0, 0] = batch.instance[0, 0] = -1
    weights = {**PURE_BOUND, "voxels": 0.01} if objective == "elbo" else {**INCLUSIVE, "instance_inclusive": 1.0}
    loss = SceneLoss(model.story, model.guide, SceneElbo(weights))

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
    expected = {"guide.encoder.stem", "guide.encoder.middle", "guide.encoder.deep", "guide.head.objectness",
                "guide.head.outputs", "story.prior"} | ({"story.decoder"} if objective == "elbo" else set())  # fmt: skip
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


# --- a story whose answer is known ---


class LinearStory(nn.Module):
    """z ~ N(0, I), y ~ N(A z + b, scale^2 I), under the names of the box."""

    def __init__(self, y: Tensor, matrix: Tensor, shift: Tensor, scale: float, closed_form: bool) -> None:
        super().__init__()
        self.y, self.matrix, self.shift, self.scale, self.closed_form = y, matrix, shift, scale, closed_form

    def expected(self, q: dist.TorchDistribution) -> Tensor:
        """E_q[log N(y; A z + b, scale^2 I)]."""
        mean = (self.matrix @ q.mean[..., None])[..., 0] + self.shift
        spread = torch.diagonal(self.matrix @ q.covariance_matrix @ self.matrix.mT, dim1=-2, dim2=-1)
        return expected_normal_log_prob(mean, spread, self.y, self.scale)

    def forward(self, scene: object, decode: int | None = None) -> None:
        with pyro.plate("scenes", len(self.y), dim=-1):
            prior = dist.MultivariateNormal(torch.zeros(2), torch.eye(2))
            z = pyro.sample("box_latent", prior)
            mean = (self.matrix @ z[..., None])[..., 0] + self.shift
            infer = {"expected_log_prob": ("box_latent", self.expected)} if self.closed_form else {}
            pyro.sample("box", dist.Normal(mean, self.scale).to_event(1), obs=self.y, infer=infer)


class LinearGuide(nn.Module):
    """An amortised full-covariance Gaussian: mean W y + c."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(2, 3))
        self.bias = nn.Parameter(torch.zeros(2))
        self.raw = nn.Parameter(torch.zeros(2, 2))

    def cholesky(self) -> Tensor:
        return torch.tril(self.raw, -1) + torch.diag_embed(torch.exp(self.raw.diagonal()))

    def forward(self, y: Tensor) -> None:
        loc = y @ self.weight.T + self.bias
        with pyro.plate("scenes", len(y), dim=-1):
            pyro.sample("box_latent", dist.MultivariateNormal(loc, scale_tril=self.cholesky().expand(len(y), 2, 2)))


@pytest.mark.parametrize(("closed_form", "steps", "tolerance"), [(True, 300, 2e-3), (False, 300, 0.08)])
def test_svi_reaches_the_exact_posterior(closed_form: bool, steps: int, tolerance: float) -> None:
    """Linear and Gaussian: SVI finds the posterior and its bound is the log evidence."""
    generator = torch.Generator().manual_seed(0)
    matrix, shift, scale = torch.randn(3, 2, generator=generator), torch.tensor([0.5, -1.0, 0.2]), 0.7
    y = torch.randn(30, 3, generator=generator) * 1.5
    story, guide = LinearStory(y, matrix, shift, scale, closed_form), LinearGuide()
    elbo = SceneElbo(PURE_BOUND)

    def loss() -> ElboResult:
        return elbo.evaluate(story, guide, y, scenes=len(y))

    config = optimisation.OptimisationConfig(
        steps=steps, learning_rate=0.05, start_rate=0.05, warmup=1, decay=0.9, weight_decay=0.0, ema=0.0
    )
    state = optimisation.init(guide, loss, config)
    for _ in range(steps):
        state, info = optimisation.step(state)
    assert set(info.terms) == {"box", "box_kl"}
    precision = torch.eye(2) + matrix.T @ matrix / scale**2
    covariance = torch.linalg.inv(precision)
    gain = covariance @ matrix.T / scale**2
    torch.testing.assert_close(guide.weight.detach(), gain, atol=tolerance, rtol=0)
    torch.testing.assert_close(guide.bias.detach(), -gain @ shift, atol=tolerance, rtol=0)
    torch.testing.assert_close((guide.cholesky() @ guide.cholesky().T).detach(), covariance, atol=tolerance, rtol=0)
    evidence = dist.MultivariateNormal(shift, matrix @ matrix.T + scale**2 * torch.eye(3)).log_prob(y).mean()
    with torch.no_grad():
        bound = -torch.stack([loss().loss for _ in range(1 if closed_form else 200)])
    if closed_form:
        assert float(bound[0]) == pytest.approx(float(evidence), abs=1e-4)
    else:
        assert_within(bound, evidence, slack=0.01)
    # a guide that is not the posterior stays below the evidence by KL(q || posterior)
    with torch.no_grad():
        guide.bias.add_(0.3)
        loc = y @ guide.weight.T + guide.bias
        story.closed_form = True
        q = dist.MultivariateNormal(loc, scale_tril=guide.cholesky().expand(30, 2, 2))
        exact = dist.MultivariateNormal((y - shift) @ gain.T, covariance)
        gap = torch.distributions.kl_divergence(q, exact).mean()
        assert float(loss().loss) == pytest.approx(float(gap - evidence), abs=1e-9)


def test_conjugate_truth_and_expectation() -> None:
    """p(z | y) by Bayes on a grid, and the expected log likelihood by quadrature."""
    y, scale = torch.tensor([0.8]), 0.6
    grid = torch.linspace(-9, 9, 20001)
    log_joint = dist.Normal(0.0, 1.0).log_prob(grid) + dist.Normal(grid, scale).log_prob(y)
    density = torch.exp(log_joint - torch.logsumexp(log_joint, 0)) / (grid[1] - grid[0])
    truth = conjugate_truth(y, scale)
    torch.testing.assert_close(truth.log_prob(grid[:, None]).exp(), density, atol=1e-9, rtol=0)
    q = dist.Normal(torch.tensor(0.3), 0.4)
    by_grid = torch.trapezoid(q.log_prob(grid).exp() * dist.Normal(grid, scale).log_prob(y), grid)
    found = expected_normal_log_prob(torch.tensor([0.3]), torch.tensor([0.16]), y, scale)
    assert float(found) == pytest.approx(float(by_grid), abs=1e-9)


# --- refusals ---


@pytest.mark.parametrize(
    ("weights", "message"),
    [({"boxes": 1.0}, "unknown term of the bound: got .*boxes.*box_kl"), ({"box": math.nan}, "weight of box"),
     ({"box": math.inf}, "weight of box.*finite")],
)  # fmt: skip
def test_bad_weights(weights: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        SceneElbo(weights)


@pytest.mark.parametrize(
    ("hide_in", "message"),
    [("guide", r"only in the story \['box_latent'\]"), ("story", r"only in the guide \['box_latent'\]")],
)
def test_disagreeing_sites(hide_in: str, message: str) -> None:
    config = tiny_config()
    model = tiny_model(config)
    scene = observed_scene(config, random_batch(config))
    hidden: Callable[..., None] = poutine.block(model.guide if hide_in == "guide" else model.story, hide=["box_latent"])
    story, guide = (model.story, hidden) if hide_in == "guide" else (hidden, model.guide)
    with pytest.raises(NolboError, match=message):
        SceneElbo().terms(story, guide, scene)


def test_paper_weights_turn_the_objectness_round() -> None:
    assert PAPER["objectness"] == 0
    assert PAPER["objectness_inclusive"] == 1
    assert {k: v for k, v in PAPER.items() if not k.startswith("objectness")} == {
        k: v for k, v in PURE_BOUND.items() if k != "objectness"
    }
