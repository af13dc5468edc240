"""Objectness in both directions, and the inclusive terms."""

from __future__ import annotations

import dataclasses
import math

import pyro.distributions as dist
import torch
from torch import Tensor, nn

from nolbo_ppl.inference import elbo as module
from nolbo_ppl.inference.elbo import (
    ElboResult,
    SceneELBO,
)
from tests.bound_cases import terms_of, unsymmetric
from tests.factories import (
    assert_within,
    observed_scene,
    random_batch,
    tiny_config,
    tiny_model,
)


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
        elbo = SceneELBO({"orientation_inclusive": 1.0, "box_inclusive": 1.0})
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
