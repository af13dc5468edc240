"""The whole observation model: independent copies, and a generative model that knows nothing of its guide."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys

import pytest
import torch

from nolbo_ppl.models.observation_model import Nolbo
from tests.factories import instance_config, random_batch, tiny_model


@pytest.mark.parametrize("way", ["deepcopy", "pickle"])
def test_a_copy_is_whole_and_independent(way: str) -> None:
    """The copy answers the same, its guide sees its own prior, and its training leaves the original alone."""
    config = instance_config()
    model = tiny_model(config, scatter=0.1).eval()
    batch = random_batch(config)
    before = model.guide.observe(batch).posterior.shape_loc.detach()
    twin: Nolbo = copy.deepcopy(model) if way == "deepcopy" else pickle.loads(pickle.dumps(model))
    assert torch.equal(twin.guide.observe(batch).posterior.shape_loc.detach(), before)
    assert set(twin.state_dict()) == set(model.state_dict())
    originals = {id(p) for p in model.parameters()} | {p.data_ptr() for p in model.parameters()}
    assert not any(id(p) in originals or p.data_ptr() in originals for p in twin.parameters())
    with torch.no_grad():
        for parameter in twin.story.prior.parameters():
            parameter.add_(1.0)
    assert torch.equal(model.guide.observe(batch).posterior.shape_loc.detach(), before)
    # the guide's latent follows the prior of its own copy: the expected prior mean is part of its own mean
    assert not torch.allclose(twin.guide.observe(batch).posterior.shape_loc.detach(), before)


def test_the_generative_model_does_not_import_the_guide() -> None:
    code = "import sys, nolbo_ppl.models.generative; print([m for m in sys.modules if m.startswith('nolbo_ppl.models')])"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "nolbo_ppl.models.observed_scene" in loaded
    for module in ("guide", "head", "backbones", "roi_refinement"):
        assert f"'nolbo_ppl.models.{module}'" not in loaded
