"""`nolbo train --learn shape_look`: the look learns, all else of the initial weights stays as it is."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.posterior.model_folder import load, save
from nolbo_ppl.inference.svi import OptimizerConfig
from nolbo_ppl.io.tensors import load_tensors
from nolbo_ppl.models.model_config import nano
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.posterior_calibration import Calibration
from nolbo_ppl.synthetic.dataset_writer import write_scenes
from nolbo_ppl.synthetic.scenes.scene_config import preset
from nolbo_ppl.synthetic.scenes.scene_generator import SceneGenerator
from nolbo_ppl.training.initial_weights import LOOK, adopt
from nolbo_ppl.training.stages import StageRun, TrainingStage
from nolbo_ppl.training.train_config import TrainConfig
from nolbo_ppl.training.trainer import run
from tests.factories import random_batch, tiny_config, tiny_model

CALIBRATION = Calibration(label_slope=1.3, range_scale=0.7, shape_scale=2.5, shape_correlation=0.4, objectness_limit=0.97)


@pytest.fixture
def _single_precision(_float64: None) -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_default_dtype(torch.float32)
    yield
    torch.set_num_threads(threads)


@pytest.mark.parametrize("detector", ["", "yolox_nano"])
def test_the_look_alone_learns(detector: str) -> None:
    """One batch again and again: its shapes are known better, and nothing but the look has moved, statistics included."""
    config = tiny_config(shape_look=32, detector=detector)
    model = tiny_model(config, scatter=0.3)
    optimisation = OptimizerConfig(steps=25, learning_rate=1e-2, warmup=1, decay=0.0)
    stage = TrainingStage("scenes", optimisation, {"shape_inclusive": 1.0}, freeze=25, shape_look_alone=True)
    stage_run = StageRun(model, stage)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    batch = random_batch(config, 2, 3, seed=1)
    losses = [stage_run.step(batch).loss for _ in range(25)]
    moved = {name for name, value in model.state_dict().items() if not torch.equal(value, before[name])}
    assert all(name.startswith(LOOK) for name in moved)
    assert any("running_mean" in name for name in moved) and any("judge" in name for name in moved)
    assert min(losses[-5:]) < losses[0] - 1.0


def test_its_encoder_starts_as_the_guides() -> None:
    plain = tiny_model(tiny_config(), seed=3, scatter=0.3)
    larger = tiny_model(tiny_config(shape_look=32), seed=4)
    adopt(larger, plain, None)
    assert larger.guide.shape_look is not None
    own = larger.guide.shape_look.encoder.state_dict()
    assert all(torch.equal(value, own[name]) for name, value in plain.guide.encoder.state_dict().items())
    assert all(torch.equal(larger.state_dict()[name], value) for name, value in plain.state_dict().items())


def test_training_of_the_look(tmp_path: Path, _single_precision: None) -> None:
    """By the verb: other weights bit for bit, other factors of the calibration as they were; a second run goes on from it."""
    model = Nolbo.from_seed(nano(), 0)
    save(tmp_path / "initial", model, CALIBRATION, {})
    source = SceneGenerator(preset("easy", 64), 3, instances=2)
    write_scenes(tmp_path / "train", source, 12)
    write_scenes(tmp_path / "held_out", SceneGenerator(preset("easy", 64), 4, instances=2), 36)
    config = TrainConfig(
        out=tmp_path / "run", initial=str(tmp_path / "initial"), shape_look=32, learn="shape_look", scenes=(tmp_path / "train",),
        validation=tmp_path / "held_out", batch=4, shape_steps=0, single_steps=0, scene_steps=3, learning_rate=0.01, threads=1,
        bf16=False, evaluate_scenes=4,
    )  # fmt: skip
    run(config)
    found = load(tmp_path / "run" / "model", "cpu")
    assert found.config == dataclasses.replace(nano(), shape_look=32)
    learnt = load_tensors(tmp_path / "run" / "model" / "model.safetensors")[0]
    assert all(torch.equal(learnt[name], value) for name, value in model.state_dict().items())
    assert bool(learnt[f"{LOOK}judge.6.weight"].any())
    shapes = {name: getattr(CALIBRATION, name) for name in ("shape_scale", "shape_correlation")}
    assert dataclasses.replace(found.calibration, **shapes) == CALIBRATION
    assert found.calibration.shape_scale != CALIBRATION.shape_scale
    again = dataclasses.replace(
        config, out=tmp_path / "again", initial=str(tmp_path / "run" / "model"), shape_look=0, scene_steps=1
    )
    run(again)
    assert load(tmp_path / "again" / "model", "cpu").config.shape_look == 32


def test_refusals(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="learn shape_look"):
        TrainConfig(learn="shape_look", initial="tiny")  # with steps of shapes
    with pytest.raises(InputError, match="learn shape_look"):
        TrainConfig(learn="shape_look", shape_steps=0)
    save(tmp_path / "plain", Nolbo.from_seed(nano(), 0), Calibration(), {})
    with pytest.raises(InputError, match="--shape-look 96"):
        TrainConfig(learn="shape_look", initial=str(tmp_path / "plain"), shape_steps=0).model()
    save(tmp_path / "look", Nolbo.from_seed(dataclasses.replace(nano(), shape_look=32), 0), Calibration(), {})
    with pytest.raises(InputError, match="as the initial weights"):
        TrainConfig(initial=str(tmp_path / "look"), shape_look=64, shape_steps=0).model()
