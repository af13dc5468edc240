"""The fusion of evidence, fitted to scenes where one of the two sources is right."""

from __future__ import annotations

import torch

from nolbo_ppl.models.hybrid_guide import HybridGuide
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.training.evidence_fit import (
    WEIGHTS,
    EvidenceTable,
    fit_fusion,
    fusion_loss,
    gather_table,
    join_tables,
    table_of,
    table_tensors,
)
from tests.factories import random_batch, tiny_config

CONFIG = tiny_config(detector="yolox_nano")


def gathered(model: Nolbo, seed: int, scenes: int = 6) -> EvidenceTable:
    assert isinstance(model.guide, HybridGuide)
    return gather_table(model.guide, random_batch(CONFIG, scenes=scenes, seed=seed, objects=2))


def total(terms: dict[str, float]) -> float:
    return sum(WEIGHTS[name] * terms[name] for name in WEIGHTS)


def test_candidates_hold_every_object_once() -> None:
    model = Nolbo.from_seed(CONFIG, 0).double().eval()
    batch = random_batch(CONFIG, scenes=6, seed=1, objects=2)
    table = gathered(model, 1)
    assert table.is_object.sum(1).tolist() == [2] * 6
    for row in range(6):
        found = sorted(table.category[row][table.is_object[row]].tolist())
        assert found == sorted(batch.category[row][batch.present[row]].tolist())
    both = join_tables([table, gathered(model, 2, scenes=3)])
    kept = table_of(table_tensors(table))
    assert all(torch.equal(value, table_tensors(kept)[name]) for name, value in table_tensors(table).items())
    assert len(both) == 9 and torch.equal(both[torch.arange(6)].cell, table.cell)


def test_unlabelled_images_teach_positives_alone() -> None:
    model = Nolbo.from_seed(CONFIG, 0).double().eval()
    assert isinstance(model.guide, HybridGuide)
    batch = random_batch(CONFIG, scenes=2, seed=3).replace(exhaustive=torch.zeros(2, 4, dtype=torch.bool))
    table = gather_table(model.guide, batch)
    assert torch.equal(table.known, table.is_object)


ALL = torch.ones(3, dtype=torch.bool)


def test_evidence_is_weighed_on_generated_scenes_alone() -> None:
    """Photographs of which nothing is right teach the scenes' weights nothing; with none the result is the same."""
    model, other = (Nolbo.from_seed(CONFIG, 0).double().eval() for _ in range(2))
    scenes, photographs = gathered(model, 4, scenes=3), gathered(model, 5, scenes=3)
    photographs.is_object.logical_not_()
    both = join_tables([photographs, scenes])
    kinds = torch.arange(6) >= 3
    options = {"seed": 0, "steps": 20, "batch": 3, "learning_rate": 1e-2}
    fit_fusion(model, both, both, (kinds, kinds), **options)
    fit_fusion(other, scenes, scenes, (ALL, ALL), **options)
    assert isinstance(model.guide, HybridGuide) and isinstance(other.guide, HybridGuide)
    of_scenes = ("weigh.", "slopes", "shift")
    expected = other.guide.fusion.state_dict()
    for name, value in model.guide.fusion.state_dict().items():
        if name.startswith(of_scenes):
            torch.testing.assert_close(value, expected[name], rtol=1e-2, atol=1e-3)


def test_the_fit_lowers_the_held_out_loss() -> None:
    """Objects are where chance put them, but objects there are: two in every image of known places."""
    model = Nolbo.from_seed(CONFIG, 0).double().eval()
    table = gathered(model, 4, scenes=3)
    terms = fit_fusion(model, table, table, (ALL, ALL), seed=0, steps=40, batch=6, learning_rate=1e-2, weight_decay=0.0)
    assert total(terms) < 0.7 * total({name: terms[f"{name}_before"] for name in WEIGHTS})
    assert isinstance(model.guide, HybridGuide)
    with torch.no_grad():
        kept = {name: float(value) for name, value in fusion_loss(model.guide.fusion, table).items()}
    assert kept == {name: terms[name] for name in WEIGHTS}  # the weights with the least loss are the model's
    again = Nolbo.from_seed(CONFIG, 0).double().eval()
    assert fit_fusion(again, table, table, (ALL, ALL), seed=0, steps=40, batch=6, learning_rate=1e-2, weight_decay=0.0) == terms
