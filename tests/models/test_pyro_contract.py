"""What Pyro makes of models works on the generative model: Predictive, uncondition, render_model, prior predictive draws."""

from __future__ import annotations

import math

import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro import poutine
from pyro.infer import Predictive
from pyro.infer.inspect import get_model_relations
from scipy.stats import chisquare, kstest

from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.camera import project
from nolbo_ppl.geometry.rotation import matrix_to_viewpoint, viewpoint_to_matrix
from nolbo_ppl.models.prior_predictive import blank_scene, prior_predictive
from tests.factories import assert_within, instance_config, observed_scene, random_batch, tiny_config, tiny_model

LATENT = ("shape_latent", "orientation_latent", "box_latent", "range_latent")


@pytest.mark.parametrize("parallel", [False, True])
@pytest.mark.parametrize("instances", [False, True])
def test_predictive_draws_the_prior(parallel: bool, instances: bool) -> None:
    """Draws of the prior, one by one or all at once, have its shapes and its means; voxels are those of the draws."""
    config = instance_config() if instances else tiny_config()
    model = tiny_model(config).eval()
    scene = observed_scene(config, random_batch(config, scenes=2, slots=3, objects=2))
    torch.manual_seed(0)
    draws = 60 if parallel else 6
    unlabelled = poutine.uncondition(model.story)
    found = Predictive(unlabelled, num_samples=draws, parallel=parallel)(scene)
    assert found["box"].shape[0] == draws and found["box"].shape[-3:] == (2, 3, 4)
    assert found["rotation"].shape[-4:] == (2, 3, 3, 3)
    assert found["voxels"].shape[0] == draws and found["voxels"].shape[-4:] == (4, 32, 32, 32)
    if not parallel:
        return
    means = model.story.prior.category_mean().detach()[found["label"]]
    assert_within((found["shape_latent"] - means).flatten(1, -2), 0.0)
    assert_within(found["box_latent"].flatten(1), 0.0)
    latent = found["shape_latent"]
    if instances:
        latent = torch.cat((latent, found["instance_latent"]), -1)
    with torch.no_grad():
        logits = model.story.decoder(latent[:, [0, 0, 1, 1], [0, 1, 0, 1]].flatten(0, 1)).unflatten(0, (draws, 4))
    log_prob = dist.Bernoulli(logits=logits).log_prob(found["voxels"].reshape(draws, 4, 32, 32, 32)).sum((-3, -2, -1))
    entropy = dist.Bernoulli(logits=logits).entropy().sum((-3, -2, -1))
    assert_within(log_prob + entropy, 0.0)


def test_predictive_of_the_guide() -> None:
    """Posterior draws: the guide's latent samples, sent through the model."""
    config = tiny_config()
    model = tiny_model(config).eval()
    scene = observed_scene(config, random_batch(config, scenes=1, slots=2).replace(noise=None))
    for parallel in (False, True):
        found = Predictive(model.story, guide=model.guide, num_samples=40, parallel=parallel, return_sites=LATENT)(scene)
        assert_within(found["shape_latent"].reshape(40, 2, -1), scene.posterior.shape_loc[0])
        assert_within(found["box_latent"].reshape(40, 2, -1), scene.posterior.box_loc[0])


def test_relations_of_the_sites() -> None:
    """What `render_model` draws: which site hangs on which, and in which plates."""
    config = tiny_config()
    scene = observed_scene(config, random_batch(config, scenes=2, slots=2))
    found = get_model_relations(tiny_model(config).story, model_args=(scene,))
    parents = {site: {p for p in found["sample_sample"][site] if p != site} for site in found["sample_sample"]}
    assert parents["box"] == {"box_latent"}
    assert parents["range"] == {"range_latent"}
    assert parents["rotation"] == {"orientation_latent"}
    assert parents["voxels"] == {"shape_latent"}
    assert set(found["observed"]) >= {"box", "range", "rotation", "voxels", "label"}
    assert set(found["plate_sample"]["regions"]) == {"objectness"}


def test_render_model() -> None:
    pytest.importorskip("graphviz")
    config = tiny_config()
    scene = observed_scene(config, random_batch(config, scenes=1, slots=1))
    drawn = pyro.render_model(tiny_model(config).story, model_args=(scene,), render_distributions=True)
    for site in (*LATENT, "box", "range", "rotation", "voxels", "objectness"):
        assert site in drawn.source
    assert "SymmetricMatrixFisher" in drawn.source


def test_prior_predictive_draws_whole_objects() -> None:
    """Shape, pose and box as the generative model says, by its own priors and affine maps."""
    config = tiny_config()
    model = tiny_model(config).train()
    state, before = torch.get_rng_state(), {k: v.clone() for k, v in model.state_dict().items()}
    n = 400
    objects = prior_predictive(model.story, n, seed=3)
    assert torch.equal(torch.get_rng_state(), state) and model.story.training
    assert all(torch.equal(v, before[k]) for k, v in model.state_dict().items())
    assert torch.equal(objects.box, prior_predictive(model.story, n, seed=3).box)
    assert not torch.equal(objects.box, prior_predictive(model.story, n, seed=4).box)
    counts = torch.bincount(objects.category, minlength=4)
    assert chisquare(counts.numpy()).pvalue > 1e-3
    assert_within(objects.shape_latent - model.story.prior.category_mean().detach()[objects.category], 0.0)
    p = objects.voxel_probability
    assert_within((objects.voxels - p).sum((1, 2, 3)), 0.0)
    assert set(objects.voxels.unique().tolist()) == {0.0, 1.0}
    azimuth = matrix_to_viewpoint(objects.R_camera_object)[:, 0]
    assert kstest((azimuth.numpy() + math.pi) / (2 * math.pi), "uniform").pvalue > 1e-3
    # box: the middle cell, log sizes about box_loc with the spread of box_spread
    size = torch.log((objects.box[:, 2:] - objects.box[:, :2]) / config.stride)
    assert_within(size, config.box_loc[2])
    assert float(size.std()) == pytest.approx(config.box_spread[2] * math.sqrt(1 + config.box_scale**2), rel=0.1)
    assert_within(torch.log(objects.diagonal), config.range_loc[3])
    # the position is seen where range_loc says: about the box's centre, offsets in box sizes
    assert bool((objects.position[:, 2] > 0).all())
    camera = torch.tensor([32.0, 32.0, 32.0, 32.0]).expand(n, 4)
    offset = (project(objects.position, camera) - (objects.box[:, :2] + objects.box[:, 2:]) / 2) / (
        objects.box[:, 2:] - objects.box[:, :2]
    )
    assert_within(offset, 0.0)
    assert float(offset.std()) == pytest.approx(config.range_spread[1], rel=0.1)


def test_prior_predictive_of_given_labels_and_viewpoints() -> None:
    config = instance_config()
    model = tiny_model(config)
    category, viewpoint = torch.tensor([0, 2, 2]), torch.tensor([[0.3, 0.2, 0.1], [3.1, 0.0, 0.0], [-2.0, 0.5, 0.0]])
    objects = prior_predictive(model.story, 3, 0, category, viewpoint)
    assert torch.equal(objects.category, category)
    assert objects.shape_latent.shape == (3, config.latent_dim)
    misfit = 3 - (objects.R_camera_object * viewpoint_to_matrix(viewpoint)).sum((-2, -1))
    assert bool((misfit < 0.3).all()), "scale 0.05 rad of the latent, 0.05 rad of the rotation"
    with pytest.raises(InputError, match="category of each object: got 3, expected 2 rows"):
        prior_predictive(model.story, 2, 0, category)
    with pytest.raises(InputError, match="at least 1"):
        prior_predictive(model.story, 0, 0)


def test_a_blank_scene_goes_through_the_guide_too() -> None:
    """Model and guide take the same arguments; of no image the guide answers the prior, and the bound of it is finite."""
    config = tiny_config()
    model = tiny_model(config)
    scene = blank_scene(config, torch.zeros(2, 3), torch.tensor([0, 3]))
    trace = poutine.trace(model.guide).get_trace(scene, decode=0)
    assert set(LATENT) <= set(trace.nodes)
    assert scene.left_out.sum() == 0
