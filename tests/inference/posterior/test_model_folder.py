"""Model folders: what is saved comes back, what is damaged is refused by name."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

import nolbo_ppl
from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.posterior.model_folder import FORMAT, LEARNT_LATER, load, save
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.io.tensors import file_hash, load_tensors, save_tensors
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.posterior_calibration import Calibration
from tests.factories import instance_config, tiny_config, tiny_model

CAMERA = [70.0, 70.0, 32.0, 32.0]


def saved(folder: Path, half: bool = False) -> ObservationModel:
    model = tiny_model(instance_config(), scatter=0.1)
    with torch.no_grad():
        model.guide.head.objectness.bias.fill_(0.0)
        for parameter in model.parameters():  # what the file can hold
            parameter.copy_(parameter.half() if half and parameter.dim() > 1 else parameter.float())
    calibration = Calibration(shape_scale=1.2, objectness_shift=0.3)
    save(folder, model.float(), calibration, {"trained_by": "a test"}, half=half)
    return ObservationModel(model.double(), calibration)


@pytest.mark.parametrize("half", [False, True])
def test_round_trip(tmp_path: Path, half: bool) -> None:
    model = saved(tmp_path, half)
    again = load(tmp_path)
    assert again.config == model.config
    assert again.calibration == model.calibration
    image = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    a, b = (m.observe(image, CAMERA, threshold=0.5, samples=2) for m in (model, again))
    assert len(a) == len(b) > 0
    np.testing.assert_allclose(a.position, b.position, atol=1e-6)
    np.testing.assert_allclose(a.voxel_mean, b.voxel_mean, atol=1e-6)
    assert json.loads((tmp_path / "config.json").read_text())["trained_by"] == "a test"


def test_half_precision_halves_the_file(tmp_path: Path) -> None:
    saved(tmp_path / "full")
    saved(tmp_path / "half", half=True)
    sizes = [(tmp_path / name / "model.safetensors").stat().st_size for name in ("half", "full")]
    assert sizes[0] < 0.7 * sizes[1]


def test_unknown_names_and_damaged_folders(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no such model: got 'nonsense'.*config.json"):
        load("nonsense")
    saved(tmp_path)
    config, weights = tmp_path / "config.json", tmp_path / "model.safetensors"
    good = weights.read_bytes()
    weights.write_bytes(good[: len(good) // 2])
    with pytest.raises(InputError, match=r"model.safetensors: not a readable safetensors file"):
        load(tmp_path)
    weights.unlink()
    with pytest.raises(InputError, match=r"model.safetensors: no such file"):
        load(tmp_path)
    weights.write_bytes(good)
    values = json.loads(config.read_text())
    for change, message in (
        ({"model": {**values["model"], "latent_dim": 8}}, r"model.safetensors: weight .*expected shape"),
        ({"model": {**values["model"], "encoder_blocks": [1, 1, 1]}}, r"weights do not fit the model.*missing"),
        ({"model": {**values["model"], "flavour": 1}}, r"unknown fields of a model configuration.*flavour"),
        ({"calibration": {"shape_scale": -1.0}}, "calibration factor shape_scale"),
        ({"calibration": {"slope": 1.0}}, "unknown calibration factors"),
        ({"calibration": {"shape_scale": "1"}}, r"config.json: calibration factor shape_scale"),
        ({"calibration": [1]}, r"config.json: calibration: got list"),
        ({"model": {**values["model"], "glimpse_blocks": 10**9}}, r"config.json: a model configuration: glimpse_blocks"),
        ({"model": {**values["model"], "head_width": 8000}}, r"model.safetensors: weight"),
        ({"sha256": "0" * 64}, r"model.safetensors: weights were changed: got \w+, expected SHA-256 000"),
    ):
        config.write_text(json.dumps({**values, **change}))
        with pytest.raises(InputError, match=message):
            load(tmp_path)
    config.write_text("[]")
    with pytest.raises(InputError, match=r"config.json: not a model configuration"):
        load(tmp_path)
    config.write_text("{")
    with pytest.raises(InputError, match=r"config.json:1: not valid JSON"):
        load(tmp_path)


def test_weights_that_were_exchanged_are_noticed(tmp_path: Path) -> None:
    """Other weights of the same form pass every check but the hash."""
    saved(tmp_path)
    load(tmp_path)
    weights = tmp_path / "model.safetensors"
    tensors, meta = load_tensors(weights)
    name = next(name for name, tensor in tensors.items() if tensor.is_floating_point())
    tensors[name] = tensors[name] + 1
    save_tensors(weights, tensors, meta)
    with pytest.raises(InputError, match="weights were changed"):
        load(tmp_path)


def test_shipped_weights_state_their_hash() -> None:
    for file in (Path(nolbo_ppl.__file__).parent / "weights").glob("*/config.json"):
        assert json.loads(file.read_text())["sha256"] == file_hash(file.with_name("model.safetensors")), file


def test_the_format_of_the_weights_is_read(tmp_path: Path) -> None:
    saved(tmp_path)
    tensors, facts = load_tensors(tmp_path / "model.safetensors")
    assert facts == {"format": FORMAT}
    described = json.loads((tmp_path / "config.json").read_text())
    del described["sha256"]  # as files of 0.1.0, which stated none
    (tmp_path / "config.json").write_text(json.dumps(described))
    save_tensors(tmp_path / "model.safetensors", tensors, {})  # nor need there be a number
    load(tmp_path)
    for stated in (FORMAT + 1, 0, "new"):
        save_tensors(tmp_path / "model.safetensors", tensors, {"format": stated})
        with pytest.raises(InputError, match=r"model.safetensors: a model of another format: .*update nolbo_ppl"):
            load(tmp_path)


def test_models_of_before_shifts_and_sizes_load_with_nothing_known(tmp_path: Path) -> None:
    torch.set_default_dtype(torch.float32)
    model = Nolbo.from_seed(tiny_config(detector="yolox_nano"), 0)
    older = {name: value for name, value in model.state_dict().items() if not name.startswith(LEARNT_LATER)}
    assert len(older) < len(model.state_dict())
    save(tmp_path, model, Calibration(), {})
    tensors, meta = load_tensors(tmp_path / "model.safetensors")
    save_tensors(tmp_path / "model.safetensors", {name: tensors[name] for name in older}, meta)
    config = json.loads((tmp_path / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps({**config, "sha256": None}))
    found = load(tmp_path, "cpu").model.state_dict()
    assert not any(bool(found[name].any()) for name in ("guide.shift.inverse_span", "guide.sizes.precision"))
    assert all(torch.equal(found[name], value) for name, value in older.items())
