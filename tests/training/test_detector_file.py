"""The public ONNX file of the detector, read into our own module (where the file is there)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from nolbo_ppl.categories import CATEGORIES
from nolbo_ppl.errors import InputError
from nolbo_ppl.evaluation.peers import OnnxPeer
from nolbo_ppl.training.detector_file import read_detector


@pytest.fixture(scope="module")
def file(data_dir: Path) -> Path:
    path = data_dir / "nets" / "yolox_nano.onnx"
    if not path.is_file():
        pytest.skip(f"no detector at {path}")
    return path


def test_our_network_is_the_files(file: Path) -> None:
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    model = read_detector(file).float()
    image = np.random.default_rng(0).integers(0, 256, (1, 3, 416, 416)).astype(np.float32)
    session = onnxruntime.InferenceSession(str(file))
    raw = session.run(None, {"images": np.ascontiguousarray(image[:, ::-1])})[0][0]
    with torch.no_grad():
        ours = model(torch.from_numpy(image))
    np.testing.assert_allclose(torch.sigmoid(ours.objectness[0]).numpy(), raw[:, 4], atol=1e-4)
    np.testing.assert_allclose(torch.sigmoid(ours.classes[0]).numpy(), raw[:, 5:], atol=1e-3)
    box, _ = OnnxPeer(file, CATEGORIES)._decode_yolox(raw.astype(np.float64))
    np.testing.assert_allclose(ours.box[0].numpy(), box, rtol=1e-3, atol=0.05)


def test_other_files_are_refused(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    with pytest.raises(InputError, match="detector file"):
        read_detector(tmp_path / "missing.onnx")
    node = onnx.helper.make_node("Relu", ["x"], ["y"])
    value = [onnx.helper.make_tensor_value_info(name, 1, [1]) for name in "xy"]
    onnx.save(onnx.helper.make_model(onnx.helper.make_graph([node], "other", value[:1], value[1:])), str(tmp_path / "other.onnx"))
    with pytest.raises(InputError, match="0 convolutions"):
        read_detector(tmp_path / "other.onnx")
