"""The head: where each output goes, and the limits of what comes out."""

from __future__ import annotations

import dataclasses
import math

import torch

from nolbo_ppl.models.head import RegionHead
from nolbo_ppl.models.observed_scene import RegionParameters
from tests.factories import instance_config, tiny_config, tiny_model


def test_outputs_are_split_without_gap_or_overlap() -> None:
    """Each raw output moves one parameter only, but for the label logits, which move the shape's mean as well."""
    config = tiny_config()
    head = RegionHead(10, config, (6, 8), (4, 8)).double()
    raw = torch.zeros(sum(head.sizes), requires_grad=True)
    prior_mean = torch.randn(4, config.latent_dim)
    q = head.parameters_of(raw, prior_mean)
    touched = {}
    for field in dataclasses.fields(RegionParameters):
        value = getattr(q, field.name)
        (gradient,) = torch.autograd.grad(value.sum(), raw, retain_graph=True)
        rows = torch.autograd.functional.jacobian(
            lambda r, n=field.name: getattr(head.parameters_of(r, prior_mean), n).flatten(), raw
        )
        touched[field.name] = set((rows != 0).any(0).nonzero().flatten().tolist())
        assert bool(torch.isfinite(gradient).all())
    labels = touched["label_logits"]
    assert labels == set(range(4))
    assert labels < touched["shape_loc"]
    touched["shape_loc"] -= labels
    everything = [index for indices in touched.values() for index in indices]
    assert sorted(everything) == list(range(sum(head.sizes)))


def test_start_of_the_azimuth_modes_and_of_the_boxes() -> None:
    """Features that say nothing: modes a quarter turn apart, and predictors of different sizes."""
    config = tiny_config(azimuth_components=4, predictors=3)
    head = RegionHead(10, config, (6, 8), (4, 8)).double()
    torch.nn.init.zeros_(head.outputs[-1].weight)
    torch.nn.init.zeros_(head.outputs[-1].bias)
    q = head.parameters_of(head(torch.randn(10)), torch.zeros(4, config.latent_dim))
    angle = torch.atan2(q.azimuth_natural[..., 1], q.azimuth_natural[..., 0])
    expected = torch.arange(4) * (math.pi / 2)
    torch.testing.assert_close(angle.cos(), expected.cos().expand(3, 4), atol=1e-6, rtol=0)
    torch.testing.assert_close(angle.sin(), expected.sin().expand(3, 4), atol=1e-6, rtol=0)
    torch.testing.assert_close(q.azimuth_natural.norm(dim=-1), torch.ones(3, 4), atol=1e-6, rtol=0)
    assert torch.equal(q.box_loc, torch.tensor([[0.0, 0, -1, -1], [0, 0, 0, 0], [0, 0, 1, 1]]))
    assert bool((q.shape_loc == 0).all())


def test_shape_mean_is_the_expected_prior_mean_plus_a_residual() -> None:
    config = instance_config()
    model = tiny_model(config)
    head = model.guide.head
    raw = torch.zeros(sum(head.sizes))
    raw[2] = 60.0  # sure of category 2
    residual = torch.tensor([0.1, 0.2, 0.3, 0.4])
    raw[4:8] = residual
    prior_mean = model.story.prior.label_mean().detach()
    q = head.parameters_of(raw, prior_mean)
    torch.testing.assert_close(q.shape_loc, prior_mean[2] + residual)
    assert bool((prior_mean[:, 2:] == 0).all()), "the instance half of a category's mean is zero"


def test_at_the_mode_the_likeliest_category_has_the_mean() -> None:
    """Hesitating between two categories, the mean lies between theirs; at the mode it is one's own, residual and all."""
    config = tiny_config()
    model = tiny_model(config)
    prior_mean = model.story.prior.label_mean().detach()
    raw = torch.zeros(2, sum(model.guide.head.sizes), dtype=torch.float64)
    raw[0, :4] = torch.tensor([0.0, 3.0, 2.8, -9.0])
    raw[1, :4] = torch.tensor([0.0, 3.0, 3.2, -9.0])
    residual = torch.tensor([[0.1, -0.2, 0.3, 0.4], [0.5, 0.6, -0.7, 0.8]]).double()
    raw[:, 4:8] = residual
    q = model.guide.head.parameters_of(raw, prior_mean)
    mode = q.at_map_category(prior_mean)
    torch.testing.assert_close(mode.shape_loc, prior_mean[[1, 2]] + residual)
    assert not torch.allclose(mode.shape_loc, q.shape_loc)
    assert mode.shape_scale is q.shape_scale and mode.label_logits is q.label_logits


def test_scales_are_positive_and_bounded_for_any_output() -> None:
    config = tiny_config()
    head = RegionHead(10, config, (6, 8), (4, 8)).double()
    for size in (1e6, -1e6):
        q = head.parameters_of(torch.full((sum(head.sizes),), size), torch.zeros(4, config.latent_dim))
        for name, low, high in (
            ("shape_scale", -4, 2),
            ("angle_scale", -3, 1.5),
            ("box_scale", -5, 3),
            ("range_scale", -5, 3),
        ):
            unit = 1.0 if name == "shape_scale" else 0.3
            expected = unit * math.exp(high if size > 0 else low)
            torch.testing.assert_close(getattr(q, name), torch.full_like(getattr(q, name), expected))


def test_map_touches_every_parameter() -> None:
    head = RegionHead(10, tiny_config(), (6, 8), (4, 8)).double()
    q = head.parameters_of(torch.randn(3, sum(head.sizes)), torch.zeros(4, 4))
    first = q.map(lambda value: value[:1])
    for field in dataclasses.fields(RegionParameters):
        assert torch.equal(getattr(first, field.name), getattr(q, field.name)[:1])


def test_objectness_starts_low() -> None:
    """A scene is mostly background: the bias keeps the first steps from drowning in it."""
    model = tiny_model().eval().requires_grad_(False)
    logit = model.guide.encode(torch.randint(0, 256, (2, 3, 64, 64), dtype=torch.uint8)).objectness_logit
    assert float(logit.mean()) < -3
