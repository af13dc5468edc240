"""Objects are cut out of the image as it was given, where that is larger than what the network sees whole."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nolbo_ppl.inference.posterior import preprocess as preprocessing
from nolbo_ppl.inference.posterior.predictor import ObservationModel, detail_of
from nolbo_ppl.inference.posterior.preprocess import DETAIL, PADDING, preprocess, same_shape
from nolbo_ppl.models.crops import BOX_SIDE, SIDE, cut_out, cut_out_detailed, image_levels
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.observed_scene import Detail
from tests.factories import random_batch, tiny_config, tiny_model


def model_with(detector: str = "", shape_look: int = 32) -> Nolbo:
    model = tiny_model(tiny_config(detector=detector, shape_look=shape_look), scatter=0.3).eval()
    if model.guide.shape_look is not None:
        with torch.no_grad():
            model.guide.shape_look.judge[-1].weight.normal_(std=0.3, generator=torch.Generator().manual_seed(1))
    return model


@pytest.mark.parametrize(
    ("given", "sides", "factor"),
    [((1000, 600), (832, 512), 2.0), ((500, 500), (500, 500), 500 / 416), ((440, 300), None, 1.0), ((200, 100), None, 1.0)],
)
def test_what_is_kept(given: tuple[int, int], sides: tuple[int, int] | None, factor: float) -> None:
    """Twice the size, or the image itself; nothing where it is hardly larger; the same place in both."""
    x, y = np.meshgrid(np.arange(given[0]), np.arange(given[1]))
    image = np.stack((255 * x / given[0], 255 * y / given[1], 0 * x), -1).astype(np.uint8)
    one = preprocess(image, None, 416, detailed=True)
    assert one.detail_factor == pytest.approx(factor) and preprocess(image, None, 416).detail is None
    if sides is None:
        assert one.detail is None
        return
    assert one.detail is not None and one.detail.shape == (3, sides[1], sides[0])
    at = torch.tensor([[120.0, 150.0], [300.0, 200.0]])  # x, y, px of the network's image
    for column, row in at.tolist():
        small = one.image[:2, int(row), int(column)].double()
        large = one.detail[:2, int((row + 0.5) * factor), int((column + 0.5) * factor)].double()
        assert float((small - large).abs().max()) <= 2.0
    inside = round(one.extent[1] * factor)
    assert bool((one.detail[:, inside + 1 :] == PADDING).all())


def test_crops_are_of_the_same_place() -> None:
    """On an image whose colours are its coordinates."""
    y, x = torch.meshgrid(torch.arange(384) + 0.5, torch.arange(384) + 0.5, indexing="ij")
    large = torch.stack((x, y, x + y))[None] / 2  # coordinates in px of the smaller image
    small = torch.nn.functional.avg_pool2d(large, 2)
    box, row = torch.tensor([[60.0, 70.0, 104.0, 92.0], [30.0, 20.0, 150.0, 140.0]]), torch.tensor([0, 0])
    plain = cut_out(image_levels(small), row, box)
    fine = cut_out_detailed(image_levels(large), torch.tensor([2.0]), row, box)
    torch.testing.assert_close(fine.factor, plain.factor)
    torch.testing.assert_close(fine.box, plain.box)
    middle = slice(SIDE // 4, 3 * SIDE // 4)
    torch.testing.assert_close(fine.image[..., middle, middle], plain.image[..., middle, middle], atol=0.3, rtol=0)
    assert float((plain.box[:, 2:] - plain.box[:, :2]).max()) == pytest.approx(BOX_SIDE)
    same = cut_out_detailed(image_levels(small), None, row, box)
    torch.testing.assert_close(same.image, plain.image)


@pytest.mark.parametrize("detector", ["", "yolox_nano"])
def test_a_larger_image_without_more_in_it_says_the_same(detector: str) -> None:
    """Every pixel four times: its half is the image, of which large objects are cut out as before."""
    guide = model_with(detector).guide
    image = random_batch(tiny_config(), 2, 3, seed=1).image
    twice = image.repeat_interleave(2, 2).repeat_interleave(2, 3)
    row, region = torch.tensor([0, 1]), torch.tensor([5, 12])
    box = torch.tensor([[0.0, 0, 64, 60], [0, 0, 60, 64]])
    with torch.no_grad():
        plain = guide.parameters_at(guide.encode(image), row, region, box=box)
        same = guide.parameters_at(guide.encode(image, Detail(image, torch.ones(2))), row, region, box=box)
        larger = guide.parameters_at(guide.encode(image, Detail(twice, torch.full((2,), 2.0))), row, region, box=box)
    for name in ("shape_loc", "azimuth_natural", "range_loc", "label_logits", "box_loc"):
        torch.testing.assert_close(getattr(same, name), getattr(plain, name), msg=name)
        torch.testing.assert_close(getattr(larger, name), getattr(plain, name), msg=name)


def test_queries_see_the_details() -> None:
    """Two pictures that are alike at the network's size, different at their own: a stripe pattern that averages out."""
    model = ObservationModel(model_with())
    rng = np.random.default_rng(0)
    base = rng.integers(60, 190, (64, 64, 3), dtype=np.uint8).repeat(2, 0).repeat(2, 1)
    stripes = base.copy().astype(int)
    stripes[:, 0::2] += 40
    stripes[:, 1::2] -= 40
    boxes = [np.array([[40.0, 40, 70, 66]])]  # 15 px at the network's size, 25 in the crop
    plain, fine = (model.observe_boxes([i.astype(np.uint8)], None, boxes, decode=False)[0] for i in (base, stripes))
    np.testing.assert_allclose(fine.class_log_posterior, plain.class_log_posterior, atol=0.05)
    assert np.abs(fine.latent - plain.latent).max() > 0.01
    without = ObservationModel(model_with(shape_look=0))
    plain, fine = (without.observe_boxes([i.astype(np.uint8)], None, boxes, decode=False)[0] for i in (base, stripes))
    np.testing.assert_allclose(fine.latent, plain.latent, atol=0.05)


def test_batches_of_large_details_are_small(monkeypatch: pytest.MonkeyPatch) -> None:
    images = [preprocess(np.zeros((100, 200, 3), np.uint8), None, 96, detailed=True) for _ in range(5)]
    assert images[0].detail is not None and images[0].detail_factor == pytest.approx(min(200 / 96, DETAIL[1]))
    assert same_shape(images, 4) == [[0, 1, 2, 3], [4]]
    found = detail_of(images[:4])
    assert found is not None and len(found.image) == 4 and found.factor.tolist() == pytest.approx([2.0] * 4)
    pixels = images[0].detail.shape[1] * images[0].detail.shape[2]
    monkeypatch.setattr(preprocessing, "DETAIL_PIXELS", 2 * pixels + 1)
    assert same_shape(images, 4) == [[0, 1], [2, 3], [4]]
    small = preprocess(np.zeros((50, 96, 3), np.uint8), None, 96, detailed=True)
    assert same_shape([*images[:1], small], 4) == [[0], [1]] and detail_of([small]) is None
