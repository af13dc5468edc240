"""Calibration factors: what each changes, and what is refused."""

from __future__ import annotations

import dataclasses
import json
import math

import pytest
import torch

from nolbo_ppl.errors import InputError
from nolbo_ppl.models.posterior_calibration import Calibration
from tests.factories import random_posterior, tiny_config

FACTORS = {
    "label_slope": "label_logits",
    "azimuth_concentration": "azimuth_natural",
    "angle_scale": "angle_scale",
    "shape_scale": "shape_scale",
    "box_scale": "box_scale",
    "range_scale": "range_scale",
}


@pytest.mark.parametrize(("factor", "parameter"), FACTORS.items())
def test_each_factor_changes_its_parameter_only(factor: str, parameter: str) -> None:
    q = random_posterior(tiny_config(), (3,))
    changed = Calibration(**{factor: 1.7}).apply(q)
    for field in dataclasses.fields(q):
        before, after = getattr(q, field.name), getattr(changed, field.name)
        torch.testing.assert_close(after, before * (1.7 if field.name == parameter else 1.0))


def test_objectness_is_affine_in_the_log_odds() -> None:
    logit = torch.tensor([-2.0, 0.0, 3.0])
    torch.testing.assert_close(Calibration(objectness_slope=2.0, objectness_shift=-0.5).objectness(logit), 2 * logit - 0.5)
    assert torch.equal(Calibration().objectness(logit), logit)


def test_round_trip() -> None:
    calibration = Calibration(objectness_shift=-1.5, shape_scale=1.2)
    assert Calibration.from_json(json.loads(json.dumps(calibration.to_json()))) == calibration


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, "2"])
def test_refusals(value: object) -> None:
    with pytest.raises(InputError, match="calibration factor shape_scale"):
        Calibration(shape_scale=value)  # type: ignore[arg-type]


def test_certainty_is_brought_below_what_is_supported_and_the_order_stays() -> None:
    probability = torch.tensor([0.1, 0.9, 0.999, 1.7], dtype=torch.float64)
    limited = Calibration(objectness_limit=0.99).limited(probability)
    assert (limited.diff() > 0).all() and float(limited.max()) == pytest.approx(0.99)
    assert float(limited[0]) == pytest.approx(0.099, rel=1e-4)
    unlimited = Calibration().limited(probability)
    assert torch.equal(unlimited[:3], probability[:3]) and float(unlimited[3]) == 1 - 1e-6
    for value in (1.0, 0.3, math.nan):
        with pytest.raises(InputError, match="objectness_limit"):
            Calibration(objectness_limit=value)


def test_tails_of_positions_are_stated_where_they_were_fitted() -> None:
    assert Calibration().position_tails is None
    tails = Calibration(position_dof=3.0, position_spread=0.4).position_tails
    assert tails is not None and (tails.dof, tails.spread) == (3.0, 0.4)


def test_unknown_factors() -> None:
    with pytest.raises(InputError, match=r"unknown calibration factors.*slope"):
        Calibration.from_json({"slope": 1.0})
