"""Shift scores: their scale is that of held-out images, an image is as far as from its nearest kind, unknown is 0."""

from __future__ import annotations

import torch

from nolbo_ppl.models.category_sizes import CategorySizes
from nolbo_ppl.models.image_shift import RESIDUAL_WEIGHT, ImageShift, excess


def drawn(n: int, seed: int, shift: float = 0.0) -> torch.Tensor:
    """Features with three strong directions."""
    g = torch.Generator().manual_seed(seed)
    basis = torch.randn(3, 12, generator=torch.Generator().manual_seed(99))
    return 3 * torch.randn(n, 3, generator=g) @ basis + 0.3 * torch.randn(n, 12, generator=g) + shift


def test_the_scale_is_that_of_held_out_images() -> None:
    shift = ImageShift(12, kinds=2, axes=3)
    assert shift(drawn(5, 0)).tolist() == [0.0] * 5  # nothing is known yet
    shift.learn(0, drawn(2000, 1), drawn(2000, 2))
    score = shift(drawn(4000, 3))
    assert abs(float(score.median())) < 0.1
    assert 0.01 < float((score > 1).double().mean()) < 0.05  # 3 % within 5 standard errors of two samples
    far = drawn(10, 4, shift=5.0)
    assert bool((shift(far) > 1).all())
    shift.learn(1, drawn(2000, 5, shift=5.0), drawn(2000, 6, shift=5.0))
    assert float(shift(drawn(200, 7, shift=5.0)).median()) < 0.3  # a kind of its own now
    assert float(shift(drawn(200, 8)).median()) < 0.3


def test_the_distance_is_mahalanobis_along_the_axes() -> None:
    shift, images = ImageShift(12, kinds=1, axes=3), drawn(3000, 1)
    shift.learn(0, images, drawn(500, 2))
    x = drawn(6, 3, shift=0.5).double()
    z = (x - images.double().mean(0)) / images.double().std(0)
    own = (images.double() - images.double().mean(0)) / images.double().std(0)
    variance, vectors = torch.linalg.eigh(own.T @ own / len(own))
    along, off = z @ vectors[:, -3:], z @ vectors[:, :-3]
    squared = (along**2 / variance[-3:]).sum(1) + RESIDUAL_WEIGHT * (off**2).sum(1) / variance[:-3].sum()
    middle, inverse = shift.get_buffer("middle")[0], shift.get_buffer("inverse_span")[0]
    expected = (torch.log(squared / (3 + RESIDUAL_WEIGHT)) - middle) * inverse
    torch.testing.assert_close(shift(x.to(shift.get_buffer("mean").dtype)).double(), expected, rtol=1e-4, atol=1e-4)


def test_little_and_nothing_known() -> None:
    shift = ImageShift(12, kinds=1, axes=8)
    shift.learn(0, drawn(16, 1), drawn(16, 2))  # two axes at most
    assert torch.isfinite(shift(drawn(50, 3))).all()
    assert excess(torch.tensor([0.5, 1.0, 1.25, torch.nan])).tolist() == [0.0, 0.0, 0.25, 0.0]
    sizes = CategorySizes(2)
    sizes.learn(1, torch.full((5,), 2.0))
    mean, precision = sizes(torch.tensor([0, 1]))
    assert mean.tolist() == [0.0, 2.0] and precision[0] == 0 and float(precision[1]) > 100
