"""From labels to what the story observes: boxes, ranges, cells, packed voxels, and back."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from nolbo_ppl.geometry.camera import project
from nolbo_ppl.models.scene_batch import (
    SceneBatch,
    cell_centre,
    cell_of,
    decode_box,
    decode_range,
    encode_box,
    encode_range,
    grid_size,
    pack_bits,
    pixels_per_radian,
    unpack_bits,
)
from tests.factories import random_batch, tiny_config

CONFIG = tiny_config()


def flat(batch: SceneBatch) -> dict[str, torch.Tensor]:
    """Objects of a batch in one row."""
    camera = batch.intrinsics[:, None].expand(-1, batch.present.shape[1], -1)
    values = {"box": batch.box, "position": batch.position, "diagonal": batch.diagonal, "camera": camera}
    return {name: value.flatten(0, 1) for name, value in values.items()}


def test_cells() -> None:
    box = torch.tensor([[0.0, 0, 10, 10], [15.9, 0, 16.0, 10], [16.0, 31, 16.0, 33], [60.0, 60, 70, 70], [-9.0, 0, 1, 1]])
    assert cell_of(box, 4, 4, 16).tolist() == [0, 0, 9, 15, 0]
    torch.testing.assert_close(
        cell_centre(torch.tensor([0, 5, 11]), 4, 16, torch.float64), torch.tensor([[8.0, 8.0], [24.0, 24.0], [56.0, 40.0]])
    )
    assert grid_size(64, 96, CONFIG) == (4, 6)


def test_box_round_trip_and_by_hand() -> None:
    data = flat(random_batch(CONFIG, 3, 4))
    cell = cell_of(data["box"], 4, 4, 16)
    latent = encode_box(data["box"], cell, 4, CONFIG)
    torch.testing.assert_close(decode_box(latent, cell, 4, CONFIG), data["box"])
    # centre half a stride to the right of cell 5's, 32 px wide, 8 px high
    one = encode_box(torch.tensor([[16.0, 20.0, 48.0, 28.0]]), torch.tensor([5]), 4, CONFIG)[0]
    raw = torch.tensor([0.5, 0.0, math.log(2.0), math.log(0.5)])
    torch.testing.assert_close(one, (raw - torch.tensor(CONFIG.box_loc)) / torch.tensor(CONFIG.box_spread))


def test_decoded_boxes_stay_finite() -> None:
    box = decode_box(torch.full((2, 4), 1e4) * torch.tensor([[1.0], [-1.0]]), torch.tensor([0, 1]), 4, CONFIG)
    assert bool(torch.isfinite(box).all())
    assert float(box[0, 2] - box[0, 0]) == pytest.approx(16 * math.exp(6))


def test_range_round_trip() -> None:
    data = flat(random_batch(CONFIG, 3, 4, seed=2))
    latent = encode_range(data["position"], data["diagonal"], data["box"], data["camera"], CONFIG)
    position, diagonal = decode_range(latent, data["box"], data["camera"], CONFIG)
    torch.testing.assert_close(position, data["position"])
    torch.testing.assert_close(diagonal, data["diagonal"])
    raw = latent * torch.tensor(CONFIG.range_spread) + torch.tensor(CONFIG.range_loc)
    distance = data["position"].norm(dim=-1)
    torch.testing.assert_close(raw[:, 0].exp() * pixels_per_radian(data["position"], data["camera"]), distance)
    centre = (data["box"][:, :2] + data["box"][:, 2:]) / 2
    size = data["box"][:, 2:] - data["box"][:, :2]
    torch.testing.assert_close(centre + raw[:, 1:3] * size, project(data["position"], data["camera"]))
    torch.testing.assert_close(raw[:, 3], data["diagonal"].log())


def test_pixels_per_radian_are_those_of_a_small_cone() -> None:
    """Against the area in pixels of a small cone about the ray, over its solid angle."""
    camera = torch.tensor([[300.0, 280.0, 64.0, 60.0]]).double()
    generator = torch.Generator().manual_seed(0)
    for slope in ((0.0, 0.0), (0.9, -0.2), (-0.4, 1.1)):
        ray = torch.tensor([*slope, 1.0]).double()
        ray = ray / ray.norm()
        side = torch.linalg.cross(ray, torch.tensor([0.3, 1.0, -0.2]).double())
        side = side / side.norm()
        other = torch.linalg.cross(ray, side)
        turn = torch.rand(1, generator=generator).double() * 2 * math.pi + torch.linspace(0, 2 * math.pi, 721).double()
        radius = 1e-4
        rim = ray + radius * (turn.cos()[:, None] * side + turn.sin()[:, None] * other)
        x, y = (rim[:, :2] / rim[:, 2:] * camera[0, :2]).unbind(-1)
        area = 0.5 * (x[:-1] * y[1:] - x[1:] * y[:-1]).sum().abs()  # the shoelace formula
        expected = torch.sqrt(area / (math.pi * radius**2))
        torch.testing.assert_close(pixels_per_radian(3 * ray[None], camera)[0], expected, rtol=1e-4, atol=0)


def test_range_does_not_depend_on_the_scale_of_the_image() -> None:
    """The same scene at twice the resolution has the same targets up to the range's share of log 2 in focal lengths."""
    data = flat(random_batch(CONFIG, 2, 4, seed=5))
    once = encode_range(data["position"], data["diagonal"], data["box"], data["camera"], CONFIG)
    twice = encode_range(data["position"], data["diagonal"], 2 * data["box"], 2 * data["camera"], CONFIG)
    shift = torch.zeros(4)
    shift[0] = -math.log(2) / CONFIG.range_spread[0]
    torch.testing.assert_close(twice, once + shift)
    # a zoom and a step back that show the same picture: the network's target is the same
    zoomed = data["camera"] * torch.tensor([2.0, 2.0, 1.0, 1.0])
    ray_scale = torch.tensor([1.0, 1.0, 2.0])  # the same pixels through twice the focal length
    position = data["position"] * ray_scale
    radian = [pixels_per_radian(x, c) for x, c in ((data["position"], data["camera"]), (position, zoomed))]
    position = position * (radian[1] / radian[0] * data["position"].norm(dim=-1) / position.norm(dim=-1))[:, None]
    again = encode_range(position, data["diagonal"], data["box"], zoomed, CONFIG)
    torch.testing.assert_close(again, once)


@pytest.mark.parametrize("size", [8, 32])
def test_packed_bits_are_numpys(size: int) -> None:
    voxels = np.random.default_rng(0).random((3, 2, size, size, size)) < 0.4
    packed = pack_bits(torch.from_numpy(voxels))
    expected = np.packbits(voxels.reshape(3, 2, -1), axis=-1)
    assert np.array_equal(packed.numpy(), expected)
    assert packed.dtype == torch.uint8
    assert np.array_equal(unpack_bits(torch.from_numpy(expected), size).numpy(), voxels)


def test_batches_are_cut_and_converted() -> None:
    batch = random_batch(CONFIG, 3, 2)
    part = batch[1:]
    assert part.image.shape[0] == 2
    assert torch.equal(part.box, batch.box[1:])
    assert part.shape_index is None
    half = batch.to(torch.float32)
    assert half.box.dtype == torch.float32
    assert half.image.dtype == torch.uint8
    assert half.category.dtype == torch.int64


def test_neutral_batches_keep_what_is_known() -> None:
    batch = random_batch(CONFIG, 2, 3, objects=2)
    batch.has_viewpoint[0, 0] = batch.has_position[0, 1] = batch.has_size[1, 0] = batch.has_voxels[1, 1] = False
    for name, mask in (
        ("viewpoint", "has_viewpoint"),
        ("position", "has_position"),
        ("diagonal", "has_size"),
        ("shape_loc", "has_voxels"),
        ("shape_scale", "has_voxels"),
        ("box", "present"),
    ):
        getattr(batch, name)[~getattr(batch, mask)] = math.nan
    neutral = batch.neutral()
    for field in dataclasses.fields(SceneBatch):
        value = getattr(neutral, field.name)
        assert value is None or not value.is_floating_point() or bool(torch.isfinite(value).all()), field.name
    for name, mask in (
        ("viewpoint", "has_viewpoint"),
        ("position", "has_position"),
        ("diagonal", "has_size"),
        ("shape_loc", "has_voxels"),
        ("box", "present"),
    ):
        known = getattr(batch, mask)
        assert torch.equal(getattr(neutral, name)[known], getattr(batch, name)[known])
