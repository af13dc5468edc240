"""What networks start from: of the head of others, all that does not describe the shape latent."""

from __future__ import annotations

import pytest
import torch

from nolbo_ppl.errors import InputError
from nolbo_ppl.training.initial_weights import adopt_detection
from nolbo_ppl.training.train_config import TrainConfig
from tests.factories import random_batch, tiny_config, tiny_model

STATED = ("angle_scale", "box_loc", "box_scale", "range_loc", "range_scale")
DESCRIBED = ("label_logits", "azimuth_logits", "azimuth_natural", "angle_loc")
"""What methods without categories and viewpoints do not state."""


@pytest.mark.parametrize(("method", "latent_dim"), [("nolbo", 4), ("vvae", 6), ("single", 9)])
def test_all_but_the_latent_is_answered_alike(method: str, latent_dim: int) -> None:
    """Whatever its method and dimensions, a model states objects, boxes, ranges, categories and viewpoints as the initial one."""
    initial = tiny_model(tiny_config(), seed=4, scatter=0.3)
    model = tiny_model(tiny_config(method=method, latent_dim=latent_dim), seed=5, scatter=0.3)
    parts = ("story.prior.", "shape_guide.posterior")
    untouched = {name: value.clone() for name, value in model.state_dict().items() if name.startswith(parts)}
    first = model.guide.head.sizes[0]
    latent_rows = slice(first, first + 2 * latent_dim)
    rows_before = model.guide.head.outputs[-1].weight.detach()[latent_rows].clone()
    adopt_detection(model, initial)
    image = random_batch(initial.config, 2).image
    row, region = torch.tensor([0, 0, 1, 1]), torch.tensor([0, 1, 2, 3])  # both predictors of a cell
    answers = []
    with torch.no_grad():
        for one in (initial.eval(), model.eval()):
            encoding = one.guide.encode(image)
            answers.append((encoding.objectness_logit, one.guide.parameters_at(encoding, row, region)))
    (logit, given), (own_logit, own) = answers
    torch.testing.assert_close(own_logit, logit)
    for name in (*STATED, *(DESCRIBED if model.config.description.describes else ())):
        torch.testing.assert_close(getattr(own, name), getattr(given, name), msg=name)
    torch.testing.assert_close(model.guide.head.outputs[-1].weight.detach()[latent_rows], rows_before)
    for name, value in untouched.items():
        torch.testing.assert_close(model.state_dict()[name], value)


def test_heads_of_other_sizes_are_refused() -> None:
    with pytest.raises(InputError, match="head of the initial weights"):
        adopt_detection(tiny_model(tiny_config(head_width=8)), tiny_model(tiny_config()))
    with pytest.raises(InputError, match="features of the initial weights"):
        adopt_detection(tiny_model(tiny_config(encoder_channels=(4, 6, 8, 16))), tiny_model(tiny_config()))
    assert TrainConfig(method="vvae", initial="tiny", initial_part="detection", latent_dim=8).model().latent_dim == 8
