"""How evidence is read on photographs: what was drawn with known numbers is found again, and a resumed run keeps it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from nolbo_ppl.data.converters.photographs import Photograph, read_photographs
from nolbo_ppl.models.hybrid_guide import HybridGuide
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.training import photograph_fit, trainer
from nolbo_ppl.training.photograph_fit import FoundObjects, adopt_fit, find_objects, fit_found, judged, mean_precision
from nolbo_ppl.training.train_config import TrainConfig
from tests.data.converters.test_photographs import write
from tests.factories import tiny_config

BOX = [10.0, 10.0, 60.0, 60.0]
LABELS = 4


@pytest.fixture
def single_precision() -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    yield
    torch.set_default_dtype(before)


def photo(category: int | None, exhaustive: set[int]) -> Photograph:
    boxes = [] if category is None else [BOX]
    return Photograph(
        Path("x.png"), 100, 100, "", frozenset(exhaustive), np.array(boxes).reshape(-1, 4),
        np.array([] if category is None else [category], dtype=np.int64), np.zeros(len(boxes), dtype=bool),
        np.full((len(boxes), 3), np.nan),
    )  # fmt: skip


def drawn(n: int, informative: bool, seed: int = 0) -> tuple[FoundObjects, list[Photograph]]:
    """One detection a photograph: right with probability sigmoid(2 x - 0.7), its category from own^0.6 (and look^0.8)."""
    rng = np.random.default_rng(seed)
    odds = rng.normal(0, 2, n)
    own, look = (photograph_fit._normalised(rng.normal(0, 2, (n, LABELS))) for _ in range(2))
    logits = 0.6 * own + (0.8 * look if informative else 0.0)
    category = (photograph_fit._normalised(logits) + rng.gumbel(size=logits.shape)).argmax(1)
    right = rng.random(n) < 1 / (1 + np.exp(-(2 * odds - 0.7)))
    photos = [photo(int(c) if r else None, set(range(LABELS))) for c, r in zip(category, right)]
    return FoundObjects(np.arange(n), np.tile(BOX, (n, 1)), odds, own, look), photos


@pytest.mark.parametrize("informative", [True, False])
def test_the_numbers_behind_detections_are_found(informative: bool) -> None:
    fit = fit_found(*drawn(4000, informative), *drawn(4000, informative, seed=1))
    assert fit is not None and (fit.photographs, fit.detections) == (4000, 8000)
    assert fit.factor == pytest.approx(2.0, abs=0.35) and fit.shift == pytest.approx(-0.7, abs=0.3)  # 5 standard errors
    assert fit.label_factor == pytest.approx(0.6, abs=0.15)
    if informative:
        assert fit.look_share == pytest.approx(0.8, abs=0.2) and fit.map50_with_look > fit.map50_without_look
    else:
        assert fit.look_share < 0.15


def test_other_photographs_decide_on_the_look() -> None:
    """A look that tells the categories of those it is fitted on, and misleads on others, has no share."""
    found, photos = drawn(600, True)
    others, other_photos = drawn(600, True, seed=1)
    misled = dataclasses.replace(others, look=-others.look)
    kept, dropped = fit_found(found, photos, others, other_photos), fit_found(found, photos, misled, other_photos)
    assert kept is not None and kept.look_share > 0.5
    assert dropped is not None and dropped.look_share == 0.0


@pytest.mark.parametrize("gain", [-0.1, 0.0, 0.1])
def test_a_look_without_a_gain_in_precision_has_no_share(gain: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Likelihood wants a share of this look; precision decides, and without one the other weight is the look's absence's."""
    precision = iter([0.5, 0.5 + gain])
    monkeypatch.setattr(photograph_fit, "mean_precision", lambda *_: next(precision))
    found, photos = drawn(600, True, seed=3)
    fit = fit_found(found, photos, *drawn(60, True, seed=4))
    assert fit is not None and (fit.map50_without_look, fit.map50_with_look) == (0.5, 0.5 + gain)
    assert (fit.look_share > 0.3) == (gain > 0)
    if gain <= 0:
        *_, category = judged(found, photos, found.own.argmax(1))
        rows = category >= 0
        grid = np.linspace(0.05, 2.0, 400)
        loss = [-photograph_fit._normalised(a * found.own[rows])[np.arange(rows.sum()), category[rows]].mean() for a in grid]
        assert fit.look_share == 0.0 and fit.label_factor == pytest.approx(grid[int(np.argmin(loss))], abs=0.01)


def test_what_is_not_labelled_is_not_judged() -> None:
    photos = [photo(0, {0}), photo(None, {0}), photo(1, {1})]
    own = photograph_fit._normalised(np.array([[3.0, 0, 0, 0], [0, 3.0, 0, 0], [0, 3.0, 0, 0]]))
    found = FoundObjects(np.arange(3), np.tile(BOX, (3, 1)), np.array([1.0, 0.5, 0.0]), own, np.zeros_like(own))
    counted, right, category = judged(found, photos, own.argmax(1))
    assert counted.tolist() == [True, False, True]  # nobody says that there is no second kind in the second photograph
    assert right.tolist() == [True, False, True] and category.tolist() == [0, -1, 1]
    assert mean_precision(found, photos, own) == 1.0
    assert fit_found(found, photos, found, photos) is None  # too few


def test_a_resumed_run_does_not_look_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, single_precision: None) -> None:
    model = Nolbo.from_seed(tiny_config(detector="yolox_nano"), 0).eval()
    assert isinstance(model.guide, HybridGuide)
    config = TrainConfig(tmp_path / "run", preset="photo", photographs=write(tmp_path / "labels"))
    calls: list[int] = []

    def found(*_: object) -> FoundObjects:
        calls.append(1)
        return drawn(600, True)[0]

    monkeypatch.setattr(trainer, "find_objects", found)
    monkeypatch.setattr(trainer, "read_photographs", lambda *_, **__: [p for p in drawn(600, True)[1] for _ in range(3)])
    first = trainer.fit_photographs(model, config)
    fitted = model.guide.fusion.photograph.detach().clone()
    assert calls == [1, 1] and fitted.tolist() == pytest.approx(
        [first[k] for k in ("factor", "shift", "label_factor", "look_share")]
    )
    with torch.no_grad():
        model.guide.fusion.photograph.zero_()
    assert trainer.fit_photographs(model, config) == first and calls == [1, 1]
    assert torch.equal(model.guide.fusion.photograph, fitted)


def test_detections_are_found_as_they_are(tmp_path: Path, single_precision: None) -> None:
    model = Nolbo.from_seed(tiny_config(detector="yolox_nano"), 0).eval()
    assert isinstance(model.guide, HybridGuide)
    before = model.guide.fusion.photograph.detach().clone()
    photos = read_photographs(write(tmp_path), categories=model.config.categories)
    found = find_objects(model, photos, batch=1)
    assert torch.equal(model.guide.fusion.photograph, before)
    assert len(found.scene) > 0 and set(found.scene.tolist()) <= {0, 1} and (found.log_odds >= photograph_fit.MIN_ODDS).all()
    np.testing.assert_allclose(np.exp(found.own).sum(1), 1.0, rtol=1e-6)
    assert np.isfinite(found.look).all()
    fit = fit_found(*drawn(600, True), *drawn(600, True))
    assert fit is not None
    adopt_fit(model, fit)
    assert float(model.guide.fusion.photograph[0]) == pytest.approx(fit.factor)
