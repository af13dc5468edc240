"""Stages of training: what moves, what is frozen, and two processes that are one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from nolbo_ppl.inference.elbo import INCLUSIVE, PAPER, PURE_BOUND, SHAPE_STAGE, SceneELBO
from nolbo_ppl.inference.svi import OptimizerConfig, restore, state_tensors
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.shape_vae import ShapeBatch
from nolbo_ppl.training.stages import OBJECTIVES, StageRun, TrainingStage, scene_weights, seeded_noise, shorten
from nolbo_ppl.training.validation import validate
from tests.factories import random_batch, run_in_two_processes, tiny_config, tiny_model
from tests.gloo_worker import local_batch, local_run, training

QUICK = OptimizerConfig(steps=4, learning_rate=1e-2, warmup=1, decay=0.0, ema=0.5)


def snapshot(model: Nolbo) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in model.state_dict().items()}


def moved(before: dict[str, torch.Tensor], model: Nolbo) -> set[str]:
    """Names of the tensors that are not bit-identical any more."""
    return {name for name, value in model.state_dict().items() if not torch.equal(value, before[name])}


def test_frozen_parts_stay_bit_identical() -> None:
    """Decoder, prior and 3D encoder with their statistics, for the steps of the freeze, evaluations in between."""
    config = tiny_config()
    model = tiny_model(config)
    weights = scene_weights("elbo", {"voxels": 0.01})
    run = StageRun(model, TrainingStage("scenes", QUICK, weights, freeze=2, decode=16))
    before = snapshot(model)
    for step in range(4):
        run.step(random_batch(config, seed=step))
        changed = moved(before, model)
        if step < 2:
            validate(model, [random_batch(config, seed=9)])
            assert all(name.startswith("guide.") for name in changed)
            frozen = {n: v for n, v in run.state.average.items() if not n.startswith("guide.")}
            assert all(torch.equal(value, before[name]) for name, value in frozen.items())
        assert any(name.startswith("guide.encoder") and "running" in name for name in changed)
    assert {name for name in before if name.startswith("story.prior") and "one_hot" not in name} <= changed
    assert any(name.startswith("story.decoder") and "running_mean" in name for name in changed)
    assert not any(name.startswith("shape_guide") for name in changed)
    assert run.finished


def test_a_stage_frozen_throughout_never_moves_the_story() -> None:
    config = tiny_config()
    model = tiny_model(config)
    run = StageRun(model, TrainingStage("single", QUICK, scene_weights("inclusive"), freeze=4))
    before = snapshot(model)
    for step in range(4):
        run.step(random_batch(config, seed=step))
    assert all(name.startswith("guide.") for name in moved(before, model))


def test_stage_of_shapes_leaves_the_image_guide_alone() -> None:
    config = tiny_config()
    model = tiny_model(config)
    run = StageRun(model, TrainingStage("shapes", QUICK, {"shape_kl": 1.0, "voxels": 1.0}))
    before = snapshot(model)
    scene = random_batch(config, 1, 4)
    batch = ShapeBatch(scene.voxels[0], scene.category[0], scene.instance[0], scene.noise[0])
    losses = [run.step(batch).loss for _ in range(4)]
    changed = moved(before, model)
    assert not any(name.startswith("guide.") for name in changed)
    for part in ("shape_guide", "story.decoder", "story.prior"):
        assert any(name.startswith(part) for name in changed), part
    assert losses[-1] < losses[0]


def test_the_label_of_a_shape_latent_by_bayes() -> None:
    """`shape_label`: log p(l | z) of the mixture with equal weights, at the sample that the noise stands for."""
    model = tiny_model().eval()
    scene = random_batch(tiny_config(), 1, 4)
    batch = ShapeBatch(scene.voxels[0], scene.category[0], scene.instance[0], scene.noise[0])
    terms = SceneELBO(SHAPE_STAGE).terms(model.shape_model, model.shape_guide, batch, names={"shape_label"})
    loc, scale = model.shape_guide.posterior(batch.voxels)
    z, mean = loc + scale * batch.noise, model.story.prior.category_mean()
    density = torch.distributions.MultivariateNormal(mean, torch.eye(mean.shape[1])).log_prob(z[:, None]).exp()
    own = density[torch.arange(4), batch.category] / density.sum(1)
    torch.testing.assert_close(terms["shape_label"], own.log().sum())


def test_the_label_of_a_shape_latent_keeps_categories_apart() -> None:
    """With the term, the shape stage makes the label of a latent more certain than without it."""
    scene = random_batch(tiny_config(), 1, 4)
    batch = ShapeBatch(scene.voxels[0], scene.category[0], scene.instance[0], scene.noise[0])
    certain = {}
    for weight in (0.0, 50.0):
        model = tiny_model()
        weights = {"shape_kl": 1.0, "voxels": 0.01} | ({"shape_label": weight} if weight else {})
        run = StageRun(model, TrainingStage("shapes", replace(QUICK, steps=20), weights))
        for _ in range(20):
            run.step(batch)
        model.eval()
        elbo = SceneELBO(SHAPE_STAGE)
        terms = elbo.terms(model.shape_model, model.shape_guide, batch, names={"shape_label"})
        certain[weight] = float(terms["shape_label"].detach())
    assert certain[50.0] > certain[0.0] + 0.1, certain


@pytest.mark.parametrize("objective", ["inclusive", "elbo", "paper"])
def test_every_objective_learns(objective: str) -> None:
    """One scene, a few steps: the loss falls."""
    config = tiny_config()
    model = tiny_model(config)
    longer = OptimizerConfig(steps=12, learning_rate=5e-3, warmup=1, decay=0.0, ema=0.5)
    run = StageRun(model, TrainingStage("scenes", longer, scene_weights(objective, {"voxels": 0.0})))
    batch = random_batch(config, 1, 2)
    losses = [run.step(batch).loss for _ in range(12)]
    assert losses[-1] < 0.95 * losses[0]


def test_the_average_is_adopted() -> None:
    config = tiny_config()
    model = tiny_model(config)
    run = StageRun(model, TrainingStage("scenes", QUICK, scene_weights("inclusive")))
    for step in range(3):
        run.step(random_batch(config, seed=step))
    copy = run.averaged()
    assert not copy.training
    run.load_ema()
    for (name, ours), averaged in zip(model.state_dict().items(), copy.state_dict().values(), strict=True):
        assert torch.equal(ours, averaged), name


def test_weights_of_objectives() -> None:
    assert OBJECTIVES == {"inclusive": INCLUSIVE, "elbo": PURE_BOUND, "paper": PAPER}
    assert "voxels" not in scene_weights("inclusive")
    assert scene_weights("elbo", {"voxels": 0.005})["voxels"] == 0.005
    assert "box" not in scene_weights("elbo", {"box": 0.0})


def test_shorter_stages_freeze_in_proportion() -> None:
    stage = shorten(TrainingStage("scenes", OptimizerConfig(steps=1000), INCLUSIVE, freeze=400), 100)
    assert (stage.optimisation.steps, stage.freeze) == (100, 40)


def test_noise_depends_on_seed_and_step_only() -> None:
    torch.manual_seed(0)
    first = seeded_noise(3, 5, 2, 4)
    torch.manual_seed(1)
    assert torch.equal(seeded_noise(3, 5, 2, 4), first)
    assert not torch.equal(seeded_noise(3, 6, 2, 4), first)
    assert not torch.equal(seeded_noise(4, 5, 2, 4), first)


@pytest.mark.slow
def test_two_processes_train_as_one_with_the_joint_batch(tmp_path: Path) -> None:
    """Shapes, then scenes frozen, free, and with one process that has no voxels: the same weights and averages."""
    first, second = run_in_two_processes("training", tmp_path)
    joint = training(None)
    assert set(first) == set(joint)
    for name, value in joint.items():
        assert torch.equal(first[name], second[name]), name
        torch.testing.assert_close(first[name], value.detach(), atol=1e-5, rtol=0, msg=name)


@pytest.mark.slow
def test_steps_made_alone_are_averaged(tmp_path: Path) -> None:
    """Against two runs in this process that know nothing of each other and whose states are averaged by hand."""
    first, second = run_in_two_processes("local", tmp_path)
    assert set(first) == set(second)
    runs = [local_run(0), local_run(0)]
    for step in range(3):
        for rank, run in enumerate(runs):
            run.step(local_batch(rank, step))
        if step == 0:
            continue
        states = [state_tensors(run.state) for run in runs]
        assert any(not torch.equal(states[0][name], states[1][name]) for name in states[0])
        mean = {name: (value + states[1][name]) / 2 if value.is_floating_point() else value for name, value in states[0].items()}
        for name, value in mean.items():
            assert torch.equal(first[f"{step}/{name}"], second[f"{step}/{name}"]), name
            torch.testing.assert_close(first[f"{step}/{name}"], value, atol=1e-9, rtol=1e-9, msg=name)
        for run in runs:
            restore(run.state, mean, run.state.step)
