"""Schedule, moving average, resumption, and losses that are not finite."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from nolbo_ppl.errors import NolboError
from nolbo_ppl.inference import svi as optimisation
from nolbo_ppl.inference.elbo import ElboResult, SceneELBO, SceneLoss
from nolbo_ppl.inference.svi import OptimizerConfig, OptimizerState, learning_rate
from nolbo_ppl.io.tensors import load_tensors, save_tensors
from nolbo_ppl.training.stages import scene_weights
from tests.factories import random_batch, tiny_config, tiny_model


def test_schedule() -> None:
    config = OptimizerConfig(steps=100, learning_rate=1.0, start_rate=0.1, warmup=10, decay=0.2)
    rates = [learning_rate(config, step) for step in range(100)]
    assert rates[:10] == pytest.approx([0.1 + 0.09 * k for k in range(1, 11)])
    assert rates[10:80] == [1.0] * 70
    assert rates[99] == pytest.approx(0.02)
    assert rates[89] == pytest.approx(0.02 + 0.98 / 2)
    assert all(a > b for a, b in itertools.pairwise(rates[80:]))
    assert learning_rate(config, 150) == pytest.approx(0.02)
    held = OptimizerConfig(steps=100, learning_rate=1.0, warmup=0, decay=0.0)
    assert [learning_rate(held, step) for step in (0, 50, 99, 200)] == [1.0] * 4


def quadratic(target: Tensor, module: nn.Linear) -> ElboResult:
    """A loss with a minimum at a target."""
    value = (module.weight - target).square().sum() + module.bias.square().sum()
    return ElboResult({"box": -value}, value)


def test_average_against_a_hand_loop_and_decay_of_matrices_only() -> None:
    torch.manual_seed(0)
    module = nn.Linear(3, 2)
    module.register_buffer("count", torch.tensor(0))
    target = torch.randn(2, 3)
    config = OptimizerConfig(steps=40, learning_rate=0.05, warmup=1, decay=0.0, ema=0.9, weight_decay=0.1)
    state = optimisation.init(module, lambda: quadratic(target, module), config)
    by_name = {group["weight_decay"]: [p.shape for p in group["params"]] for group in state.optimizer.param_groups}
    assert by_name == {0.1: [(2, 3)], 0.0: [(2,)]}
    average = {name: value.clone() for name, value in module.state_dict().items()}
    for step in range(40):
        module.count += 1
        optimisation.step(state)
        decay = min(0.9, (1 + step) / (10 + step))
        for name, value in module.state_dict().items():
            average[name] = decay * average[name] + (1 - decay) * value if name != "count" else value.clone()
    for name, value in average.items():
        torch.testing.assert_close(state.average[name], value, rtol=1e-12, atol=1e-14)
    assert int(state.average["count"]) == 40


def test_a_step_is_adamw_by_hand() -> None:
    """First step of AdamW on a clipped gradient: decoupled decay, then the sign of the gradient times the rate."""
    module = nn.Linear(1, 1)
    with torch.no_grad():
        module.weight.fill_(3.0)
        module.bias.fill_(-4.0)
    config = OptimizerConfig(steps=10, learning_rate=0.1, start_rate=0.0, warmup=1, weight_decay=0.5, clip=1.0)
    state = optimisation.init(module, lambda: quadratic(torch.zeros(1, 1), module), config)
    _, info = optimisation.step(state)
    assert info.loss == pytest.approx(25.0)
    assert info.gradient_norm == pytest.approx(10.0)
    assert info.learning_rate == pytest.approx(0.1)
    assert info.terms == {"box": pytest.approx(-25.0)}
    assert module.weight.item() == pytest.approx(3.0 * (1 - 0.1 * 0.5) - 0.1, abs=1e-6)
    assert module.bias.item() == pytest.approx(-4.0 + 0.1, abs=1e-6)
    assert module.weight.grad.item() == pytest.approx(0.6, abs=1e-6)


def scene_state(seed: int = 0, optimizer: str = "adamw") -> OptimizerState:
    model = tiny_model(seed=seed)
    model.shape_guide.requires_grad_(False)
    loss = SceneLoss(model.story, model.guide, SceneELBO(scene_weights("inclusive", {"voxels": 0.01})))
    config = OptimizerConfig(steps=6, learning_rate=1e-2, warmup=2, decay=0.5, ema=0.9, optimizer=optimizer)
    return optimisation.init(model, loss, config)


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Sums in one order: bit for bit the same is promised on one thread only."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("optimizer", ["adamw", "muon"])
def test_resumed_run_equals_the_uninterrupted_one(tmp_path: Path, optimizer: str) -> None:
    """Bit for bit, through a file, into networks that started elsewhere."""
    batches = [random_batch(tiny_config(), seed=step) for step in range(6)]
    whole = scene_state(optimizer=optimizer)
    infos = []
    for step, batch in enumerate(batches):
        _, info = optimisation.step(whole, batch, decode=4)
        infos.append(info)
        if step == 2:
            save_tensors(tmp_path / "state.safetensors", optimisation.state_tensors(whole), {"step": whole.step})
    tensors, meta = load_tensors(tmp_path / "state.safetensors")
    resumed = optimisation.restore(scene_state(5, optimizer), tensors, meta["step"])
    for step in range(3, 6):
        _, info = optimisation.step(resumed, batches[step], decode=4)
        assert info == infos[step]
    expected, found = optimisation.state_tensors(whole), optimisation.state_tensors(resumed)
    assert set(expected) == set(found)
    assert any(name.startswith("optimizer/") for name in expected)
    for name, value in expected.items():
        assert torch.equal(value, found[name]), name


def test_state_tensors_do_not_move_with_the_state() -> None:
    """A state taken in memory stays what it was while training goes on."""
    state = scene_state()
    batch = random_batch(tiny_config())
    optimisation.step(state, batch)
    taken = optimisation.state_tensors(state)
    before = {name: value.clone() for name, value in taken.items()}
    optimisation.step(state, batch)
    assert all(torch.equal(value, before[name]) for name, value in taken.items())


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_loss_that_is_not_finite_names_its_terms(bad: float) -> None:
    state = scene_state()
    batch = random_batch(tiny_config())
    optimisation.step(state, batch)
    before = {name: value.clone() for name, value in optimisation.state_tensors(state).items() if "running" not in name}
    good = state.loss

    def broken(*args: object, **kwargs: object) -> ElboResult:
        result = good(*args, **kwargs)
        result.terms["box_inclusive"] = result.terms["box_inclusive"] * bad
        return ElboResult(result.terms, -sum(result.terms.values()))

    state.loss = broken
    with pytest.raises(NolboError, match=r"step 1.*not finite: \{'box_inclusive'"):
        optimisation.step(state, batch)
    after = optimisation.state_tensors(state)
    assert all(torch.equal(value, after[name]) for name, value in before.items() if "num_batches" not in name)
    assert state.step == 1


def test_a_gradient_that_is_not_finite_leaves_the_weights() -> None:
    module = nn.Linear(1, 1)
    nn.init.zeros_(module.weight)
    state = optimisation.init(
        module, lambda: ElboResult({}, module.weight.abs().sqrt().sum() + module.bias.sum()), OptimizerConfig()
    )
    before = module.bias.detach().clone()
    with pytest.raises(NolboError, match="gradient of step 0 is not finite"):
        optimisation.step(state)
    assert torch.equal(module.bias.detach(), before)
    assert float(module.weight.detach()) == 0
