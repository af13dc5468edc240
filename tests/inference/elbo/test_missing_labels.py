"""Missing categories and instances, summed out by hand."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from nolbo_ppl.inference.elbo import (
    PURE_BOUND,
    SceneELBO,
    SceneLoss,
)
from tests.bound_cases import terms_of
from tests.factories import (
    instance_config,
    observed_scene,
    random_batch,
    tiny_config,
    tiny_model,
)


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
    result = SceneLoss(model.story, model.guide, SceneELBO(PURE_BOUND))(batch, decode=None)
    result.loss.backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is None or bool(torch.isfinite(parameter.grad).all()), name
