"""Fitting the calibration factors: known distortions are found and undone."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.stats import chi2

from nolbo_ppl.errors import InputError
from nolbo_ppl.models.distributions import VonMisesMixture
from nolbo_ppl.models.guide import Guide
from nolbo_ppl.models.observed_scene import ObservedScene
from nolbo_ppl.models.scene_batch import SceneBatch, decode_box, decode_range, encode_box
from nolbo_ppl.training import calibrate as module
from nolbo_ppl.training.calibrate import calibrate, position_factor, region_factor, view_correlation
from tests.factories import observed_scene, random_batch, random_posterior, tiny_config, tiny_model


def test_region_factor_makes_the_region_cover() -> None:
    torch.manual_seed(0)
    error = 1.7 * torch.randn(20000, 3)
    factor = region_factor(error.square().sum(-1), 3)
    assert factor == pytest.approx(1.7, rel=0.02)
    inside = (error / factor).square().sum(-1) <= chi2.ppf(0.9, 3)
    assert float(inside.double().mean()) == pytest.approx(0.9, abs=1e-3)


@pytest.mark.parametrize("factor", [0.4, 1.8])
def test_position_factor_makes_the_region_cover(factor: float) -> None:
    """Errors drawn from covariances of which one part was multiplied by a known factor."""
    g = torch.Generator().manual_seed(2)
    root = torch.randn(2, 20000, 3, 3, generator=g, dtype=torch.float64)
    by_range, by_box = root @ root.mT + 0.01 * torch.eye(3, dtype=torch.float64)
    noise = torch.randn(20000, 3, 1, generator=g, dtype=torch.float64)
    error = (torch.linalg.cholesky(factor**2 * by_range + by_box) @ noise)[..., 0]
    found = position_factor(error, by_range, by_box)
    assert found == pytest.approx(factor, rel=0.05)
    solved = torch.linalg.solve(found**2 * by_range + by_box, error[..., None])[..., 0]
    assert float(((error * solved).sum(-1) <= chi2.ppf(0.9, 3)).double().mean()) == pytest.approx(0.9, abs=1e-3)


def test_position_factor_has_limits() -> None:
    """A box alone that explains too much, and errors that nothing explains."""
    eye = torch.eye(3, dtype=torch.float64).expand(60, 3, 3)
    error = torch.ones(60, 3, dtype=torch.float64)
    assert position_factor(1e-3 * error, eye, eye) == pytest.approx(0.05)
    assert position_factor(1e3 * error, eye, eye) == pytest.approx(20)


@pytest.mark.parametrize("correlation", [0.0, 0.35, 0.8])
def test_correlation_of_views_is_found(correlation: float) -> None:
    """Errors with a part common to the views of a shape: its share of the variance comes back."""
    g = torch.Generator().manual_seed(3)
    group = torch.randint(0, 900, (4000,), generator=g)
    common = torch.randn(900, 6, generator=g)[group]
    own = torch.randn(4000, 6, generator=g)
    found = view_correlation(math.sqrt(correlation) * common + math.sqrt(1 - correlation) * own, group)
    assert found == pytest.approx(correlation, abs=0.03)


def test_views_without_partners_have_no_correlation() -> None:
    assert view_correlation(torch.randn(50, 3), torch.arange(50)) == 0.0
    assert view_correlation(torch.zeros(0, 3), torch.zeros(0, dtype=torch.long)) == 0.0


def test_distorted_scales_and_odds_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Truths drawn from the guide's posterior distorted by known factors: each factor comes back."""
    torch.manual_seed(1)
    config = tiny_config()
    model = tiny_model(config)
    batch = random_batch(config, scenes=300, slots=6, seed=1)
    q = random_posterior(config, (300, 6), seed=2)
    q.azimuth_natural = q.azimuth_natural / 6
    scene = observed_scene(config, batch, q)
    where = scene.assignment

    def scattered(loc: torch.Tensor, scale: torch.Tensor, factor: float) -> torch.Tensor:
        return loc + factor * scale * torch.randn_like(loc)

    q.range_scale, q.box_scale = q.range_scale / 8, q.box_scale / 8  # covariances of positions are of first order
    box = decode_box(scattered(q.box_loc, q.box_scale, 1.5), where.cell, scene.encoding.columns, config)
    camera = batch.intrinsics[:, None].expand(-1, 6, -1)
    position, diagonal = decode_range(scattered(q.range_loc, q.range_scale, 0.6), box, camera, config)
    where.box_target = encode_box(box, where.cell, scene.encoding.columns, config)
    truth = VonMisesMixture(q.azimuth_logits, 0.4 * q.azimuth_natural).sample()
    angles = scattered(q.angle_loc, q.angle_scale, 2.0)
    category = torch.distributions.Categorical(logits=0.5 * q.label_logits).sample()
    logit = scene.encoding.objectness_logit
    where.is_object = torch.rand_like(logit) < torch.sigmoid(0.7 * logit - 0.4)
    batch = scene.batch.replace(
        viewpoint=torch.cat((truth[..., None], angles), -1),
        category=category,
        position=position,
        diagonal=diagonal,
        symmetry=torch.ones_like(batch.symmetry),
        shape_loc=scattered(q.at_map_category(model.story.prior.label_mean()).shape_loc, q.shape_scale, 1.2),
    )
    # turns of the in-plane angle by whole circles are no errors
    batch.viewpoint[::2, :, 2] += 2 * math.pi
    scene = ObservedScene(batch, scene.encoding, where, q)
    monkeypatch.setattr(Guide, "observe", lambda self, one: scene)
    found = calibrate(model, [batch])
    assert found.box_scale == pytest.approx(1.5, rel=0.05)
    assert found.range_scale == pytest.approx(0.6, rel=0.05)
    assert found.angle_scale == pytest.approx(2.0, rel=0.05)
    assert found.shape_scale == pytest.approx(1.2, rel=0.05)
    assert found.label_slope == pytest.approx(0.5, rel=0.15)
    assert found.azimuth_concentration == pytest.approx(0.4, rel=0.15)
    assert found.objectness_slope == pytest.approx(0.7, rel=0.1)
    assert found.objectness_shift == pytest.approx(-0.4, abs=0.1)


def test_end_to_end_on_scenes_partly_labelled() -> None:
    """Missing labels are left out; the result is a usable set of factors."""
    config = tiny_config()
    model = tiny_model(config, scatter=0.1)
    batches = [random_batch(config, scenes=6, slots=4, seed=k) for k in range(4)]
    for batch in batches:
        batch.category[::2] = -1
        batch.has_viewpoint[1::2] = False
        batch.has_size[:3] = False
        batch.visibility[:, 3] = 0.2
    found = calibrate(model, [batch.replace(shape_loc=None, shape_scale=None) for batch in batches])
    assert found.shape_scale == 1.0
    assert found.box_scale > 1, "random boxes are far from an untrained guide's"
    assert math.isfinite(found.objectness_shift)


def test_too_few_objects() -> None:
    config = tiny_config()
    few: list[SceneBatch] = [random_batch(config, scenes=3, slots=3)]
    with pytest.raises(InputError, match="too few objects to calibrate on: got 9, expected at least 50"):
        calibrate(tiny_model(config), few)
    with pytest.raises(module.TooFewObjects):
        calibrate(tiny_model(config), [])
