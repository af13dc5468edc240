"""`nolbo train --method`: the compared methods end to end on a tiny folder, from images to observations."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from nolbo_ppl.cli import main
from nolbo_ppl.inference.posterior.model_folder import load
from nolbo_ppl.inference.posterior.single_object_predictor import SingleObjectModel
from nolbo_ppl.io.files import read_jsonl
from nolbo_ppl.models.baselines.method import METHODS, MethodName
from nolbo_ppl.synthetic.dataset_writer import write_scenes
from nolbo_ppl.synthetic.scenes.scene_config import preset
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator


@pytest.fixture(autouse=True)
def _single_precision(_float64: None) -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_default_dtype(torch.float32)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Thirty scenes of 64 px, with two shapes of each category."""
    out = tmp_path_factory.mktemp("methods") / "scenes"
    write_scenes(out, SceneGenerator(preset("easy", 64), 3, instances=2), 30)
    return out


@pytest.mark.parametrize("method", ["single", "tlnet", "vaegan"])
def test_a_method_trains_and_observes(method: MethodName, folder: Path, tmp_path: Path) -> None:
    options = "--preset nano --batch 4 --shape-batch 4 --shape-steps 2 --single-steps 1 --scene-steps 4 --log-every 1 --threads 1"
    out = tmp_path / "run"
    main(["train", "--method", method, "--scenes", str(folder), "--out", str(out), "--no-bf16", *options.split()])
    rows = [row for _, row in read_jsonl(out / "metrics.jsonl")]
    steps = {name: [row["step"] for row in rows if row["stage"] == name and "loss" in row] for name in ("scenes", "joint")}
    assert steps == {"scenes": [1, 2, 3, 4], "joint": []} if method != "tlnet" else {"scenes": [1, 2, 3], "joint": [1]}
    assert all(np.isfinite(row["loss"]) for row in rows if "loss" in row)
    assert any("terms/generator" in row for row in rows) == METHODS[method].adversary
    model = load(out / "model")
    assert model.config.method == method
    assert isinstance(model, SingleObjectModel) == METHODS[method].one_object
    image = np.full((64, 64, 3), 120, dtype=np.uint8)
    (answer,) = model.observe_boxes([image], [80.0, 80.0, 32.0, 32.0], [np.array([[10.0, 10.0, 50.0, 40.0]])])
    assert answer.detections(0).latent.shape == (1, 16)
