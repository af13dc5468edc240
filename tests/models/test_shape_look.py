"""The look at shapes: nothing before training, the shape latent alone after it, from the object's own pixels."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from nolbo_ppl.errors import InputError
from nolbo_ppl.models.crops import cut_out, image_levels
from nolbo_ppl.models.model_config import nano, paper
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.observed_scene import RegionParameters
from nolbo_ppl.models.scene_batch import decode_box
from nolbo_ppl.models.shape_look import BOX_SHARE, CONTEXT_SCALE, ShapeLook
from tests.factories import random_batch, tiny_config, tiny_model

SIDE = 32
DETECTORS = ("", "yolox_nano")


def look_of(model: Nolbo) -> ShapeLook:
    assert model.guide.shape_look is not None
    return model.guide.shape_look


def shaken(model: Nolbo, seed: int = 0) -> Nolbo:
    """With a last layer that says something."""
    g = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in look_of(model).judge[-1].parameters():
            parameter.add_(0.3 * torch.randn(parameter.shape, generator=g))
    return model


def with_look(detector: str, scatter: float = 0.3) -> Nolbo:
    return tiny_model(tiny_config(shape_look=SIDE, detector=detector), scatter=scatter).eval()


def differing(a: RegionParameters, b: RegionParameters) -> set[str]:
    return {f.name for f in dataclasses.fields(a) if not torch.equal(getattr(a, f.name), getattr(b, f.name))}


@pytest.mark.parametrize("detector", DETECTORS)
def test_a_fresh_look_changes_nothing_and_a_learnt_one_the_shape_alone(detector: str) -> None:
    model = with_look(detector)
    plain = tiny_model(tiny_config(detector=detector)).eval()
    own = model.state_dict()
    plain.load_state_dict({name: value for name, value in own.items() if not name.startswith("guide.shape_look.")})
    batch = random_batch(tiny_config(), 2, 3, seed=2)
    row, region = torch.tensor([0, 1, 1]), torch.tensor([3, 8, 20])
    with torch.no_grad():
        without = plain.guide.parameters_at(plain.guide.encode(batch.image), row, region)
        scene_without = plain.guide.observe(batch).posterior
        encoding = model.guide.encode(batch.image)
        assert not differing(model.guide.parameters_at(encoding, row, region), without)
        assert not differing(model.guide.observe(batch).posterior, scene_without)
        shaken(model)
        assert differing(model.guide.parameters_at(encoding, row, region), without) == {"shape_loc", "shape_scale"}
        assert differing(model.guide.observe(batch).posterior, scene_without) == {"shape_loc", "shape_scale"}
        # boxes are asked for without looks
        assert not differing(
            model.guide.parameters_at(encoding, row, region, look=False),
            plain.guide.parameters_at(plain.guide.encode(batch.image), row, region, look=False),
        )


@pytest.mark.parametrize("detector", DETECTORS)
def test_what_is_added_is_what_the_look_says_of_the_box(detector: str) -> None:
    """By hand: the crop through encoder and layers, added to the mean of the plain answer."""
    model = with_look(detector)
    guide, look = model.guide, look_of(model)
    batch = random_batch(tiny_config(), 2, 3, seed=3)
    row, region = torch.tensor([0, 1]), torch.tensor([3, 10])
    box = torch.tensor([[10.0, 12, 40, 30], [5, 30, 60, 62]])
    heard: list[torch.Tensor] = []
    look.judge[0].register_forward_pre_hook(lambda module, inputs: heard.append(inputs[0]))
    with torch.no_grad():
        encoding = guide.encode(batch.image)
        before = guide.parameters_at(encoding, row, region, box=box)
        shaken(model, 5)
        after = guide.parameters_at(encoding, row, region, box=box)
        crop = cut_out(encoding.levels, row, box, SIDE, BOX_SHARE * SIDE).image
        cells = look.narrow(look.encoder(crop)[0]).flatten(1)
        torch.testing.assert_close(heard[-1][:, : cells.shape[1]], cells)
        context = CONTEXT_SCALE * torch.atanh(heard[-1][:, cells.shape[1] :])
        labels = len(model.config.categories)
        torch.testing.assert_close(context[:, :labels], before.label_logits)
        expected = look.judge(heard[-1])
    d = model.config.latent_dim
    torch.testing.assert_close(after.shape_loc - before.shape_loc, expected[:, :d])
    assert bool((after.shape_scale != before.shape_scale).all())


def test_training_and_queries_look_alike() -> None:
    model = shaken(with_look(""))
    scene = model.guide.observe(random_batch(tiny_config(), 3, 4, objects=3, seed=5))
    assert bool(scene.assignment.assigned.any())
    for b, m in scene.assignment.assigned.nonzero().tolist():
        region = scene.assignment.cell[b, m] * model.config.predictors + scene.assignment.predictor[b, m]
        alone = model.guide.parameters_at(scene.encoding, torch.tensor([b]), region[None])
        torch.testing.assert_close(alone.shape_loc[0], scene.posterior.shape_loc[b, m])
        torch.testing.assert_close(alone.shape_scale[0], scene.posterior.shape_scale[b, m])


def test_it_looks_at_the_crop_and_nowhere_else() -> None:
    model = shaken(with_look(""))
    look = look_of(model)
    image = torch.randn(1, 3, 64, 64, generator=torch.Generator().manual_seed(1)).requires_grad_(False)
    row, box = torch.tensor([0]), torch.tensor([[20.0, 20, 42, 42]])  # of the crop's own size: cut from the image itself
    raw = torch.zeros(1, sum(model.guide.head.sizes))
    with torch.no_grad():
        said = look(image_levels(image), row, box, raw)
        reach = SIDE / (BOX_SHARE * SIDE / 22) / 2
        outside = image.clone()
        low, high = int(31 - reach - 2), int(31 + reach + 3)
        outside[..., :low, :] = 5.0
        outside[..., high:, :] = 5.0
        outside[..., :low] = 5.0
        outside[..., high:] = 5.0
        torch.testing.assert_close(look(image_levels(outside), row, box, raw), said)
        inside = image.clone()
        inside[..., 25:37, 25:37] = 5.0
        assert not torch.allclose(look(image_levels(inside), row, box, raw), said, atol=1e-3)


def test_an_object_says_the_same_wherever_it_stands() -> None:
    """Moved by whole pixels, or drawn twice as large: the crop is the same picture (larger ones are means of four pixels)."""
    model = shaken(with_look(""))
    look = look_of(model)
    g = torch.Generator().manual_seed(2)
    thing = torch.randn(1, 3, 30, 30, generator=g)
    first, moved = torch.zeros(1, 3, 128, 128), torch.zeros(1, 3, 128, 128)
    first[..., 10:40, 10:40], moved[..., 50:80, 60:90] = thing, thing
    large = torch.nn.functional.interpolate(first, scale_factor=2.0, mode="nearest")
    box = torch.tensor([[14.0, 14, 36, 36]])
    raw, row = torch.zeros(1, sum(model.guide.head.sizes)), torch.tensor([0])
    with torch.no_grad():
        said = look(image_levels(first), row, box, raw)
        torch.testing.assert_close(look(image_levels(moved), row, box + torch.tensor([50.0, 40, 50, 40]), raw), said)
        torch.testing.assert_close(look(image_levels(large), row, 2 * box, raw), said)


def test_no_gradient_goes_into_what_the_guide_said() -> None:
    model = shaken(with_look(""))
    raw = torch.randn(2, sum(model.guide.head.sizes)).requires_grad_(True)
    image = torch.randn(1, 3, 64, 64)
    change = look_of(model)(image_levels(image), torch.zeros(2, dtype=torch.long), torch.tensor([[4.0, 4, 30, 40]] * 2), raw)
    change.sum().backward()
    assert raw.grad is None
    assert all(p.grad is not None for p in look_of(model).parameters())


def test_scenes_without_objects() -> None:
    model = with_look("").train()
    batch = random_batch(tiny_config(), 2, 3, objects=0)
    assert not model.guide.observe(batch).assignment.assigned.any()
    none = torch.zeros(0, dtype=torch.long)
    assert len(model.guide.parameters_at(model.guide.encode(batch.image), none, none).shape_loc) == 0


def test_boxes_of_predictions_are_cut_out_in_training() -> None:
    """Not the true ones, which nobody knows later on."""
    model = with_look("")
    seen: list[torch.Tensor] = []
    look_of(model).register_forward_pre_hook(lambda module, inputs: seen.append(inputs[2]))
    scene = model.guide.observe(random_batch(tiny_config(), 2, 3, seed=7))
    where = scene.assignment
    chosen = where.assigned
    own = decode_box(scene.posterior.box_loc[chosen], where.cell[chosen], scene.encoding.columns, model.config)
    torch.testing.assert_close(seen[-1], own)


def test_configurations() -> None:
    with pytest.raises(InputError, match="shape_look"):
        dataclasses.replace(nano(), shape_look=40)
    with pytest.raises(InputError, match="look at shapes"):
        dataclasses.replace(paper(), shape_look=96)
