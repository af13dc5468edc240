"""Networks grown into larger ones: what they compute before any further step."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from nolbo_ppl.errors import InputError
from nolbo_ppl.models.model_config import ModelConfig, nano
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.training.net2net import grow, grown_config
from tests.factories import random_batch, tiny_config, tiny_model

LOOK: dict[str, Any] = {"glimpse_maps": 3, "glimpse_blocks": 2, "glimpse_detail": True}


def enlarged(config: ModelConfig, **changes: Any) -> ModelConfig:
    """The same with larger fields."""
    return ModelConfig.from_json({**config.to_json(), **changes})


def shaken(model: Nolbo, seed: int) -> Nolbo:
    """Statistics and weights away from where they start, so that no layer is an identity by chance."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, value in model.state_dict().items():
            if value.is_floating_point() and "running_var" not in name:
                value += 0.1 * torch.randn(value.shape, generator=generator, dtype=value.dtype)
    return model.eval()


@pytest.mark.parametrize("blocks", [0, 1])
def test_a_grown_second_look_sees_what_it_saw(blocks: int) -> None:
    model = shaken(tiny_model(tiny_config(glimpse_blocks=blocks), scatter=0.3), 1)
    config = grown_config(model.config, enlarged(model.config, **LOOK))
    larger = grow(model, config, seed=7).eval()
    assert larger.config.glimpse_blocks == 2 and larger.config.latent_dim == model.config.latent_dim
    batch = random_batch(model.config, 3, 4, objects=3, seed=5)
    before, after = model.guide.observe(batch), larger.guide.observe(batch)
    torch.testing.assert_close(after.encoding.objectness_logit, before.encoding.objectness_logit)
    for name in ("label_logits", "shape_loc", "shape_scale", "azimuth_natural", "box_loc", "range_scale"):
        torch.testing.assert_close(getattr(after.posterior, name), getattr(before.posterior, name), msg=name)
    for a, b in zip(model.story.state_dict().values(), larger.story.state_dict().values(), strict=True):
        assert torch.equal(a, b)


def test_new_encoder_blocks_only_repeat_the_activation() -> None:
    model = shaken(tiny_model(scatter=0.3), 2)
    n4, n8, n16 = model.config.encoder_blocks
    larger = grow(model, grown_config(model.config, enlarged(model.config, encoder_blocks=(n4, n8, n16 + 2))), seed=3).eval()
    image = random_batch(model.config, 2, 3, seed=4).image.to(torch.get_default_dtype())
    before, after = model.guide.encoder(image)[1], larger.guide.encoder(image)[1]
    torch.testing.assert_close(after[1], before[1])
    twice = torch.where(before[2] < 0, before[2] * 0.1 * 0.1, before[2])
    torch.testing.assert_close(after[2], twice)
    assert float((before[2] < 0).double().mean()) > 0.1


def test_every_new_weight_learns() -> None:
    """Zeros are no dead ends: after two steps along the gradient all new weights have one."""
    model = tiny_model(scatter=0.3)
    larger = grow(model, grown_config(model.config, enlarged(model.config, **LOOK)), seed=7)
    new = set(dict(larger.named_parameters())) - set(dict(model.named_parameters()))
    optimizer = torch.optim.SGD(larger.parameters(), 1e-3)
    for _ in range(2):
        optimizer.zero_grad()
        posterior = larger.guide.observe(random_batch(model.config, 3, 4, objects=3, seed=5)).posterior
        (posterior.label_logits.square().sum() + posterior.shape_loc.square().sum()).backward()
        optimizer.step()
    still = [name for name in new if not float(larger.get_parameter(name).grad.abs().sum()) > 0]
    assert new and not still


def test_refusals() -> None:
    with pytest.raises(InputError, match="encoder_blocks of networks to grow"):
        grown_config(tiny_config(encoder_blocks=(1, 1, 3)), tiny_config(encoder_blocks=(1, 1, 2)))
    with pytest.raises(InputError, match="no RoI refinement"):
        grown_config(tiny_config(glimpse=0), nano())
