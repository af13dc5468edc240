"""Devices by name, mixed precision, and that no tensor is made on a default device: story, guide, bound, SVI step, observe."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nolbo_ppl.devices import device_of, mixed_precision, pinned, placed
from nolbo_ppl.errors import InputError
from nolbo_ppl.inference import svi
from nolbo_ppl.inference.elbo import INCLUSIVE, PURE_BOUND, SHAPE_STAGE, SceneELBO, SceneLoss
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.inference.posterior.single_object_predictor import SingleObjectModel
from nolbo_ppl.inference.svi import OptimizerConfig
from nolbo_ppl.models.model_config import ModelConfig
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.prior_predictive import prior_predictive
from nolbo_ppl.models.scene_batch import SceneBatch
from nolbo_ppl.models.shape_vae import ShapeBatch
from nolbo_ppl.structures.object_posteriors import ObjectPosteriors
from nolbo_ppl.training.calibrate import calibrate
from nolbo_ppl.training.evidence_fit import gather_table
from nolbo_ppl.training.stages import StageRun, TrainingStage, scene_weights
from nolbo_ppl.training.validation import validate
from tests.factories import instance_config, random_batch, tiny_config, tiny_model
from tests.fake_device import FAKE, Held, ImplicitDevice, fake_device


def hybrid_config() -> ModelConfig:
    return tiny_config(detector="yolox_nano", image_size=64)


CONFIGS = {
    "mixture": tiny_config,
    "angle": lambda: tiny_config(orientation="angle"),
    "sincos": lambda: tiny_config(orientation="sincos"),
    "instances": instance_config,
    "hybrid": hybrid_config,
    "single": lambda: tiny_config(method="single"),
    "vaegan": lambda: tiny_config(method="vaegan"),
}


def model_of(name: str) -> Nolbo:
    return tiny_model(CONFIGS[name](), scatter=0.3)


def partly_labelled(config: ModelConfig, seed: int = 1) -> SceneBatch:
    """Some labels missing, parts of images unlabelled: every branch of the story is taken."""
    batch = random_batch(config, scenes=3, slots=3, seed=seed)
    category, instance = batch.category.clone(), batch.instance.clone()
    category[0, 0], instance[0, 0], instance[1, 1] = -1, -1, -1
    return batch.replace(
        category=category,
        instance=instance,
        has_viewpoint=batch.has_viewpoint & (torch.arange(3) != 1),
        ignore=torch.tensor([[[2.0, 2.0, 20.0, 20.0]]]).repeat(3, 1, 1),
        exhaustive=torch.tensor([True, True, False]).repeat(len(config.categories), 1).T.contiguous(),
    )


def on_fake(model: Nolbo, batch: Any) -> tuple[Nolbo, Any]:
    with fake_device():
        return model.to(FAKE), placed(batch, FAKE)


def test_names_of_devices(monkeypatch: pytest.MonkeyPatch) -> None:
    assert device_of("cpu") == torch.device("cpu") and device_of(torch.device("meta")).type == "meta"
    for wrong in ("gpu", "cuda:x", "cuda:", "cpu:", "cpu:1", "", "mps:0"):
        with pytest.raises(InputError, match="auto, cpu, cuda"):
            device_of(wrong)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    assert device_of("auto") == torch.device("cpu")
    for absent in ("cuda", "cuda:0", "mps"):
        with pytest.raises(InputError, match="use --device cpu"):
            device_of(absent)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    assert device_of("auto") == torch.device("mps") == device_of("mps")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert device_of("auto") == torch.device("cuda", 0) and device_of("cuda:1") == torch.device("cuda", 1)
    monkeypatch.setenv("LOCAL_RANK", "1")
    assert device_of("auto") == device_of("cuda") == torch.device("cuda", 1) and device_of("cuda:0").index == 0
    with pytest.raises(InputError, match="of 2 CUDA devices"):
        device_of("cuda:2")


def test_mixed_precision_by_kind_of_device() -> None:
    a = torch.randn(3, 3, dtype=torch.float32)
    with mixed_precision(torch.device("cpu"), True):
        assert (a @ a).dtype == torch.bfloat16
        with mixed_precision(torch.device("cpu"), False):
            assert (a @ a).dtype == torch.float32
    with mixed_precision(FAKE, True):
        assert (a @ a).dtype == torch.float32


def test_placed_and_pinned_share_what_need_not_move() -> None:
    batch = random_batch(tiny_config())
    assert placed(batch, torch.device("cpu")).image is batch.image and pinned(batch, torch.device("cpu")) is batch
    moved = placed(batch, FAKE)
    assert {one.device.type for one in vars(moved).values() if isinstance(one, torch.Tensor)} == {"meta"} and moved.ignore is None


def test_the_fake_device_computes_and_refuses() -> None:
    with fake_device():
        x = torch.arange(6.0).reshape(2, 3).to(FAKE)
        assert isinstance(x, Held) and x.device == FAKE
        weight = torch.nn.Parameter(torch.ones(3, device=FAKE))
        loss = (x * weight + x.new_tensor([1.0, 2.0, 3.0])).square().sum()
        loss.backward()
        assert float(loss.detach()) == float(((torch.arange(6.0).reshape(2, 3) + torch.tensor([1.0, 2.0, 3.0])) ** 2).sum())
        assert weight.grad is not None and weight.grad.device == FAKE
        assert x[x > 2].cpu().tolist() == [3.0, 4.0, 5.0]
        for mixing in (lambda: x + torch.ones(3), lambda: x[torch.tensor([0])], lambda: torch.where(x > 1, x, torch.ones(2, 3))):
            with pytest.raises(ImplicitDevice):
                mixing()


def test_a_factory_of_the_library_without_a_device_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    import nolbo_ppl.models.scene_batch as module

    source = "def made():\n    import torch\n    return torch.zeros(3)\n"
    space: dict[str, Any] = {}
    exec(compile(source, module.__file__, "exec"), space)
    with fake_device(), pytest.raises(ImplicitDevice, match=r"zeros without a device in /models/scene_batch.py"):
        space["made"]()


@pytest.mark.parametrize(
    ("name", "weights"), [*((name, INCLUSIVE) for name in CONFIGS), ("sincos", PURE_BOUND), ("instances", PURE_BOUND)]
)
def test_bound_and_step_are_those_of_the_cpu(name: str, weights: dict[str, float]) -> None:
    results = []
    for fake in (False, True):
        model = model_of(name)
        batch = partly_labelled(model.config)
        if fake:
            model, batch = on_fake(model, batch)
        weights = scene_weights("inclusive", method=model.config.method) if weights is INCLUSIVE else weights
        stage = TrainingStage("scenes", OptimizerConfig(2, optimizer="muon", warmup=0), weights, decode=2)
        if fake:
            with fake_device():
                run = StageRun(model, stage)
                info = run.step(batch)
                state = {key: value.cpu() for key, value in svi.state_tensors(run.state).items()}
        else:
            run = StageRun(model, stage)
            info = run.step(batch)
            state = svi.state_tensors(run.state)
        results.append((info, state))
    (expected, state), (found, on_device) = results
    assert found.terms == pytest.approx(expected.terms, rel=1e-9) and found.loss == pytest.approx(expected.loss, rel=1e-9)
    assert found.gradient_norm == pytest.approx(expected.gradient_norm, rel=1e-7)
    assert state.keys() == on_device.keys()
    for key, value in state.items():
        torch.testing.assert_close(on_device[key], value, rtol=1e-4, atol=1e-6, check_dtype=False)


def test_shapes_are_learnt_there_too() -> None:
    model = model_of("instances")
    scenes = random_batch(model.config, scenes=2, slots=4)
    batch = ShapeBatch(scenes.voxels.flatten(0, 1), scenes.category.flatten(), scenes.instance.flatten(), torch.randn(8, 4))
    stage = TrainingStage("shapes", OptimizerConfig(1), SHAPE_STAGE)
    expected = StageRun(model_of("instances"), stage).step(batch)
    model, batch = on_fake(model, batch)
    with fake_device():
        found = StageRun(model, stage).step(batch)
    assert found.terms == pytest.approx(expected.terms, rel=1e-9)


def observer(name: str) -> ObservationModel:
    if name == "single":
        return SingleObjectModel(model_of(name), None, ObservationModel(model_of("mixture")))
    return ObservationModel(model_of(name))


def pictures() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256, (64, 64, 3), dtype=np.uint8) for _ in range(2)]


def same_answer(a: ObjectPosteriors, b: ObjectPosteriors) -> None:
    for field in dataclasses.fields(ObjectPosteriors):
        one, other = getattr(a, field.name), getattr(b, field.name)
        if isinstance(one, np.ndarray):
            np.testing.assert_allclose(other, one, rtol=1e-6, atol=1e-9, err_msg=field.name)


@pytest.mark.parametrize("name", ["mixture", "instances", "hybrid", "single"])
def test_observe_answers_as_on_the_cpu(name: str) -> None:
    boxes = [np.array([[5.0, 5.0, 40.0, 30.0], [20.0, 10.0, 60.0, 60.0]]), np.zeros((0, 4))]
    camera = [60.0, 60.0, 32.0, 32.0]
    expected = observer(name)
    found = expected.observe(pictures(), camera, threshold=0.005)
    at_boxes = expected.observe_boxes(pictures(), camera, boxes)
    assert sum(map(len, found)) > 3
    device_model = observer(name)
    with fake_device():
        device_model = device_model.to(FAKE)
        again, boxed = (
            device_model.observe(pictures(), camera, threshold=0.005),
            device_model.observe_boxes(pictures(), camera, boxes),
        )
        shape = device_model.decode(device_model.prior_mean()[:2])
    assert device_model.device == FAKE
    for a, b in zip([*found, *at_boxes], [*again, *boxed]):
        same_answer(a, b)
    np.testing.assert_allclose(shape, expected.decode(expected.prior_mean()[:2]), rtol=1e-9)


@pytest.mark.parametrize("name", ["mixture", "hybrid"])
def test_validation_calibration_and_evidence(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nolbo_ppl.training.calibrate.MIN_OBJECTS", 5)
    batches = [random_batch(CONFIGS[name](), scenes=3, slots=3, seed=s) for s in (1, 2)]
    expected = validate(model_of(name), batches), calibrate(model_of(name), batches)
    model = model_of(name)
    with fake_device():
        model.to(FAKE)
        found = validate(model, batches), calibrate(model, batches)
        table = gather_table(model.guide, placed(batches[0], FAKE)) if name == "hybrid" else None  # type: ignore[arg-type]
    assert found[0] == pytest.approx(expected[0], rel=1e-7)
    assert dataclasses.astuple(found[1]) == pytest.approx(dataclasses.astuple(expected[1]), rel=1e-6)
    if table is not None:
        assert type(table.look) is torch.Tensor and type(table.detector.box) is torch.Tensor


def test_draws_of_the_prior() -> None:
    model = model_of("mixture")
    with fake_device():
        drawn = prior_predictive(model.to(FAKE).story, 4, seed=0)
    assert drawn.voxels.device == FAKE and drawn.category.device == FAKE


def test_sceneloss_without_terms_lies_with_the_parameters() -> None:
    model, batch = on_fake(model_of("mixture"), random_batch(tiny_config()))
    with fake_device():
        assert SceneLoss(model.story, model.guide, SceneELBO({}))(batch).loss.device == FAKE


@pytest.mark.gpu
@pytest.mark.parametrize("name", CONFIGS)
def test_a_gpu_gives_the_numbers_of_the_cpu(name: str, tmp_path: Path) -> None:
    device = device_of("cuda")
    batch = partly_labelled(CONFIGS[name]())
    stage = TrainingStage("scenes", OptimizerConfig(1, optimizer="muon", warmup=0), INCLUSIVE, decode=2)
    expected = StageRun(model_of(name), stage).step(batch)
    found = StageRun(model_of(name).to(device), stage).step(placed(pinned(batch, device), device))
    assert found.terms == pytest.approx(expected.terms, rel=1e-6)
    camera = [60.0, 60.0, 32.0, 32.0]
    on_cpu = ObservationModel(model_of(name)).observe(pictures(), camera, threshold=0.005)
    on_gpu = ObservationModel(model_of(name)).to(device).observe(pictures(), camera, threshold=0.005)
    for a, b in zip(on_cpu, on_gpu):
        same_answer(a, b)
