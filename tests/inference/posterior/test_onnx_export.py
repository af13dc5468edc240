"""Exported graphs say what the model says, in onnxruntime and without torch; the page that shows it runs."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from nolbo_ppl.cli import main
from nolbo_ppl.errors import InputError
from nolbo_ppl.evaluation.labelled_scenes import GeneratedScenes
from nolbo_ppl.inference.posterior.model_folder import load, save
from nolbo_ppl.inference.posterior.onnx_export import OUTPUTS, export_onnx
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.models.distributions import bessel
from nolbo_ppl.models.evidence import _joint_log_odds
from nolbo_ppl.models.posterior_calibration import Calibration
from nolbo_ppl.structures.object_posteriors import ObjectPosteriors
from nolbo_ppl.synthetic.scenes.scene_config import preset
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator
from tests.factories import tiny_config, tiny_model

onnxruntime = pytest.importorskip("onnxruntime")
PAGE = Path(__file__).resolve().parents[3] / "docs" / "howto" / "without-torch.md"
CALIBRATION = Calibration(1.3, 0.4, 0.8, 0.7, 1.2, 1.1, 0.9, 1.4)


def answers(folder: Path, image: np.ndarray, camera: np.ndarray) -> dict[str, np.ndarray]:
    session = onnxruntime.InferenceSession(str(folder / "guide.onnx"), providers=["CPUExecutionProvider"])
    height, width = image.shape[:2]
    given = {
        "image": image.transpose(2, 0, 1)[None].astype(np.float32),
        "intrinsics": camera.astype(np.float32),
        "extent": np.array([width, height], dtype=np.float32),
    }
    names = json.loads((folder / "model.json").read_text())["guide_inputs"]
    return dict(zip(OUTPUTS, session.run(list(OUTPUTS), {name: given[name] for name in names})))


def compared(found: dict[str, np.ndarray], expected: ObjectPosteriors) -> int:
    """Rows of a graph's answer that are rows of the model's, within 1e-4 of the largest number of each."""
    matched = 0
    for k, box in enumerate(found["box"]):
        distance = np.abs(expected.box - box).max(1)
        row = int(distance.argmin())
        if distance[row] > 1e-3:
            continue  # below CANDIDATE
        if np.ptp(np.sort(expected.class_log_posterior[row])[-2:]) < 1e-4:
            continue  # of two categories either is the likeliest
        matched += 1
        for name in OUTPUTS[2:]:
            if name.startswith("azimuth"):
                field = {"azimuth_weights": "weights", "azimuth": "azimuth", "azimuth_concentration": "concentration"}[name]
                value = getattr(expected.viewpoint_modes, field)[row]
            else:
                value = getattr(expected, name)[row]
            scale = max(1.0, float(np.abs(value).max()))
            # A covariance is a square: its relative difference is twice that of the scale.
            most = 2e-4 if name == "position_covariance" else 1e-4
            np.testing.assert_allclose(found[name][k] / scale, value / scale, rtol=0, atol=most, err_msg=name)
    return matched


CHANGES: list[dict[str, Any]] = [
    {"shape_look": 32},
    {"detector": "yolox_nano"},
    {"orientation": "angle", "voxel_patches": False},
]


@pytest.mark.parametrize("changes", CHANGES, ids=str)
def test_onnxruntime_gives_the_same_posterior(tmp_path: Path, changes: dict[str, Any]) -> None:
    networks = tiny_model(tiny_config(**changes), scatter=0.3)
    if networks.guide.shape_look is not None:
        torch.nn.init.normal_(networks.guide.shape_look.judge[-1].weight, std=0.3, generator=torch.Generator().manual_seed(2))
    model = ObservationModel(networks, CALIBRATION)
    candidates = 2 * 4 * 4 if not changes.get("detector") else 20
    files = export_onnx(model, tmp_path, (64, 64), candidates)
    image = np.random.default_rng(3).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    camera = np.array([60.0, 62.0, 32.0, 30.0])
    found = answers(tmp_path, image, camera)
    expected = model.observe(image, camera, threshold=1e-6, iou_threshold=1.0, decode=False)  # every region for itself
    assert len(expected) >= candidates / 2
    matched = compared(found, expected)
    assert matched >= candidates / 2
    decoder = onnxruntime.InferenceSession(str(files.decoder), providers=["CPUExecutionProvider"])
    latent = np.random.default_rng(0).standard_normal((3, model.config.latent_dim))
    (voxels,) = decoder.run(None, {"latent": latent.astype(np.float32)})
    np.testing.assert_allclose(voxels, model.decode(latent), atol=1e-4)


@pytest.mark.parametrize("name", ["tiny", pytest.param("photo", marks=pytest.mark.slow)])
def test_the_shipped_weights_say_the_same(name: str, tmp_path: Path) -> None:
    """`tiny` and `photo` in onnxruntime, in single precision, beside torch in double, on a rendered scene: the likeliest
    regions, and the shapes of their objects."""
    own = load(name, "cpu")
    size = own.config.image_size
    files = export_onnx(own, tmp_path, candidates=12)
    double = ObservationModel(own.model.double(), own.calibration)
    scene = GeneratedScenes(SceneGenerator(preset("standard", 128), 77, instances=2), 1)[0]
    image = np.asarray(Image.fromarray(scene.image).resize((size, size), Image.Resampling.BILINEAR))
    camera = scene.intrinsics * size / 128
    found = answers(tmp_path, image, camera)
    least = max(1e-6, 0.9 * float(found["objectness"].min()))
    expected = double.observe(image, camera, threshold=least, iou_threshold=1.0, decode=False)
    assert compared(found, expected) >= 8
    decoder = onnxruntime.InferenceSession(str(files.decoder), providers=["CPUExecutionProvider"])
    latent = found["latent"][:2].astype(np.float32)
    (voxels,) = decoder.run(None, {"latent": latent})
    np.testing.assert_allclose(voxels, double.decode(latent), atol=1e-4)


def test_functions_of_graphs_are_those_of_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    x = torch.logspace(-6, 3, 400, dtype=torch.float64)
    np.testing.assert_allclose(bessel._log_i0e_of_graphs(x), bessel.log_i0e(x), atol=1e-6)
    a, b = torch.linspace(-40, 40, 101, dtype=torch.float64), torch.linspace(30, -50, 101, dtype=torch.float64)
    own = _joint_log_odds(a, b)
    monkeypatch.setattr(torch.jit, "is_tracing", lambda: True)
    np.testing.assert_allclose(_joint_log_odds(a, b), own, atol=1e-6)


def test_what_cannot_be_exported_is_refused(tmp_path: Path) -> None:
    model = ObservationModel(tiny_model())
    with pytest.raises(InputError, match="multiples of 32"):
        export_onnx(model, tmp_path, (64, 50))
    with pytest.raises(InputError, match="1 to 32 regions"):
        export_onnx(model, tmp_path, (64, 64), candidates=33)
    with pytest.raises(InputError, match="single objects"):
        export_onnx(ObservationModel(tiny_model(tiny_config(method="single"))), tmp_path)


def test_the_page_runs_without_torch(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    torch.set_default_dtype(torch.float32)
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    config = tiny_config()
    save(tmp_path / "own", tiny_model(config, scatter=0.3).float(), Calibration(objectness_shift=3.0, objectness_limit=0.9), {})
    main(["export", "--model", str(tmp_path / "own"), "--out", str(tmp_path / "exported"), "--candidates", "32"])
    assert "guide.onnx" in capsys.readouterr().out
    image = np.random.default_rng(5).integers(0, 256, (96, 160, 3), dtype=np.uint8)
    Image.fromarray(image).save(tmp_path / "street.png")
    without = "import sys\nsys.modules['torch'] = sys.modules['nolbo_ppl'] = None\n"  # importing them is an error
    (tmp_path / "page.py").write_text(f"{without}{code}\nnp.savez('objects.npz', **objects)\n")
    run = subprocess.run([sys.executable, "page.py"], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr
    assert "voxels" in run.stdout
    with np.load(tmp_path / "objects.npz") as file:
        found = dict(file)
    own = load(tmp_path / "own", "cpu")
    double = ObservationModel(own.model.double(), own.calibration)
    expected = double.observe(image, [150.0, 150.0, 80.0, 48.0], decode=False)
    assert len(found["box"]) == len(expected) > 0
    order = np.argsort(-found["objectness"], kind="stable")
    np.testing.assert_allclose(found["objectness"][order], expected.objectness, atol=1e-4)
    np.testing.assert_allclose(found["position"][order], expected.position, rtol=1e-3, atol=1e-3)
