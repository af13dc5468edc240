"""Sizes and distances of photographs: the ratio a height tells, and the product of Gaussian statements against quadrature."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from nolbo_ppl.geometry.rotation import viewpoint_to_matrix
from nolbo_ppl.inference.posterior.metric_size import (
    FOCAL_LOG_SCALE,
    GUIDE_LOG_SCALE,
    RATIO_SCALE,
    MetricKnowledge,
    ratio_of_height,
    shape_hulls,
    with_metric_size,
)
from nolbo_ppl.models.category_sizes import CategorySizes
from nolbo_ppl.models.scene_batch import decode_range, encode_range
from tests.factories import random_posterior, tiny_config

CONFIG = tiny_config()
CAMERA = torch.tensor([[400.0, 410.0, 200.0, 150.0]])


def hulls() -> torch.Tensor:
    grids = np.zeros((len(CONFIG.categories), 16, 16, 16))
    grids[:, 2:14, 4:12, 5:11] = 1.0
    return torch.as_tensor(shape_hulls(grids))


def test_hulls_hold_the_corners_of_a_box() -> None:
    points = hulls()[0].numpy()
    extents = np.ptp(points, axis=0)
    np.testing.assert_allclose(extents, np.array([12, 8, 6]) / np.linalg.norm([12, 8, 6]), rtol=1e-9)
    np.testing.assert_allclose(points.max(0) + points.min(0), 0, atol=1e-12)
    empty = shape_hulls(np.zeros((1, 8, 8, 8)))
    np.testing.assert_allclose(np.ptp(empty[0], axis=0), 3**-0.5)


@pytest.mark.parametrize("ratio", [1.5, 4.0, 20.0])
def test_a_height_tells_the_ratio(ratio: float) -> None:
    R = viewpoint_to_matrix(torch.tensor([[0.7, 0.2, 0.05]]))
    ray = torch.nn.functional.normalize(torch.tensor([[0.2, -0.1, 1.0]]), dim=-1)
    point = hulls()[:1] @ R.mT + ratio * ray[:, None]
    y = 410 * point[..., 1] / point[..., 2]
    found = ratio_of_height(hulls()[:1], R, ray, torch.tensor([math.log(3.0)]), y.amax(1) - y.amin(1), CAMERA[:, 1])
    assert float(found.exp()) == pytest.approx(ratio, rel=0.02)


def answer(share: float = 1.0, guessed: bool = False, extent: float = 300.0, sized: bool = True):
    """One object at 10 m, 2 m large, in an image whose box says twice its height; before and after."""
    q = random_posterior(CONFIG, (1,), seed=1)
    position, diagonal = torch.tensor([[0.5, 0.2, 10.0]]), torch.tensor([2.0])
    R = viewpoint_to_matrix(torch.tensor([[0.7, 0.2, 0.05]]))
    point = 2.0 * hulls()[:1] @ R.mT + position[:, None]
    y = 410 * point[..., 1] / point[..., 2]
    height = float(y.max() - y.min()) * 2
    box = torch.tensor([[200.0, 150.0 - height / 2, 260.0, 150.0 + height / 2]])
    q = dataclasses.replace(q, range_loc=encode_range(position, diagonal, box, CAMERA, CONFIG))
    sizes = CategorySizes(len(CONFIG.categories))
    if sized:
        for label in range(len(CONFIG.categories)):
            sizes.learn(label, torch.tensor([math.log(3.0) - 0.1, math.log(3.0) + 0.1]))
    known = MetricKnowledge(hulls(), sizes, torch.tensor([share]), torch.tensor([guessed]), torch.tensor([[400.0, extent]]))
    after = with_metric_size(q, box, position, diagonal, R, CAMERA, known, CONFIG)
    return q, after, box, sizes


def test_the_product_is_that_of_the_densities() -> None:
    q, after, box, sizes = answer()
    spread = torch.tensor([CONFIG.range_spread[0], CONFIG.range_spread[3]])
    s0, s1 = ((q.range_scale[0, [0, 3]] * spread) ** 2 + GUIDE_LOG_SCALE**2).sqrt().tolist()
    u, v = torch.meshgrid(torch.linspace(-2.5, 2.5, 1201), torch.linspace(-2.5, 2.5, 1201), indexing="ij")
    change = -math.log(2)  # nearer by half, up to perspective
    mean, precision = (float(value[0]) for value in sizes(torch.tensor([0])))
    log = -0.5 * ((u / s0) ** 2 + (v / s1) ** 2 + ((u - v - change) / RATIO_SCALE) ** 2)
    log = log - 0.5 * precision * (v - (mean - math.log(2.0))) ** 2
    weight = torch.softmax(log.flatten(), 0).view_as(log)
    moved = ((after.range_loc - q.range_loc)[0, [0, 3]] * spread).tolist()
    assert moved[0] == pytest.approx(float((weight * u).sum()), abs=0.03)
    assert moved[1] == pytest.approx(float((weight * v).sum()), abs=0.03)
    scale = (after.range_scale[0, [0, 3]] * spread).tolist()
    assert scale[0] ** 2 == pytest.approx(float((weight * u**2).sum() - (weight * u).sum() ** 2), rel=0.02)
    assert scale[1] ** 2 == pytest.approx(float((weight * v**2).sum() - (weight * v).sum() ** 2), rel=0.02)
    position, diagonal = decode_range(after.range_loc, box, CAMERA, CONFIG)
    assert float(position.norm()) < 10 and float(diagonal[0]) > 2


def test_what_says_nothing_changes_nothing() -> None:
    generated, cut_off = answer(share=0.0), answer(extent=100.0, sized=False)
    torch.testing.assert_close(generated[1].range_loc, generated[0].range_loc)
    torch.testing.assert_close(generated[1].range_scale, generated[0].range_scale)
    torch.testing.assert_close(cut_off[1].range_loc, cut_off[0].range_loc)  # by the border: its height says nothing
    assert bool((cut_off[1].range_scale >= cut_off[0].range_scale).all())
    stated, guessed = answer()[1], answer(guessed=True)[1]
    spread = CONFIG.range_spread[0]
    variance = (guessed.range_scale[0, 0] * spread) ** 2 - (stated.range_scale[0, 0] * spread) ** 2
    assert float(variance) == pytest.approx(FOCAL_LOG_SCALE**2, rel=1e-6)
    assert torch.equal(guessed.range_loc, stated.range_loc) and guessed.range_scale[0, 3] == stated.range_scale[0, 3]
