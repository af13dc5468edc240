"""Labels of a model with its confidence: written, read, and drawn anew so that their mean is that of soft labels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from nolbo_ppl.cli.convert import main
from nolbo_ppl.data.converters import pseudo_labels
from nolbo_ppl.data.converters.pseudo_labels import write_pseudo_labels
from nolbo_ppl.data.dataset_folder import SceneFolder
from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.io.files import read_jsonl, write_jsonl
from nolbo_ppl.io.scenes import annotations_record
from nolbo_ppl.training.scene_loader import SceneLoader, ShapeTable, drawn_labels
from tests.factories import tiny_config, tiny_model


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """One image of 64 x 64 px: a certain object, one that is there with 0.7, one whose category is right with 0.25."""
    (tmp_path / "images").mkdir()
    Image.fromarray(np.zeros((64, 64, 3), dtype=np.uint8)).save(tmp_path / "images" / "a.png")
    objects = [
        {"box": [2, 2, 20, 20], "category": "car"},
        {"box": [30, 2, 50, 20], "category": "bus", "confidence": 0.7},
        {"box": [2, 30, 20, 60], "category": "boat", "confidence": 1.0, "category_confidence": 0.25},
    ]
    write_jsonl(tmp_path / "scenes.jsonl", [{"image": "images/a.png", "intrinsics": [60, 60, 32, 32], "objects": objects}])
    return tmp_path


def test_labels_are_drawn_with_their_probabilities(folder: Path) -> None:
    scenes = SceneFolder(folder, size=64)
    record = scenes.records[0]
    assert record.confidence is not None and record.confidence.tolist() == [1.0, 0.7, 1.0]
    kept = annotations_record(record, "images/a.png")["objects"]
    assert [thing.get("category_confidence") for thing in kept] == [1.0, 1.0, 0.25]
    assert record.select(np.array([2])).category_confidence.tolist() == [0.25]  # type: ignore[union-attr]
    loader = SceneLoader(scenes, ShapeTable(*scenes.shapes()), 1, 0, 4)
    draws = [loader.batch(step) for step in range(400)]
    present = np.array([batch.present[0, :3].tolist() for batch in draws])
    known = np.array([(batch.category[0, :3] >= 0).tolist() for batch in draws])
    assert present[:, [0, 2]].all() and known[:, :2].all()
    assert present[:, 1].mean() == pytest.approx(0.7, abs=5 * np.sqrt(0.21 / 400))
    assert known[:, 2].mean() == pytest.approx(0.25, abs=5 * np.sqrt(0.19 / 400))
    assert (loader.batch(7).present == draws[7].present).all()  # of the step alone
    fixed = loader.prepared(np.array([0]))
    assert fixed.present[0, :3].tolist() == [True, True, True] and int(fixed.category[0, 2]) == -1


def test_certain_labels_are_left_alone() -> None:
    arrays = {"present": np.array([[True, False]]), "category": np.array([[3, -1]])}
    assert drawn_labels(arrays, np.ones((2, 1, 2)))["present"].tolist() == [[True, False]]


@pytest.mark.parametrize("value", [0.0, 1.5, "much"])
def test_wrong_probabilities_are_refused(folder: Path, value: Any) -> None:
    row = next(row for _, row in read_jsonl(folder / "scenes.jsonl"))
    row["objects"][1]["confidence"] = value
    write_jsonl(folder / "scenes.jsonl", [row])
    with pytest.raises(InputError, match=r"objects\[1\].confidence"):
        SceneFolder(folder)


def test_a_model_labels_photographs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "photographs").mkdir()
    rng = np.random.default_rng(0)
    for name in ("a.png", "b.png"):
        Image.fromarray(rng.integers(0, 256, (64, 96, 3), dtype=np.uint8)).save(tmp_path / "photographs" / name)
    model = ObservationModel(tiny_model(tiny_config(), scatter=0.3))
    monkeypatch.setattr("nolbo_ppl.cli.convert.load", lambda name: model)
    monkeypatch.setattr(pseudo_labels, "MIN_SIDE", 1.0)
    out = tmp_path / "out"
    main(["pseudo-labels", "--images", str(tmp_path / "photographs"), "--out", str(out),
          "--min-confidence", "0.03", "--suspected", "0.01"])  # fmt: skip
    rows = [row for _, row in read_jsonl(out / "scenes.jsonl")]
    assert len(rows) == 2 and sum(len(row["objects"]) for row in rows) > 0
    for thing in (thing for row in rows for thing in row["objects"]):
        assert 0.03 <= thing["confidence"] <= 1 and 0 < thing["category_confidence"] <= 1
    assert len(SceneFolder(out, model.config.categories, size=96)) == 2
    with pytest.raises(InputError, match="suspected and min_confidence"):
        write_pseudo_labels([tmp_path / "photographs" / "a.png"], model, tmp_path / "other", 0.1, 0.2)
