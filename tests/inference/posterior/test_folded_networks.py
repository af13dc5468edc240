"""Networks of queries: folded and laid out anew, they say what the trained ones say, and follow their weights."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Iterator

import pytest
import torch
from torch import nn

from nolbo_ppl.inference.posterior.folded_networks import (
    FoldedDecoder,
    FoldedNetworks,
    folded_detector,
    folded_guide,
    kernel_type,
    tensors_of,
)
from nolbo_ppl.models.hybrid_guide import HybridEncoding, HybridGuide
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.observation_model import Nolbo
from tests.factories import tiny_config


@pytest.fixture(autouse=True)
def single_precision() -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    yield
    torch.set_default_dtype(before)


def model_of(config: ModelConfig, seed: int = 0) -> Nolbo:
    """Random networks whose batch normalisations have learnt something; single precision."""
    model = Nolbo.from_seed(config, seed).eval().requires_grad_(False)
    g = torch.Generator().manual_seed(seed)
    for module in model.modules():
        if isinstance(module, nn.modules.batchnorm._BatchNorm):
            assert module.running_mean is not None and module.running_var is not None
            module.running_mean.copy_(0.3 * torch.randn(module.running_mean.shape, generator=g))
            module.running_var.copy_(torch.exp(torch.randn(module.running_var.shape, generator=g)))
            module.weight.copy_(torch.exp(0.3 * torch.randn(module.weight.shape, generator=g)))
            module.bias.copy_(0.3 * torch.randn(module.bias.shape, generator=g))
    return model


def picture(seed: int = 0) -> torch.Tensor:
    return torch.randint(0, 256, (2, 3, 64, 96), generator=torch.Generator().manual_seed(seed), dtype=torch.uint8)


@pytest.mark.parametrize("shape_look", [0, 32])
@pytest.mark.parametrize("detector", ["", "yolox_nano"])
def test_a_folded_guide_answers_as_its_own(detector: str, shape_look: int) -> None:
    guide = model_of(tiny_config(detector=detector, shape_look=shape_look)).guide
    if guide.shape_look is not None:
        nn.init.normal_(guide.shape_look.judge[-1].weight, std=0.3)
    fast = folded_guide(guide, torch.float32)
    region, row = torch.tensor([3, 8, 20]), torch.tensor([0, 1, 1])
    with torch.inference_mode():
        own, folded = guide.encode(picture()), fast.encode(picture())
        torch.testing.assert_close(folded.objectness_logit, own.objectness_logit, atol=1e-4, rtol=1e-4)
        a, b = guide.parameters_at(own, row, region), fast.parameters_at(folded, row, region)
    for name in ("label_logits", "shape_loc", "azimuth_natural", "box_loc", "range_loc", "range_scale"):
        torch.testing.assert_close(getattr(b, name), getattr(a, name), atol=2e-4, rtol=2e-4, msg=name)
    if isinstance(guide, HybridGuide):
        assert isinstance(own, HybridEncoding) and isinstance(folded, HybridEncoding)
        assert own.fused is not None and folded.fused is not None
        torch.testing.assert_close(folded.fused.label_logits, own.fused.label_logits, atol=1e-3, rtol=1e-3)
    assert guide.encoder is not fast.encoder and guide.head is fast.head


@pytest.mark.parametrize("patches", [True, False])
def test_a_folded_decoder_decodes_the_same_shapes(patches: bool) -> None:
    decoder = model_of(tiny_config(voxel_patches=patches)).story.decoder
    z = torch.randn(5, decoder.dense.in_features, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        own = decoder(z)
        torch.testing.assert_close(FoldedDecoder(decoder, torch.float32)(z), own, atol=1e-4, rtol=1e-4)
        short = FoldedDecoder(decoder, torch.bfloat16)(z)  # eight bits of mantissa, a few layers
    assert short.dtype == torch.float32 and float((short - own).abs().max()) < 0.05 * float(own.abs().max())


def test_changed_weights_are_followed_and_others_run_as_they_are() -> None:
    model = model_of(tiny_config())
    networks, z = FoldedNetworks(model), torch.zeros(1, model.config.latent_dim)
    first = networks.decoder
    assert networks.decoder is first and isinstance(first, FoldedDecoder)
    with torch.no_grad():
        model.story.decoder.dense.bias.add_(0.5)
    assert networks.decoder is not first
    torch.testing.assert_close(networks.decoder(z), model.story.decoder(z), atol=0.1, rtol=0.1)
    again = pickle.loads(pickle.dumps(networks))
    torch.testing.assert_close(again.decoder(z), networks.decoder(z))
    assert copy.deepcopy(networks).model is not model
    double = FoldedNetworks(copy.deepcopy(model).double())
    assert double.decoder is double.model.story.decoder and double.guide is double.model.guide
    assert kernel_type() in (torch.float32, torch.bfloat16)


def test_weights_replaced_moved_or_of_another_mode_are_followed() -> None:
    model = model_of(tiny_config())
    networks = FoldedNetworks(model)
    before = networks.current()
    assert networks.current() == before
    head = model.guide.head.objectness
    head.weight = nn.Parameter(head.weight + 1, requires_grad=False)  # replaced
    assert networks.guide is not before.guide
    before = networks.current()
    head.weight.data = head.weight.data.clone()  # moved
    assert networks.guide is not before.guide
    before = networks.current()
    model.guide.head.objectness = nn.Linear(head.in_features, head.out_features).requires_grad_(False)  # type: ignore[assignment]
    assert networks.guide is not before.guide and networks.guide.head.objectness is model.guide.head.objectness
    before = networks.current()
    next(iter(model.guide.encoder.buffers())).add_(0.1)  # written, a running mean
    assert networks.guide is not before.guide and networks.decoder is not before.decoder
    model.train()
    assert networks.guide is model.guide
    model.eval()
    assert networks.guide is not model.guide


def test_every_weight_is_looked_at() -> None:
    model = model_of(tiny_config(detector="yolox_nano", shape_look=32))
    expected = {id(one) for one in (*model.guide.parameters(), *model.guide.buffers())}
    assert {id(one) for one in tensors_of(model.guide)} == expected


def test_a_folded_detector_predicts_the_same() -> None:
    guide = model_of(tiny_config(detector="yolox_nano")).guide
    assert isinstance(guide, HybridGuide)
    own, fast = guide.detector(picture().float()), folded_detector(guide.detector)(picture().float())
    for name in ("box", "objectness", "classes", "features"):
        torch.testing.assert_close(getattr(fast, name), getattr(own, name), atol=1e-3, rtol=1e-4, msg=name)
