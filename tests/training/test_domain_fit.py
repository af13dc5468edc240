"""Photographs told from generated scenes, and sizes of categories."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from nolbo_ppl.models.hybrid_guide import HybridGuide
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.synthetic.assets.cad_sizes import TYPICAL_DIAGONAL
from nolbo_ppl.training.domain_fit import MIN_SIZE_SPREAD, contexts_of, fit_domain, learn_sizes
from tests.factories import tiny_config


def guide_of(**changes: object) -> HybridGuide:
    guide = Nolbo.from_seed(tiny_config(detector="yolox_nano", **changes), 0).eval().guide
    assert isinstance(guide, HybridGuide)
    return guide


def test_two_kinds_are_told_apart_and_the_border_lies_between() -> None:
    guide, g = guide_of(), torch.Generator().manual_seed(0)
    features = guide.fusion.domain.in_features
    direction = torch.randn(features, generator=g)
    context = torch.randn(400, features, generator=g)
    generated = torch.arange(400) % 3 == 0
    context[generated] += 0.8 * direction
    figures = fit_domain(guide, context, generated)
    assert figures["domain/photographs_right"] > 0.97 and figures["domain/generated_right"] > 0.97
    with torch.no_grad():
        fresh = torch.randn(300, features, generator=g)
        assert float((guide.fusion.generated(fresh) < 0.5).double().mean()) > 0.95
        assert float((guide.fusion.generated(fresh + 0.8 * direction) > 0.5).double().mean()) > 0.95
        assert float(guide.shift(fresh).median()) < 0.6 and float(guide.shift(4 * fresh).min()) > 1
    before = guide.fusion.domain.weight.detach().clone()
    assert fit_domain(guide, context[:30], generated[:30]) == {}  # too few of both
    assert torch.equal(guide.fusion.domain.weight, before)


def test_contexts_are_those_of_the_encoding() -> None:
    guide = guide_of()
    image = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    (context,) = contexts_of(guide, [image])
    assert context.shape == (guide.fusion.domain.in_features,) and len(contexts_of(guide, [])) == 0
    padded = np.full((64, 64, 3), 114, dtype=np.uint8)
    padded[:48] = image
    with torch.no_grad():
        torch.testing.assert_close(guide.gather(torch.from_numpy(padded).permute(2, 0, 1)[None]).context[0], context)


def test_sizes_are_a_common_specimens() -> None:
    guide = guide_of(categories=("car", "unicorn", "bottle"), symmetry=(1, 1, 0))
    learn_sizes(guide, ("car", "unicorn", "bottle"), 0)
    mean, precision = guide.sizes(torch.tensor([0, 1, 2]))
    assert float(mean[0]) == pytest.approx(math.log(TYPICAL_DIAGONAL["car"]))
    assert float(precision[1]) == 0.0
    assert all(float(precision[k]) <= 1.0001 / MIN_SIZE_SPREAD**2 for k in (0, 2))
