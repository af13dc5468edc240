"""The network that knows generated scenes beside the detector: what `tiny` says, and never trained."""

from __future__ import annotations

import torch

from nolbo_ppl.inference.elbo import INCLUSIVE, SceneELBO, SceneLoss
from nolbo_ppl.models.backbones import normalise_image
from nolbo_ppl.models.hybrid_guide import HybridGuide
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.scene_batch import decode_box
from nolbo_ppl.models.scene_network import PREFIX, scene_weights_of
from tests.factories import random_batch, tiny_config

PLAIN = tiny_config()
CONFIG = tiny_config(detector="yolox_nano")


def guide_of(model: Nolbo) -> HybridGuide:
    assert isinstance(model.guide, HybridGuide)
    return model.guide


def test_it_says_what_the_initial_network_says_of_a_whole_image() -> None:
    """Objectness, category and box of every region, as the other guide gives them without its RoI refinement."""
    initial, model = Nolbo.from_seed(PLAIN, 1).double().eval(), Nolbo.from_seed(CONFIG, 2).double().eval()
    state = model.state_dict()
    own = scene_weights_of(initial.state_dict(), list(state))
    assert own.keys() == {name for name in state if name.startswith(PREFIX)}
    model.load_state_dict({**state, **own})
    image = torch.randint(0, 256, (2, 3, 64, 96), dtype=torch.uint8, generator=torch.Generator().manual_seed(3))
    says = guide_of(model).scene(normalise_image(image, torch.float64))
    encoding = initial.guide.encode(image)
    row, region = (encoding.objectness_logit > -torch.inf).nonzero(as_tuple=True)
    q = initial.guide.parameters_at(encoding, row, region, look=False)
    box = decode_box(q.box_loc, region // CONFIG.predictors, encoding.columns, CONFIG)
    torch.testing.assert_close(says.log_odds, encoding.objectness_logit)
    torch.testing.assert_close(says.labels[row, region], torch.log_softmax(q.label_logits, -1))
    torch.testing.assert_close(says.box[row, region], box)


def test_training_leaves_it_and_the_detector_as_they_are() -> None:
    model = Nolbo.from_seed(CONFIG, 0).train()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    loss = SceneLoss(model.story, model.guide, SceneELBO(INCLUSIVE))
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-3)
    loss(random_batch(CONFIG)).loss.backward()
    optimizer.step()
    changed = {name for name, value in model.state_dict().items() if not torch.equal(value, before[name])}
    assert any(name.startswith("guide.encoder.") for name in changed)
    assert not any(name.startswith((PREFIX, "guide.detector.")) for name in changed)
