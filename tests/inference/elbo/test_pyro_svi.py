"""Pyro's own SVI on the model and guide: parameters move, losses agree, copies and other models are left alone."""

from __future__ import annotations

import copy
from collections.abc import Callable

import pyro
import pytest
import torch
from pyro.infer import ELBO, SVI, Trace_ELBO, TraceEnum_ELBO
from pyro.optim import Adam, ClippedAdam
from torch import Tensor

from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.elbo import INCLUSIVE, PURE_BOUND, SHAPE_STAGE, SceneELBO, SceneLoss
from nolbo_ppl.inference.svi import OptimizerConfig
from nolbo_ppl.models.observation_model import Nolbo
from nolbo_ppl.models.shape_vae import ShapeBatch
from nolbo_ppl.training.stages import StageRun, TrainingStage
from tests.bound_cases import unsymmetric
from tests.factories import assert_within, observed_scene, random_batch, repeat_scene, tiny_config, tiny_model


def parts(model: Nolbo) -> dict[str, Tensor]:
    """Copies of the parameters of each part."""
    found = {
        "encoder": model.guide.encoder,
        "head": model.guide.head,
        "prior": model.story.prior,
        "decoder": model.story.decoder,
    }
    return {name: torch.cat([p.detach().flatten() for p in part.parameters()]) for name, part in found.items()}


LOSSES: dict[str, Callable[[], ELBO]] = {
    "scene": SceneELBO,
    "inclusive": lambda: SceneELBO(INCLUSIVE),
    "trace": Trace_ELBO,
    "enum": lambda: TraceEnum_ELBO(max_plate_nesting=2, strict_enumeration_warning=False),
    "particles": lambda: SceneELBO(num_particles=2, retain_graph=True),
}


@pytest.mark.parametrize("loss", LOSSES)
def test_svi_moves_the_parameters(loss: str) -> None:
    model, batch = tiny_model(scatter=0.05), random_batch(tiny_config(), objects=2)
    before = parts(model)
    svi = SVI(model.story, model.guide, Adam({"lr": 1e-2}), loss=LOSSES[loss]())
    for _ in range(2):
        value = svi.step(model.guide.observe(batch))
        assert value == pytest.approx(value), "a finite number"
    moved = {name: float((value - before[name]).abs().max()) for name, value in parts(model).items()}
    still = {"decoder"} if loss == "inclusive" else set()  # no voxels in that objective
    assert {name for name, change in moved.items() if change == 0} == still, moved
    assert max(moved.values()) < 0.05, "Adam's steps are as long as the rate"
    assert len(pyro.get_param_store()) == 0


def test_a_second_model_is_trained_itself() -> None:
    """Parameters are each model's own: nothing by their names lingers from the first, and frozen ones stay."""
    batch = random_batch(tiny_config(), objects=2)
    first = tiny_model()
    SVI(first.story, first.guide, Adam({"lr": 1e-2}), SceneELBO()).step(first.guide.observe(batch))
    kept = parts(first)
    second = copy.deepcopy(first)
    second.story.requires_grad_(False)
    SVI(second.story, second.guide, ClippedAdam({"lr": 1e-2}), Trace_ELBO()).step(second.guide.observe(batch))
    after = parts(second)
    assert all(torch.equal(value, kept[name]) for name, value in parts(first).items())
    assert {name for name in after if torch.equal(after[name], kept[name])} == {"prior", "decoder"}


def test_training_lowers_the_loss() -> None:
    """A dozen steps on one batch, its noise fixed: the bound rises by what Adam can do."""
    model, batch = tiny_model(), random_batch(tiny_config(), objects=2)
    svi = SVI(model.story, model.guide, Adam({"lr": 3e-3}), loss=SceneELBO())
    losses = [svi.step(model.guide.observe(batch)) for _ in range(12)]
    assert losses[-1] < losses[0] - 100
    assert svi.evaluate_loss(model.guide.observe(batch)) < losses[0] - 100


def test_the_loss_is_that_of_trace_elbo() -> None:
    """The two bounds estimate one number, voxels included; ours with less noise."""
    config = tiny_config()
    model = tiny_model(config).eval()
    batch = unsymmetric(random_batch(config, scenes=1, objects=2, seed=5)).replace(noise=None)
    scene = repeat_scene(observed_scene(config, batch), 20)
    ours, pyros = SceneELBO(), Trace_ELBO(max_plate_nesting=2)
    a = torch.tensor([ours.loss(model.story, model.guide, scene) / 20 for _ in range(8)])
    b = torch.tensor([pyros.loss(model.story, model.guide, scene) / 20 for _ in range(20)])
    assert_within(torch.cat((b - a.mean(),)), 0.0, slack=5 * float(a.std()) / len(a) ** 0.5)
    assert a.std() < b.std()
    # without voxels nothing is sampled in ours: one particle is as good as many
    exact = ours.loss(model.story, model.guide, scene, decode=0) / 20
    assert SceneELBO(num_particles=3).loss(model.story, model.guide, scene, decode=0) / 20 == pytest.approx(exact, rel=1e-12)
    c = torch.tensor([pyros.loss(model.story, model.guide, scene, decode=0) / 20 for _ in range(40)])
    assert_within(c, exact)


def test_gradients_of_all_doors_are_one() -> None:
    """`loss_and_grads`, `differentiable_loss`, Pyro's module form and the trainer's own module."""
    config = tiny_config()
    batch = random_batch(config, objects=2)

    def gradient(run: Callable[[Nolbo], object]) -> Tensor:
        model = tiny_model(config, scatter=0.05)
        run(model)
        return torch.cat([p.grad.flatten() for p in model.parameters() if p.grad is not None])

    elbo = SceneELBO(PURE_BOUND)
    scenes = len(batch.image)
    expected = gradient(lambda m: SceneLoss(m.story, m.guide, elbo)(batch, decode=None).loss.backward()) * scenes
    assert expected.abs().max() > 1
    for run in (
        lambda m: elbo.loss_and_grads(m.story, m.guide, m.guide.observe(batch)),
        lambda m: elbo.differentiable_loss(m.story, m.guide, m.guide.observe(batch)).backward(),
        lambda m: elbo(m.story, m.guide)(m.guide.observe(batch)).backward(),
    ):
        torch.testing.assert_close(gradient(run), expected, rtol=1e-9, atol=1e-9)


def test_the_trainer_minimises_the_same_object() -> None:
    model = tiny_model()
    for name, weights in (("scenes", INCLUSIVE), ("shapes", SHAPE_STAGE)):
        run = StageRun(model, TrainingStage(name, OptimizerConfig(steps=1), weights))
        assert isinstance(run.state.loss.elbo, SceneELBO) and isinstance(run.state.loss.elbo, ELBO)  # type: ignore[attr-defined]


def test_the_shape_autoencoder_under_svi() -> None:
    config = tiny_config()
    model, batch = tiny_model(config), random_batch(config, scenes=1, slots=4)
    shapes = ShapeBatch(batch.voxels[0], batch.category[0], batch.instance[0], torch.randn(4, config.latent_dim))
    before = torch.cat([p.detach().flatten() for p in model.shape_guide.parameters()])
    svi = SVI(model.shape_model, model.shape_guide, Adam({"lr": 1e-2}), loss=SceneELBO(SHAPE_STAGE))
    losses = [svi.step(shapes) for _ in range(5)]
    assert losses[-1] < losses[0]
    assert not torch.equal(torch.cat([p.detach().flatten() for p in model.shape_guide.parameters()]), before)


def test_particles_are_counted() -> None:
    with pytest.raises(InputError, match="num_particles: got 0"):
        SceneELBO(num_particles=0)
