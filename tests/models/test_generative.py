"""The generative story: its sites, its truths, and simulation-based calibration of its conjugate parts."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pyro
import pytest
import torch
from pyro import poutine
from scipy.stats import chisquare

from nolbo_ppl.geometry.rotation import geodesic_angle, viewpoint_to_matrix
from nolbo_ppl.models.generative import conjugate_target
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.observed_scene import ObservedScene
from tests.factories import instance_config, observed_scene, random_batch, repeat_scene, tiny_config, tiny_model


def trace_of(config: ModelConfig, scene: ObservedScene, **kwargs: Any) -> poutine.Trace:
    """Trace of the story alone, sampled from its prior."""
    model = tiny_model(config)
    with torch.no_grad():
        return poutine.trace(model.story).get_trace(scene, **kwargs)


def test_sites_and_their_shapes() -> None:
    config = instance_config()
    batch = random_batch(config, 2, 3, objects=2)
    trace = trace_of(config, observed_scene(config, batch))
    sites = {
        n: tuple(s["fn"].batch_shape)
        for n, s in trace.nodes.items()
        if s["type"] == "sample" and type(s["fn"]).__name__ != "_Subsample"
    }
    objects = (2, 3)
    assert sites == {
        "objectness": (2, 32),
        "label": objects,
        "shape_latent": objects,
        "instance": objects,
        "instance_latent": objects,
        "orientation_latent": objects,
        "rotation": objects,
        "box_latent": objects,
        "box": objects,
        "range_latent": objects,
        "range": objects,
        "voxels": (4,),
    }
    assert len(pyro.get_param_store()) == 0, "no parameter enters the global store"


def test_objectness_prior() -> None:
    config = tiny_config(objectness_epsilon=0.07)
    scene = observed_scene(config, random_batch(config))
    site = trace_of(config, scene, decode=0).nodes["objectness"]
    expected = torch.where(scene.assignment.is_object, 0.93, 0.07)
    torch.testing.assert_close(site["fn"].probs, expected)


def test_truth_of_a_conjugate_site_is_its_posterior() -> None:
    config = tiny_config()
    scene = observed_scene(config, random_batch(config))
    trace = trace_of(config, scene, decode=0)
    for name, scale in (("box", config.box_scale), ("range", config.range_scale)):
        truth = trace.nodes[f"{name}_latent"]["infer"]["target"]
        observed = trace.nodes[name]["value"]
        precision = 1 + scale**-2
        torch.testing.assert_close(truth.mean, observed * scale**-2 / precision)
        torch.testing.assert_close(truth.variance, torch.full_like(observed, 1 / precision))


@pytest.mark.parametrize(("name", "scale"), [("box", 0.5), ("range", 0.3)])
def test_simulation_based_calibration(name: str, scale: float) -> None:
    """Latent and observation from the story itself: the latent's rank among posterior draws is uniform (chi-square)."""
    torch.manual_seed(4)
    config = tiny_config(box_scale=scale, range_scale=scale)
    scene = repeat_scene(observed_scene(config, random_batch(config, scenes=1, slots=2)), 400)
    model = tiny_model(config)
    with torch.no_grad():
        trace = poutine.trace(poutine.uncondition(model.story)).get_trace(scene, decode=0)
    latent, observed = trace.nodes[f"{name}_latent"]["value"], trace.nodes[name]["value"]
    assert abs(float((observed - latent).std()) - scale) < 5 * scale / math.sqrt(2 * observed.numel())
    draws = conjugate_target(observed, scale).sample((19,))
    rank = (draws < latent).sum(0).flatten().numpy()
    counts = np.bincount(rank, minlength=20)
    assert counts.sum() == 400 * 2 * 4
    assert chisquare(counts).pvalue > 1e-3
    # the test can fail: a posterior a fifth too narrow is found out
    narrow = conjugate_target(observed, scale).mean + 0.8 * (draws - conjugate_target(observed, scale).mean)
    wrong = np.bincount((narrow < latent).sum(0).flatten().numpy(), minlength=20)
    assert chisquare(wrong).pvalue < 1e-3


@pytest.mark.parametrize("form", ["mixture", "sincos"])
def test_observed_rotation_of_a_simulated_scene(form: str) -> None:
    """From the story: the orientation latent scatters by its scale, the rotation by the matrix Fisher's about it."""
    torch.manual_seed(5)
    config = tiny_config(orientation=form)
    batch = random_batch(config, scenes=1, slots=1)
    batch = batch.replace(symmetry=torch.ones_like(batch.symmetry))
    scene = repeat_scene(observed_scene(config, batch), 3000)
    model = tiny_model(config)
    with torch.no_grad():
        trace = poutine.trace(poutine.uncondition(model.story)).get_trace(scene, decode=0)
    R = trace.nodes["rotation"]["value"]
    torch.testing.assert_close(R @ R.mT, torch.eye(3).expand_as(R))
    value = trace.nodes["orientation_latent"]["value"]
    angles = torch.atan2(value[..., 0], value[..., 1]) if form == "sincos" else value
    turn = geodesic_angle(viewpoint_to_matrix(angles), R)
    # three axes of variance 1 / (2 kappa) each, to the order of 1 / kappa
    expected = 3 / (2 * config.rotation_concentration)
    assert float(turn.square().mean()) == pytest.approx(expected, rel=0.1)


def test_voxels_are_decoded_from_the_objects_that_have_them() -> None:
    config = tiny_config()
    batch = random_batch(config, 2, 3, objects=2)
    batch.has_voxels[0, 0] = False
    scene = observed_scene(config, batch)
    assert trace_of(config, scene).nodes["voxels"]["fn"].batch_shape == (3,)
    assert trace_of(config, scene, decode=2).nodes["voxels"]["scale"] == pytest.approx(1.5)
    assert "voxels" not in trace_of(config, scene, decode=0).nodes
    none = batch.replace(has_voxels=torch.zeros_like(batch.has_voxels))
    assert "voxels" not in trace_of(config, observed_scene(config, none)).nodes
