"""`nolbo train --preset photo --detector FILE` from a file in the layout of YOLOX-nano's, at a size that tests bear."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.inference.posterior.model_folder import load, save
from nolbo_ppl.io.files import read_json
from nolbo_ppl.models.hybrid_guide import HybridGuide
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.posterior_calibration import Calibration
from nolbo_ppl.models.yolox import ScaledConv, YoloxNano
from nolbo_ppl.synthetic.dataset_writer import write_scenes
from nolbo_ppl.synthetic.scenes.scene_config import preset
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator
from nolbo_ppl.training import photograph_fit, trainer
from nolbo_ppl.training.detector_file import read_detector
from nolbo_ppl.training.train_config import TrainConfig
from tests.data.converters.test_photographs import write
from tests.factories import tiny_config


@pytest.fixture(autouse=True)
def _single_precision(_float64: None) -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_default_dtype(torch.float32)
    yield
    torch.set_num_threads(threads)


def write_detector(path: Path, seed: int = 0) -> YoloxNano:
    """Random weights in an ONNX file that orders convolutions and colours as the public one does; returns the network."""
    onnx = pytest.importorskip("onnx")
    torch.manual_seed(seed)
    network = YoloxNano()
    nodes, tensors = [], []
    for k, unit in enumerate(module for module in network.modules() if isinstance(module, ScaledConv)):
        kernel = (unit.weight * unit.gain[:, None, None, None]).detach().numpy()
        if k == 0:  # four phases, each blue, green, red
            kernel = kernel.reshape(len(kernel), 4, 3, 3, 3)[:, :, ::-1].reshape(kernel.shape)
        for name, value in (("w", kernel), ("b", unit.bias.detach().numpy())):
            tensors.append(onnx.numpy_helper.from_array(np.ascontiguousarray(value), f"{name}{k}"))
        nodes.append(onnx.helper.make_node("Conv", [f"x{k}", f"w{k}", f"b{k}"], [f"x{k + 1}"]))
    inputs, outputs = ([onnx.helper.make_tensor_value_info(name, 1, [1, 3, 64, 64])] for name in ("x0", f"x{len(nodes)}"))
    onnx.save(onnx.helper.make_model(onnx.helper.make_graph(nodes, "detector", inputs, outputs, tensors)), str(path))
    return network


def test_a_written_detector_is_read_back(tmp_path: Path) -> None:
    network = write_detector(tmp_path / "detector.onnx").eval()
    image = torch.randint(0, 256, (1, 3, 64, 96)).float()
    with torch.no_grad():
        own, read = network(image), read_detector(tmp_path / "detector.onnx")(image)
    torch.testing.assert_close(read.box, own.box, rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(read.classes, own.classes, rtol=1e-4, atol=1e-4)


def test_the_command_of_the_shipped_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_detector(tmp_path / "detector.onnx")
    save(tmp_path / "small", Nolbo.from_seed(tiny_config(categories=CATEGORIES, symmetry=(1,) * 12), 0), Calibration(), {})
    for name, seed in (("a", 3), ("b", 4)):
        write_scenes(tmp_path / name, SceneGenerator(preset("easy", 64), seed, instances=2), 20)
    monkeypatch.setattr(trainer, "fit_fusion", functools.partial(trainer.fit_fusion, steps=5))
    looked: list[int] = []
    fitted = photograph_fit.PhotographFit(1.5, 0.5, 0.8, 0.0, 1, 60, 0.5, 0.4)

    def fit_found(found: photograph_fit.FoundObjects, photos: list[Any], *_: object) -> photograph_fit.PhotographFit:
        looked.append(len(photos))
        return fitted

    monkeypatch.setattr(trainer, "fit_found", fit_found)
    config = TrainConfig(
        tmp_path / "run",
        preset="photo",
        initial=str(tmp_path / "small"),
        detector=tmp_path / "detector.onnx",
        scenes=(tmp_path / "a", tmp_path / "b"),
        mix=(0.5, 0.5),
        image_size=64,
        batch=4,
        shape_steps=0,
        single_steps=0,
        scene_steps=1,
        threads=1,
        bf16=False,
        evidence_scenes=6,
        evaluate_scenes=4,
        photographs=write(tmp_path / "labels"),
    )
    trainer.run(config)
    assert looked == [1]  # every third of two photographs, from the first
    model = load(tmp_path / "run" / "model")
    assert isinstance(model.model.guide, HybridGuide)
    assert model.model.guide.fusion.photograph.tolist() == pytest.approx([1.5, 0.5, 0.8, 0.0])
    assert (model.calibration.objectness_slope, model.calibration.objectness_shift) == (1.0, 0.0)
    card = read_json(tmp_path / "run" / "model" / "config.json")
    assert card["photographs"]["detections"] == 60 and card["training"]["detector"].endswith("detector.onnx")
    first = model.model.state_dict()
    trainer.run(config)  # nothing is left to do: the evidence and the fit are read
    assert looked == [1]
    again = load(tmp_path / "run" / "model").model.state_dict()
    assert all(torch.equal(value, again[name]) for name, value in first.items())
