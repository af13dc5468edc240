"""The RoI refinement: the grid over a box, bilinear samples against an independent sampler, its place in the guide."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from nolbo_ppl.errors import InputError
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.roi_refinement import MARGIN, MIN_SIDE, RoiRefinementBlock, roi_grid, sample_map
from nolbo_ppl.models.scene_batch import decode_box, encode_box
from tests.factories import random_batch, tiny_config, tiny_model


def test_the_grid_covers_the_enlarged_box() -> None:
    box = torch.tensor([[10.0, 20.0, 50.0, 30.0]])
    points = roi_grid(box, 4)[0]
    assert points.shape == (4, 4, 2)
    torch.testing.assert_close(points.mean((0, 1)), torch.tensor([30.0, 25.0]))
    step = points[:, 1:, 0] - points[:, :-1, 0]
    torch.testing.assert_close(step, torch.full((4, 3), 40 * MARGIN / 4))
    assert float(points[0, 0, 1]) == pytest.approx(25 - 12 * 3 / 8)
    small = roi_grid(torch.tensor([[5.0, 5, 5, 5]]), 2)[0]
    assert float(small[0, 1, 0] - small[0, 0, 0]) == pytest.approx(MIN_SIDE / 2)


@pytest.mark.parametrize("stride", [4, 8])
def test_samples_equal_torch_grid_sample(stride: int) -> None:
    """`grid_sample` with border padding is an independent bilinear sampler; points beyond the image are among them."""
    generator = torch.Generator().manual_seed(stride)
    maps = torch.randn(3, 5, 6, 9, generator=generator, dtype=torch.float64)
    row = torch.tensor([2, 0, 0, 1])
    points = torch.rand(4, 40, 2, generator=generator, dtype=torch.float64) * torch.tensor([9.0, 6.0]) * stride * 1.4 - stride
    ours = sample_map(maps, row, points, stride)
    unit = points / (torch.tensor([9.0, 6.0], dtype=torch.float64) * stride) * 2 - 1
    theirs = torch.nn.functional.grid_sample(maps[row], unit[:, None], padding_mode="border", align_corners=False)
    torch.testing.assert_close(ours, theirs[:, :, 0].transpose(1, 2))


def test_samples_pass_gradients() -> None:
    maps = torch.randn(2, 2, 3, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64, requires_grad=True)
    row, points = torch.tensor([1, 0]), torch.tensor([[[3.0, 5.0], [30.0, -2.0]], [[9.1, 9.2], [0.0, 23.0]]]).double()
    assert torch.autograd.gradcheck(lambda m: sample_map(m, row, points, 8), (maps,))


def test_a_map_of_one_cell_is_constant() -> None:
    maps = torch.tensor([[[[2.5]]]])
    torch.testing.assert_close(sample_map(maps, torch.tensor([0]), torch.rand(1, 7, 2) * 40, 16), torch.full((1, 7, 1), 2.5))


@pytest.mark.parametrize("changes", [{}, {"glimpse_maps": 3, "glimpse_blocks": 1, "glimpse_detail": True}])
def test_the_second_look_keeps_the_box_and_sees_only_its_surroundings(changes: dict[str, Any]) -> None:
    """Outputs other than the box change, and they depend on the maps within the enlarged box alone."""
    model = tiny_model(tiny_config(**changes), scatter=0.3).eval()
    head = model.guide.head
    batch = random_batch(tiny_config(), 2, 3, objects=2, seed=4)
    encoding = model.guide.encode(batch.image)
    row, cell = torch.tensor([1]), torch.tensor([5])
    raw = head(encoding.features[row, cell])[:, 0]
    fine = [m.detach().clone().requires_grad_() for m in encoding.fine]
    refined = head.refine(raw, fine, row, cell, encoding.columns)
    torch.testing.assert_close(head.box_latent(refined), head.box_latent(raw))
    first = sum(head.sizes[:4])
    assert not torch.allclose(refined[:, :first], raw[:, :first])
    refined.sum().backward()
    box = decode_box(head.box_latent(raw), cell, encoding.columns, model.config)[0].detach()
    half = (box[2:] - box[:2]).mul(MARGIN).clamp_min(MIN_SIDE) / 2
    low, high = (box[:2] + box[2:]) / 2 - half, (box[:2] + box[2:]) / 2 + half
    used_maps = model.config.glimpse_maps
    assert all(m.grad is None for m in fine[used_maps:])
    for m, stride in zip(fine[:used_maps], model.guide.encoder.fine_strides):
        assert float(m.grad[0].abs().sum()) == 0, "another image"
        used = m.grad[1].abs().sum(0).nonzero()[:, [1, 0]]
        assert len(used)
        centre = (used + 0.5) * stride
        inside = ((centre >= low.clamp_min(0) - stride) & (centre <= high + stride)).all(-1)
        size = torch.tensor([m.shape[3], m.shape[2]])
        border = ((used == 0) | (used == size - 1)).any(-1)
        assert bool((inside | border).all())


def test_objects_are_refined_the_same_alone_and_in_company() -> None:
    """The batched path of training and the path of queries give the same posterior."""
    model = tiny_model(scatter=0.3).eval()
    batch = random_batch(tiny_config(), 3, 4, objects=3, seed=5)
    scene = model.guide.observe(batch)
    for b, m in scene.assignment.assigned.nonzero().tolist():
        region = scene.assignment.cell[b, m] * model.config.predictors + scene.assignment.predictor[b, m]
        alone = model.guide.parameters_at(scene.encoding, torch.tensor([b]), region[None])
        torch.testing.assert_close(alone.shape_loc[0], scene.posterior.shape_loc[b, m])
        torch.testing.assert_close(alone.azimuth_natural[0], scene.posterior.azimuth_natural[b, m])


def test_a_given_box_is_looked_at_instead_of_the_own_one() -> None:
    """The own box given changes nothing; at another one the outputs are the cell's plus what the glimpse adds there."""
    model = tiny_model(scatter=0.3).eval()
    guide, head = model.guide, model.guide.head
    encoding = guide.encode(random_batch(tiny_config(), 2, 3, objects=2, seed=4).image)
    row, region = torch.tensor([0, 1]), torch.tensor([3, 10])
    cell = region // model.config.predictors
    own = guide.parameters_at(encoding, row, region)
    box = decode_box(own.box_loc, cell, encoding.columns, model.config)
    same = guide.parameters_at(encoding, row, region, box=box)
    torch.testing.assert_close(same.label_logits, own.label_logits)
    given = box + torch.tensor([4.0, -3.0, 9.0, 6.0])
    other = guide.parameters_at(encoding, row, region, box=given)
    torch.testing.assert_close(other.box_loc, own.box_loc)
    raw = head(encoding.features[row, cell])[torch.arange(2), region % model.config.predictors]
    change = head.glimpse(encoding.fine, row, given, encode_box(given, cell, encoding.columns, model.config).clamp(-8, 8))
    labels = len(model.config.categories)
    torch.testing.assert_close(other.label_logits, raw[:, :labels] + change[:, :labels])
    assert not torch.allclose(other.label_logits, own.label_logits)


def test_configurations_without_a_second_look() -> None:
    model = tiny_model(tiny_config(glimpse=0)).eval()
    assert model.guide.head.glimpse is None
    scene = model.guide.observe(random_batch(tiny_config(), 2, 3))
    assert bool(torch.isfinite(scene.posterior.shape_loc).all())
    with pytest.raises(InputError, match="RoI refinement of darknet19"):
        ModelConfig(encoder="darknet19", image_size=448)
    with pytest.raises(InputError, match="multiple of 4"):
        tiny_config(glimpse_width=6)
    with pytest.raises(InputError, match="glimpse_maps"):
        tiny_config(glimpse_maps=4)


def test_blocks_of_the_second_look_start_as_the_identity_and_learn() -> None:
    block = RoiRefinementBlock(8)
    x = torch.randn(2, 8, 5, 5, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(block(x), x, rtol=0, atol=0)
    block(x).square().sum().backward()
    assert float(block.branch[-1].weight.grad.abs().sum()) > 0


def test_details_are_sampled_twice_as_densely() -> None:
    """With everything but the detail's kernel silenced, each cell of the look holds the mean of its own 2 x 2 samples."""
    config = tiny_config(glimpse_detail=True)
    glimpse = tiny_model(config).guide.head.glimpse
    width, side = config.glimpse_width, config.glimpse
    fine = torch.randn(1, config.encoder_channels[1], 12, 12, generator=torch.Generator().manual_seed(2))
    box, row = torch.tensor([[7.0, 9.0, 35.0, 40.0]]), torch.tensor([0])
    kernel = torch.zeros_like(glimpse.detail.weight)
    kernel[:, 0, 1:3, 1:3] = 0.25
    seen: list[torch.Tensor] = []
    with torch.no_grad():
        glimpse.detail.weight.copy_(kernel)
        glimpse.look[0].weight.zero_()
        glimpse.look[1].register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
        glimpse([fine, torch.zeros(1, config.encoder_channels[2], 6, 6)], row, box, torch.zeros(1, 4))
    points = roi_grid(box, side)
    offset = (box[:, 2:] - box[:, :2]) * MARGIN / side / 4
    corners = [points + offset * torch.tensor([a, b]) for a in (-1.0, 1.0) for b in (-1.0, 1.0)]
    expected = sum(sample_map(fine, row, c.flatten(1, 2), 4)[..., 0] for c in corners) / 4
    torch.testing.assert_close(seen[0], expected.view(1, 1, side, side).expand(1, width, side, side))


@pytest.mark.parametrize(("images", "rows"), [(1, [0, 0, 0]), (3, [0, 1, 2]), (2, [1, 0, 1]), (3, [2, 0])])
def test_queries_sample_what_training_does(images: int, rows: list[int]) -> None:
    g = torch.Generator().manual_seed(0)
    maps, row = torch.randn(images, 5, 6, 9, generator=g), torch.tensor(rows)
    points = 90 * torch.rand(len(rows), 40, 2, generator=g) - 10  # some beyond the border
    trained = sample_map(maps, row, points, 8)
    with torch.no_grad():
        torch.testing.assert_close(sample_map(maps, row, points, 8), trained, atol=1e-10, rtol=1e-10)
